"""Writes solves to an MCAP file that ROS 2 tools and our own reader understand.

The iterations come as the array that the compiled loop wrote; they are copied once, into the
chunk, and everything about them is done for a whole block of solves at once. A chunk is closed at
the first solve boundary past `CHUNK_SIZE` and written with its index in one go, so that a crash
loses at most the chunk that was being filled.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.logs import schema
from casadi_ik.logs.chunk import COMPRESSORS, Run, chunk_bytes, definitions
from casadi_ik.logs.clock import LogClock
from casadi_ik.logs.event_kinds import SINGULAR, EventKind, event_format
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.events import detect_events
from casadi_ik.logs.keep import Keep
from casadi_ik.logs.mcap_file import McapFile, Summary
from casadi_ik.logs.message import HEAD, fill
from casadi_ik.logs.provenance import METADATA_NAME, log_metadata
from casadi_ik.logs.solve_rows import solve_format, solve_rows
from casadi_ik.solvers.method import TraceFormat
from casadi_ik.solvers.recorder import SolveBlock

Compression = Literal["none", "lz4", "zstd"]

CHUNK_SIZE = 2**21
"""A chunk is closed at the end of the first solve with which it is larger [bytes]."""

URDF_ATTACHMENT = "robot.urdf"
"""Name of the attachment that holds the robot description."""


@dataclass(frozen=True, eq=False)
class _Messages:
    """What some solves of a method have to say on one of its topics.

    Attributes:
        channel: Channel id.
        rows: (m,) payloads, solve by solve.
        sequence: (m,).
        log_time: (m,) [ns].
        publish_time: (m,) [ns].
        ends: (k,) how many of them belong to the first solves up to each.
    """

    channel: int
    rows: NDArray[Any]
    sequence: np.ndarray
    log_time: np.ndarray
    publish_time: np.ndarray
    ends: NDArray[np.int64]

    @property
    def size(self) -> int:
        """Of one message [bytes]."""
        return HEAD.itemsize + self.rows.dtype.itemsize

    def of_solves(self, start: int, stop: int) -> _Messages:
        """Those of some of the solves."""
        first = int(self.ends[start - 1]) if start else 0
        part = slice(first, int(self.ends[stop - 1]))
        return _Messages(
            self.channel,
            self.rows[part],
            self.sequence[part],
            self.log_time[part],
            self.publish_time[part],
            self.ends[start:stop] - first,
        )


@dataclass(frozen=True, eq=False)
class _Method:
    """What a method's solves look like in this log."""

    form: TraceFormat
    fingers: tuple[str, ...]
    formats: Mapping[str, TraceFormat]
    channels: Mapping[str, int]


