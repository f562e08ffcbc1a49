"""Writes solves to an MCAP file that ROS 2 tools and our own reader understand.

The iterations come as the array that the compiled loop wrote; they are copied once, into the
chunk, and everything about them is done for a whole block of solves at once. A chunk is closed at
a solve boundary and written with its index in one go, while the next one is filled; a crash loses
at most these two, 4 MiB of messages and the rest of a solve (`ChunkStream`).
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema

from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.errors import LogError
from casadi_ik.logs.events.detect import detect_events
from casadi_ik.logs.events.kinds import SINGULAR, EventKind, event_format
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.mcap import schema
from casadi_ik.logs.mcap.chunk import COMPRESSORS
from casadi_ik.logs.mcap.clock import LogClock
from casadi_ik.logs.mcap.file import McapFile
from casadi_ik.logs.mcap.metadata import METADATA_NAME
from casadi_ik.logs.mcap.summary import Summary
from casadi_ik.logs.write.chunk_stream import ChunkStream
from casadi_ik.logs.write.keep import Keep
from casadi_ik.logs.write.measured import measured_format, measured_rows
from casadi_ik.logs.write.provenance import log_metadata
from casadi_ik.logs.write.solve_rows import solve_format, solve_rows
from casadi_ik.logs.write.topic_messages import block_messages
from casadi_ik.problem.trace import CLEARANCE, TraceFormat

Compression = Literal["none", "lz4", "zstd"]
"""How the chunks of a log are compressed; zstd is level 1."""

URDF_ATTACHMENT = "robot.urdf"
"""Name of the attachment that holds the robot description."""


@dataclass(frozen=True, eq=False)
class _Method:
    """What a method's solves look like: their rows as given, and as they stand in this log."""

    given: TraceFormat
    form: TraceFormat
    fingers: tuple[str, ...]
    formats: Mapping[str, TraceFormat]
    channels: Mapping[str, int]


class McapRecorder:
    """A `Recorder` that keeps every iteration in an MCAP file.

    Use it as a context manager. Leaving it with an exception gives up what has not reached the
    disk; a log that has nothing on the disk is gone, one that has is finished. What stood at the
    path stays until the first chunk is written.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(0), 20))
        >>> with ik.logs.McapRecorder("two.mcap", robot_name=robot.name) as recorder:
        ...     batch = solver.solve_batch(points, normals, log=recorder)
        >>> len(ik.logs.open("two.mcap").solves().array())
        20
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
            LogError: The path cannot be written, somebody is writing it, the compression is
                unknown, or URDF or parameters are larger than what a reader takes.
        """
        if compression not in COMPRESSORS:
            raise LogError(f"compression {compression!r}: expected one of {', '.join(COMPRESSORS)}")
        self.path = Path(path)
        self.clock = clock or LogClock()
        self.keep = keep or Keep()
        self._rules = rules or EventRules()
        self._methods: dict[str, _Method] = {}
        self._recorded: dict[str, list[range]] = {}
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
        summary, library = Summary(), f"casadi_ik {metadata['code_version']}"
        record = Metadata(METADATA_NAME, metadata)
        try:
            beginning = summary.beginning("ros2", library, record, attached)
        except LogError as error:
            raise LogError(f"{self.path}: {error}") from None
        self._chunks = ChunkStream(McapFile(self.path), summary, beginning, compression)

    def record(self, block: SolveBlock) -> None:
        """Write solves: their totals, and of those that are kept their iterations and events.

        Raises:
            LogError: The block contradicts itself or an earlier one, or a solve of it is larger
                than what a reader takes (the log stays usable), or it could not be written (the
                log ends with the chunk before).
        """
        if len(block) == 0:
            return
        self._check(block)
        method = self._method(block)
        block = replace(block, format=method.form, rows=measured_rows(block))
        counts, rules = block.batch.iterations, self._rules
        if block.around is not None:
            rules = replace(rules, clearance=block.around.margin)
        events = detect_events(block.format, block.rows, counts, rules)
        kinds = len(EventKind)
        cell = events["solve_id"].astype(np.int64) * kinds + events["kind"]
        tally = np.bincount(cell, minlength=len(block) * kinds).reshape(-1, kinds)
        solves = solve_rows(block, tally, method.formats["solve"])
        singular = tally[:, list(SINGULAR)].sum(axis=1) > 0
        solves["kept"] = self.keep(block.first, block.batch.success, singular)
        messages = block_messages(block, events, solves, method.channels, self.clock)
        self._chunks.check(messages, f"{self.path}: method {block.method!r}", block.first)
        self._note(block)
        self._chunks.add(messages)

    def close(self) -> None:
        """Finish the file; a second call does nothing.

        Raises:
            LogError: It could not be written; the chunks before can be read.
        """
        self._chunks.close()

    def discard(self) -> None:
        """Give up what is not on the disk; a log of which nothing is there is gone."""
        self._chunks.discard()

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

    def _check(self, block: SolveBlock) -> None:
        where = f"{self.path}: method {block.method!r}, solve {block.first}"
        if self._chunks.closed:
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
            same = known.given.layout == block.format.layout and known.given.labels == (
                block.format.labels
            )
            same &= (block.around is not None) == (CLEARANCE in known.form.layout.names)
            if not same or known.fingers != block.fingers:
                raise LogError(f"{where}: layout or labels differ from the method's earlier solves")
        try:
            self.clock.check(block.first, block.batch.iterations)
        except LogError as error:
            raise LogError(f"{where}: {error}") from None

    def _note(self, block: SolveBlock) -> None:
        """Remember which solves are recorded, numbers that follow each other as one range."""
        numbers, recorded = _numbers(block), self._recorded.setdefault(block.method, [])
        if recorded and recorded[-1].stop == numbers.start:
            numbers = range(recorded.pop().start, numbers.stop)
        recorded.append(numbers)

    def _method(self, block: SolveBlock) -> _Method:
        """The method's channels, registered when it comes for the first time."""
        known = self._methods.get(block.method)
        if known is not None:
            return known
        form = measured_format(block.format, block.around is not None)
        formats = {
            "iteration": form,
            "solve": solve_format(replace(block, format=form)),
            "event": event_format(form),
        }
        texts = {kind: schema.schema_text(f.layout, f.labels) for kind, f in formats.items()}
        channels = {}
        for kind, text in texts.items():
            number = len(schema.KINDS) * len(self._methods) + len(channels) + 1
            name = schema.schema_name(kind, block.method, form.layout, len(block.fingers))
            metadata = {
                "offered_qos_profiles": "",
                "method": block.method,
                "labels": json.dumps({k: list(names) for k, names in formats[kind].labels.items()}),
            }
            self._chunks.define(
                Schema(number, text.encode(), "ros2msg", name),
                Channel(number, schema.topic(block.method, kind), "cdr", metadata, number),
            )
            channels[kind] = number
        method = _Method(block.format, form, block.fingers, formats, channels)
        self._methods[block.method] = method
        return method


def _numbers(block: SolveBlock) -> range:
    return range(block.first, block.first + len(block))
