"""What an MCAP file holds: read from its summary, or record by record if it has none.

Records and summaries are read and written by the `mcap` library. A file without an end (its writer
was killed, or is still at it) is read up to the last complete record, and everything in it is
verified.

Messages are not left to the library, which handles them one by one: it would read a log of a
million iterations 15 to 60 times slower. A log has a message of fixed size per iteration, so all
messages of a channel in a chunk are one numpy array, packed and unpacked at once. Nothing in a
chunk is trusted: size and checksum are verified, and opcode, length and time of every record in
it. No chunk is unpacked that is larger than `RECORD_LIMIT`.
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import lz4.frame
import numpy as np
import zstandard
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
from numpy.typing import NDArray

from casadi_ik.compile.layout import opaque
from casadi_ik.errors import LogError, os_errors

Kind = TypeVar("Kind", bound=McapRecord)

_DAMAGE = (McapError, struct.error, ValueError, MemoryError, OverflowError)
"""Exceptions of the library over bytes that are not as they were written."""


NOT_IN_CHUNKS = (
    "the messages are not in chunks; expected chunks, which tools for MCAP files write unless"
    " chunking is off (as in rosbag2's preset fastwrite)"
)


class ForeignLogError(LogError):
    """An MCAP file that this package did not write, such as a ROS bag."""


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
        index_offsets: Offsets of the indexes that are there for these messages, by channel.
    """

    path: Path
    size: int
    summary: Summary = field(default_factory=Summary)
    records: list[Metadata] = field(default_factory=list)
    complete: bool = True
    end: int = len(MAGIC)
    owed: Sequence[Run] = ()
    index_offsets: dict[int, int] = field(default_factory=dict)

    @property
    def chunks(self) -> list[ChunkIndex]:
        """Indexes of the chunks."""
        return self.summary.chunk_indexes

    @property
    def counts(self) -> Mapping[int, int]:
        """Messages by channel id."""
        return message_counts(self.summary)


@contextlib.contextmanager
def open_log_file(path: Path, doing: str = "read") -> Iterator[IO[bytes]]:
    """The open file; whatever is wrong with it becomes one `LogError` that names it."""
    cannot = f"{path}: cannot {doing} the log"
    try:
        with os_errors(cannot, LogError), path.open("rb") as stream:
            yield stream
    except LogError as error:
        text = str(error)
        raise (error if str(path) in text else type(error)(f"{path}: {text}")) from error
    except MemoryError as error:
        raise LogError(f"{cannot}: it does not fit into memory") from error


def read_contents(path: Path) -> Contents:
    """Find out what a file holds.

    Raises:
        NothingWrittenError: It is empty or torn before its first record was whole.
        LogError: It is missing, is no MCAP file or is damaged.
    """
    with open_log_file(path) as stream:
        size, closed = check_magic(stream)
        if not closed:
            return replace(scan(stream, path), complete=False)
        summary = read_summary(stream)
        if summary is None:
            return scan(stream, path)
        contents = Contents(path, size, summary, end=size)
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


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> UnpackedChunk:
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


def read_summary(stream: IO[bytes]) -> Summary | None:
    """Read the summary of a file that ends with its magic bytes, and verify its checksum.

    The MCAP format makes the summary and each of its parts optional, and other tools leave parts
    out. The indexes of metadata and attachments are completed from the file, which reads no more
    than the head of every record.

    Returns:
        The summary; None if the file has none, or one without schemas, channels, chunk indexes or
        counts, so that the data have to be read instead.

    Raises:
        LogError: The summary is damaged.
    """
    end = stream.seek(-len(MAGIC), os.SEEK_END)
    with _damage("its end"):
        stream.seek(end - 20)
        start, _, checksum = struct.unpack("<QQI", stream.read(20))
    if start == 0:
        return None
    if not len(MAGIC) < start < end:
        raise LogError("the log is damaged: its summary begins outside of the file")
    check_size("the summary", end - start)
    stream.seek(start)
    # The checksum covers the summary and the footer up to itself.
    if checksum and zlib.crc32(stream.read(end - start - 4)) != checksum:
        raise LogError("the log is damaged: the summary does not match its checksum")
    stream.seek(0)
    with _damage("its summary"):
        summary = SeekingReader(stream, record_size_limit=RECORD_LIMIT).get_summary()
    if summary is None or summary.statistics is None:
        return None
    counts, chunks = summary.statistics, len(summary.chunk_indexes)
    definitions = len(summary.schemas), len(summary.channels)
    if (*definitions, chunks) != (counts.schema_count, counts.channel_count, counts.chunk_count):
        return None
    indexed = len(summary.metadata_indexes), len(summary.attachment_indexes)
    if not indexed[0] or indexed != (counts.metadata_count, counts.attachment_count):
        _index_metadata(stream, summary)
    return summary


