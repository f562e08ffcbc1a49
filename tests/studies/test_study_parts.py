"""Samplers of the studies draw what they promise, and the checks of the studies can fail."""

from __future__ import annotations

import collision
import event_thresholds
import impossible_targets
import missed_targets
import numpy as np
import one_body
import public_robots
import pytest
import touch
import touch_claims
import touch_hold
from collision_study import search
from event_thresholds import StoredBlocks
from imported_files import hand
from runner.study import standing
from samplers import SAMPLERS, displaced, finger_sets, palm_slopes, singular_arms, suits

import casadi_ik as ik
from casadi_ik import logs

# Samplers and classes of targets.


@pytest.mark.parametrize("name", [*missed_targets.ROBOTS[-2:], "kuka_lwr_barrett"])
def test_targets_are_within_limits(rng, name):
    robot = missed_targets.load(name)
    for sampler, (_, draw) in SAMPLERS.items():
        if suits(robot, sampler):
            q = draw(robot, rng, 40)
            assert q.shape == (40, len(robot.actuators))
            assert robot.beyond_limits(q).max() <= 1e-9


def test_singular_arms_are_nearer_to_singular(robot, rng):
    usual = palm_slopes(robot, robot.random(rng, 200))
    assert np.median(palm_slopes(robot, singular_arms(robot, rng, 200))) < np.median(usual) / 4


def test_pairs_and_fingers():
    toured = missed_targets.robots_of(["tour"])
    assert {name.split("+")[0] for name in toured} == set(ik.shipped_names("arms"))
    assert {name.split("+")[1] for name in toured} == set(ik.shipped_names("hands"))
    assert set(toured) < set(missed_targets.robots_of(["pairs"]))
    robot = ik.load_robot("panda+allegro_right")
    sets = finger_sets(robot, ["all", "3", "4", "thumb+ring"])
    assert set(sets) == {"all", "3", "thumb+ring"}
    assert robot.fingers.index(robot.thumb) in sets["3"]


def test_displaced_contacts_are_within_their_tolerance(robot, rng):
    q = robot.random(rng, 50)
    points, normals = displaced(*robot.contacts(q), rng, 0.004, 0.4)
    position, angle = robot.errors(q, points, normals)
    np.testing.assert_allclose(position, 0.004, rtol=1e-9)
    np.testing.assert_allclose(angle, 0.4, rtol=1e-9)


def test_every_class_makes_different_contacts(robot):
    contact_sets = []
    for name in impossible_targets.CLASSES:
        points, normals = impossible_targets.impossible(robot, name, np.random.default_rng(1), 5)
        assert points.shape == normals.shape == (5, 3, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-12)
        contact_sets.append(np.concatenate([points, normals]))
    plain = robot.contacts(robot.random(np.random.default_rng(1), 5))
    assert all(not np.allclose(item, np.concatenate(plain)) for item in contact_sets)


def test_perturbed_targets_keep_tolerances():
    robot, tolerance = ik.load_robot("g1+dex3"), ik.Tolerance()
    points, normals = robot.contacts(robot.home)
    moved_points, turned_normals = one_body.around(points, normals, 500, np.random.default_rng(0))
    off = np.linalg.norm(moved_points - points, axis=2)
    angle = np.arccos(np.clip((turned_normals * normals).sum(axis=2), -1, 1))
    for errors, tolerance_value in ((off, tolerance.position), (angle, tolerance.angle)):
        assert 0.99 * tolerance_value < errors.max() <= tolerance_value * (1 + 1e-9)


def test_every_pose_rests_on_the_table():
    surface = ik.load_surface("sugar_box")
    ups = []
    for number in range(len(touch.POSES)):
        pose = touch.placed(surface, number)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert (surface.points @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() == pytest.approx(0.002)
        ups.append(np.abs(pose[2, :3]).argmax())
    assert sorted(ups) == [0, 1, 2]


# Checks of a study can fail.


def test_random_search_finds_exactly_the_solutions():
    robot = ik.load_robot("mobile_kuka_lwr_barrett")
    among, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)
    free = one_body.untouched(among, 1, 0)
    points, normals = robot.contacts(free)
    assert one_body.random_search(among, plain, points[0], normals[0], 0)
    assert not one_body.random_search(among, plain, points[0] + [0, 0, 9.0], normals[0], 0)


def test_check_is_never_free_where_others_penetrate():
    rows, sentence = collision.check(60, 32, 0)
    assert [row[0] for row in rows] == ["random", "free"]
    assert "1 um: **0**" in sentence
    part = collision.Part("coal", search.Piece(collision.ROBOT, 0, 0, 0, 0), 60)
    result = collision.solve(part)
    assert result["checked"] == 60
    assert 0 < result["free"] < 60
    assert result["others"] == 1
    assert result["falsely_free"] == 0


