"""One arm with one hand of the catalogue, tried on targets that it can reach."""

from __future__ import annotations

import os
import resource
import tempfile
import time
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from hard_targets import SETS

import casadi_ik as ik
from casadi_ik.arrays import Array

KINDS = ("random hands", "near limits", "corners on near-singular arms")

TOLERANCES = {
    "5 mm, 3 deg": ik.Tolerance(),
    "1e-6 m, 1e-6 rad": ik.Tolerance(1e-6, 1e-6),
}

REFERENCE = "kuka_lwr_barrett"
"""Times are given as ratios to this robot's, measured before and after in the same process."""

SCALE = 1000
"""Targets of the reference that are solved for a ratio."""

WARM = 300
"""Targets solved before times are taken."""

LATE, MOVED = 2, 0.2
"""So many of them again, each point moved by about so much [m]: these go through all rounds, so
that what late rounds need is compiled and no target's time holds it."""

FEW = 3
"""Fingers of the smaller grasps: the thumb (or the first finger) and the two after it."""


@dataclass(frozen=True)
class Pair:
    """What is asked of an arm and a hand.

    Attributes:
        arm: Shipped name.
        hand: Shipped name.
        count: Targets of every kind, for every set of fingers.
        seed: Of the targets.
    """

    arm: str
    hand: str
    count: int
    seed: int

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return f"{self.arm}+{self.hand}"


def finger_sets(robot: ik.ArmHand) -> dict[str, list[int]]:
    """Places in `robot.fingers` of those that have a contact, by name of the set."""
    every = list(range(len(robot.fingers)))
    sets = {"all fingers": every}
    if len(every) > FEW:
        first = robot.fingers.index(robot.thumb) if robot.thumb else 0
        sets[f"{FEW} fingers"] = [first, *(f for f in every if f != first)][:FEW]
    return sets


def targets(robot: ik.ArmHand, pair: Pair, kind: str, fingers: list[int]) -> tuple[Array, ...]:
    """Configurations (k, n) and their contacts, (k, f, 3) each, NaN for fingers that are free."""
    return _asked(robot, _drawn(robot, pair, kind), fingers)


def _drawn(robot: ik.ArmHand, pair: Pair, kind: str) -> Array:
    rng = np.random.default_rng([pair.seed, *(zlib.crc32(w.encode()) for w in (pair.robot, kind))])
    return SETS[kind](robot, rng, pair.count)


def _asked(robot: ik.ArmHand, q: Array, fingers: list[int]) -> tuple[Array, ...]:
    points, normals = robot.contacts(q)
    free = np.setdiff1d(np.arange(len(robot.fingers)), fingers)
    points[:, free] = normals[:, free] = np.nan
    return q, points, normals


def try_pair(pair: Pair) -> dict[str, Any]:
    """Solve all targets of a pair; its kernels are compiled anew and thrown away.

    Returns:
        "motors", "fingers", "first use" [s of processor time] and "cells": by fingers, kind and
        tolerance a dictionary of "count", "missed" (rows and configurations), "restarted", "mean",
        "p99", "max" [us] and "ratio" of the mean to the reference's at the same tolerance.
    """
    names = list(TOLERANCES)
    scale = _Scale()
    with tempfile.TemporaryDirectory() as kernels:
        before = os.environ.get("CASADI_IK_CACHE")
        os.environ["CASADI_IK_CACHE"] = kernels
        try:
            begun = _processor_time()
            robot = ik.load_robot(pair.robot)
            solvers = {name: ik.Solver(robot, tolerance=TOLERANCES[name]) for name in names}
            some = robot.contacts(robot.random(np.random.default_rng(pair.seed), 8))
            solvers[names[0]].solve_batch(some[0][:1], some[1][:1])
            solvers[names[0]].solve_batch(*some)
            first_use = _processor_time() - begun
            warm = robot.contacts(robot.random(np.random.default_rng(pair.seed), WARM))
            off = np.random.default_rng(pair.seed).normal(0, MOVED, (LATE, *warm[0].shape[1:]))
            for solver in solvers.values():
                solver.solve_batch(*warm)
                solver.solve_batch(warm[0][:LATE] + off, warm[1][:LATE])
            drawn = {kind: _drawn(robot, pair, kind) for kind in KINDS}
            cells = {
                f"{fingers}/{kind}/{name}": _cell(
                    solvers[name], _asked(robot, drawn[kind], places), scale, name
                )
                for fingers, places in finger_sets(robot).items()
                for kind in KINDS
                for name in names
            }
        finally:
            os.environ.pop("CASADI_IK_CACHE")
            if before is not None:
                os.environ["CASADI_IK_CACHE"] = before
    return {
        "motors": len(robot.actuators) - len(robot.description.arm_actuators),
        "fingers": len(robot.fingers),
        "first use": first_use,
        "cells": cells,
    }


class _Scale:
    """What a target of the reference takes."""

    def __init__(self) -> None:
        robot = ik.load_robot(REFERENCE)
        self._targets = robot.contacts(robot.random(np.random.default_rng(0), SCALE))
        self._solvers = {name: ik.Solver(robot, tolerance=t) for name, t in TOLERANCES.items()}
        for solver in self._solvers.values():
            solver.solve_batch(*self._targets)

    def time(self, tolerance: str) -> float:
        """Seconds of this thread."""
        begun = time.thread_time()
        self._solvers[tolerance].solve_batch(*self._targets)
        return (time.thread_time() - begun) / SCALE


def _cell(solver: ik.Solver, asked: tuple[Array, ...], scale: _Scale, name: str) -> dict[str, Any]:
    q, points, normals = asked
    before = scale.time(name)
    begun = time.thread_time()
    batch = solver.solve_batch(points, normals)
    mean = (time.thread_time() - begun) / len(q)
    after = scale.time(name)
    return {
        "count": len(q),
        "missed": [
            {"row": int(row), "status": batch.status_names[row], "q": q[row].tolist()}
            for row in np.flatnonzero(~batch.success)
        ],
        "restarted": int((batch.restarts > 0).sum()),
        "mean": 1e6 * mean,
        "p99": 1e6 * float(np.quantile(batch.time, 0.99)),
        "max": 1e6 * float(batch.time.max()),
        "ratio": mean / ((before + after) / 2),
    }


def _processor_time() -> float:
    """Seconds of this process and of the compilers it ran."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in used)
