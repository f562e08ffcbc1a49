"""A follower keeps limits for any targets, and follows smooth targets exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from samplers import smooth_path
from toy_robots import grasp_at

import casadi_ik as ik

PERIOD = 0.004
ROUNDING = 1e-9


def check_limits(robot, follower, q):
    """Assert limits of positions, velocities and accelerations of (k, n), from rest."""
    assert (q >= robot.lower).all()
    assert (q <= robot.upper).all()
    steps = np.diff(q, axis=0)
    assert (np.abs(steps) <= follower.velocity * follower.period + ROUNDING).all()
    changes = np.diff(np.concatenate([np.zeros((1, q.shape[1])), steps]), axis=0)
    assert (np.abs(changes) <= follower.acceleration * follower.period**2 + ROUNDING).all()


@pytest.mark.parametrize("seed", range(4))
def test_smooth_motion_is_followed_within_tolerance(robot, solver, seed):
    path = smooth_path(robot, seed, 600, PERIOD, share=0.5)
    points, normals = robot.contacts(path)
    follower = solver.follow(path[0], PERIOD)
    q, states = [path[0]], []
    for target in zip(points, normals, strict=True):
        q.append(follower(*target))
        states.append(follower.state)
    check_limits(robot, follower, np.array(q))
    statuses = [state.status for state in states]
    assert set(statuses) == {ik.motion.FollowStatus.FOLLOWING}
    position, angle = robot.errors(np.array(q[1:]), points, normals)
    assert position.max() <= 2e-3
    errors = np.array([state.position_error for state in states])
    np.testing.assert_allclose(errors, position, atol=1e-12)
    np.testing.assert_allclose([state.angle_error for state in states], angle, atol=1e-7)


kinds = st.sampled_from(
    ["random", "near", "far", "NaN", "partly", "infinite", "endless", "zero", "free"]
)


@settings(max_examples=40)
@example(seed=1, events=["near", "endless", "near"])
@example(seed=182075427, events=["near", "near", "random", "random", "random", "NaN", "near"])
@given(seed=st.integers(0, 2**32), events=st.lists(kinds, min_size=1, max_size=12))
def test_limits_are_kept_for_any_targets(robot, solver, seed, events):
    rng = np.random.default_rng(seed)
    start = robot.random(rng, 1)[0]
    follower = solver.follow(start, PERIOD)
    q = [start]
    for event in events:
        points, normals = robot.contacts(robot.random(rng, 1)[0])
        if event == "near":
            points, normals = robot.contacts(q[-1])
        elif event == "far":
            points = points + rng.normal(0, 5, 3)
        elif event == "NaN":
            points, normals = points * np.nan, normals * np.nan
        elif event == "partly":
            points[1, 2] = np.nan
        elif event == "infinite":
            normals[0, 0] = np.inf
        elif event == "endless":
            points[0, 1] = np.inf
        elif event == "zero":
            normals[2] = 0
        elif event == "free":
            points[1], normals[1], normals[0] = np.nan, np.nan, np.nan
        for _ in range(rng.integers(1, 60)):
            q.append(follower(points, normals))
            state = follower.state
            bad = event in ("NaN", "partly", "infinite", "endless", "zero")
            assert (state.status is ik.motion.FollowStatus.HOLDING) == bad
            assert bool(state.reason) == bad
    check_limits(robot, follower, np.array(q))


@pytest.mark.parametrize("seed", range(3))
def test_jumping_target_is_reached_at_rest(robot, solver, seed):
    """The target is reached without overshoot: no motor reverses."""
    rng = np.random.default_rng(seed)
    start = 0.7 * robot.home + 0.3 * robot.random(rng, 1)[0]
    end = start + 0.15 * (robot.random(rng, 1)[0] - start)
    grasp = grasp_at(robot, end)
    follower = solver.follow(start, PERIOD)
    q = np.array([start] + [follower(grasp) for _ in range(1500)])
    check_limits(robot, follower, q)
    state = follower.state
    assert state.status is ik.motion.FollowStatus.FOLLOWING
    position, angle = robot.errors(q[-1], *grasp.arrays(robot.fingers))
    assert position.max() <= 5e-3
    assert angle.max() <= np.radians(3)
    assert np.abs(state.velocity).max() < 1e-3
    np.testing.assert_allclose(state.q, state.goal, atol=1e-4)


def test_stream_continues_after_bad_frames(robot, solver):
    path = smooth_path(robot, 9, 700, PERIOD, share=0.4)
    points, normals = robot.contacts(path)
    points[300:330] = np.nan
    normals[300:330] = np.nan
    points[400, 0, 1] = np.nan
    follower = solver.follow(path[0], PERIOD)
    q, statuses = [path[0]], []
    for target in zip(points, normals, strict=True):
        q.append(follower(*target))
        statuses.append(follower.state.status)
    check_limits(robot, follower, np.array(q))
    bad = [i for i, status in enumerate(statuses) if status is ik.motion.FollowStatus.HOLDING]
    assert bad == [*range(300, 330), 400]
    assert statuses[299] is ik.motion.FollowStatus.FOLLOWING
    assert set(statuses[500:]) == {ik.motion.FollowStatus.FOLLOWING}


def test_a_long_pause_brings_the_motors_to_rest(robot, solver):
    path = smooth_path(robot, 5, 300, PERIOD, share=0.5)
    follower = solver.follow(path[0], PERIOD)
    for target in zip(*robot.contacts(path), strict=True):
        follower(*target)
    assert np.abs(follower.state.velocity).max() > 0.05
    lost_points = np.full((3, 3), np.nan)
    speeds = []
    for _ in range(120):
        follower(lost_points, lost_points)
        speeds.append(np.abs(follower.state.velocity))
    assert (np.diff(speeds, axis=0) <= 1e-9).all()
    assert speeds[-1].max() == 0
    assert follower.state.reason == "there is no contact"


def test_out_of_reach_and_back(robot, solver):
    points, normals = robot.contacts(robot.home)
    follower = solver.follow(robot.home, PERIOD)
    excursion = np.concatenate([np.linspace(0, 0.9, 400), np.linspace(0.9, 0, 400), np.zeros(600)])
    q, states = [robot.home], []
    for off in excursion:
        q.append(follower(points + np.array([off, 0.0, 0.0]), normals))
        states.append(follower.state)
    check_limits(robot, follower, np.array(q))
    statuses = [state.status for state in states]
    assert ik.motion.FollowStatus.MISSED in statuses[300:500]
    assert states[400].goal_position_error.max() > 5e-3
    assert set(statuses[-100:]) == {ik.motion.FollowStatus.FOLLOWING}


def test_fingertips_alone_and_a_wrist(robot, solver):
    """Positions are met exactly; the wrist comes as near as they permit."""
    end = robot.home + 0.1
    points, _ = robot.contacts(end)
    palm = robot.palm(end)
    offsets = {}
    for weight in (0.0, 0.1):
        follower = solver.follow(robot.home, PERIOD)
        for _ in range(800):
            follower(points, palm=palm, palm_weight=(weight, weight))
        assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
        assert np.isnan(follower.state.angle_error).all()
        offsets[weight] = np.linalg.norm(robot.palm(follower.state.q)[:3, 3] - palm[:3, 3])
    assert offsets[0.1] < 0.5 * offsets[0.0]


def test_another_branch_on_request(robot, solver):
    grasp = ik.load_grasp("cup")
    first, *later_answers = (solution.q for solution in solver.solve_all(grasp, limit=4))
    follower = solver.follow(first, PERIOD)
    for _ in range(50):
        follower(grasp)
    np.testing.assert_allclose(follower.state.q, first, atol=0.1)
    farthest = max(later_answers, key=lambda q: np.abs(q - first).max())
    follower.branch(farthest)
    q = np.array([follower.state.q] + [follower(grasp) for _ in range(2500)])
    check_limits(robot, follower, q)
    np.testing.assert_allclose(q[-1], farthest, atol=0.1)
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING


def test_contacts_of_other_kinds(robot, solver):
    """Contacts may be a whole pose, and a point on a line."""
    end = robot.home + 0.05
    frames = robot.contact_frames(end)
    contacts = {
        name: ik.Contact(frame[:3, 3], frame[:3, 0])
        for name, frame in zip(robot.fingers, frames, strict=True)
    }
    contacts["thumb"] = ik.Contact(frames[0, :3, 3] + frames[0, :3, 1], line=frames[0, :3, 1])
    follower = solver.follow(robot.home, PERIOD)
    for _ in range(800):
        follower(ik.Grasp(contacts))
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
    points, normals = robot.contacts(end)
    follower(points, normals)
    assert not np.isnan(follower.state.angle_error).any()


def test_bad_follower_input_is_refused(robot, solver):
    follower = solver.follow(robot.home, PERIOD)
    points, normals = robot.contacts(robot.home)
    with pytest.raises(ik.errors.InputError, match=r"points:.*\(2, 3\).*\(3, 3\)"):
        follower(points[:2], normals)
    with pytest.raises(ik.errors.InputError, match=r"normals: .*'a'"):
        follower(points, [["a"]])
    with pytest.raises(ik.errors.InputError, match="normals: "):
        follower(ik.load_grasp("cup"), normals)
    with pytest.raises(ik.errors.InputError, match=r"period:.*0.*> 0"):
        solver.follow(period=0)
    with pytest.raises(ik.errors.InputError, match=r"acceleration:.*-1.*> 0"):
        solver.follow(acceleration=-1)
    with pytest.raises(ik.errors.InputError, match="velocity: found"):
        solver.follow(velocity=[1.0, 2.0])
    with pytest.raises(ik.errors.InputError, match="q0: found shape"):
        solver.follow(np.zeros(3))
    with pytest.raises(ik.errors.InputError, match="posture: found"):
        solver.follow(posture={"lwr_joint_1": 0.2})
