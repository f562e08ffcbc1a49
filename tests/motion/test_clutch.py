"""A follower that is paused and resumed, and joints that are measured beyond their limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import casadi_ik as ik

PERIOD = 0.01


def moved_by(robot, q, follower, points, normals):
    """Return positions at rest at q and after each cycle of targets that turn and move by 5 cm."""
    path = [q, q]
    for share in np.concatenate([np.zeros(20), np.linspace(0, 1, 80), np.ones(120)]):
        turn = Rotation.from_rotvec([0.0, 0.0, 0.1 * share])
        centre = points.mean(axis=0)
        target = centre + turn.apply(points - centre) + [0.0, 0.0, -0.05 * share]
        path.append(follower(target, turn.apply(normals)))
    return np.array(path)


def assert_within_limits(follower, q):
    steps = np.diff(q, axis=0)
    assert (np.abs(steps) <= follower.velocity * PERIOD * (1 + 1e-9)).all()
    changes = np.abs(np.diff(steps, axis=0))
    assert (changes <= follower.acceleration * PERIOD**2 * (1 + 1e-9) + 1e-12).all()


@pytest.mark.parametrize("has_scene", [False, True])
def test_resumed_follower_moves_as_the_target_does(robot, has_scene):
    solver = ik.Solver(robot, scene=ik.Scene() if has_scene else None)
    follower = solver.follow(robot.home, PERIOD)
    q, (points, normals) = robot.home, robot.contacts(robot.home)
    for _ in range(20):
        points = points + np.array([0.004, 0.0, 0.0])
        q = follower(points, normals)
    follower.pause()
    path = [q]
    for i in range(60):
        path.append(follower(points + np.array([0.02 * i, 0.0, 0.0]), normals))
        assert follower.state.status is ik.motion.FollowStatus.HOLDING
    np.testing.assert_array_equal(path[-1], path[-20])
    assert_within_limits(follower, np.array(path))
    measured = path[-1] + 0.01
    follower.resume(measured)
    path = moved_by(robot, measured, follower, points + 0.5, normals)
    assert np.abs(path[:22] - measured).max() < 1e-6 or has_scene
    assert np.abs(path[:22] - measured).max() < 0.02
    assert_within_limits(follower, path)
    initial_points, final_points = robot.contacts(measured)[0], robot.contacts(path[-1])[0]
    np.testing.assert_allclose(
        (final_points - initial_points).mean(axis=0), [0, 0, -0.05], atol=1e-3
    )


def test_palm_is_anchored_too(robot):
    follower = ik.Solver(robot).follow(robot.home, PERIOD)
    free = np.full((len(robot.fingers), 3), np.nan)
    points = free.copy()
    points[0] = robot.contacts(robot.home)[0][0]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([1.0, 2.0, 0.5]).as_matrix()
    pose[:3, 3] = 0.3
    follower.resume()
    q = robot.home
    for _ in range(20):
        q = follower(points - 2.0, palm=pose)
    np.testing.assert_allclose(q, robot.home, atol=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_joints_beyond_limits_return(robot, side):
    """The motor returns, never faster than its limits, and never moves farther out."""
    start = robot.random(np.random.default_rng(2), 1)[0]
    start[1] = robot.upper[1] + 0.05 if side > 0 else robot.lower[1] - 0.05
    follower = ik.Solver(robot).follow(robot.home, PERIOD)
    follower.reset(start)
    target = robot.contacts(np.clip(start, robot.lower, robot.upper))
    q = np.array([start, start, *(follower(*target) for _ in range(200))])
    assert_within_limits(follower, q)
    assert ((q[-1] >= robot.lower) & (q[-1] <= robot.upper)).all()
    beyond_by = np.maximum(robot.lower - q, q - robot.upper).max(axis=1)
    assert (np.diff(beyond_by[beyond_by > 0]) <= 1e-12).all()
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING


def test_better_branch_is_reported_and_taken_by_call(robot):
    """Contacts that turn about the base by 300 degrees are beyond the limit of the first joint."""
    follower = ik.Solver(robot).follow(robot.home, PERIOD)
    q, (points, normals) = robot.home, robot.contacts(robot.home)
    target = points, normals
    assert follower.better_branch() is None
    for angle in np.radians([*np.linspace(0, 300, 600), *np.full(100, 300)]):
        turn = Rotation.from_rotvec([0.0, 0.0, angle])
        target = turn.apply(points), turn.apply(normals)
        q = follower(*target)
    assert follower.state.status is ik.motion.FollowStatus.MISSED
    better = follower.better_branch()
    assert better is not None
    assert better.gain > 1
    assert better.travel == pytest.approx(np.abs(better.q - q).max())
    path = [q, follower(*target)]
    assert np.abs(path[-1] - q).max() < 1e-2
    follower.pause()
    follower.branch(better.q)
    path += [follower(*target) for _ in range(800)]
    np.testing.assert_allclose(path[-1], better.q, atol=1e-9)
    follower.resume()
    path += [follower(*target) for _ in range(50)]
    assert_within_limits(follower, np.array(path))
    np.testing.assert_allclose(path[-1], better.q, atol=1e-2)
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
