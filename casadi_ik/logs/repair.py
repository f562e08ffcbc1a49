"""Logs made whole: the end of one whose writer was killed, and the shards of a study as one log.

What the reader would refuse is not joined: every chunk is unpacked and verified on its way. A chunk
goes into the new log as it is, compressed, unless its solves get other numbers or its channels
others ids (see `logs.shards`): then its messages are changed accordingly and compressed anew.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, ChunkIndex, Metadata
from mcap.summary import Summary

from casadi_ik.compile.layout import Layout
from casadi_ik.errors import LogError, os_errors
from casadi_ik.files.arrays import Counts
from casadi_ik.files.writing import atomic_write
from casadi_ik.logs.container import (
    COMPRESSORS,
    Contents,
    Run,
    UnpackedChunk,
    add_chunk,
    check_magic,
    file_head,
    file_tail,
    index_messages,
    message_counts,
    open_log_file,
    pack_chunk,
    read_chunk,
    read_summary,
    scan,
)
from casadi_ik.logs.format import CHECKSUM, MESSAGE_KINDS, METADATA_NAME, SHARDS, with_checksum
from casadi_ik.logs.reader import Log
from casadi_ik.logs.shards import Paths, Shard, open_shards
from casadi_ik.logs.writer import lock_file


@dataclass(frozen=True)
class RepairResult:
    """The result of repairing a log.

    Attributes:
        path: The file.
        changed: False if it was whole already.
        chunks: Complete chunks in it.
        messages: Messages in it.
        cut: Bytes of a torn tail that were cut away; 0 if only the summary was missing.
    """

    path: Path
    changed: bool
    chunks: int
    messages: int
    cut: int


def finish_log(path: str | os.PathLike[str]) -> RepairResult:
    """Repair a truncated log in place.

    Every complete chunk is verified by its checksum; what is torn behind the last of them is cut,
    and the end that was never written is written. A log that is whole is left as it is.

    Args:
        path: An MCAP file.

    Raises:
        LogError: The file is missing, cannot be written, is still being written, is no MCAP file,
            or is damaged elsewhere than at its end. Then it has not been changed.

    Example:
        >>> finished = ik.logs.finish_log("cup.mcap")  # whole already: nothing is changed
    """
    path = Path(path)
    with open_log_file(path, "finish") as stream:
        _, closed = check_magic(stream)
        contents = scan(stream, path)
        whole = contents.complete and _ends_well(stream, contents)
        replaced = 0 if whole else _close(contents)
    # Of a file that was closed nothing is torn: only its summary is written anew.
    cut = 0 if closed else replaced
    return RepairResult(path, not whole, len(contents.chunks), sum(contents.counts.values()), cut)


def _close(contents: Contents) -> int:
    """Write the end of a file behind its last whole record; return the bytes that were there."""
    tail = b""
    if contents.owed:
        tail = index_messages(contents.chunks[-1], contents.owed, contents.end)
    tail += file_tail(contents.summary, contents.end + len(tail))
    with contents.path.open("r+b") as stream:
        if not lock_file(stream.fileno(), contents.path) or (
            stream.seek(0, os.SEEK_END) != contents.size
        ):
            raise LogError("cannot finish the log: its writer is still at it")
        stream.truncate(contents.end)
        stream.seek(contents.end)
        stream.write(tail)
        stream.flush()
        os.fsync(stream.fileno())
    return contents.size - contents.end


def _ends_well(stream: IO[bytes], contents: Contents) -> bool:
    """Whether the file ends with a summary that says what it holds."""
    with suppress(LogError):
        summary = read_summary(stream)
        if summary is None:
            return False
        indexed, scanned = summary.chunk_indexes, contents.chunks
        places = [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in indexed]
        return places == [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in scanned]
    return False


@dataclass(frozen=True)
class MergeResult:
    """The result of joining logs.

    Attributes:
        path: The new log.
        shards: How many were joined.
        solves: Solves in it, by method.
        messages: Messages in it.
        size: Its size [bytes].
        left_out: Files in which nothing is whole.
    """

    path: Path
    shards: int
    solves: Mapping[str, int]
    messages: int
    size: int
    left_out: tuple[Path, ...] = ()


def merge_logs(shards: Paths, target: str | os.PathLike[str]) -> MergeResult:
    """Join shards to one log.

    Args:
        shards: Complete logs (see `finish_log`) or folders of them: same robot, seed and clock,
            and the methods of one kind in all.
        target: The log to write; it is there when it is complete.

    Returns:
        What was joined.

    Raises:
        LogError: A shard is missing, damaged or incomplete, contradicts the first, or holds a
            solve that another holds too; or the target cannot be written.

    Example:
        >>> merged = ik.logs.merge_logs(["cup.mcap"], "all.mcap")
        >>> ik.logs.open("all.mcap").methods
        ('hand-first',)
    """
    if not isinstance(shards, str | os.PathLike) and not shards:
        raise LogError("merge: found no shards, expected at least one")
    path = Path(target)
    opened, left_out = open_shards(shards)
    for shard in opened:
        _check_alike(shard, opened[0])
    merge = _Merge(Log(opened, left_out))
    solves = {part.method: len(part) for part in merge.log.solves().parts}
    refused = os_errors(f"{path}: cannot write the merged log", LogError)
    with refused, atomic_write(path) as part, part.open("xb") as stream:
        merge.write(stream)
        size = stream.tell()
    messages = sum(message_counts(merge.summary).values())
    return MergeResult(path, len(opened), solves, messages, size, tuple(left_out))


def _check_alike(shard: Shard, first: Shard) -> None:
    """Check that a shard can be joined to another; in all other metadata they may differ."""
    if not shard.contents.complete:
        raise LogError(
            f"{shard.path}: the log is truncated or damaged at its end (`casadi-ik log finish`"
            " repairs what was torn)"
        )
    for key in ("robot", "seed", "t0_ns", "slot_ns"):
        found, expected = shard.record.get(key), first.record.get(key)
        if found != expected:
            raise LogError(
                f"{shard.path}: {key}: found {found}, expected {expected} as in {first.path}"
            )


class _Merge:
    """A log on its way into one file.

    Attributes:
        log: The shards.
        summary: Of the new file.
    """

    def __init__(self, log: Log) -> None:
        """Put channels together; each topic has the number of its first appearance.

        Raises:
            LogError: A topic is not of one kind in all shards, or there are too many.
        """
        self.log = log
        self.summary = Summary()
        self._topics: list[dict[int, tuple[int, str, Layout]]] = []
        self._same: list[bool] = []
        numbers: dict[str, int] = {}
        for shard in log.shards:
            topics, same, own = dict[int, tuple[int, str, Layout]](), True, shard.contents.summary
            for method, kind in product(shard.methods, MESSAGE_KINDS):
                topic = shard.topic(method, kind)
                channel = own.channels[topic.channel]
                number = numbers.setdefault(channel.topic, len(numbers) + 1)
                if number >= 2**16:
                    raise LogError("more topics than a log has numbers for")
                topics[channel.id] = number, kind, topic.layout
                same &= channel.id == channel.schema_id == number
                schema = replace(own.schemas[channel.schema_id], id=number)
                channel = replace(channel, id=number, schema_id=number)
                known = self.summary.schemas.setdefault(number, schema)
                if known != schema or self.summary.channels.setdefault(number, channel) != channel:
                    holder = next(each.path for each in log.shards if method in each.methods)
                    raise LogError(
                        f"{shard.path}: method {method!r} has other fields or names than in"
                        f" {holder} ({channel.topic})"
                    )
            self._topics.append(topics)
            self._same.append(same)

    def write(self, stream: IO[bytes]) -> None:
        """Write the new log.

        Raises:
            LogError: A shard is damaged.
            OSError: It cannot be written.
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
                    data, moved, runs = self._copied(chunk, i, stream.tell())
                    stream.write(data)
                    add_chunk(self.summary, moved, runs)
        stream.write(file_tail(self.summary, stream.tell()))

    def _copied(
        self, chunk: UnpackedChunk, i: int, position: int
    ) -> tuple[bytes, ChunkIndex, Sequence[Run]]:
        """A chunk of a shard as the new log has it at an offset: bytes, index, messages.

        Raises:
            LogError: It holds what is no part of a log of casadi_ik.
        """
        shard, topics, offset = self.log.shards[i], self._topics[i], self.log.sources.offsets[i]
        strange = [run.channel for run in chunk.runs if run.channel not in topics]
        if strange:
            raise LogError(f"a message of channel {strange[0]}, which is no topic of casadi_ik")
        names = {name: key for key, (name, _) in COMPRESSORS.items()}
        compression, runs = names[chunk.packed.compression], chunk.runs
        if offset == 0 and self._same[i]:
            data, packed = chunk.data, chunk.packed.data
        else:
            later = np.uint64(offset * shard.clock.slot)
            pieces, runs, start, packed = [], [], 0, None
            for run in chunk.runs:
                number, kind, layout = topics[run.channel]
                messages = chunk.messages(run, layout.dtype).copy()
                last = int(shard.clock.locate(run.log_time)[0].max()) + offset
                shard.clock.check(last, 1)
                messages["head"]["channel"] = number
                messages["head"]["log_time"] += later
                if kind == "solve":
                    messages["head"]["sequence"] += np.uint32(offset)
                if "solve_id" in layout.names:
                    messages["row"]["solve_id"] += np.uint32(offset)
                pieces.append(messages.tobytes())
                runs.append(Run(number, start, run.size, run.log_time + later))
                start += len(pieces[-1])
            data = b"".join(pieces)
        return *pack_chunk(memoryview(data), runs, compression, position, packed), runs

    def _metadata(self) -> dict[str, str]:
        """The metadata: of the first shard, and in what each of them differs from it."""
        base = {key: text for key, text in self.log.shards[0].record.items() if key != SHARDS}
        parts, origins = self.log.solves().parts, []
        for i, source in enumerate(self.log.sources.sources):
            own = {
                key: text for key, text in source.record.items() if key not in (CHECKSUM, SHARDS)
            }
            solves = {
                part.method: _ranges(part.solve_id[part.shard == i])
                for part in parts
                if part.shard is not None and (part.shard == i).any()
            }
            differs = {key: text for key, text in own.items() if text != base.get(key)}
            about = {"file": source.file, "first": source.first}
            origins.append({**about, "solves": solves, "differs": differs})
        return with_checksum({**base, SHARDS: json.dumps(origins)})


def _ranges(numbers: Counts) -> list[list[int]]:
    """Sorted numbers, at least one, as first and last of every run."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return [[int(run[0]), int(run[-1])] for run in runs]


def _attachments(shards: Sequence[Shard]) -> list[Attachment]:
    """The attachments of all shards, which must be the same where they have one name."""
    joint: dict[str, Attachment] = {}
    for shard in shards:
        for attachment in shard.attachments().values():
            known = joint.setdefault(attachment.name, attachment)
            if known.data != attachment.data:
                raise LogError(
                    f"{shard.path}: the attachment {attachment.name!r} is not the same as in"
                    f" {shards[0].path}"
                )
    return list(joint.values())
