"""What an MCAP file holds: read from its summary, or record by record if it has none.

Records are read and written by the classes of the `mcap` library; a file that ends as it should is
read by its index. A file without an end (its writer was killed, or is still at it) is read up to
the last complete record, and everything in it is verified.
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
from mcap.opcode import Opcode
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
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC as MAGIC

from casadi_ik.errors import LogError
from casadi_ik.logs.chunks import (
    RECORD,
    Run,
    Unpacked,
    check_size,
    chunk_index,
    message_indexes,
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
        owed: MessageIndex records of the last chunk that are not whole, by channel.
    """

    path: Path
    size: int
    summary: Summary = field(default_factory=Summary)
    records: list[Metadata] = field(default_factory=list)
    complete: bool = True
    end: int = len(MAGIC)
    owed: dict[int, bytes] = field(default_factory=dict)

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Indexes of the chunks."""
        return self.summary.chunk_indexes

    @property
    def attachments(self) -> list[AttachmentIndex]:
        """Indexes of the attachments."""
        return self.summary.attachment_indexes

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
        size, complete = check_magic(stream)
        if not complete:
            return replace(scan(stream, path), complete=False)
        contents = Contents(path, size, read_summary(stream), end=size)
        for index in contents.summary.metadata_indexes:
            found = parsed(Metadata, record_at(stream, index.offset, index.length))
            if found.name != index.name:
                raise LogError(
                    f"the log is damaged: metadata {index.name!r} are not at their place"
                )
            contents.records.append(found)
    return contents


def read_attachment(stream: IO[bytes], index: AttachmentIndex) -> Attachment:
    """An attachment, its checksum verified.

    Raises:
        LogError: It is damaged, or not what its index says.
    """
    found = parsed(Attachment, record_at(stream, index.offset, index.length))
    if (found.name, len(found.data)) != (index.name, index.data_size):
        raise LogError(f"the log is damaged: attachment {index.name!r} is not what its index says")
    return found


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> Unpacked:
    """A chunk by its index, unpacked and verified.

    Raises:
        LogError: It is damaged, too large, or not what its index says.
    """
    found = _whole_chunk(record_at(stream, index.chunk_start_offset, index.chunk_length))
    expected = replace(index, message_index_length=0, message_index_offsets={})
    if chunk_index(found.packed, index.chunk_start_offset) != expected:
        raise LogError(f"the chunk at byte {index.chunk_start_offset} is not what its index says")
    return found


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
    end = stream.seek(0, os.SEEK_END)
    length = RECORD.size + 20
    footer = parsed(Footer, record_at(stream, end - len(MAGIC) - length, length))
    start, summary = footer.summary_start, Summary()
    if not len(MAGIC) < start < end:
        raise LogError("the file has no summary")
    check_size("the summary", end - start)
    stream.seek(start)
    section = stream.read()
    covered = section[: -len(MAGIC) - 4]
    if footer.summary_crc and zlib.crc32(covered) != footer.summary_crc:
        raise LogError("the log is damaged: the summary does not match its checksum")
    reader = StreamReader(io.BytesIO(section), skip_magic=True, emit_chunks=True)
    with _damage("its summary"):
        for record in reader.records:
            if isinstance(record, Statistics):
                summary.statistics = record
            elif isinstance(record, Schema | Channel):
                declare(summary, record)
            elif isinstance(record, ChunkIndex):
                summary.chunk_indexes.append(record)
            elif isinstance(record, AttachmentIndex):
                summary.attachment_indexes.append(record)
            elif isinstance(record, MetadataIndex):
                summary.metadata_indexes.append(record)
    if summary.statistics is None:
        raise LogError("the file has no summary")
    return summary


def declare(summary: Summary, record: Schema | Channel) -> None:
    """Note a schema or channel.

    Raises:
        LogError: Its number already stands for another.
    """
    known: Any = summary.schemas if isinstance(record, Schema) else summary.channels
    if known.setdefault(record.id, record) != record:
        raise LogError(f"the log is damaged: {type(record).__name__} {record.id} is defined twice")


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
    start, offsets = position + builder.count, []
    groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
        (Opcode.SCHEMA, list(summary.schemas.values())),
        (Opcode.CHANNEL, list(summary.channels.values())),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, chunks),
        (Opcode.ATTACHMENT_INDEX, summary.attachment_indexes),
        (Opcode.METADATA_INDEX, summary.metadata_indexes),
    ]
    for opcode, group in groups:
        before = builder.count
        for record in group:
            record.write(builder)
        if group:
            offsets.append(SummaryOffset(opcode, position + before, builder.count - before))
    offset_start = position + builder.count
    for item in offsets:
        item.write(builder)
    Footer(start, offset_start, 0).write(builder)
    data = builder.end()[:-4]
    # The checksum covers the summary and the footer up to itself.
    return data + struct.pack("<I", zlib.crc32(data[start - position :])) + MAGIC


@dataclass(frozen=True, eq=False)
class Record:
    """One record as bytes.

    Attributes:
        opcode: Its kind.
        offset: Where it begins.
        body: Its bytes behind opcode and length.
    """

    opcode: int
    offset: int
    body: bytes

    @property
    def length(self) -> int:
        """Of the whole record."""
        return RECORD.size + len(self.body)


def records(stream: IO[bytes], start: int, end: int) -> Iterator[Record]:
    """The records of a stretch of a file, to its end or to the first that is not whole.

    Args:
        stream: The file.
        start: Where the first begins.
        end: Where the stretch ends.

    Raises:
        LogError: A record is larger than `RECORD_LIMIT`.
    """
    while start + RECORD.size <= end:
        stream.seek(start)
        head = stream.read(RECORD.size)
        opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        if opcode == 0 or start + RECORD.size + length > end:
            return
        check_size(f"the record at byte {start}", length)
        record = Record(opcode, start, stream.read(length))
        if len(record.body) < length:
            return
        yield record
        start += record.length


def record_at(stream: IO[bytes], offset: int, length: int) -> Record:
    """The one record that fills a stretch of a file.

    Raises:
        LogError: Something else stands there.
    """
    record = next(records(stream, offset, offset + length), None)
    if record is None or record.length != length:
        raise LogError(f"the log is damaged: no record of {length} bytes at byte {offset}")
    return record


def parsed(kind: type[Kind], record: Record) -> Kind:
    """A record as the library reads it: written again it is the very same.

    So its lengths and its checksum hold, if it has any.

    Raises:
        LogError: It is of another kind, or contradicts itself.
    """
    with _damage(f"{kind.__name__} at byte {record.offset}"):
        # Every kind that is asked for can be read; their base does not say so.
        found: Kind = cast(Any, kind).read(ReadDataStream(io.BytesIO(record.body)))
        builder = RecordBuilder()
        found.write(builder)
        if builder.end() != RECORD.pack(record.opcode, len(record.body)) + record.body:
            raise ValueError("it contradicts its own kind, length or checksum")
    return found


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
    size, was_closed = check_magic(stream)
    contents, wrong = Contents(path, size, complete=False), "it is cut off"
    for record in records(stream, len(MAGIC), size):
        if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return replace(contents, complete=True)
        try:
            _take(contents, record)
        except LogError as error:
            wrong = str(error)
            break
        contents.end = record.offset + record.length
    if was_closed or _chunk_follows(stream, contents.end, size):
        raise LogError(
            f"the log is damaged in its middle: the record at byte {contents.end} is not as it was"
            f" written: {wrong}"
        )
    if contents.end == len(MAGIC):
        raise NothingWrittenError(
            f"the log is truncated: none of its {size} bytes is a whole record"
        )
    if contents.owed:
        # Its indexes are torn: which channels it holds is to be looked up in it.
        contents.chunks[-1].message_index_offsets = {}
    return contents


def _take(contents: Contents, record: Record) -> None:
    """Account for one record.

    Raises:
        LogError: It is damaged or does not belong there; then nothing has changed.
    """
    summary = contents.summary
    if record.opcode == Opcode.CHUNK:
        chunk = _whole_chunk(record)
        for opcode, body in chunk.definitions:
            declare(summary, _definition(Record(opcode, record.offset, body)))
        contents.owed = message_indexes(chunk.runs)
        add_chunk(summary, chunk_index(chunk.packed, record.offset), chunk.runs)
    elif record.opcode == Opcode.MESSAGE_INDEX:
        channel = int.from_bytes(record.body[:2], "little")
        if contents.owed.get(channel, b"")[RECORD.size :] != record.body:
            raise LogError(f"the message index of channel {channel} is wrong")
        note_index(contents, channel, record.offset)
    elif record.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
        kind = Attachment if record.opcode == Opcode.ATTACHMENT else Metadata
        found = parsed(kind, record)
        _note(summary, found, record.offset, record.length)
        if isinstance(found, Metadata):
            contents.records.append(found)
    elif record.opcode == Opcode.HEADER and record.offset == len(MAGIC):
        parsed(Header, record)
    elif record.opcode == Opcode.MESSAGE:
        raise LogError("the messages are not in chunks, which casadi_ik does not read")
    else:
        declare(summary, _definition(record))


def note_index(contents: Contents, channel: int, offset: int) -> None:
    """Note that a MessageIndex record of the last chunk stands at an offset."""
    chunk = contents.chunks[-1]
    chunk.message_index_offsets[channel] = offset
    chunk.message_index_length += len(contents.owed.pop(channel))


def _note(summary: Summary, item: Attachment | Metadata, offset: int, length: int) -> None:
    """Note an attachment or metadata at an offset."""
    if isinstance(item, Metadata):
        summary.metadata_indexes.append(MetadataIndex(offset, length, item.name))
    else:
        times = item.log_time, item.create_time
        about = len(item.data), item.name, item.media_type
        summary.attachment_indexes.append(AttachmentIndex(offset, length, *times, *about))


def _definition(record: Record) -> Schema | Channel:
    return parsed(Schema if record.opcode == Opcode.SCHEMA else Channel, record)


def _whole_chunk(record: Record) -> Unpacked:
    where = f"the chunk at byte {record.offset}"
    with _damage(where):
        chunk = Chunk.read(ReadDataStream(io.BytesIO(record.body)))
    start, size = len(record.body) - len(chunk.data), len(chunk.data).to_bytes(8, "little")
    whole = chunk_index(chunk, 0).chunk_length == record.length
    if record.opcode != Opcode.CHUNK or not whole or record.body[start - 8 : start] != size:
        raise LogError(f"{where} contradicts its own length")
    return unpack(chunk, where)


def _chunk_follows(stream: IO[bytes], start: int, size: int) -> bool:
    """Whether a whole chunk stands behind the record at `start`."""
    for record in records(stream, start, size):
        if record.opcode == Opcode.CHUNK and record.offset > start:
            with contextlib.suppress(LogError):
                _whole_chunk(record)
                return True
    return False


@contextlib.contextmanager
def _damage(what: str) -> Iterator[None]:
    """Name what the library stumbles over."""
    try:
        yield
    except _DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise LogError(f"the log is damaged: {what}: {reason}") from error
