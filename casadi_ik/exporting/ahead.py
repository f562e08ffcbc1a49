"""Kernels compiled ahead of use: by using each of them once."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Contact, Grasp

FEW = 16
"""Targets: enough for solves side by side."""

FAR = 100.0
"""How far away [m] no robot reaches."""


def uses(robot: ArmHand) -> Iterator[tuple[str, Callable[[], object]]]:
    """Everything that compiles something, in words and as what does it."""
    solver = Solver(robot)
    q = robot.random(np.random.default_rng(0), FEW)

    def targets() -> tuple[np.ndarray, np.ndarray]:
        return robot.contacts(q)

    def one() -> object:
        points, normals = (array[0] for array in targets())
        pairs = zip(robot.fingers, points, normals, strict=True)
        return solver.solve(Grasp({name: Contact(*pair) for name, *pair in pairs}))

    def beyond() -> object:
        points, normals = targets()
        return solver.solve_batch(points[:1] + FAR, normals[:1], diagnose=True)

    def logged() -> object:
        with tempfile.TemporaryDirectory() as place:
            return solver.solve_batch(*targets(), log=Path(place) / "log.mcap")

    yield "forward kinematics", targets
    yield "one target", one
    yield "batches", lambda: solver.solve_batch(*targets())
    yield "loops that cannot wait", solver.fast
    yield "logs", logged
    yield "diagnoses", beyond
