"""Timings on this machine: `make bench` prints them and writes studies/results/bench/README.md.

python studies/bench.py             # everything, some minutes
python studies/bench.py --quick     # small sizes, to see that it runs
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench_log_parts
import bench_logs
import numpy as np
from bench_first_use import first_use
from bench_report import Section, write_report
from peers import installed, kinds, measured
from targets import random_arm_targets

import casadi_ik as ik

ROBOT = "kuka_lwr_barrett"
REPORT = Path(__file__).parent / "results" / "bench" / "README.md"


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        batch: Targets per batch.
        repeats: Of every measurement.
        memory: Solves of the memory test.
        peers: Targets of each kind for other solvers.
        iterations: Targets on which the paper's methods iterate.
        later: Processes that find the cache full.
    """

    batch: int = 6000
    repeats: int = 7
    memory: int = 1_000_000
    peers: int = 60
    iterations: int = 120
    later: int = 3


QUICK = Sizes(batch=240, repeats=2, memory=2_000, peers=12, iterations=4, later=1)


@dataclass(frozen=True)
class Timing:
    """Seconds of several repetitions, each divided by what was done in it."""

    least: float
    median: float

    @property
    def cells(self) -> tuple[str, str]:
        """In microseconds."""
        return f"{1e6 * self.least:.1f}", f"{1e6 * self.median:.1f}"


def timed(
    run: Callable[[], object], repeats: int, count: int, clock: Callable[[], float]
) -> Timing:
    """Time a call that does `count` things; one call goes uncounted before."""
    run()
    times = []
    for _ in range(repeats):
        begin = clock()
        run()
        times.append((clock() - begin) / count)
    return Timing(min(times), statistics.median(times))


