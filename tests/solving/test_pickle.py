"""What is sent to other processes arrives as what it was."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import casadi_ik as ik


@pytest.mark.parametrize("method", ["hand-first", "ipopt", "enhanced-dls"])
@pytest.mark.parametrize("again", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy])
def test_a_round_trip(method, again) -> None:
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    tolerance = {"thumb": ik.Tolerance(1e-3, 0.01)}
    solver = ik.Solver(robot, method, tolerance)
    first = solver.solve(grasp)
    other, same = again(solver), again(grasp)
    assert other.tolerances == solver.tolerances
    found = again(other.solve(same))
    np.testing.assert_array_equal(found.q, first.q)
    assert found.status is first.status
    assert again(robot).actuators == robot.actuators
    points, normals = grasp.arrays(robot.fingers)
    batch = solver.solve_batch(points[None], normals[None])
    np.testing.assert_array_equal(again(batch).q, batch.q)


def test_solvers_in_other_processes() -> None:
    joblib = pytest.importorskip("joblib")
    robot, grasp = ik.load_robot("kuka_lwr_barrett"), ik.load_grasp("cup")
    solver = ik.Solver(robot)
    with joblib.parallel_config(backend="loky"):
        found = joblib.Parallel(n_jobs=2)(joblib.delayed(solver.solve)(grasp) for _ in range(2))
    for one in found:
        np.testing.assert_array_equal(one.q, solver.solve(grasp).q)
