"""What the data section of an MCAP file really holds, record by record, checksums verified."""

from __future__ import annotations

import io
import os
import struct
from dataclasses import dataclass, field
from typing import IO, TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray
from zstandard import ZstdError

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.file import Summary

HEAD = struct.Struct("<BQ")
"""Opcode and length in front of every record."""

_SAME = HEAD.size + 2
"""Bytes at the beginning of a message that are the same in those of its channel and size."""

_LOG_TIME = slice(HEAD.size + 6, HEAD.size + 14)
"""Where in a message its log time is, behind channel and sequence."""

_INDEX_HEAD = struct.Struct("<HI")
"""Channel and size of the entries: how the content of a MessageIndex begins."""

_DAMAGED = (McapError, struct.error, ValueError, RuntimeError, MemoryError, ZstdError)
"""What a record with wrong bytes was seen to raise (RuntimeError is lz4's)."""

Kind = TypeVar("Kind", Attachment, Channel, Chunk, Metadata, Schema)

Entries = dict[int, NDArray[np.uint64]]
"""Log time and offset of every message in a chunk, (k, 2), by channel."""


@dataclass
class DataSection:
    """The data section as far as it is whole.

    Attributes:
        summary: What is in it.
        end: Where it ends: behind the last whole record [bytes].
        closed: Whether a DataEnd record stands there.
        owed: Entries of the last chunk whose MessageIndex records are not all there.
        size: Size of the file when it was read [bytes].
    """

    summary: Summary
    end: int = len(MCAP0_MAGIC)
    closed: bool = False
    owed: Entries = field(default_factory=dict)
    size: int = 0

    def owed_indexes(self) -> bytes:
        """The missing MessageIndex records, to be written at `end`; now they count as there."""
        builder = RecordBuilder()
        for channel, entries in self.owed.items():
            index = self.summary.chunks[-1]
            index.message_index_offsets[channel] = self.end + builder.count
            before = builder.count
            MessageIndex(channel, [(int(t), int(o)) for t, o in entries]).write(builder)
            index.message_index_length += builder.count - before
        self.owed = {}
        return builder.end()


def scan(stream: IO[bytes]) -> DataSection:
    """Read the data section from its beginning to its end or to where it is torn.

    Args:
        stream: An MCAP file.

    Raises:
        LogError: Not an MCAP file, torn before its first record was whole, or damaged where it
            cannot be torn: in a file that was closed, or in front of a chunk that is whole.
    """
    magic = stream.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC:
        found = f"it begins with {magic!r}" if magic else "it is empty"
        raise LogError(f"not an MCAP file: {found}")
    size = stream.seek(-len(MCAP0_MAGIC), os.SEEK_END) + len(MCAP0_MAGIC)
    was_closed = size > len(MCAP0_MAGIC) and stream.read() == MCAP0_MAGIC
    stream.seek(len(MCAP0_MAGIC))
    found, wrong = _Scan(), "it is cut off"
    found.section.size = size
    while (record := _record(stream, size)) is not None:
        opcode, body = record
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            found.section.closed = True
            return found.section
        try:
            found.take(opcode, body)
        except _DAMAGED as error:
            wrong = str(error) or type(error).__name__
            break
    place = found.section.end
    if was_closed or _chunk_follows(stream, size):
        raise LogError(
            f"the log is damaged in its middle: the record at byte {place} is not as it was"
            f" written: {wrong}"
        )
    if place == len(MCAP0_MAGIC):
        raise LogError(f"the log is truncated: none of its {size} bytes is a whole record")
    return found.section


def _record(stream: IO[bytes], size: int) -> tuple[int, bytes] | None:
    """Opcode and content of the next record; None if it is not all there."""
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode == 0 or stream.tell() + length > size:
        return None
    return opcode, stream.read(length)


def _chunk_follows(stream: IO[bytes], size: int) -> bool:
    while (record := _record(stream, size)) is not None:
        opcode, body = record
        if opcode == Opcode.CHUNK:
            try:
                _Scan().chunk(body)
            except _DAMAGED:
                continue
            return True
    return False


