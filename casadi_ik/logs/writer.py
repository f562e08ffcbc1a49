"""Writes solves to an MCAP file that ROS 2 tools and our own reader understand.

The iterations come as the array that the compiled loop wrote; they are copied once, into the
chunk, and everything about them is done for a whole block of solves at once. A chunk is closed at
a solve boundary and written with its index in one go, while the next one is filled; a crash loses
at most these two, 4 MiB of messages and the rest of a solve.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema
from mcap.summary import Summary
from numpy.typing import NDArray

from casadi_ik.errors import InputError, LogError
from casadi_ik.files.writing import BackgroundWriter
from casadi_ik.logs.container import (
    COMPRESSORS,
    MESSAGE,
    Run,
    add_chunk,
    check_size,
    file_head,
    file_tail,
    pack_chunk,
    write_messages,
)
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

try:
    import fcntl
except ImportError:  # Windows: no lock
    fcntl = None

Compression = Literal["none", "lz4", "zstd"]
"""How the chunks of a log are compressed; zstd is level 1."""

CHUNK_SIZE = 2**21
"""A chunk is closed at the end of the first solve with which it is no smaller [bytes]."""


@dataclass(frozen=True)
class Keep:
    """Which solves keep every iteration and event; of the others the totals are kept.

    Of a solve of more iterations than a log has room for (`LogClock.room`) only the totals are.
    Stands in the log's metadata, so that no reader takes the sample for the whole.

    Attributes:
        failed: All that were not solved.
        singular: All in which a Jacobian was near singular or ill-conditioned.
        sample: Share of all solves, whatever became of them, from 0 to 1.
        seed: Of the sample; with the solve's number it decides, whatever else is in the log.

    Example:
        >>> keep = ik.logs.Keep(sample=0.01)  # all that fail, and one in a hundred of the others
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
        """Which of k solves to keep.

        Args:
            first: Number of the first; the others follow.
            success: (k,) whether it was solved.
            singular: (k,) whether a Jacobian was near singular or ill-conditioned.
        """
        if self.sample >= 1:
            return np.ones(len(success), dtype=bool)
        numbers = np.random.Generator(np.random.PCG64(self.seed).advance(first))
        kept = numbers.random(len(success)) < self.sample
        return kept | (self.failed & ~success) | (self.singular & singular)


