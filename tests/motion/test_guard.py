"""Followers and paths in a scene never touch a resting obstacle."""

from __future__ import annotations

import numpy as np
import pytest
from collision_queries import query_at, query_of_contacts, query_of_grasps
from dense_ways import dense
from samplers import smooth_path
from toy_robots import grasp_of, grasps_of

import casadi_ik as ik
from casadi_ik.motion.free_path import PATH_RESOLUTION, check_path, motor_units

PERIOD = 0.004


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    return ik.Solver(robot, scene=ik.load_scene("table"))


def clearances(solver, q):
    return query_at(solver, q[:1]).check(q)


def test_targets_inside_a_table_are_not_followed(robot, solver):
    """The robot stops before the table, reports it, and continues when targets leave the table."""
    points, normals = robot.contacts(robot.home)
    follower = solver.follow(robot.home, PERIOD)
    deep = np.concatenate([np.linspace(0, 0.7, 500), np.linspace(0.7, 0, 500), np.zeros(300)])
    q, states = [robot.home], []
    for depth in deep:
        q.append(follower(points - np.array([0.0, 0.0, depth]), normals))
        states.append(follower.state)
    distances = clearances(solver, np.array(q))
    assert distances.free.all()
    assert distances.distance.min() < 0.03, "it never came near"
    np.testing.assert_allclose(states[-1].clearance, distances.distance[-1])
    for i in (300, 500, 700):
        shifted_points = points - np.array([0.0, 0.0, deep[i]])
        position, angle = robot.errors(q[i + 1], shifted_points, normals)
        np.testing.assert_allclose(states[i].position_error, position, atol=1e-9)
        np.testing.assert_allclose(states[i].angle_error, angle, atol=1e-6)
    statuses = [state.status for state in states]
    assert ik.motion.FollowStatus.BLOCKED in statuses
    assert not {ik.motion.FollowStatus.FOLLOWING} & set(statuses[480:520])
    assert statuses[-1] is ik.motion.FollowStatus.FOLLOWING
    steps = np.diff(np.array(q), axis=0)
    assert (np.abs(steps) <= follower.velocity * PERIOD * (1 + 1e-9)).all()
    changes = np.diff(steps, axis=0)
    assert (np.abs(changes) <= follower.acceleration * PERIOD**2 * (1 + 1e-9)).all()


def test_numpy_guard_stops_at_the_same_positions(robot, solver):
    points, normals = robot.contacts(robot.home)
    plain = ik.Solver(robot, scene=ik.load_scene("table"), compiled=False)
    paths, statuses = [], set()
    for checker in (solver, plain):
        follower, q = checker.follow(robot.home, 5 * PERIOD), []
        for depth in np.linspace(0, 0.6, 30):
            q.append(follower(points - np.array([0.0, 0.0, depth]), normals))
            statuses.add(follower.state.status)
        paths.append(q)
    np.testing.assert_allclose(*paths, atol=1e-6)
    assert ik.motion.FollowStatus.BLOCKED in statuses


@pytest.mark.parametrize("seed", range(3))
def test_jumping_targets_cause_no_contact(robot, solver, seed):
    rng = np.random.default_rng(seed)
    follower = solver.follow(robot.home, PERIOD)
    q = [robot.home]
    for _ in range(6):
        target = robot.contacts(robot.random(rng, 1)[0])
        q += [follower(*target) for _ in range(80)]
    assert clearances(solver, np.array(q)).free.all()


def led_through_each_other(body, shares):
    """Return contacts of both hands on the way to each other's place, at these fractions."""
    points, normals = body.contacts(body.home)
    rows = [
        [body.fingers.index(finger) for finger in side.fingers] for side in body.description.sides
    ]
    direction = points[rows[1]].mean(axis=0) - points[rows[0]].mean(axis=0)
    for share in shares:
        goal = points.copy()
        goal[rows[0]] += share * direction
        goal[rows[1]] -= share * direction
        yield goal, normals


@pytest.mark.slow
def test_hands_led_through_each_other_do_not_touch():
    """The hands stop in front of each other, and follow again on the way back."""
    body = ik.load_robot("g1+dex3")
    solver = ik.Solver(body, scene=ik.Scene())
    plain, careful = ik.Solver(body).follow(body.home, PERIOD), solver.follow(body.home, PERIOD)
    paths: dict[bool, list] = {True: [body.home], False: [body.home]}
    statuses = []
    shares = np.append(np.sin(np.linspace(0, np.pi, 500)) ** 2, np.zeros(100))
    for target in led_through_each_other(body, shares):
        paths[False].append(plain(*target))
        paths[True].append(careful(*target))
        statuses.append(careful.state.status)
    assert clearances(solver, np.array(paths[False])).distance.min() < -0.01
    assert clearances(solver, np.array(paths[True])).free.all()
    assert ik.motion.FollowStatus.BLOCKED in statuses
    assert statuses[-1] is ik.motion.FollowStatus.FOLLOWING


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.001, 0.01])
def test_motors_stop_where_clearance_is_missing(period):
    """Nearly all pairs of links within a hand are nearer than the kept clearance."""
    body = ik.load_robot("g1+dex3")
    solver = ik.Solver(body, scene=ik.Scene())
    rng, second = np.random.default_rng(11), round(1 / period)
    starts = body.home + 0.5 * (body.random(rng, 100) - body.home)
    for start in starts[clearances(solver, starts).free][:3]:
        follower, target = solver.follow(start, period), body.contacts(start)
        q = np.array([follower(*target) for _ in range(4 * second)])
        assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
        assert np.abs(q[-1] - start).max() > 1e-4
        np.testing.assert_array_equal(q[-second:], q[-1:].repeat(second, axis=0))


