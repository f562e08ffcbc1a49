"""The four-bar and the slider triangle: closure, branches, derivatives, toggles, AR10 numbers."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from algebra_samples import central_difference, gradient, graph
from toy_robots import replace

import casadi_ik as ik
from casadi_ik import model as robots
from casadi_ik.kinematics import mechanisms
from casadi_ik.kinematics.mechanisms import Linkage
from casadi_ik.papers.qiu.fingers import planar_finger

S, B = (1, 1), (5, 1)
AR10 = Linkage(2.97, 3.47, 0.84, 0.72, -1)
AR10_PHI = 3.32939008
AR10_RANGE = np.linspace(0, 1.225, 200)


def bar(b):
    return Linkage(b[0], b[1], b[2], b[3], b[4])


psi = graph(lambda phi, b: mechanisms.psi(phi, bar(b)), S, B)
theta3 = graph(lambda phi, b, r: mechanisms.theta3(phi, bar(b), r), S, B, S)
f = graph(lambda phi, b: mechanisms.theta3_rate(phi, bar(b)), S, B)
toggle = graph(lambda phi, b: mechanisms.linkage_toggle(phi, bar(b)), S, B)


def linkages(count: int, seed: int = 3):
    """Yield random linkages of both branches, at least 1e-3 of sin^2 away from a toggle."""
    rng = np.random.default_rng(seed)
    found_count = 0
    while found_count < count:
        lengths, phi = rng.uniform(0.3, 2, 4), rng.uniform(-np.pi, np.pi)
        b = np.array([*lengths, rng.choice([-1.0, 1.0])])
        if float(toggle(phi, b)) > 1e-3:
            found_count += 1
            yield b, phi


def test_loop_closes_to_rounding_on_both_branches():
    branches = []
    for b, phi in linkages(400):
        p, q, g, h, sigma = b
        rod, theta = float(psi(phi, b)), float(theta3(phi, b, 0))
        P = p * np.array([np.cos(phi), np.sin(phi)])
        Q = np.array([g + q * np.cos(rod), q * np.sin(rod)])
        beta = phi + theta
        assert np.abs(P + h * np.array([np.cos(beta), np.sin(beta)]) - Q).max() < 1e-12
        assert np.sin(beta - rod) * sigma > 0
        assert float(toggle(phi, b)) == pytest.approx(np.sin(beta - rod) ** 2, abs=1e-12)
        branches.append(sigma)
        # psi as printed below eq. (9), with sigma for the minus sign
        A, Bc, C = (float(x) for x in mechanisms.coefficients(ca.DM(phi), Linkage(*b)))
        printed = np.arctan2(Bc, A) + sigma * np.arccos(C / np.hypot(A, Bc))
        assert np.cos(printed - rod) == pytest.approx(1, abs=1e-12)
    assert {-1.0, 1.0} == set(branches)


def test_rates_match_central_differences_ad_and_eq_11_with_the_crank():
    theta_ad = gradient(lambda phi, b: mechanisms.theta3(phi, bar(b)), S, B)
    step, wrong = 1e-6, []
    for b, phi in linkages(400, seed=4):
        p, _, g, h, _ = b
        if float(toggle(phi, b)) < 1e-2:
            continue
        theta, rod = float(theta3(phi, b, 0)), float(psi(phi, b))
        slope = float(f(phi, b))
        difference = float(theta3(phi + step, b, theta) - theta3(phi - step, b, theta)) / (2 * step)
        assert slope == pytest.approx(difference, rel=1e-6, abs=1e-6)
        assert slope == pytest.approx(float(theta_ad(phi, b)[0]), rel=1e-9, abs=1e-9)
        lever = h * np.sin(phi + theta - rod)
        assert slope == pytest.approx((p * np.sin(rod - phi) - lever) / lever, rel=1e-9, abs=1e-9)
        wrong.append(abs((g * np.sin(rod - phi) - lever) / lever - slope))
    assert np.median(wrong) > 0.1  # a = g in eq. (11) is not a rounding matter


def test_reference_makes_theta3_continuous_through_the_cut():
    b = [1.0, 2.0, 0.5, 1.8, -1]
    phis = np.linspace(0, 2 * np.pi, 721)
    cut, smooth, last = [], [], 0.0
    for phi in phis:
        if float(toggle(phi, b)) < 1e-3:
            continue
        cut.append(float(theta3(phi, b, 0)))
        last = float(theta3(phi, b, last if smooth else cut[0]))
        smooth.append(last)
    assert len(smooth) > 300
    assert np.abs(np.diff(smooth)).max() < 0.1
    assert np.allclose(np.exp(1j * np.array(cut)), np.exp(1j * np.array(smooth)))


def test_branch_from_a_known_pose():
    assert mechanisms.branch_from_pose(AR10, AR10_PHI, 4.1103) == -1
    assert mechanisms.branch_from_pose(AR10, AR10_PHI, 4.1103 - 2 * np.pi) == -1
    assert mechanisms.branch_from_pose(AR10, AR10_PHI, 2.09) == 1
    for b, phi in linkages(50, seed=6):
        theta = float(theta3(phi, b, 0))
        assert mechanisms.branch_from_pose(Linkage(*b), phi, theta) == b[4]
    with pytest.raises(ik.errors.InputError, match="cannot be assembled"):
        mechanisms.branch_from_pose(Linkage(1.0, 0.1, 3.0, 0.1), 3.0, 0.0)


def test_beyond_assembly_values_are_finite_and_flagged():
    gradients = [
        gradient(lambda phi, b, g=g: g(phi, bar(b)), S, B)
        for g in (mechanisms.psi, mechanisms.theta3, mechanisms.theta3_rate)
    ]
    rng = np.random.default_rng(8)
    outside = 0
    while outside < 100:
        b, phi = np.array([*rng.uniform(0.3, 2, 4), rng.choice([-1, 1])]), rng.uniform(-3, 3)
        if float(toggle(phi, b)) >= 0:
            continue
        outside += 1
        for g in (psi, f):
            assert g(phi, b).is_regular()
        assert theta3(phi, b, 0).is_regular()
        assert all(dg(phi, b).is_regular() for dg in gradients)
    # exactly at a toggle: crank and ground in line, rod + coupler just long enough
    b = [1.0, 1.5, 1.0, 0.5, 1]
    assert float(toggle(np.pi, b)) == pytest.approx(0, abs=1e-12)
    assert all(dg(np.pi, b).is_regular() for dg in gradients)


def test_theta3_is_continuous_into_the_toggle():
    b = [1.0, 1.0, 1.5, 1.0, -1]
    phis = np.linspace(0, np.pi, 4001)
    measures = np.array([float(toggle(x, b)) for x in phis])
    last = int(np.flatnonzero(measures > 0)[-1])
    assert measures[last + 1] < 0
    inner_angle, outside = float(theta3(phis[last], b, 0)), float(theta3(phis[last + 1], b, 0))
    assert abs(inner_angle - outside) < 0.05


S = (1, 1)
angle = graph(mechanisms.angle_from_slider, S, S, S)
rate = graph(mechanisms.angle_rate, S, S, S)
slider_toggle = graph(mechanisms.slider_toggle, S, S, S)
angle_gradient = gradient(mechanisms.angle_from_slider, S, S, S)

# b, c, shortest and longest slider [mm]; angle there [rad].
AR10_SCREWS = {
    "index proximal": (52.2, 13.0, 42.0, 60.0, 0.587, 2.118),
    "index middle": (49.8, 14.0, 41.5, 57.5, 0.818, 2.040),
    "thumb 1": (52.36, 11.86, 42.46, 59.60, 0.518, 2.141),
    "thumb 2": (49.4, 12.0, 41.48, 51.20, 0.755, 1.602),
}


@pytest.mark.parametrize("name", AR10_SCREWS)
def test_ar10_stroke(name):
    b, c, low, high = (1e-3 * x for x in AR10_SCREWS[name][:4])
    for s, expected in zip((low, high), AR10_SCREWS[name][4:], strict=True):
        assert float(angle(s, b, c)) == pytest.approx(expected, abs=6e-4)
    rates = []
    for s in np.linspace(low, high, 101):
        theta = float(angle(s, b, c))
        acos = np.arccos((b * b + c * c - s * s) / (2 * b * c))
        assert theta == pytest.approx(acos, abs=1e-14)
        slope = float(rate(s, b, c))
        assert slope == pytest.approx(float(angle_gradient(s, b, c)[0]), rel=1e-13)
        assert slope == pytest.approx(s / (b * c * np.sin(theta)), rel=1e-12)
        difference = central_difference(angle, s, b, c, step=1e-8)[0, 0]
        assert slope == pytest.approx(difference, rel=1e-6)
        rates.append(slope)
    assert min(rates) > 70
    assert max(rates) < 140


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
        assert float(slider_toggle(s, b, c)) == pytest.approx(
            np.sin(float(angle(s, b, c))) ** 2, abs=1e-12
        )
    for s in (b - c, b + c):
        assert float(slider_toggle(s, b, c)) == pytest.approx(0, abs=1e-12)
    assert float(slider_toggle(0.03, b, c)) < 0
    assert float(slider_toggle(0.07, b, c)) < 0


def turn(axis: int, angle: float) -> np.ndarray:
    return pin.AngleAxis(angle, np.eye(3)[axis]).toRotationMatrix()


def contact(finger, q) -> tuple[np.ndarray, np.ndarray]:
    """Return contact point and normal in the palm frame from the constants alone."""
    spread = (
        0.0
        if finger.spread_motor is None
        else finger.ratio * q[finger.spread_motor] + finger.offset
    )
    first, second = q[list(finger.flexion)]
    bent = finger.proximal + turn(1, first) @ (finger.middle + turn(1, second) @ finger.tip)
    angle = finger.normal_angle + first + second
    point = finger.frame @ [*(turn(2, spread) @ bent), 1]
    normal = finger.frame[:3, :3] @ turn(2, spread) @ [np.sin(angle), 0, np.cos(angle)]
    return point[:3], normal


@pytest.mark.parametrize("name", ["thumb", "finger_2", "finger_3"])
@pytest.mark.parametrize("coupling", ["", ", ratio: -0.5, offset: 0.3"])
def test_constants_give_the_forward_kinematics(own_robot, rng, name, coupling):
    plain = "coupling: {kind: linear, of: bh_spread"
    replace(own_robot.with_name("hand.yaml"), f"{plain}}}", f"{plain}{coupling}}}")
    robot = ik.load_robot(own_robot)
    finger = planar_finger(robot.description, name)
    if coupling and name == "finger_2":
        assert (finger.ratio, finger.offset) == (-0.5, 0.3)
    at = robot.fingers.index(name)
    for q in robot.random(rng, 30):
        points, normals = robot.contacts(q)
        palm = robot.palm(q)
        point, normal = contact(finger, q)
        np.testing.assert_allclose(palm[:3, :3] @ point + palm[:3, 3], points[at], atol=1e-12)
        np.testing.assert_allclose(palm[:3, :3] @ normal, normals[at], atol=1e-12)


REFUSED = {
    "axes": (
        "parent: bh_finger_2_link_2, child: bh_finger_2_link_3, axis: [0, 0, 1]",
        "parent: bh_finger_2_link_2, child: bh_finger_2_link_3, axis: [0, 1, 1]",
        "flexion axes are not parallel",
    ),
    "normal": (
        "finger_2: {link: bh_finger_2_link_3, xyz: [50 mm, 9.5 mm, 0], normal: [0, 1, 0]",
        "finger_2: {link: bh_finger_2_link_3, xyz: [50 mm, 9.5 mm, 0], normal: [0, 1, 0.3]",
        "not in plane",
    ),
    "prismatic": (
        "bh_finger_2_distal, parent",
        "bh_finger_2_distal, type: prismatic, parent",
        "all revolute",
    ),
    "spread": (
        "coupling: {kind: linear, of: bh_spread}",
        "coupling: {kind: lead-screw, of: bh_spread, b: 2, c: 2}",
        "bh_finger_2_spread does not follow a motor linearly",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_fingers_are_refused_with_the_reason(own_robot, case):
    old, new, says = REFUSED[case]
    hand = own_robot.with_name("hand.yaml")
    replace(hand, old, new)
    if case == "spread":
        in_degrees = "bh_spread: {limits: [0 deg, 180 deg], velocity: 2 rad/s"
        replace(hand, in_degrees, "bh_spread: {unit: m, limits: [0 m, 3.14 m], velocity: 2 m/s")
        replace(own_robot, "bh_spread: 30 deg", "bh_spread: 0.5 m")
    if case == "prismatic":
        replace(own_robot, "bh_finger_2_distal: 10 deg", "bh_finger_2_distal: 10 mm")
        start = "     origin: {xyz: [70 mm, 0, 0], rpy: [0, 0, 37.544 deg]},\n     limits: "
        finger = "type: prismatic, parent: bh_finger_2_link_2, child: bh_finger_2_link_3"
        head = f"{finger}, axis: [0, 0, 1],\n{start}"
        replace(
            hand, f"{head}[0 deg, 48 deg], velocity: 2 rad/s", f"{head}[0, 48 mm], velocity: 2 m/s"
        )
    with pytest.raises(ik.errors.UnsupportedError) as caught:
        planar_finger(robots.load_description(own_robot), "finger_2")
    message = str(caught.value)
    assert message.startswith(
        "robot 'kuka_lwr_barrett': finger 'finger_2' is not a planar finger: "
    )
    assert says in message


def test_long_and_short_chains_are_refused(coupled_robot):
    with pytest.raises(
        ik.errors.UnsupportedError, match=r"it has joints \['left_spread', 'left_1', .*; exp"
    ):
        planar_finger(coupled_robot.description, "left")
    with pytest.raises(ik.errors.UnsupportedError, match="right_spread follows 'spread'"):
        planar_finger(coupled_robot.description, "right")
