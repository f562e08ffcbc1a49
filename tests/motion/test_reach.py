"""The approach to a grasp: from rest to rest, within limits, free between samples, ending in it."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from collision_queries import query_at, query_of_grasps
from dense_ways import dense

import casadi_ik as ik
from casadi_ik.motion.free_path import motor_units, plan_path
from casadi_ik.motion.motion import limit_fraction, rates_of, timed


@pytest.fixture(scope="module")
def grasp() -> ik.Grasp:
    return ik.load_grasp("cup")


def sent(motion):
    """Return the largest first and second differences (n,) of commands from rest to rest."""
    (period,) = set(np.diff(motion.times).round(12))
    q = np.concatenate([motion.q[:1], motion.q, motion.q[-1:]])
    return (
        np.abs(np.diff(q, axis=0)).max(axis=0) / period,
        np.abs(np.diff(q, n=2, axis=0)).max(axis=0) / period**2,
    )


def check_motion(robot, grasp, reach_motion, q0):
    motion, rates = reach_motion.motion, rates_of(robot, None, None)
    assert reach_motion.status is ik.motion.ReachStatus.REACHED
    np.testing.assert_array_equal(motion.q[0], q0)
    np.testing.assert_allclose(motion.q[-1], reach_motion.q, atol=1e-9)
    position, angle = robot.errors(motion.q[-1], *grasp.arrays(robot.fingers))
    assert position.max() <= 5e-3
    assert angle.max() <= np.radians(3)
    assert (motion.q >= robot.lower).all()
    assert (motion.q <= robot.upper).all()
    assert (np.abs(motion.velocity) <= rates.velocity * (1 + 1e-9)).all()
    assert (np.abs(motion.acceleration) <= rates.acceleration * (1 + 1e-9)).all()
    assert not motion.velocity[[0, -1]].round(6).any()
    steps = np.diff(motion.times)[:, None]
    assert (steps > 0).all()
    # The stated rates are those of the motion.
    between = np.diff(motion.q, axis=0) / steps
    off = np.abs(between - (motion.velocity[1:] + motion.velocity[:-1]) / 2)
    assert (off <= 0.6 * rates.acceleration * steps).all()
    part = motion.notes["part"]
    assert list(dict.fromkeys(part.tolist())) == ["going", "coming", "closing"]
    return part


@pytest.mark.parametrize("scene", [None, ik.Scene()], ids=["no scene", "nothing in it"])
def test_approach_is_straight_and_then_closes(robot, grasp, scene):
    grasp, solver = ik.Grasp(grasp.contacts), ik.Solver(robot, scene=scene)
    reach_motion = solver.reach(grasp, distance=0.1, opening=0.025)
    part = check_motion(robot, grasp, reach_motion, robot.home)
    assert (reach_motion.clearance is None) == (scene is None)
    assert solver.approach(grasp).success
    motion = reach_motion.motion
    coming = robot.palm(motion.q[part == "coming"])
    steps = coming[:, :3, 3] - coming[-1, :3, 3]
    direction = steps[0] / np.linalg.norm(steps[0])
    assert np.linalg.norm(steps[0]) == pytest.approx(0.1, abs=0.01)
    assert np.linalg.norm(steps - np.outer(steps @ direction, direction), axis=1).max() < 2e-3
    assert np.abs(coming[:, :3, :3] - coming[-1, :3, :3]).max() < 0.01
    tips, _ = robot.contacts(motion.q[part == "coming"][-1])
    points, _ = grasp.arrays(robot.fingers)
    assert np.linalg.norm(tips - points, axis=1).max() == pytest.approx(0.025, abs=0.003)


@pytest.mark.parametrize(
    ("name", "period"),
    [("tennis_ball", 0.01), ("apple", 0.004), ("tomato_soup_can", 0.02), ("cup", 0.05)],
)
def test_motion_keeps_velocity_and_acceleration_limits(robot, name, period):
    """Joints reach limits at corners; the figures are measured."""
    motion = ik.Solver(robot).reach(ik.load_grasp(name), period=period)
    velocity, acceleration = sent(motion.motion)
    rates = rates_of(robot, None, None)
    assert (velocity <= rates.velocity * (1 + 1e-9)).all()
    assert (acceleration <= rates.acceleration * (1 + 1e-9)).all()
    assert motion.velocity_share == pytest.approx((velocity / rates.velocity).max())
    assert (acceleration / rates.acceleration).max() <= motion.acceleration_share <= 1


def test_short_and_kinked_paths_are_timed(robot):
    """Steps range from a ten-millionth to a third, of all motors or one, also back and forth."""
    rng, rates = np.random.default_rng(0), rates_of(robot, None, None)
    for size in (1e-7, 1e-4, 1e-2, 0.3):
        for moving in (1, 14):
            steps = size * rng.standard_normal((int(rng.integers(1, 12)), 14))
            steps[:, moving:] = 0.0
            path = robot.home + np.cumsum(np.concatenate([np.zeros((1, 14)), steps]), axis=0)
            q = timed(path, rates, 0.01)
            np.testing.assert_array_equal(q[[0, -1]], path[[0, -1]])
            assert max(limit_fraction(q, 0.01, rates)) <= 1
            assert ((q >= path.min(axis=0)) & (q <= path.max(axis=0))).all()


def test_clearance_holds_between_samples(robot):
    """A ball beside the path is detected between two distant samples."""
    grasp = ik.Grasp(ik.load_grasp("cup").contacts)
    path = ik.Solver(robot).reach(grasp).motion
    going = path.q[path.notes["part"] == "going"]
    place = robot.palm(going[len(going) // 2])[:3, 3] - np.array([0.0, 0.0, 0.3])
    itself = [
        {"links": pair, "reason": "not of interest"}
        for pair in combinations(robot.links(path.q[0]), 2)
    ]
    ball = {"ball": {"kind": "sphere", "radius": 0.08, "xyz": place.tolist()}}
    solver = ik.Solver(robot, scene=ik.Scene(ball, touching=itself))
    motion = solver.reach(grasp, period=0.08)
    q_before_closing = motion.motion.q[motion.motion.notes["part"] != "closing"]
    fine = dense(q_before_closing, 0.1 * motor_units(robot))
    min_distance = solver.check(fine, grasp).distance.min()
    assert solver.check(q_before_closing, grasp).distance.min() > min_distance + 1e-3
    assert motion.clearance == pytest.approx(min_distance, abs=1e-4)
    last = solver.approach(grasp)
    min_distance = solver.check(dense(last.coming, 0.1 * motor_units(robot)), grasp).distance.min()
    assert last.clearance == pytest.approx(min_distance, abs=1e-4)


def test_path_leads_around_an_obstacle(robot):
    """OMPL avoids a ball on the straight path."""
    start = robot.home + 1.6 * (np.arange(14) == 0)
    ends = np.stack([start, robot.home])
    place = robot.palm(ends.mean(axis=0))[:3, 3]
    solids = {"ball": {"kind": "sphere", "radius": 0.05, "xyz": place.tolist()}}
    solver = ik.Solver(robot, scene=ik.Scene(solids))
    around = query_at(solver, ends[1:]).rows(np.zeros(1, dtype=int))
    assert not around.free(dense(ends, motor_units(robot))).all()
    corners, reason = plan_path(robot, *ends, around, seed=0)
    assert "OMPL" in reason
    np.testing.assert_array_equal(corners[[0, -1]], ends)
    assert around.free(dense(corners, motor_units(robot))).all()
    no_corners, reason_inside = plan_path(robot, ends.mean(axis=0), ends[1], around, seed=0)
    assert (no_corners, reason_inside) == (None, "the start is not free: bh_base and ball touch")


def test_whole_motion_is_collision_free(robot, grasp):
    solver = ik.Solver(robot, scene=ik.load_scene("table"))
    motion = solver.reach(grasp)
    part = check_motion(robot, grasp, motion, robot.home)
    around = query_of_grasps(solver, [grasp]).rows(np.zeros(1, dtype=int))
    looked_at = dense(motion.motion.q[part != "closing"], motor_units(robot))
    assert around.free(looked_at).all()
    assert motion.clearance >= 0


def test_unreachable_grasp_is_explained(robot, grasp):
    far_pose = np.eye(4)
    far_pose[0, 3] = 5.0
    motion = ik.Solver(robot).reach(grasp.at(far_pose))
    assert (motion.status, motion.motion) == (ik.motion.ReachStatus.NOT_SOLVED, None)
    assert not motion.success
    points, _ = grasp.arrays(robot.fingers)
    place = (points.mean(axis=0) + np.array([0.0, 0.0, 0.25])).tolist()
    lid = {"lid": {"kind": "box", "size": [0.6, 0.6, 0.02], "xyz": place}}
    motion = ik.Solver(robot, scene=ik.Scene(lid)).reach(grasp, distance=0.3, direction=[0, 0, -1])
    assert motion.status in (ik.motion.ReachStatus.NO_APPROACH, ik.motion.ReachStatus.NOT_SOLVED)
    assert motion.reason
    with pytest.raises(ik.errors.InputError, match=r"distance:.*-1.*>= 0"):
        ik.Solver(robot).reach(grasp, distance=-1)


def test_blocked_approach_uses_another_direction(robot, grasp):
    """With a lid over the object, the hand approaches from the side."""
    points, _ = grasp.arrays(robot.fingers)
    place = (points.mean(axis=0) + np.array([0.0, 0.0, 0.25])).tolist()
    lid = {"lid": {"kind": "box", "size": [0.6, 0.6, 0.02], "xyz": place}}
    solver = ik.Solver(robot, scene=ik.Scene(lid))
    assert not solver.approach(grasp, distance=0.3, direction=[0, 0, -1]).success
    motion = solver.reach(grasp, distance=0.3)
    assert motion.success
    assert motion.clearance >= 0
    coming = robot.palm(motion.motion.q[motion.motion.notes["part"] == "coming"])[:, :3, 3]
    assert np.linalg.norm(coming[-1] - coming[0]) == pytest.approx(0.3, abs=5e-3)


def test_motion_is_written_like_a_followed_one(robot, grasp, tmp_path):
    motion = ik.Solver(robot).reach(grasp).motion
    for suffix in ("npz", "csv", "mcap"):
        motion.write(tmp_path / f"way.{suffix}")
    stored = np.load(tmp_path / "way.npz")
    np.testing.assert_array_equal(stored["q"], motion.q)
    assert stored["part"].tolist() == motion.notes["part"].tolist()
    expected_message = (
        f"^{re.escape(str(tmp_path / 'way.txt'))}: found suffix '.txt', expected one of .npz, "
    )
    with pytest.raises(ik.errors.InputError, match=expected_message):
        motion.write(tmp_path / "way.txt")
    assert len(list(tmp_path.iterdir())) == 3


def test_approach_alone(robot, grasp):
    """The hand approaches straight with open fingers; in a scene the path is free or refused."""
    motion = ik.Solver(robot).approach(grasp, distance=0.06, opening=0.015)
    assert (motion.success, motion.reason, motion.clearance) == (True, "", None)
    np.testing.assert_array_equal(motion.pregrasp, motion.coming[0])
    np.testing.assert_array_equal(motion.coming[-1], motion.closing[0])
    np.testing.assert_allclose(motion.closing[-1], motion.q, atol=1e-9)
    palms = robot.palm(motion.coming)[:, :3, 3]
    assert np.linalg.norm(palms[-1] - palms[0]) == pytest.approx(0.06, abs=2e-3)
    assert not robot.errors(motion.pregrasp, *grasp.arrays(robot.fingers))[0].min() < 0.03
    middle = robot.palm(motion.coming[len(motion.coming) // 2])[:3, 3] - 0.1 * np.array([0, 0, 1])
    wall = {"wall": {"kind": "sphere", "radius": 0.09, "xyz": middle.tolist()}}
    blocked = ik.Solver(robot, scene=ik.Scene(wall)).approach(grasp, distance=0.3, limit=1)
    assert blocked.status in (ik.motion.ReachStatus.NO_APPROACH, ik.motion.ReachStatus.NOT_SOLVED)
    assert blocked.pregrasp is None
    assert blocked.reason


def test_given_palm_is_reached(robot, grasp):
    """Fingers open and close around the posture of the grasp."""
    solution = ik.Solver(robot).solve(grasp)
    motors = robot.actuators[7:]
    posture = dict(zip(motors, solution.q[7:].tolist(), strict=True))
    motion = ik.Solver(robot).reach(ik.Grasp(palm=robot.palm(solution.q), posture=posture))
    assert motion.success
    np.testing.assert_allclose(robot.palm(motion.motion.q[-1]), robot.palm(solution.q), atol=1e-3)
    assert (
        np.abs(motion.motion.q[motion.motion.notes["part"] == "coming"] - solution.q)[:, 7:].max()
        > 0.02
    )


@pytest.fixture(scope="module")
def on_table(robot, grasp):
    solver = ik.Solver(robot, scene=ik.load_scene("table"))
    return solver, solver.choose([grasp], limit=3, prefer="limits", per_candidate=None)


def test_chosen_posture_is_reached(robot, grasp, on_table):
    solver, ranked = on_table
    for choice in ranked:
        motion = solver.reach(choice)
        assert motion.success, motion.reason
        np.testing.assert_array_equal(motion.motion.q[-1], choice.solution.q)
        np.testing.assert_array_equal(motion.q, choice.q)
        np.testing.assert_array_equal(solver.approach(choice).closing[-1], choice.q)
    far_pose = np.eye(4)
    far_pose[0, 3] = 0.1
    far_choice = replace(ranked[0], grasp=grasp.at(far_pose))
    missed = solver.reach(far_choice)
    assert missed.status is ik.motion.ReachStatus.NOT_SOLVED
    assert "100 mm" in missed.reason
    assert solver.approach(far_choice).reason == missed.reason
    with pytest.raises(ik.errors.InputError, match=r"grasp:.*Grasp"):
        solver.reach(3)


def test_candidates_follow_the_object(robot, grasp):
    """The grasps are in the object frame, the answers in the base frame."""
    pose = grasp.object_pose
    (choice,) = ik.Solver(robot).choose([grasp.in_object_frame()], object_pose=pose, limit=1)
    for finger, contact in grasp.contacts.items():
        np.testing.assert_allclose(choice.grasp.contacts[finger].point, contact.point, atol=1e-12)
    np.testing.assert_allclose(choice.grasp.object_pose, pose, atol=1e-12)


def test_given_or_known_approach_direction(robot, grasp):
    solver, down = ik.Solver(robot), np.array([0.0, 0.0, -1.0])
    (choice,) = solver.choose([grasp], limit=1)

    def comes(requested, **options):
        motion = solver.reach(requested, distance=0.1, **options)
        coming = robot.palm(motion.motion.q[motion.motion.notes["part"] == "coming"])[:, :3, 3]
        approach = coming[-1] - coming[0]
        return approach / np.linalg.norm(approach)

    assert comes(choice, direction=3 * down) @ down > 0.999
    assert comes(grasp, direction=down) @ down > 0.999
    assert comes(choice) @ down < 0.9
    motors = dict(zip(robot.actuators[7:], choice.q[7:].tolist(), strict=True))
    above = robot.palm(choice.q) - np.array(
        [[0, 0, 0, 0]] * 2 + [[0, 0, 0, -0.05]] + [[0, 0, 0, 0]]
    )
    pregrasp_palm = ik.Grasp(palm=above, posture=motors)
    assert comes(replace(choice, grasp=replace(grasp, pregrasp=pregrasp_palm))) @ down > 0.999
    with pytest.raises(ik.errors.InputError, match=r"direction: .*\[0, 0, 0\]"):
        solver.reach(grasp, direction=[0, 0, 0])


def test_object_moves_with_the_hand(robot, grasp, on_table):
    solver, ranked = on_table
    reach_motion = solver.reach(ranked[0], lift=0.1, retreat=0.08)
    motion, part = reach_motion.motion, reach_motion.motion.notes["part"]
    assert list(dict.fromkeys(part)) == ["going", "coming", "closing", "lifting", "retreating"]
    ends = [motion.q[np.flatnonzero(part == name)[-1]] for name in dict.fromkeys(part)]
    np.testing.assert_array_equal(ends[2], ranked[0].q)
    palms = robot.palm(np.array(ends))[:, :3, 3]
    np.testing.assert_allclose(palms[3] - palms[2], [0, 0, 0.1], atol=1e-3)
    came = palms[1] - palms[0]
    back = palms[4] - palms[3]
    np.testing.assert_allclose(back, -0.08 * came / np.linalg.norm(came), atol=2e-3)
    assert max(reach_motion.velocity_share, reach_motion.acceleration_share) <= 1
    # The brim of the cup is 30 mm above its middle: no finger comes near a ball there.
    for height, lift, free in ((0.09, 0.1, False), (0.09, 0.04, True), (0.09, 0.0, True)):
        place = (grasp.object_pose[:3, 3] + np.array([0.0, 0.0, height])).tolist()
        ball = {"ball": {"kind": "sphere", "radius": 0.01, "xyz": place}}
        other_motion = ik.Solver(robot, scene=ik.Scene(ball)).reach(ranked[0], lift=lift)
        assert other_motion.success is free
        assert free or other_motion.status is ik.motion.ReachStatus.NO_RETREAT
        assert free or other_motion.reason == "lifting is not free: cup and ball touch"
    hand = ik.Solver(ik.load_robot("ar10"))
    with pytest.raises(ik.errors.UnsupportedError, match="no arm that moves its palm"):
        hand.reach(ik.load_grasp("ar10_cup"), lift=0.1)


def test_supported_object_can_be_lifted(robot, grasp, on_table):
    """The object touches what it stands on."""
    _, ranked = on_table
    below = (grasp.object_pose[:3, 3] - np.array([0.0, 0.0, 0.03 + 0.005])).tolist()
    post = {"kind": "cylinder", "radius": 0.01, "length": 0.01, "xyz": below}
    solver = ik.Solver(robot, scene=ik.Scene({"post": post}))
    assert solver.reach(ranked[0], lift=0.05).success


def test_move_between_postures(robot, grasp, on_table):
    solver, ranked = on_table
    motion = solver.move(robot.home, ranked[0].q)
    assert (motion.status, motion.reason) == (ik.motion.ReachStatus.REACHED, "straight")
    np.testing.assert_array_equal(motion.motion.q[[0, -1]], [robot.home, ranked[0].q])
    assert set(motion.motion.notes["part"]) == {"going"}
    assert max(motion.velocity_share, motion.acceleration_share) <= 1
    start = robot.home + 1.6 * (np.arange(14) == 0)
    place = robot.palm((start + robot.home) / 2)[:3, 3]
    ball = {"ball": {"kind": "sphere", "radius": 0.05, "xyz": place.tolist()}}
    around = ik.Solver(robot, scene=ik.Scene(ball))
    motion = around.move(start, robot.home)
    assert motion.reason == "OMPL, RRT-Connect"
    nothing_held = ik.Grasp(grasp.contacts)
    min_distances = around.check(
        dense(motion.motion.q, 0.2 * motor_units(robot)), nothing_held
    ).distance
    assert min_distances.min() >= -1e-4
    assert motion.clearance <= min_distances.min() + 1e-4
    move_from_inside = around.move((start + robot.home) / 2, robot.home)
    assert (move_from_inside.status, move_from_inside.motion) == (
        ik.motion.ReachStatus.NO_WAY,
        None,
    )
    assert move_from_inside.reason == "the start is not free: bh_base and ball touch"
    with pytest.raises(ik.errors.InputError, match=r"q1:.*lwr_joint_1.*9"):
        solver.move(robot.home, [9.0, *robot.home[1:]])
