"""The files of a log, and the numbers of their solves when they are read as one log.

The shards of a study may each number their solves from 0. If two of them use one number for
different solves of a method, numbers are continued from shard to shard, in the order in which the
files were named and within a folder in the order of their paths: solve n of a shard becomes n plus
(the largest number + 1) of every shard before it. Otherwise numbers stay unchanged.
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
    parse_json,
    parse_layout,
    parse_metadata,
    topic,
)
from casadi_ik.logs.rows import solve_layout
from casadi_ik.logs.tables import Labels, MethodRows
from casadi_ik.solve.trace import CONDITION, SIGMA, STANDARD_FIELDS, Elements

logger = logging.getLogger(__name__)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic: messages of one kind of one method.

    Attributes:
        channel: Channel id.
        layout: Fields of a row.
        labels: Names of codes, bits and elements by field.
    """

    channel: int
    layout: Layout
    labels: Labels


class Shard:
    """A file of a log; it is opened for each query and closed again.

    Attributes:
        path: Path of the file.
        name: Name of the file within its log.
        contents: Chunks, attachments and counts.
        record: Metadata record as text by key.
        metadata: Metadata with structured values parsed.
        robot: Name of the robot.
        topics: Topics by method and kind. A file that another program wrote may lack topics without
            messages, because some writers define a channel with its first message.
        methods: Names of the methods.
        clock: Rule of the log times.
    """

    def __init__(self, path: Path, name: str = "") -> None:
        """Read the summary of the file.

        Raises:
            NothingWrittenError: The file ends before its metadata.
            LogError: The file is missing, not an MCAP file, damaged, or not a log of casadi_ik.
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
            self.topics = self._parse_topics()
            self.methods: tuple[str, ...] = tuple(dict.fromkeys(name for name, _ in self.topics))
        self._solves: dict[str, MethodRows] = {}

    def count(self, method: str, kind: str) -> int:
        """Return the number of messages of a kind; 0 if the file does not hold the topic."""
        entry = self.topics.get((method, kind))
        return 0 if entry is None else self.contents.counts.get(entry.channel, 0)

    def attachments(self) -> dict[str, Attachment]:
        """Read the attached files and verify their checksums; return them by name.

        Raises:
            LogError: An attachment is damaged.
        """
        with open_log_file(self.path) as stream:
            return {
                item.name: record_at(Attachment, stream, item.offset, item.length)
                for item in self.contents.summary.attachment_indexes
            }

    def solves(self, method: str) -> MethodRows:
        """Return all solves of a method whose solves have a topic, in the order of the file.

        The result is cached.

        Raises:
            LogError: The file is damaged.
        """
        if method not in self._solves:
            self._solves[method] = self.read(method, "solve")
        return self._solves[method]

    def solve_numbers(self, method: str) -> Counts:
        """Return the numbers of the solves of a method in the order of the file.

        Raises:
            LogError: The file is damaged.
        """
        has_solves = (method, "solve") in self.topics
        return self.solves(method).solve_id if has_solves else np.zeros(0, np.int64)

    def read(
        self,
        method: str,
        kind: str,
        solves: Counts | None = None,
        fields: Sequence[str] | None = None,
    ) -> MethodRows:
        """Read rows in the order of the file.

        Args:
            method: Method of one of the `topics`.
            kind: Kind of this topic: "solve", "iteration" or "event".
            solves: Sorted numbers of the solves; None: all.
            fields: Names of the fields; None: all.

        Raises:
            UnknownNameError: A field does not exist.
            LogError: The file is damaged.
        """
        entry, name = self.topics[method, kind], topic(method, kind)
        for field in fields or ():
            if field not in entry.layout.names:
                names = ", ".join(entry.layout.names)
                raise UnknownNameError(f"no field {field!r}; there are: {names}")
        no_rows = _select_fields(np.zeros(0, entry.layout.dtype), fields)
        all_times, all_rows = [np.zeros(0, np.uint64)], [opaque(no_rows)]
        with open_log_file(self.path) as stream:
            for index in self.contents.chunks:
                if not self._may_hold(index, entry.channel, solves):
                    continue
                chunk = read_chunk(stream, index)
                for run in chunk.runs:
                    if run.channel != entry.channel:
                        continue
                    times, rows = run.log_time, chunk.messages(run, entry.layout.dtype)["row"]
                    if solves is not None:
                        is_selected = np.isin(self.clock.locate(times)[0], solves)
                        times, rows = times[is_selected], rows[is_selected]
                    all_times.append(times)
                    # A copy, so that the memory of the chunk can be freed.
                    all_rows.append(opaque(_select_fields(rows, fields)))
            times, rows = np.concatenate(all_times), np.concatenate(all_rows).view(no_rows.dtype)
            if solves is None and len(times) != self.count(method, kind):
                raise LogError(
                    f"{name!r}: found {len(times)} messages, but the summary counts"
                    f" {self.count(method, kind)}"
                )
            solve_id, iteration = self.clock.locate(times)
            if len(solve_id) and (solve_id.min() < 0 or solve_id.max() >= 2**32):
                raise LogError(f"{name!r}: the time of a message is outside of the log")
            if "solve_id" in (rows.dtype.names or ()) and np.any(rows["solve_id"] != solve_id):
                raise LogError(f"{name!r}: the number of a solve does not match its time")
        units = {item.name: item.unit for item in entry.layout}
        return MethodRows(method, rows, solve_id, iteration, entry.labels, units)

    def _may_hold(self, index: ChunkIndex, channel: int, solves: Counts | None) -> bool:
        """Return False if a chunk cannot hold messages of a channel and of these solves."""
        if index.message_index_offsets and channel not in index.message_index_offsets:
            return False
        if solves is None:
            return True
        times = np.array([index.message_start_time, index.message_end_time], np.uint64)
        low, high = self.clock.locate(times)[0]
        return bool(np.searchsorted(solves, low) < np.searchsorted(solves, high, "right"))

    def _parse_topics(self) -> dict[tuple[str, str], Topic]:
        """Return the topics by method and kind.

        Raises:
            LogError: The schema of a topic is missing, or its schema or labels are invalid.
        """
        summary = self.contents.summary
        topics: dict[tuple[str, str], Topic] = {}
        for channel in summary.channels.values():
            method = channel.metadata.get("method")
            kind = next((kind for kind in MESSAGE_KINDS if channel.topic.endswith(f"/{kind}")), "")
            if method is None or channel.topic != topic(method, kind):
                continue
            if not 0 < len(method) <= 200:
                raise LogError(
                    f"method: found a name of {len(method)} characters, expected 1 to 200"
                )
            if channel.schema_id not in summary.schemas:
                raise LogError(f"topic {channel.topic!r}: its schema is missing")
            layout, labels = parse_channel(kind, channel, summary.schemas[channel.schema_id])
            topics[method, kind] = Topic(channel.id, layout, labels)
        return topics


def log_files(path: Paths) -> list[tuple[Path, str]]:
    """Return the files of a log and the name of each file within the log.

    Args:
        path: A file, a folder (all .mcap files in it and its subfolders in the order of their
            paths; hidden files are incomplete), or several of these.

    Raises:
        LogError: A folder holds no log, or `path` is empty.
    """
    paths = [path] if isinstance(path, str | os.PathLike) else list(path)
    files: list[tuple[Path, str]] = []
    for item in map(Path, paths):
        if not item.is_dir():
            files.append((item, item.name))
            continue
        with os_errors(f"{item}: cannot be read", LogError):
            folder_files = sorted(file for file in item.rglob("*.mcap") if file.name[0] != ".")
        if not folder_files:
            raise LogError(f"{item}: the folder holds no log (*.mcap)")
        files += [(file, file.relative_to(item).as_posix()) for file in folder_files]
    if not files:
        raise LogError("log: found no path, expected at least one")
    return files


def open_shards(path: Paths) -> tuple[list[Shard], list[Path]]:
    """Open the shards of a log.

    A writer that is killed before its first chunk leaves an empty or truncated file. No data are
    lost with it, so it is skipped with a warning if there are other files. MCAP files of other
    programs in a folder are also skipped if the folder holds a log.

    Returns:
        The shards, and the files without a complete record.

    Raises:
        LogError: A file is missing, not an MCAP file, damaged, or not a log of casadi_ik; or no
            file has a complete record.
    """
    files = log_files(path)
    paths = {Path(item) for item in ([path] if isinstance(path, str | os.PathLike) else path)}
    shards: list[Shard] = []
    empty: list[Path] = []
    foreign: list[ForeignLogError] = []
    for file, name in files:
        try:
            shards.append(Shard(file, name))
        except ForeignLogError as error:
            if file in paths:
                raise
            foreign.append(error)
        except NothingWrittenError as error:
            if len(files) == 1:
                raise
            empty.append(file)
            logger.warning("%s; skipped: no complete record", printable(str(error)))
    if foreign and not shards:
        raise foreign[0]
    for error in foreign:
        logger.warning("%s; skipped", printable(str(error)))
    if not shards:
        raise LogError(f"{files[0][0]} and {len(files) - 1} other files: no complete record")
    return shards, empty


class OriginalShard(msgspec.Struct):
    """A shard as it was written; a merged log describes its shards and holds all their solves.

    Attributes:
        file: Name of the original file within its log.
        first: Offset that was added to the numbers of its solves.
        solves: Ranges (first, last) of the numbers of its solves by method; empty: all solves of
            the file.
        differs: Metadata entries that differ from those of the file.
        holder: Index of the file that contains its solves.
        record: Metadata record as text by key.
        metadata: Metadata with structured values parsed.
    """

    file: str
    first: int = 0
    solves: dict[str, list[tuple[int, int]]] = {}
    differs: dict[str, str] = {}
    holder: int = 0
    record: Mapping[str, str] = {}
    metadata: Mapping[str, Any] = {}


class ShardOrigins:
    """Origins of the solves of a log.

    Attributes:
        offsets: Offset of the numbers of each file's solves.
        sources: The shards as they were written.
    """

    def __init__(self, shards: Sequence[Shard]) -> None:
        """Assign consecutive numbers to the solves of several files.

        Raises:
            LogError: A solve is in two files, the files hold too many solves, or the metadata of a
                merged log are invalid.
        """
        self.offsets = _offsets(shards) if _may_share_numbers(shards) else [0] * len(shards)
        self.sources: list[OriginalShard] = []
        for i, (shard, offset) in enumerate(zip(shards, self.offsets, strict=True)):
            with open_log_file(shard.path):
                for source in _original_shards(shard):
                    source.holder, source.first = i, source.first + offset
                    source.solves = {
                        method: [(first + offset, last + offset) for first, last in ranges]
                        for method, ranges in source.solves.items()
                    }
                    source.record = {**shard.record, **source.differs}
                    source.metadata = parse_metadata(source.record)
                    self.sources.append(source)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shards."""
        return tuple(source.file for source in self.sources)

    def differences(self) -> dict[str, tuple[Any, ...]]:
        """Return the distinct values of every metadata entry in which the shards differ."""
        differences: dict[str, tuple[Any, ...]] = {}
        for key in dict.fromkeys(key for source in self.sources for key in source.metadata):
            values: list[Any] = []
            for source in self.sources:
                if source.metadata.get(key) not in values:
                    values.append(source.metadata.get(key))
            if len(values) > 1:
                differences[key] = tuple(values)
        return differences

    def original_shards(self, file: int, method: str, numbers: Counts) -> Counts:
        """Return the index of the original shard of each solve.

        Args:
            file: Index of the file that holds the solves.
            method: Method of the solves.
            numbers: (k,) numbers of the solves in the log.
        """
        in_file = [i for i, source in enumerate(self.sources) if source.holder == file]
        indices = np.full(len(numbers), in_file[0])
        for i in in_file:
            ranges = np.array(self.sources[i].solves.get(method, ()), np.int64).reshape(-1, 2)
            if len(ranges):
                position = np.searchsorted(ranges[:, 0], numbers, "right") - 1
                indices[(position >= 0) & (numbers <= ranges[position, 1])] = i
        return indices


