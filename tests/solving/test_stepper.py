"""A solve by single steps gives the iterates of the loop."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from toy_robots import grasp_of

import casadi_ik as ik
from casadi_ik import errors

STEPPED = [name for name in ik.METHODS if name != "ipopt"]


@pytest.fixture(scope="module")
def stepped_solver(robot) -> ik.Solver:
    return ik.Solver(robot, method="enhanced-dls", finger_step="closed-form")


def same_as_the_log(solver: ik.Solver, grasp: ik.Grasp, path: Path) -> ik.Solution:
    """The steps are the iterations in the log, and have the same end."""
    solution = solver.solve(grasp, log=path, diagnose=False)
    rows = ik.logs.open(path).iterations().rows
    stepper = solver.stepper(grasp)
    records = list(itertools.islice(stepper, solution.iterations))
    assert len(records) == len(rows) == solution.iterations
    if solution.status is not ik.Status.ITERATION_LIMIT:
        assert stepper.status == solution.status
    np.testing.assert_array_equal(stepper.state["q"], solution.q)
    for record, row in zip(records, rows, strict=True):
        assert set(record) <= set(row.dtype.names)
        # The other fields of a log are measured on finished traces.
        extra_fields = set(row.dtype.names) - set(record)
        assert all(name.startswith(("sigma_", "condition_")) for name in extra_fields)
        np.testing.assert_array_equal(record["q"], row["q"])
        for name in ("phase", "status"):
            assert record[name] == row[name]
    return solution


@pytest.mark.parametrize("method", STEPPED)
def test_steps_match_the_log(robot, method: str, tmp_path) -> None:
    options = {"max_iterations": 60} if method.startswith("original") else {}
    solver = ik.Solver(robot, method, finger_step="closed-form", options=options)
    same_as_the_log(solver, ik.load_grasp("sugar_box"), tmp_path / "x.mcap")


@pytest.mark.parametrize("method", ["hand-first", "thumb-first"])
def test_steps_cover_all_restarts(robot, method: str, tmp_path) -> None:
    """A target out of reach uses all starts, by steps as in the loop."""
    solver = ik.Solver(robot, method)
    points, normals = ik.load_grasp("sugar_box").arrays(robot.fingers)
    far_grasp = grasp_of(robot, points + np.array([0.0, 0.0, 3.0]), normals)
    solution = same_as_the_log(solver, far_grasp, tmp_path / "x.mcap")
    assert solution.status is ik.Status.STALLED
    # Six restarts of eight hands from tables and five global ones.
    expected = 8 * (6 + 5) if method == "hand-first" else 32
    assert solution.restarts == expected - 1


def test_state_and_parameters_are_named_and_read_only(stepped_solver: ik.Solver) -> None:
    grasp = ik.load_grasp("sugar_box")
    robot = stepped_solver.robot
    q0 = robot.home + 0.01
    stepper = stepped_solver.stepper(grasp, q0)
    np.testing.assert_array_equal(stepper.state["q"], q0)
    points, _ = grasp.arrays(robot.fingers)
    np.testing.assert_array_equal(stepper.parameters["points"], points)
    stepper.state["q"][:] = 7.0
    stepper.parameters["points"][:] = 7.0
    np.testing.assert_array_equal(stepper.state["q"], q0)
    np.testing.assert_array_equal(stepper.parameters["points"], points)


def test_bad_input_is_refused(stepped_solver: ik.Solver) -> None:
    grasp = ik.load_grasp("sugar_box")
    with pytest.raises(errors.InputError, match="q0"):
        stepped_solver.stepper(grasp, np.zeros((1, 14)))
    with pytest.raises(errors.InputError, match="Grasp"):
        stepped_solver.stepper("sugar_box")  # type: ignore[arg-type]
    with pytest.raises(errors.InputError, match="points: row 0 "):
        stepped_solver.stepper(ik.Grasp({"thumb": ik.Contact([0.5, 0, 0.5], [1, 0, 0])}))


def test_unsteppable_methods_say_why(stepped_solver: ik.Solver) -> None:
    ipopt_solver = ik.Solver(stepped_solver.robot, method="ipopt")
    with pytest.raises(errors.UnsupportedError, match="Ipopt"):
        ipopt_solver.stepper(ik.load_grasp("sugar_box"))
