"""The channels that several logs have in common, and chunks that are carried over to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import IO

import numpy as np
from mcap.records import Channel, ChunkIndex, Schema

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.chunk import COMPRESSORS, Run, chunk_bytes
from casadi_ik.logs.mcap.message_bytes import HEAD, PREFIX
from casadi_ik.logs.mcap.schema import KINDS
from casadi_ik.logs.mcap.unpacking import Unpacked, read_chunk
from casadi_ik.logs.read.shard import Shard

_COMPRESSIONS = {name: key for key, (name, _) in COMPRESSORS.items()}


class JointChannels:
    """Channels of several logs by their topics; the first log that has one numbers it.

    Attributes:
        schemas: Of the joint log.
        channels: Of the joint log.
    """

    def __init__(self, shards: Sequence[Shard]) -> None:
        """Put channels together.

        Raises:
            LogError: A topic is not of one kind in all of them, or there are too many.
        """
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self._holders: dict[str, Shard] = {}
        self._same: list[bool] = []
        self._maps = [self._taken(shard) for shard in shards]

    def same(self, shard: int) -> bool:
        """Whether a shard's channels and schemas have the ids that they have in the joint log."""
        return self._same[shard]

    def of(self, shard: int) -> Mapping[int, int]:
        """Ids of the joint log by those of a shard."""
        return self._maps[shard]

    def _taken(self, shard: Shard) -> dict[int, int]:
        summary = shard.contents.summary
        ids, same = dict[int, int](), True
        known = {channel.topic: channel for channel in self.channels}
        for method in shard.methods:
            for kind in KINDS:
                own = summary.channels[shard.topic(method, kind).channel]
                schema, joint = summary.schemas[own.schema_id], known.get(own.topic)
                if joint is None:
                    joint = self._added(own, schema)
                    self._holders[own.topic] = shard
                theirs = next(each for each in self.schemas if each.id == joint.schema_id)
                alike = replace(own, id=joint.id, schema_id=joint.schema_id) == joint
                if not alike or replace(schema, id=theirs.id) != theirs:
                    raise LogError(
                        f"{shard.path}: method {method!r} has other fields or names than in"
                        f" {self._holders[own.topic].path} ({own.topic})"
                    )
                ids[own.id] = joint.id
                same &= (own.id, own.schema_id) == (joint.id, joint.schema_id)
        self._same.append(same)
        return ids

    def _added(self, channel: Channel, schema: Schema) -> Channel:
        """A channel under its own id and that of its schema, if they are still free."""
        used = {each.id for each in self.channels}, {each.id for each in self.schemas}
        number = channel.id if channel.id not in used[0] else max(used[0]) + 1
        schema_id = schema.id if schema.id not in used[1] else max(used[1]) + 1
        if max(number, schema_id) >= 2**16:
            raise LogError("more topics than a log has numbers for")
        self.schemas.append(replace(schema, id=schema_id))
        self.channels.append(replace(channel, id=number, schema_id=schema_id))
        return self.channels[-1]


def copied(
    source: IO[bytes],
    shard: Shard,
    index: ChunkIndex,
    ids: Mapping[int, int] | None,
    offset: int,
    position: int,
) -> tuple[list[bytes | memoryview], ChunkIndex, Sequence[Run]]:
    """A chunk of a shard as the joint log has it.

    Args:
        source: The shard's file.
        shard: The shard.
        index: Which chunk of it.
        ids: Channel ids of the joint log by the shard's; None: they are the same.
        offset: What the numbers of its solves are raised by.
        position: Where the chunk will stand.

    Returns:
        Its bytes and message indexes, its place, and where in it which messages are.

    Raises:
        LogError: It is damaged, or holds what is no part of a log of casadi_ik.
    """
    chunk = read_chunk(source, index)
    compression = _COMPRESSIONS[index.compression]
    own = {shard.topic(method, kind).channel for method in shard.methods for kind in KINDS}
    for run in chunk.runs:
        if run.channel not in own:
            raise LogError(f"a message of channel {run.channel}, which is no topic of casadi_ik")
    if not chunk.runs:
        return [], index, ()
    if offset == 0 and ids is None:
        source.seek(index.chunk_start_offset)
        pieces, moved = chunk_bytes(
            memoryview(chunk.data),
            chunk.runs,
            compression,
            position,
            packed=source.read(index.chunk_length)[-index.compressed_size :],
        )
        return pieces, moved, chunk.runs
    data, runs = _changed(chunk, shard, ids or {number: number for number in own}, offset)
    pieces, moved = chunk_bytes(data.data, runs, compression, position)
    return pieces, moved, runs


def _changed(
    chunk: Unpacked, shard: Shard, ids: Mapping[int, int], offset: int
) -> tuple[np.ndarray, list[Run]]:
    """The messages of a chunk with other channel ids and numbers of solves."""
    kinds = {
        shard.topic(method, kind).channel: (shard.topic(method, kind).layout, kind)
        for method in shard.methods
        for kind in KINDS
    }
    data = np.empty(sum(run.stop - run.start for run in chunk.runs), np.uint8)
    runs, start, later = [], 0, np.uint64(offset * shard.clock.slot)
    for run in chunk.runs:
        layout, kind = kinds[run.channel]
        if run.size != HEAD.itemsize + layout.dtype.itemsize:
            raise LogError(f"a message of channel {run.channel} is not what its schema says")
        last = int(shard.clock.locate(run.log_time)[0].max()) + offset
        shard.clock.check(last, np.zeros(1, np.int64))
        block = data[start : start + run.stop - run.start].reshape(-1, run.size)
        block[:] = np.frombuffer(chunk.data, np.uint8, block.size, run.start).reshape(block.shape)
        prefix = block[:, : PREFIX.itemsize].view(PREFIX)[:, 0]
        prefix["channel"] = ids[run.channel]
        prefix["log_time"] += later
        if kind == "solve":
            prefix["sequence"] += np.uint32(offset)
        if "solve_id" in layout.names:
            rows = block[:, HEAD.itemsize :].view(layout.dtype)[:, 0]
            rows["solve_id"] += np.uint32(offset)
        runs.append(Run(ids[run.channel], start, run.size, run.log_time + later))
        start += block.size
    return data, runs