def solves(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """Hand-first on one thread, a solve in a batch."""
    rows = []
    for kind, tolerance, targets in kinds(robot, sizes.batch, 0):
        solver = ik.Solver(robot, tolerance=tolerance)
        solver.solve_batch(*targets)  # may compile
        batch = solver.solve_batch(*targets)
        count = len(targets[0])
        timing = timed(
            lambda s=solver, t=targets: s.solve_batch(*t), sizes.repeats, count, time.thread_time
        )
        inside = f"{1e6 * float(batch.time.mean()):.1f}"
        solved = f"{100 * batch.success.mean():.2f}"
        rows.append((kind, solved, *timing.cells, inside, f"{batch.iterations.mean():.1f}"))
    note = (
        f"{sizes.batch} targets of each kind, {sizes.repeats} repetitions of `solve_batch`, CPU "
        "time of one thread, verdicts included; the last but one column is `solution.time`."
    )
    columns = "targets", "solved %", "least µs", "median µs", "of it in the solve µs", "iterations"
    return Section("hand-first, a solve in a batch", columns, rows, note)


def single(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """`Solver.solve` of one grasp against the same in a batch."""
    rows = []
    for kind, tolerance, (points, normals) in kinds(robot, 60, 0):
        solver = ik.Solver(robot, tolerance=tolerance)
        grasps = [
            ik.Grasp({n: ik.Contact(*c) for n, *c in zip(robot.fingers, p, m, strict=True)})
            for p, m in zip(points, normals, strict=True)
        ]
        count = len(grasps)
        one = timed(
            lambda s=solver, g=grasps: [s.solve(grasp) for grasp in g],
            sizes.repeats,
            count,
            time.thread_time,
        )
        many = timed(
            lambda s=solver, p=points, n=normals: s.solve_batch(p, n),
            sizes.repeats,
            count,
            time.thread_time,
        )
        rows.append((kind, one.cells[0], many.cells[0], f"{1e6 * (one.least - many.least):.0f}"))
    columns = "targets", "Solver.solve µs", "in a batch µs", "on top µs"
    return Section("One grasp at a time", columns, rows, "CPU time, the least of all repetitions.")


def diagnoses(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """What the reason costs where there is no solution."""
    rng = np.random.default_rng(0)
    count = max(sizes.batch // 60, 4)
    points, normals = robot.contacts(robot.random(rng, count))
    turned = normals + rng.normal(0, 0.5, normals.shape)
    turned /= np.linalg.norm(turned, axis=2, keepdims=True)
    away = np.array([[[1.5, 0.0, 0.0]]])
    sets = {
        "1.5 m too far": (points + away, normals),
        "contacts moved by 30 mm": (points + rng.normal(0, 0.03, points.shape), normals),
        "normals turned by 30 deg": (points, turned),
    }
    solver = ik.Solver(robot)
    rows = []
    for name, targets in sets.items():
        found = solver.solve_batch(*targets, diagnose=True).diagnoses
        asked = [row for row, diagnosis in enumerate(found) if diagnosis is not None]
        there = targets[0][asked], targets[1][asked]
        bare, full = (
            timed(
                lambda t=there, d=diagnose: solver.solve_batch(*t, diagnose=d),
                max(sizes.repeats // 2, 1),
                len(asked),
                time.thread_time,
            ).least
            for diagnose in (False, True)
        )
        cells = f"{1e3 * bare:.2f}", f"{1e3 * (full - bare):.2f}", f"{full / bare - 1:.1f}"
        rows.append((name, str(len(asked)), *cells))
    columns = "targets", "not solved", "solve ms", "diagnosis ms", "ratio"
    return Section("Why not: a diagnosis", columns, rows, "CPU time of one thread, per target.")


def threads(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """Two threads against one."""
    rows = []
    for kind, tolerance, targets in kinds(robot, 4 * sizes.batch, 0)[:2]:
        solver = ik.Solver(robot, tolerance=tolerance)
        one, two = (
            timed(
                lambda s=solver, t=targets, j=jobs: s.solve_batch(*t, jobs=j),
                sizes.repeats,
                len(targets[0]),
                time.perf_counter,
            )
            for jobs in (1, 2)
        )
        rows.append((kind, one.cells[0], two.cells[0], f"{one.least / two.least:.2f}"))
    columns = "targets", "jobs=1 µs", "jobs=2 µs", "ratio"
    note = "Wall time, the least of all repetitions; needs two idle cores."
    return Section("Threads", columns, rows, note)


def memory(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """Peak of the memory after a tenth of the solves and after all of them."""
    solver = ik.Solver(robot)
    rng = np.random.default_rng(0)
    part = sizes.memory // 10
    rows = []
    for done in range(1, 11):
        for _ in solver.solve_blocks(_hands(robot, rng, part)):
            pass
        rows.append((f"{done * part}", f"{_peak():.1f}"))
    chosen = [rows[0], rows[4], rows[9]]
    grown = f"{float(rows[9][1]) - float(rows[0][1]):.1f}"
    note = f"Peak of the whole process; from the first to the last row it grew by {grown} MB."
    return Section("Memory over solves in blocks", ("solves", "peak MB"), chosen, note)


def _hands(
    robot: ik.ArmHand, rng: np.random.Generator, count: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for start in range(0, count, 4096):
        yield robot.contacts(robot.random(rng, min(4096, count - start)))


def _peak() -> float:
    """Largest resident size so far [MB]."""
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used / (2**20 if sys.platform == "darwin" else 2**10)


def iterations(robot: ik.ArmHand, sizes: Sizes) -> Section:
    """What an iteration of the other methods costs."""
    names = ik.shipped_grasps(robot.name)
    each = max(sizes.iterations // len(names), 1)
    rng = np.random.default_rng(0)
    targets = random_arm_targets(robot, names, each, rng)
    rows = []
    for method in ik.METHODS:
        if method in ("hand-first", "ipopt"):
            continue
        steps = ("closed-form", "ipopt") if method.startswith("enhanced") else (None,)
        for finger_step in steps:
            settings: dict[str, Any] = {"finger_step": finger_step} if finger_step else {}
            solver = ik.Solver(robot, method, **settings)
            slow = finger_step == "ipopt"
            points, normals = (array[: 2 if slow else None] for array in targets)
            total = int(solver.solve_batch(points, normals).iterations.sum())
            timing = timed(
                lambda s=solver, p=points, n=normals: s.solve_batch(p, n),
                1 if slow else sizes.repeats,
                total,
                time.thread_time,
            )
            rows.append((method, finger_step or "", *timing.cells))
    columns = "method", "finger step", "least µs", "median µs"
    return Section("An iteration of other methods", columns, rows, "CPU time of one thread.")


MEASUREMENTS: dict[str, Callable[[ik.ArmHand, Sizes], Section]] = {
    "memory": memory,
    "solves": solves,
    "single": single,
    "diagnoses": diagnoses,
    "threads": threads,
    "first-use": lambda _, sizes: first_use(ik.METHODS, sizes.later),
    "iterations": iterations,
    "logs": lambda _, sizes: bench_logs.report(sizes.batch, sizes.repeats),
    "log-parts": lambda _, sizes: bench_log_parts.report(sizes.batch, sizes.repeats),
    "peers": lambda _, sizes: measured(sizes.peers, 0, installed()),
}


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, write the report."""
    parser = argparse.ArgumentParser(description="Timings on this machine.")
    parser.add_argument("--quick", action="store_true", help="small sizes; no report unless --out")
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS, default=list(MEASUREMENTS))
    parser.add_argument("--out", type=Path, help=f"the report (default: {REPORT.name} of results)")
    options = parser.parse_args(arguments)
    robot = ik.load_robot(ROBOT)
    found = []
    for name in options.only:
        section = MEASUREMENTS[name](robot, QUICK if options.quick else Sizes())
        section.show()
        found.append(section)
    out = options.out or (None if options.quick else REPORT)
    if out is not None:
        words = ["--quick"] * options.quick
        if len(found) < len(MEASUREMENTS):
            words += ["--only", *options.only]
        write_report(out, " ".join(["python studies/bench.py", *words]), found)


if __name__ == "__main__":
    main()