def _index_metadata(stream: IO[bytes], summary: Summary) -> None:
    """Find all metadata and attachments of a file by the heads of its records.

    Raises:
        LogError: A record reaches beyond the end of the file.
    """
    summary.metadata_indexes, summary.attachment_indexes = [], []
    size, start, opcode = stream.seek(0, os.SEEK_END), len(MAGIC), 0
    while opcode != Opcode.DATA_END:
        stream.seek(start)
        with _damage(f"the record at byte {start}"):
            opcode, length = RECORD.unpack(stream.read(RECORD.size))
        length += RECORD.size
        if start + length > size:
            raise LogError(f"the log is damaged: the record at byte {start} is cut off")
        if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            kind = Metadata if opcode == Opcode.METADATA else Attachment
            _note(summary, record_at(kind, stream, start, length), start, length)
        start += length


def message_counts(summary: Summary) -> dict[int, int]:
    """Messages by channel id, counted on in place while a file grows."""
    if summary.statistics is None:
        summary.statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
    return summary.statistics.channel_message_counts


def add_chunk(summary: Summary, index: ChunkIndex, runs: Sequence[Run]) -> None:
    """Note a chunk and count its messages."""
    summary.chunk_indexes.append(index)
    counts = message_counts(summary)
    for run in runs:
        counts[run.channel] = counts.get(run.channel, 0) + len(run.log_time)