@dataclass(frozen=True, eq=False)
class _Method:
    """What a method's solves look like: their rows as given, and as they stand in this log."""

    given: TraceFormat
    form: TraceFormat
    fingers: tuple[str, ...]
    solve: TraceFormat
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
            path: The file.
            robot_name: Name of the robot.
            urdf: Its description, attached.
            parameters: Everything that determines the solves but target, start and seed.
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
        given = {**(parameters or {}), "event_rules": asdict(self._rules)}
        keeping = asdict(self.keep)
        entries = log_metadata(robot_name, seed, given, keeping, compression, self.clock)
        now, summary = time.time_ns(), Summary()
        attached = list[Attachment]()
        if urdf is not None:
            attached.append(Attachment(now, now, "robot.urdf", "application/xml", urdf.encode()))
        library = f"casadi_ik {entries['code_version']}"
        try:
            start = file_head(summary, library, Metadata(METADATA_NAME, entries), attached)
        except LogError as error:
            raise LogError(f"{self.path}: {error}") from None
        self._chunks = _Chunks(LogFile(self.path), summary, start, compression)

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
        if block.query is not None:
            rules = replace(rules, clearance=block.query.margin)
        events = detect_events(block.format, block.rows, counts, rules)
        kinds = len(EventKind)
        cell = events["solve_id"].astype(np.int64) * kinds + events["kind"]
        tally = np.bincount(cell, minlength=len(block) * kinds).reshape(-1, kinds)
        solves = solve_rows(block, tally, method.solve)
        singular = tally[:, list(SINGULAR)].sum(axis=1) > 0
        wanted = self.keep(block.first, block.batch.success, singular)
        solves["kept"] = wanted & (counts <= self.clock.room)
        messages = block_messages(block, events, solves, method.channels, self.clock)
        self._chunks.check(messages, f"{self.path}: method {block.method!r}", block.first)
        # Numbers that follow each other are remembered as one range.
        numbers, recorded = _numbers(block), self._recorded.setdefault(block.method, [])
        if recorded and recorded[-1].stop == numbers.start:
            numbers = range(recorded.pop().start, numbers.stop)
        recorded.append(numbers)
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
            same &= (block.query is not None) == (CLEARANCE in known.form.layout.names)
            if not same or known.fingers != block.fingers:
                raise LogError(f"{where}: layout or labels differ from the method's earlier solves")
        try:
            self.clock.check(block.first, len(block))
        except LogError as error:
            raise LogError(f"{where}: {error}") from None

    def _method(self, block: SolveBlock) -> _Method:
        """The method's channels, registered when it comes for the first time."""
        known = self._methods.get(block.method)
        if known is not None:
            return known
        form = measured_format(block.format, block.query is not None)
        solve = solve_format(replace(block, format=form))
        formats = {"iteration": form, "solve": solve, "event": event_format(form)}
        texts = [schema_text(each.layout, each.labels) for each in formats.values()]
        channels = {}
        for (kind, each), text in zip(formats.items(), texts, strict=True):
            number = len(MESSAGE_KINDS) * len(self._methods) + len(channels) + 1
            name = schema_name(kind, block.method, form.layout, len(block.fingers))
            metadata = {
                "offered_qos_profiles": "",
                "method": block.method,
                "labels": json.dumps({k: list(names) for k, names in each.labels.items()}),
            }
            self._chunks.define(
                Schema(number, text.encode(), "ros2msg", name),
                Channel(number, topic(block.method, kind), "cdr", metadata, number),
            )
            channels[kind] = number
        method = _Method(block.format, form, block.fingers, solve, channels)
        self._methods[block.method] = method
        return method


def recorder_of(
    solver: Any,
    log: str | os.PathLike[str] | Recorder | None,
    seed: int,
    keep: Keep | None = None,
    compression: Compression = "zstd",
) -> contextlib.AbstractContextManager[Recorder | None]:
    """A recorder of a `Solver` for a path, closed in the end; an open one, or None, as it is.

    Raises:
        LogError: The log cannot be written.
    """
    if not isinstance(log, str | os.PathLike):
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


class Messages(NamedTuple):
    """Messages of k solves on one topic: m rows, and up to which of them each solve goes."""

    channel: int
    rows: NDArray[Any]
    sequence: NDArray[Any]
    log_time: NDArray[Any]
    publish_time: NDArray[Any]
    ends: NDArray[np.int64]

    @property
    def size(self) -> int:
        """Of one message [bytes]."""
        return MESSAGE.itemsize + self.rows.dtype.itemsize

    def of_solves(self, start: int, stop: int) -> Messages:
        """Those of some of the solves."""
        first = int(self.ends[start - 1]) if start else 0
        part = slice(first, int(self.ends[stop - 1]))
        rows, sequence, *times = (each[part] for each in self[1:5])
        return Messages(
            self.channel, rows, sequence, times[0], times[1], self.ends[start:stop] - first
        )


