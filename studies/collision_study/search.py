"""Grasps all about a place of a cluttered table, and a dense search of those not solved."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import casadi_ik as ik
from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.files.arrays import Array
from casadi_ik.solve.target_builder import TargetBuilder, tolerances_by_finger
from collision_study.oracles import CoalOracle

TABLE = {"kind": "box", "size": [3, 3, 0.04], "xyz": [0, 0, -0.02]}
MAX_POSTURE_DISTANCE = 0.12
"""Clutter keeps so far [m] from the object's middle: what stands in the hand cannot be grasped."""
TURNS = 16
"""Number of yaw angles of each grasp at its position."""
AT_ONCE = 2048
"""Answers of a dense search that are looked for at once."""
SAFE = 2e-3
"""Margin [m] of the answers that a dense search has to find for a target to count."""
POSTURES = 12
"""Random hands that a robot without shipped grasps has grasps of."""
SAMPLES = 20_000
"""Random configurations that they are taken from."""
BALL, SMALLEST = "ball", 0.012
"""Name of the object of random hands, and its smallest radius [m]."""
MICROMETRE = 1e-6
BATCH = 256
"""Targets of a batch that is timed: those of a grasp, again and again."""


@dataclass(frozen=True)
class Piece:
    """A place of a table with clutter about it, at which all grasps are tried.

    Attributes:
        robot: Name of the robot; its shipped grasps are tried.
        clutter: Solids beside the table.
        number: Of the place.
        seed: Of the study.
        searched: Answers of a dense search.
    """

    robot: str
    clutter: int
    number: int
    seed: int
    searched: int


def solve_piece(piece: Piece) -> dict[str, Any]:
    """Solve the targets of a piece whose contacts can be met without the scene."""
    robot = ik.load_robot(piece.robot)
    blind = ik.Solver(robot)
    rows = []
    for solids, grasped, grasps in _placed(piece, robot):
        arrays = [grasp.arrays(robot.fingers) for grasp in grasps]
        points, normals = (np.stack(both) for both in zip(*arrays, strict=True))
        solution = blind.solve_batch(points, normals)
        solvable = np.flatnonzero(solution.success)
        if len(solvable):
            solvable_grasps = [grasps[i] for i in solvable]
            rows += _solved(
                blind,
                solids,
                grasped,
                solvable_grasps,
                points[solvable],
                normals[solvable],
                solution.q[solvable],
                piece,
            )
    return {"targets": rows}


def targets_at(piece: Piece) -> Iterator[tuple[dict[str, Any], str, Array, Array, Array]]:
    """Yield the yaw angles of each grasp of a piece that are solvable without the scene.

    Yields:
        Solids of the scene, the name of the one that is grasped, and its (k, f, 3) points,
        (k, f, 3) normals and (k, 4, 4) poses.
    """
    for solids, grasps in _solvable(piece):
        arrays = [grasp.arrays(ik.load_robot(piece.robot).fingers) for grasp in grasps]
        points, normals = (np.stack(both) for both in zip(*arrays, strict=True))
        poses = np.stack([grasp.known_pose for grasp in grasps if grasp.known_pose is not None])
        yield solids, grasps[0].object, points, normals, poses


def grasps_at(piece: Piece) -> Iterator[tuple[ik.Scene, list[ik.Grasp]]]:
    """Yield the scene of each grasp of a piece, and its targets that are solvable without it."""
    for solids, grasps in _solvable(piece):
        yield ik.Scene(solids, grasped=grasps[0].object), grasps


def _solvable(piece: Piece) -> Iterator[tuple[dict[str, Any], list[ik.Grasp]]]:
    robot = ik.load_robot(piece.robot)
    blind = ik.Solver(robot)
    for solids, grasped, grasps in _placed(piece, robot):
        arrays = [grasp.arrays(robot.fingers) for grasp in grasps]
        points, normals = (np.stack(both) for both in zip(*arrays, strict=True))
        solvable = np.flatnonzero(blind.solve_batch(points, normals).success)
        pose, name = grasps[0].known_pose, grasps[0].object
        assert pose is not None
        if len(solvable):
            place = {"xyz": pose[:3, 3].tolist()}
            yield {**solids, name: grasped | place}, [grasps[i] for i in solvable]


