"""Targets with the answers of this package: what an exported solver is tested and shown by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.api import Solver
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.exporting.targets import SceneTargets
from casadi_ik.exporting.single import in_single_precision
from casadi_ik.grasps.load import load_grasp, shipped_grasps
from casadi_ik.kernels.codegen import number, numbers

COUNT = 1000
"""How many are stored."""

BEYOND = 10
"""Of these, how many are moved out of reach: they go through all rounds."""

SEED = 17

WHOLE = ("status", "iterations", "restarts")


@dataclass(frozen=True, eq=False)
class Example:
    """One target.

    Attributes:
        what: What it is, in words.
        points: (f, 3) [m].
        normals: (f, 3), NaN where free.
    """

    what: str
    points: Array
    normals: Array


def example(robot: ArmHand) -> Example:
    """The robot's first shipped grasp, or where its fingertips are when it is at home."""
    names = shipped_grasps(robot.name)
    if names:
        grasp = load_grasp(names[0])
        points, normals = grasp.arrays(robot.fingers)
        if not np.isnan(points).any() and not grasp.more(robot.fingers):
            return Example(f"Solves the shipped grasp {names[0]}.", points, normals)
    return Example("Solves what the fingertips touch at home.", *robot.contacts(robot.home))


def stored(solver: Solver, scene: SceneTargets | None = None) -> list[dict[str, Any]]:
    """`COUNT` targets and the answers to them; q0 None: at home, and far from limits is wanted."""
    robot = solver.robot
    rng = np.random.default_rng(SEED)
    q = robot.random(rng, COUNT)
    ends = np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper)
    points, normals = robot.contacts(np.where(rng.random(q.shape) < 0.2, ends, q))
    points[:BEYOND] += rng.normal(0, 0.1, points[:BEYOND].shape)
    near = np.arange(COUNT) % 4 == 1
    q0 = np.clip(q + 0.1, robot.lower, robot.upper)
    found: list[dict[str, Any]] = [{} for _ in range(COUNT)]
    for rows, starts in ((~near, None), (near, q0[near])):
        batch = solver.solve_batch(points[rows], normals[rows], q0=starts)
        for i, row in enumerate(np.flatnonzero(rows).tolist()):
            found[row] = {
                "q0": None if starts is None else starts[i].tolist(),
                "points": points[row].ravel().tolist(),
                "normals": normals[row].ravel().tolist(),
                "q": batch.q[i].tolist(),
                "status": int(batch.status[i]),
                "iterations": int(batch.iterations[i]),
                "restarts": int(batch.restarts[i]),
            }
    return found if scene is None else [scene.answered(target) for target in found]


def targets_header(solver: Solver, scene: SceneTargets | None = None) -> str:
    """A C header with the `stored` targets."""
    robot = solver.robot
    f, n = len(robot.fingers), len(robot.actuators)
    rows = []
    for target in stored(solver, scene):
        whole = (target["q0"] is not None, *(target[name] for name in WHOLE))
        q0 = target["q0"] or robot.home.tolist()
        arrays = map(numbers, (target["points"], target["normals"], q0, target["q"]))
        if scene is not None:
            clearance = target["clearance"]
            arrays = (*arrays, "NAN" if clearance is None else number(clearance))
        rows.append("{" + ", ".join([*(str(int(value)) for value in whole), *arrays]) + "},\n")
    return (
        "/* Targets, and what the Python package answers. */\n"
        f"enum {{ TARGETS = {COUNT} }};\n\n"
        "typedef struct {\n  int near, status, iterations, restarts;\n"
        f"  double points[{3 * f}], normals[{3 * f}], q0[{n}], q[{n}];\n"
        f"{'' if scene is None else '  double clearance;' + chr(10)}}} target;\n\n"
        "static const target targets[TARGETS] = {\n" + "".join(rows) + "};\n"
    ) + ("" if scene is None else "\n" + scene.header())


def single_targets_header(solver: Solver, scene: SceneTargets | None = None) -> str:
    """The same for a solver in single precision: no answers, and the scene as it takes it."""
    robot = solver.robot
    f, n = len(robot.fingers), len(robot.actuators)
    rows = []
    for target in stored(solver, scene):
        q0 = target["q0"] or robot.home.tolist()
        arrays = map(numbers, (target["points"], target["normals"], q0))
        whole = int(target["q0"] is not None), int(target["status"])
        rows.append("{" + ", ".join([*map(str, whole), *arrays]) + "},\n")
    return (
        "/* Targets, and how they end in double precision. */\n"
        f"enum {{ TARGETS = {COUNT} }};\n\n"
        "typedef struct {\n  int near, status;\n"
        f"  double points[{3 * f}], normals[{3 * f}], q0[{n}];\n}} target;\n\n"
        "static const target targets[TARGETS] = {\n" + "".join(rows) + "};\n"
    ) + ("" if scene is None else "\n" + in_single_precision(scene.header()))


def written(array: Array) -> str:
    """An array as C text, NaN included."""
    values = (number(v) if np.isfinite(v) else "NAN" for v in array.ravel().tolist())
    return "{" + ", ".join(values) + "}"
