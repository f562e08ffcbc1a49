"""Measurements of `bench.py` within one process: batches, calls, scenes, followers, methods."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from samplers import SAMPLERS, grasps_of, random_arm_targets

import casadi_ik as ik

SHARED = "CASADI_IK_BENCH_TARGETS"
"""Variable of the environment: the folder of targets that all processes of a run share."""

Quantities = dict[str, float]

Case = tuple[Any, ...]

Targets = tuple[Any, Any]

TOLERANCES = {"5mm": ik.Tolerance(), "1e-6": ik.Tolerance(1e-6, 1e-6)}

WARM = 300
"""Targets solved before times are taken, at most."""

SCENE = {
    "table": {"kind": "box", "size": [1.6, 1.6, 0.04], "xyz": [0.0, 0.0, -0.1]},
    "post": {"kind": "cylinder", "radius": 0.06, "length": 0.6, "xyz": [0.45, 0.25, 0.3]},
}

CANDIDATES, OF_OBJECT = 50, 500
"""Candidates of a choice: those of a scene's batch, and in an object's frame."""

CYCLES, PERIOD = 500, 1e-3
"""Number of cycles of a follower, and their length [s]."""


def shared(name: str, make: Callable[[], Any]) -> Any:
    """Return a folder that the first caller fills for all processes of a run."""
    folder = os.environ.get(SHARED)
    if folder is None:
        return make()
    path = Path(folder) / f"{name}.pickle"
    if not path.exists():
        path.write_bytes(pickle.dumps(make()))
    return pickle.loads(path.read_bytes())


def sampled_contacts(robot: ik.ArmHand, sampler: str, count: int) -> Targets:
    """Contacts of a sampler, the same in every process."""

    def draw() -> Targets:
        return robot.contacts(SAMPLERS[sampler][1](robot, np.random.default_rng(0), count))

    return shared(f"{robot.name}-{sampler}-{count}", draw)


@contextlib.contextmanager
def clock(quantities: Quantities, name: str, count: int, wall: bool = False) -> Any:
    """Processor time of this thread (or time on the wall) of what is done, by its count [us]."""
    timer = time.perf_counter if wall else time.thread_time
    begun = timer()
    yield
    quantities[name] = 1e6 * (timer() - begun) / count


def batch(robot: str, sampler: str, tolerance: str, count: int) -> Callable[[], Quantities]:
    """`solve_batch`, a target."""
    solver = ik.Solver(ik.load_robot(robot), tolerance=TOLERANCES[tolerance])
    targets = sampled_contacts(solver.robot, sampler, count)
    solver.solve_batch(*(array[:WARM] for array in targets))
    solver.solve_batch(*targets)

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            solved = solver.solve_batch(*targets)
        return quantities | {"missed": float((~solved.success).sum())}

    return measure


def fast(robot: str, count: int) -> Callable[[], Quantities]:
    """`Solver.fast`, a call."""
    solver = ik.Solver(ik.load_robot(robot))
    targets = list(zip(*sampled_contacts(solver.robot, "random", count), strict=True))
    call, home = solver.fast(), solver.robot.home
    for points, normals in targets:
        call(points, normals, home)

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            for points, normals in targets:
                call(points, normals, home)
        return quantities

    return measure


def single(robot: str, count: int) -> Callable[[], Quantities]:
    """`Solver.solve`, a call."""
    solver = ik.Solver(ik.load_robot(robot))
    grasps = grasps_of(solver.robot, *sampled_contacts(solver.robot, "random", count))

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us", count):
            for grasp in grasps:
                solver.solve(grasp)
        return quantities

    measure()
    return measure


def scene(robot: str, count: int) -> Callable[[], Quantities]:
    """Batch and choice among a table and a post, and all solutions without them.

    Several answers of a candidate count in the choice: code that knows no other way is compared.
    """
    solver = ik.Solver(ik.load_robot(robot), scene=ik.Scene(SCENE))
    plain = ik.Solver(solver.robot)
    targets = sampled_contacts(solver.robot, "random", count)
    grasps = grasps_of(solver.robot, *(array[:CANDIDATES] for array in targets))
    home = solver.robot.home
    has_limit = "per_candidate" in inspect.signature(solver.choose).parameters
    any_number: dict[str, Any] = {"per_candidate": None} if has_limit else {}

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "batch us", count):
            solved = solver.solve_batch(*targets)
        with clock(quantities, "choose us a candidate", CANDIDATES):
            ranked = solver.choose(grasps, q0=home, **any_number)
        with clock(quantities, "solve_all us", 5):
            for grasp in grasps[:5]:
                plain.solve_all(grasp)
        counts = {"not free": float((~solved.success).sum()), "answered": float(ranked.answered)}
        return quantities | counts

    measure()
    return measure


def clutter(robot: str, place: int) -> Callable[[], Quantities]:
    """Solve every third grasp of a place of the collision study, in batches of 256."""
    arm_hand = ik.load_robot(robot)

    def placed() -> list[Any]:
        search = importlib.import_module("collision_study.search")
        pieces = [search.Piece(robot, clutter, place, 3, 0) for clutter in (0, 3, 8)]
        return [case for piece in pieces for case in list(search.targets_at(piece))[::3]]

    cases = []
    for solids, name, points, normals, poses in shared(f"{robot}-clutter-{place}", placed):
        indices = np.arange(256) % len(points)
        targets = {
            "points": points[indices],
            "normals": normals[indices],
            "object_pose": poses[indices],
        }
        solver = ik.Solver(arm_hand, scene=ik.Scene(solids, grasped=name))
        solver.solve_batch(**targets)
        cases.append((solver, targets, len(points)))

    def measure() -> Quantities:
        seconds, solved, count = 0.0, 0, 0
        for solver, targets, size in cases:
            begun = time.thread_time()
            batch = solver.solve_batch(**targets)
            seconds += (time.thread_time() - begun) * size / len(batch.q)
            solved, count = solved + int(batch.success[:size].sum()), count + size
        return {"us": 1e6 * seconds / count, "solved": float(solved), "targets": float(count)}

    return measure


def choose(robot: str, grasp_kind: str, around: str) -> Callable[[], Quantities]:
    """Choosing among grasps in an object's frame, hands at random about it, from any side."""
    arm_hand, rng = ik.load_robot(robot), np.random.default_rng(0)
    solver = ik.Solver(arm_hand, scene=ik.Scene(SCENE) if around == "scene" else None)
    pose, q = np.eye(4), arm_hand.random(rng, OF_OBJECT)
    pose[:3, 3] = 0.5, 0.1, 0.3
    turns = np.linalg.qr(rng.normal(size=(OF_OBJECT, 3, 3)))[0]
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]
    points, normals = arm_hand.contacts(q)
    palms, middle = arm_hand.palm(q), points.mean(axis=1, keepdims=True)
    # Turned about the middle of the fingertips, which is put where the object is.
    palms[:, :3, 3] = ((palms[:, None, :3, 3] - middle) @ turns)[:, 0]
    palms[:, :3, :3] = np.swapaxes(turns, 1, 2) @ palms[:, :3, :3]
    moving = {i for name in arm_hand.fingers for i in arm_hand.description.finger_actuators(name)}
    postures = [{arm_hand.actuators[i]: float(row[i]) for i in moving} for row in q]
    grasps = grasps_of(arm_hand, (points - middle) @ turns, normals @ turns)
    if grasp_kind == "palms":
        grasps = [ik.Grasp(palm=p, posture=h) for p, h in zip(palms, postures, strict=True)]

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us a candidate", OF_OBJECT):
            ranked = solver.choose(grasps, pose, arm_hand.home)
        return quantities | {"answered": float(ranked.answered)}

    measure()
    return measure