def block_messages(
    block: SolveBlock,
    events: NDArray[Any],
    solves: NDArray[Any],
    channels: Mapping[str, int],
    clock: LogClock,
) -> list[Messages]:
    """The messages of a block by topic.

    Args:
        block: The solves, at least one.
        events: Their events, "solve_id" counted within the block; it is counted on in place.
        solves: Their rows; those not "kept" get no iterations and events.
        channels: Channel id by kind.
        clock: Rule of the log times.
    """
    counts, k = block.batch.iterations, len(block)
    seconds, solve = block.batch.time * 1e9, np.arange(k)
    starts = np.cumsum(counts) - counts
    of_row = np.repeat(solve, counts)
    iteration = np.arange(len(block.rows)) - np.repeat(starts, counts)
    share = (iteration + 1) * np.repeat(seconds / np.maximum(counts, 1), counts)
    published = np.repeat(block.started, counts) + share.astype(np.int64)
    event_of, event_at = (events[key].astype(np.int64) for key in ("solve_id", "iteration"))
    event_published = published[starts[event_of] + event_at]
    events["solve_id"] += block.first
    kept = solves["kept"] > 0

    def of(kind: str, rows: Any, solve_of: Any, at: Any, published: Any) -> Messages:
        """Messages of the solves that are kept; `solve_of` and `at` tell solve and iteration."""
        if not kept.all():
            wanted = np.flatnonzero(kept[solve_of])
            rows, solve_of, at, published = (
                np.take(each, wanted) for each in (rows, solve_of, at, published)
            )
        ends = np.cumsum(np.bincount(solve_of, minlength=k))
        log_time = clock.times(block.first + solve_of, at)
        return Messages(channels[kind], rows, at, log_time, published, ends)

    return [
        of("iteration", block.rows, of_row, iteration, published),
        of("event", events, event_of, event_at, event_published),
        Messages(
            channels["solve"],
            solves,
            block.first + solve,
            clock.times(block.first + solve, np.clip(counts - 1, 0, clock.room - 1)),
            block.started + seconds.astype(np.int64),
            1 + solve,
        ),
    ]


