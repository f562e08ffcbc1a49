"""Fixed motors: wherever they are within limits, no reachable target is missed."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import part_of_the_arm
from toy_robots import copy_shipped_robot, edited, grasp_of

import casadi_ik as ik


def all_solved(
    robot: ik.ArmHand, fixed: dict[str, float], prefer: str = "limits", k: int = 12
) -> bool:
    """Assert that k targets reachable with fixed motors are solved and keep them."""
    q = robot.random(np.random.default_rng(17), k)
    columns = [robot.actuators.index(name) for name in fixed]
    q[:, columns] = list(fixed.values())
    solver = ik.Solver(robot, compiled=False)
    batch = solver.solve_batch(*robot.contacts(q), q0=robot.home, prefer=prefer, fixed=fixed)
    np.testing.assert_array_equal(batch.q[:, columns], q[:, columns])
    return bool(batch.success.all())


@pytest.mark.parametrize(
    ("method", "limits", "min_solved"),
    [("hand-first", "enforce", 1), ("hand-first", "ignore", 1), ("thumb-first", "enforce", 0.9)],
)
def test_every_motor_can_be_fixed(robot, rng, method, limits, min_solved):
    tolerance = ik.Tolerance(1e-6, 1e-6) if method == "hand-first" else ik.Tolerance()
    solver = ik.Solver(robot, method, tolerance, limits=limits)
    for i, name in enumerate(robot.actuators):
        q = robot.random(rng, 25)
        q[:, i] = value = rng.uniform(robot.lower[i], robot.upper[i])
        batch = solver.solve_batch(*robot.contacts(q), fixed={name: value})
        assert batch.success.mean() >= min_solved, name
        np.testing.assert_array_equal(batch.q[:, i], value)


@pytest.mark.parametrize("prefer", ["limits", "q0"])
@pytest.mark.parametrize(
    ("name", "fixed"),
    [
        ("ur10e+robotiq_3f", {"ur10e_joint_1": 4.2, "ur10e_joint_6": -5.1}),
        ("puma560+jaco_3f", {"puma560_joint_4": -4.2}),
        ("xarm6+barrett_bh8_280", {"xarm6_joint_1": -4.2, "xarm6_joint_6": 5.1}),
        ("xarm7+trifinger", {"xarm7_joint_1": 4.2, "xarm7_joint_3": 4.2, "xarm7_joint_5": -5.1}),
    ],
)
def test_joint_can_be_fixed_in_another_turn(name, fixed, prefer):
    """An arm family gives each joint in the middle turn of its range."""
    assert all_solved(ik.load_robot(name), fixed, prefer)


@pytest.mark.parametrize("value", [np.pi, -np.pi])
def test_joint_can_be_fixed_at_the_turn_border(value):
    robot = ik.load_robot("ur10e+robotiq_3f")
    assert all_solved(robot, {"ur10e_joint_1": value, "ur10e_joint_5": value / 2})


@pytest.mark.parametrize("compiled", [True, False])
def test_fixed_turn_keeps_alternatives_and_collision_free_answers(compiled):
    robot = ik.load_robot("ur10e+robotiq_3f")
    solver = ik.Solver(robot, compiled=compiled)
    free = ik.Solver(robot, scene=ik.load_scene("table"), compiled=compiled)
    q = robot.random(np.random.default_rng(1), 8)
    counts = []
    for turn in (0.0, 2 * np.pi):
        fixed = {robot.actuators[0]: turn - 2.0}
        q[:, 0] = turn - 2.0
        points, normals = robot.contacts(q)
        solved = free.solve_batch(points, normals, fixed=fixed).success
        alternatives = solver.solve_all(
            grasp_of(robot, points[0], normals[0]), limit=9, fixed=fixed
        )
        counts.append((len(alternatives), solved.tolist()))
    assert counts[0] == counts[1]
    assert counts[0][0] > 1


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_two_sphere_arm_joint_can_be_fixed_in_another_turn(tmp_path, prefer):
    path = copy_shipped_robot(tmp_path)
    with edited(tmp_path / "arm.yaml") as arm:
        for joint in (arm["joints"][0], arm["joints"][6]):
            joint["limits"] = ["-360 deg", "360 deg"]
    assert all_solved(ik.load_robot(path), {"lwr_joint_1": 4.2, "lwr_joint_7": -5.1}, prefer)


@pytest.mark.parametrize("joints", [5, 3])
def test_short_arms_and_wrists_are_placed_immediately(tmp_path, joints):
    """Short arms rarely reach a palm pose exactly; a near configuration suffices."""
    robot = ik.load_robot(part_of_the_arm(tmp_path, slice(joints)))
    q = robot.random(np.random.default_rng(6), 25)
    for prefer in ("limits", "q0"):
        solver = ik.Solver(robot, compiled=False)
        batch = solver.solve_batch(*robot.contacts(q), q0=robot.home, prefer=prefer)
        assert batch.success.all()
        assert np.median(batch.phases["arm-placement"]) < 50
