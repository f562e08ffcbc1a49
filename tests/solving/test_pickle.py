"""Results and solvers survive sending to other processes."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import casadi_ik as ik


@pytest.mark.parametrize("method", ["hand-first", "ipopt", "enhanced-dls"])
@pytest.mark.parametrize("copy_of", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy])
def test_a_round_trip(method, copy_of) -> None:
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    tolerance = {"thumb": ik.Tolerance(1e-3, 0.01)}
    solver = ik.Solver(robot, method, tolerance)
    first = solver.solve(grasp)
    solver_copy, grasp_copy = copy_of(solver), copy_of(grasp)
    assert solver_copy.tolerances == solver.tolerances
    solution = copy_of(solver_copy.solve(grasp_copy))
    np.testing.assert_array_equal(solution.q, first.q)
    assert solution.status is first.status
    assert copy_of(robot).actuators == robot.actuators
    points, normals = grasp.arrays(robot.fingers)
    batch = solver.solve_batch(points[None], normals[None])
    np.testing.assert_array_equal(copy_of(batch).q, batch.q)


def test_solvers_in_other_processes() -> None:
    joblib = pytest.importorskip("joblib")
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    solver = ik.Solver(robot)
    with joblib.parallel_config(backend="loky"):
        solutions = joblib.Parallel(n_jobs=2)(joblib.delayed(solver.solve)(grasp) for _ in range(2))
    for solution in solutions:
        np.testing.assert_array_equal(solution.q, solver.solve(grasp).q)
