"""Single targets by `fast` have the same answers, bit for bit, as in a batch."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import errors


@pytest.fixture(scope="module")
def targets(robot):
    """Return targets at limits, some out of reach, some partly free."""
    rng = np.random.default_rng(7)
    q = robot.random(rng, 400)
    ends = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    points, normals = robot.contacts(np.where(rng.random(q.shape) < 0.4, ends, q))
    points[:20] += rng.normal(0, 0.02, points[:20].shape)
    normals[15:40, 1] = np.nan
    points[30:40, 1] = np.nan
    normals[40:60] *= rng.uniform(0.1, 9.0, (20, 3, 1))
    return points, normals


@pytest.mark.parametrize("limits", ["enforce", "ignore"])
@pytest.mark.parametrize("starts_near", [False, True])
def test_fast_matches_batch_bit_for_bit(robot, targets, limits, starts_near):
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-6, 1e-6), limits=limits)
    q0 = robot.home + 0.01 if starts_near else None
    fast, batch = solver.fast(), solver.solve_batch(*targets, q0=q0)
    assert batch.restarts.max() > 380, "no target went through all rounds"
    for row, target in enumerate(zip(*targets, strict=True)):
        q, status = fast(*target, q0)
        assert status == batch.status[row]
        np.testing.assert_array_equal(q, batch.q[row])
        np.testing.assert_array_equal(fast.position_error, batch.position_error[row])
        np.testing.assert_array_equal(fast.angle_error, batch.angle_error[row])


def test_one_instance_per_thread(robot, targets):
    solver = ik.Solver(robot)
    expected = solver.solve_batch(*targets).q

    def solve(_):
        fast = solver.fast()
        return np.array([fast(*target)[0].copy() for target in zip(*targets, strict=True)])

    with ThreadPoolExecutor(3) as pool:
        for answers in pool.map(solve, range(3)):
            np.testing.assert_array_equal(answers, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, n: (p[:2], n), "points: found shape"),
        (lambda p, n: (p, n * 0), "is zero"),
        (lambda p, n: (p * np.inf, n), "is infinite"),
        (lambda p, n: (p + 0j, n), "is complex"),
        (lambda p, n: ([[0.5], [0.5, 0.1]], n), "points: expected an array of numbers"),
        (lambda p, n: (p * np.nan, n), "no point"),
        (lambda p, n: (p * [1, np.nan, 1], n), "partly NaN"),
        (lambda p, n: (p * np.nan, n * np.nan), "row 0 has no contact"),
    ],
)
def test_malformed_target_is_refused(robot, targets, change, message):
    points, normals = targets[0][100], targets[1][100]
    fast = ik.Solver(robot).fast()
    with pytest.raises(errors.InputError, match=message):
        fast(*change(points, normals))
    assert fast(points, normals)[1] is ik.Status.SOLVED
    with pytest.raises(errors.InputError, match="q0"):
        fast(points, normals, np.full(14, np.nan))


def test_extreme_normal_lengths_are_accepted(robot, targets):
    points, normals = targets[0][100], targets[1][100]
    fast = ik.Solver(robot).fast()
    q = fast(points, normals)[0].copy()
    np.testing.assert_allclose(fast(points, normals * 1e-200)[0], q, atol=1e-12)


def test_works_without_a_compiler(robot, targets):
    points, normals = targets[0][100], targets[1][100]
    expected, _ = ik.Solver(robot).fast()(points, normals)
    q, status = ik.Solver(robot, compiled=False).fast()(points, normals)
    np.testing.assert_allclose(q, expected, atol=1e-9)
    assert status is ik.Status.SOLVED


def test_only_hand_first_is_fast(robot):
    with pytest.raises(errors.UnsupportedError, match=r"'hand-first'.*'thumb-first'"):
        ik.Solver(robot, method="thumb-first").fast()
