"""The solution nearest to the current configuration: small motions, and paths without jumps.

Most tests use the virtual machine, whose iterates are those of compiled code.
"""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import EXACT, grasp_at

import casadi_ik as ik
from casadi_ik import errors


def distance(robot, q, q0):
    """Return the Euclidean distance with every motor divided by its range."""
    return np.linalg.norm((q - q0) / (robot.upper - robot.lower), axis=-1)


def path(robot, rng, steps):
    """Return configurations along a smooth motion whose contacts move by about 0.25 mm per step."""
    start = robot.lower + (robot.upper - robot.lower) * rng.uniform(0.3, 0.7, len(robot.lower))
    direction = rng.normal(size=len(start)) * (robot.upper - robot.lower)
    points = [robot.contacts(start + sign * 1e-6 * direction)[0] for sign in (0, 1)]
    speed = np.linalg.norm(points[1] - points[0], axis=-1).max() / 1e-6
    return start + np.arange(steps)[:, None] * direction * 0.25e-3 / speed


def test_small_path_steps_cause_no_jump(robot, rng):
    """Before, the largest step was 208 degrees."""
    solver = ik.Solver(robot, tolerance=EXACT, compiled=False)
    for _ in range(4):
        path_targets = path(robot, rng, 40)
        q = path_targets[0]
        for target in path_targets[1:]:
            points, normals = robot.contacts(target)
            batch = solver.solve_batch(points[None], normals[None], q0=q)
            assert batch.success.all()
            assert np.abs(batch.q[0] - q).max() < np.radians(3)
            q = batch.q[0]


def test_preference_for_q0_is_nearer_and_solves_all(robot, rng):
    q, q0 = robot.random(rng, 300), robot.random(rng, 300)
    solver, targets = ik.Solver(robot, tolerance=EXACT, compiled=False), robot.contacts(q)
    near_batch = solver.solve_batch(*targets, q0=q0)
    limits_batch = solver.solve_batch(*targets, q0=q0, prefer="limits")
    assert near_batch.success.all()
    assert limits_batch.success.all()
    nearer = distance(robot, near_batch.q, q0) <= distance(robot, limits_batch.q, q0) + 1e-6
    assert nearer.mean() > 0.98
    np.testing.assert_array_equal(limits_batch.q, solver.solve_batch(*targets).q)


def test_nearest_known_solution_is_chosen(robot, rng):
    q, q0 = robot.random(rng, 12), robot.random(rng, 12)
    solver = ik.Solver(robot, tolerance=EXACT, compiled=False)
    batch = solver.solve_batch(*robot.contacts(q), q0=q0)
    min_distances = [
        solver.solve_all(grasp_at(robot, q_row), prefer="q0", q0=start, limit=1)[0].distance
        for q_row, start in zip(q, q0, strict=True)
    ]
    ratio = distance(robot, batch.q, q0) / np.array(min_distances)
    assert np.median(ratio) < 1.01


def test_manipulability_preference(robot, rng):
    q = robot.random(rng, 3)
    solver = ik.Solver(robot, compiled=False)
    targets = robot.contacts(q)
    best = solver.solve_batch(*targets, prefer="manipulability")
    usual = solver.solve_batch(*targets)
    assert best.success.all()
    finder = solver._engine.finder
    assert (
        finder._manipulability_values(best.q) >= finder._manipulability_values(usual.q) * (1 - 1e-9)
    ).all()


def test_invalid_preferences_are_refused(robot):
    q = robot.home
    with pytest.raises(errors.InputError, match=r"prefer:.*'near'"):
        ik.Solver(robot, compiled=False).solve(grasp_at(robot, q), prefer="near")
    with pytest.raises(errors.UnsupportedError, match=r"prefer: .*'ipopt'"):
        ik.Solver(robot, "ipopt").solve(grasp_at(robot, q), q0=q, prefer="q0")