def parse_channel(kind: str, channel: Channel, schema: Schema) -> tuple[Layout, Labels]:
    """Return the layout and labels of the messages of a channel.

    A log may come from an untrusted source. Schemas and labels are compared with those that a
    recorder writes when the log is opened, so that other code can rely on the rows.

    Args:
        kind: "iteration", "solve" or "event".
        channel: The channel.
        schema: Its schema.

    Raises:
        LogError: Schema or labels are invalid.
    """
    context = f"{channel.topic[:200]!r}"
    try:
        layout = _checked_layout(kind, schema.data.decode())
        labels = _checked_labels(channel.metadata.get("labels", "{}"))
        for item in layout if kind == "solve" else ():
            count = len(labels.get(item.name, ()))
            if item.name in ("position_error", "events", "phase_iterations") and (
                count != item.shape[0]
            ):
                raise LogError(
                    f"labels of {item.name}: found {count} names, expected {item.shape[0]}"
                )
    except UnicodeDecodeError as error:
        raise LogError(f"{context}: the schema is not UTF-8 text") from error
    except LogError as error:
        raise LogError(f"{context}: {error}") from error
    return layout, labels


@lru_cache(maxsize=64)
def _checked_layout(kind: str, text: str) -> Layout:
    """Return the layout of a schema after comparing it with the layout of a recorder.

    Raises:
        LogError: A field is missing, or has another type or shape.
    """
    layout = parse_layout(text)
    fields = {item.name: item for item in layout}

    def size(name: str) -> int:
        item = fields.get(name)
        return item.shape[0] if item is not None and len(item.shape) == 1 else 1

    n, f = size("q"), size("position_error")
    if kind == "solve":
        sizes = n, f, size("phase_iterations"), size("events"), size("lowest_sigma")
        expected_fields: Iterable[Field] = solve_layout(*sizes, "clearance" in fields)
        optional = {name for name in layout.names if name.startswith("target_")} | {"lowest_sigma"}
    elif kind == "event":
        expected_fields, optional = event_layout(size("joint_mask")), set()
    else:
        words = -(-n // 32)
        shapes = {
            Elements.ACTUATORS: (n,),
            Elements.ACTUATOR_BITS: () if words == 1 else (words,),
            Elements.FINGERS: (f,),
        }
        expected_fields = [
            Field(item.name, shapes.get(item.elements, ()), item.dtype) for item in STANDARD_FIELDS
        ]
        measured = [item for item in layout if item.name.startswith((SIGMA, CONDITION))]
        expected_fields += [
            item if item.dtype[0] == "f" else replace(item, dtype="f4") for item in measured
        ]
        optional = {item.name for item in expected_fields}
    for expected in expected_fields:
        actual = fields.get(expected.name)
        if actual is None and expected.name not in optional:
            raise LogError(f"schema: field {expected.name!r} is missing")
        if actual is not None and (actual.dtype, actual.shape) != (expected.dtype, expected.shape):
            raise LogError(
                f"schema: field {expected.name!r}: found {actual.dtype} {actual.shape}, expected"
                f" {expected.dtype} {expected.shape}"
            )
    return layout


@lru_cache(maxsize=256)
def _checked_labels(text: str) -> Labels:
    """Return labels from JSON after checking the number and length of their names.

    Raises:
        LogError: The text is not JSON, or has too many or too long names.
    """
    labels = parse_json("labels", text, dict[str, tuple[str, ...]])
    for field, names in labels.items():
        if len(names) > 4096 or max(map(len, (field, *names))) > 200:
            raise LogError(
                f"labels of {field[:200]!r}: more than 4096 names or 200 characters in a name"
            )
    return labels


def _select_fields(rows: NDArray[Any], fields: Sequence[str] | None) -> NDArray[Any]:
    """Return rows with some of their fields, in the order of the log."""
    if fields is None:
        return rows
    return repack_fields(rows[[name for name in rows.dtype.names or () if name in fields]])


def _original_shards(shard: Shard) -> list[OriginalShard]:
    """Return the shards that a merged log describes; for other logs, the shard itself.

    Raises:
        LogError: The description is invalid.
    """
    context = f"metadata: {SHARDS}"
    originals: list[OriginalShard] = parse_json(
        context, shard.record.get(SHARDS, "[]"), list[OriginalShard]
    )
    for original in originals:
        numbers = [
            number for ranges in original.solves.values() for pair in ranges for number in pair
        ]
        if not all(0 <= number < 2**32 for number in (original.first, *numbers)):
            raise LogError(f"{context}: the number of a solve is negative or too large")
    return originals or [OriginalShard(shard.name)]


def _may_share_numbers(shards: Sequence[Shard]) -> bool:
    """Return False if the times of the chunks exclude that two shards share a solve number."""
    spans = []
    for shard in shards:
        chunks = shard.contents.chunks
        if chunks:
            times = (
                min(index.message_start_time for index in chunks),
                max(index.message_end_time for index in chunks),
            )
            spans.append(tuple(shard.clock.locate(np.array(times, np.uint64))[0].tolist()))
    spans.sort()
    return any(following[0] <= previous[1] for previous, following in pairwise(spans))


def _offsets(shards: Sequence[Shard]) -> list[int]:
    """Return the offset of the solve numbers of each shard (see the module's docstring).

    Raises:
        LogError: A solve is in two shards, or the shards hold too many solves.
    """
    share_numbers = False
    for method in dict.fromkeys(method for shard in shards for method in shard.methods):
        numbers = np.concatenate([shard.solve_numbers(method) for shard in shards])
        if len(np.unique(numbers)) < len(numbers):
            _check_distinct(
                method, [shard for shard in shards if (method, "solve") in shard.topics]
            )
            share_numbers = True
    if not share_numbers:
        return [0] * len(shards)
    last_numbers = [
        [int(shard.solve_numbers(method).max(initial=-1)) for method in shard.methods]
        for shard in shards
    ]
    counts = (max(numbers, default=-1) + 1 for numbers in last_numbers)
    *offsets, total = accumulate(counts, initial=0)
    if total >= 2**32:
        raise LogError(
            f"{shards[0].path} and {len(shards) - 1} other files: found {total} solves, expected"
            " fewer than 2**32"
        )
    return offsets


def _check_distinct(method: str, shards: Sequence[Shard]) -> None:
    """Check that no solve is in two shards, whatever its number.

    Raises:
        LogError: A solve is in two shards.
    """
    shard_of_row: dict[bytes, Shard] = {}
    for shard in shards:
        rows = shard.solves(method).rows.copy()
        numbers = rows["solve_id"].copy()
        rows["solve_id"] = 0
        keys = [row.tobytes() for row in opaque(rows)]
        duplicates = [i for i, key in enumerate(keys) if key in shard_of_row]
        if duplicates:
            first = min(duplicates, key=lambda i: numbers[i])
            raise LogError(
                f"{shard.path}: solve {numbers[first] + 1} of {method} is also in"
                f" {shard_of_row[keys[first]].path} ({len(duplicates)} such solves)"
            )
        shard_of_row.update(dict.fromkeys(keys, shard))
