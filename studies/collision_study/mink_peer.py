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
from peers import Mink, starts_of

import casadi_ik as ik
from casadi_ik.arrays import Array
from casadi_ik.collision.solids import Kind
from casadi_ik.problem.clearance import SceneCheck, Surroundings
from collision_study.search import Piece, grasps_at, surroundings

STARTS, STEPS, CAP, WAIT, STALL = 25, 60, 0.5, 8, 0.98
"""Starts of a target, steps of each, the largest change of a motor, and when one is left."""

SPARE = 2e-4
"""Distance [m] beyond the margin that its limits keep: it moves on straight lines."""

DETECTION = 0.05
"""Distance [m] from which on its limits act."""


class MinkAmong(Mink):
    """mink, with what stands about the robot."""

    def __init__(self, robot: ik.ArmHand, around: Surroundings) -> None:
        """Build the model of one target."""
        self._around = around
        super().__init__(robot, 1e-2)
        self._avoided = self._limits_of(around)

    def _spec(self, robot: ik.ArmHand) -> Any:
        spec = super()._spec(robot)
        mujoco, table = self._mujoco, self._around.table
        bodies = {body.name: body for body in spec.bodies}
        world = spec.worldbody
        for geom in list(spec.geoms):
            spec.delete(geom)
        shapes = robot.description.shapes
        for i, one in enumerate(shapes.capsules):
            body = bodies.get(one.link, world)
            ends = np.concatenate([one.center - one.half, one.center + one.half])
            if np.any(one.half):
                body.add_geom(
                    name=f"g{i}",
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                    fromto=ends,
                    size=[one.radius, 0, 0],
                )
            else:
                body.add_geom(
                    name=f"g{i}",
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    pos=one.center,
                    size=[one.radius, 0, 0],
                )
        poses = self._around.poses.reshape(-1, 12)
        for k, solid in enumerate(table.solids):
            if k < table.own:
                own = shapes.solids[k]
                body, pose = bodies.get(own.link, world), own.pose
            else:
                flat, pose, body = poses[k - table.own], np.eye(4), world
                pose[:3, :3], pose[:3, 3] = flat[:9].reshape(3, 3), flat[9:]
            kinds = mujoco.mjtGeom
            kind = {
                Kind.BOX: kinds.mjGEOM_BOX,
                Kind.CYLINDER: kinds.mjGEOM_CYLINDER,
                Kind.CAPSULE: kinds.mjGEOM_CAPSULE if solid.size[1] else kinds.mjGEOM_SPHERE,
            }[solid.kind]
            turn = np.empty(4)
            mujoco.mju_mat2Quat(turn, pose[:3, :3].ravel())
            name = f"g{len(shapes.capsules) + k}"
            body.add_geom(name=name, type=kind, pos=pose[:3, 3], quat=turn, size=solid.size)
        return spec

    def _limits_of(self, around: Surroundings) -> list[Any]:
        """A limit for all pairs that may overlap equally much."""
        table, found = around.table, []
        for offset in np.unique(table.offsets):
            rows = table.pairs[table.offsets == offset].tolist()
            found.append(
                self._mink.CollisionAvoidanceLimit(
                    self._model,
                    [([f"g{i}"], [f"g{j}"]) for i, j in rows],
                    minimum_distance_from_collisions=float(offset) + around.margin + SPARE,
                    collision_detection_distance=DETECTION,
                )
            )
        return found

    def limits(self) -> list[Any]:
        """Those of collisions; those of motors are bounds of the program."""
        return self._avoided


def solve_peer(piece: Piece, targets: int) -> dict[str, Any]:
    """So many of a piece's targets by mink and by us."""
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
            spent = time.process_time() - begin
            solver.solve(grasp, diagnose=False)
            begin = time.process_time()
            ours = solver.solve(grasp, diagnose=False)
            own = time.process_time() - begin
            row = {"solved": solved, "starts": starts, "seconds": spent}
            rows.append(row | {"ours": ours.success, "own": own})
    return {"targets": rows}


def _solved(
    peer: MinkAmong, robot: ik.ArmHand, grasp: ik.Grasp, around: Surroundings
) -> tuple[bool, int]:
    """Whether an answer was found, and how many starts it took."""
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
    around: Surroundings,
    q: Array,
) -> bool:
    tolerance, costs = ik.Tolerance(), list[float]()
    chord = 2 * np.sin(tolerance.angle / 2)
    for _ in range(STEPS):
        p, n = peer.contacts(q)
        off, away = np.square(p - points).sum(axis=1), np.square(n - normals).sum(axis=1)
        met = off.max() <= tolerance.position**2 and away.max() <= chord**2
        if met and around.free(q[None])[0]:
            return True
        costs.append(float(100 * off.sum() + away.sum()))
        if len(costs) > WAIT and costs[-1] > STALL * costs[-1 - WAIT]:
            return False
        change = peer.step(q)
        change = change * min(1.0, CAP / max(float(np.abs(change).max()), 1e-12))
        q = np.clip(q + change, robot.lower, robot.upper)
    return False


def installed() -> bool:
    """Whether mink can be imported."""
    try:
        import_module("mink")
    except ImportError:
        return False
    return True
