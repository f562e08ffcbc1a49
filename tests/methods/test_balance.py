"""Least-squares balance of contradictory contacts."""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import grasp_of, moved_targets

import casadi_ik as ik

TOLERANCE = ik.Tolerance()
THREE = ("index", "thumb", "middle")
ALL = "kuka_lwr_barrett"
"""Robots of which all fingers have contacts."""


def displaced(robot, rng, count, part, fingers=None):
    """Return contacts of configurations, displaced by a part of the tolerance."""
    contacts = robot.contacts(robot.random(rng, count))
    points, normals = moved_targets(
        contacts, rng, part * TOLERANCE.position, part * TOLERANCE.angle
    )
    free = [name not in (fingers or robot.fingers) for name in robot.fingers]
    points[:, free] = normals[:, free] = np.nan
    return points, normals


def noisy(robot, rng, count):
    """Return noisy contacts as of a camera; about one in fifty cannot be met."""
    points, normals = robot.contacts(robot.random(rng, count))
    normals = normals + rng.normal(0, np.radians(2.0), normals.shape)
    return points + rng.normal(0, 4e-3, points.shape), normals


@pytest.mark.parametrize(
    ("name", "count", "fingers"),
    [(ALL, 2000, None), ("ar10", 200, THREE), ("baxter_ar10", 200, THREE)],
)
def test_reachable_underactuated_targets_are_solved(name, count, fingers):
    """Least squares alone missed 1.2, 54 and 3.4 % of them."""
    robot = ik.load_robot(name)
    points, normals = displaced(robot, np.random.default_rng(1), count, 0.98, fingers)
    batch = ik.Solver(robot).solve_batch(points, normals)
    assert np.flatnonzero(~batch.success).tolist() == []


def test_limits_and_fixed_actuators_are_kept(robot):
    points, normals = noisy(robot, np.random.default_rng(3), 500)
    free = ik.Solver(robot).solve_batch(points, normals)
    balanced = np.flatnonzero((free.phases["balance"] > 0) & free.success)
    assert len(balanced)
    assert ((free.q >= robot.lower) & (free.q <= robot.upper)).all()
    spread, fixed_count = robot.actuators.index("bh_spread"), 0
    for row in balanced[:20]:
        value = float(
            np.clip(free.q[row, spread] + 0.005, robot.lower[spread], robot.upper[spread])
        )
        row_slice = slice(row, row + 1)
        batch = ik.Solver(robot).solve_batch(
            points[row_slice], normals[row_slice], fixed={"bh_spread": value}
        )
        assert batch.q[0, spread] == value
        fixed_count += batch.phases["balance"].sum()
    assert fixed_count


def test_results_are_independent_of_batch_and_blocks(robot):
    solver = ik.Solver(robot)
    points, normals = noisy(robot, np.random.default_rng(5), 300)
    batch = solver.solve_batch(points, normals)
    blocks = [(points[:100], normals[:100]), (points[100:], normals[100:])]
    streamed = np.concatenate([block.solution.q for block in solver.solve_blocks(blocks)])
    np.testing.assert_array_equal(streamed, batch.q)
    rows = np.flatnonzero(batch.phases["balance"])[:8]
    assert len(rows)
    for row in rows:
        solution = solver.solve(grasp_of(robot, points[row], normals[row]), diagnose=False)
        # A grasp normalises its normals, so that the last digit may differ.
        np.testing.assert_allclose(solution.q, batch.q[row], atol=1e-6)
        assert solution.success == batch.success[row]


def test_repeated_infeasible_minima_end_table_restarts(robot):
    """Unreachable targets once used all restarts and up to 60 steps of a balance."""
    points, normals = noisy(robot, np.random.default_rng(11), 1000)
    solver = ik.Solver(robot)
    batch = solver.solve_batch(points, normals)
    missed = ~batch.success
    assert missed.sum() >= 10
    # Two or three restarts from tables suffice instead of six.
    given_up = 8 * (2 + 3 + 2) - 1
    assert given_up <= np.median(batch.restarts[missed]) <= given_up + 8
    assert np.median(batch.phases["balance"][missed]) < 15
    patient = ik.Solver(robot, options={"same_minimum": (10**6, 10**6), "far_cost": (1e9, 1e9)})
    assert not patient.solve_batch(points[missed], normals[missed]).success.any()
    row = np.flatnonzero(missed)[batch.restarts[missed] == given_up][0]
    grasp = grasp_of(robot, points[row], normals[row])
    assert max(record["restart"] for record in solver.stepper(grasp)) <= given_up + 1


def test_distant_misses_are_not_balanced(robot):
    points, normals = noisy(robot, np.random.default_rng(7), 20)
    points[:, 0] += 0.5
    batch = ik.Solver(robot).solve_batch(points, normals)
    assert not batch.success.any()
    assert not batch.phases["balance"].any()
