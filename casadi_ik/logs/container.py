"""What an MCAP file holds: read from its summary, or record by record if it has none.

Records and summaries are read and written by the `mcap` library. A file without an end (its writer
was killed, or is still at it) is read up to the last complete record, and everything in it is
verified.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TypeVar, cast

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC

from casadi_ik.errors import LogError
from casadi_ik.logs.chunks import (
    RECORD,
    RECORD_LIMIT,
    Run,
    Unpacked,
    check_size,
    chunk_index,
    index_messages,
    unpack,
)

Kind = TypeVar("Kind", bound=McapRecord)

_DAMAGE = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""Exceptions of the library over bytes that are not as they were written."""


class NothingWrittenError(LogError):
    """A log whose writer ended before anything was whole: nothing can be lost with it."""


@dataclass(eq=False)
class Contents:
    """What one file holds.

    Attributes:
        path: The file.
        size: Its size [bytes].
        summary: Schemas, channels, indexes and counts, as the library has them.
        records: Its metadata records.
        complete: False if the file has no end: its writer was killed or the disk was full, or it
            is still being written. Then every complete chunk is here, each verified.
        end: Offset behind its last complete record.
        owed: Messages of the last chunk if their indexes are not whole.
    """

    path: Path
    size: int
    summary: Summary = field(default_factory=Summary)
    records: list[Metadata] = field(default_factory=list)
    complete: bool = True
    end: int = len(MAGIC)
    owed: Sequence[Run] = ()

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Indexes of the chunks."""
        return self.summary.chunk_indexes

    @property
    def counts(self) -> Mapping[int, int]:
        """Messages by channel id."""
        return counts_of(self.summary)


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
        raise (error if str(path) in text else type(error)(f"{path}: {text}")) from error
    except MemoryError as error:
        raise LogError(f"{path}: cannot read the log: it does not fit into memory") from error


def read_contents(path: Path) -> Contents:
    """Find out what a file holds.

    Raises:
        NothingWrittenError: It is empty or torn before its first record was whole.
        LogError: It is missing, is no MCAP file or is damaged.
    """
    with reading(path) as stream:
        size, closed = check_magic(stream)
        if not closed:
            return replace(scan(stream, path), complete=False)
        contents = Contents(path, size, read_summary(stream), end=size)
        for index in contents.summary.metadata_indexes:
            contents.records.append(record_at(Metadata, stream, index.offset, index.length))
    return contents


def record_at(kind: type[Kind], stream: IO[bytes], offset: int, length: int) -> Kind:
    """A record as the library reads it: written again it is the very same.

    So its lengths and its checksum hold, if it has any.

    Raises:
        LogError: Something else stands there.
    """
    where = f"{kind.__name__} at byte {offset}"
    check_size(where, length)
    with _damage(where):
        stream.seek(offset)
        data = stream.read(length)
        # Every kind that is asked for can be read; their base does not say so.
        found: Kind = cast(Any, kind).read(ReadDataStream(io.BytesIO(data[RECORD.size :])))
        if _written(found) != data:
            raise ValueError("it contradicts its own kind, length or checksum")
    return found


def _written(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> Unpacked:
    """A chunk by its index, unpacked and verified.

    Raises:
        LogError: It is damaged, too large, or not what its index says.
    """
    start = index.chunk_start_offset
    where = f"the chunk at byte {start}"
    check_size(where, index.chunk_length)
    with _damage(where):
        stream.seek(start + RECORD.size)
        data = stream.read(index.chunk_length - RECORD.size)
        chunk = Chunk.read(ReadDataStream(io.BytesIO(data)))
    if chunk_index(chunk, start) != replace(
        index, message_index_length=0, message_index_offsets={}
    ):
        raise LogError(f"{where} is not what its index says")
    return unpack(chunk, where)


def check_magic(stream: IO[bytes]) -> tuple[int, bool]:
    """Check that a file begins as MCAP files do.

    Returns:
        Its size [bytes], and whether it ends as a complete one does.

    Raises:
        NothingWrittenError: It is empty, or less than those bytes.
        LogError: It is no MCAP file.
    """
    stream.seek(0)
    found = stream.read(len(MAGIC))
    if found != MAGIC:
        kind = NothingWrittenError if MAGIC.startswith(found) else LogError
        raise kind(f"not an MCAP file: {f'it begins with {found!r}' if found else 'it is empty'}")
    size = stream.seek(0, os.SEEK_END)
    stream.seek(size - len(MAGIC))
    return size, size > len(MAGIC) and stream.read() == MAGIC


def read_summary(stream: IO[bytes]) -> Summary:
    """The summary of a file that ends with its magic bytes, its checksum verified.

    Raises:
        LogError: It is damaged, or there is none.
    """
    end = stream.seek(-len(MAGIC), os.SEEK_END)
    with _damage("its end"):
        stream.seek(end - 20)
        start, _, checksum = struct.unpack("<QQI", stream.read(20))
    if not len(MAGIC) < start < end:
        raise LogError("the file has no summary")
    check_size("the summary", end - start)
    stream.seek(start)
    # The checksum covers the summary and the footer up to itself.
    if checksum and zlib.crc32(stream.read(end - start - 4)) != checksum:
        raise LogError("the log is damaged: the summary does not match its checksum")
    stream.seek(0)
    with _damage("its summary"):
        summary = SeekingReader(stream, record_size_limit=RECORD_LIMIT).get_summary()
    if summary is None or summary.statistics is None:
        raise LogError("the file has no summary")
    return summary


def counts_of(summary: Summary) -> dict[int, int]:
    """Messages by channel id, counted on in place while a file grows."""
    if summary.statistics is None:
        summary.statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
    return summary.statistics.channel_message_counts


def add_chunk(summary: Summary, index: ChunkIndex, runs: Sequence[Run]) -> None:
    """Note a chunk and count its messages."""
    summary.chunk_indexes.append(index)
    counts = counts_of(summary)
    for run in runs:
        counts[run.channel] = counts.get(run.channel, 0) + len(run.log_time)


def beginning(
    summary: Summary, library: str, metadata: Metadata, attachments: Sequence[Attachment]
) -> bytes:
    """The first bytes of a file, up to the first chunk; their indexes go into the summary.

    Raises:
        LogError: A record is larger than what is read.
    """
    builder = RecordBuilder()
    builder.write(MAGIC)
    Header("ros2", library).write(builder)
    for item in (metadata, *attachments):
        offset = builder.count
        item.write(builder)
        what = f"attachment {item.name!r}" if isinstance(item, Attachment) else "the metadata"
        check_size(what, builder.count - offset)
        _note(summary, item, offset, builder.count - offset)
    return builder.end()


def ending(summary: Summary, position: int) -> bytes:
    """The last bytes of a file, from the end of its data on.

    Args:
        summary: Of the file.
        position: Offset at which they will stand.
    """
    chunks, counts, builder = summary.chunk_indexes, counts_of(summary), RecordBuilder()
    statistics = Statistics(
        attachment_count=len(summary.attachment_indexes),
        channel_count=len(summary.channels),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        metadata_count=len(summary.metadata_indexes),
        schema_count=len(summary.schemas),
    )
    DataEnd(0).write(builder)
    start = builder.count
    records: list[McapRecord] = [
        *(*summary.schemas.values(), *summary.channels.values(), statistics, *chunks),
        *(*summary.attachment_indexes, *summary.metadata_indexes),
        Footer(position + start, 0, 0),
    ]
    for record in records:
        record.write(builder)
    data = builder.end()[:-4]
    return data + struct.pack("<I", zlib.crc32(data[start:])) + MAGIC


def scan(stream: IO[bytes], path: Path) -> Contents:
    """Read a file from its beginning to the end of its data, or to where it is torn.

    Args:
        stream: An MCAP file.
        path: Its path.

    Returns:
        What it holds; `Contents.complete`: whether the end of its data is there.

    Raises:
        NothingWrittenError: Torn before its first record was whole.
        LogError: Not an MCAP file, or damaged where it cannot be torn: in a file that was closed,
            or in front of a chunk that is whole.
    """
    size, closed = check_magic(stream)
    contents, wrong, damaged = Contents(path, size, complete=False), "it is cut off", closed
    stream.seek(len(MAGIC))
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=RECORD_LIMIT)
    start, torn = len(MAGIC), False
    with contextlib.suppress(*_DAMAGE):
        for record in reader.records:
            length = stream.tell() - start
            try:
                if torn:
                    damaged |= isinstance(record, Chunk) and bool(unpack(record, "a chunk"))
                elif isinstance(record, DataEnd | Footer):
                    record_at(type(record), stream, start, length)
                    return replace(contents, complete=True)
                else:
                    _take(contents, record, start, length, stream)
            except LogError as error:
                if not torn:
                    torn, wrong = True, str(error)
            start = stream.tell()
    if damaged:
        raise LogError(
            f"the log is damaged in its middle: the record at byte {contents.end} is not as it was"
            f" written: {wrong}"
        )
    if contents.end == len(MAGIC):
        raise NothingWrittenError(
            f"the log is truncated: none of its {size} bytes is a whole record"
        )
    return contents


def _take(
    contents: Contents, record: McapRecord, start: int, length: int, stream: IO[bytes]
) -> None:
    """Account for a record of a file without a summary; the stream stands behind it.

    Raises:
        LogError: It is damaged or does not belong there; then nothing has changed.
    """
    summary, end = contents.summary, start + length
    record_at(type(record), stream, start, length)
    if isinstance(record, MessageIndex):
        return  # not the one that its chunk would have here
    owed: Sequence[Run] = ()
    if isinstance(record, Chunk):
        chunk = unpack(record, f"the chunk at byte {start}")
        for definition in chunk.definitions:
            _declare(summary, definition)
        index = chunk_index(record, start)
        expected = index_messages(index, chunk.runs, end)
        if stream.read(len(expected)) == expected:
            end += len(expected)
        else:
            index.message_index_offsets, index.message_index_length = {}, 0
            owed = chunk.runs
        add_chunk(summary, index, chunk.runs)
    elif isinstance(record, Attachment | Metadata):
        _note(summary, record, start, length)
        if isinstance(record, Metadata):
            contents.records.append(record)
    elif isinstance(record, Message):
        raise LogError("the messages are not in chunks, which casadi_ik does not read")
    elif isinstance(record, Schema | Channel):
        _declare(summary, record)
    contents.end, contents.owed = end, owed
    stream.seek(end)


def _declare(summary: Summary, record: Schema | Channel) -> None:
    """Note a schema or channel.

    Raises:
        LogError: Its number already stands for another.
    """
    known: Any = summary.schemas if isinstance(record, Schema) else summary.channels
    if known.setdefault(record.id, record) != record:
        raise LogError(f"the log is damaged: {type(record).__name__} {record.id} is defined twice")


def _note(summary: Summary, item: Attachment | Metadata, offset: int, length: int) -> None:
    """Note an attachment or metadata at an offset."""
    if isinstance(item, Metadata):
        summary.metadata_indexes.append(MetadataIndex(offset, length, item.name))
    else:
        times = item.log_time, item.create_time
        about = len(item.data), item.name, item.media_type
        summary.attachment_indexes.append(AttachmentIndex(offset, length, *times, *about))


@contextlib.contextmanager
def _damage(what: str) -> Iterator[None]:
    """Name what the library stumbles over."""
    try:
        yield
    except _DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise LogError(f"the log is damaged: {what}: {reason}") from error