class _Chunks:
    """Messages on their way into chunks: gathered, cut at solve boundaries, written.

    A chunk is compressed and written while the next one is filled, and is on the disk before that
    one is. Of what `add` has taken a killed process loses these two, less than twice `CHUNK_SIZE`
    and a solve, and no more.
    """

    def __init__(self, file: LogFile, summary: Summary, start: bytes, compression: str) -> None:
        """Take an open file.

        Args:
            file: Where to write.
            summary: Of the file; grows with it.
            start: What stands before the first chunk; goes to the disk with that.
            compression: Of the chunks.
        """
        self._file = file
        self._summary = summary
        self._start = start
        self._compression = compression
        self._waiting: list[Messages] = []
        self._size = 0
        self._new: list[McapRecord] = []
        self._background = BackgroundWriter()

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written.

        Raises:
            LogError: Nothing can, since a chunk could not be written; said once.
        """
        if self._file.closed:
            self._background.wait()
        return self._file.closed

    def define(self, schema: Schema, channel: Channel) -> None:
        """Take a schema and its channel; they stand in the chunk with the first messages."""
        self._summary.schemas[schema.id] = schema
        self._summary.channels[channel.id] = channel
        self._new += [schema, channel]

    def check(self, parts: Sequence[Messages], where: str, first: int) -> None:
        """Check that every solve fits into a chunk that can be read, whatever waits before it.

        Args:
            parts: Messages of the same solves on several channels.
            where: File and method, for messages.
            first: Number of the first of the solves.

        Raises:
            LogError: One is too large.
        """
        ends = np.sum([part.ends * part.size for part in parts], axis=0)
        sizes = np.diff(ends, prepend=0)
        worst = int(sizes.argmax())
        # Beside it there is room for what waits, and for what compression may add.
        check_size(f"{where}, solve {first + worst}", int(sizes[worst]) + 2 * CHUNK_SIZE)

    def add(self, parts: Sequence[Messages]) -> None:
        """Take messages of the same solves on several channels.

        Raises:
            LogError: A chunk, perhaps of an earlier call, could not be written; the chunks before
                can be read.
        """
        count, start = len(parts[0].ends), 0
        size = np.sum([part.ends * part.size for part in parts], axis=0)
        while start < count:
            done = int(size[start - 1]) if start else 0
            full = done + CHUNK_SIZE - self._size
            stop = min(int(np.searchsorted(size, full)) + 1, count)
            self._waiting += [part.of_solves(start, stop) for part in parts]
            self._size += int(size[stop - 1]) - done
            if self._size >= CHUNK_SIZE:
                self._background.do(partial(self._put, *self._gathered()))
            start = stop

    def close(self) -> None:
        """Write what waits, and the summary.

        Raises:
            LogError: It could not be written; the chunks before can be read.
        """
        try:
            if self._waiting and not self.closed:
                self._background.do(partial(self._put, *self._gathered()))
            self._background.wait()
            if not self._file.closed:
                self._finish()
        finally:
            self._background.end()

    def discard(self) -> None:
        """Give up what waits; a file that has nothing else goes away, any other is finished."""
        self._background.end()
        if not self._file.closed and self._file.position:
            with contextlib.suppress(LogError):
                self._finish()
        self._file.close()

    def _gathered(self) -> tuple[np.ndarray, list[Run]]:
        """What waits as the contents of a chunk, and the messages in it."""
        builder = RecordBuilder()
        for record in self._new:
            record.write(builder)
        start = builder.count
        data = np.empty(start + self._size, np.uint8)
        data[:start] = np.frombuffer(builder.end(), np.uint8)
        runs: list[Run] = []
        for channel in sorted({part.channel for part in self._waiting}):
            parts = [part for part in self._waiting if part.channel == channel and len(part.rows)]
            first = start
            for part in parts:
                stop = start + len(part.rows) * part.size
                write_messages(data[start:stop], *part[:5])
                start = stop
            if parts:
                log_time = np.concatenate([part.log_time for part in parts])
                runs.append(Run(channel, first, parts[0].size, log_time))
        self._waiting, self._size, self._new = [], 0, []
        return data, runs

    def _put(self, data: np.ndarray, runs: list[Run]) -> None:
        start = b"" if self._file.position else self._start
        position = self._file.position + len(start)
        written, index = pack_chunk(data.data, runs, self._compression, position)
        self._file.write(start + written)
        add_chunk(self._summary, index, runs)

    def _finish(self) -> None:
        start = b"" if self._file.position else self._start
        self._file.write(start + file_tail(self._summary, self._file.position + len(start)))
        self._file.close()


class LogFile:
    """A file that grows by whole records, locked, and stays readable whatever happens.

    What stood at the path stays until the first write.

    Attributes:
        path: As it was given.
        position: Bytes of whole records that are written.
        closed: Whether it is closed.
    """

    def __init__(self, path: Path) -> None:
        """Open and lock.

        Raises:
            LogError: The path cannot be written, or somebody else is writing it.
        """
        self.path = path
        self.position = 0
        self.closed = False
        try:
            self._created = not path.exists()
            if not self._created and not stat.S_ISREG(mode := path.stat().st_mode):
                what = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
                raise LogError(f"{path}: cannot write the log: the path is {what}")
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
            self._descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            raise self._failure(error) from error
        if not lock_file(self._descriptor, path):
            os.close(self._descriptor)
            raise LogError(f"{path}: cannot write the log: another writer is at it")

    def write(self, data: bytes) -> None:
        """Append, with one call to the system if it takes all at once; nothing is buffered.

        If it fails or is interrupted, the file ends where it ended before.

        Raises:
            LogError: It could not be written. The file is closed; if nothing is in it, it is gone.
        """
        left = memoryview(data)
        try:
            if self.position == 0:
                os.ftruncate(self._descriptor, 0)
            while len(left):
                left = left[os.write(self._descriptor, left) :]
            self.position += len(data)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.position)
                os.lseek(self._descriptor, self.position, os.SEEK_SET)
            if not isinstance(error, OSError):
                raise
            self.close()
            raise self._failure(error) from error

    def close(self) -> None:
        """Close and unlock; a file this writer made and never wrote to goes away."""
        if self.closed:
            return
        self.closed = True
        if self.position == 0 and (self._created or os.fstat(self._descriptor).st_size == 0):
            with contextlib.suppress(OSError):
                self.path.resolve().unlink()
        os.close(self._descriptor)

    def _failure(self, error: OSError) -> LogError:
        return LogError(f"{self.path}: cannot write the log: {error.strerror or error}")


def lock_file(descriptor: int, path: Path) -> bool:
    """Lock an open file, where the file system has locks.

    Returns:
        False if another process writes the file, or if it is no longer at its path.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass  # ENOLCK, ENOTSUP or ENOSYS: network file systems often have no locks
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False


def _numbers(block: SolveBlock) -> range:
    return range(block.first, block.first + len(block))
