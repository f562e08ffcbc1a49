"""Hand-first solves every reachable target, alone and in batches, compiled or not."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from samplers import (
    near_limits,
)
from toy_robots import EXACT

import casadi_ik as ik


@pytest.fixture(scope="module")
def exact(robot):
    return ik.Solver(robot, tolerance=EXACT)


def test_targets_with_a_joint_next_to_its_limit(robot, exact, rng):
    """Swivel intervals of a few thousandths of a degree are found, which sampling would miss."""
    q = robot.random(rng, 400)
    joint = rng.integers(0, 7, len(q))
    side = rng.integers(0, 2, len(q)).astype(bool)
    rows, margin = np.arange(len(q)), np.radians(0.003)
    q[rows, joint] = np.where(side, robot.lower[joint] + margin, robot.upper[joint] - margin)
    batch = exact.solve_batch(*robot.contacts(q))
    assert batch.success.all()
    # Most of them skip the whole-system stage, because the closed form has found the interval.
    assert np.mean(batch.phases["refinement"] == 0) > 0.9


def test_without_limits_everything_is_solved_too(robot, rng):
    solver = ik.Solver(robot, tolerance=EXACT, limits="ignore")
    assert solver.solve_batch(*robot.contacts(near_limits(robot, rng, 200))).success.all()


def test_unreachable_contacts_are_approached(robot, exact, rng):
    """An unsolved answer is finite, within limits and stretched towards the target."""
    points, normals = robot.contacts(robot.random(rng, 20))
    offsets = points.mean(axis=1, keepdims=True)
    points = points + 2.0 * offsets / np.linalg.norm(offsets, axis=2, keepdims=True)
    batch = exact.solve_batch(points, normals)
    assert not batch.success.any()
    assert np.isfinite(batch.q).all()
    assert batch.limits_ok.all()
    assert (batch.position_error.mean(axis=1) < np.linalg.norm(points.mean(axis=1), axis=1)).all()


@pytest.mark.slow
def test_optimisation_changes_no_bit(robot, rng, monkeypatch):
    # Each order compiles only one of the two kernels: single solves for arms, lanes for hands.
    hand = ik.load_robot("ar10")
    with_arm = robot.contacts(robot.random(rng, 20))
    single_points = hand.contacts(hand.random(rng, 100))

    def answers() -> bytes:
        fast, q = ik.Solver(robot).fast(), []
        for points, normals in zip(*with_arm, strict=True):
            answers_found, status = fast(points, normals)
            assert status == ik.Status.SOLVED
            q.append(answers_found.copy())
        batch = ik.Solver(hand).solve_batch(*single_points)
        assert batch.success.all()
        return np.array(q).tobytes() + batch.q.tobytes() + batch.iterations.tobytes()

    monkeypatch.setenv("CASADI_IK_CFLAGS", "-O0")
    plain = answers()
    monkeypatch.delenv("CASADI_IK_CFLAGS")
    assert answers() == plain


@pytest.mark.parametrize("offset", [0.0, 0.045], ids=["closed form", "none"])
def test_uncompiled_restart_is_the_same(tmp_path, rng, offset):
    robot = derived_robot(tmp_path, wrist_offset=offset)
    q, usual = robot.random(rng, 25), ik.Tolerance()
    points, normals = robot.contacts(q)
    points += rng.normal(0, 0.005, points.shape)
    starts = np.where(np.arange(25)[:, None] % 2, robot.home, q + 0.02)
    statuses = set()
    for prefer, tolerance in (("limits", usual), ("limits", EXACT), ("q0", usual)):
        fast, slow = (
            ik.Solver(
                robot, tolerance=tolerance, compiled=compiled, options={"max_rounds": 1}
            ).solve_batch(points, normals, q0=starts, prefer=prefer)
            for compiled in (True, False)
        )
        np.testing.assert_array_equal(fast.status, slow.status)
        np.testing.assert_array_equal(fast.restarts, slow.restarts)
        if prefer == "limits":  # of several that are near, the last places of a sine may decide
            np.testing.assert_allclose(fast.q, slow.q, atol=1e-7)
        statuses |= {name for name, count in fast.phases.items() if count.any()}
    # Few targets reach the balance, which follows the tolerant fits.
    assert statuses | {"balance"} == set(fast.phases) - ({"arm-choice"} if offset else set())


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_unreachable_targets_end_the_same_alone_and_in_a_batch(ar10, rng, prefer):
    """All restarts are made for an unreachable target."""
    points, normals = ar10.contacts(ar10.random(rng, 6))
    points = points + rng.normal(0, 0.008, points.shape)
    solver = ik.Solver(ar10)
    batch = solver.solve_batch(points, normals, prefer=prefer)
    assert not batch.success.all()
    assert batch.restarts.max() > 100
    fast_solver = solver.fast()
    for row in range(len(points)):
        q, _ = fast_solver(points[row], normals[row], ar10.home if prefer == "q0" else None)
        np.testing.assert_array_equal(q, batch.q[row])
        single_batch = solver.solve_batch(
            points[row : row + 1], normals[row : row + 1], prefer=prefer
        )
        for name in ("q", "status", "restarts", "iterations"):
            assert np.array_equal(getattr(single_batch, name)[0], getattr(batch, name)[row])
        assert {name: phase_times[row] for name, phase_times in batch.phases.items()} == {
            name: phase_times[0] for name, phase_times in single_batch.phases.items()
        }
