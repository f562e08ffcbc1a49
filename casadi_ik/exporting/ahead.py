"""What a robot compiles when it is first used, made to be compiled ahead."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand
from casadi_ik.collision.scene import Scene
from casadi_ik.errors import UnsupportedError
from casadi_ik.grasps import Contact, Grasp
from casadi_ik.touch.hand_table import touch_library


def uses(robot: ArmHand, everything: bool = False) -> Iterator[tuple[str, Callable[[], object]]]:
    """Ways to use a robot that compile something, in words and as what does it.

    Args:
        robot: The robot.
        everything: Whether scenes, choices, motions and diagnoses are among them.
    """
    solver = Solver(robot)
    q = robot.random(np.random.default_rng(0), 64)  # enough for solves side by side

    def targets() -> tuple[np.ndarray, np.ndarray]:
        return robot.contacts(q)

    @cache
    def grasp() -> Grasp:
        points, normals = robot.contacts(q[0])
        pairs = zip(robot.fingers, points, normals, strict=True)
        return Grasp({name: Contact(*pair) for name, *pair in pairs})

    def logged() -> object:
        with tempfile.TemporaryDirectory() as place:
            return solver.solve_batch(*targets(), log=Path(place) / "log.mcap")

    yield "forward kinematics", targets
    yield "one target", lambda: solver.solve(grasp())
    yield "limits ignored", lambda: Solver(robot, limits="ignore").solve(grasp())
    yield "batches", lambda: solver.solve_batch(*targets())
    yield "grasps of surfaces", touch_library
    if not everything:
        return

    def beyond() -> object:
        points, normals = targets()
        return solver.solve_batch(points[:1] + 100.0, normals[:1], diagnose=True)

    yield "real-time loops", solver.fast
    yield "logs", logged
    yield "diagnoses", beyond
    yield "followers", lambda: solver.follow(q[0], period=0.001)(grasp())
    try:
        about = Solver(robot, scene=Scene())
    except UnsupportedError:
        return
    yield "scenes", lambda: about.solve_batch(*targets())
    yield "choices", lambda: about.choose([grasp()] * 2, limit=1)
    yield "ways to a grasp", lambda: about.reach(grasp(), q0=q[1])
