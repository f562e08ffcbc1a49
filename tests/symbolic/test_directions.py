"""Unit vectors: the rotation between two of them, the error, and what aligns several."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from algebra_samples import PROPERTY, central_difference, gradient, graph, unit_vectors
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from casadi_ik.symbolic import se3
from casadi_ik.symbolic.se3 import align

V = (3, 1)
angle = graph(se3.angle_between, V, V)
error = graph(se3.normal_error, V, V)
rotation = graph(se3.rotation_between, V, V)
perpendicular = graph(se3.perpendicular, V)
gradients = [gradient(f, V, V) for f in (se3.angle_between, se3.normal_error, se3.rotation_between)]
SPECIAL = [np.array(v, float) for v in ([0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0])]


def turned(n: np.ndarray, w: np.ndarray, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """The unit axis perpendicular to n nearest to w, and n turned about it by theta."""
    axis = np.cross(n, np.cross(w, n))
    axis /= np.linalg.norm(axis)
    return axis, np.cos(theta) * n + np.sin(theta) * np.cross(axis, n)


thetas = st.one_of(
    st.sampled_from([1e-300, 1e-15, 1e-9, 1e-5, 0.99e-4, 1.01e-4, 1e-3]),
    st.floats(1e-3, 3.14),
    st.sampled_from([np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-8, np.pi - 1e-10]),
)


@PROPERTY
@given(unit_vectors, unit_vectors, thetas)
def test_error_turns_current_into_desired(n, w, theta):
    if np.linalg.norm(np.cross(n, w)) < 0.1:
        w = np.roll(n, 1) * [1, -1, 1]
    if np.linalg.norm(np.cross(n, w)) < 0.1:
        return
    axis, d = turned(n, w, theta)
    # Rounding the two normals moves their angle by about 1e-16, hence the direction by 1e-16/sin.
    slack = 1e-15 / max(np.sin(theta), 1e-15)
    assert abs(float(angle(n, d)) - theta) < 1e-15
    e = error(n, d).full()[:, 0]
    assert abs(np.linalg.norm(e) - theta) < 4e-15 + slack * slack
    assert np.linalg.norm(e - theta * axis) < theta * slack + 1e-15
    R = rotation(n, d).full()
    assert np.allclose(R @ n, d, rtol=0, atol=4e-15)
    assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=4e-15)
    assert np.allclose(R @ axis, axis, rtol=0, atol=2 * slack + 1e-15)


@PROPERTY
@given(unit_vectors)
def test_opposite_normals_get_a_half_turn(n):
    for n_ in (n, *SPECIAL):
        e = error(n_, -n_).full()[:, 0]
        assert abs(np.linalg.norm(e) - np.pi) < 2e-15
        assert abs(e @ n_) < 2e-15
        R = rotation(n_, -n_).full()
        assert np.allclose(R @ n_, -n_, rtol=0, atol=2e-15)
        assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=4e-15)
        assert np.linalg.det(R) > 0
        p = perpendicular(n_).full()[:, 0]
        assert abs(np.linalg.norm(p) - 1) < 2e-15
        assert abs(p @ n_) < 2e-15


@PROPERTY
@given(unit_vectors)
def test_equal_normals_have_no_error(n):
    assert np.array_equal(error(n, n).full()[:, 0], np.zeros(3))
    assert float(angle(n, n)) < 1e-149
    assert np.allclose(rotation(n, n).full(), np.eye(3), rtol=0, atol=2e-15)


def test_lengths_do_not_matter_to_the_angle():
    assert float(angle([3, 0, 0], [0, 0, 0.1])) == pytest.approx(np.pi / 2, abs=1e-15)


@PROPERTY
@given(unit_vectors, unit_vectors)
def test_derivatives_match_central_differences(n, d):
    if np.linalg.norm(n - d) < 0.1 or np.linalg.norm(n + d) < 0.1:
        return
    for f, df in zip((angle, error, rotation), gradients, strict=True):
        assert np.allclose(df(n, d).full(), central_difference(f, n, d), rtol=1e-6, atol=1e-7)


def test_derivatives_are_finite_at_equal_and_opposite_normals():
    for n in [*SPECIAL, np.array([0.6, 0.0, 0.8]), np.array([0.48, -0.6, 0.64])]:
        for df in gradients:
            assert df(n, n).is_regular()
            assert df(n, -n).is_regular()


def test_small_error_is_the_cross_product_to_first_order():
    n = np.array([0.48, -0.6, 0.64])
    J = gradients[1](n, n).full()[:, 3:]
    assert np.allclose(J, np.cross(n, np.eye(3)).T, rtol=0, atol=1e-15)


@pytest.fixture(scope="module")
def best():
    B = ca.SX.sym("B", 3, 3)
    function = ca.Function("align", [B], [align(B)])
    return lambda matrix: np.array(function(matrix))


def contraction(B):
    """What 128 steps of the power iteration leave of an error, from Davenport's eigenvalues."""
    B = B / np.linalg.norm(B)
    z = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    K = np.block(
        [[np.trace(B), z[None]], [z[:, None], B + B.T - np.trace(B) * np.eye(3)]]
    ) + 2 * np.eye(4)
    values = np.linalg.eigvalsh(K)
    return (values[-2] / values[-1]) ** 128


@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_as_good_as_scipy(best, rng, count, noise):
    clear = 0
    for _ in range(30):
        turn = Rotation.random(rng=rng).as_matrix()
        a, w = rng.normal(size=(count, 3)), rng.uniform(0.1, 2, count)
        b = a @ turn.T + noise * rng.normal(size=(count, 3))
        R = best((w[:, None] * b).T @ a)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        expected = Rotation.align_vectors(b, a, weights=w)[0].as_matrix()
        left = contraction((w[:, None] * b).T @ a)
        if left < 0.01:
            clear += 1
            np.testing.assert_allclose(R, expected, atol=20 * left + 1e-7)
    assert clear > 10


def test_any_scale(best, rng):
    a, turn = rng.normal(size=(4, 3)), Rotation.random(rng=rng).as_matrix()
    B = (a @ turn.T).T @ a
    for scale in (1e-6, 1.0, 1e6):
        np.testing.assert_allclose(best(scale * B), best(B), atol=1e-9)


def test_half_a_turn(best):
    turn = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    np.testing.assert_allclose(best(turn), turn, atol=1e-9)


def test_one_vector_and_nothing_give_a_rotation(best):
    for B in (np.outer([0, 0, 1.0], [1.0, 0, 0]), np.zeros((3, 3))):
        R = best(B)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert best(np.outer([0, 0, 1.0], [1.0, 0, 0]))[2, 0] == pytest.approx(1, abs=1e-9)
