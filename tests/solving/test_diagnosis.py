"""Diagnosis of unsolved targets: right reasons, right numbers, never a false alarm."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
from robot_variants import derived_robot
from scipy.optimize import least_squares
from toy_robots import moved_targets

import casadi_ik as ik

pytestmark = pytest.mark.usefixtures("usual_flags")

Array = np.ndarray
STARTS = 2


@pytest.fixture(scope="module")
def solver(robot: ik.ArmHand) -> ik.Solver:
    """Hand-first solver with the default tolerance."""
    return ik.Solver(robot)


@pytest.fixture(scope="module")
def cup(robot: ik.ArmHand) -> tuple[Array, Array]:
    """Contacts within reach."""
    return ik.load_grasp("cup").arrays(robot.fingers)


def diagnosed(solver: ik.Solver, points: Array, normals: Array) -> ik.solve.Diagnosis:
    """Return the diagnosis of an unsolved target; it is unreachable only with a proof."""
    batch = solver.solve_batch(points[None], normals[None], diagnose=True)
    (diagnosis,) = batch.diagnoses
    assert diagnosis is not None
    status = "NOT_FOUND" if diagnosis.proof is None else "UNREACHABLE"
    assert batch.status_names.tolist() == [status]
    return diagnosis


def proved(solver: ik.Solver, points: Array, normals: Array) -> ik.solve.Diagnosis:
    """Return the diagnosis of a target that is proved unreachable."""
    diagnosis = diagnosed(solver, points, normals)
    assert diagnosis.established
    assert "proved for" in "\n".join(diagnosis.lines)
    return diagnosis


def at_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int, part: float) -> Array:
    """Return configurations with a part of the actuators at their limits."""
    q = robot.random(rng, count)
    chance = rng.random(q.shape)
    q = np.where(chance < part / 2, robot.lower, q)
    return np.where(chance > 1 - part / 2, robot.upper, q)


def stretched(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Return such configurations with the arm at 99.9 % of its length."""
    q, a, b = at_limits(robot, rng, count, 0.3), 0.4, 0.39
    cosine = ((0.999 * (a + b)) ** 2 - a * a - b * b) / (2 * a * b)
    q[:, 3] = np.arccos(cosine) * rng.choice([-1, 1], count)
    return q


def test_solved_targets_have_no_diagnosis(solver: ik.Solver, cup: tuple[Array, Array]) -> None:
    assert solver.solve(ik.load_grasp("cup")).diagnosis is None
    assert solver.solve_batch(cup[0][None], cup[1][None]).diagnoses == ()
    assert solver.solve_batch(cup[0][None], cup[1][None], diagnose=True).diagnoses == (None,)


def test_contacts_too_far_apart(solver: ik.Solver, cup: tuple[Array, Array]) -> None:
    points, normals = cup
    spread = points + 0.25 * np.array([[0, 1, 0], [1, -1, 0], [-1, -1, 0]])
    diagnosis = proved(solver, spread, normals)
    assert diagnosis.reason is ik.solve.Reason.HAND
    assert diagnosis.hand is not None
    assert not diagnosis.hand.ok
    assert max(c.position_error for c in diagnosis.hand.contacts.values()) > 0.05
    assert "mm" in diagnosis.lines[1]


@pytest.mark.parametrize(("shift", "distance"), [((3.0, 0, 0), 3.0), ((0, 0, 40.0), 40.0)])
def test_too_far(
    solver: ik.Solver, cup: tuple[Array, Array], shift: Array, distance: float
) -> None:
    diagnosis = proved(solver, cup[0] + np.array(shift), cup[1])
    assert diagnosis.reason is ik.solve.Reason.REACH
    assert diagnosis.reach is not None
    assert diagnosis.reach.farthest == pytest.approx(0.79)
    assert diagnosis.reach.excess == pytest.approx(distance - 0.79, abs=0.8)
    assert diagnosis.reliefs == diagnosis.released == ()
    numbers = [float(word) for word in re.findall(r"\d+\.?\d*", diagnosis.lines[1])]
    excess = diagnosis.reach.excess
    assert any(n == pytest.approx(unit * excess, rel=0.01) for n in numbers for unit in (1, 1e3))


