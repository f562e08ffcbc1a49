r"""How near does `best_effort` come to targets out of reach, and how long does it take?

Targets are contacts of random configurations that are moved away from the base, so that none of
them can be reached. The reference is the nearest configuration of many random starts, of which each
descends to a local minimum, and of the answer itself::

    python studies/best_effort.py --report studies/results/best_effort
    python studies/best_effort.py --robots ur5e panda --count 2000 --starts 512

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

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.solve.nearest import NearestSearch

ROBOTS = ("ur5e", "iiwa14", "panda", "viperx_300s", "kuka_lwr_barrett", "panda+allegro_right")
EXCESSES = (0.001, 0.005, 0.02, 0.1)
"""Distances by which targets are beyond the reach of random configurations [m]."""

REACH_SAMPLES = 20_000
"""Number of configurations from which the reach of a robot is estimated."""

SAME_GAP, WORSE_GAP = 1e-6, 1e-2
"""Relative excesses over the distance of the reference that the report counts."""

INTRODUCTION = """
Contacts of random configurations are moved away from the base until their centre is 1, 5, 20 or
100 mm beyond the farthest centre of {samples:,} random configurations. *Above the best*: the
distance (the sum of squared errors, each divided by its tolerance) exceeds that of the reference by
more than this part. The reference is the best of the answer and of {starts} random starts of each
target, which descend by the same steps. *Time*: processor time of a target in a batch, which
includes the solve that fails first.
"""


@dataclass(frozen=True)
class Part:
    """Targets that are solved in one call.

    Attributes:
        robot: Name of the robot.
        number: Number of the part.
        size: Number of targets.
        starts: Number of random starts of the reference.
        seed: Seed of the targets.
    """

    robot: str
    number: int
    size: int
    starts: int
    seed: int

    @property
    def path(self) -> Path:
        """Path of the results."""
        name = f"{self.number:05d}-{self.size}-{self.starts}-{self.seed}.json"
        return Path("best_effort") / self.robot / name


def targets_of(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Return contacts (count, f, 3) and normals beyond the reach of a robot."""
    samples = robot.contacts(robot.random(np.random.default_rng(0), REACH_SAMPLES))[0].mean(axis=1)
    reach = np.linalg.norm(samples, axis=1).max() + rng.choice(EXCESSES, count)
    points, normals = robot.contacts(robot.random(rng, count))
    centres = points.mean(axis=1)
    distances = np.linalg.norm(centres, axis=1)
    return points + ((reach / distances - 1)[:, None] * centres)[:, None], normals


def solve(part: Part) -> dict[str, Any]:
    """Solve a part, and its reference."""
    robot = ik.load_robot(part.robot)
    solver, rng = ik.Solver(robot), np.random.default_rng([part.seed, part.number])
    points, normals = targets_of(robot, rng, part.size)
    for limit in (2, 100):  # a first use compiles the kernels of single rows and of lanes
        solver.solve_batch(points[:limit], normals[:limit], best_effort=True)
    begin = time.process_time()
    batch = solver.solve_batch(points, normals, best_effort=True)
    seconds = (time.process_time() - begin) / part.size
    rows = np.flatnonzero(batch.status == ik.Status.NEAREST)
    targets = solver._target_builder.from_arrays(points[rows], normals[rows])
    search: NearestSearch = solver._engine.nearest_search
    distance = search.distances(targets, np.arange(len(rows)), batch.q[rows])
    reference = distance.copy()
    for _ in range(part.starts):
        minima = search.descend(targets.starting_at(robot.random(rng, len(rows))))
        reference = np.minimum(reference, search.distances(targets, np.arange(len(rows)), minima))
    gap = distance / reference - 1
    return {
        "nearest": len(rows),
        "same": int((gap <= SAME_GAP).sum()),
        "worse": int((gap > WORSE_GAP).sum()),
        "seconds": seconds,
    }


def report(done: Sequence[tuple[Part, dict[str, Any]]], starts: int) -> tuple[str, list[Metric]]:
    """Return the table of the report and its metrics."""
    rows, metrics, near_shares = [], list[Metric](), [1.0]
    for robot in dict.fromkeys(part.robot for part, _ in done):
        results = [result for part, result in done if part.robot == robot]
        count, n_same, n_worse = (
            sum(item[key] for item in results) for key in ("nearest", "same", "worse")
        )
        near_shares.append(1 - n_worse / max(count, 1))
        times = [1e6 * item["seconds"] for item in results]
        share = [f"{100 * part / max(count, 1):.2f}" for part in (count - n_same, n_worse)]
        rows.append([robot, f"{count:,}", *share, f"{np.median(times):.0f}"])
        metrics.append(median_metric(f"best_effort/{robot}/time", times, "us"))
    heads = ["robot", "targets", "above the best by 1e-6 %", "by 1e-2 %", "time [us]"]
    text = INTRODUCTION.format(samples=REACH_SAMPLES, starts=starts)
    result = (
        f"**For every robot, at least {100 * min(near_shares):.1f} % of the answers are within "
        f"{100 * WORSE_GAP:g} % of the best distance known.**"
    )
    return f"{result}\n{text}\n{markdown_table(heads, rows)}", metrics


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Nearest configurations of targets out of reach.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, help="names of robots")
    parser.add_argument("--count", type=int, default=1000, help="targets of every robot")
    parser.add_argument("--block", type=int, default=500, help="targets solved in one call")
    parser.add_argument("--starts", type=int, default=256, help="random starts of the reference")
    parser.add_argument("--seed", type=int, default=0, help="seed of the targets")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster instead")
    parser.add_argument("--out", type=Path, default=Path("out"), help="results by part")
    parser.add_argument("--report", type=Path, help="folder (default: OUT/report)")
    options = parser.parse_args(arguments)
    block = min(options.block, options.count)
    parts = [
        Part(robot, number, block, options.starts, options.seed)
        for number in range(-(-options.count // block))
        for robot in options.robots
    ]
    run_parts(solve, parts, options.out, jobs=options.jobs, dask=options.dask)
    done, codes = read_parts(options.out, parts)
    text, metrics = report(done, options.starts)
    publish(
        "Nearest configurations of targets out of reach",
        [text],
        options.report or options.out / "report",
        command(__file__, arguments),
        {"best_effort": codes},
        metrics,
    )


if __name__ == "__main__":
    program(main)