def _placed(
    piece: Piece, robot: ik.ArmHand
) -> Iterator[tuple[dict[str, Any], dict[str, Any], list[ik.Grasp]]]:
    """Yield obstacles, grasped object and grasps of each grasp of a piece."""
    rng = np.random.default_rng([piece.seed, piece.clutter, piece.number])
    angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 0.85)
    goal = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.1, 0.6)])
    solids = {"table": TABLE, **_clutter(rng, piece.clutter, goal)}
    for known_grasp, grasped in _grasps(robot):
        yield solids, grasped, [_placed_grasp(known_grasp, goal, rng) for _ in range(TURNS)]


def _solved(
    plain_solver: ik.Solver,
    solids: dict[str, Any],
    grasped: dict[str, Any],
    grasps: list[ik.Grasp],
    points: Array,
    normals: Array,
    blind: Array,
    piece: Piece,
) -> list[dict[str, Any]]:
    """Return a row of results for each rotation of a grasp."""
    robot, name = plain_solver.robot, grasps[0].object
    poses = np.stack([grasp.known_pose for grasp in grasps if grasp.known_pose is not None])
    place = {"xyz": poses[0][:3, 3].tolist()}
    scene = ik.Scene({**solids, name: grasped | place}, grasped=name)
    solver = ik.Solver(robot, scene=scene)
    batch = solver.solve_batch(points, normals, object_pose=poses)
    rows = np.arange(BATCH) % len(points)
    time_each = _timed(solver, points[rows], normals[rows], poses[rows])
    plain_time = _timed(plain_solver, points[rows], normals[rows], None)
    answered = np.flatnonzero(batch.success)
    of_answered = 0.0
    if len(answered):
        answered_rows = answered[np.arange(BATCH) % len(answered)]
        of_answered = _timed(
            solver, points[answered_rows], normals[answered_rows], poses[answered_rows]
        )
    check = SceneCheck(robot, scene)
    rows = []
    for i, grasp in enumerate(grasps):
        around = surroundings(check, robot, grasp)
        false = missed = False
        if batch.success[i]:
            false = bool(CoalOracle(robot, around).penetrating(batch.q[i][None], MICROMETRE)[0])
        else:
            rng = np.random.default_rng([piece.seed, piece.number, i])
            missed = dense(robot, points[i], normals[i], around, piece.searched, rng)
        begin = time.process_time()
        solver.solve(grasp, diagnose=False)
        rows.append(
            {
                "grasp": name,
                "status": batch.status_names[i].item(),
                "blind": bool(around.free(blind[i][None])[0]),
                "missed": missed,
                "false": false,
                "pair": ""
                if (report := batch.collisions[i]) is None
                else " and ".join(report.pair),
                "batch": time_each,
                "answered_time": of_answered,
                "blind_time": plain_time,
                "single": time.process_time() - begin,
            }
        )
    return rows


def _timed(solver: ik.Solver, points: Array, normals: Array, poses: Array | None) -> float:
    """Processor time of a target [s], everything that is done once done before."""
    solver.solve_batch(points, normals, object_pose=poses)
    begin = time.process_time()
    solver.solve_batch(points, normals, object_pose=poses)
    return (time.process_time() - begin) / len(points)


def surroundings(check: SceneCheck, robot: ik.ArmHand, grasp: ik.Grasp) -> CollisionQuery:
    """Return the obstacles that a grasp is checked against."""
    builder = TargetBuilder(robot, tolerances_by_finger(None, robot.fingers))
    return check.collision_query(builder.from_grasps([grasp]))