def test_blocked_arm_slows_its_own_side():
    """Hands jump to where a turned waist has them; the right shoulder would touch the torso."""
    body = ik.load_robot("g1+dex3")
    q = body.home.copy()
    q[body.actuators.index("waist_yaw_joint")] = 0.4
    q[body.actuators.index("left_elbow_joint")] = 0.3
    follower = ik.Solver(body, scene=ik.Scene()).follow(body.home, 0.01)
    for _ in range(600):
        follower(*body.contacts(q))
    assert follower.state.status is ik.motion.FollowStatus.FOLLOWING


@pytest.mark.slow
def test_passing_thumbs_keep_apart_in_every_cycle():
    """The thumbs come within 2 mm of each other and do not touch in any cycle."""
    body = ik.load_robot("g1+inspire")
    solver = ik.Solver(body, scene=ik.Scene())
    follower, shares = solver.follow(body.home), np.sin(np.linspace(0, np.pi, 2000))[:450] ** 2
    q = [follower(*target) for target in led_through_each_other(body, shares)]
    distances = clearances(solver, np.array(q))
    assert distances.free.all()
    assert distances.distance.min() < 2e-3, "they never came near"
    assert follower.state.status is ik.motion.FollowStatus.BLOCKED


def clearances_around(solver):
    grasp = ik.Grasp(dict.fromkeys(solver.robot.fingers[:1], ik.Contact([0, 0, 0], [0, 0, 1])))
    return query_of_grasps(solver, [grasp]).rows(np.zeros(1, dtype=np.intp))


def test_a_path_keeps_clear(robot, solver):
    """The target passes down through the table; the hand never comes nearer than the margin."""
    points, normals = robot.contacts(robot.home)
    low = points[:, 2].min()
    moving = [
        grasp_of(robot, points - np.array([0, 0, z]), normals)
        for z in np.linspace(0, low + 0.2, 40)
    ]
    track = solver.track(moving, q0=robot.home)
    assert track.success[0]
    assert not track.success[-1]
    assert track.clearance is not None
    assert clearances(solver, track.q).free.all()
    np.testing.assert_allclose(track.clearance, clearances(solver, track.q).distance)
    # The path is free between the postures, too, up to the checked resolution.
    assert track.free_between is not None
    assert track.free_between.all()
    assert clearances(solver, dense(track.q, motor_units(robot))).surplus.min() >= -PATH_RESOLUTION


def test_obstacle_between_free_postures_is_detected(robot):
    """A thin pole is in the sweep of the arm, and a ball moves through the robot."""
    q_path = np.tile(robot.home, (3, 1))
    q_path[:, 0] += [-0.7, 0.7, 0.72]
    x, y, z = robot.palm(robot.home)[:3, 3]
    pole = {"kind": "capsule", "radius": 0.002, "length": 0.1, "xyz": [x, y, z]}
    solver = ik.Solver(robot, scene=ik.Scene({"pole": pole}))
    around = clearances_around(solver)
    assert around.free(q_path).all()
    verdict = check_path(around, q_path)
    assert verdict.free.tolist() == [False, True]
    assert verdict.surplus[0] < 0
    assert not around.free(verdict.worst[:1])[0]
    scene_in_hand = ik.Scene(
        {"ball": {"kind": "sphere", "radius": 0.02, "xyz": [x, y, z]}}, grasped="ball"
    )
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[x, y - 0.5, z], [x, y + 0.5, z]]
    carrying = ik.Solver(robot, scene=scene_in_hand)
    moving = query_of_contacts(carrying, *robot.contacts(q_path[:2]), ("ball", poses))
    standing = np.tile(robot.home, (2, 1))
    assert moving.free(standing).all()
    assert not check_path(moving, standing).free[0]


def test_free_path_is_followed_as_without_a_scene(robot, solver):
    path = smooth_path(robot, 2, 60, 0.02, share=0.5)
    path = robot.home + 0.05 * (path - path[0])
    assert clearances(solver, path).free.all()
    moving = grasps_of(robot, *robot.contacts(path))
    track = solver.track(moving, q0=path[0])
    assert track.success.all()
    assert track.jumps == ()


def test_free_motions_avoid_collisions_of_followed_postures():
    """The contacts are from postures that mostly collide, but other postures can hold them."""
    robot = ik.load_robot("g1+dex3")
    solver = ik.Solver(robot, scene=ik.Scene())
    path = smooth_path(robot, 1, 1500, 1e-3, 0.3)
    path = robot.home + 0.4 * (path - path[0])
    follower = solver.follow(path[0], 1e-3)
    for points, normals in zip(*robot.contacts(path), strict=True):
        follower(points, normals)
        assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
