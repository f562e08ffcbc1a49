"""A moving grasp is followed without jumps where possible, within the motors' velocities."""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import grasp_at, grasp_of, grasps_of

import casadi_ik as ik

LEAP = 0.05
"""A motor that moves by more of its range from one grasp to the next jumps."""


def largest_step(robot, track) -> float:
    """Return the largest step of a motor as a fraction of its range."""
    return float((np.abs(np.diff(track.q, axis=0)) / (robot.upper - robot.lower)).max())


def smooth_path(robot, seed, count=60):
    """Return a path between two random configurations that are not too far apart, within limits."""
    rng = np.random.default_rng(seed)
    start = robot.random(rng, 1)[0]
    middle = (robot.lower + robot.upper) / 2
    end = start + 0.25 * (robot.random(rng, 1)[0] - start) + 0.1 * (middle - start)
    return start + np.linspace(0, 1, count)[:, None] * (end - start)


@pytest.mark.parametrize("seed", range(8))
def test_a_grasp_that_moves_smoothly_is_followed_smoothly(robot, solver, seed):
    track = solver.track(grasps_of(robot, *robot.contacts(smooth_path(robot, seed))))
    assert track.success.all()
    assert track.jumps == ()
    assert largest_step(robot, track) <= LEAP
    assert len(track) == 60
    assert np.nanmax(track.position_error) <= 5e-3


def test_it_begins_where_the_robot_is(robot, solver):
    path = smooth_path(robot, 3)
    track = solver.track(grasps_of(robot, *robot.contacts(path)), q0=path[0])
    assert track.success.all()
    np.testing.assert_allclose(track.q[0], path[0], atol=0.05)


def test_unavoidable_jump_is_reported(robot, solver):
    """Joint 7 turns twice, which no arm can follow, but every grasp on the way can be reached."""
    turns = np.linspace(-2 * np.pi, 2 * np.pi, 160)
    path = np.tile(robot.home, (len(turns), 1))
    path[:, 6] = turns
    track = solver.track(grasps_of(robot, *robot.contacts(path)))
    assert track.success.all()
    assert track.jumps
    for jump in track.jumps:
        i = robot.actuators.index(jump.actuator)
        step = track.q[jump.index] - track.q[jump.index - 1]
        assert step[i] == pytest.approx(jump.size)
        assert abs(jump.size) > LEAP * (robot.upper - robot.lower)[i]
        assert set(jump.at_limit) <= set(robot.actuators)
    assert any(jump.at_limit for jump in track.jumps)
    # Elsewhere it moves less.
    steps = (np.abs(np.diff(track.q, axis=0)) / (robot.upper - robot.lower)).max(axis=1)
    jumped = [jump.index - 1 for jump in track.jumps]
    assert np.delete(steps, jumped).max() < steps[jumped].min()


def test_motors_keep_velocities_and_catch_up(robot, solver):
    """A grasp that is too fast for the motors is met late, and again once it stands still."""
    path = smooth_path(robot, 1, count=10)
    path = np.concatenate([path, np.tile(path[-1], (200, 1))])
    velocity, period = 0.2, 0.05
    track = solver.track(
        grasps_of(robot, *robot.contacts(path)), q0=path[0], period=period, velocity=velocity
    )
    assert np.abs(np.diff(track.q, axis=0)).max() <= velocity * period * (1 + 1e-9)
    assert track.success[0]
    assert not track.success[5]
    assert track.success[-1]
    assert track.jumps == ()


def test_the_robots_own_velocities(robot, solver):
    period = 1e-3
    velocities = np.array([actuator.velocity for actuator in robot.description.actuators])
    path = smooth_path(robot, 2, count=20)
    track = solver.track(grasps_of(robot, *robot.contacts(path)), q0=path[0], period=period)
    assert (np.abs(np.diff(track.q, axis=0)) <= velocities * period * (1 + 1e-9)).all()


def test_unreachable_grasp_is_approached(robot, solver):
    """The contacts leave the workspace, are missed there, and are met again."""
    points, normals = robot.contacts(robot.home)
    excursion = 0.8 * np.sin(np.linspace(0, np.pi, 40))
    moving = [grasp_of(robot, points - [s, 0, 0], normals) for s in excursion]
    reachable = [solver.solve(target, diagnose=False).success for target in moving]
    assert not all(reachable)
    track = solver.track(moving)
    assert track.success[0]
    assert track.success[-1]
    np.testing.assert_array_equal(track.success, reachable)


def test_bad_tracking_input_is_refused(robot, solver):
    moving = [grasp_at(robot, robot.home)] * 2
    with pytest.raises(ik.errors.InputError, match=r"grasps: .*0"):
        solver.track([])
    with pytest.raises(ik.errors.InputError, match=r"velocity: .*period"):
        solver.track(moving, velocity=1.0)
    with pytest.raises(ik.errors.InputError, match=r"period:.*-1.*> 0"):
        solver.track(moving, period=-1)
    with pytest.raises(ik.errors.InputError, match=r"velocity:.*> 0.*14"):
        solver.track(moving, period=1.0, velocity=[1.0, 2.0])
    with pytest.raises(ik.errors.UnsupportedError, match="method: 'ipopt'"):
        ik.Solver(robot, "ipopt").track(moving)
