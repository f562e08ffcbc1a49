"""Writes solves to an MCAP file that ROS 2 tools and our own reader understand.

A log appears under its name when it is complete, and only then: until `close` it grows in a
hidden neighbour file, which goes away if anything fails.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from casadi_ik.errors import LogError
from casadi_ik.kernels.layout import Layout
from casadi_ik.logs import schema
from casadi_ik.logs.cdr import HEADER, Codec
from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.events import detect_events
from casadi_ik.logs.provenance import METADATA_NAME, log_metadata
from casadi_ik.solvers.recorder import Event, SolveRecord

COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}
"""The names under which a compression can be asked for."""

URDF_ATTACHMENT = "robot.urdf"
"""Name of the attachment that holds the robot description."""


class McapRecorder:
    """A `Recorder` that keeps every iteration in an MCAP file.

    Use it as a context manager; leaving it with an exception discards the log.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        robot_name: str,
        urdf: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        seed: int = 0,
        rules: EventRules | None = None,
        compression: Literal["none", "lz4", "zstd"] = "zstd",
        clock: LogClock | None = None,
    ) -> None:
        """Open the log.

        Args:
            path: Where the log shall stand; a log that stands there is replaced at `close`.
            robot_name: Name of the robot.
            urdf: The robot as URDF, attached as "robot.urdf".
            parameters: Everything that determines the solves, kept as JSON.
            seed: Seed of the run.
            rules: What counts as an event.
            compression: Of the chunks.
            clock: Rule of the log times; by default the clock starts now.

        Raises:
            LogError: The path cannot be written, or the compression is unknown.
        """
        if compression not in COMPRESSIONS:
            raise LogError(
                f"compression {compression!r}: expected one of {', '.join(COMPRESSIONS)}"
            )
        self.path = Path(path)
        self.clock = clock or LogClock.now()
        self._rules = rules or EventRules()
        self._target = Path(os.path.realpath(self.path))
        self._part = self._target.with_name(f".{self._target.name}.{secrets.token_hex(4)}.part")
        self._stream: IO[bytes] | None = None
        self._layouts: dict[str, Layout] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._recorded: set[tuple[str, int]] = set()
        self._codecs = {"solve": Codec(schema.SOLVE_SCHEMA), "event": Codec(schema.EVENT_SCHEMA)}
        metadata = log_metadata(
            robot_name,
            seed,
            {**(parameters or {}), "event_rules": asdict(self._rules)},
            compression,
            self.clock,
        )
        with self._writing():
            self._check_target()
            self._stream = self._open_part()
            self._writer = Writer(self._stream, compression=COMPRESSIONS[compression])
            self._writer.start(profile="ros2", library=f"casadi_ik {metadata['code_version']}")
            self._writer.add_metadata(METADATA_NAME, metadata)
            if urdf is not None:
                now = time.time_ns()
                self._writer.add_attachment(
                    now, now, URDF_ATTACHMENT, "application/xml", urdf.encode()
                )
            self._ids = {
                kind: self._writer.register_schema(name, "ros2msg", text.encode())
                for kind, name, text in (
                    ("solve", schema.SOLVE_NAME, schema.SOLVE_SCHEMA),
                    ("event", schema.EVENT_NAME, schema.EVENT_SCHEMA),
                )
            }

    def record(self, solve: SolveRecord) -> None:
        """Write a solve: its iterations, its events and its totals.

        Events are those the solver noticed and those `detect_events` finds in the trace.

        Raises:
            LogError: The record contradicts itself or an earlier one (the log stays usable), or
                it could not be written (the log is discarded).
        """
        summary = solve.summary
        self._check(solve)
        events = (
            *solve.events,
            *detect_events(solve.layout, solve.trace, solve.labels, self._rules),
        )
        events = tuple(sorted(events, key=lambda event: event.iteration))
        rows = len(solve.trace)
        times = self.clock.times(summary.solve_id, rows)
        solve_bytes = self._codecs["solve"].encode(_solve_values(solve))
        event_bytes = [self._codecs["event"].encode(_event_values(solve, e)) for e in events]
        block = np.empty(rows, dtype=[("header", "S4"), ("row", solve.layout.dtype)])
        block["row"] = solve.trace
        block["header"].view("u4")[:] = np.frombuffer(HEADER, "u4")
        payload = memoryview(block.tobytes())
        size = block.dtype.itemsize
        published = summary.started + (
            np.arange(1, rows + 1) * (summary.time * 1e9 / max(rows, 1))
        ).astype(np.int64)
        end = summary.started + int(summary.time * 1e9)
        self._open_channels(solve)
        with self._writing():
            add, channel = self._writer.add_message, self._channels[summary.method, "iteration"]
            for i, (log_time, publish_time) in enumerate(
                zip(times.tolist(), published.tolist(), strict=True)
            ):
                row = bytes(payload[i * size : (i + 1) * size])
                add(channel, log_time, row, publish_time, sequence=i)
            channel = self._channels[summary.method, "event"]
            for event, data in zip(events, event_bytes, strict=True):
                i = event.iteration
                add(channel, int(times[i]), data, int(published[i]), sequence=i)
            last = int(times[-1]) if rows else self.clock.start(summary.solve_id)
            channel = self._channels[summary.method, "solve"]
            add(channel, last, solve_bytes, end, sequence=summary.solve_id)
        self._recorded.add((summary.method, summary.solve_id))

    def close(self) -> None:
        """Finish the file and put it in its place; a second call does nothing.

        Raises:
            LogError: It could not be written; nothing is left behind.
        """
        if self._stream is None:
            return
        with self._writing():
            self._writer.finish()
            self._stream.close()
            self._part.replace(self._target)
        self._stream = None

    def discard(self) -> None:
        """Give the log up: nothing is left behind, and the path keeps what stood there."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            with contextlib.suppress(OSError):
                self._part.unlink()
        self._stream = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self.discard()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turns a failing disk into one `LogError`, and leaves nothing half-written."""
        with contextlib.ExitStack() as undo:
            undo.callback(self.discard)
            try:
                yield
            except OSError as error:
                reason = error.strerror or str(error)
                raise LogError(f"{self.path}: cannot write the log: {reason}") from error
            undo.pop_all()

    def _check_target(self) -> None:
        try:
            mode = self._target.stat().st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISREG(mode):
            what = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
            raise LogError(f"{self.path}: cannot write the log: the path is {what}")
        if not os.access(self._target, os.W_OK):
            raise LogError(f"{self.path}: cannot write the log: the file is read-only")

    def _open_part(self) -> IO[bytes]:
        return self._part.open("xb")

    def _check(self, solve: SolveRecord) -> None:
        summary = solve.summary
        where = f"{self.path}: method {summary.method!r}, solve {summary.solve_id}"
        if self._stream is None:
            raise LogError(f"{where}: the log is closed")
        if (summary.method, summary.solve_id) in self._recorded:
            raise LogError(f"{where} is already in the log")
        if solve.trace.ndim != 1 or solve.trace.dtype != solve.layout.dtype:
            raise LogError(f"{where}: the trace is not of its layout")
        if self._layouts.get(summary.method, solve.layout) != solve.layout:
            raise LogError(f"{where}: the layout differs from the method's earlier solves")
        if any(not 0 <= event.iteration < len(solve.trace) for event in solve.events):
            raise LogError(f"{where}: an event lies outside the trace")

    def _open_channels(self, solve: SolveRecord) -> None:
        """Register the method's three channels when it comes for the first time."""
        method = solve.summary.method
        if method in self._layouts:
            return
        text = schema.iteration_schema(solve.layout, solve.labels)
        name = schema.iteration_name(method, solve.layout, len(solve.summary.fingers))
        metadata = {
            "offered_qos_profiles": "",
            "method": method,
            "labels": json.dumps({key: list(names) for key, names in solve.labels.items()}),
        }
        self._layouts[method] = solve.layout
        with self._writing():
            schema_id = self._writer.register_schema(name, "ros2msg", text.encode())
            for kind, used in {"iteration": schema_id, **self._ids}.items():
                self._channels[method, kind] = self._writer.register_channel(
                    schema.topic(method, kind), "cdr", used, metadata
                )


def _solve_values(solve: SolveRecord) -> dict[str, Any]:
    summary = solve.summary
    return {
        **{name: value for name, value in vars(summary).items() if name != "phase_iterations"},
        "phases": tuple(summary.phase_iterations),
        "phase_iterations": tuple(summary.phase_iterations.values()),
    }


def _event_values(solve: SolveRecord, event: Event) -> dict[str, Any]:
    return {**vars(event), "solve_id": solve.summary.solve_id}
