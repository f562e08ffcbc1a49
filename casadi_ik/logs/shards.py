"""The files of a log, one by one, and how their solves are numbered when they are read as one.

The shards of a study may each count from 0. If two of them use a number for different solves of a
method, the numbers go on from shard to shard, in the order in which the files were named and
below a folder in the order of their paths: solve n of a shard becomes n plus, for every shard
before it, its largest number plus one. Otherwise every number stays as it is.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from mcap.records import Attachment, Channel, ChunkIndex, Schema
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field, Layout, opaque
from casadi_ik.errors import LogError, UnknownNameError, os_errors, printable
from casadi_ik.files.arrays import Counts
from casadi_ik.logs.container import (
    NOT_IN_CHUNKS,
    ForeignLogError,
    NothingWrittenError,
    open_log_file,
    read_chunk,
    read_contents,
    record_at,
)
from casadi_ik.logs.events import event_layout
from casadi_ik.logs.format import (
    MESSAGE_KINDS,
    SHARDS,
    casadi_ik_record,
    clock_from_metadata,
    parse_layout,
    parse_metadata,
    parsed_json,
    topic,
)
from casadi_ik.logs.rows import solve_layout
from casadi_ik.logs.tables import Labels, MethodRows
from casadi_ik.solve.trace import CONDITION, SIGMA, STANDARD_FIELDS, Elements

logger = logging.getLogger(__name__)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@dataclass(frozen=True, eq=False)
class Topic:
    """Messages of one kind of one method.

    Attributes:
        channel: Channel id.
        layout: Fields of a row.
        labels: Names that make a field readable.
    """

    channel: int
    layout: Layout
    labels: Labels


class Shard:
    """One file. It is opened anew for each question.

    Attributes:
        path: The file.
        name: Its name among the files of its log.
        contents: Its chunks, attachments and counts.
        record: Its provenance, as it stands in the file.
        metadata: The same, structured values as what they say.
        robot: Name of the robot.
        methods: The methods it holds.
        clock: Rule of its log times.
    """

    def __init__(self, path: Path, name: str = "") -> None:
        """Read the summary of the file.

        Raises:
            NothingWrittenError: Its writer was killed before anything was whole.
            LogError: It is missing, no MCAP file, damaged, or no log of casadi_ik.
        """
        self.path = path
        self.name = name or path.name
        self.contents = read_contents(path)
        with open_log_file(path):
            contents = self.contents
            if not (contents.complete or contents.chunks or contents.records):
                raise NothingWrittenError("the log is truncated before its metadata")
            self.record: Mapping[str, str] = casadi_ik_record(contents.records)
            self.metadata: Mapping[str, Any] = parse_metadata(self.record)
            self.robot: str = self.metadata["robot"]
            self.clock = clock_from_metadata(self.metadata)
            if not contents.chunks and any(contents.counts.values()):
                raise ForeignLogError(NOT_IN_CHUNKS)
            self._topics = self._described()
            self.methods: tuple[str, ...] = tuple(dict.fromkeys(name for name, _ in self._topics))
        self._solves: dict[str, MethodRows] = {}

    def topic(self, method: str, kind: str) -> Topic:
        """The messages of a kind of one of the `methods`."""
        return self._topics[method, kind]

    def count(self, method: str, kind: str) -> int:
        """Number of messages of a kind that a method has; 0 if it is not in this file."""
        found = self._topics.get((method, kind))
        return 0 if found is None else self.contents.counts.get(found.channel, 0)

    def attachments(self) -> dict[str, Attachment]:
        """The attached files by name, their checksums verified.

        Raises:
            LogError: One is damaged.
        """
        with open_log_file(self.path) as stream:
            found = self.contents.summary.attachment_indexes
            return {
                item.name: record_at(Attachment, stream, item.offset, item.length) for item in found
            }

    def solves(self, method: str) -> MethodRows:
        """All solves of a method, in the order of the file; they are read once.

        Raises:
            LogError: The file is damaged.
        """
        if method not in self._solves:
            self._solves[method] = self.read(method, "solve")
        return self._solves[method]

    def read(
        self,
        method: str,
        kind: str,
        solves: Counts | None = None,
        fields: Sequence[str] | None = None,
    ) -> MethodRows:
        """Rows in the order of the file.

        Args:
            method: One of `methods`.
            kind: "solve", "iteration" or "event".
            solves: Numbers of the solves wanted, sorted; None: all.
            fields: Names of the fields wanted; None: all.

        Raises:
            UnknownNameError: No such field.
            LogError: The file is damaged.
        """
        found, name = self._topics[method, kind], topic(method, kind)
        for each in fields or ():
            if each not in found.layout.names:
                names = ", ".join(found.layout.names)
                raise UnknownNameError(f"no field {each!r}; there are: {names}")
        none = _chosen(np.zeros(0, found.layout.dtype), fields)
        all_times, all_rows = [np.zeros(0, np.uint64)], [opaque(none)]
        with open_log_file(self.path) as stream:
            for index in self.contents.chunks:
                if not self._may_hold(index, found.channel, solves):
                    continue
                chunk = read_chunk(stream, index)
                for run in chunk.runs:
                    if run.channel != found.channel:
                        continue
                    times, part = run.log_time, chunk.messages(run, found.layout.dtype)["row"]
                    if solves is not None:
                        wanted = np.isin(self.clock.locate(times)[0], solves)
                        times, part = times[wanted], part[wanted]
                    all_times.append(times)
                    # A copy, so that the chunk need not be kept.
                    all_rows.append(opaque(_chosen(part, fields)))
            times, rows = np.concatenate(all_times), np.concatenate(all_rows).view(none.dtype)
            if solves is None and len(times) != self.count(method, kind):
                raise LogError(
                    f"{len(times)} messages on {name!r}, but the summary counts"
                    f" {self.count(method, kind)}"
                )
            solve_id, iteration = self.clock.locate(times)
            if len(solve_id) and (solve_id.min() < 0 or solve_id.max() >= 2**32):
                raise LogError(f"{name!r}: a message before the log began, or late")
            if "solve_id" in (rows.dtype.names or ()) and np.any(rows["solve_id"] != solve_id):
                raise LogError(f"{name!r}: a solve's number is not that of its time")
        units = {item.name: item.unit for item in found.layout}
        return MethodRows(method, rows, solve_id, iteration, found.labels, units)

    def _may_hold(self, index: ChunkIndex, channel: int, solves: Counts | None) -> bool:
        """Whether a chunk may hold messages of a channel and of some solves."""
        if index.message_index_offsets and channel not in index.message_index_offsets:
            return False
        if solves is None:
            return True
        times = np.array([index.message_start_time, index.message_end_time], np.uint64)
        low, high = self.clock.locate(times)[0]
        return bool(np.searchsorted(solves, low) < np.searchsorted(solves, high, "right"))

    def _described(self) -> dict[tuple[str, str], Topic]:
        """The topics by method and kind.

        Raises:
            LogError: One is missing, or is not such as a log of ours has.
        """
        summary = self.contents.summary
        by_name = {channel.topic: channel for channel in summary.channels.values()}
        found: dict[tuple[str, str], Topic] = {}
        for channel in summary.channels.values():
            method = channel.metadata.get("method")
            if method is None or channel.topic != topic(method, MESSAGE_KINDS[0]):
                continue
            if not 0 < len(method) <= 200:
                raise LogError(f"a method's name has {len(method)} characters")
            for kind in MESSAGE_KINDS:
                own = by_name.get(topic(method, kind))
                if own is None or own.schema_id not in summary.schemas:
                    raise LogError(f"no topic {topic(method, kind)!r}, or no schema of it")
                layout, labels = parse_channel(kind, own, summary.schemas[own.schema_id])
                found[method, kind] = Topic(own.id, layout, labels)
        return found


def log_files(path: Paths) -> list[tuple[Path, str]]:
    """Files of a log, and the name of each among them.

    Args:
        path: A file, a folder (all .mcap files in it and below, by the order of their paths;
            hidden ones are unfinished work of others), or several of these.

    Raises:
        LogError: A folder holds no log, or nothing was named.
    """
    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    files: list[tuple[Path, str]] = []
    for item in map(Path, given):
        if not item.is_dir():
            files.append((item, item.name))
            continue
        with os_errors(f"{item}: cannot be read", LogError):
            inside = sorted(file for file in item.rglob("*.mcap") if file.name[0] != ".")
        if not inside:
            raise LogError(f"{item}: no log in this folder")
        files += [(file, file.relative_to(item).as_posix()) for file in inside]
    if not files:
        raise LogError("no log was named")
    return files


def open_shards(path: Paths) -> tuple[list[Shard], list[Path]]:
    """Open the shards of a log.

    A writer that is killed before its first chunk leaves an empty or torn file, with which
    nothing is lost. Among others it is left out with a warning. So is an MCAP file of another
    program in a folder, as long as the folder holds a log.

    Returns:
        The shards, and the files in which nothing is whole.

    Raises:
        LogError: A file is missing, is no MCAP file, is damaged, or is not a log of casadi_ik; or
            nothing is whole in any.
    """
    files = log_files(path)
    given = [path] if isinstance(path, str | os.PathLike) else path
    named = {Path(item) for item in given}
    shards: list[Shard] = []
    empty: list[Path] = []
    foreign: list[ForeignLogError] = []
    for file, name in files:
        try:
            shards.append(Shard(file, name))
        except ForeignLogError as error:
            if file in named:
                raise
            foreign.append(error)
        except NothingWrittenError as error:
            if len(files) == 1:
                raise
            empty.append(file)
            logger.warning("%s; left out, nothing in it is whole", printable(str(error)))
    if foreign and not shards:
        raise foreign[0]
    for error in foreign:
        logger.warning("%s; left out", printable(str(error)))
    if not shards:
        raise LogError(f"{files[0][0]}: nothing in it is whole, nor in {len(files) - 1} others")
    return shards, empty


class OriginalShard(msgspec.Struct):
    """A shard as it was written; a merged log, which says so of each, has several in one file.

    Attributes:
        file: Name of its own file; below a folder the path from there.
        first: What its solves' numbers were raised by.
        solves: First and last numbers of its solves in every stretch, by method; empty: all that
            are in the file.
        differs: Entries of its provenance that are not as in the file's.
        holder: Number of the file in which its solves stand now.
        record: Its provenance, as it stands in the file.
        metadata: The same, structured values as what they say.
    """

    file: str
    first: int = 0
    solves: dict[str, list[tuple[int, int]]] = {}
    differs: dict[str, str] = {}
    holder: int = 0
    record: Mapping[str, str] = {}
    metadata: Mapping[str, Any] = {}


class ShardOrigins:
    """Where the solves of a log come from.

    Attributes:
        offsets: What the numbers of each file's solves are raised by.
        sources: The shards as they were written.
    """

    def __init__(self, shards: Sequence[Shard]) -> None:
        """Number the solves of some files.

        Raises:
            LogError: One and the same solve is in two files, there are too many, or what a merged
                log says of its shards is malformed.
        """
        self.offsets = _offsets(shards) if _overlapping(shards) else [0] * len(shards)
        self.sources: list[OriginalShard] = []
        for i, (shard, offset) in enumerate(zip(shards, self.offsets, strict=True)):
            with open_log_file(shard.path):
                for source in _sources(shard):
                    source.holder, source.first = i, source.first + offset
                    source.solves = {
                        method: [(first + offset, last + offset) for first, last in pairs]
                        for method, pairs in source.solves.items()
                    }
                    source.record = {**shard.record, **source.differs}
                    source.metadata = parse_metadata(source.record)
                    self.sources.append(source)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sources."""
        return tuple(source.file for source in self.sources)

    def differences(self) -> dict[str, tuple[Any, ...]]:
        """Entries of the metadata in which they differ, and all that is said there."""
        found: dict[str, tuple[Any, ...]] = {}
        for key in dict.fromkeys(key for each in self.sources for key in each.metadata):
            values: list[Any] = []
            for each in self.sources:
                if each.metadata.get(key) not in values:
                    values.append(each.metadata.get(key))
            if len(values) > 1:
                found[key] = tuple(values)
        return found

    def of(self, file: int, method: str, numbers: Counts) -> Counts:
        """The source that each of the solves (k,) of a file comes from, by their numbers here."""
        own = [i for i, source in enumerate(self.sources) if source.holder == file]
        found = np.full(len(numbers), own[0])
        for i in own:
            ranges = np.array(self.sources[i].solves.get(method, ()), np.int64).reshape(-1, 2)
            if len(ranges):
                place = np.searchsorted(ranges[:, 0], numbers, "right") - 1
                found[(place >= 0) & (numbers <= ranges[place, 1])] = i
        return found


