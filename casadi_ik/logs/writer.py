"""The recorder that writes solves to an MCAP file that ROS 2 tools can read.

Iterations arrive as the array that the compiled loop has written. They are copied once, into a
chunk, and processed for a whole block of solves at a time. A chunk ends between two solves and is
written together with its index while the next chunk is filled. A crash loses at most these two:
4 MiB of messages and the remainder of a solve.
"""

from __future__ import annotations

import contextlib
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
from mcap.summary import Summary
from numpy.typing import NDArray

from casadi_ik.errors import InputError, LogError
from casadi_ik.logs.chunk_writer import ChunkWriter, LogFile, TopicMessages
from casadi_ik.logs.chunks import COMPRESSORS
from casadi_ik.logs.container import file_head
from casadi_ik.logs.events import SINGULAR, EventKind, EventRules, detect_events, event_format
from casadi_ik.logs.format import (
    MESSAGE_KINDS,
    METADATA_NAME,
    LogClock,
    log_metadata,
    schema_name,
    schema_text,
    topic,
)
from casadi_ik.logs.rows import measured_format, measured_rows, solve_format, solve_rows
from casadi_ik.solve.recorder import Recorder, SolveBlock
from casadi_ik.solve.trace import CLEARANCE, TraceFormat

Compression = Literal["none", "lz4", "zstd"]
"""Compression of the chunks of a log; zstd is level 1."""


