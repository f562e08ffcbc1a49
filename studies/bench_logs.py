"""What a log costs: writing, its size, a study with it against one without, reading.

::

    python studies/bench_logs.py
    python studies/bench_logs.py --count 24000 --repeats 9
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self, get_args

import numpy as np
from bench_report import Section
from samplers import random_arm_targets

import casadi_ik as ik
from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.arrays import Array

METHODS: dict[str, dict[str, Any]] = {
    "hand-first": {},
    "enhanced-dls": {"finger_step": "closed-form", "limits": "ignore"},
}
"""Few iterations a solve, and many."""

FEWER = 25
"""The slow methods get so many times fewer targets."""

Targets = tuple[Array, Array]


class Dropped:
    """A recorder that forgets the blocks: the solves are traced, nothing is done with it."""

    def record(self, block: SolveBlock) -> None:
        """Forget it."""

    def close(self) -> None:
        """Nothing to do."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Nothing to do."""


class Kept(Dropped):
    """A recorder that keeps the blocks in memory."""

    def __init__(self) -> None:
        self.blocks: list[SolveBlock] = []

    def record(self, block: SolveBlock) -> None:
        """Keep it."""
        self.blocks.append(block)


def cases(count: int) -> Iterator[tuple[ik.Solver, Targets]]:
    """A solver of each of the `METHODS` and its targets: `count` of hand-first, fewer of others."""
    robot = ik.load_robot("kuka_lwr_barrett")
    names = ik.shipped_grasps(robot.name)
    for method, settings in METHODS.items():
        each = max(count // len(names) // (1 if not settings else FEWER), 1)
        targets = random_arm_targets(robot, names, each, np.random.default_rng(0))
        yield ik.Solver(robot, method, **settings), targets


def least(run: Callable[[], object], repeats: int) -> float:
    """Least CPU time of several calls [s]; one call goes uncounted before."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def report(count: int, repeats: int) -> Section:
    """Measure.

    Args:
        count: Targets of hand-first; the others get fewer.
        repeats: Of each measurement.
    """
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        for solver, targets in cases(count):
            for compression in get_args(ik.logs.Compression):
                cells = _measured(solver, targets, compression, path, repeats)
                rows.append([solver.method, compression, *cells])
    columns = (
        *("method", "compression", "iterations per solve", "write µs", "bytes"),
        *("study, CPU", "study, wall", "read µs", "to polars µs"),
    )
    note = (
        "Per iteration, solves and events included; the least CPU time of all repetitions. Study: "
        "`solve_batch` with a log over the same without one; wall time waits for the disk as well."
    )
    return Section("Logs", columns, rows, note)


def _measured(
    solver: ik.Solver, targets: Targets, compression: Any, path: Path, repeats: int
) -> list[str]:
    kept = Kept()
    solver.solve_batch(*targets, log=kept)
    iterations = sum(len(block.rows) for block in kept.blocks)

    def write() -> None:
        name = solver.robot.name
        with ik.logs.McapRecorder(path, robot_name=name, compression=compression) as recorder:
            for block in kept.blocks:
                recorder.record(block)

    def logged() -> None:
        solver.solve_batch(*targets, log=path, compression=compression)

    ratios = _ratios(lambda: solver.solve_batch(*targets), logged, repeats)
    written = least(write, repeats)
    log = ik.logs.open(path)
    read = least(log.iterations, repeats)
    table = log.iterations()
    frame = least(table.frame, repeats)
    return [
        f"{iterations / len(targets[0]):.0f}",
        f"{1e6 * written / iterations:.2f}",
        f"{path.stat().st_size / iterations:.0f}",
        *(f"{ratio:.2f}" for ratio in ratios),
        f"{1e6 * read / iterations:.2f}",
        f"{1e6 * frame / iterations:.2f}",
    ]


def _ratios(plain: Callable[[], object], logged: Callable[[], object], repeats: int) -> Array:
    """CPU and wall time of one call over those of another, which take turns."""
    times = np.zeros((repeats, 2, 2))
    for i, j in np.ndindex(repeats, 2):
        clocks = time.process_time, time.perf_counter
        begin = [clock() for clock in clocks]
        (plain, logged)[j]()
        times[i, j] = [clock() - start for clock, start in zip(clocks, begin, strict=True)]
    bare, full = times.min(axis=0)
    return full / bare


def main(description: str, measure: Callable[[int, int], Section], repeats: int) -> None:
    """Measure as the command line says, and print.

    Args:
        description: What is measured.
        measure: Called with the targets of hand-first and the repetitions.
        repeats: Unless the command line says otherwise.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--count", type=int, default=12_000, help="targets of hand-first")
    parser.add_argument("--repeats", type=int, default=repeats)
    options = parser.parse_args()
    measure(options.count, options.repeats).show()


if __name__ == "__main__":
    main("What a log costs.", report, repeats=5)
