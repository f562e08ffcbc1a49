"""Grasps at random places of a cluttered table, and a dense search of the solutions of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.solving.trials import Descent, repeated

TABLE = {"kind": "box", "size": [3, 3, 0.04], "xyz": [0, 0, -0.02]}
NEAR = 0.12
"""Clutter keeps so far [m] from the object's middle: what stands in the hand cannot be grasped."""
STARTS = 256
"""Random starts solved at once."""


@dataclass(frozen=True, eq=False)
class Target:
    """A grasp and what stands about it."""

    grasp: ik.Grasp
    scene: ik.Scene


def placed_targets(
    robot: ik.ArmHand, blind: ik.Solver, rng: np.random.Generator, count: int, clutter: int
) -> list[Target]:
    """Shipped grasps moved to random places that contacts alone can be solved at."""
    grasps = [ik.load_grasp(name) for name in ik.shipped_grasps(robot.name)]
    found: list[Target] = []
    while len(found) < count:
        grasp = grasps[len(found) % len(grasps)]
        assert grasp.object_pose is not None
        angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 0.85)
        motion = np.eye(4)
        turn = rng.uniform(-np.pi, np.pi)
        motion[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        goal = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.1, 0.6)])
        motion[:3, 3] = goal - motion[:3, :3] @ grasp.object_pose[:3, 3]
        moved = _moved(grasp, motion)
        if not blind.solve(moved, diagnose=False).success:
            continue
        solids = {"table": TABLE} | _clutter(rng, clutter, goal)
        found.append(Target(moved, ik.Scene(solids)))
    return found


def _moved(grasp: ik.Grasp, motion: Array) -> ik.Grasp:
    assert grasp.object_pose is not None
    turn, shift = motion[:3, :3], motion[:3, 3]
    contacts = {
        name: ik.Contact(
            turn @ one.point + shift, None if one.normal is None else turn @ one.normal
        )
        for name, one in grasp.contacts.items()
    }
    return ik.Grasp(contacts, object=grasp.object, object_pose=motion @ grasp.object_pose)


def _clutter(rng: np.random.Generator, count: int, goal: Array) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    while len(found) < count:
        place = goal + rng.uniform(-0.35, 0.35, 3) * [1, 1, 0.6]
        size = rng.uniform(0.02, 0.07)
        off = np.linalg.norm(place - goal) - size * 1.8
        if off < NEAR or np.hypot(*place[:2]) < 0.25 or place[2] < size:
            continue
        rest: dict[str, object] = {"xyz": place.tolist(), "rpy": rng.uniform(-3, 3, 3).tolist()}
        kinds = (
            {"kind": "box", "size": [2 * size, 1.5 * size, size]},
            {"kind": "cylinder", "radius": size, "length": 2 * size},
            {"kind": "sphere", "radius": size},
        )
        found[f"clutter_{len(found)}"] = kinds[len(found) % 3] | rest
    return found


def dense(
    solver: ik.Solver,
    grasp: ik.Grasp,
    around: Surroundings,
    count: int,
    margin: float,
    rng: np.random.Generator,
) -> bool:
    """Whether one of many solutions of a grasp has room to spare."""
    engine = solver._engine
    problems = solver._questions.of_grasps([grasp], None)
    finder = engine.freer
    trials, limits = finder.trials, finder.trials.limits(problems)
    descent = Descent(trials, problems)
    looked = 0
    while looked < count:
        starts = solver.robot.random(rng, STARTS)
        q = descent.run(np.zeros(STARTS, np.intp), limits.clip(starts))
        q = q[trials.solved(repeated(problems, STARTS), q, True)]
        looked += STARTS
        if not len(q):
            continue
        swung = finder.swung(q, limits.lower, limits.upper)
        every = q if swung is None else np.concatenate([q, swung.q])
        looked += len(every)
        rows = around.rows(np.zeros(len(every), np.intp))
        if (rows.check(every).room >= margin).any():
            return True
    return False
