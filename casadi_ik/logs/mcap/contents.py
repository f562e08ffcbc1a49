"""Where in one MCAP file what is: from its summary, or by going through it if it has none."""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from casadi_ik.errors import LogError

_FOOTER = struct.Struct("<QQI")
"""Summary start, summary offset start, checksum: the contents of the Footer record."""

_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""

_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time, uncompressed size, checksum, length of the compression's name."""

_UNREADABLE = (
    McapError,
    struct.error,
    ValueError,
    EOFError,
    RuntimeError,
    MemoryError,
    OverflowError,
    LookupError,
    ZstdError,
)
"""What reading a damaged file was seen to raise (RuntimeError is lz4's)."""


@dataclass(eq=False)
class Contents:
    """What one file holds.

    Attributes:
        path: The file.
        size: Its size [bytes].
        schemas: By id.
        channels: By id.
        counts: Messages by channel id.
        chunks: Where the chunks are.
        attachments: Where the attachments are.
        metadata: Metadata records by name.
        complete: False if the file has no footer: its writer was killed or the disk was full, or
            it is still being written. Then every complete chunk is here.
        readable: Bytes up to the end of the last complete record.
    """

    path: Path
    size: int
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: dict[str, Mapping[str, str]] = field(default_factory=dict)
    complete: bool = True
    readable: int = 0


@contextlib.contextmanager
def reading(path: Path) -> Iterator[IO[bytes]]:
    """The open file; whatever is wrong with it becomes one `LogError` that names it."""
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot read the log: {reason}") from error
    except LogError as error:
        text = str(error)
        raise LogError(text if str(path) in text else f"{path}: {text}") from error
    except _UNREADABLE as error:
        raise LogError(f"{path}: the log is damaged: {error or type(error).__name__}") from error


def read_contents(path: Path) -> Contents:
    """Find out what a file holds.

    Raises:
        LogError: It is missing, is no MCAP file or is damaged.
    """
    with reading(path) as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if head != MCAP0_MAGIC:
            found = f"it begins with {head!r}" if head else "it is empty"
            raise LogError(f"not an MCAP file: {found}")
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - len(MCAP0_MAGIC), len(MCAP0_MAGIC)))
        if stream.read() == MCAP0_MAGIC:
            return _from_summary(stream, Contents(path, size, readable=size))
        return _gone_through(stream, Contents(path, size, complete=False))


def read_attachment(stream: IO[bytes], index: AttachmentIndex) -> bytes:
    """An attachment, its checksum verified (the mcap library skips it).

    Raises:
        LogError: It is damaged.
    """
    stream.seek(index.offset)
    record = stream.read(index.length)
    end = len(record) - 4
    if len(record) != index.length or zlib.crc32(record[9:end]) != int.from_bytes(
        record[end:], "little"
    ):
        raise LogError(f"the log is damaged: attachment {index.name!r} fails its checksum")
    return record[end - index.data_size : end]


def _from_summary(stream: IO[bytes], contents: Contents) -> Contents:
    magic = len(MCAP0_MAGIC)
    stream.seek(contents.size - magic - _FOOTER.size)
    start, _, checksum = _FOOTER.unpack(stream.read(_FOOTER.size))
    if start and checksum:
        stream.seek(start)
        if zlib.crc32(stream.read(contents.size - magic - 4 - start)) != checksum:
            raise LogError("the log is damaged: the summary does not match its checksum")
    stream.seek(0)
    reader = SeekingReader(stream, validate_crcs=True)
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        raise LogError("the file has no summary")
    contents.schemas, contents.channels = summary.schemas, summary.channels
    contents.counts = summary.statistics.channel_message_counts
    contents.chunks, contents.attachments = summary.chunk_indexes, summary.attachment_indexes
    for record in reader.iter_metadata():
        contents.metadata[record.name] = record.metadata
    return contents


def _gone_through(stream: IO[bytes], contents: Contents) -> Contents:
    """Record by record, to the first that is not whole; what is in the chunks is skipped."""
    position = len(MCAP0_MAGIC)
    with contextlib.suppress(*_UNREADABLE):
        while True:
            stream.seek(position)
            opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
            end = position + _RECORD_HEAD.size + length
            if opcode == 0 or end > contents.size or opcode == Opcode.DATA_END:
                break
            _take(stream, contents, opcode, position, end)
            position = end
    contents.readable = position
    if contents.chunks:
        # Its indexes may be torn.
        last = contents.chunks[-1]
        for channel in last.message_index_offsets:
            contents.counts[channel] -= _indexed(stream, last.message_index_offsets[channel])
        last.message_index_offsets = {}
    for chunk in contents.chunks:
        unknown = set(chunk.message_index_offsets) - set(contents.channels)
        if not chunk.message_index_offsets or unknown:
            _define(stream, contents, chunk)
    return contents


def _take(stream: IO[bytes], contents: Contents, opcode: int, start: int, end: int) -> None:
    """Note one record that stands from `start` to `end`; the stream is behind its head."""
    if opcode == Opcode.CHUNK:
        first, last, size, _, name = _CHUNK_HEAD.unpack(stream.read(_CHUNK_HEAD.size))
        compression = stream.read(name).decode()
        contents.chunks.append(
            ChunkIndex(
                chunk_length=end - start,
                chunk_start_offset=start,
                compression=compression,
                compressed_size=int.from_bytes(stream.read(8), "little"),
                message_end_time=last,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=first,
                uncompressed_size=size,
            )
        )
    elif opcode == Opcode.MESSAGE_INDEX and contents.chunks:
        channel = int.from_bytes(stream.read(2), "little")
        chunk = contents.chunks[-1]
        chunk.message_index_offsets[channel] = start
        chunk.message_index_length += end - start
        contents.counts[channel] = contents.counts.get(channel, 0) + _indexed(stream, start)
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
        body = ReadDataStream(stream)
        if opcode == Opcode.SCHEMA:
            _define_one(contents, Schema.read(body))
        elif opcode == Opcode.CHANNEL:
            _define_one(contents, Channel.read(body))
        elif opcode == Opcode.METADATA:
            record = Metadata.read(body)
            contents.metadata[record.name] = record.metadata
        else:
            found = Attachment.read(body)
            contents.attachments.append(
                AttachmentIndex(
                    offset=start,
                    length=end - start,
                    log_time=found.log_time,
                    create_time=found.create_time,
                    data_size=len(found.data),
                    name=found.name,
                    media_type=found.media_type,
                )
            )


def _indexed(stream: IO[bytes], position: int) -> int:
    """How many messages a MessageIndex record names."""
    stream.seek(position + _RECORD_HEAD.size + 2)
    return int.from_bytes(stream.read(4), "little") // 16


def _define(stream: IO[bytes], contents: Contents, chunk: ChunkIndex) -> None:
    """Note the schemas and channels in a chunk; count its messages if it has no index."""
    stream.seek(chunk.chunk_start_offset + _RECORD_HEAD.size)
    for record in breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True):
        if isinstance(record, Message) and not chunk.message_index_offsets:
            counts = contents.counts
            counts[record.channel_id] = counts.get(record.channel_id, 0) + 1
        elif isinstance(record, Schema | Channel):
            _define_one(contents, record)


def _define_one(contents: Contents, record: Schema | Channel) -> None:
    """Note a schema or channel.

    Raises:
        LogError: Its id already has another.
    """
    known: dict[int, Any] = contents.schemas if isinstance(record, Schema) else contents.channels
    if known.setdefault(record.id, record) != record:
        raise LogError(f"the log is damaged: {type(record).__name__} {record.id} is defined twice")
