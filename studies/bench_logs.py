"""What a log costs: writing, its size, a study with it against one without, reading.

::

    python studies/bench_logs.py
    python studies/bench_logs.py --count 24000 --repeats 9
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from targets import random_arm_targets

import casadi_ik as ik
from casadi_ik.solvers.recorder import SolveBlock

METHODS: dict[str, dict[str, Any]] = {
    "hand-first": {},
    "enhanced-dls": {"finger_step": "closed-form", "limits": "ignore"},
}
"""Few iterations a solve, and many."""

FEWER = 25
"""The slow methods get so many times fewer targets."""


class Report(NamedTuple):
    """A table and how it was measured."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str


class Kept:
    """A recorder that keeps the blocks in memory."""

    def __init__(self) -> None:
        self.blocks: list[SolveBlock] = []

    def record(self, block: SolveBlock) -> None:
        """Keep it."""
        self.blocks.append(block)

    def close(self) -> None:
        """Nothing to do."""

    def __enter__(self) -> Kept:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Nothing to do."""


def least(run: Callable[[], object], repeats: int) -> float:
    """Least CPU time of several calls [s]; one call goes uncounted before."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def report(count: int = 12_000, repeats: int = 5) -> Report:
    """Measure.

    Args:
        count: Targets of hand-first; the others get fewer.
        repeats: Of each measurement.
    """
    robot = ik.load_robot("kuka_lwr_barrett")
    names = ik.shipped_grasps(robot.name)
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        for method, settings in METHODS.items():
            each = max(count // len(names) // (1 if not settings else FEWER), 1)
            targets = random_arm_targets(robot, names, each, np.random.default_rng(0))
            solver = ik.Solver(robot, method, **settings)
            for compression in get_args(ik.logs.Compression):
                rows.append(
                    [method, compression, *_measured(solver, targets, compression, path, repeats)]
                )
    columns = (
        *("method", "compression", "iterations per solve", "write µs", "bytes"),
        *("study, CPU", "study, wall", "read µs", "to polars µs"),
    )
    note = (
        "Per iteration, solves and events included; the least CPU time of all repetitions. Study: "
        "`solve_batch` with a log over the same without one; chunks are compressed and written by "
        "a thread of their own, so that the wall time needs an idle core to profit."
    )
    return Report("Logs", columns, rows, note)


def _measured(
    solver: ik.Solver,
    targets: tuple[np.ndarray, np.ndarray],
    compression: Any,
    path: Path,
    repeats: int,
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


def _ratios(
    plain: Callable[[], object], logged: Callable[[], object], repeats: int
) -> NDArray[np.float64]:
    """CPU and wall time of one call over those of another, which take turns."""
    times = np.zeros((repeats, 2, 2))
    for i, j in np.ndindex(repeats, 2):
        clocks = time.process_time, time.perf_counter
        begin = [clock() for clock in clocks]
        (plain, logged)[j]()
        times[i, j] = [clock() - start for clock, start in zip(clocks, begin, strict=True)]
    bare, full = times.min(axis=0)
    return full / bare


def show(found: Report) -> None:
    """Print it."""
    table = Table(*found.columns, title=found.title, caption=found.note)
    for row in found.rows:
        table.add_row(*row)
    Console().print(table)


def main(arguments: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="What a log costs.")
    parser.add_argument("--count", type=int, default=12_000, help="targets of hand-first")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    show(report(options.count, options.repeats))


if __name__ == "__main__":
    main()
