"""Targets that are met only within their tolerance are solved by every call of a solver."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import with_fixed_motor
from toy_robots import moved_targets

import casadi_ik as ik


@pytest.mark.parametrize("degrees", [10.0, 30.0])
@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_displaced_targets_are_solved_in_a_batch(robot, degrees, prefer):
    """The exact fit alone missed up to 80 % of them."""
    tolerance = ik.Tolerance(0.005, np.radians(degrees))
    rng = np.random.default_rng(7)
    contacts = robot.contacts(robot.random(rng, 500))
    points, normals = moved_targets(contacts, rng, 0.8 * tolerance.position, 0.8 * tolerance.angle)
    starts = robot.random(np.random.default_rng(1), len(points))
    batch = ik.Solver(robot, tolerance=tolerance).solve_batch(
        points, normals, q0=starts, prefer=prefer
    )
    assert np.flatnonzero(~batch.success).tolist() == []


@pytest.mark.parametrize("name", ["unitree_dex3", "dclaw", "puma560"])
def test_wide_tolerances_are_searched_beyond_the_minima_of_exact_fits(name):
    """Repeated minima ended the search: 20 % of the Dex3's targets were missed."""
    robot, rng = ik.load_robot(name), np.random.default_rng(5)
    tolerance = ik.Tolerance(0.001, np.radians(60.0))
    contacts = robot.contacts(robot.random(rng, 1000))
    targets = moved_targets(contacts, rng, 0.8 * tolerance.position, 0.8 * tolerance.angle)
    with pytest.warns(ik.errors.InputWarning, match="tolerance"):
        solver = ik.Solver(robot, tolerance=tolerance)
    assert np.mean(solver.solve_batch(*targets).success) >= 0.997


def displaced_palms(robot, q, tolerance, part):
    """Return palm poses of configurations, displaced by a part of the tolerance."""
    rng, palms = np.random.default_rng(11), np.array(robot.palm(q))
    shift, axis = rng.normal(size=(2, len(q), 3))
    shift *= part * tolerance.position / np.linalg.norm(shift, axis=1, keepdims=True)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    cross = np.cross(axis[:, None], np.eye(3)[None]).swapaxes(1, 2)
    angle = part * tolerance.angle
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    palms[:, :3, :3] = turn @ palms[:, :3, :3]
    palms[:, :3, 3] += shift
    return palms


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_an_arm_of_five_axes_reaches_palm_poses_within_tolerance(degrees):
    """Exact poses are out of reach of the arm; 2 to 9 of 20 were solved."""
    robot = with_fixed_motor(ik.load_robot("viperx_300s+so100_jaw"), "vx300s_joint_4")
    tolerance = ik.Tolerance(0.005, np.radians(degrees))
    q = robot.random(np.random.default_rng(7), 20)
    palms = displaced_palms(robot, q, tolerance, 0.8)
    solver = ik.Solver(robot, tolerance=tolerance)
    motors = robot.description.finger_motors
    for prefer in ("limits", "q0"):
        batch = solver.solve_palms(palms, q, prefer=prefer)
        assert np.flatnonzero(~batch.success).tolist() == []
        assert (np.asarray(batch.palm_position_error) <= tolerance.position).all()
        assert (np.asarray(batch.palm_angle_error) <= tolerance.angle).all()
    for palm, hand in zip(palms, q, strict=True):
        posture = {name: float(hand[robot.actuators.index(name)]) for name in motors}
        grasp = ik.Grasp(palm=palm, posture=posture)
        assert solver.solve(grasp, diagnose=False).success
        assert len(solver.choose([grasp]))
        assert solver.solve_all(grasp, limit=1)


def test_palms_of_an_arm_with_limits_are_solved_within_tolerance(robot):
    """Displaced poses are beyond the limits or the reach of the arm: 12 % were missed."""
    tolerance = ik.Tolerance(0.005, np.radians(30.0))
    q = robot.random(np.random.default_rng(7), 100)
    palms = displaced_palms(robot, q, tolerance, 0.8)
    batch = ik.Solver(robot, tolerance=tolerance).solve_palms(palms, q, diagnose=True)
    assert np.flatnonzero(~batch.success).tolist() == []