@dataclass(frozen=True)
class Keep:
    """Selection of the solves whose iterations and events are logged.

    All solves log their totals. A solve with more than `LogClock.max_iterations` iterations logs
    only these. The selection is part of the log's metadata, so that a reader can tell a sample from
    all solves.

    Attributes:
        failed: Select all solves that failed.
        singular: Select all solves in which a Jacobian was near singular or ill-conditioned.
        sample: Fraction of all solves that is selected at random, 0 to 1.
        seed: Seed of the sample; seed and number of a solve alone decide its selection.

    Example:
        >>> keep = ik.logs.Keep(sample=0.01)  # all failures and 1 % of the solved targets
        >>> keep.failed, keep.sample
        (True, 0.01)
    """

    failed: bool = True
    singular: bool = True
    sample: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (isinstance(self.sample, (int, float)) and 0 <= self.sample <= 1):
            raise InputError(f"keep.sample: found {self.sample!r}, expected a number from 0 to 1")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError(f"keep.seed: found {self.seed!r}, expected an integer >= 0")

    def __call__(
        self, first: int, success: NDArray[np.bool_], singular: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Select from k consecutive solves.

        Args:
            first: Number of the first solve.
            success: (k,) True for solved targets.
            singular: (k,) True if a Jacobian was near singular or ill-conditioned.

        Returns:
            (k,) True for the selected solves.
        """
        if self.sample >= 1:
            return np.ones(len(success), dtype=bool)
        numbers = np.random.Generator(np.random.PCG64(self.seed).advance(first))
        is_sampled = numbers.random(len(success)) < self.sample
        return is_sampled | (self.failed & ~success) | (self.singular & singular)


@dataclass(frozen=True, eq=False)
class _RecordedMethod:
    """Formats and channels of a method.

    Attributes:
        trace_format: Format of the rows that the method records.
        iteration_format: Format of the iterations in the log, with measurements.
        solve_format: Format of the solves.
        fingers: Names of the fingers.
        channels: Channel id by kind of message.
    """

    trace_format: TraceFormat
    iteration_format: TraceFormat
    solve_format: TraceFormat
    fingers: tuple[str, ...]
    channels: Mapping[str, int]

    def matches(self, block: SolveBlock) -> bool:
        """Return True if a block has the formats of the method's earlier blocks."""
        is_checked = CLEARANCE in self.iteration_format.layout.names
        return (
            self.trace_format.layout == block.format.layout
            and self.trace_format.labels == block.format.labels
            and self.fingers == block.fingers
            and is_checked == (block.query is not None)
        )


class McapRecorder:
    """A `Recorder` that writes every iteration to an MCAP file.

    Use it as a context manager. If the block ends with an exception, messages that are not yet in
    the file are discarded, and the file is finished, or removed if it is empty. An existing file at
    the path stays unchanged until the first chunk is written.

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
            path: Path of the file.
            robot_name: Name of the robot.
            urdf: URDF of the robot, which is attached.
            parameters: All parameters that determine the solves besides target, start and seed.
            seed: Seed of the study.
            keep: Selection of the solves whose iterations are logged (default: all).
            rules: Thresholds of events.
            compression: Compression of the chunks; zstd is level 1.
            clock: Rule of the log times.

        Raises:
            LogError: The path cannot be written, another process writes it, the compression is
                unknown, or URDF or parameters are larger than `RECORD_LIMIT`.
        """
        if compression not in COMPRESSORS:
            raise LogError(f"compression: found {compression!r}, expected {', '.join(COMPRESSORS)}")
        self.path = Path(path)
        self.clock = clock or LogClock()
        self.keep = keep or Keep()
        self._rules = rules or EventRules()
        self._methods: dict[str, _RecordedMethod] = {}
        self._recorded: dict[str, list[range]] = {}
        all_parameters = {**(parameters or {}), "event_rules": asdict(self._rules)}
        selection = asdict(self.keep)
        entries = log_metadata(robot_name, seed, all_parameters, selection, compression, self.clock)
        created, summary = time.time_ns(), Summary()
        attachments = list[Attachment]()
        if urdf is not None:
            attachments.append(
                Attachment(created, created, "robot.urdf", "application/xml", urdf.encode())
            )
        library = f"casadi_ik {entries['code_version']}"
        try:
            head = file_head(summary, library, Metadata(METADATA_NAME, entries), attachments)
        except LogError as error:
            raise LogError(f"{self.path}: {error}") from None
        self._chunks = ChunkWriter(LogFile(self.path), summary, head, compression)

    def record(self, block: SolveBlock) -> None:
        """Write the totals of solves, and the iterations and events of the selected solves.

        Raises:
            LogError: The block is inconsistent in itself or with an earlier one, or one of its
                solves is larger than `RECORD_LIMIT` (the log stays usable), or writing failed (the
                log ends with the previous chunk).
        """
        if len(block) == 0:
            return
        self._check(block)
        method = self._register_method(block)
        block = replace(block, format=method.iteration_format, rows=measured_rows(block))
        counts, rules = block.batch.iterations, self._rules
        if block.query is not None:
            rules = replace(rules, clearance=block.query.margin)
        events = detect_events(block.format, block.rows, counts, rules)
        kinds = len(EventKind)
        cell = events["solve_id"].astype(np.int64) * kinds + events["kind"]
        event_counts = np.bincount(cell, minlength=len(block) * kinds).reshape(-1, kinds)
        solves = solve_rows(block, event_counts, method.solve_format)
        is_singular = event_counts[:, list(SINGULAR)].sum(axis=1) > 0
        is_selected = self.keep(block.first, block.batch.success, is_singular)
        solves["kept"] = is_selected & (counts <= self.clock.max_iterations)
        messages = block_messages(block, events, solves, method.channels, self.clock)
        self._chunks.check(messages, f"{self.path}: method {block.method!r}", block.first)
        numbers, recorded = _solve_numbers(block), self._recorded.setdefault(block.method, [])
        if recorded and recorded[-1].stop == numbers.start:
            numbers = range(recorded.pop().start, numbers.stop)
        recorded.append(numbers)
        self._chunks.add(messages)

    def close(self) -> None:
        """Finish the file; a second call does nothing.

        Raises:
            LogError: Writing failed; the previous chunks can be read.
        """
        self._chunks.close()

    def discard(self) -> None:
        """Discard messages that are not yet in the file; remove the file if it is empty."""
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
        """Check a block against its format and against earlier blocks.

        Raises:
            LogError: The log is closed, a solve is already in the log, or rows, formats or numbers
                are invalid.
        """
        context = f"{self.path}: method {block.method!r}, solve {block.first}"
        if self._chunks.closed:
            raise LogError(f"{context}: the log is closed")
        if len(block) > 1:
            context += f" to {block.first + len(block) - 1}"
        numbers = _solve_numbers(block)
        for recorded in self._recorded.get(block.method, ()):
            duplicate = max(numbers.start, recorded.start)
            if duplicate < min(numbers.stop, recorded.stop):
                raise LogError(f"{context}: solve {duplicate} is already in the log")
        if block.rows.dtype != block.format.layout.dtype:
            raise LogError(f"{context}: rows do not have the layout of the block")
        count = int(block.batch.iterations.sum())
        if block.rows.shape != (count,):
            raise LogError(
                f"{context}: found rows of shape {block.rows.shape}, expected ({count},)"
            )
        method = self._methods.get(block.method)
        if method is not None and not method.matches(block):
            raise LogError(f"{context}: layout or labels differ from the method's earlier solves")
        try:
            self.clock.check(block.first, len(block))
        except LogError as error:
            raise LogError(f"{context}: {error}") from None

    def _register_method(self, block: SolveBlock) -> _RecordedMethod:
        """Return the formats and channels of a method; define them if the method is new."""
        if block.method in self._methods:
            return self._methods[block.method]
        iteration_format = measured_format(block.format, block.query is not None)
        formats = {
            "iteration": iteration_format,
            "solve": solve_format(replace(block, format=iteration_format)),
            "event": event_format(iteration_format),
        }
        # All texts are made before the first definition, because an invalid layout raises an error.
        texts = {kind: schema_text(form.layout, form.labels) for kind, form in formats.items()}
        channels: dict[str, int] = {}
        for kind, form in formats.items():
            number = len(MESSAGE_KINDS) * len(self._methods) + len(channels) + 1
            fingers = len(block.fingers)
            name = schema_name(kind, block.method, iteration_format.layout, fingers)
            metadata = {
                "offered_qos_profiles": "",
                "method": block.method,
                "labels": json.dumps({field: list(names) for field, names in form.labels.items()}),
            }
            self._chunks.define(
                Schema(number, texts[kind].encode(), "ros2msg", name),
                Channel(number, topic(block.method, kind), "cdr", metadata, number),
            )
            channels[kind] = number
        method = _RecordedMethod(
            block.format, iteration_format, formats["solve"], block.fingers, channels
        )
        self._methods[block.method] = method
        return method


def recorder_of(
    solver: Any,
    log: str | os.PathLike[str] | Recorder | None,
    seed: int,
    keep: Keep | None = None,
    compression: Compression = "zstd",
) -> contextlib.AbstractContextManager[Recorder | None]:
    """Return a context manager for the `log` argument of a `Solver`.

    Args:
        solver: The solver.
        log: Path of a log, which is closed at the end of the block, or an open recorder or None,
            which the context manager returns unchanged.
        seed: Seed of the solves.
        keep: Selection of the solves whose iterations are logged.
        compression: Compression of the chunks.

    Raises:
        LogError: The log cannot be written.
        InputError: The argument is neither a path nor a recorder.
    """
    if not isinstance(log, str | os.PathLike):
        if log is not None and not hasattr(log, "record"):
            raise InputError(f"log: found {log!r}, expected a path, a recorder, or None")
        return contextlib.nullcontext(log)
    return McapRecorder(
        log,
        robot_name=solver.robot.name,
        urdf=solver.robot.urdf(),
        parameters=dict(solver.parameters),
        seed=seed,
        keep=keep,
        compression=compression,
    )


def block_messages(
    block: SolveBlock,
    events: NDArray[Any],
    solves: NDArray[Any],
    channels: Mapping[str, int],
    clock: LogClock,
) -> list[TopicMessages]:
    """Return the messages of a block by topic.

    Args:
        block: The solves, at least one.
        events: Events of the solves; their "solve_id" counts from 0 and is changed in place to
            count from the block's first solve.
        solves: Rows of the solves; only those with "kept" log iterations and events.
        channels: Channel id by kind of message.
        clock: Rule of the log times.
    """
    counts, k = block.batch.iterations, len(block)
    duration, solve = block.batch.time * 1e9, np.arange(k)
    starts = np.cumsum(counts) - counts
    row_solve = np.repeat(solve, counts)
    row_iteration = np.arange(len(block.rows)) - np.repeat(starts, counts)
    # The iterations of a solve share its duration equally.
    elapsed = (row_iteration + 1) * np.repeat(duration / np.maximum(counts, 1), counts)
    row_time = np.repeat(block.started, counts) + elapsed.astype(np.int64)
    event_solve, event_iteration = (
        events[name].astype(np.int64) for name in ("solve_id", "iteration")
    )
    event_time = row_time[starts[event_solve] + event_iteration]
    events["solve_id"] += block.first
    is_kept = solves["kept"] > 0

    def kept_messages(
        kind: str, rows: Any, solve: Any, iteration: Any, publish_time: Any
    ) -> TopicMessages:
        """Return the messages of the solves that keep their iterations."""
        if not is_kept.all():
            indices = np.flatnonzero(is_kept[solve])
            rows, solve, iteration, publish_time = (
                np.take(values, indices) for values in (rows, solve, iteration, publish_time)
            )
        stops = np.cumsum(np.bincount(solve, minlength=k))
        log_time = clock.times(block.first + solve, iteration)
        return TopicMessages(channels[kind], rows, iteration, log_time, publish_time, stops)

    return [
        kept_messages("iteration", block.rows, row_solve, row_iteration, row_time),
        kept_messages("event", events, event_solve, event_iteration, event_time),
        TopicMessages(
            channels["solve"],
            solves,
            block.first + solve,
            clock.times(block.first + solve, np.clip(counts - 1, 0, clock.max_iterations - 1)),
            block.started + duration.astype(np.int64),
            1 + solve,
        ),
    ]


def _solve_numbers(block: SolveBlock) -> range:
    return range(block.first, block.first + len(block))
