"""The method `ipopt`: what the others are compared with."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Phase, Status

TIGHT = ik.Tolerance(position=1e-6, angle=1e-6)
ROBOTS = ("kuka_lwr_barrett", "kuka_lwr_barrett_coupled")


@pytest.fixture(scope="module")
def solver(robot):
    return ik.Solver(robot, "ipopt")


@pytest.fixture(scope="module")
def targets(robot):
    """Contacts of hands drawn at random, 10 of them."""
    return robot.contacts(robot.random(np.random.default_rng(11), 10))


def cost(batch: ik.BatchSolution) -> np.ndarray:
    """Squared errors as the method weighs them: 100 mm like one unit of the normal."""
    chords = 2 * np.sin(batch.angle_error / 2)
    return np.nansum((batch.position_error / 0.1) ** 2 + chords**2, axis=1)


@pytest.mark.parametrize("name", ROBOTS)
def test_agrees_with_hand_first(name):
    """Both solve to a micrometre, and their contacts are the same within twice that."""
    robot = ik.load_robot(name)
    points, normals = robot.contacts(robot.random(np.random.default_rng(5), 12))
    found = [
        ik.Solver(robot, method, TIGHT).solve_batch(points, normals)
        for method in ("ipopt", "hand-first")
    ]
    for batch in found:
        assert batch.success.all(), batch.status_names
        assert batch.limits_ok.all()
    ours, theirs = (robot.contacts(batch.q) for batch in found)
    np.testing.assert_allclose(ours[0], theirs[0], atol=2e-6)
    np.testing.assert_allclose(ours[1], theirs[1], atol=2e-6)


@pytest.mark.parametrize("name", ik.shipped_grasps("kuka_lwr_barrett"))
def test_shipped_grasps(name, solver):
    solution = solver.solve(ik.load_grasp(name))
    assert solution.success, solution.status


def test_impossible_contacts_are_met_no_worse_than_by_hand_first(robot, targets):
    """Half a metre out of reach, fingers torn apart, a normal turned round."""
    points, normals = (array[:3].copy() for array in targets)
    points[0] += [0.0, 0.0, 1.5]
    points[1, 0] += [0.15, 0.0, 0.0]
    normals[2, 1] *= -1
    solvers = ik.Solver(robot, "ipopt", options={"restarts": 10}), ik.Solver(robot, "hand-first")
    found = [each.solve_batch(points, normals) for each in solvers]
    assert not found[0].success.any()
    assert found[0].limits_ok.all()
    assert np.all(found[0].restarts == 10)
    assert np.all(cost(found[0]) <= cost(found[1]) * (1 + 1e-6))


def test_a_start_at_the_solution_takes_one_iteration(robot, solver, targets):
    first = solver.solve_batch(*targets)
    exact = np.flatnonzero(cost(first) < 1e-16)
    assert len(exact) >= 6
    again = solver.solve_batch(targets[0][exact], targets[1][exact], q0=first.q[exact])
    np.testing.assert_array_equal(again.iterations, 1)
    np.testing.assert_array_equal(again.restarts, 0)
    np.testing.assert_array_equal(again.q, first.q[exact])


def test_free_fingers_and_normals(robot, solver, targets):
    """What is free is not pulled anywhere: the rest is met although it could not be."""
    points, normals = (array[:4].copy() for array in targets)
    points[0, 2] = normals[0, 2] = np.nan
    points[1, 1:] = normals[1, 1:] = np.nan
    normals[2, 0] = np.nan
    normals[3] = np.nan
    batch = solver.solve_batch(points, normals)
    assert batch.success.all()
    assert np.isnan(batch.position_error[0, 2])
    assert np.isnan(batch.angle_error[2, 0])
    turned = targets[1][:4].copy()
    turned[2, 0] *= -1  # the wrong way round, so that it matters whether it counts
    assert solver.solve_batch(
        points[2:3], np.where(np.isnan(normals), normals, turned)[2:3]
    ).success[0]
    assert not solver.solve_batch(points[2:3], turned[2:3]).success[0]


def test_limits_are_never_left(robot, tmp_path, targets):
    """Neither by the answer nor by any iterate; ignored, they are no bounds."""
    path = tmp_path / "log.mcap"
    batch = ik.Solver(robot, "ipopt").solve_batch(*targets, log=path)
    q = ik.logs.open(path).iterations().rows["q"]
    assert len(q) == batch.iterations.sum()
    assert np.all((q >= robot.lower) & (q <= robot.upper))
    assert np.all((batch.q >= robot.lower) & (batch.q <= robot.upper))
    # A thumb that has to open further than it can.
    q = robot.home.copy()
    q[robot.actuators.index("bh_thumb_distal")] = -0.5
    beyond = [array[None] for array in robot.contacts(q)]
    assert not ik.Solver(robot, "ipopt", options={"restarts": 1}).solve_batch(*beyond).success[0]
    free = ik.Solver(robot, "ipopt", limits="ignore").solve_batch(*beyond)
    assert free.success[0]
    assert not free.limits_ok[0]


def test_a_row_draws_the_same_numbers_in_any_part_of_the_batch(robot, solver, targets):
    method = solver._engine.method
    problems = Problems(*targets, ik.Tolerance(), True)
    q0 = np.tile(robot.home, (10, 1))
    whole = method.run(problems, q0, 3, False)
    again = np.flatnonzero(whole.restarts > 0)
    assert len(again) >= 2, "targets that need a restart"
    for row in again[:2]:
        part = slice(int(row), int(row) + 1)
        alone = method.run(problems.rows(part), q0[part], 3, False)
        np.testing.assert_array_equal(alone.q[0], whole.q[row])
        assert alone.iterations[0] == whole.iterations[row]
    other = method.run(problems, q0, 4, False)
    assert np.any(other.q[again] != whole.q[again])
    once = np.flatnonzero(whole.restarts == 0)
    np.testing.assert_array_equal(other.q[once], whole.q[once])


def test_the_trace(robot, solver, targets):
    method = solver._engine.method
    problems = Problems(*targets, ik.Tolerance(), True)
    outcome = method.run(problems, np.tile(robot.home, (10, 1)), 0, True)
    assert outcome.restarts.max() >= 1
    for row, trace in enumerate(outcome.trace):
        assert len(trace) == outcome.iterations[row]
        assert trace["restart"][-1] == outcome.restarts[row]
        np.testing.assert_array_equal(
            np.unique(trace["restart"]), np.arange(outcome.restarts[row] + 1)
        )
        assert np.all(trace["phase"] == Phase.WHOLE_SYSTEM)
        assert np.all(trace["status"][:-1] == Status.RUNNING)
        assert trace["status"][-1] == outcome.status[row] == Status.SOLVED
        points, normals = robot.contacts(trace["q"])
        distances = np.linalg.norm(points - targets[0][row], axis=2)
        np.testing.assert_allclose(trace["position_error"], distances, atol=1e-6)
        chords = np.linalg.norm(normals - targets[1][row], axis=2)
        np.testing.assert_allclose(
            trace["cost"], np.sum((distances / 0.1) ** 2 + chords**2, axis=1), rtol=1e-6, atol=1e-12
        )
        np.testing.assert_allclose(trace["q"][-1], outcome.q[row], atol=1e-12)
        starts = np.flatnonzero(np.diff(trace["restart"])) + 1
        assert np.all(trace["barrier"][[0, *starts]] == 0.1)
        assert np.all(np.isnan(trace["step_size"][[*(starts - 1), -1]]))


def test_no_restarts_and_a_small_budget(robot, targets):
    once = ik.Solver(robot, "ipopt", options={"restarts": 0}).solve_batch(*targets)
    assert np.all(once.restarts == 0)
    assert 3 <= once.success.sum() < 10
    short = ik.Solver(robot, "ipopt", options={"restarts": 0, "max_iterations": 2})
    batch = short.solve_batch(*targets)
    assert set(batch.status_names) == {"ITERATION_LIMIT"}
    np.testing.assert_array_equal(batch.iterations, 3)
