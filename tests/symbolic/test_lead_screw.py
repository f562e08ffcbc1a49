"""The AR10's slider triangles: round trips over the stroke and the closed derivative."""

import numpy as np
import pytest
from algebra_samples import PROPERTY, central_difference, gradient, graph
from hypothesis import given
from hypothesis import strategies as st

from casadi_ik.symbolic import mechanisms

S = (1, 1)
angle = graph(mechanisms.angle_from_slider, S, S, S)
slider = graph(mechanisms.slider_from_angle, S, S, S)
rate = graph(mechanisms.angle_rate, S, S, S)
toggle = graph(mechanisms.slider_toggle, S, S, S)
angle_gradient = gradient(mechanisms.angle_from_slider, S, S, S)

# b, c, shortest and longest slider [mm]; angle there [rad], facts/robots.md section 3.
AR10 = {
    "index proximal": (52.2, 13.0, 42.0, 60.0, 0.587, 2.118),
    "index middle": (49.8, 14.0, 41.5, 57.5, 0.818, 2.040),
    "thumb 1": (52.36, 11.86, 42.46, 59.60, 0.518, 2.141),
    "thumb 2": (49.4, 12.0, 41.48, 51.20, 0.755, 1.602),
}


@pytest.mark.parametrize("name", AR10)
def test_ar10_stroke(name):
    b, c, low, high = (1e-3 * x for x in AR10[name][:4])
    for s, expected in zip((low, high), AR10[name][4:], strict=True):
        assert float(angle(s, b, c)) == pytest.approx(expected, abs=6e-4)
    rates = []
    for s in np.linspace(low, high, 101):
        theta = float(angle(s, b, c))
        acos = np.arccos((b * b + c * c - s * s) / (2 * b * c))
        assert theta == pytest.approx(acos, abs=1e-14)
        assert float(slider(theta, b, c)) == pytest.approx(s, abs=1e-16)
        found = float(rate(s, b, c))
        assert found == pytest.approx(float(angle_gradient(s, b, c)[0]), rel=1e-13)
        assert found == pytest.approx(s / (b * c * np.sin(theta)), rel=1e-12)
        difference = central_difference(angle, s, b, c, step=1e-8)[0, 0]
        assert found == pytest.approx(difference, rel=1e-6)
        rates.append(found)
    assert min(rates) > 70
    assert max(rates) < 140


@PROPERTY
@given(st.floats(0.01, 0.1), st.floats(1.1, 5), st.floats(1e-6, np.pi - 1e-6))
def test_round_trip_between_the_flat_triangles(b, ratio, theta):
    s = slider(theta, b, ratio * b)
    assert float(angle(s, b, ratio * b)) == pytest.approx(theta, abs=1e-15 / np.sin(theta) * 20)


def test_outside_the_triangle_nothing_is_nan():
    b, c = 0.05, 0.013
    for s in (0.0, 0.01, b - c, b + c, 0.1):
        assert angle(s, b, c).is_regular()
        assert angle_gradient(s, b, c).is_regular()
        assert rate(s, b, c).is_regular()
    assert float(angle(0.01, b, c)) == pytest.approx(0, abs=1e-7)
    assert float(angle(0.1, b, c)) == pytest.approx(np.pi, abs=1e-7)


def test_toggle_is_the_squared_sine_and_turns_negative_without_a_triangle():
    b, c = 0.0522, 0.013
    for s in np.linspace(0.0395, 0.065, 30):
        assert float(toggle(s, b, c)) == pytest.approx(
            np.sin(float(angle(s, b, c))) ** 2, abs=1e-12
        )
    for s in (b - c, b + c):
        assert float(toggle(s, b, c)) == pytest.approx(0, abs=1e-12)
    assert float(toggle(0.03, b, c)) < 0
    assert float(toggle(0.07, b, c)) < 0