def test_object_in_the_shoulder(
    solver: ik.Solver, robot: ik.ArmHand, cup: tuple[Array, Array]
) -> None:
    """The elbow would have to bend beyond its limit; lifting that limit proves it."""
    points = cup[0] - cup[0].mean(axis=0) + [0, 0, 0.31]
    diagnosis = proved(solver, points, cup[1])
    assert diagnosis.reason is ik.solve.Reason.REACH
    assert diagnosis.reach is not None
    assert diagnosis.reach.nearest == pytest.approx(0.395, abs=1e-3)
    assert diagnosis.reach.excess < -0.1
    assert [relief.lifted for relief in diagnosis.reliefs if relief.lifted in robot.actuators] == [
        "lwr_joint_4"
    ]


def test_normal_that_faces_away(
    solver: ik.Solver, robot: ik.ArmHand, cup: tuple[Array, Array]
) -> None:
    points, normals = cup
    normals = normals * np.array([[-1], [1], [1]])
    diagnosis = diagnosed(solver, points, normals)
    assert diagnosis.reason is ik.solve.Reason.HAND
    assert {(item.part, item.finger) for item in diagnosis.released} >= {
        ("normal", "thumb"),
        ("finger", "thumb"),
    }
    for item in diagnosis.released:
        p, n = robot.contacts(item.q)
        other_columns = [i for i, name in enumerate(robot.fingers) if name != item.finger]
        assert np.linalg.norm((p - points)[other_columns], axis=1).max() <= 5e-3 * (1 + 1e-9)
        if item.finger != "all":
            assert np.linalg.norm((n - normals)[other_columns], axis=1).max() <= np.deg2rad(3)


def test_diagnosis_uses_the_object_pose(solver: ik.Solver) -> None:
    """The diagnosis tries several targets with the same object pose."""
    grasp = ik.load_grasp("cup")
    up = np.eye(4)
    up[2, 3] = 0.15
    contacts = {**grasp.contacts, "finger_2": grasp.contacts["finger_2"].transformed(up)}
    grasp_with_object = replace(grasp, contacts=contacts)
    assert grasp_with_object.object_pose is not None
    diagnosis = solver.solve(grasp_with_object).diagnosis
    assert diagnosis is not None
    assert ("finger", "finger_2") in {(item.part, item.finger) for item in diagnosis.released}
    up[2, 3] = 0.02
    assert solver.track([grasp, grasp.at(up)], period=0.1).success.all()


def test_single_limit_is_named(solver: ik.Solver, robot: ik.ArmHand) -> None:
    """An actuator 5 deg beyond its limit and all others mid-range; brute force finds no other way.

    Every relief is proved by its solution, and asks for no more than those 5 degrees.
    """
    rng = np.random.default_rng(3)
    middle, half_range = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
    names, blocked = ["lwr_joint_4", "bh_thumb_proximal", "bh_finger_2_distal"], 0
    for name in names:
        j = robot.actuators.index(name)
        for _ in range(4):
            q = middle + 0.5 * half_range * rng.uniform(-1, 1, len(half_range))
            q[j] = robot.upper[j] + np.deg2rad(5)
            points, normals = robot.contacts(q)
            strict = ik.Solver(robot, tolerance=ik.Tolerance(5e-4, np.deg2rad(0.3)))
            batch = strict.solve_batch(points[None], normals[None], diagnose=True)
            if batch.success[0]:
                continue
            diagnosis = batch.diagnoses[0]
            assert diagnosis is not None
            best = best_of_restarts(robot, points, normals, q)
            assert np.linalg.norm(residual(best, robot, points, normals)) > 1e-2
            assert diagnosis.reason is not ik.solve.Reason.REACHABLE
            (relief,) = (item for item in diagnosis.reliefs if item.lifted == name)
            assert list(relief.violations) == [name]
            assert 0 < abs(relief.violations[name]) <= np.deg2rad(5.3)
            assert np.linalg.norm(robot.contacts(relief.q)[0] - points, axis=1).max() <= 5.01e-4
            assert f"{name} " in "\n".join(diagnosis.lines)
            blocked += 1
            break
    assert blocked == len(names)