def file_head(
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


def file_tail(summary: Summary, position: int) -> bytes:
    """The last bytes of a file, from the end of its data on.

    Args:
        summary: Of the file.
        position: Offset at which they will stand.
    """
    chunks, counts, builder = summary.chunk_indexes, message_counts(summary), RecordBuilder()
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
            if isinstance(record, Message) and not torn:
                raise ForeignLogError(NOT_IN_CHUNKS)
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
        _take_message_index(contents, record, start, end)
        return
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
    elif isinstance(record, Schema | Channel):
        _declare(summary, record)
    contents.end, contents.owed, contents.index_offsets = end, owed, {}
    stream.seek(end)


def _take_message_index(contents: Contents, record: MessageIndex, start: int, end: int) -> None:
    """Account for the index of a channel that another tool has written behind the last chunk.

    Other tools order channels and entries differently. What does not index the chunk's messages is
    passed over, and a log that is finished gets another index instead.
    """
    runs = [run for run in contents.owed if run.channel == record.channel_id]
    entries = np.frombuffer(b"".join(run.entries for run in runs), "<u8").reshape(-1, 2)
    if not runs or sorted(record.records) != sorted(map(tuple, entries.tolist())):
        return
    contents.index_offsets[record.channel_id] = start
    if {run.channel for run in contents.owed} <= contents.index_offsets.keys():
        index = contents.chunks[-1]
        index.message_index_offsets = contents.index_offsets
        index.message_index_length = end - contents.end
        contents.end, contents.owed = end, ()


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


# Chunks: messages of fixed size, many at a time.

RECORD_LIMIT = 2**28
"""No record is larger, nor what a chunk unpacks to: 256 MiB. A chunk of ours holds 2 MiB and the
rest of one solve; a file that announces more is refused before memory is taken for it [bytes]."""

RECORD = struct.Struct("<BQ")
"""Opcode and length in front of every record."""

CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of little-endian plain CDR, in front of every row."""

MESSAGE = np.dtype(
    [
        *(("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4")),
        *(("log_time", "<u8"), ("publish_time", "<u8"), ("cdr", "<u4")),
    ]
)
"""A Message record up to its row."""

_MESSAGE: Mapping[str, Any] = {name: field[1] for name, field in (MESSAGE.fields or {}).items()}

_ZSTD = zstandard.ZstdCompressionParameters.from_level(
    1, hash_log=12, target_length=3, write_content_size=True
)
"""Level 1, but with a hash table that fits into a core's first cache, longer strides, and literals
as they are: measured on logs, twice as fast as level 1 for 5 to 7 % more bytes. Higher levels take
twice the time of level 1 for one percent less."""

COMPRESSORS: Mapping[str, tuple[str, Callable[[memoryview], bytes | memoryview]]] = {
    "none": ("", lambda data: data),
    "lz4": ("lz4", lz4.frame.compress),
    "zstd": (
        "zstd",
        lambda data: zstandard.ZstdCompressor(compression_params=_ZSTD).compress(data),
    ),
}
"""Name of a compression in the file, and its function."""


def check_size(what: str, size: int) -> None:
    """Refuse what is larger than `RECORD_LIMIT`.

    Raises:
        LogError: It is.
    """
    if size > RECORD_LIMIT:
        raise LogError(f"{what} holds {size} bytes, more than the {RECORD_LIMIT} that are read")


def message_type(row: np.dtype[Any]) -> np.dtype[Any]:
    """A whole Message record ("head" and "row") with a row of the given type."""
    return np.dtype([("head", MESSAGE), ("row", row)])


@dataclass(frozen=True, eq=False)
class Run:
    """Messages of one channel and size that follow each other in a chunk.

    Attributes:
        channel: Channel id.
        start: Offset of the first in the chunk.
        size: Of one message, its head included [bytes].
        log_time: (k,) uint64 [ns].
    """

    channel: int
    start: int
    size: int
    log_time: np.ndarray

    @property
    def stop(self) -> int:
        """Offset behind the last message."""
        return self.start + self.size * len(self.log_time)

    @property
    def entries(self) -> bytes:
        """Log time and offset of each message, as a message index has them."""
        offsets = np.arange(self.start, self.stop, self.size, dtype="<u8")
        return np.stack([self.log_time, offsets], axis=1).tobytes()


def write_messages(
    buffer: NDArray[np.uint8],
    channel: int,
    rows: NDArray[Any],
    sequence: NDArray[Any],
    log_time: NDArray[Any],
    publish_time: NDArray[Any],
) -> Run:
    """Write messages of one channel into a chunk.

    Args:
        buffer: The bytes of the messages, overwritten.
        channel: Channel id.
        rows: (k,) packed.
        sequence: (k,).
        log_time: (k,) [ns].
        publish_time: (k,) [ns].

    Returns:
        The messages, as if the chunk began with the buffer.
    """
    payload = opaque(rows)
    kind = message_type(payload.dtype)
    head = np.zeros(1, MESSAGE)
    head["opcode"], head["channel"] = Opcode.MESSAGE, channel
    head["length"] = kind.itemsize - RECORD.size
    head["cdr"] = np.frombuffer(CDR_HEADER, "<u4")
    # Heads and rows are copied as bytes: numpy copies records field by field.
    bare = buffer.view([("head", opaque(head).dtype), ("row", payload.dtype)])
    bare["head"], bare["row"] = opaque(head), payload
    heads = buffer.view(kind)["head"]
    heads["sequence"], heads["log_time"], heads["publish_time"] = sequence, log_time, publish_time
    return Run(channel, 0, kind.itemsize, log_time)


def index_messages(index: ChunkIndex, runs: Sequence[Run], position: int) -> bytes:
    """The MessageIndex records of a chunk, noted in its index, for an offset of the file."""
    records = b""
    for channel in dict.fromkeys(run.channel for run in runs):
        entries = b"".join(run.entries for run in runs if run.channel == channel)
        index.message_index_offsets[channel] = position + len(records)
        # Not `mcap.records.MessageIndex.write`: it takes the pairs one by one.
        records += RECORD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries))
        records += struct.pack("<HI", channel, len(entries)) + entries
    index.message_index_length = len(records)
    return records


def pack_chunk(
    data: memoryview,
    runs: Sequence[Run],
    compression: str,
    position: int,
    packed: bytes | None = None,
) -> tuple[bytes, ChunkIndex]:
    """A Chunk record and its MessageIndex records.

    Args:
        data: Schemas, channels and messages, not compressed.
        runs: The messages in it; none of them empty, at least one.
        compression: A key of `COMPRESSORS`.
        position: Offset in the file at which the chunk will stand.
        packed: The data compressed, where they are already.

    Returns:
        The bytes, and the ChunkIndex record for the summary.
    """
    name, compress = COMPRESSORS[compression]
    chunk = Chunk(
        compression=name,
        data=bytes(compress(data)) if packed is None else packed,
        message_start_time=min(int(run.log_time.min()) for run in runs),
        message_end_time=max(int(run.log_time.max()) for run in runs),
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data),
    )
    builder = RecordBuilder()
    chunk.write(builder)
    index = chunk_index(chunk, position)
    builder.write(index_messages(index, runs, position + builder.count))
    return builder.end(), index


def chunk_index(chunk: Chunk, position: int) -> ChunkIndex:
    """The index of a chunk at an offset of a file, without its message indexes."""
    return ChunkIndex(
        chunk_length=RECORD.size + 40 + len(chunk.compression) + len(chunk.data),
        chunk_start_offset=position,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


@dataclass(frozen=True, eq=False)
class UnpackedChunk:
    """A chunk, unpacked and verified.

    Attributes:
        packed: The chunk as it stands in the file.
        data: Its contents.
        runs: The messages, in their order.
        definitions: Its Schema and Channel records.
    """

    packed: Chunk
    data: bytes
    runs: Sequence[Run]
    definitions: Sequence[Schema | Channel]

    def messages(self, run: Run, row: np.dtype[Any]) -> NDArray[Any]:
        """Messages of a run, (k,) of `message_type`; a view.

        Raises:
            LogError: They do not hold such rows.
        """
        kind = message_type(row)
        found = np.frombuffer(self.data, np.uint8, run.stop - run.start, run.start)
        if run.size == kind.itemsize:
            found = found.view(kind)
            if np.all(found["head"]["cdr"] == int.from_bytes(CDR_HEADER, "little")):
                return found
        raise LogError(f"a message of channel {run.channel} is not what its schema says")


def unpack(chunk: Chunk, where: str) -> UnpackedChunk:
    """Unpack a chunk and find its messages.

    Args:
        chunk: The chunk.
        where: Its name in messages.

    Raises:
        LogError: It is damaged or too large.
    """
    size = chunk.uncompressed_size
    check_size(where, size)
    try:
        data = _decompressed(chunk.data, chunk.compression, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise LogError(f"{where} cannot be unpacked: {error}") from error
    if len(data) != size:
        raise LogError(f"{where} has {len(data)} bytes for {size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise LogError(f"{where} fails its checksum")
    runs, definitions = _records_in(data, where)
    first, last = chunk.message_start_time, chunk.message_end_time
    if any(int(run.log_time.min()) < first or int(run.log_time.max()) > last for run in runs):
        raise LogError(f"{where} holds messages of other times than it says")
    return UnpackedChunk(chunk, data, runs, definitions)


def _decompressed(packed: bytes, compression: str, size: int) -> bytes:
    """Never more than one byte beyond the size, whatever is announced inside."""
    if compression == "":
        return packed
    if compression == "lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(packed, max_length=size + 1)
        if not decompressor.eof or decompressor.unused_data:
            raise ValueError("it is cut, or too long")
        return data
    if compression != "zstd":
        raise ValueError(f"its compression {compression!r} is not known here")
    announced = zstandard.frame_content_size(packed)
    if announced not in (-1, size):
        raise ValueError(f"it announces {announced} bytes for {size}")
    return zstandard.ZstdDecompressor().decompress(
        packed, max_output_size=size, allow_extra_data=False
    )


def _records_in(data: bytes, where: str) -> tuple[list[Run], list[Schema | Channel]]:
    """The messages of a chunk, and its other records."""
    octets = np.frombuffer(data, np.uint8)
    same, time = _MESSAGE["sequence"], _MESSAGE["log_time"]
    runs: list[Run] = []
    definitions: list[Schema | Channel] = []
    offset, most = 0, 1
    while offset < len(data):
        if offset + RECORD.size > len(data):
            raise LogError(f"{where} ends within a record")
        opcode, length = RECORD.unpack_from(data, offset)
        size = RECORD.size + length
        if offset + size > len(data):
            raise LogError(f"{where} holds a record that reaches beyond it")
        # Schemas and channels have numbers of 16 bits.
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and len(definitions) < 2**17:
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            body = ReadDataStream(io.BytesIO(data[offset + RECORD.size : offset + size]))
            try:
                definitions.append(kind.read(body))
            except (McapError, struct.error, ValueError) as error:
                raise LogError(f"{where} holds a damaged {kind.__name__}") from error
            offset += size
            continue
        if opcode != Opcode.MESSAGE or size < _MESSAGE["cdr"]:
            raise LogError(f"{where} holds a record that does not belong there ({opcode})")
        # Messages that follow each other and begin with the same opcode, length and channel.
        most = min(2 * most, (len(data) - offset) // size)
        block = octets[offset : offset + most * size].reshape(most, size)
        other = np.flatnonzero((block[:, :same] != block[0, :same]).any(axis=1))
        count = int(other[0]) if len(other) else most
        log_time = np.ascontiguousarray(block[:count, time : time + 8]).view("<u8")[:, 0]
        channel = int.from_bytes(data[offset + _MESSAGE["channel"] : offset + same], "little")
        last = runs[-1] if runs else None
        if last is not None and (last.channel, last.size, last.stop) == (channel, size, offset):
            log_time = np.concatenate([last.log_time, log_time])
            runs[-1] = Run(channel, last.start, size, log_time)
        else:
            runs.append(Run(channel, offset, size, log_time))
        offset += count * size
        most = max(count, 1)
    return runs, definitions
