"""Targets out of reach: the nearest configuration, compared with an independent optimiser."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

import casadi_ik as ik
from casadi_ik.compile.cancellation import virtual_machine


def out_of_reach(robot, count, seed=0, factor=1.5):
    points, normals = robot.contacts(robot.random(np.random.default_rng(seed), count))
    return points * factor, normals


def distances(solver, points, normals, q):
    """Return (k,) sums of squared position errors and chords, each divided by its tolerance."""
    tolerances = np.array([(item.position, item.angle) for item in solver.tolerances.values()])
    reached_points, reached_normals = solver.robot.contacts(q)
    positions = np.linalg.norm(reached_points - points, axis=2) / tolerances[:, 0]
    chords = np.linalg.norm(reached_normals - normals, axis=2) / (2 * np.sin(tolerances[:, 1] / 2))
    return (positions**2 + chords**2).sum(axis=1)


@pytest.mark.parametrize("name", ["ur5e", "kuka_lwr_barrett"])
def test_no_other_optimiser_comes_nearer(name):
    robot = ik.load_robot(name)
    solver, rng = ik.Solver(robot), np.random.default_rng(3)
    points, normals = out_of_reach(robot, 6, factor=2.5)
    batch = solver.solve_batch(points, normals, best_effort=True)
    assert (batch.status == ik.Status.NEAREST)[~batch.success].all()
    assert (~batch.success).sum() >= 3
    assert batch.limits_ok.all()
    nearest_distances = distances(solver, points, normals, batch.q)
    tolerances = np.array([(item.position, item.angle) for item in solver.tolerances.values()])
    for row in np.flatnonzero(~batch.success):

        def residual(q, row=row):
            at, facing = robot.contacts(q)
            positions = (at - points[row]) / tolerances[:, :1]
            chords = (facing - normals[row]) / (2 * np.sin(tolerances[:, 1:] / 2))
            return np.concatenate([positions.ravel(), chords.ravel()])

        for start in robot.random(rng, 6):
            best = least_squares(residual, start, bounds=(robot.lower, robot.upper))
            assert nearest_distances[row] <= 2 * best.cost * (1 + 1e-6)


def targets_near_the_boundary(robot, count, share_at_limits=0.4, seed=0):
    """Return contacts with some motors at limits; every second target is moved by up to 5 mm."""
    rng = np.random.default_rng(seed)
    q = robot.random(rng, count)
    limits = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    q = np.where(rng.random(q.shape) < share_at_limits, limits, q)
    points, normals = robot.contacts(q)
    outwards = points / np.linalg.norm(points, axis=2, keepdims=True)
    distance = np.where(np.arange(count) % 2, rng.random(count), 0.0)[:, None, None]
    return points + 5e-3 * distance * outwards, normals


@pytest.mark.parametrize(
    ("name", "scene"),
    [
        ("so101", None),
        ("ur5e", None),
        ("barrett_bh8_280", None),
        ("kuka_lwr_barrett", None),
        ("kuka_lwr_barrett", "table"),
    ],
)
def test_solved_targets_keep_their_solutions(name, scene):
    robot = ik.load_robot(name)
    scene = None if scene is None else ik.load_scene(scene)
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-3, np.radians(0.6)), scene=scene)
    points, normals = targets_near_the_boundary(robot, 20, 0.4 if scene is None else 0.0)
    options = {"q0": robot.home, "prefer": "q0" if scene is None else "limits"}
    plain = solver.solve_batch(points, normals, **options)
    best = solver.solve_batch(points, normals, best_effort=True, **options)
    assert plain.success.any()
    assert best.success[plain.success].all()
    np.testing.assert_array_equal(best.q[plain.success], plain.q[plain.success])
    for row in np.flatnonzero(plain.success)[:3].tolist():
        contacts = zip(robot.fingers, points[row], normals[row], strict=True)
        grasp = ik.Grasp({finger: ik.Contact(*vectors) for finger, *vectors in contacts})
        single = solver.solve(grasp, diagnose=False, best_effort=True, **options)
        np.testing.assert_array_equal(single.q, plain.q[row])


@pytest.mark.parametrize("name", ["so101", "kuka_lwr_barrett"])
def test_targets_out_of_reach_need_few_restarts(name):
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 10, factor=3.0)
    plain = solver.solve_batch(points, normals)
    nearest = solver.solve_batch(points, normals, best_effort=True)
    rows = nearest.status == ik.Status.NEAREST
    assert rows.any()
    assert (nearest.iterations[rows] < plain.iterations[rows]).all()
    contacts = zip(robot.fingers, points[rows][0], normals[rows][0], strict=True)
    grasp = ik.Grasp({finger: ik.Contact(*vectors) for finger, *vectors in contacts})
    single = solver.solve(grasp, diagnose=False, best_effort=True)
    assert single.iterations == nearest.iterations[rows][0]


def test_diagnosis_of_a_target_out_of_reach_is_kept(robot):
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 3, factor=3.0)
    batch = solver.solve_batch(points, normals, best_effort=True, diagnose=True)
    plain = solver.solve_batch(points, normals, diagnose=True)
    assert (batch.status == ik.Status.NEAREST).all()
    assert [item.reason for item in batch.diagnoses] == [item.reason for item in plain.diagnoses]
    assert [item.established for item in batch.diagnoses] == [
        item.established for item in plain.diagnoses
    ]


@pytest.mark.parametrize("name", ["viperx_300s", "ur5e", "kuka_lwr_barrett"])
def test_single_targets_equal_those_of_a_batch(name):
    robot = ik.load_robot(name)
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 70, factor=2.0)
    batch = solver.solve_batch(points, normals, best_effort=True)
    rows = np.flatnonzero(batch.status == ik.Status.NEAREST)[:5]
    assert len(rows) == 5
    for row in rows:
        contacts = zip(robot.fingers, points[row], normals[row], strict=True)
        grasp = ik.Grasp({finger: ik.Contact(*vectors) for finger, *vectors in contacts})
        single = solver.solve(grasp, diagnose=False, best_effort=True)
        np.testing.assert_array_equal(single.q, batch.q[row])


def test_poses_of_five_axes_are_nearest():
    """The reference is the best of many bounded least-squares solutions."""
    robot, rng = ik.load_robot("viperx_300s"), np.random.default_rng(2)
    fixed_motor = 3
    fixed = {robot.actuators[fixed_motor]: float(robot.home[fixed_motor])}
    solver = ik.Solver(robot)
    finger = robot.fingers[0]
    for frame in robot.contact_frames(robot.random(rng, 3))[:, 0]:
        frame[:3, 3] *= 1.1
        grasp = ik.Grasp({finger: ik.Contact.at(frame)})
        solution = solver.solve(grasp, fixed=fixed, diagnose=False, best_effort=True)
        assert solution.status is ik.Status.NEAREST
        residual = pose_residual(robot, frame, solver.tolerances[finger])
        lower, upper = robot.lower.copy(), robot.upper.copy()
        lower[fixed_motor] = robot.home[fixed_motor] - 1e-9
        upper[fixed_motor] = robot.home[fixed_motor] + 1e-9
        starts = np.clip(robot.random(rng, 40), lower, upper)
        costs = [least_squares(residual, start, bounds=(lower, upper)).cost for start in starts]
        assert np.sum(residual(solution.q) ** 2) <= 2 * min(costs) * (1 + 1e-6)


def test_equally_near_configurations_are_decided_by_travel():
    """The rotation of the first joint does not matter for a point above the axis of the base."""
    robot = ik.load_robot("ur5e")
    solver = ik.Solver(robot)
    grasp = ik.Grasp({robot.fingers[0]: ik.Contact([0.0, 0.0, 3.0])})
    for start in robot.random(np.random.default_rng(1), 3):
        solution = solver.solve(grasp, q0=start, diagnose=False, best_effort=True)
        restarted = solver.solve(grasp, q0=solution.q, diagnose=False, best_effort=True)
        np.testing.assert_allclose(restarted.q, solution.q, atol=1e-4)


def test_equally_near_configurations_are_decided_by_a_posture():
    """The rotation of the first joint does not matter for a point above the axis of the base."""
    robot = ik.load_robot("ur5e")
    solver = ik.Solver(robot)
    grasp = ik.Grasp({robot.fingers[0]: ik.Contact([0.0, 0.0, 3.0])})
    nearest = solver.solve(grasp, diagnose=False, best_effort=True)
    for angle in (-1.0, 2.0):
        posture = nearest.q.copy()
        posture[0] = angle
        options = ik.BestEffort(posture=posture)
        solution = solver.solve(grasp, diagnose=False, best_effort=options)
        assert solution.status is ik.Status.NEAREST
        assert solution.q[0] == pytest.approx(angle, abs=1e-3)
        assert solution.error_ratio == pytest.approx(nearest.error_ratio)


@pytest.mark.parametrize(
    "options",
    [
        {"weights": [1.0, 2.0]},
        {"minimax": "yes"},
        {"posture": [0.0, np.nan]},
        {"posture": "home"},
        {"posture": [0.0], "local": True},
    ],
)
def test_invalid_options_are_refused(options):
    with pytest.raises(ik.errors.InputError, match=next(iter(options))):
        ik.BestEffort(**options)


def test_posture_of_another_robot_is_refused(robot):
    options = ik.BestEffort(posture=[0.0, 0.0])
    with pytest.raises(ik.errors.InputError, match=f"posture.*2.*{len(robot.actuators)}"):
        ik.Solver(robot).solve_batch(*robot.contacts(robot.home[None]), best_effort=options)


def test_nearest_configurations_do_not_need_a_compiler():
    robot = ik.load_robot("ur5e")
    points, normals = out_of_reach(robot, 4, factor=2.5)
    compiled = ik.Solver(robot).solve_batch(points, normals, best_effort=True)
    with virtual_machine():
        virtual = ik.Solver(robot).solve_batch(points, normals, best_effort=True)
    assert (compiled.status == ik.Status.NEAREST).any()
    np.testing.assert_array_equal(virtual.status, compiled.status)
    unsolved = ~compiled.success
    np.testing.assert_allclose(virtual.error_ratio[unsolved], compiled.error_ratio[unsolved])


def test_error_ratio_measures_the_excess(robot):
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 3)
    batch = solver.solve_batch(points, normals, best_effort=True)
    for row in range(3):
        solution = batch.solution(row)
        expected = max(
            max(
                item.position_error / item.tolerance.position,
                item.angle_error / item.tolerance.angle,
            )
            for item in solution.contacts.values()
        )
        assert solution.error_ratio == pytest.approx(expected)
        assert batch.error_ratio[row] == pytest.approx(expected)
        assert (solution.error_ratio <= 1) == solution.success


def test_solved_targets_are_unchanged(robot, rng):
    solver = ik.Solver(robot)
    points, normals = robot.contacts(robot.random(rng, 50))
    plain = solver.solve_batch(points, normals)
    np.testing.assert_array_equal(plain.q, solver.solve_batch(points, normals, best_effort=True).q)


def test_unreachable_palm_keeps_the_hand(robot, rng):
    solver, q = ik.Solver(robot), robot.random(rng, 8)
    palms = robot.palm(q)
    palms[:, :3, 3] *= 2
    batch = solver.solve_palms(palms, q, best_effort=True)
    assert (batch.status == ik.Status.NEAREST).any()
    hand = list(robot.description.hand_actuators)
    np.testing.assert_allclose(batch.q[:, hand], q[:, hand], atol=1e-9)


def test_the_nearest_configuration_is_free_of_collisions(robot):
    solver = ik.Solver(robot, scene=ik.load_scene("table"))
    batch = solver.solve_batch(*out_of_reach(robot, 6, seed=1), best_effort=True)
    is_nearest = batch.status == ik.Status.NEAREST
    assert is_nearest.any()
    assert (batch.clearance[is_nearest] > 0).all()


def test_fixed_motors_stay_fixed(robot):
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 3)
    batch = solver.solve_batch(points, normals, fixed={"lwr_joint_3": 0.2}, best_effort=True)
    np.testing.assert_allclose(batch.q[:, 2], 0.2)


def pose_residual(robot, pose, tolerance):
    """Return the residual of a pose of the first fingertip: position and axes, by tolerance."""

    def residual(q):
        frame = robot.contact_frames(q)[0]
        position = (frame[:3, 3] - pose[:3, 3]) / tolerance.position
        axes = (frame[:3, :3] - pose[:3, :3]) / (2 * np.sin(tolerance.angle / 2))
        return np.concatenate([position, axes.ravel() / np.sqrt(2)])

    return residual


def test_arm_led_out_of_reach_stays_on_its_branch():
    robot = ik.load_robot("ur5e")
    solver, q = ik.Solver(robot), robot.home
    points, normals = robot.contacts(q)
    outwards = points[0] / np.linalg.norm(points[0])
    statuses = []
    for step in range(160):
        grasp = ik.Grasp(
            {robot.fingers[0]: ik.Contact(points[0] + 5e-3 * step * outwards, normals[0])}
        )
        solution = solver.solve(grasp, q0=q, diagnose=False, best_effort="local")
        assert np.abs(solution.q - q).max() < 0.5
        statuses.append(solution.status)
        q = solution.q
    assert set(statuses[:40]) == {ik.Status.SOLVED}
    assert set(statuses[-40:]) == {ik.Status.NEAREST}


def test_local_descent_does_not_jump_to_limits():
    robot = ik.load_robot("ur5e")
    frame = robot.contact_frames(robot.home)[0].copy()
    frame[:3, 3] = 9.0
    grasp = ik.Grasp({robot.fingers[0]: ik.Contact.from_pose(frame)})
    solver = ik.Solver(robot)
    local = solver.solve(grasp, diagnose=False, best_effort="local")
    nearest = solver.solve(grasp, diagnose=False, best_effort=True)
    assert local.error_ratio < 1.01 * nearest.error_ratio
    assert np.abs(local.q - robot.home).max() < np.pi


def test_five_axis_arm_follows_infeasible_poses():
    """Each answer is a minimum near the last one: no step is omitted, and none is a jump."""
    robot = ik.load_robot("viperx_300s")
    fixed = {name: float(robot.home[i]) for i, name in enumerate(robot.actuators[:1])}
    solver = ik.Solver(robot, tolerance=ik.Tolerance(5e-3, np.radians(2.9)))
    frame, q = robot.contact_frames(robot.home)[0], robot.home
    for step in range(1, 21):
        pose = frame.copy()
        pose[1, 3] += 5e-3 * step
        grasp = ik.Grasp({robot.fingers[0]: ik.Contact.from_pose(pose)})
        solution = solver.solve(grasp, q0=q, fixed=fixed, diagnose=False, best_effort="local")
        if step > 2:
            assert solution.status is ik.Status.NEAREST
            assert 1e-4 < np.abs(solution.q - q).max() < 0.2
            residual = pose_residual(robot, pose, solver.tolerances[robot.fingers[0]])
            margin = np.where(np.arange(len(q)) == 0, 1e-9, 0.3)
            bounds = np.clip(solution.q - margin, robot.lower, None), solution.q + margin
            best = least_squares(residual, solution.q, bounds=np.minimum(bounds, robot.upper))
            assert np.sum(residual(solution.q) ** 2) <= 2 * best.cost * (1 + 1e-6)
        q = solution.q


def test_weights_replace_tolerances(robot):
    points, normals = out_of_reach(robot, 4)
    tolerance = ik.Tolerance(3e-3, 0.5)
    plain = ik.Solver(robot, tolerance=tolerance)
    pair = 1 / tolerance.position, 0.5 / np.sin(tolerance.angle / 2)
    scaled = dict.fromkeys(robot.fingers, pair)
    weighted = ik.Solver(robot).solve_batch(
        points, normals, best_effort=ik.BestEffort(weights=scaled)
    )
    expected = plain.solve_batch(points, normals, best_effort=True)
    rows = (weighted.status == ik.Status.NEAREST) & (expected.status == ik.Status.NEAREST)
    assert rows.any()
    costs = [distances(plain, points, normals, batch.q) for batch in (weighted, expected)]
    np.testing.assert_allclose(costs[0][rows], costs[1][rows], rtol=1e-3)
    by_position = ik.Solver(robot).solve_batch(
        points, normals, best_effort=ik.BestEffort(weights=dict.fromkeys(scaled, (1.0, 0.0)))
    )
    position = np.linalg.norm(robot.contacts(by_position.q)[0] - points, axis=2)
    distance = np.linalg.norm(robot.contacts(weighted.q)[0] - points, axis=2)
    assert ((position**2).sum(axis=1) <= (distance**2).sum(axis=1) * (1 + 1e-6))[rows].all()


def test_minimax_lowers_the_largest_error(robot):
    solver = ik.Solver(robot)
    points, normals = out_of_reach(robot, 8)
    squares = solver.solve_batch(points, normals, best_effort=True)
    minimax = solver.solve_batch(points, normals, best_effort=ik.BestEffort(minimax=True))
    rows = squares.status == ik.Status.NEAREST
    assert (minimax.error_ratio[rows] <= squares.error_ratio[rows] * (1 + 1e-6)).all()
    assert (minimax.error_ratio[rows] < 0.99 * squares.error_ratio[rows]).any()


def test_choose_returns_the_nearest_of_infeasible_candidates(robot):
    solver = ik.Solver(robot)
    points, normals = robot.contacts(robot.home)
    grasps = [
        ik.Grasp(
            {
                finger: ik.Contact(point + np.array([0.0, 0.0, height]), normal)
                for finger, point, normal in zip(robot.fingers, points, normals, strict=True)
            }
        )
        for height in (3.0, 2.0)
    ]
    assert len(solver.choose(grasps)) == 0
    ranking = solver.choose(grasps, best_effort=True)
    assert ranking.answered == 0
    assert [choice.candidate for choice in ranking] == [1, 0]
    assert all(choice.solution.status is ik.Status.NEAREST for choice in ranking)
    assert ranking[0].score == pytest.approx(-ranking[0].solution.error_ratio)


@pytest.mark.parametrize("pair", [(0.0, 0.0), (-1.0, 1.0), (np.nan, 1.0), (1.0,), "heavy"])
def test_invalid_weights_are_refused(pair):
    with pytest.raises(ik.errors.InputError, match=r"weights.*thumb"):
        ik.BestEffort(weights={"thumb": pair})


def test_weights_of_unknown_fingers_are_refused(robot):
    options = ik.BestEffort(weights={"tail": (1.0, 1.0)})
    with pytest.raises(ik.errors.UnknownNameError, match="tail"):
        ik.Solver(robot).solve_batch(*robot.contacts(robot.home[None]), best_effort=options)


@pytest.mark.parametrize("value", ["global", 2, None])
def test_unknown_best_effort_is_refused(robot, value):
    with pytest.raises(ik.errors.InputError, match=f"best_effort.*{value!r}"):
        ik.Solver(robot).solve_batch(*robot.contacts(robot.home[None]), best_effort=value)