class _Scan:
    """Takes one record after the other."""

    def __init__(self) -> None:
        self.section = DataSection(Summary())

    def take(self, opcode: int, body: bytes) -> None:
        """Account for one record; if it raises, nothing has changed."""
        if opcode == Opcode.CHUNK:
            self.chunk(body)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._message_index(body)
        elif opcode == Opcode.MESSAGE:
            raise ValueError("a message outside of the chunks, which casadi_ik does not write")
        elif opcode == Opcode.ATTACHMENT:
            self._attachment(body)
        elif opcode == Opcode.METADATA:
            name = _read(Metadata, body).name
            index = MetadataIndex(self.section.end, HEAD.size + len(body), name)
            self.section.summary.metadata.append(index)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._declare(opcode, body)
        self.section.end += HEAD.size + len(body)

    def chunk(self, body: bytes) -> None:
        """A chunk, unpacked and its checksum verified."""
        chunk = _read(Chunk, body)
        unpacked, length = get_chunk_data_stream(chunk, validate_crc=True)
        data = unpacked.read(length)
        if len(data) != chunk.uncompressed_size:
            raise ValueError(f"{len(data)} bytes for {chunk.uncompressed_size}")
        entries, declared = _walked(data)
        for opcode, content in declared:
            self._declare(opcode, content)
        counts = self.section.summary.counts
        for channel, found in entries.items():
            counts[channel] = counts.get(channel, 0) + len(found)
        self.section.owed = entries
        self.section.summary.chunks.append(
            ChunkIndex(
                chunk_length=HEAD.size + len(body),
                chunk_start_offset=self.section.end,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def _message_index(self, body: bytes) -> None:
        """An index must say what the chunk before it holds."""
        channel, size = _INDEX_HEAD.unpack_from(body)
        found = np.frombuffer(body, "<u8", offset=_INDEX_HEAD.size).reshape(-1, 2)
        expected = self.section.owed.get(channel)
        in_order = found[np.argsort(found[:, 1], kind="stable")]
        if expected is None or size != found.nbytes or not np.array_equal(in_order, expected):
            raise ValueError(f"the message index of channel {channel} is wrong")
        del self.section.owed[channel]
        chunk = self.section.summary.chunks[-1]
        chunk.message_index_offsets[channel] = self.section.end
        chunk.message_index_length += HEAD.size + len(body)

    def _attachment(self, body: bytes) -> None:
        attachment = _read(Attachment, body)
        self.section.summary.attachments.append(
            AttachmentIndex(
                offset=self.section.end,
                length=HEAD.size + len(body),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def _declare(self, opcode: int, body: bytes) -> None:
        summary = self.section.summary
        if opcode == Opcode.SCHEMA:
            schema = _read(Schema, body)
            summary.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = _read(Channel, body)
            summary.channels[channel.id] = channel


def _walked(data: bytes) -> tuple[Entries, list[tuple[int, bytes]]]:
    """Where the messages of a chunk are, and its other records."""
    octets = np.frombuffer(data, np.uint8)
    parts: dict[int, list[NDArray[np.uint64]]] = {}
    declared: list[tuple[int, bytes]] = []
    offset, most = 0, 1
    while offset < len(data):
        opcode, length = HEAD.unpack_from(data, offset)
        size = HEAD.size + length
        if offset + size > len(data):
            raise ValueError("a record reaches beyond its chunk")
        if opcode != Opcode.MESSAGE:
            declared.append((opcode, data[offset + HEAD.size : offset + size]))
            offset += size
            continue
        # Messages of one channel and size that follow each other are taken at once.
        most = min(2 * most, (len(data) - offset) // size)
        block = octets[offset : offset + most * size].reshape(most, size)
        other = np.flatnonzero((block[:, :_SAME] != block[0, :_SAME]).any(axis=1))
        count = int(other[0]) if len(other) else most
        entries = np.empty((count, 2), np.uint64)
        entries[:, 0] = np.ascontiguousarray(block[:count, _LOG_TIME]).view("<u8")[:, 0]
        entries[:, 1] = offset + size * np.arange(count)
        channel = int.from_bytes(data[offset + HEAD.size : offset + _SAME], "little")
        parts.setdefault(channel, []).append(entries)
        offset += count * size
        most = max(count, 1)
    return {channel: np.concatenate(found) for channel, found in parts.items()}, declared


def _read(kind: type[Kind], body: bytes) -> Kind:
    """A record that, written again, is the very same: lengths and checksums in it are right."""
    record = kind.read(ReadDataStream(io.BytesIO(body)))
    builder = RecordBuilder()
    record.write(builder)
    if builder.end()[HEAD.size :] != body:
        raise ValueError(f"{kind.__name__} contradicts its own length or checksum")
    return record
