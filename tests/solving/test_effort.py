"""Effort for unreachable targets, and the hint for q0 in degrees."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import errors

CANDIDATES = 8
"""Hand postures per restart."""


@pytest.fixture(scope="module")
def far_targets(robot):
    """Return contacts that can nearly be reached, and some that can."""
    rng = np.random.default_rng(7)
    points, normals = robot.contacts(robot.random(rng, 60))
    points[:30] += rng.normal(0, 0.02, points[:30].shape)
    return points, normals


def test_restarts_are_limited(robot, far_targets):
    usual = ik.Solver(robot).solve_batch(*far_targets)
    solver = ik.Solver(robot, options={"max_rounds": 1})
    batch, fast = solver.solve_batch(*far_targets), solver.fast()
    assert usual.restarts.max() >= CANDIDATES
    assert batch.restarts.max() < CANDIDATES
    assert batch.success[30:].all()
    for q0 in (None, robot.home):
        near_batch = solver.solve_batch(*far_targets, q0=q0)
        assert near_batch.restarts.max() < CANDIDATES
        for row in range(40):
            q, status = fast(far_targets[0][row], far_targets[1][row], q0)
            assert status == near_batch.status[row]
            np.testing.assert_array_equal(q, near_batch.q[row])


def test_invalid_limits_are_refused(robot):
    for value in (0, -1, 1.5, True):
        with pytest.raises(errors.InputError, match="expected a whole number >= 1"):
            ik.Solver(robot, options={"max_rounds": value})
    with pytest.raises(errors.UnknownNameError, match="'max_rounds'"):
        ik.Solver(robot, "enhanced-dls", options={"max_rounds": 1})


def test_palms_out_of_the_arms_reach_are_not_searched(robot, rng):
    """Unreachable palms once used all restarts although the hand is fixed: up to 100 ms each."""
    q = robot.random(rng, 80)
    palms = robot.palm(q)
    palms[40:, :3, 3] *= 1.0 / np.linalg.norm(palms[40:, :3, 3], axis=1, keepdims=True) * 1.6
    solver = ik.Solver(robot)
    batch = solver.solve_palms(palms, q)
    assert batch.success[:40].all()
    assert not batch.success[40:].any()
    assert batch.restarts.max() < CANDIDATES
    # A palm at the edge of its tolerance gets the same effort.
    straight = np.zeros(len(robot.lower))
    straight[7:] = robot.home[7:]
    end = robot.palm(straight)[None]
    end[0, :3, 3] += [0.0, 0.0, 4.9e-3]
    assert solver.solve_palms(end, straight).success.all()


def test_postures_are_names_or_whole_configurations(robot, rng):
    q = robot.random(rng, 5)
    solver, palms = ik.Solver(robot), robot.palm(q)
    named = solver.solve_palms(palms, dict(zip(robot.actuators[7:], q[:, 7:].T, strict=True)))
    np.testing.assert_array_equal(solver.solve_palms(palms, q).q, named.q)
    np.testing.assert_array_equal(solver.solve_palms(palms[:1], q[0]).q, named.q[:1])
    with pytest.raises(errors.InputError, match=r"postures:.*\(5, 7\).*\(14,\)"):
        solver.solve_palms(palms, q[:, 7:])
    with pytest.raises(errors.InputError, match=r"postures:.*'open'"):
        solver.solve_palms(palms, "open")


def test_fast_answer_is_not_overwritten(robot, far_targets):
    fast = ik.Solver(robot).fast()
    first, _ = fast(far_targets[0][40], far_targets[1][40])
    answer_before = first.copy()
    fast(far_targets[0][41], far_targets[1][41])
    np.testing.assert_array_equal(first, answer_before)


def test_q0_in_degrees_is_detected(robot):
    grasp, solver = ik.load_grasp("cup"), ik.Solver(robot)
    message = "q0: lwr_joint_2 is 30 rad, far beyond its limits .* rad; degrees are np.deg2rad"
    with pytest.warns(UserWarning, match=message):
        solver.solve(grasp, q0=np.rad2deg(robot.home))
    points, normals = robot.contacts(robot.home[None])
    with pytest.warns(UserWarning, match=message):
        solver.solve_batch(points, normals, q0=np.rad2deg(robot.home)[None])
    assert solver.solve(grasp, q0=robot.upper + 0.5).success  # beyond, and no degrees
