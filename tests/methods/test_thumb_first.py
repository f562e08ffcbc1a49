"""The thumb-first method solves from one start, within limits, with a truthful trace."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import thumb_of
from samplers import shipped_hands
from toy_robots import EXACT

import casadi_ik as ik

DEFAULT_TOLERANCE = ik.Tolerance()


STARTS = 32
"""Default number of starts of a solve."""


def thumb_first(
    robot, tolerance=DEFAULT_TOLERANCE, limits="enforce", compiled=True, **options
) -> ik.Solver:
    return ik.Solver(
        robot, "thumb-first", tolerance, limits=limits, compiled=compiled, options=options
    )


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    return thumb_first(robot)


@pytest.fixture(scope="module")
def single_start(robot) -> ik.Solver:
    return thumb_first(robot, starts=1)


def bent(robot, rng, count):
    """Return hands of the shipped grasps with distal joints at 25 to 45 deg, on random arms."""
    q = shipped_hands(robot, rng, count)
    distal = [i for i, name in enumerate(robot.actuators) if name.endswith("_distal")]
    q[:, distal] = np.radians(rng.uniform(25, 45, (count, len(distal))))
    return q


@pytest.mark.parametrize("hands", [shipped_hands, bent])
def test_single_start_usually_suffices(robot, single_start, rng, hands):
    batch = single_start.solve_batch(*robot.contacts(hands(robot, rng, 600)))
    assert batch.success.mean() >= 0.995
    assert batch.limits_ok.all()
    assert not batch.restarts.any()


@pytest.mark.parametrize(
    ("hands", "tolerance", "min_solved"),
    [
        *(
            (hands, tolerance, 1)
            for hands in (shipped_hands, bent)
            for tolerance in (DEFAULT_TOLERANCE, EXACT)
        ),
        # Hand postures that are not grasps.
        (ik.ArmHand.random, DEFAULT_TOLERANCE, 0.995),
        (ik.ArmHand.random, EXACT, 0.98),
    ],
)
def test_restarts_solve_the_others(robot, rng, hands, tolerance, min_solved):
    solver = thumb_first(robot, tolerance)
    batch = solver.solve_batch(*robot.contacts(hands(robot, rng, 300)))
    assert batch.success.mean() >= min_solved


def test_limits_ignored(robot, rng):
    solver = thumb_first(robot, limits="ignore")
    batch = solver.solve_batch(*robot.contacts(robot.random(rng, 100)))
    assert batch.success.all()


def test_nearest_solution_is_chosen(robot, solver, rng):
    """The answers once were as far from q0 as without it, and some targets were missed."""
    q, q0 = robot.random(rng, 400), robot.random(rng, 400)
    targets = robot.contacts(q)
    near_batch = solver.solve_batch(*targets, q0=q0)
    limits_batch = solver.solve_batch(*targets, q0=q0, prefer="limits")
    assert near_batch.success.all()
    assert limits_batch.success.mean() > 0.995
    np.testing.assert_array_equal(limits_batch.q, solver.solve_batch(*targets).q)
    ranges = robot.upper - robot.lower
    distances = [
        np.linalg.norm((batch.q - q0) / ranges, axis=1) for batch in (near_batch, limits_batch)
    ]
    assert (distances[0] <= distances[1]).mean() > 0.9
    close = np.clip(q + rng.uniform(-0.02, 0.02, q.shape) * ranges, robot.lower, robot.upper)
    close_batch = solver.solve_batch(*targets, q0=close)
    assert close_batch.success.all()
    assert np.median(np.abs((close_batch.q - close) / ranges).max(axis=1)) < 0.05


def test_slightly_inconsistent_contacts_are_balanced(robot, solver, rng):
    """Before, 71 % of them were solved."""
    points, normals = robot.contacts(robot.random(rng, 500))
    points = points + rng.normal(0, 4e-3, points.shape)
    normals = normals + rng.normal(0, np.radians(2), normals.shape)
    batch = solver.solve_batch(points, normals)
    assert batch.success.mean() > 0.94
    assert batch.phases["balance"].any()
    assert batch.limits_ok.all()


def test_unreachable_targets_keep_the_best(robot, solver, rng):
    points, normals = robot.contacts(robot.random(rng, 10))
    batch = solver.solve_batch(points + np.array([3.0, 0, 0]), normals)
    assert not batch.success.any()
    assert (batch.status == ik.Status.STALLED).all()
    assert (batch.restarts == STARTS - 1).all()
    assert batch.limits_ok.all()


def test_the_start_chooses_between_hands(robot, single_start, rng):
    """The search starts with the hand near q0 when several hands have the same contacts."""
    q = robot.random(rng, 200)
    around = np.clip(q + rng.normal(0, 0.3, q.shape), robot.lower, robot.upper)
    starts = (robot.home, around)
    batches = [single_start.solve_batch(*robot.contacts(q), q0=q0, prefer="q0") for q0 in starts]
    hand = list(robot.description.hand_actuators)
    from_home, from_truth = (np.abs(batch.q - q)[:, hand].max(axis=1) for batch in batches)
    assert np.median(from_truth) < np.median(from_home)


def test_palm_is_fixed_without_an_arm(coupled_robot, rng):
    q = coupled_robot.random(rng, 100)
    batch = thumb_first(coupled_robot).solve_batch(*coupled_robot.contacts(q))
    assert batch.success.mean() >= 0.95
    assert not batch.phases["arm-placement"].any()


def test_proxqp_solves_equally_well(robot, single_start, rng):
    """The quadratic program gives the same result: fixing joints one by one loses nothing."""
    targets = robot.contacts(shipped_hands(robot, rng, 60))
    program = thumb_first(robot, starts=1, step="proxqp")
    single_batch, program_batch = single_start.solve_batch(*targets), program.solve_batch(*targets)
    np.testing.assert_array_equal(single_batch.success, program_batch.success)
    assert program_batch.limits_ok.all()
    assert np.mean(single_batch.iterations == program_batch.iterations) > 0.8


@pytest.mark.parametrize("joints", [1, 3, 4])
def test_thumbs_with_any_number_of_joints(tmp_path, rng, joints):
    robot = thumb_of(tmp_path, joints)
    solver = thumb_first(robot, compiled=False, starts=8)
    batch = solver.solve_batch(*robot.contacts(robot.random(rng, 20)))
    assert batch.success.mean() >= 0.9
    assert batch.limits_ok.all()
