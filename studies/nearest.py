"""How far does the robot move from q0 to a solution, and could it have moved less?

Along smooth paths every solve starts where the last one ended; from random configurations to random
targets the answer is compared with the nearest of the solutions that `solve_all` finds. "limits" is
what a solve does that is not told where the robot is::

    python studies/nearest.py --report out/nearest
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from runner.report import command, markdown_table, publish

import casadi_ik as ik
from casadi_ik.files.arrays import Array

STEP = 0.25e-3
"""Largest motion of a contact from one target of a path to the next [m], about."""

TOLERANCES = {
    "5 mm, 3 deg": ik.Tolerance(),
    "1e-6 m, 1e-6 rad": ik.Tolerance(1e-6, 1e-6),
}
PREFERENCES = ("limits", "q0")
NEAREST = 1.01
"""An answer whose distance is at most so many times the nearest's counts as the nearest."""

INTRODUCTION = """
Robot kuka_lwr_barrett. *Motion:* of the motor that moves most, from q0 to the answer. *Distance:*
Euclidean, every motor as a part of its range. *Paths:* straight lines in the space of the motors
from the inner 40 % of their ranges, contacts {step:g} mm apart; every solve starts at the last
answer. *Anywhere:* random targets from random configurations. *CPU time* of a solve in a batch.
"""


def path(robot: ik.ArmHand, rng: np.random.Generator, steps: int, step: float) -> Array:
    """Return configurations (steps, n) whose contacts move by about `step` [m] each."""
    ranges = robot.upper - robot.lower
    start = robot.lower + ranges * rng.uniform(0.3, 0.7, len(ranges))
    direction = rng.normal(size=len(ranges)) * ranges
    points = [robot.contacts(start + scale * direction)[0] for scale in (0.0, 1e-6)]
    speed = np.linalg.norm(points[1] - points[0], axis=-1).max() / 1e-6
    q = start + np.arange(steps)[:, None] * direction * step / speed
    return np.clip(q, robot.lower, robot.upper)


def solve_paths(solver: ik.Solver, paths: list[Array], prefer: str) -> tuple[Array, float]:
    """Motions [deg] of all steps, and the part of them solved."""
    motions, solved = [], []
    q = np.stack([path[0] for path in paths])
    for step in range(1, len(paths[0])):
        targets = solver.robot.contacts(np.stack([path[step] for path in paths]))
        batch = solver.solve_batch(*targets, q0=q, prefer=prefer)
        motions.append(np.degrees(np.abs(batch.q - q).max(axis=1)))
        solved.append(batch.success)
        q = batch.q
    return np.concatenate(motions), float(np.mean(solved))


def anywhere(solver: ik.Solver, q: Array, q0: Array, prefer: str) -> tuple[Array, Array, float]:
    """Distances, motions [deg] and CPU seconds a solve."""
    robot = solver.robot
    targets = robot.contacts(q)
    solver.solve_batch(*targets, q0=q0, prefer=prefer)
    begin = time.process_time()
    batch = solver.solve_batch(*targets, q0=q0, prefer=prefer)
    seconds = (time.process_time() - begin) / len(q)
    assert batch.success.all()
    change = batch.q - q0
    distance = np.linalg.norm(change / (robot.upper - robot.lower), axis=1)
    return distance, np.degrees(np.abs(change).max(axis=1)), seconds


def nearest(solver: ik.Solver, q: Array, q0: Array) -> Array:
    """(k,) distances of the nearest solutions that `solve_all` finds."""
    robot, distances = solver.robot, []
    points, normals = robot.contacts(q)
    for row in range(len(q)):
        contacts = {
            name: ik.Contact(points[row, i], normals[row, i])
            for i, name in enumerate(robot.fingers)
        }
        best = solver.solve_all(ik.Grasp(contacts), prefer="q0", q0=q0[row], limit=1)
        distances.append(best[0].distance)
    return np.array(distances)


def main(arguments: list[str] | None = None) -> None:
    """Measure and write the report."""
    parser = argparse.ArgumentParser(description="How far solves move from q0.")
    parser.add_argument("--paths", type=int, default=40)
    parser.add_argument("--steps", type=int, default=100, help="of a path")
    parser.add_argument("--step", type=float, default=STEP, help="of the contacts [m], about")
    parser.add_argument("--count", type=int, default=4000, help="targets anywhere")
    parser.add_argument("--compared", type=int, default=300, help="of them, with solve_all")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--report", type=Path, default=Path("out/nearest"), help="folder")
    options = parser.parse_args(arguments)
    robot = ik.load_robot("kuka_lwr_barrett")
    rng = np.random.default_rng(options.seed)
    paths = [path(robot, rng, options.steps, options.step) for _ in range(options.paths)]
    q, q0 = robot.random(rng, options.count), robot.random(rng, options.count)
    steps, jumps = [], []
    for name, tolerance in TOLERANCES.items():
        solver = ik.Solver(robot, tolerance=tolerance)
        rows = slice(0, options.compared)
        nearest_distances = nearest(solver, q[rows], q0[rows])
        for prefer in PREFERENCES:
            motions, solved = solve_paths(solver, paths, prefer)
            row = [name, prefer, f"{100 * solved:.2f}", f"{np.median(motions):.3f}"]
            steps.append([*row, f"{np.quantile(motions, 0.99):.2f}", f"{motions.max():.2f}"])
            distance, motion, seconds = anywhere(solver, q, q0, prefer)
            ratio = distance[rows] / nearest_distances
            row = [name, prefer, f"{np.median(distance):.3f}", f"{np.median(motion):.0f}"]
            row += [f"{100 * np.mean(ratio < limit):.1f}" for limit in (NEAREST, 1.1)]
            jumps.append([*row, f"{1e6 * seconds:.1f}"])
            Console().print(steps[-1], jumps[-1])
    heads = ["tolerance", "prefer", "solved %", "median motion [deg]"]
    tables = [markdown_table([*heads, "99th percentile", "largest"], steps)]
    heads = ["tolerance", "prefer", "median distance", "median motion [deg]"]
    heads += ["nearest of solve_all %", "within 10 % of it", "CPU time [us]"]
    tables.append(markdown_table(heads, jumps))
    introduction = INTRODUCTION.format(step=1e3 * options.step)
    largest = max(float(row[-1]) for row in steps if row[1] == "q0")
    result = (
        f"With preference q0, no motor moves more than {largest:.2f} deg between contacts "
        f"{1e3 * options.step:g} mm apart."
    )
    parts = [
        introduction,
        f"Seed {options.seed}.",
        "## Paths",
        tables[0],
        "## Anywhere",
        tables[1],
    ]
    run_by = command(__file__, arguments)
    publish("Distance to the nearest solution", result, parts, options.report, run_by)


if __name__ == "__main__":
    main()
