"""Timings on this machine, each the median of several runs: `make bench`.

Machines differ and are noisy: quote the ratios, not the microseconds.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from targets import random_arm_targets

import casadi_ik as ik


def median_time(run: Callable[[], object], repeats: int) -> float:
    """Median wall time of a call [s]; one call goes uncounted before."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Timings on this machine.")
    parser.add_argument("--count", type=int, default=2400, help="targets per batch")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    robot = ik.load_robot("kuka_lwr_barrett")
    rng = np.random.default_rng(0)
    names = ik.shipped_grasps(robot.name)
    grasps = random_arm_targets(robot, names, options.count // len(names), rng)
    hands = robot.contacts(robot.random(rng, options.count))
    table = Table("what", "time", "ratio", title="kuka_lwr_barrett, 5 mm / 3 deg, one thread")

    solver = ik.Solver(robot, "hand-first")
    reference = 0.0
    for label, (points, normals) in (("12 grasps", grasps), ("random hands", hands)):
        batch = solver.solve_batch(points, normals)
        seconds = median_time(
            lambda p=points, n=normals: solver.solve_batch(p, n), options.repeats
        ) / len(points)
        reference = reference or seconds
        solved = f"{100 * batch.success.mean():.2f} % solved"
        add(table, f"hand-first, a solve in a batch, {label}: {solved}", seconds, reference)
    cup = ik.load_grasp("cup")
    seconds = median_time(lambda: [solver.solve(cup) for _ in range(50)], options.repeats) / 50
    add(table, "hand-first, Solver.solve of the cup", seconds, reference)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        points, normals = grasps[0][:200], grasps[1][:200]
        logged = (
            median_time(lambda: solver.solve_batch(points, normals, log=path), options.repeats)
            / 200
        )
        add(table, "hand-first, a solve in a batch that is logged", logged, reference)

    table.add_section()
    fixed: dict[str, Any] = {"limits": "ignore", "options": {"max_iterations": 200}}
    reference = 0.0
    variants: tuple[tuple[str, int, dict[str, Any]], ...] = (
        ("compiled, closed-form fingers", 240, {"finger_step": "closed-form"}),
        ("virtual machine, closed-form", 24, {"finger_step": "closed-form", "compiled": False}),
        ("virtual machine, Ipopt fingers", 12, {"finger_step": "ipopt"}),
    )
    for label, count, settings in variants:
        paper = ik.Solver(robot, "enhanced-dls", **fixed, **settings)
        rows = slice(None, None, len(grasps[0]) // count)
        points, normals = grasps[0][rows], grasps[1][rows]
        iterations = paper.solve_batch(points, normals).iterations.sum()
        repeats = 1 if settings["finger_step"] == "ipopt" else options.repeats
        seconds = median_time(
            lambda s=paper, p=points, n=normals: s.solve_batch(p, n), repeats
        ) / int(iterations)
        reference = reference or seconds
        add(table, f"enhanced-dls, an iteration, {label}", seconds, reference)
    Console().print(table)


def add(table: Table, label: str, seconds: float, reference: float) -> None:
    """A row: time and its ratio to the section's first."""
    table.add_row(label, f"{1e6 * seconds:.1f} us", f"{seconds / reference:.1f}")


if __name__ == "__main__":
    main()
