"""mink with limits on collisions, on the targets and in the scenes of the choice.

Its model has our shapes: every pair that we check is one of a collision limit, with what it may
overlap. Set up as in the comparison of solvers (`peers`), one start from home and then evenly
spread ones, until an answer meets the contacts and is free by our check.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

import numpy as np
from peer_solvers import Mink
from peers import starts_of

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.solids import Kind
from casadi_ik.files.arrays import Array
from collision_study.oracles import with_shapes
from collision_study.search import Piece, grasps_at, surroundings

STARTS, STEPS, CAP, WAIT, STALL = 25, 60, 0.5, 8, 0.98
"""Starts of a target, steps of each, the largest change of a motor, and when one is left."""

SPARE = 2e-4
"""Distance [m] beyond the margin that its limits keep: it moves on straight lines."""

DETECTION = 0.05
"""Distance [m] from which on its limits act."""


class MinkAmong(Mink):
    """mink, with what stands about the robot."""

    def __init__(self, robot: ik.ArmHand, around: CollisionQuery) -> None:
        """Build the model of one target."""
        self._around = around
        super().__init__(robot, 1e-2)
        self._avoided = self._limits_of(around)

    def _spec(self, robot: ik.ArmHand) -> Any:
        spec = super()._spec(robot)
        with_shapes(spec, robot, self._around)
        return spec

    def _limits_of(self, around: CollisionQuery) -> list[Any]:
        """Return a collision limit for each amount of allowed overlap."""
        table, limits = around.table, []
        for offset in np.unique(table.offsets):
            rows = table.pairs[table.offsets == offset].tolist()
            limits.append(
                self._mink.CollisionAvoidanceLimit(
                    self._model,
                    [([f"g{i}"], [f"g{j}"]) for i, j in rows],
                    minimum_distance_from_collisions=float(offset) + around.margin + SPARE,
                    collision_detection_distance=DETECTION,
                )
            )
        return limits

    def limits(self) -> list[Any]:
        """Return the collision limits; motor limits are bounds of the program."""
        return self._avoided


def solve_peer(piece: Piece, targets: int) -> dict[str, Any]:
    """Solve some targets of a piece by mink and by hand-first."""
    robot, rows = ik.load_robot(piece.robot), list[dict[str, Any]]()
    for scene, grasps in grasps_at(piece):
        check, solver = SceneCheck(robot, scene), ik.Solver(robot, scene=scene)
        if any(part[0].kind is Kind.CONVEX for i in scene.items.values() for part in i.parts):
            continue  # MuJoCo takes planes as corners only
        for grasp in grasps[: max(1, targets // 3)]:
            if len(rows) == targets:
                return {"targets": rows}
            around = surroundings(check, robot, grasp).rows(np.zeros(1, dtype=np.intp))
            peer = MinkAmong(robot, around)
            begin = time.process_time()
            solved, starts = _solved(peer, robot, grasp, around)
            seconds = time.process_time() - begin
            solver.solve(grasp, diagnose=False)
            begin = time.process_time()
            ours = solver.solve(grasp, diagnose=False)
            own_seconds = time.process_time() - begin
            row = {"solved": solved, "starts": starts, "seconds": seconds}
            rows.append(row | {"ours": ours.success, "own": own_seconds})
    return {"targets": rows}


def _solved(
    peer: MinkAmong, robot: ik.ArmHand, grasp: ik.Grasp, around: CollisionQuery
) -> tuple[bool, int]:
    """Return whether a solution was found, and the number of starts."""
    points, normals = grasp.arrays(robot.fingers)
    peer.aim(points, normals)
    for number, start in enumerate(starts_of(robot, STARTS - 1), start=1):
        if _from(peer, robot, points, normals, around, start):
            return True, number
    return False, STARTS


def _from(
    peer: MinkAmong,
    robot: ik.ArmHand,
    points: Array,
    normals: Array,
    around: CollisionQuery,
    q: Array,
) -> bool:
    tolerance, costs = ik.Tolerance(), list[float]()
    chord = 2 * np.sin(tolerance.angle / 2)
    for _ in range(STEPS):
        p, n = peer.contacts(q)
        off, normal_error = np.square(p - points).sum(axis=1), np.square(n - normals).sum(axis=1)
        is_within = off.max() <= tolerance.position**2 and normal_error.max() <= chord**2
        if is_within and around.free(q[None])[0]:
            return True
        costs.append(float(100 * off.sum() + normal_error.sum()))
        if len(costs) > WAIT and costs[-1] > STALL * costs[-1 - WAIT]:
            return False
        change = peer.step(q)
        change = change * min(1.0, CAP / max(float(np.abs(change).max()), 1e-12))
        q = np.clip(q + change, robot.lower, robot.upper)
    return False


def installed() -> bool:
    """Return whether mink is installed."""
    try:
        import_module("mink")
    except ImportError:
        return False
    return True