def dense(
    robot: ik.ArmHand,
    points: Array,
    normals: Array,
    around: CollisionQuery,
    count: int,
    rng: np.random.Generator,
) -> bool:
    """Return whether one of many solutions, each nearest to a random start, has clearance."""
    blind = ik.Solver(robot)
    for first in range(0, count, AT_ONCE):
        size = min(AT_ONCE, count - first)
        tiled = (np.tile(array, (size, 1, 1)) for array in (points, normals))
        solutions = blind.solve_batch(*tiled, q0=robot.random(rng, size), prefer="q0")
        q = solutions.q[solutions.success]
        if len(q) and (around.rows(np.zeros(len(q), np.intp)).check(q).surplus >= SAFE).any():
            return True
    return False


@cache
def _grasps(robot: ik.ArmHand) -> list[tuple[ik.Grasp, dict[str, Any]]]:
    """Grasps of a robot, each with what it holds: the shipped ones, else of random hands."""
    shipped = ik.shipped_grasps(robot.name)
    if shipped:
        grasps = [ik.load_grasp(name) for name in shipped]
        return [(grasp, {"kind": "object", "object": grasp.object}) for grasp in grasps]
    q = robot.random(np.random.default_rng(POSTURES), SAMPLES)
    points, normals = robot.contacts(q)
    poses = np.tile(np.eye(4), (SAMPLES, 1, 1))
    poses[:, :3, 3] = points.mean(axis=1)
    # The ball is as large as fits between the fingertips; a point of it is checked, and its size.
    radii = np.linalg.norm(points - poses[:, None, :3, 3], axis=2).min(axis=1) - SAFE
    point = {"kind": "sphere", "radius": SAFE}
    check = SceneCheck(robot, ik.Scene({BALL: point}, grasped=BALL))
    builder = TargetBuilder(robot, tolerances_by_finger(None, robot.fingers))
    around = check.collision_query(builder.from_arrays(points, normals).holding(BALL, poses))
    of_ball = np.array([BALL in names for names in around.table.names])
    clear = around.with_table(around.table.select(~of_ball)).free(q) & (radii > SMALLEST)
    clear &= around.with_table(around.table.select(of_ball)).check(q).distance + SAFE > radii
    targets = []
    for row in np.flatnonzero(clear)[:POSTURES].tolist():
        named = zip(robot.fingers, points[row], normals[row], strict=True)
        contacts = {name: ik.Contact(point, normal) for name, point, normal in named}
        grasp = ik.Grasp(contacts, object=BALL, object_pose=poses[row])
        targets.append((grasp, {"kind": "sphere", "radius": float(radii[row])}))
    return targets


def _placed_grasp(grasp: ik.Grasp, goal: Array, rng: np.random.Generator) -> ik.Grasp:
    """Return a grasp with its object at a position, rotated about the vertical."""
    assert grasp.known_pose is not None
    turn, motion = rng.uniform(-np.pi, np.pi), np.eye(4)
    motion[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    motion[:3, 3] = goal - motion[:3, :3] @ grasp.known_pose[:3, 3]
    return grasp.at(motion)


def _clutter(rng: np.random.Generator, count: int, goal: Array) -> dict[str, dict[str, object]]:
    solids: dict[str, dict[str, object]] = {}
    while len(solids) < count:
        place = goal + rng.uniform(-0.35, 0.35, 3) * [1, 1, 0.6]
        size = rng.uniform(0.02, 0.07)
        off = np.linalg.norm(place - goal) - size * 1.8
        if off < MAX_POSTURE_DISTANCE or np.hypot(*place[:2]) < 0.25 or place[2] < size:
            continue
        pose: dict[str, object] = {"xyz": place.tolist(), "rpy": rng.uniform(-3, 3, 3).tolist()}
        kinds = (
            {"kind": "box", "size": [2 * size, 1.5 * size, size]},
            {"kind": "cylinder", "radius": size, "length": 2 * size},
            {"kind": "sphere", "radius": size},
        )
        solids[f"clutter_{len(solids)}"] = kinds[len(solids) % 3] | pose
    return solids
