"""Robot, shipped grasp and its solution, made once."""

from __future__ import annotations

import pytest

import casadi_ik as ik


@pytest.fixture(scope="session")
def grasp() -> ik.Grasp:
    return ik.load_grasp("cup")


@pytest.fixture(scope="session")
def solver(robot: ik.ArmHand) -> ik.Solver:
    return ik.Solver(robot, method="enhanced-dls", finger_step="closed-form")


@pytest.fixture(scope="session")
def log(
    solver: ik.Solver, grasp: ik.Grasp, tmp_path_factory: pytest.TempPathFactory
) -> ik.logs.Log:
    path = tmp_path_factory.mktemp("log") / "cup.mcap"
    solver.solve(grasp, log=path)
    return ik.logs.open(path)


@pytest.fixture(scope="session")
def solution(solver: ik.Solver, grasp: ik.Grasp) -> ik.Solution:
    return solver.solve(grasp)