class McapRecorder:
    """A `Recorder` that keeps every iteration in an MCAP file.

    Use it as a context manager. Leaving it with an exception gives up what has not reached the
    disk; a log that has nothing on the disk is gone, one that has is finished. What stood at the
    path stays until the first chunk is written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        robot_name: str,
        urdf: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        seed: int = 0,
        keep: Keep | None = None,
        rules: EventRules | None = None,
        compression: Compression = "zstd",
        clock: LogClock | None = None,
    ) -> None:
        """Open the log.

        Args:
            path: Where the log shall stand.
            robot_name: Name of the robot.
            urdf: The robot as URDF, attached as "robot.urdf".
            parameters: Everything that determines the solves, kept as JSON.
            seed: Seed of the run.
            keep: Which solves keep their iterations; all unless said.
            rules: What counts as an event.
            compression: Of the chunks; zstd is level 1.
            clock: Rule of the log times.

        Raises:
            LogError: The path cannot be written, somebody is writing it, or the compression is
                unknown.
        """
        if compression not in COMPRESSORS:
            raise LogError(f"compression {compression!r}: expected one of {', '.join(COMPRESSORS)}")
        self.path = Path(path)
        self.clock = clock or LogClock()
        self.keep = keep or Keep()
        self._rules = rules or EventRules()
        self._compression = compression
        self._methods: dict[str, _Method] = {}
        self._recorded: dict[str, list[range]] = {}
        self._waiting: list[_Messages] = []
        self._waiting_size = 0
        self._new: tuple[list[Schema], list[Channel]] = ([], [])
        self._summary = Summary()
        metadata = log_metadata(
            robot_name,
            seed,
            {**(parameters or {}), "event_rules": asdict(self._rules)},
            asdict(self.keep),
            compression,
            self.clock,
        )
        now, attached = time.time_ns(), []
        if urdf is not None:
            data = urdf.encode()
            attached.append(Attachment(now, now, URDF_ATTACHMENT, "application/xml", data))
        self._file = McapFile(self.path)
        self._beginning = self._summary.beginning(
            "ros2",
            f"casadi_ik {metadata['code_version']}",
            Metadata(METADATA_NAME, metadata),
            attached,
        )

    def record(self, block: SolveBlock) -> None:
        """Write solves: their totals, and of those that are kept their iterations and events.

        Raises:
            LogError: The block contradicts itself or an earlier one (the log stays usable), or it
                could not be written (the log ends with the chunk before).
        """
        if len(block) == 0:
            return
        self._check(block)
        method = self._method(block)
        counts = block.batch.iterations
        events = detect_events(block.format, block.rows, counts, self._rules)
        tally = np.zeros((len(block), len(EventKind)), dtype=np.int64)
        np.add.at(tally, (events["solve_id"], events["kind"]), 1)
        solves = solve_rows(block, tally, method.formats["solve"].layout)
        kept = self.keep(block.first, block.batch.success, tally[:, SINGULAR].any(axis=1))
        solves["kept"] = kept
        parts = self._messages(block, method, events, solves, kept)
        self._recorded.setdefault(block.method, []).append(_numbers(block))
        start = 0
        size = sum(part.ends * part.size for part in parts)
        while start < len(block):
            done = int(size[start - 1]) if start else 0
            full = done + CHUNK_SIZE - self._waiting_size
            stop = min(int(np.searchsorted(size, full)) + 1, len(block))
            self._waiting += [part.of_solves(start, stop) for part in parts]
            self._waiting_size += int(size[stop - 1]) - done
            if self._waiting_size >= CHUNK_SIZE:
                self._flush()
            start = stop

    def close(self) -> None:
        """Finish the file; a second call does nothing.

        Raises:
            LogError: It could not be written; the chunks before can be read.
        """
        if self._file.closed:
            return
        self._flush()
        self._finish()

    def discard(self) -> None:
        """Give up what is not on the disk; a log of which nothing is there is gone."""
        if self._file.closed:
            return
        if self._file.position:
            self._finish()
        self._file.close()

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
            return
        with contextlib.suppress(LogError):
            self.discard()

    def _check(self, block: SolveBlock) -> None:
        where = f"{self.path}: method {block.method!r}, solve {block.first}"
        if self._file.closed:
            raise LogError(f"{where}: the log is closed")
        if len(block) > 1:
            where += f" to {block.first + len(block) - 1}"
        numbers = _numbers(block)
        for other in self._recorded.get(block.method, ()):
            twice = max(numbers.start, other.start)
            if twice < min(numbers.stop, other.stop):
                raise LogError(f"{where}: solve {twice} is already in the log")
        expected = int(block.batch.iterations.sum())
        if block.rows.dtype != block.format.layout.dtype or block.rows.shape != (expected,):
            raise LogError(f"{where}: the rows are not of their layout, or not {expected}")
        known = self._methods.get(block.method)
        if known is not None:
            same = known.form.layout == block.format.layout and known.form.labels == (
                block.format.labels
            )
            if not same or known.fingers != block.fingers:
                raise LogError(f"{where}: layout or labels differ from the method's earlier solves")
        try:
            self.clock.check(block.first, block.batch.iterations)
        except LogError as error:
            raise LogError(f"{where}: {error}") from None

    def _method(self, block: SolveBlock) -> _Method:
        """The method's channels, registered when it comes for the first time."""
        known = self._methods.get(block.method)
        if known is not None:
            return known
        formats = {
            "iteration": block.format,
            "solve": solve_format(block),
            "event": event_format(block.format),
        }
        texts = {kind: schema.schema_text(f.layout, f.labels) for kind, f in formats.items()}
        channels = {}
        for kind, form in formats.items():
            number = len(self._summary.channels) + 1
            name = schema.schema_name(kind, block.method, block.format.layout, len(block.fingers))
            metadata = {
                "offered_qos_profiles": "",
                "method": block.method,
                "labels": json.dumps({key: list(names) for key, names in form.labels.items()}),
            }
            described = Schema(number, texts[kind].encode(), "ros2msg", name)
            channel = Channel(number, schema.topic(block.method, kind), "cdr", metadata, number)
            self._summary.schemas[number] = described
            self._summary.channels[number] = channel
            self._new[0].append(described)
            self._new[1].append(channel)
            channels[kind] = number
        method = _Method(block.format, block.fingers, formats, channels)
        self._methods[block.method] = method
        return method

    def _messages(
        self,
        block: SolveBlock,
        method: _Method,
        events: NDArray[Any],
        solves: NDArray[Any],
        kept: NDArray[np.bool_],
    ) -> list[_Messages]:
        """The block's messages by topic; `events` are numbered within the block."""
        counts, k = block.batch.iterations, len(block)
        seconds = block.batch.time * 1e9
        solve = np.arange(k)
        of_row = np.repeat(solve, counts)
        iteration = np.arange(len(block.rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        published = block.started[of_row] + (
            (iteration + 1) * (seconds / np.maximum(counts, 1))[of_row]
        ).astype(np.int64)
        rows = block.rows
        event_of, event_at = (events[key].astype(np.int64) for key in ("solve_id", "iteration"))
        event_row = (np.cumsum(counts) - counts)[event_of] + event_at
        event_published = published[event_row]
        events["solve_id"] += block.first
        if not kept.all():
            wanted = kept[of_row]
            rows, of_row, iteration = rows[wanted], of_row[wanted], iteration[wanted]
            published = published[wanted]
            wanted = kept[event_of]
            events, event_of, event_at = events[wanted], event_of[wanted], event_at[wanted]
            event_published = event_published[wanted]
        last = np.maximum(counts - 1, 0)
        numbers, times = method.channels, self.clock.times
        return [
            _Messages(
                numbers["iteration"],
                rows,
                iteration,
                times(block.first + of_row, iteration),
                published,
                np.cumsum(np.where(kept, counts, 0)),
            ),
            _Messages(
                numbers["event"],
                events,
                event_at,
                times(block.first + event_of, event_at),
                event_published,
                np.cumsum(np.bincount(event_of, minlength=k)),
            ),
            _Messages(
                numbers["solve"],
                solves,
                block.first + solve,
                times(block.first + solve, last),
                block.started + seconds.astype(np.int64),
                1 + solve,
            ),
        ]

    def _flush(self) -> None:
        """Write what waits as a chunk."""
        if not self._waiting:
            return
        defined = definitions(*self._new)
        data = np.empty(len(defined) + self._waiting_size, np.uint8)
        data[: len(defined)] = np.frombuffer(defined, np.uint8)
        runs, start = [], len(defined)
        for channel in sorted({part.channel for part in self._waiting}):
            parts = [part for part in self._waiting if part.channel == channel]
            first, size = start, parts[0].size
            for part in parts:
                count = len(part.rows)
                stop = start + count * size
                fill(
                    data[start:stop].reshape(count, size),
                    channel,
                    part.rows,
                    part.sequence,
                    part.log_time,
                    part.publish_time,
                )
                start = stop
            if start > first:
                offsets = np.arange(first, start, size, dtype=np.uint64)
                log_time = np.concatenate([part.log_time for part in parts])
                runs.append(Run(channel, log_time, offsets))
        pieces = [] if self._file.position else [self._beginning]
        position = self._file.position + sum(map(len, pieces))
        written, index = chunk_bytes(memoryview(data), runs, self._compression, position)
        self._file.write([*pieces, *written])
        self._summary.chunks.append(index)
        for run in runs:
            counts = self._summary.counts
            counts[run.channel] = counts.get(run.channel, 0) + len(run.log_time)
        self._waiting, self._waiting_size, self._new = [], 0, ([], [])

    def _finish(self) -> None:
        pieces = [] if self._file.position else [self._beginning]
        position = self._file.position + sum(map(len, pieces))
        self._file.write([*pieces, self._summary.ending(position)])
        self._file.close()


def _numbers(block: SolveBlock) -> range:
    return range(block.first, block.first + len(block))
