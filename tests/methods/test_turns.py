"""The nearest answer counts full turns, and joints without limits have no border."""

from __future__ import annotations

import numpy as np
import pytest
from moved_base import on_pedestal
from toy_robots import grasp_at, grasps_of

import casadi_ik as ik

TURN = 2 * np.pi
BASE, WRIST = 0, 5
"""Joints without limits: the first and the last one of the arm."""

SHOULDER = 1
"""A joint with limits of plus and minus two turns."""

Q = np.array([0.4, -1.2, 1.1, -0.6, -1.3, 0.5])


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> ik.ArmHand:
    """UR5e with a three-finger hand, two of its joints without limits."""
    names = "ur5e_joint_1", "ur5e_joint_6"
    folder = tmp_path_factory.mktemp("turns")
    return on_pedestal(ik.load_robot("ur5e+dclaw"), folder, continuous=names)


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    """Solver without a scene."""
    return ik.Solver(robot)


def target_after_step(robot: ik.ArmHand, joint: int, start: float, step: float) -> tuple:
    """Return q with a joint at an angle, and q with the joint turned on by a step."""
    q = robot.home.copy()
    q[:6] = Q
    q[joint] = start
    goal = q.copy()
    goal[joint] += step
    return q, goal


def answers(solver: ik.Solver, q0: np.ndarray, goal: np.ndarray) -> dict:
    """Return the answers of all calls that prefer what is near q0."""
    robot, grasp = solver.robot, grasp_at(solver.robot, goal)
    points, normals = robot.contacts(goal[None])
    fast = solver.fast()(points[0], normals[0], q0)
    ranked = solver.choose(grasps_of(robot, points, normals), q0=q0, prefer="q0")
    return {
        "solve": solver.solve(grasp, q0=q0, prefer="q0").q,
        "solve_batch": solver.solve_batch(points, normals, q0=q0).q[0],
        "solve_palms": solver.solve_palms(robot.palm(goal[None]), goal[None], q0=q0).q[0],
        "solve_all": solver.solve_all(grasp, q0=q0, prefer="q0", limit=1)[0].q,
        "fast": fast[0],
        "choose": ranked[0].q,
    }


@pytest.mark.parametrize("joint", [BASE, WRIST])
@pytest.mark.parametrize("start", [6.2, -6.2, 9.5, -31.0])
def test_joint_without_limits_ends_in_the_nearest_turn(solver, joint, start):
    q0, goal = target_after_step(solver.robot, joint, start, np.copysign(0.25, start))
    for call, q in answers(solver, q0, goal).items():
        assert q[joint] == pytest.approx(goal[joint], abs=0.05), call
        assert solver.robot.beyond_limits(q) <= 1e-9, call


@pytest.mark.parametrize(("start", "step", "end"), [(6.0, 0.2, 6.2), (6.1, 0.4, 6.5 - TURN)])
def test_joint_with_limits_ends_in_the_nearest_allowed_turn(solver, start, step, end):
    q0, goal = target_after_step(solver.robot, SHOULDER, start, step)
    for call, q in answers(solver, q0, goal).items():
        assert q[SHOULDER] == pytest.approx(end, abs=0.05), call
        assert solver.robot.beyond_limits(q) <= 1e-9, call


def test_fixed_joint_stays_in_its_turn(solver):
    q0, goal = target_after_step(solver.robot, BASE, 6.2, 0.25)
    name = solver.robot.actuators[BASE]
    q0[BASE] -= 20.0
    solution = solver.solve(grasp_at(solver.robot, goal), q0=q0, fixed={name: goal[BASE]})
    assert solution.success
    assert solution.q[BASE] == pytest.approx(goal[BASE], abs=1e-12)


def test_path_of_two_turns_is_continuous(solver):
    robot = solver.robot
    start, _ = target_after_step(robot, BASE, 5.0, 0.0)
    path = np.tile(start, (60, 1))
    path[:, BASE] += np.linspace(0, 2 * TURN, 60)
    track = solver.track(grasps_of(robot, *robot.contacts(path)), q0=start)
    assert track.success.all()
    assert not track.jumps
    np.testing.assert_allclose(track.q[:, BASE], path[:, BASE], atol=0.05)


def test_follower_turns_endlessly(solver):
    robot = solver.robot
    start, _ = target_after_step(robot, BASE, 5.0, 0.0)
    path = np.tile(start, (2000, 1))
    path[:, BASE] += TURN * (1 - np.cos(np.linspace(0, np.pi, 2000)))
    q, follower = start, solver.follow(q0=start, period=0.01)
    for points, normals in zip(*robot.contacts(path), strict=True):
        q = follower(points, normals)
        assert follower.state.status.name == "FOLLOWING"
    assert q[BASE] == pytest.approx(5.0 + 2 * TURN, abs=0.05)


def test_motion_leads_to_the_nearest_turn(solver):
    pytest.importorskip("toppra")
    q0, goal = target_after_step(solver.robot, BASE, 6.2, 0.25)
    motion = solver.reach(grasp_at(solver.robot, goal), q0=q0, distance=0.02).motion
    assert np.ptp(motion.q[:, BASE]) < 0.6
    assert motion.q[-1, BASE] == pytest.approx(goal[BASE], abs=0.05)


def test_joint_without_limits_is_written_as_continuous(robot):
    assert robot.description.continuous.sum() == robot.urdf().count('type="continuous"') == 2
