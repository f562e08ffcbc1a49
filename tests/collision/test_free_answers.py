"""Answers in a scene: a collision-free one, or a verdict that names the obstacle."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from collision_queries import query_of_grasps

import casadi_ik as ik


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    return ik.Solver(robot, scene=ik.load_scene("table"))


@pytest.mark.parametrize("name", ik.shipped_grasps("kuka_lwr_barrett"))
def test_shipped_grasps_have_collision_free_solutions_on_a_table(solver, robot, name):
    grasp = ik.load_grasp(name)
    solution = solver.solve(grasp)
    assert solution.status is ik.Status.SOLVED, solution.collision
    assert solution.clearance >= 0
    assert solution.closest is not None
    # The verdict depends on q only: it is the same for the answer as a start.
    points, normals = grasp.arrays(robot.fingers)
    position, angle = robot.errors(solution.q, points, normals)
    assert (position <= 5e-3).all()
    assert (angle <= np.deg2rad(3)).all()


def test_choice_finds_candidates_that_contacts_alone_miss(solver, robot):
    """Without the search some answers collide; with it none does."""
    grasps = [ik.load_grasp(name) for name in ik.shipped_grasps(robot.name)]
    blind = ik.Solver(robot)
    touching = 0
    for grasp in grasps:
        around = query_of_grasps(solver, [grasp])
        touching += not around.check(blind.solve(grasp).q[None]).free[0]
    assert touching >= 3


def test_blocking_wall_is_named(robot):
    cup = ik.load_grasp("cup")
    wall = {"kind": "sphere", "radius": 0.3, "xyz": cup.object_pose[:3, 3].tolist()}
    solver = ik.Solver(robot, scene=ik.Scene({"balloon": wall}))
    solution = solver.solve(cup)
    assert solution.status is ik.Status.COLLISION
    quick = solver.solve(cup, diagnose=False).collision
    assert quick.pair == solution.collision.pair
    assert quick.without_scene is None
    assert quick.without_self is None
    assert not solution.success
    report = solution.collision
    assert "balloon" in report.pair
    assert report.without_scene
    assert not report.without_self
    assert report.short > 0
    assert solution.clearance == pytest.approx(-report.short)
    assert any("balloon" in line for line in report.lines)


def test_without_a_scene_no_collision_is_checked(robot):
    solution = ik.Solver(robot).solve(ik.load_grasp("cup"))
    assert solution.clearance is None
    assert solution.closest is None
    with pytest.raises(ik.errors.InputError, match=r"prefer: 'clearance'.*scene"):
        ik.Solver(robot).solve(ik.load_grasp("cup"), prefer="clearance")


def test_grasped_object_may_only_touch_the_fingers(solver):
    cup = ik.load_grasp("cup")
    around = query_of_grasps(solver, [cup])
    of_cup = {names[0] for names in around.table.names if names[1] == "cup"}
    assert "bh_base" in of_cup
    assert "bh_thumb_link_2" in of_cup
    assert not of_cup & {"bh_thumb_link_3", "bh_finger_2_link_3", "bh_finger_3_link_3"}


def test_clearance_is_preferred_if_asked(solver):
    gained = []
    for name in ("cup", "apple", "banana", "mug"):
        usual, with_clearance = (
            solver.solve(ik.load_grasp(name), prefer=p) for p in ("limits", "clearance")
        )
        assert with_clearance.success
        gained.append(with_clearance.clearance - usual.clearance)
    assert min(gained) >= -1e-9
    assert max(gained) > 1e-3


def test_batches_match_single_solves(solver, robot):
    grasps = [ik.load_grasp(name) for name in ("cup", "mug", "banana")]
    arrays = [grasp.arrays(robot.fingers) for grasp in grasps]
    points, normals = (np.stack(parts) for parts in zip(*arrays, strict=True))
    scene_in_hand = ik.Scene(
        {"cup": {"kind": "object", "object": "cup"}},
        grasped="cup",
    )
    poses = np.stack([grasp.object_pose for grasp in grasps])
    batch = ik.Solver(robot, scene=scene_in_hand).solve_batch(points, normals, object_pose=poses)
    assert batch.clearance.shape == (3,)
    assert (batch.clearance[batch.success] >= 0).all()
    single_batch = ik.Solver(robot, scene=scene_in_hand).solve_batch(
        points[1:2], normals[1:2], object_pose=poses[1:2]
    )
    np.testing.assert_allclose(single_batch.q[0], batch.q[1], atol=1e-9)
    with pytest.raises(ik.errors.InputError, match=r"object_pose:.*2.*3"):
        ik.Solver(robot, scene=scene_in_hand).solve_batch(points, normals, object_pose=poses[:2])
    with pytest.raises(ik.errors.InputError, match="'grasped'"):
        solver.solve_batch(points, normals, object_pose=poses)


def test_wrong_number_of_object_poses_is_refused(solver):
    """The driver reads one pose per configuration."""
    cup = ik.load_grasp("cup")
    around = query_of_grasps(solver, [cup, cup])
    with pytest.raises(ik.errors.InputError, match="2 poses for 3 configurations"):
        around.check(np.tile(solver.robot.home, (3, 1)))
    assert around.check(np.tile(solver.robot.home, (2, 1))).free.shape == (2,)


def test_all_solutions_are_collision_free(solver):
    cup = ik.load_grasp("cup")
    solutions = solver.solve_all(cup, limit=4)
    assert solutions
    around = query_of_grasps(solver, [cup])
    assert around.free(np.stack([solution.q for solution in solutions])).all()


def test_calls_without_scene_support_say_so(solver):
    with pytest.raises(ik.errors.UnsupportedError, match=r"fast: .*scene"):
        solver.fast()


def test_other_methods_are_checked_after_the_solve(robot):
    cup = ik.load_grasp("cup")
    wall = {"kind": "sphere", "radius": 0.3, "xyz": cup.object_pose[:3, 3].tolist()}
    scene = ik.Scene({"balloon": wall})
    paper_solution = ik.Solver(robot, "thumb-first", compiled=False, scene=scene).solve(
        cup, diagnose=False
    )
    assert paper_solution.status is ik.Status.COLLISION
    assert paper_solution.clearance < 0


def test_solver_with_scene_can_be_copied(solver):
    copy = pickle.loads(pickle.dumps(solver))
    grasp = ik.load_grasp("cup")
    np.testing.assert_array_equal(copy.solve(grasp).q, solver.solve(grasp).q)


def test_rows_have_independent_answers(solver, robot):
    """Answers do not depend on the other targets of a batch, bit for bit."""
    rng = np.random.default_rng(4)
    points, normals = robot.contacts(robot.random(rng, 40))
    batch = solver.solve_batch(points, normals)
    assert (batch.status == ik.Status.COLLISION).sum() > 3
    assert batch.success.sum() > 3
    parts = [(points[i : i + 7], normals[i : i + 7]) for i in range(0, 40, 7)]
    blocks = list(solver.solve_blocks(parts))
    q = np.concatenate([block.solution.q for block in blocks])
    np.testing.assert_array_equal(q, batch.q)
    reports = [report for block in blocks for report in block.solution.collisions]
    assert reports == list(batch.collisions)
