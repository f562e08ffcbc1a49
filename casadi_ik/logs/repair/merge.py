"""Joins the shards of a study: compressed chunks are copied as they are, only offsets change.

Log times are arithmetic in the number of the solve, so shards can only be joined if they count
time alike and no solve of a method is in two of them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Metadata, Schema

from casadi_ik.errors import LogError
from casadi_ik.files.writing import written_whole
from casadi_ik.logs.mcap.chunk import definitions
from casadi_ik.logs.mcap.clock import LogClock
from casadi_ik.logs.mcap.contents import read_attachment, reading
from casadi_ik.logs.mcap.metadata import CHECKSUM, METADATA_NAME, checksum
from casadi_ik.logs.mcap.records import HEAD
from casadi_ik.logs.mcap.summary import Summary
from casadi_ik.logs.mcap.unpacking import read_chunk
from casadi_ik.logs.read.shard import Shard, naming

VARYING = ("created", "machine", "python", "packages", "code_version", "compression")
"""What may differ between shards; what does is kept in the metadata, shard by shard."""

Declared = TypeVar("Declared", Schema, Channel)


@dataclass(frozen=True)
class Merged:
    """What was joined.

    Attributes:
        path: The new log.
        shards: How many were joined.
        solves: Solves in it, by method.
        messages: Messages in it.
        size: Its size [bytes].
    """

    path: Path
    shards: int
    solves: Mapping[str, int]
    messages: int
    size: int


@dataclass(frozen=True)
class _Shard:
    path: Path
    stream: IO[bytes]
    summary: Summary
    metadata: Mapping[str, str]
    attachments: tuple[Attachment, ...]


def merge_logs(shards: Sequence[str | os.PathLike[str]], target: str | os.PathLike[str]) -> Merged:
    """Join shards to one log.

    Args:
        shards: Complete logs (see `finish_log`) of one study: same robot, parameters, seed and
            clock, same schemas and channels under the same numbers.
        target: The log to write; it is there when it is complete.

    Returns:
        What was joined.

    Raises:
        LogError: A shard is missing, damaged or incomplete, contradicts the first, or holds a
            solve that another holds too; or the target cannot be written.
    """
    if not shards:
        raise LogError("merge: found no shards, expected at least one")
    path = Path(target)
    with ExitStack() as stack:
        opened = [stack.enter_context(_opened(Path(shard))) for shard in shards]
        metadata = _joint_metadata(opened)
        solves = _joint_solves(opened, LogClock(int(metadata["t0_ns"]), int(metadata["slot_ns"])))
        summary = _joint_summary(opened)
        attachments = _joint_attachments(opened)
        try:
            with written_whole(path) as part, part.open("xb") as stream:
                _write(stream, opened, summary, metadata, attachments)
                size = stream.tell()
        except OSError as error:
            reason = error.strerror or str(error)
            raise LogError(f"{path}: cannot write the merged log: {reason}") from error
    return Merged(path, len(opened), solves, sum(summary.counts.values()), size)


@contextmanager
def _opened(path: Path) -> Iterator[_Shard]:
    shard = Shard(path)
    if not shard.contents.complete:
        raise LogError(f"{path}: not finished (`casadi-ik log finish` repairs what was torn)")
    with reading(path) as stream:
        attachments = tuple(read_attachment(stream, item) for item in shard.contents.attachments)
    with path.open("rb") as stream:
        yield _Shard(path, stream, shard.contents.summary, shard.record, attachments)


def _joint_metadata(shards: Sequence[_Shard]) -> dict[str, str]:
    first = shards[0]
    for shard in shards[1:]:
        for key in sorted({*first.metadata, *shard.metadata} - {*VARYING, CHECKSUM}):
            place, found, expected = _difference(key, shard.metadata, first.metadata)
            if found != expected:
                raise LogError(
                    f"{shard.path}: {place}: found {found}, expected {expected} as in {first.path}"
                )
    origins = [
        {"file": shard.path.name}
        | {key: shard.metadata[key] for key in VARYING if key in shard.metadata}
        for shard in shards
    ]
    record = {**first.metadata, "shards": json.dumps(origins)}
    return {**record, CHECKSUM: checksum(record)}


def _difference(
    key: str, found: Mapping[str, Any], expected: Mapping[str, Any]
) -> tuple[str, Any, Any]:
    """The first place under a key where two records differ, and what is there."""
    first, second = _parsed(found.get(key)), _parsed(expected.get(key))
    if isinstance(first, dict) and isinstance(second, dict):
        for name in sorted({*first, *second}):
            if first.get(name) != second.get(name):
                place, *rest = _difference(name, first, second)
                return f"{key}.{place}", rest[0], rest[1]
    return key, first, second


def _parsed(value: Any) -> Any:
    """JSON as what it says; anything else as it is."""
    if isinstance(value, str):
        with suppress(ValueError):
            return json.loads(value)
    return value


def _joint_solves(shards: Sequence[_Shard], clock: LogClock) -> dict[str, int]:
    """How many solves there are by method; each must be in one shard only."""
    holders: dict[str, dict[int, _Shard]] = {}
    for shard in shards:
        for method, numbers in _solves_of(shard, clock).items():
            holder = holders.setdefault(method, {})
            doubled = sorted(numbers & holder.keys())
            if doubled:
                raise LogError(
                    f"{shard.path}: solve {doubled[0]} of {method} is in"
                    f" {holder[doubled[0]].path} too ({len(doubled)} such solves)"
                )
            holder.update(dict.fromkeys(numbers, shard))
    return {method: len(holder) for method, holder in holders.items()}


def _solves_of(shard: _Shard, clock: LogClock) -> dict[str, set[int]]:
    """Numbers of the solves by method."""
    found: dict[str, set[int]] = {}
    methods = {
        channel.id: channel.metadata["method"]
        for channel in shard.summary.channels.values()
        if "method" in channel.metadata
    }
    for index in shard.summary.chunks:
        with naming(shard.path):
            chunk = read_chunk(shard.stream, index)
        for run in chunk.runs:
            numbers = found.setdefault(methods[run.channel], set())
            numbers.update(np.unique(clock.locate(run.log_time)[0]).tolist())
    return found


def _joint_summary(shards: Sequence[_Shard]) -> Summary:
    """Schemas, channels and counts of all; one number stands for one thing."""
    joint = Summary()
    for shard in shards:
        _unite(shard, shards[0], joint.channels, shard.summary.channels)
        _unite(shard, shards[0], joint.schemas, shard.summary.schemas)
        for channel, count in shard.summary.counts.items():
            joint.counts[channel] = joint.counts.get(channel, 0) + count
    return joint


def _unite(
    shard: _Shard, first: _Shard, joint: dict[int, Declared], found: Mapping[int, Declared]
) -> None:
    for number, record in found.items():
        known = joint.setdefault(number, record)
        if known != record:
            raise LogError(
                f"{shard.path}: {type(record).__name__.lower()} {number}, {_name(record)}, is not"
                f" as in {first.path} ({_name(known)})"
            )


def _name(record: Schema | Channel) -> str:
    return record.topic if isinstance(record, Channel) else record.name


def _joint_attachments(shards: Sequence[_Shard]) -> list[Attachment]:
    joint: dict[str, Attachment] = {}
    for shard in shards:
        for attachment in shard.attachments:
            known = joint.setdefault(attachment.name, attachment)
            if known.data != attachment.data:
                raise LogError(
                    f"{shard.path}: the attachment {attachment.name!r} is not the same as in"
                    f" {shards[0].path}"
                )
    return list(joint.values())


def _write(
    stream: IO[bytes],
    shards: Sequence[_Shard],
    summary: Summary,
    metadata: dict[str, str],
    attachments: Sequence[Attachment],
) -> None:
    record, library = Metadata(METADATA_NAME, metadata), f"casadi_ik {metadata['code_version']}"
    stream.write(summary.beginning("ros2", library, record, attachments))
    stream.write(definitions([*summary.schemas.values()], [*summary.channels.values()]))
    pairs = [(index, shard) for shard in shards for index in shard.summary.chunks]
    for index, shard in sorted(pairs, key=lambda pair: pair[0].message_start_time):
        summary.chunks.append(_copy(stream, shard, index))
    stream.write(summary.ending(stream.tell()))


def _copy(stream: IO[bytes], shard: _Shard, index: ChunkIndex) -> ChunkIndex:
    """Copy a chunk with its message indexes as it is; gives where it is now."""
    shard.stream.seek(index.chunk_start_offset)
    data = shard.stream.read(index.chunk_length + index.message_index_length)
    if HEAD.unpack_from(data) != (Opcode.CHUNK, index.chunk_length - HEAD.size):
        raise LogError(f"{shard.path}: no chunk at byte {index.chunk_start_offset}")
    moved = stream.tell() - index.chunk_start_offset
    stream.write(data)
    return replace(
        index,
        chunk_start_offset=index.chunk_start_offset + moved,
        message_index_offsets={
            channel: offset + moved for channel, offset in index.message_index_offsets.items()
        },
    )