def test_check_detects_another_mesh():
    surface, mesh = touch_claims.surface_of("coarse_can")
    solver, pose = touch.solver_of("panda+allegro_right"), standing(surface, 0.7)
    grasp = solver.grasps_of(surface, pose, limit=1, among=1)[0]
    smaller, larger = mesh.copy(), mesh.copy()
    smaller.apply_scale(0.9)
    larger.apply_scale(1.6)
    assert touch_claims.check(solver.robot, smaller, pose, grasp)["off"]
    assert touch_claims.check(solver.robot, larger, pose, grasp)["deep"]
    turned_pose = pose.copy()
    turned_pose[:3, :3] = turned_pose[:3, :3] @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    violations = touch_claims.check(solver.robot, mesh, turned_pose, grasp)
    assert violations["leaning"]
    assert violations["outside the cone"]


def test_depths_are_right_beside_concave_and_sharp_edges(rng):
    _, bar = touch_claims.surface_of("angle_bar")
    edges = bar.vertices[bar.edges_unique].mean(axis=1)
    points = (edges[:, None] + rng.normal(scale=4e-3, size=(len(edges), 30, 3))).reshape(-1, 3)
    x, y, z = points.T
    in_foot = (x > 0) & (x < 0.08) & (y > 0) & (y < 0.015)
    in_wedge = (x > 0) & (y >= 0.015) & (x < 0.015 * (0.08 - y) / 0.065)
    is_inside = (in_foot | in_wedge) & (abs(z) < 0.03)
    assert 100 < is_inside.sum() < len(points) - 100
    np.testing.assert_array_equal(touch_claims.signed_distances(bar, points) < 0, is_inside)


def test_weak_squeeze_drops_the_object(monkeypatch):
    solver, surface = ik.Solver(ik.load_robot("panda+panda_hand")), ik.load_surface("tennis_ball")
    (grasp,) = solver.grasps_of(surface, standing(surface, 0.7), limit=1, among=1)
    down = -np.eye(3)[2:]
    hold = touch_hold.Hold(solver.robot, grasp, surface)
    assert hold.is_held(hold.settled(), down).all()
    monkeypatch.setattr(touch_hold, "SQUEEZE", 0.02)
    hold = touch_hold.Hold(solver.robot, grasp, surface)
    assert not hold.is_held(hold.settled(), down).any()


def test_the_area_under_the_curve():
    is_held = np.array([True, False, True, False])
    assert touch_hold.concordance(np.array([4.0, 1.0, 3.0, 2.0]), is_held) == 1.0
    assert touch_hold.concordance(np.array([1.0, 4.0, 2.0, 3.0]), is_held) == 0.0
    assert touch_hold.concordance(np.ones(4), is_held) == 0.5


@pytest.fixture(scope="module")
def stored_blocks() -> StoredBlocks:
    robot = ik.load_robot("kuka_lwr_barrett")
    options = {"max_iterations": 300}
    solver = ik.Solver(robot, "enhanced-dls", finger_step="closed-form", options=options)
    blocks = StoredBlocks()
    solver.solve_batch(*event_thresholds.targets_of(robot, 24, 0), log=blocks)
    return blocks


def test_what_a_threshold_catches(stored_blocks: StoredBlocks) -> None:
    """The share of solves with a smaller singular value equals that of the traces."""
    rows = np.concatenate([block.rows for block in stored_blocks.blocks])
    counts = np.concatenate([block.batch.iterations for block in stored_blocks.blocks])
    solved = np.concatenate([block.batch.success for block in stored_blocks.blocks])
    assert 0 < solved.sum() < len(solved)
    starts = np.cumsum(counts) - counts
    shares = []
    for trial in event_thresholds.trials(stored_blocks.blocks[0]):
        if (trial.kind, trial.subject) != (logs.EventKind.NEAR_SINGULAR, "closed_chain"):
            continue
        lowest = np.fmin.reduceat(rows["sigma_closed_chain"], starts)
        caught = event_thresholds.caught(stored_blocks.blocks, trial)
        below = lowest < np.float32(trial.threshold)
        assert caught.failed == pytest.approx(100 * below[~solved].mean())
        assert caught.solved == pytest.approx(100 * below[solved].mean())
        shares.append(caught.failed)
    assert len(shares) == len(event_thresholds.FACTORS)
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]


def test_a_made_up_checkout(tmp_path):
    (tmp_path / "owner+name").mkdir()
    path = hand(tmp_path / "owner+name")
    assert public_robots.checkout(tmp_path, "owner/name") == path.parent
    assert public_robots.checkout(tmp_path, "owner/other") is None
    result = public_robots.imported(path, [], shapes=False)
    motors, *fingers = result["outcome"].split()
    assert motors == "0+4"
    assert len(fingers) == 2
    row = {"repository": "owner/name", "path": path.name, "arguments": "", "expected": "0+1"}
    sentence, blocks = public_robots.report([row], {public_robots.key(row): result}, shapes=False)
    text = "\n".join([sentence, *blocks])
    assert "0 of 1 are as" in " ".join(text.split())
    path.write_text("<robot/>")
    assert public_robots.imported(path, [], shapes=False)["outcome"].startswith("error: ")


def test_non_opposing_contacts_do_not_close():
    """Two opposite points of a ball of 30 mm, with normals inwards or aside."""
    across = np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
    side_normals = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert touch.closure_margin(across, -across / 0.03, 0.03) > 1e-3
    assert not touch.closes(across, side_normals, 0.03)
    assert not touch.closes(across[:1], -across[:1] / 0.03, 0.03)
