"""Does a follower freeze or exceed limits where an operator leads it out of reach?

Smooth random paths of contacts whose distance from the base varies from half to 1.8 times the reach
of the robot, so that most targets cannot be met. At every `INTERVAL`-th cycle the configuration is
compared with the nearest one that a global search finds::

    python studies/operator_paths.py --cycles 250000 --report studies/results/operator_paths

A run that is killed continues where it stopped.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from runner.parts import read_parts, run_parts
from runner.report import Metric, command, markdown_table, median_metric, program, publish
from scipy.spatial.transform import Rotation

import casadi_ik as ik
from casadi_ik.files.arrays import Array, Bools

ROBOTS = ("so101", "ur5e", "panda", "kuka_lwr_barrett")
PERIOD = 0.01
"""Time from cycle to cycle [s]."""

INTERVAL = 250
"""Number of cycles between two comparisons with the global optimum."""

FREEZE = 10
"""Number of consecutive cycles without motion that count as a freeze."""

STILL = 1e-9
"""Largest step of a motor at rest [rad or m]."""

NUDGE = 1e-4
"""Motion of a motor that shows whether it moves the contacts [rad or m]."""

EXCESS = 1e-9
"""Relative excess over a limit that counts as a violation."""

INTRODUCTION = """
The distance of the contacts from the base varies between 0.5 and 1.8 times the reach of the robot
(the largest distance of 2,000 random configurations), and their normals turn by up to 90 degrees;
{period:g} s per cycle, no scene. *Out of reach*: share of the compared cycles, one of {interval},
in which the search for solutions fails. A *freeze* has at least {freeze} consecutive cycles in
which no motor moves although the target does, unless all motors that move the contacts are at
limits. *Violations*: motors
that exceed a limit of position, velocity or acceleration in a cycle. *Above the optimum*: the root
of the sum of squared errors, each divided by its tolerance, times the position tolerance, minus the
same of the nearest configuration of a global search. It is positive because a follower stays on its
branch, and because its velocities are limited. *Time*: of one cycle.
"""


@dataclass(frozen=True)
class Part:
    """Path of one robot.

    Attributes:
        robot: Name of the robot.
        number: Number of the path, also its seed.
        cycles: Number of cycles.
    """

    robot: str
    number: int
    cycles: int

    @property
    def path(self) -> Path:
        """Path of the results."""
        return Path("operator_paths", f"{self.robot}-{self.cycles}-{self.number}.json")

    @property
    def size(self) -> int:
        """Number of cycles."""
        return self.cycles


def operator_path(robot: ik.ArmHand, cycles: int, seed: int) -> tuple[Array, Array]:
    """Return contact points [m] and normals (cycles, f, 3) of a path, mostly out of reach."""
    rng = np.random.default_rng(seed)
    samples, _ = robot.contacts(robot.random(rng, 2000))
    reach = np.linalg.norm(samples.mean(axis=1), axis=1).max()
    seconds = PERIOD * np.arange(cycles)[:, None]

    def smooth(count: int) -> Array:
        """Return smooth random numbers (cycles, count) of about -1 to 1."""
        waves = [
            np.sin(2 * np.pi * (rng.uniform(0.02, 0.1, count) * seconds + rng.random(count)))
            for _ in range(3)
        ]
        return sum(waves, np.zeros((cycles, count))) / np.sqrt(3)

    initial_points, initial_normals = robot.contacts(robot.home)
    centre = initial_points.mean(axis=0)
    direction = centre / np.linalg.norm(centre) + smooth(3)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    pulse = np.exp((np.cos(2 * np.pi * (seconds / 8 + rng.random())) - 1) / 0.6)
    middle = reach * (1.8 - 1.3 * pulse) * direction
    turns = Rotation.from_rotvec(np.pi / 2 * smooth(3)).as_matrix()[:, None]
    points = middle[:, None] + (turns @ (initial_points - centre)[..., None])[..., 0]
    return points, (turns @ initial_normals[..., None])[..., 0]


def follow(part: Part) -> dict[str, Any]:
    """Follow one path, and compare it with the limits and with the global optimum."""
    robot = ik.load_robot(part.robot)
    solver = ik.Solver(robot)
    points, normals = operator_path(robot, part.cycles, part.number)
    follower = solver.follow(robot.home, PERIOD)
    q = np.empty((part.cycles, len(robot.actuators)))
    begin = time.process_time()
    for i, target in enumerate(zip(points, normals, strict=True)):
        q[i] = follower(*target)
    seconds = (time.process_time() - begin) / part.cycles
    steps = np.diff(q, axis=0, prepend=robot.home[None])
    changes = np.diff(steps, axis=0, prepend=np.zeros((1, len(robot.actuators))))
    slack = 1 + EXCESS
    violations = (
        (q < robot.lower)
        | (q > robot.upper)
        | (np.abs(steps) > slack * PERIOD * follower.velocity)
        | (np.abs(changes) > slack * PERIOD**2 * follower.acceleration + 1e-15)
    )
    is_still: Bools = np.asarray((np.abs(steps) <= STILL).all(axis=1))
    still_rows = np.flatnonzero(is_still)
    is_still[still_rows] = _can_move(robot, q[still_rows])
    windows = np.lib.stride_tricks.sliding_window_view(is_still, FREEZE).all(axis=1)
    freezes = int(np.count_nonzero(np.diff(windows.astype(int), prepend=0) > 0))
    rows = np.arange(INTERVAL, part.cycles, INTERVAL)
    batch = solver.solve_batch(points[rows], normals[rows], best_effort=True, diagnose=False)
    costs = [
        _distance(solver, configurations, points[rows], normals[rows])
        for configurations in (q[rows], batch.q)
    ]
    is_missed = batch.status == ik.Status.NEAREST
    return {
        "freezes": freezes,
        "violations": int(np.count_nonzero(violations)),
        "compared": len(rows),
        "missed": int(is_missed.sum()),
        "excess": (costs[0] - costs[1])[is_missed].tolist(),
        "seconds": seconds,
    }


def _can_move(robot: ik.ArmHand, q: Array) -> Array:
    """Return True for configurations (k, n) with a motor within limits that moves the contacts."""
    points, normals = robot.contacts(q)
    can_move = np.zeros(len(q), dtype=bool)
    for i in range(q.shape[1]):
        nudged = q.copy()
        nudged[:, i] += NUDGE
        moved_points, turned_normals = robot.contacts(nudged)
        change = np.abs(moved_points - points) + np.abs(turned_normals - normals)
        is_within_limits = (q[:, i] > robot.lower[i]) & (q[:, i] < robot.upper[i])
        can_move |= is_within_limits & (change.max(axis=(1, 2)) > NUDGE**2)
    return can_move


def _distance(solver: ik.Solver, q: Array, points: Array, normals: Array) -> Array:
    """Return the root of the sum of squared errors over tolerance, times the tolerance [m]."""
    position, angle = solver.robot.errors(q, points, normals)
    (tolerance,) = set(solver.tolerances.values())
    chords = np.sin(angle / 2) / np.sin(tolerance.angle / 2)
    squares = (position / tolerance.position) ** 2 + chords**2
    return tolerance.position * np.sqrt(squares.sum(axis=1))


def report(done: Sequence[tuple[Part, dict[str, Any]]]) -> tuple[str, str, list[Metric]]:
    """Return the result sentence, the table and the metrics of the report."""
    rows, metrics, totals = [], list[Metric](), np.zeros(4, dtype=int)
    for robot in dict.fromkeys(part.robot for part, _ in done):
        results = [result for part, result in done if part.robot == robot]
        cycles = sum(part.cycles for part, _ in done if part.robot == robot)
        names = "freezes", "violations", "missed", "compared"
        counts = np.array([sum(item[name] for item in results) for name in names])
        totals += [cycles, *counts[:2], 0]
        excess = 1e3 * np.concatenate([item["excess"] for item in results])
        times = [1e6 * item["seconds"] for item in results]
        rows.append(
            [
                robot,
                f"{cycles:,}",
                f"{100 * counts[2] / counts[3]:.0f}",
                f"{counts[0]:,}",
                f"{counts[1]:,}",
                *(f"{np.quantile(excess, share):.2f}" for share in (0.5, 0.9)),
                f"{np.median(times):.0f}",
            ]
        )
        metrics.append(median_metric(f"operator_paths/{robot}/excess", excess, "mm"))
    heads = ["robot", "cycles", "out of reach %", "freezes", "violations"]
    heads += ["above the optimum: median mm", "90 % mm", "time us"]
    result = (
        f"In {totals[0]:,} cycles there were {totals[1]:,} freezes and {totals[2]:,} violations of "
        "limits."
    )
    text = INTRODUCTION.format(period=PERIOD, interval=INTERVAL, freeze=FREEZE)
    return result, f"{text}\n{markdown_table(heads, rows)}", metrics


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Followers of targets that are out of reach.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, help="names of robots")
    parser.add_argument("--cycles", type=int, default=25_000, help="cycles of every robot")
    parser.add_argument("--block", type=int, default=25_000, help="cycles of one path")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out"), help="results by part")
    parser.add_argument("--report", type=Path, help="folder (default: OUT/report)")
    options = parser.parse_args(arguments)
    block = min(options.block, options.cycles)
    parts = [
        Part(robot, number, block)
        for number in range(-(-options.cycles // block))
        for robot in options.robots
    ]
    run_parts(follow, parts, options.out, jobs=options.jobs, dask=options.dask)
    done, codes = read_parts(options.out, parts)
    result, text, metrics = report(done)
    publish(
        "Followers of targets out of reach",
        result,
        [text],
        options.report or options.out / "report",
        command(__file__, arguments),
        {"operator_paths": codes},
        metrics,
    )


if __name__ == "__main__":
    program(main)
