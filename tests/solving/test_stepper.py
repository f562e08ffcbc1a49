"""A solve by hand gives the iterates of the loop."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.errors import InputError, UnsupportedError


@pytest.fixture(scope="module")
def stepped_solver() -> ik.Solver:
    robot = ik.load_robot("kuka_lwr_barrett")
    return ik.Solver(robot, method="enhanced-dls", finger_step="closed-form")


def test_steps_are_those_of_the_log(stepped_solver: ik.Solver, tmp_path) -> None:
    grasp = ik.load_grasp("sugar_box")
    solution = stepped_solver.solve(grasp, log=tmp_path / "x.mcap")
    rows = ik.logs.open(tmp_path / "x.mcap").iterations().rows
    stepper = stepped_solver.stepper(grasp)
    records = list(stepper)
    assert stepper.status == solution.status
    assert stepper.iteration == len(records) == solution.iterations
    np.testing.assert_allclose(stepper.state["q"], solution.q, atol=1e-9)
    for record, row in zip(records, rows, strict=True):
        assert set(record) == set(row.dtype.names)
        np.testing.assert_allclose(record["q"], row["q"], atol=1e-9)
        assert record["phase"] == row["phase"]


def test_state_and_parameters_are_named_and_cannot_be_spoilt(stepped_solver: ik.Solver) -> None:
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
    with pytest.raises(InputError, match="q0"):
        stepped_solver.stepper(grasp, np.zeros((1, 14)))
    with pytest.raises(InputError, match="expected a Grasp"):
        stepped_solver.stepper("sugar_box")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="needs a contact"):
        stepped_solver.stepper(ik.Grasp({"thumb": ik.Contact([0.5, 0, 0.5], [1, 0, 0])}))


def test_a_method_of_another_kind_is_unsupported(monkeypatch, stepped_solver: ik.Solver) -> None:
    other = ik.Solver(stepped_solver.robot, method="enhanced-dls")
    monkeypatch.setattr("casadi_ik.api.SteppedMethod", type("Never", (), {}))
    with pytest.raises(UnsupportedError, match="cannot be stepped"):
        other.stepper(ik.load_grasp("sugar_box"))
