"""The structure of an MCAP file: its summary, and its records if it has no summary.

The `mcap` library reads and writes records and summaries. A file without an end (its writer was
killed or is still writing) is read up to the last complete record, and every record is verified.
Chunks and their messages: see `casadi_ik.logs.chunks`.
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

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
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

from casadi_ik.errors import LogError, os_errors
from casadi_ik.logs.chunks import (
    RECORD,
    RECORD_LIMIT,
    MessageRun,
    UnpackedChunk,
    check_size,
    chunk_index,
    index_messages,
    is_section,
    parse_records,
    section_index,
    unpack_chunk,
)

RecordType = TypeVar("RecordType", bound=McapRecord)

_LIBRARY_ERRORS = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""Exceptions of the library for damaged bytes."""

SECTION_SIZE = 2**24
"""Maximum size of a section, which is a run of messages outside of chunks [bytes]; a single larger
message is a section of its own. Reading sections thus takes about as much memory as chunks."""


class ForeignLogError(LogError):
    """A file of another program, such as a ROS bag."""


class NothingWrittenError(LogError):
    """A log whose writer ended before its first complete record; no data are lost."""


@dataclass(eq=False)
class Contents:
    """Contents of a file.

    Attributes:
        path: Path of the file.
        size: Its size [bytes].
        summary: Schemas, channels, indexes and counts, in the `Summary` class of the library.
            Its chunk indexes include those of sections (`section_index`).
        records: Metadata records.
        complete: False if the file has no end: its writer was killed, the disk was full, or it is
            still being written. `summary` then covers every complete chunk.
        end: Offset of the end of the last complete record.
        unindexed_runs: Messages of the last chunk if its message indexes are incomplete.
        message_index_offsets: Offsets of the message indexes read so far for these messages, by
            channel id.
    """

    path: Path
    size: int
    summary: Summary = field(default_factory=Summary)
    records: list[Metadata] = field(default_factory=list)
    complete: bool = True
    end: int = len(MAGIC)
    unindexed_runs: Sequence[MessageRun] = ()
    message_index_offsets: dict[int, int] = field(default_factory=dict)

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Indexes of the chunks and sections."""
        return self.summary.chunk_indexes

    @property
    def counts(self) -> Mapping[int, int]:
        """Number of messages by channel id."""
        return message_counts(self.summary)


@contextlib.contextmanager
def open_log_file(path: Path, action: str = "read") -> Iterator[IO[bytes]]:
    """Open a file and convert all its errors to a `LogError` that names it.

    Args:
        path: The file.
        action: Verb for error messages.
    """
    context = f"{path}: cannot {action} the log"
    try:
        with os_errors(context, LogError), path.open("rb") as stream:
            yield stream
    except LogError as error:
        text = str(error)
        raise (error if str(path) in text else type(error)(f"{path}: {text}")) from error
    except MemoryError as error:
        raise LogError(f"{context}: it does not fit into memory") from error


def read_contents(path: Path) -> Contents:
    """Read the summary of a file, or scan the file if it has no complete summary.

    Raises:
        NothingWrittenError: The file ends before its first complete record.
        LogError: The file is missing, not an MCAP file, or damaged.
    """
    with open_log_file(path) as stream:
        size, is_closed = check_magic(stream)
        if not is_closed:
            return replace(scan(stream, path), complete=False)
        summary = read_summary(stream)
        if summary is None or (not summary.chunk_indexes and any(message_counts(summary).values())):
            return scan(stream, path)
        contents = Contents(path, size, summary, end=size)
        for index in contents.summary.metadata_indexes:
            contents.records.append(record_at(Metadata, stream, index.offset, index.length))
    return contents


def record_at(
    record_type: type[RecordType], stream: IO[bytes], offset: int, length: int
) -> RecordType:
    """Read a record and verify that writing it again gives the same bytes.

    The comparison verifies the lengths in the record and its checksum.

    Raises:
        LogError: The bytes are not a record of this type.
    """
    context = f"{record_type.__name__} at byte {offset}"
    check_size(context, length)
    with _library_errors(context):
        stream.seek(offset)
        data = stream.read(length)
        # The base class of records does not declare `read`.
        record: RecordType = cast(Any, record_type).read(
            ReadDataStream(io.BytesIO(data[RECORD.size :]))
        )
        if _record_bytes(record) != data:
            raise ValueError("its type, length or checksum is wrong")
    return record


def _record_bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> UnpackedChunk:
    """Read, unpack and verify a chunk or section.

    Raises:
        LogError: The chunk is damaged, too large, or differs from its index.
    """
    start = index.chunk_start_offset
    context = f"the chunk at byte {start}"
    check_size(context, index.chunk_length)
    if is_section(index):
        stream.seek(start)
        data = stream.read(index.chunk_length)
        times = index.message_start_time, index.message_end_time
        section = Chunk("", data, times[1], times[0], 0, index.chunk_length)
        return unpack_chunk(section, f"the section at byte {start}")
    with _library_errors(context):
        stream.seek(start + RECORD.size)
        data = stream.read(index.chunk_length - RECORD.size)
        chunk = Chunk.read(ReadDataStream(io.BytesIO(data)))
    if chunk_index(chunk, start) != replace(
        index, message_index_length=0, message_index_offsets={}
    ):
        raise LogError(f"{context} differs from its index")
    return unpack_chunk(chunk, context)


def check_magic(stream: IO[bytes]) -> tuple[int, bool]:
    """Check that a file starts with the magic bytes of MCAP.

    Returns:
        The size of the file [bytes], and True if it also ends with the magic bytes.

    Raises:
        NothingWrittenError: The file is empty or ends within the magic bytes.
        ForeignLogError: The file is not an MCAP file.
    """
    stream.seek(0)
    start = stream.read(len(MAGIC))
    if start != MAGIC:
        error_type = NothingWrittenError if MAGIC.startswith(start) else ForeignLogError
        problem = f"it starts with {start!r}" if start else "it is empty"
        raise error_type(f"not an MCAP file: {problem}")
    size = stream.seek(0, os.SEEK_END)
    stream.seek(size - len(MAGIC))
    return size, size > len(MAGIC) and stream.read() == MAGIC


def read_summary(stream: IO[bytes]) -> Summary | None:
    """Read the summary of a file that ends with the magic bytes, and verify its checksum.

    The MCAP format makes the summary and each of its parts optional, and other tools leave parts
    out. If indexes of metadata or attachments are missing, they are rebuilt from the opcode and
    length at the start of every record.

    Returns:
        The summary; None if it is missing, or lacks schemas, channels, chunk indexes or counts, so
        that the data must be read instead.

    Raises:
        LogError: The summary is damaged.
    """
    end = stream.seek(-len(MAGIC), os.SEEK_END)
    with _library_errors("its end"):
        stream.seek(end - 20)
        start, _, checksum = struct.unpack("<QQI", stream.read(20))
    if start == 0:
        return None
    if not len(MAGIC) < start < end:
        raise LogError("the log is damaged: its summary starts outside of the file")
    check_size("the summary", end - start)
    stream.seek(start)
    # The checksum covers the summary and the footer before the checksum.
    if checksum and zlib.crc32(stream.read(end - start - 4)) != checksum:
        raise LogError("the log is damaged: the summary does not match its checksum")
    stream.seek(0)
    with _library_errors("its summary"):
        summary = SeekingReader(stream, record_size_limit=RECORD_LIMIT).get_summary()
    if summary is None or summary.statistics is None:
        return None
    statistics, chunks = summary.statistics, len(summary.chunk_indexes)
    definitions = len(summary.schemas), len(summary.channels)
    if (*definitions, chunks) != (
        *(statistics.schema_count, statistics.channel_count),
        statistics.chunk_count,
    ):
        return None
    indexed = len(summary.metadata_indexes), len(summary.attachment_indexes)
    if not indexed[0] or indexed != (statistics.metadata_count, statistics.attachment_count):
        _index_metadata(stream, summary)
    return summary


def _index_metadata(stream: IO[bytes], summary: Summary) -> None:
    """Index all metadata and attachments of a file by the opcode and length of each record.

    Raises:
        LogError: A record extends beyond the end of the file.
    """
    summary.metadata_indexes, summary.attachment_indexes = [], []
    size, start, opcode = stream.seek(0, os.SEEK_END), len(MAGIC), 0
    while opcode != Opcode.DATA_END:
        stream.seek(start)
        with _library_errors(f"the record at byte {start}"):
            opcode, length = RECORD.unpack(stream.read(RECORD.size))
        length += RECORD.size
        if start + length > size:
            raise LogError(f"the log is damaged: the record at byte {start} is cut off")
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            record_type = Metadata if opcode == Opcode.METADATA else Attachment
            _add_index(summary, record_at(record_type, stream, start, length), start, length)
        start += length


def message_counts(summary: Summary) -> dict[int, int]:
    """Return the number of messages by channel id: the dictionary of the summary, not a copy."""
    if summary.statistics is None:
        summary.statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
    return summary.statistics.channel_message_counts


def add_chunk(summary: Summary, index: ChunkIndex, runs: Sequence[MessageRun]) -> None:
    """Add a chunk to a summary and count its messages."""
    summary.chunk_indexes.append(index)
    counts = message_counts(summary)
    for run in runs:
        counts[run.channel] = counts.get(run.channel, 0) + len(run.log_time)


def file_head(
    summary: Summary, library: str, metadata: Metadata, attachments: Sequence[Attachment]
) -> bytes:
    """Return the bytes of a file before its first chunk, and index its records in the summary.

    Raises:
        LogError: A record is larger than `RECORD_LIMIT`.
    """
    builder = RecordBuilder()
    builder.write(MAGIC)
    Header("ros2", library).write(builder)
    for item in (metadata, *attachments):
        offset = builder.count
        item.write(builder)
        name = f"attachment {item.name!r}" if isinstance(item, Attachment) else "the metadata"
        check_size(name, builder.count - offset)
        _add_index(summary, item, offset, builder.count - offset)
    return builder.end()


def file_tail(summary: Summary, position: int) -> bytes:
    """Return the bytes of a file after its data.

    Args:
        summary: Summary of the file.
        position: Offset of the bytes in the file.
    """
    counts, builder = message_counts(summary), RecordBuilder()
    chunks = [index for index in summary.chunk_indexes if not is_section(index)]
    end_times = [index.message_end_time for index in summary.chunk_indexes]
    start_times = [index.message_start_time for index in summary.chunk_indexes]
    statistics = Statistics(
        attachment_count=len(summary.attachment_indexes),
        channel_count=len(summary.channels),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max(end_times, default=0),
        message_start_time=min(start_times, default=0),
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
    """Read a file from its start to the end of its data, or to where it is truncated.

    Args:
        stream: The file.
        path: Its path.

    Returns:
        The contents; `Contents.complete` is True if the end of the data exists.

    Raises:
        NothingWrittenError: The file ends before its first complete record.
        LogError: The file is not an MCAP file, or is damaged in a way that truncation does not
            explain: the file was closed, or a valid chunk follows the damage.
    """
    size, is_closed = check_magic(stream)
    contents, problem = Contents(path, size, complete=False), "it is cut off"
    stream.seek(len(MAGIC))
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=RECORD_LIMIT)
    start, is_torn, is_damaged = len(MAGIC), False, is_closed
    with contextlib.suppress(*_LIBRARY_ERRORS):
        for record in reader.records:
            length = stream.tell() - start
            try:
                if is_torn:
                    is_damaged |= isinstance(record, Chunk) and bool(
                        unpack_chunk(record, "a chunk")
                    )
                elif isinstance(record, DataEnd | Footer):
                    record_at(type(record), stream, start, length)
                    return replace(contents, complete=True)
                elif isinstance(record, Message):
                    _add_section(contents, start, length, stream)
                else:
                    _add_record(contents, record, start, length, stream)
            except LogError as error:
                if not is_torn:
                    is_torn, problem = True, str(error)
            start = stream.tell()
    if is_damaged:
        raise LogError(
            f"the log is damaged in its middle: the record at byte {contents.end} is invalid:"
            f" {problem}"
        )
    if contents.end == len(MAGIC):
        raise NothingWrittenError(f"the log is truncated: no record in its {size} bytes")
    return contents


def _add_record(
    contents: Contents, record: McapRecord, start: int, length: int, stream: IO[bytes]
) -> None:
    """Add a record to the contents of a file, and move the stream to the next record.

    Raises:
        LogError: The record is damaged or misplaced; `contents.end` is unchanged.
    """
    summary, end = contents.summary, start + length
    record_at(type(record), stream, start, length)
    if isinstance(record, MessageIndex):
        _add_message_index(contents, record, start, end)
        return
    unindexed_runs: Sequence[MessageRun] = ()
    if isinstance(record, Chunk):
        chunk = unpack_chunk(record, f"the chunk at byte {start}")
        for definition in chunk.definitions:
            _add_definition(summary, definition)
        index = chunk_index(record, start)
        expected = index_messages(index, chunk.runs, end)
        if stream.read(len(expected)) == expected:
            end += len(expected)
        else:
            index.message_index_offsets, index.message_index_length = {}, 0
            unindexed_runs = chunk.runs
        add_chunk(summary, index, chunk.runs)
    elif isinstance(record, Attachment | Metadata):
        _add_index(summary, record, start, length)
        if isinstance(record, Metadata):
            contents.records.append(record)
    elif isinstance(record, Schema | Channel):
        _add_definition(summary, record)
    contents.end, contents.unindexed_runs, contents.message_index_offsets = end, unindexed_runs, {}
    stream.seek(end)


def _add_section(contents: Contents, start: int, length: int, stream: IO[bytes]) -> None:
    """Add the messages from an offset on as a section, and move the stream to its end.

    Args:
        contents: Contents of the file.
        start: Offset of the first message.
        length: Length of the first message [bytes].
        stream: The file.

    Raises:
        LogError: The first message is damaged.
    """
    context = f"the section at byte {start}"
    stream.seek(start)
    data = stream.read(max(length, SECTION_SIZE))
    runs, definitions, size = parse_records(data, context, partial=True)
    if not runs:
        raise LogError(f"{context}: its first message is damaged")
    for definition in definitions:
        _add_definition(contents.summary, definition)
    add_chunk(contents.summary, section_index(data[:size], runs, start), runs)
    contents.end, contents.unindexed_runs, contents.message_index_offsets = start + size, (), {}
    stream.seek(contents.end)


def _add_message_index(contents: Contents, record: MessageIndex, start: int, end: int) -> None:
    """Add a message index after the last chunk, as other tools write it for one channel.

    Other tools order channels and entries differently. An index that does not match the messages
    of the chunk is ignored, and `finish_log` replaces it.
    """
    runs = [run for run in contents.unindexed_runs if run.channel == record.channel_id]
    entries = np.frombuffer(b"".join(run.entries for run in runs), "<u8").reshape(-1, 2)
    if not runs or sorted(record.records) != sorted(map(tuple, entries.tolist())):
        return
    offsets = contents.message_index_offsets
    offsets[record.channel_id] = start
    if {run.channel for run in contents.unindexed_runs} <= offsets.keys():
        index = contents.chunks[-1]
        index.message_index_offsets = offsets
        index.message_index_length = end - contents.end
        contents.end, contents.unindexed_runs = end, ()


def _add_definition(summary: Summary, record: Schema | Channel) -> None:
    """Add a schema or channel to a summary.

    Raises:
        LogError: Its id belongs to a different schema or channel.
    """
    records: Any = summary.schemas if isinstance(record, Schema) else summary.channels
    if records.setdefault(record.id, record) != record:
        raise LogError(
            f"the log is damaged: {type(record).__name__} {record.id} has two definitions"
        )


def _add_index(summary: Summary, item: Attachment | Metadata, offset: int, length: int) -> None:
    """Add the index of an attachment or of metadata to a summary."""
    if isinstance(item, Metadata):
        summary.metadata_indexes.append(MetadataIndex(offset, length, item.name))
    else:
        times = item.log_time, item.create_time
        description = len(item.data), item.name, item.media_type
        summary.attachment_indexes.append(AttachmentIndex(offset, length, *times, *description))


@contextlib.contextmanager
def _library_errors(context: str) -> Iterator[None]:
    """Convert errors of the library to a `LogError` that names the damaged record."""
    try:
        yield
    except _LIBRARY_ERRORS as error:
        reason = str(error) or type(error).__name__
        raise LogError(f"the log is damaged: {context}: {reason}") from error