def follow(robot: str) -> Callable[[], Quantities]:
    """Measure a cycle of a follower of a slow motion."""
    solver = ik.Solver(ik.load_robot(robot))
    arm_hand, rng = solver.robot, np.random.default_rng(0)
    middle, half_range = (
        (arm_hand.lower + arm_hand.upper) / 2,
        (arm_hand.upper - arm_hand.lower) / 2,
    )
    directions = rng.uniform(-0.1, 0.1, (2, len(middle))) * half_range
    turn = np.linspace(0, 0.5, CYCLES)[:, None]
    path = middle + directions[0] * np.sin(turn) + directions[1] * turn**2
    targets = list(zip(*arm_hand.contacts(path), strict=True))

    def measure() -> Quantities:
        quantities, follower = Quantities(), solver.follow(path[0], PERIOD)
        with clock(quantities, "us", CYCLES):
            for points, normals in targets:
                follower(points, normals)
        return quantities

    measure()
    return measure


def diagnosis(robot: str, kind: str, count: int) -> Callable[[], Quantities]:
    """Measure the cost of a diagnosis for unsolved targets."""
    solver, rng = ik.Solver(ik.load_robot(robot)), np.random.default_rng(0)
    points, normals = sampled_contacts(solver.robot, "random", count)
    if kind == "far":
        points = points + np.array([1.5, 0.0, 0.0])
    elif kind == "moved":
        points = points + rng.normal(0, 0.03, points.shape)
    else:
        normals = normals + rng.normal(0, 0.5, normals.shape)
        normals = normals / np.linalg.norm(normals, axis=2, keepdims=True)
    left = ~solver.solve_batch(points, normals, diagnose=True).success
    targets = points[left], normals[left]

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "solve us", len(targets[0])):
            solver.solve_batch(*targets)
        with clock(quantities, "with reason us", len(targets[0])):
            solver.solve_batch(*targets, diagnose=True)
        return quantities | {"not solved": float(left.sum())}

    return measure


def methods(robot: str, method: str, step: str) -> Callable[[], Quantities]:
    """Measure an iteration of a method on built-in grasps."""
    arm_hand = ik.load_robot(robot)
    solver = ik.Solver(arm_hand, method, finger_step=step or None)
    iterations = 1 if step == "ipopt" else 10
    names = ik.shipped_grasps(robot)[: 2 if step == "ipopt" else None]
    targets = random_arm_targets(arm_hand, names, iterations, np.random.default_rng(0))
    total = int(solver.solve_batch(*targets).iterations.sum())

    def measure() -> Quantities:
        quantities: Quantities = {}
        with clock(quantities, "us an iteration", total):
            solver.solve_batch(*targets)
        return quantities | {"iterations": float(total)}

    return measure


def threads(robot: str, count: int) -> Callable[[], Quantities]:
    """Two threads and one, time on the wall."""
    solver = ik.Solver(ik.load_robot(robot))
    targets = sampled_contacts(solver.robot, "random", count)
    solver.solve_batch(*targets)

    def measure() -> Quantities:
        quantities: Quantities = {}
        for jobs in (1, 2):
            with clock(quantities, f"jobs={jobs} us (wall)", count, wall=True):
                solver.solve_batch(*targets, jobs=jobs)
        return quantities

    return measure
