"""Success depends on the target alone, not on options that order or explain answers."""

from __future__ import annotations

import numpy as np
import pytest
from toy_robots import grasps_of, moved_targets

import casadi_ik as ik

COUNT = 12
SHARE = 0.8
"""Fraction of the tolerance by which contacts are displaced from those of a configuration."""

TOLERANCES = [ik.Tolerance(5e-3, np.deg2rad(angle)) for angle in (3, 30)]


@pytest.fixture(scope="module", params=["kuka_lwr_barrett", "ur10e+robotiq_2f85", "dclaw"])
def robot(request) -> ik.ArmHand:
    """Robots: an arm with a three-finger hand, an arm with a gripper, and a hand alone."""
    return ik.load_robot(request.param)


def displaced_targets(robot: ik.ArmHand, tolerance: ik.Tolerance) -> tuple:
    """Return contacts (k, f, 3) of random configurations, displaced within the tolerance."""
    rng = np.random.default_rng(7)
    targets = robot.contacts(robot.random(rng, COUNT))
    return moved_targets(targets, rng, SHARE * tolerance.position, SHARE * tolerance.angle)


def unsolved(robot: ik.ArmHand, tolerance: ik.Tolerance) -> dict[str, list[int]]:
    """Return the numbers of the targets that a call does not solve, by call."""
    points, normals = displaced_targets(robot, tolerance)
    solver, grasps = ik.Solver(robot, tolerance=tolerance), grasps_of(robot, points, normals)
    q0 = robot.random(np.random.default_rng(8), COUNT)
    virtual = ik.Solver(robot, tolerance=tolerance, compiled=False)
    fast, order = solver.fast(), np.random.default_rng(9).permutation(COUNT)
    success = {
        "solve": [solver.solve(grasp).success for grasp in grasps],
        "solve without diagnosis": [
            solver.solve(grasp, diagnose=False).success for grasp in grasps
        ],
        "fingers in another order": [
            solver.solve(ik.Grasp(dict(reversed(grasp.contacts.items())))).success
            for grasp in grasps
        ],
        "solve_batch": solver.solve_batch(points, normals).success,
        "solve_batch with diagnosis": solver.solve_batch(points, normals, diagnose=True).success,
        "two jobs": solver.solve_batch(points, normals, jobs=2).success,
        "rows in another order": solver.solve_batch(points[order], normals[order]).success[
            np.argsort(order)
        ],
        "q0": solver.solve_batch(points, normals, q0=q0).success,
        "fast": [
            fast(*target)[1] == ik.Status.SOLVED for target in zip(points, normals, q0, strict=True)
        ],
        "choose": [bool(len(solver.choose([grasp]))) for grasp in grasps],
        "solve_all": [bool(solver.solve_all(grasp, limit=1)) for grasp in grasps],
        "virtual machine": virtual.solve_batch(points, normals, diagnose=True).success,
    }
    success |= {
        f"prefer {name}": solver.solve_batch(points, normals, q0=q0, prefer=name).success
        for name in ("q0", "limits", "manipulability")
        if name != "manipulability" or robot.description.arm_actuators
    }
    return {
        call: np.flatnonzero(~np.asarray(is_solved)).tolist() for call, is_solved in success.items()
    }


@pytest.mark.parametrize("tolerance", TOLERANCES, ids=["3 deg", "30 deg"])
def test_success_depends_on_the_target_only(robot, tolerance):
    """The configuration that generated a target solves it."""
    failures = {call: rows for call, rows in unsolved(robot, tolerance).items() if rows}
    assert not failures
