"""The palm orientation that the contact points suggest, eqs. (1) and (2)."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from toy_robots import replace

import casadi_ik as ik
from casadi_ik.errors import UnsupportedError
from casadi_ik.papers.qiu.tasks import axes_through, base_axes, palm_orientation
from casadi_ik.problem.target import Target


def estimate(robot: ik.ArmHand, points: np.ndarray) -> np.ndarray:
    """Estimated palm orientation for (f, 3) contact points in the order of `robot.fingers`."""
    symbols = ca.SX.sym("p", 3, len(points))
    goals = {name: Target(symbols[:, i], ca.SX.zeros(3, 1)) for i, name in enumerate(robot.fingers)}
    f = ca.Function("f", [symbols], [palm_orientation(robot.description, goals)])
    return np.array(f(points.T))


def rotation(rng) -> np.ndarray:
    return pin.exp3(rng.normal(size=3))


def test_bases_of_the_barrett_hand_span_the_palm_frame(robot):
    np.testing.assert_allclose(base_axes(robot.description), np.eye(3), atol=1e-15)


def test_symmetric_pinch_gives_the_palm_itself(robot, rng):
    """Without spread the fingertips form the same triangle as the bases."""
    q = robot.random(rng, 20)
    q[:, 7] = 0.0
    q[:, 12:] = q[:, 10:12]
    q[:, 8:10] = q[:, 10:12]
    for row in q:
        points, _ = robot.contacts(row)
        palm = robot.palm(row)
        side = (points[0] - points[1]) @ palm[:3, 1]
        expected = palm[:3, :3] if side > 0 else palm[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(estimate(robot, points), expected, atol=1e-9)


def test_moves_with_the_contacts(robot, rng):
    for _ in range(20):
        points = rng.normal(size=(3, 3))
        R, p = rotation(rng), rng.normal(size=3)
        there = estimate(robot, points @ R.T + p)
        np.testing.assert_allclose(there, R @ estimate(robot, points), atol=1e-12)
        np.testing.assert_allclose(there @ there.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(there) == pytest.approx(1.0)


def test_eqs_1_and_2_literally(robot, rng):
    thumb, second, third = points = rng.normal(size=(3, 3))
    x, y = second - third, thumb - (second + third) / 2
    z = np.cross(x, y)
    x = np.cross(y, z)
    axes = [axis / np.linalg.norm(axis) for axis in (x, y, z)]
    np.testing.assert_allclose(estimate(robot, points), np.stack(axes, axis=1), atol=1e-12)


def test_another_palm_frame_turns_the_estimate_with_it(own_robot, robot, rng):
    replace(
        own_robot.with_name("hand.yaml"),
        "palm: {link: bh_base,",
        "palm: {link: bh_base, rpy: [0.3, 0.2, 1.0],",
    )
    own = ik.load_robot(own_robot)
    points = rng.normal(size=(3, 3))
    turned = estimate(robot, points) @ own.description.palm_placement[:3, :3]
    np.testing.assert_allclose(estimate(own, points), turned, atol=1e-12)


def test_points_on_a_line_give_finite_numbers():
    points = [ca.SX([0, 0, 0]), ca.SX([1, 0, 0]), ca.SX([2, 0, 0])]
    assert np.all(np.isfinite(np.array(ca.evalf(ca.densify(axes_through(points))))))


def test_two_fingers_are_too_few(own_robot):
    replace(own_robot, "[thumb, finger_2, finger_3]", "[thumb, finger_2]")
    with pytest.raises(UnsupportedError, match=r"has 2 fingers; .* at least three"):
        base_axes(ik.load_robot(own_robot).description)
