"""Repair of truncated logs, and merging of the shards of a study.

Merging unpacks and verifies every chunk, so the reader accepts every merged log. The
compressed bytes of a chunk are copied unless its solves get new numbers or its channels new ids
(see `casadi_ik.logs.shards`); its messages are then changed and compressed again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, ChunkIndex, Metadata, Schema
from mcap.summary import Summary

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import LogError, os_errors
from casadi_ik.files.arrays import Counts
from casadi_ik.files.writing import atomic_write
from casadi_ik.logs.chunk_writer import lock_file
from casadi_ik.logs.chunks import (
    COMPRESSORS,
    MessageRun,
    UnpackedChunk,
    index_messages,
    is_section,
    pack_chunk,
)
from casadi_ik.logs.container import (
    Contents,
    add_chunk,
    check_magic,
    file_head,
    file_tail,
    message_counts,
    open_log_file,
    read_chunk,
    read_summary,
    scan,
)
from casadi_ik.logs.format import (
    CHECKSUM,
    METADATA_NAME,
    SHARDS,
    parse_layout,
    with_checksum,
)
from casadi_ik.logs.reader import Log
from casadi_ik.logs.shards import Paths, Shard, open_shards


@dataclass(frozen=True)
class RepairResult:
    """The result of repairing a log.

    Attributes:
        path: The file.
        changed: False if the log was complete.
        chunks: Number of complete chunks.
        messages: Number of messages.
        cut: Size of the bytes that were removed after the last complete record [bytes]; 0 if the
            log was complete or only its summary was replaced.
    """

    path: Path
    changed: bool
    chunks: int
    messages: int
    cut: int


def finish_log(path: str | os.PathLike[str]) -> RepairResult:
    """Repair a truncated log in place.

    Every complete chunk is verified by its checksum, incomplete data after the last chunk are
    removed, and the missing summary is written. A complete log is not changed.

    Args:
        path: An MCAP file.

    Raises:
        LogError: The file is missing, cannot be written, is still being written, is not an MCAP
            file, or is damaged before its end. The file is unchanged.

    Example:
        >>> ik.logs.finish_log("cup.mcap").changed  # a complete log
        False
    """
    path = Path(path)
    with open_log_file(path, "finish") as stream:
        _, is_closed = check_magic(stream)
        contents = scan(stream, path)
        is_complete = contents.complete and _summary_matches(stream, contents)
        replaced = 0 if is_complete else _write_tail(contents)
    # A file that was closed loses no data: only its summary is replaced.
    cut = 0 if is_closed else replaced
    chunks = sum(not is_section(index) for index in contents.chunks)
    return RepairResult(path, not is_complete, chunks, sum(contents.counts.values()), cut)


def _write_tail(contents: Contents) -> int:
    """Write the end of a file after its last complete record.

    Returns:
        Size of the data that were replaced [bytes].

    Raises:
        LogError: Another writer has locked the file or has changed its size.
    """
    tail = b""
    if contents.unindexed_runs:
        tail = index_messages(contents.chunks[-1], contents.unindexed_runs, contents.end)
    tail += file_tail(contents.summary, contents.end + len(tail))
    with contents.path.open("r+b") as stream:
        if not lock_file(stream.fileno(), contents.path) or (
            stream.seek(0, os.SEEK_END) != contents.size
        ):
            raise LogError("cannot finish the log: another process has locked or changed it")
        stream.truncate(contents.end)
        stream.seek(contents.end)
        stream.write(tail)
        stream.flush()
        os.fsync(stream.fileno())
    return contents.size - contents.end


def _summary_matches(stream: IO[bytes], contents: Contents) -> bool:
    """Return True if the summary of a file lists exactly the chunks that a scan has found."""

    def positions(indexes: Sequence[ChunkIndex]) -> list[tuple[int, int]]:
        return [
            (index.chunk_start_offset, index.chunk_length)
            for index in indexes
            if not is_section(index)
        ]

    with suppress(LogError):
        summary = read_summary(stream)
        if summary is not None:
            return positions(summary.chunk_indexes) == positions(contents.chunks)
    return False


@dataclass(frozen=True)
class MergeResult:
    """The result of merging logs.

    Attributes:
        path: Path of the merged log.
        shards: Number of merged shards.
        solves: Number of solves by method.
        messages: Number of messages.
        size: Size of the merged log [bytes].
        left_out: Files without a complete record, which were skipped.
    """

    path: Path
    shards: int
    solves: Mapping[str, int]
    messages: int
    size: int
    left_out: tuple[Path, ...] = ()


def merge_logs(shards: Paths, target: str | os.PathLike[str]) -> MergeResult:
    """Merge shards into one log.

    Args:
        shards: Complete logs (see `finish_log`) or folders of them with the same robot, seed, clock
            (`t0_ns`, `slot_ns`) and fields of each method.
        target: Path of the merged log, which appears there once it is complete.

    Raises:
        LogError: A shard is missing, damaged or incomplete, contradicts the first shard, or holds a
            solve that another shard also holds; or the target cannot be written.

    Example:
        >>> merged = ik.logs.merge_logs(["cup.mcap"], "all.mcap")
        >>> ik.logs.open("all.mcap").methods
        ('hand-first',)
    """
    if not isinstance(shards, str | os.PathLike) and not shards:
        raise LogError("merge: found 0 shards, expected at least 1")
    path = Path(target)
    opened, left_out = open_shards(shards)
    for shard in opened:
        _check_compatible(shard, opened[0])
    merge = _Merge(Log(opened, left_out))
    solves = {part.method: len(part) for part in merge.log.solves().parts}
    write_errors = os_errors(f"{path}: cannot write the merged log", LogError)
    with write_errors, atomic_write(path) as temporary, temporary.open("xb") as stream:
        merge.write(stream)
        size = stream.tell()
    messages = sum(message_counts(merge.summary).values())
    return MergeResult(path, len(opened), solves, messages, size, tuple(left_out))


def _check_compatible(shard: Shard, first: Shard) -> None:
    """Check that a shard can be merged with the first one; other metadata may differ.

    Raises:
        LogError: The shard is incomplete, or its robot, seed or clock differs.
    """
    if not shard.contents.complete:
        raise LogError(
            f"{shard.path}: the log is truncated or damaged at its end; `casadi-ik log finish`"
            " repairs truncated logs"
        )
    for key in ("robot", "seed", "t0_ns", "slot_ns"):
        actual, expected = shard.record.get(key), first.record.get(key)
        if actual != expected:
            raise LogError(
                f"{shard.path}: {key}: found {actual}, expected {expected} as in {first.path}"
            )


class _Merge:
    """Shards that are merged into one file.

    Attributes:
        log: The shards.
        summary: Summary of the merged log.
    """

    def __init__(self, log: Log) -> None:
        """Assign a channel id to each topic in the order of first appearance.

        Raises:
            LogError: A topic has different fields in two shards, or there are too many topics.
        """
        self.log = log
        self.summary = Summary()
        # By shard: (new channel id, kind, layout) by old channel id, and True if no id changes.
        self._topics: list[dict[int, tuple[int, str, Layout]]] = []
        self._has_same_ids: list[bool] = []
        numbers: dict[str, int] = {}
        for shard in log.shards:
            topics, has_same_ids = dict[int, tuple[int, str, Layout]](), True
            summary = shard.contents.summary
            for (method, kind), topic in shard.topics.items():
                channel = summary.channels[topic.channel]
                number = numbers.setdefault(channel.topic, len(numbers) + 1)
                if number >= 2**16:
                    raise LogError(f"merge: found more than {2**16 - 1} topics")
                topics[channel.id] = number, kind, topic.layout
                has_same_ids &= channel.id == channel.schema_id == number
                schema = replace(summary.schemas[channel.schema_id], id=number)
                channel = replace(channel, id=number, schema_id=number)
                first_schema = self.summary.schemas.setdefault(number, schema)
                first_channel = self.summary.channels.setdefault(number, channel)
                if not _same_fields(first_schema, schema) or first_channel != channel:
                    holder = next(item.path for item in log.shards if (method, kind) in item.topics)
                    raise LogError(
                        f"{shard.path}: method {method!r} has other fields or names than in"
                        f" {holder} ({channel.topic})"
                    )
            self._topics.append(topics)
            self._has_same_ids.append(has_same_ids)

    def write(self, stream: IO[bytes]) -> None:
        """Write the merged log.

        Raises:
            LogError: A shard is damaged.
            OSError: The log cannot be written.
        """
        log, record = self.log, self._metadata()
        library = f"casadi_ik {record['code_version']}"
        attachments = _attachments(log.shards)
        head = file_head(self.summary, library, Metadata(METADATA_NAME, record), attachments)
        builder = RecordBuilder()
        for definitions in (self.summary.schemas, self.summary.channels):
            for definition in definitions.values():
                definition.write(builder)
        stream.write(head + builder.end())
        chunks = [
            (index.message_start_time + offset * shard.clock.slot, i, index)
            for i, (shard, offset) in enumerate(zip(log.shards, log.sources.offsets, strict=True))
            for index in shard.contents.chunks
        ]
        for _, i, index in sorted(chunks, key=lambda chunk: chunk[:2]):
            with open_log_file(log.shards[i].path) as source:
                chunk = read_chunk(source, index)
                if chunk.runs:
                    data, new_index, runs = self._renumber(chunk, i, stream.tell())
                    stream.write(data)
                    add_chunk(self.summary, new_index, runs)
        stream.write(file_tail(self.summary, stream.tell()))

    def _renumber(
        self, chunk: UnpackedChunk, i: int, position: int
    ) -> tuple[bytes, ChunkIndex, Sequence[MessageRun]]:
        """Return the bytes, index and messages of a chunk in the merged log.

        Args:
            chunk: A chunk of a shard.
            i: Index of the shard.
            position: Offset of the chunk in the merged log.

        Raises:
            LogError: The chunk holds messages of a topic that is not one of casadi_ik.
        """
        shard, topics, offset = self.log.shards[i], self._topics[i], self.log.sources.offsets[i]
        unknown = [run.channel for run in chunk.runs if run.channel not in topics]
        if unknown:
            raise LogError(f"channel {unknown[0]}: its topic is not one of casadi_ik")
        names = {name: key for key, (name, _) in COMPRESSORS.items()}
        compression, runs = names[chunk.packed.compression], chunk.runs
        if offset == 0 and self._has_same_ids[i]:
            data, packed = chunk.data, chunk.packed.data
        else:
            delay = np.uint64(offset * shard.clock.slot)
            blocks, runs, start, packed = [], [], 0, None
            for run in chunk.runs:
                number, kind, layout = topics[run.channel]
                messages = chunk.messages(run, layout.dtype).copy()
                last = int(shard.clock.locate(run.log_time)[0].max()) + offset
                shard.clock.check(last, 1)
                messages["head"]["channel"] = number
                messages["head"]["log_time"] += delay
                if kind == "solve":
                    messages["head"]["sequence"] += np.uint32(offset)
                if "solve_id" in layout.names:
                    messages["row"]["solve_id"] += np.uint32(offset)
                blocks.append(messages.tobytes())
                runs.append(MessageRun(number, start, run.size, run.log_time + delay))
                start += len(blocks[-1])
            data = b"".join(blocks)
        return *pack_chunk(memoryview(data), runs, compression, position, packed), runs

    def _metadata(self) -> dict[str, str]:
        """Return the metadata of the first shard, and the differences of other shards from it."""
        base = {key: text for key, text in self.log.shards[0].record.items() if key != SHARDS}
        parts, origins = self.log.solves().parts, []
        for i, source in enumerate(self.log.sources.sources):
            record = {
                key: text for key, text in source.record.items() if key not in (CHECKSUM, SHARDS)
            }
            solves = {
                part.method: _ranges(part.solve_id[part.shard == i])
                for part in parts
                if part.shard is not None and (part.shard == i).any()
            }
            differs = {key: text for key, text in record.items() if text != base.get(key)}
            names = {"file": source.file, "first": source.first}
            origins.append({**names, "solves": solves, "differs": differs})
        return with_checksum({**base, SHARDS: json.dumps(origins)})


def _same_fields(first: Schema, second: Schema) -> bool:
    """Return True if two schemas have the same fields; descriptions of fields may differ.

    Versions of this package describe fields in different words.
    """

    def fields(schema: Schema) -> list[Field]:
        return [replace(field, doc="") for field in parse_layout(schema.data.decode())]

    if replace(first, data=b"") != replace(second, data=b""):
        return False
    return first.data == second.data or fields(first) == fields(second)


def _ranges(numbers: Counts) -> list[list[int]]:
    """Return [first, last] of every run of consecutive numbers; `numbers` is sorted, not empty."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return [[int(run[0]), int(run[-1])] for run in runs]


def _attachments(shards: Sequence[Shard]) -> list[Attachment]:
    """Return the attachments of all shards.

    Raises:
        LogError: Two shards have different attachments of one name.
    """
    attachments: dict[str, Attachment] = {}
    owners: dict[str, Path] = {}
    for shard in shards:
        for attachment in shard.attachments().values():
            first = attachments.setdefault(attachment.name, attachment)
            owner = owners.setdefault(attachment.name, shard.path)
            if first.data != attachment.data:
                raise LogError(
                    f"{shard.path}: the attachment {attachment.name!r} differs from that of {owner}"
                )
    return list(attachments.values())
