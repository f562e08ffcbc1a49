"""Where the time of a logged study goes: the same solves without a log, traced, and logged.

::

    python studies/bench_log_parts.py
    python studies/bench_log_parts.py --count 24000 --repeats 15
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from bench_logs import Dropped, Targets, cases, main
from bench_report import Section

import casadi_ik as ik
from casadi_ik.logs.mcap import chunk
from casadi_ik.logs.mcap import file as mcap_file
from casadi_ik.logs.write import chunk_stream
from casadi_ik.logs.write import recorder as writer

WRITING = ("checksum", "compression", "writing to disk")
"""What is done to finished bytes, whoever has made them."""

STAGES = ("detecting events", "solve rows", "times and order", "filling chunks", *WRITING)
"""What a log consists of, in this order; what is not among them is in the rest."""


class Stopwatch:
    """CPU time by stage [s] of what is run under `watching`."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.bytes = 0

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted."""

        def run(*arguments: Any, **options: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds[stage] += time.process_time() - begin

        return run

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch the writer at work."""

        def checksum(data: memoryview) -> int:
            self.bytes += len(data)
            return crc32(data)

        crc32 = self.timed("checksum", chunk.zlib.crc32)
        compressors = {
            name: (text, self.timed("compression", compress))
            for name, (text, compress) in chunk.COMPRESSORS.items()
        }
        watched = (
            (writer, "detect_events", "detecting events"),
            (writer, "solve_rows", "solve rows"),
            (writer, "block_messages", "times and order"),
            (chunk_stream, "fill", "filling chunks"),
            (mcap_file.McapFile, "write", "writing to disk"),
        )
        patches = [
            mock.patch.object(chunk, "zlib", SimpleNamespace(crc32=checksum)),
            mock.patch.object(chunk, "COMPRESSORS", compressors),
            *(
                mock.patch.object(place, name, self.timed(stage, getattr(place, name)))
                for place, name, stage in watched
            ),
        ]
        for patch in patches:
            patch.start()
        try:
            yield
        finally:
            for patch in patches:
                patch.stop()


def report(count: int, repeats: int) -> Section:
    """Measure.

    Args:
        count: Targets of hand-first; the others get fewer.
        repeats: Of every run; they take turns.
    """
    rows: list[list[str]] = []
    notes = []
    for solver, targets in cases(count):
        found, note = _measured(solver, targets, repeats)
        rows += found
        notes.append(note)
    columns = "method", "part", "µs a solve", "µs an iteration", "of a solve without log %"
    text = (
        "CPU time; the log with zstd. Of each kind of run the one with the least total counts. "
        f"{' '.join(notes)}"
    )
    return Section("What a log consists of", columns, rows, text)


def _measured(solver: ik.Solver, targets: Targets, repeats: int) -> tuple[list[list[str]], str]:
    """Rows of the table and a sentence about them."""
    least: dict[str, tuple[float, Stopwatch]] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.mcap"
        runs: dict[str, dict[str, Any]] = {
            "without": {},
            "traced": {"log": Dropped()},
            "logged": {"log": path},
            "sampled": {"log": path, "keep": ik.logs.Keep(sample=0.01)},
        }
        for turn in range(repeats + 1):
            for name, options in runs.items():
                watch = Stopwatch()
                with watch.watching():
                    begin = time.process_time()
                    solver.solve_batch(*targets, **options)
                    total = time.process_time() - begin
                if turn and (name not in least or total < least[name][0]):
                    least[name] = total, watch
    solves = len(targets[0])
    iterations = int(solver.solve_batch(*targets).iterations.sum())
    (bare, _), (traced, _), (full, watch), (sampled, _) = (least[name] for name in runs)
    parts = {"solving, without log": bare, "tracing": traced - bare}
    parts |= {stage: watch.seconds[stage] for stage in STAGES}
    parts |= {"the rest (indexes, colder caches)": full - traced - sum(watch.seconds.values())}
    parts |= {"solving and logging": full, "the same, keep=Keep(sample=0.01)": sampled}
    rows = [
        [
            solver.method,
            part,
            f"{1e6 * seconds / solves:.2f}",
            f"{1e6 * seconds / iterations:.3f}",
            f"{100 * seconds / bare:.1f}",
        ]
        for part, seconds in parts.items()
    ]
    writing = sum(watch.seconds[stage] for stage in WRITING)
    note = (
        f"A solve of {solver.method} leaves {watch.bytes / solves:.0f} bytes; to check, compress "
        f"and write them takes {100 * writing / bare:.0f} % of the time it takes to solve, at "
        f"{watch.bytes / writing / 1e6:.0f} MB/s; that bounds what a log of every iteration costs."
    )
    return rows, note


if __name__ == "__main__":
    main("Where the time of a logged study goes.", report, repeats=9)
