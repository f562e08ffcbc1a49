"""Planar fingers: recognised constants give back the forward kinematics; others are refused."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from toy_robots import replace

import casadi_ik as ik
from casadi_ik import robots
from casadi_ik.symbolic.planar_finger import planar_finger


def turn(axis: int, angle: float) -> np.ndarray:
    return pin.AngleAxis(angle, np.eye(3)[axis]).toRotationMatrix()


def contact(finger, q) -> tuple[np.ndarray, np.ndarray]:
    """Contact point and normal in the palm frame from the constants alone."""
    spread = 0.0 if finger.spread is None else finger.ratio * q[finger.spread] + finger.offset
    first, second = q[list(finger.flexion)]
    bent = finger.proximal + turn(1, first) @ (finger.middle + turn(1, second) @ finger.tip)
    angle = finger.normal_angle + first + second
    point = finger.frame @ [*(turn(2, spread) @ bent), 1]
    normal = finger.frame[:3, :3] @ turn(2, spread) @ [np.sin(angle), 0, np.cos(angle)]
    return point[:3], normal


@pytest.mark.parametrize("name", ["thumb", "finger_2", "finger_3"])
def test_constants_give_the_forward_kinematics(robot, rng, name):
    finger = planar_finger(robot.description, name)
    at = robot.fingers.index(name)
    for q in robot.random(rng, 30):
        points, normals = robot.contacts(q)
        palm = robot.palm(q)
        point, normal = contact(finger, q)
        np.testing.assert_allclose(palm[:3, :3] @ point + palm[:3, 3], points[at], atol=1e-12)
        np.testing.assert_allclose(palm[:3, :3] @ normal, normals[at], atol=1e-12)


def test_constants_of_the_barrett_hand(robot):
    second, third, thumb = (
        planar_finger(robot.description, name) for name in ("finger_2", "finger_3", "thumb")
    )
    assert second.spread == third.spread == robot.actuators.index("bh_spread")
    assert thumb.spread is None
    for finger in (second, third, thumb):
        assert finger.facing in (1.0, -1.0)
        np.testing.assert_allclose(np.linalg.norm(finger.middle), 0.070, rtol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(finger.tip), np.hypot(0.05, 0.0095), rtol=1e-12)
        np.testing.assert_allclose(np.degrees(finger.flexion_limits), [[0, 140], [0, 48]])
    np.testing.assert_allclose(second.frame[:3, 3], [0.025, 0, 0.0754 - 0.080], atol=1e-15)


def test_facing_is_the_side_of_the_pad(robot, rng):
    """The pad faces the finger frame's x axis on the side that `facing` says."""
    for name in robot.fingers:
        finger = planar_finger(robot.description, name)
        sums = finger.flexion_limits.sum(axis=0)
        side = np.sin(finger.normal_angle + np.linspace(*sums, 50)) * finger.facing
        assert np.mean(side > 0) > 0.6


def test_ratio_and_offset_of_the_spread(own_robot, rng):
    replace(
        own_robot.with_name("hand.yaml"),
        "coupling: {kind: linear, of: bh_spread}",
        "coupling: {kind: linear, of: bh_spread, ratio: -0.5, offset: 0.3}",
    )
    description = robots.load_description(own_robot)
    finger = planar_finger(description, "finger_2")
    assert (finger.ratio, finger.offset) == (-0.5, 0.3)


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


def test_coupled_flexion_is_refused(own_robot):
    """The real Barrett hand's distal joints follow the proximal ones."""
    hand = own_robot.with_name("hand.yaml")
    replace(hand, "  bh_finger_2_distal: {}\n", "")
    limits = "limits: [0 deg, 48 deg], velocity: 2 rad/s, source: mdh cad limits assumed"
    text = hand.read_text()
    at = text.index(limits, text.index("name: bh_finger_2_distal"))
    follower = ",\n     coupling: {kind: linear, of: bh_finger_2_proximal, ratio: 0.3333}"
    hand.write_text(text[: at + len(limits)] + follower + text[at + len(limits) :])
    replace(own_robot, "  bh_finger_2_distal: 10 deg\n", "")
    with pytest.raises(
        ik.errors.UnsupportedError, match="follows 'bh_finger_2_proximal'; expected its own"
    ):
        planar_finger(robots.load_description(own_robot), "finger_2")


def test_long_and_short_chains_are_refused(coupled_robot):
    with pytest.raises(
        ik.errors.UnsupportedError, match=r"it has joints \['left_spread', 'left_1', .*; exp"
    ):
        planar_finger(coupled_robot.description, "left")
    with pytest.raises(ik.errors.UnsupportedError, match="right_spread follows 'spread'"):
        planar_finger(coupled_robot.description, "right")
