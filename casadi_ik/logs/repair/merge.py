"""Joins the shards of a study to one log.

What the reader would refuse is not joined: every chunk is unpacked and verified on its way. A chunk
goes into the new log as it is, compressed, unless its solves get other numbers or its channels
others ids (see `read.sources`): then its messages are changed accordingly and compressed anew.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap.records import Attachment, Metadata

from casadi_ik.errors import LogError
from casadi_ik.files.writing import written_whole
from casadi_ik.logs.mcap.chunk import definitions
from casadi_ik.logs.mcap.contents import read_attachment, reading
from casadi_ik.logs.mcap.metadata import CHECKSUM, METADATA_NAME, SHARDS, checksum
from casadi_ik.logs.mcap.summary import Summary
from casadi_ik.logs.read.files import open_shards
from casadi_ik.logs.read.log import Log
from casadi_ik.logs.read.shard import Shard
from casadi_ik.logs.read.sources import ranges_of
from casadi_ik.logs.repair.joint import JointChannels, copied

ALIKE = ("robot", "seed", "t0_ns", "slot_ns")
"""What must be the same in all shards; in what else they differ is kept, shard by shard."""


@dataclass(frozen=True)
class Merged:
    """What was joined.

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


def merge_logs(
    shards: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
) -> Merged:
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
        if not shard.contents.complete:
            raise LogError(
                f"{shard.path}: the log is truncated or damaged at its end (`casadi-ik log finish`"
                " repairs what was torn)"
            )
        _check_alike(shard, opened[0])
    log = Log(opened, left_out)
    numbers = {part.method: part for part in log.solves().parts}
    channels = JointChannels(opened)
    attachments = _joint_attachments(opened)
    record = Metadata(METADATA_NAME, _joint_record(log))
    summary = Summary()
    try:
        with written_whole(path) as part, part.open("xb") as stream:
            _write(stream, log, channels, summary, record, attachments)
            size = stream.tell()
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot write the merged log: {reason}") from error
    solves = {method: len(part) for method, part in numbers.items()}
    return Merged(path, len(opened), solves, sum(summary.counts.values()), size, tuple(left_out))


def _check_alike(shard: Shard, first: Shard) -> None:
    for key in ALIKE:
        found, expected = shard.record.get(key), first.record.get(key)
        if found != expected:
            raise LogError(
                f"{shard.path}: {key}: found {found}, expected {expected} as in {first.path}"
            )


def _joint_record(log: Log) -> dict[str, str]:
    """The metadata: of the first shard, and in what each of them differs from it."""
    base = {key: text for key, text in log.shards[0].record.items() if key != SHARDS}
    parts, origins = log.solves().parts, []
    for i, source in enumerate(log.sources.sources):
        own = {key: _text(value) for key, value in source.metadata.items()}
        differs = {
            key: text
            for key, text in own.items()
            if key not in (CHECKSUM, SHARDS) and text != _text(_value(base.get(key)))
        }
        solves = {
            part.method: ranges_of(part.solve_id[part.shard == i])
            for part in parts
            if part.shard is not None and (part.shard == i).any()
        }
        origins.append(
            {"file": source.name, "first": source.first, "solves": solves, "differs": differs}
        )
    record = {**base, SHARDS: json.dumps(origins)}
    return {**record, CHECKSUM: checksum(record)}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _value(text: str | None) -> Any:
    """Structured values as what they say, so that they compare."""
    with suppress(ValueError):
        found = json.loads(text or "")
        if isinstance(found, dict):
            return found
    return text or ""


def _joint_attachments(shards: Sequence[Shard]) -> list[Attachment]:
    joint: dict[str, Attachment] = {}
    for shard in shards:
        with reading(shard.path) as stream:
            found = [read_attachment(stream, item) for item in shard.contents.attachments]
        for attachment in found:
            known = joint.setdefault(attachment.name, attachment)
            if known.data != attachment.data:
                raise LogError(
                    f"{shard.path}: the attachment {attachment.name!r} is not the same as in"
                    f" {shards[0].path}"
                )
    return list(joint.values())


def _write(
    stream: IO[bytes],
    log: Log,
    channels: JointChannels,
    summary: Summary,
    record: Metadata,
    attachments: Sequence[Attachment],
) -> None:
    library = f"casadi_ik {record.metadata['code_version']}"
    stream.write(summary.beginning("ros2", library, record, attachments))
    for channel in channels.channels:
        summary.channels[channel.id] = channel
    for schema in channels.schemas:
        summary.schemas[schema.id] = schema
    stream.write(definitions(channels.schemas, channels.channels))
    offsets = log.sources.offsets
    pairs = [
        (index.message_start_time + offset * shard.clock.slot, i, index)
        for i, (shard, offset) in enumerate(zip(log.shards, offsets, strict=True))
        for index in shard.contents.chunks
    ]
    counts = [dict[int, int]() for _ in log.shards]
    for _, i, index in sorted(pairs, key=lambda pair: pair[:2]):
        shard = log.shards[i]
        with reading(shard.path) as source:
            ids = None if channels.same(i) else channels.of(i)
            pieces, moved, runs = copied(source, shard, index, ids, offsets[i], stream.tell())
        for piece in pieces:
            stream.write(piece)
        if not runs:
            continue
        summary.chunks.append(moved)
        for run in runs:
            summary.counts[run.channel] = summary.counts.get(run.channel, 0) + len(run.log_time)
            counts[i][run.channel] = counts[i].get(run.channel, 0) + len(run.log_time)
    for shard, found, i in zip(log.shards, counts, range(len(log.shards)), strict=True):
        said = shard.contents.summary.counts
        expected = {channels.of(i).get(channel): count for channel, count in said.items() if count}
        if found != expected:
            raise LogError(f"{shard.path}: the log is damaged: its summary counts other messages")
    stream.write(summary.ending(stream.tell()))