def test_barely_reachable_targets_are_never_unreachable(
    solver: ik.Solver, robot: ik.ArmHand
) -> None:
    rng = np.random.default_rng(11)
    for q in (
        at_limits(robot, rng, 2000, 0.4),
        at_limits(robot, rng, 1000, 0.8),
        stretched(robot, rng, 2000),
    ):
        batch = solver.solve_batch(*robot.contacts(q), diagnose=True)
        assert batch.success.all(), batch.status_names[~batch.success]


def test_reachable_thanks_to_tolerance(solver: ik.Solver, robot: ik.ArmHand) -> None:
    rng = np.random.default_rng(12)
    for q in (at_limits(robot, rng, 250, 0.3), stretched(robot, rng, 250)):
        targets = moved_targets(robot.contacts(q), rng, 0.99 * 5e-3, 0.99 * np.deg2rad(3))
        batch = solver.solve_batch(*targets, diagnose=True)
        assert "UNREACHABLE" not in batch.status_names
        assert batch.success.mean() > 0.99


def test_diagnosis_matches_brute_force(solver: ik.Solver, robot: ik.ArmHand) -> None:
    """Whole grasps are shifted, contacts shifted, or normals turned: about half can be reached."""
    rng = np.random.default_rng(13)
    points, normals = robot.contacts(robot.random(rng, 40))
    points[:16] += rng.normal(0, 0.3, (16, 1, 3))
    points[16:28] += rng.normal(0, 0.008, (12, 3, 3))
    normals[28:] += rng.normal(0, 0.25, (12, 3, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    batch = solver.solve_batch(points, normals, diagnose=True)
    unreachable = np.flatnonzero(~batch.success)
    assert 10 <= len(unreachable) <= 36
    assert len(unreachable) + batch.success.sum() >= 38
    ratios = []
    for row in unreachable:
        diagnosis = batch.diagnoses[row]
        assert diagnosis is not None
        target = points[row], normals[row]
        best = best_of_restarts(robot, *target, diagnosis.q)
        assert largest_part(robot, *target, best) > 1
        norm = np.linalg.norm(residual(best, robot, *target))
        ratios.append(np.linalg.norm(residual(diagnosis.q, robot, *target)) / norm)
    assert np.median(ratios) < 1.01
    assert np.quantile(ratios, 0.9) < 1.5


def test_other_methods_use_hand_first(robot: ik.ArmHand, cup: tuple[Array, Array]) -> None:
    """A method that does not converge has not shown that a target is out of reach."""
    options = {"max_iterations": 2}
    paper = ik.Solver(robot, "enhanced-dls", finger_step="closed-form", options=options)
    solution = paper.solve(ik.load_grasp("cup"))
    assert not solution.success
    assert solution.status is not ik.Status.UNREACHABLE
    assert solution.diagnosis is not None
    assert solution.diagnosis.reason is ik.solve.Reason.REACHABLE
    assert "hand-first solves" in solution.diagnosis.lines[1]
    far_batch = paper.solve_batch(cup[0][None] + 3.0, cup[1][None], diagnose=True)
    assert far_batch.status_names.tolist() == ["UNREACHABLE"]


def test_nearest_contacts(solver: ik.Solver, robot: ik.ArmHand, cup: tuple[Array, Array]) -> None:
    """The nearest contacts are reachable, and the stated tolerance suffices."""
    diagnosis = diagnosed(solver, cup[0] + [0.5, 0, 0], cup[1])
    points, normals = robot.contacts(diagnosis.q)
    for i, name in enumerate(robot.fingers):
        nearest_contact = diagnosis.nearest[name]
        np.testing.assert_allclose(nearest_contact.point, points[i])
        np.testing.assert_allclose(nearest_contact.normal, normals[i])
        assert nearest_contact.position_error == pytest.approx(
            np.linalg.norm(points[i] - cup[0][i] - [0.5, 0, 0])
        )
    assert np.all((diagnosis.q >= robot.lower) & (diagnosis.q <= robot.upper))
    enough = replace(diagnosis.enough, position=diagnosis.enough.position * 1.001)
    enough = replace(enough, angle=enough.angle * 1.001)
    batch_at_nearest = ik.Solver(robot, tolerance=enough).solve_batch(
        cup[0][None] + [0.5, 0, 0], cup[1][None], diagnose=True
    )
    assert batch_at_nearest.success.all()


def impossible(robot: ik.ArmHand, count: int) -> tuple[Array, Array]:
    """Return targets of several kinds, most of them out of reach."""
    rng = np.random.default_rng(21)
    points, normals = robot.contacts(robot.random(rng, 4 * count))
    points[:count] += [1.0, 0, 0]
    points[count : 2 * count] += rng.normal(0, 0.02, (count, 3, 3))
    points[2 * count : 3 * count] *= 1.15
    normals[3 * count :, 0] *= -1
    return points, normals


def test_batch_diagnoses_match_single_ones(solver: ik.Solver, robot: ik.ArmHand) -> None:
    points, normals = impossible(robot, 4)
    batch = solver.solve_batch(points, normals, diagnose=True)
    threads = solver.solve_batch(points, normals, diagnose=True, jobs=2)
    assert (~batch.success).sum() >= 10
    for row, diagnosis in enumerate(batch.diagnoses):
        target = points[row : row + 1], normals[row : row + 1]
        single_diagnosis = solver.solve_batch(*target, diagnose=True).diagnoses[0]
        for expected_diagnosis in (single_diagnosis, threads.diagnoses[row]):
            assert (diagnosis is None) == (expected_diagnosis is None)
            if diagnosis is None or expected_diagnosis is None:
                continue
            assert diagnosis.lines == expected_diagnosis.lines
            np.testing.assert_array_equal(diagnosis.q, expected_diagnosis.q)


def test_remedies_survive_pickling(solver: ik.Solver, cup: tuple[Array, Array]) -> None:
    normals = cup[1] * np.array([[-1], [1], [1]])
    diagnosis = diagnosed(solver, cup[0], normals)
    copy = pickle.loads(pickle.dumps(diagnosis))
    assert copy.freed
    assert [item.finger for item in copy.freed] == [item.finger for item in diagnosis.released]
    assert copy.lines == diagnosis.lines
    assert copy.nearest == diagnosis.nearest


def residual(q: Array, robot: ik.ArmHand, points: Array, normals: Array) -> Array:
    """Return errors of the points divided by 0.1 m, and of the normals."""
    p, n = robot.contacts(q)
    return np.concatenate([((p - points) / 0.1).ravel(), (n - normals).ravel()])


def parts(q: Array, robot: ik.ArmHand, points: Array, normals: Array) -> Array:
    """Return every error divided by its tolerance."""
    p, n = robot.contacts(q)
    angles = 2 * np.arcsin(np.linalg.norm(n - normals, axis=1) / 2)
    return np.concatenate([np.linalg.norm(p - points, axis=1) / 5e-3, angles / np.deg2rad(3)])


def largest_part(robot: ik.ArmHand, points: Array, normals: Array, q: Array) -> float:
    """Return the largest error divided by its tolerance, minimised from q by a high power."""
    limits = robot.lower, robot.upper
    size = parts(q, robot, points, normals).max()
    fair = least_squares(
        lambda x: (parts(x, robot, points, normals) / size) ** 4, q, bounds=limits, max_nfev=40
    )
    return float(parts(fair.x, robot, points, normals).max())


def best_of_restarts(robot: ik.ArmHand, points: Array, normals: Array, q: Array) -> Array:
    """Return the best configuration of scipy from random starts and a given configuration."""
    limits = robot.lower, robot.upper
    starts = [*robot.random(np.random.default_rng(0), STARTS), np.clip(q, *limits)]
    results = [
        least_squares(residual, start, bounds=limits, max_nfev=40, args=(robot, points, normals))
        for start in starts
    ]
    return min(results, key=lambda result: result.cost).x


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> ik.ArmHand:
    """Arm with an offset elbow and without a closed form."""
    return derived_robot(tmp_path_factory.mktemp("bent"), wrist_offset=0.045)


def batch_of(
    solver: ik.Solver, points: Array, normals: Array, **options: dict[str, float]
) -> ik.BatchSolution:
    return solver.solve_batch(points, normals, diagnose=True, **options)


@pytest.mark.parametrize("finger", range(3))
def test_free_finger(robot: ik.ArmHand, cup: tuple[Array, Array], finger: int) -> None:
    """Targets that two fingers reach are never unreachable; others are too far."""
    solver, rng = ik.Solver(robot), np.random.default_rng(finger)
    q = robot.random(rng, 200)
    q = np.where(rng.random(q.shape) < 0.3, robot.upper, q)
    points, normals = robot.contacts(q)
    points[:, finger], normals[:, finger] = np.nan, np.nan
    assert batch_of(solver, points, normals).success.all()

    points, normals = cup[0][None] - [1.0, 0, 0], cup[1][None].copy()
    points[:, finger], normals[:, finger] = np.nan, np.nan
    far_batch = batch_of(solver, points, normals)
    (diagnosis,) = far_batch.diagnoses
    assert far_batch.status_names.tolist() == ["UNREACHABLE"]
    assert diagnosis is not None
    assert diagnosis.reason is ik.solve.Reason.REACH
    assert np.isnan(diagnosis.nearest[robot.fingers[finger]].position_error)
    assert robot.fingers[finger] not in {item.finger for item in diagnosis.released}


def test_fixed_actuators(robot: ik.ArmHand, cup: tuple[Array, Array]) -> None:
    """Free fingers are not remedies, and reachable targets are never unreachable."""
    solver, rng = ik.Solver(robot), np.random.default_rng(4)
    for name in ("lwr_joint_3", "bh_spread"):
        column = robot.actuators.index(name)
        value = float(0.6 * robot.lower[column] + 0.4 * robot.upper[column])
        q = robot.random(rng, 200)
        q[:, column] = value
        batch = batch_of(solver, *robot.contacts(q), fixed={name: value})
        assert batch.success.all(), batch.status_names[~batch.success]

    closed = batch_of(solver, cup[0][None], cup[1][None], fixed={"bh_spread": 2.5})
    (diagnosis,) = closed.diagnoses
    assert set(closed.status_names) <= {"UNREACHABLE", "NOT_FOUND"}
    assert diagnosis is not None
    assert diagnosis.reason is ik.solve.Reason.HAND
    assert diagnosis.q[robot.actuators.index("bh_spread")] == pytest.approx(2.5)
    for relief in diagnosis.reliefs:
        assert "bh_spread" not in relief.violations
        assert relief.q[robot.actuators.index("bh_spread")] == pytest.approx(2.5)


@pytest.mark.slow
def test_arm_without_a_closed_form(bent: ik.ArmHand) -> None:
    solver, rng = ik.Solver(bent), np.random.default_rng(5)
    batch = batch_of(solver, *bent.contacts(bent.random(rng, 150)))
    assert "UNREACHABLE" not in batch.status_names
    assert batch.success.all()

    points, normals = bent.contacts(bent.home)
    wide = points + 0.25 * np.array([[0, 1, 0], [1, -1, 0], [-1, -1, 0]])
    (diagnosis,) = batch_of(solver, wide[None], normals[None]).diagnoses
    assert diagnosis is not None
    assert diagnosis.reason is ik.solve.Reason.HAND
    assert diagnosis.established

    # The reach of such an arm is unknown: a distant target is found, but not proved.
    far_batch = batch_of(solver, points[None] + [3.0, 0, 0], normals[None])
    (diagnosis,) = far_batch.diagnoses
    assert not far_batch.success[0]
    assert diagnosis is not None
    assert diagnosis.reach is None
    assert diagnosis.reason is not ik.solve.Reason.HAND
    assert diagnosis.enough.position > 1.0


def test_a_bad_start_never_makes_it_unreachable(robot: ik.ArmHand) -> None:
    """The diagnosis starts from the result of a method that gives up at once."""
    rng = np.random.default_rng(6)
    q = robot.random(rng, 1200)
    q = np.where(rng.random(q.shape) < 0.4, robot.lower, q)
    points, normals = robot.contacts(q)
    hasty = ik.Solver(
        robot, "enhanced-dls", options={"max_iterations": 1}, finger_step="closed-form"
    )
    batch = hasty.solve_batch(points, normals, diagnose=True)
    assert not batch.success.any()
    diagnoses = [diagnosis for diagnosis in batch.diagnoses if diagnosis is not None]
    assert len(diagnoses) == len(q)
    assert {diagnosis.reason for diagnosis in diagnoses} == {ik.solve.Reason.REACHABLE}
    points_reached, _ = robot.contacts(np.stack([diagnosis.q for diagnosis in diagnoses]))
    assert np.linalg.norm(points_reached - points, axis=2).max() < 5.01e-3