def parse_channel(kind: str, channel: Channel, schema: Schema) -> tuple[Layout, Labels]:
    """Layout and labels of the messages of a channel.

    A log may come from anybody. Its schemas and labels are checked once, when it is opened, against
    those that a recorder writes; behind that, whoever works with its rows can rely on them.

    Args:
        kind: "iteration", "solve" or "event".
        channel: The channel.
        schema: Its schema.

    Raises:
        LogError: They are not such as a log of ours has.
    """
    where = f"{channel.topic[:200]!r}"
    try:
        layout = _layout(kind, schema.data.decode())
        labels = _labels(channel.metadata.get("labels", "{}"))
        for item in layout if kind == "solve" else ():
            count = len(labels.get(item.name, ()))
            if item.name in ("position_error", "events", "phase_iterations") and (
                count != item.shape[0]
            ):
                raise LogError(f"labels of {item.name}: {count} names for {item.shape[0]} elements")
    except UnicodeDecodeError as error:
        raise LogError(f"{where}: its schema is not UTF-8 text") from error
    except LogError as error:
        raise LogError(f"{where}: {error}") from error
    return layout, labels


@lru_cache(maxsize=64)
def _layout(kind: str, text: str) -> Layout:
    layout = parse_layout(text)
    fields = {item.name: item for item in layout}

    def size(name: str) -> int:
        item = fields.get(name)
        return item.shape[0] if item is not None and len(item.shape) == 1 else 1

    n, f = size("q"), size("position_error")
    if kind == "solve":
        sizes = n, f, size("phase_iterations"), size("events"), size("lowest_sigma")
        expected: Iterable[Field] = solve_layout(*sizes, "clearance" in fields)
        optional = {name for name in layout.names if name.startswith("target_")} | {"lowest_sigma"}
    elif kind == "event":
        expected, optional = event_layout(size("joint_mask")), set()
    else:
        words = -(-n // 32)
        shapes = {
            Elements.ACTUATORS: (n,),
            Elements.ACTUATOR_BITS: () if words == 1 else (words,),
            Elements.FINGERS: (f,),
        }
        expected = [
            Field(each.name, shapes.get(each.elements, ()), each.dtype) for each in STANDARD_FIELDS
        ]
        measured = [item for item in layout if item.name.startswith((SIGMA, CONDITION))]
        expected += [
            item if item.dtype[0] == "f" else replace(item, dtype="f4") for item in measured
        ]
        optional = {item.name for item in expected}
    for item in expected:
        found = fields.get(item.name)
        if found is None and item.name not in optional:
            raise LogError(f"schema: no field {item.name!r}")
        if found is not None and (found.dtype, found.shape) != (item.dtype, item.shape):
            raise LogError(
                f"schema: field {item.name!r}: found {found.dtype} {found.shape}, expected"
                f" {item.dtype} {item.shape}"
            )
    return layout


@lru_cache(maxsize=256)
def _labels(text: str) -> Labels:
    labels = parsed_json("labels", text, dict[str, tuple[str, ...]])
    for name, names in labels.items():
        if len(names) > 4096 or max(map(len, (name, *names))) > 200:
            raise LogError(
                f"labels of {name[:200]!r}: more than 4096 names, or one of over 200 characters"
            )
    return labels


def _chosen(rows: NDArray[Any], fields: Sequence[str] | None) -> NDArray[Any]:
    """Some fields of rows, in the order of the log."""
    if fields is None:
        return rows
    return repack_fields(rows[[name for name in rows.dtype.names or () if name in fields]])


def _sources(shard: Shard) -> list[OriginalShard]:
    """What a merged log says of its shards; of any other the one that it is."""
    what = f"metadata: {SHARDS}"
    found: list[OriginalShard] = parsed_json(
        what, shard.record.get(SHARDS, "[]"), list[OriginalShard]
    )
    for each in found:
        pairs = [number for ranges in each.solves.values() for pair in ranges for number in pair]
        if not all(0 <= number < 2**32 for number in (each.first, *pairs)):
            raise LogError(f"{what}: a number of a solve is negative or too large")
    return found or [OriginalShard(shard.name)]


def _overlapping(shards: Sequence[Shard]) -> bool:
    """Whether two shards may hold a solve of the same number, by the times of their chunks."""
    spans = []
    for shard in shards:
        chunks = shard.contents.chunks
        if chunks:
            times = (
                min(c.message_start_time for c in chunks),
                max(c.message_end_time for c in chunks),
            )
            spans.append(tuple(shard.clock.locate(np.array(times, np.uint64))[0].tolist()))
    spans.sort()
    return any(after[0] <= before[1] for before, after in pairwise(spans))


def _offsets(shards: Sequence[Shard]) -> list[int]:
    """What the numbers of each shard's solves are raised by: see above.

    Raises:
        LogError: One and the same solve is in two shards, or there are too many.
    """
    clash = False
    for method in dict.fromkeys(method for shard in shards for method in shard.methods):
        holders = [shard for shard in shards if method in shard.methods]
        numbers = np.concatenate([shard.solves(method).solve_id for shard in holders])
        if len(np.unique(numbers)) < len(numbers):
            _refuse_same(method, holders)
            clash = True
    if not clash:
        return [0] * len(shards)
    numbers = [
        [int(shard.solves(method).solve_id.max(initial=-1)) for method in shard.methods]
        for shard in shards
    ]
    *offsets, total = accumulate((max(each, default=-1) + 1 for each in numbers), initial=0)
    if total >= 2**32:
        raise LogError(f"{shards[0].path} and others: more solves than can be numbered")
    return offsets


def _refuse_same(method: str, shards: Sequence[Shard]) -> None:
    """Check that no solve is in two shards, whatever its number.

    Raises:
        LogError: One is.
    """
    seen: dict[bytes, Shard] = {}
    for shard in shards:
        rows = shard.solves(method).rows.copy()
        numbers = rows["solve_id"].copy()
        rows["solve_id"] = 0
        own = [row.tobytes() for row in opaque(rows)]
        same = [i for i, row in enumerate(own) if row in seen]
        if same:
            first = min(same, key=lambda i: numbers[i])
            raise LogError(
                f"{shard.path}: solve {numbers[first] + 1} of {method} is in"
                f" {seen[own[first]].path} too ({len(same)} such solves)"
            )
        seen.update(dict.fromkeys(own, shard))
