"""Chunks of a log: messages of fixed size as arrays.

The `mcap` library handles messages one by one and would read a log of a million iterations 15 to 60
times slower. A log has one message of fixed size per iteration, so all messages of a channel in a
chunk are one NumPy array, packed and unpacked at once. No content of a chunk is trusted: its size
and checksum are verified, and the opcode, length and time of every record in it. A chunk that would
unpack to more than `RECORD_LIMIT` is refused.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from numpy.typing import NDArray

from casadi_ik.compile.layout import opaque
from casadi_ik.errors import LogError

RECORD_LIMIT = 2**28
"""Maximum size of a record and of an unpacked chunk: 256 MiB [bytes]. Chunks of this package hold
2 MiB and the remainder of one solve. The size is checked before memory is allocated."""

RECORD = struct.Struct("<BQ")
"""Opcode and length at the start of every record."""

CDR_HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of little-endian plain CDR at the start of every row."""

MESSAGE = np.dtype(
    [
        *(("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4")),
        *(("log_time", "<u8"), ("publish_time", "<u8"), ("cdr", "<u4")),
    ]
)
"""Fields of a Message record before its row."""

_OFFSETS: Mapping[str, Any] = {name: field[1] for name, field in (MESSAGE.fields or {}).items()}

_ZSTD = zstandard.ZstdCompressionParameters.from_level(
    1, hash_log=12, target_length=3, write_content_size=True
)
"""Level 1 with a hash table that fits into the first-level cache, longer strides, and uncompressed
literals: on logs twice as fast as level 1 for 5 to 7 % more bytes. Higher levels take twice the
time of level 1 for 1 % fewer bytes."""

COMPRESSORS: Mapping[str, tuple[str, Callable[[memoryview], bytes | memoryview]]] = {
    "none": ("", lambda data: data),
    "lz4": ("lz4", lz4.frame.compress),
    "zstd": (
        "zstd",
        lambda data: zstandard.ZstdCompressor(compression_params=_ZSTD).compress(data),
    ),
}
"""(name in the file, function) of each compression."""


def check_size(name: str, size: int) -> None:
    """Check that a record is not larger than `RECORD_LIMIT`.

    Args:
        name: Name of the record for the error message.
        size: Its size [bytes].

    Raises:
        LogError: The record is larger.
    """
    if size > RECORD_LIMIT:
        raise LogError(f"{name} holds {size} bytes; expected at most {RECORD_LIMIT}")


def message_type(row: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of a Message record ("head" and "row") with rows of the given type."""
    return np.dtype([("head", MESSAGE), ("row", row)])


@dataclass(frozen=True, eq=False)
class MessageRun:
    """Consecutive messages of one channel and size in a chunk.

    Attributes:
        channel: Channel id.
        start: Offset of the first message in the chunk.
        size: Size of one message including its head [bytes].
        log_time: (k,) log times, uint64 [ns].
    """

    channel: int
    start: int
    size: int
    log_time: np.ndarray

    @property
    def stop(self) -> int:
        """Offset of the end of the last message."""
        return self.start + self.size * len(self.log_time)

    @property
    def entries(self) -> bytes:
        """Log time and offset of each message, as stored in a message index."""
        offsets = np.arange(self.start, self.stop, self.size, dtype="<u8")
        return np.stack([self.log_time, offsets], axis=1).tobytes()


def write_messages(
    buffer: NDArray[np.uint8],
    channel: int,
    rows: NDArray[Any],
    sequence: NDArray[Any],
    log_time: NDArray[Any],
    publish_time: NDArray[Any],
) -> None:
    """Write messages of one channel into a chunk.

    Args:
        buffer: Bytes of the messages, which are overwritten.
        channel: Channel id.
        rows: (k,) packed rows.
        sequence: (k,) sequence numbers.
        log_time: (k,) log times [ns].
        publish_time: (k,) publish times [ns].
    """
    payload = opaque(rows)
    record_type = message_type(payload.dtype)
    head = np.zeros(1, MESSAGE)
    head["opcode"], head["channel"] = Opcode.MESSAGE, channel
    head["length"] = record_type.itemsize - RECORD.size
    head["cdr"] = np.frombuffer(CDR_HEADER, "<u4")
    # Heads and rows are copied as bytes, because NumPy copies records field by field.
    records = buffer.view([("head", opaque(head).dtype), ("row", payload.dtype)])
    records["head"], records["row"] = opaque(head), payload
    heads = buffer.view(record_type)["head"]
    heads["sequence"], heads["log_time"], heads["publish_time"] = sequence, log_time, publish_time


def index_messages(index: ChunkIndex, runs: Sequence[MessageRun], position: int) -> bytes:
    """Return the MessageIndex records of a chunk, and enter their offsets in its index.

    Args:
        index: Index of the chunk, which is changed.
        runs: Messages of the chunk.
        position: Offset of the records in the file.
    """
    records = b""
    for channel in dict.fromkeys(run.channel for run in runs):
        entries = b"".join(run.entries for run in runs if run.channel == channel)
        index.message_index_offsets[channel] = position + len(records)
        # `mcap.records.MessageIndex.write` would write the pairs one by one.
        records += RECORD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries))
        records += struct.pack("<HI", channel, len(entries)) + entries
    index.message_index_length = len(records)
    return records


def pack_chunk(
    data: memoryview,
    runs: Sequence[MessageRun],
    compression: str,
    position: int,
    packed: bytes | None = None,
) -> tuple[bytes, ChunkIndex]:
    """Return a Chunk record with its MessageIndex records.

    Args:
        data: Uncompressed schemas, channels and messages.
        runs: Messages in the data, at least one.
        compression: Key of `COMPRESSORS`.
        position: Offset of the chunk in the file.
        packed: Compressed data, if they exist already.

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
    """Return the index of a chunk at an offset of a file, without its message indexes."""
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


def section_index(data: bytes, runs: Sequence[MessageRun], position: int) -> ChunkIndex:
    """Return the index of a section: consecutive messages that are not in a chunk.

    Some programs write messages without chunks (rosbag2 with its preset fastwrite). A section is
    read like an uncompressed chunk that consists of its data only.

    Args:
        data: Bytes of the section.
        runs: Messages in the section, at least one.
        position: Offset of the section in the file.
    """
    return ChunkIndex(
        chunk_length=len(data),
        chunk_start_offset=position,
        compression="",
        compressed_size=len(data),
        message_end_time=max(int(run.log_time.max()) for run in runs),
        message_index_length=0,
        message_index_offsets={},
        message_start_time=min(int(run.log_time.min()) for run in runs),
        uncompressed_size=len(data),
    )


def is_section(index: ChunkIndex) -> bool:
    """Return True for the index of a section, False for the index of a Chunk record."""
    return index.chunk_length == index.compressed_size


@dataclass(frozen=True, eq=False)
class UnpackedChunk:
    """An unpacked and verified chunk.

    Attributes:
        packed: Chunk record of the file.
        data: Uncompressed data.
        runs: Messages in the order of the chunk.
        definitions: Schema and Channel records.
    """

    packed: Chunk
    data: bytes
    runs: Sequence[MessageRun]
    definitions: Sequence[Schema | Channel]

    def messages(self, run: MessageRun, row: np.dtype[Any]) -> NDArray[Any]:
        """Return a view of the messages of a run, (k,) records of `message_type`.

        Raises:
            LogError: The messages do not hold such rows.
        """
        record_type = message_type(row)
        data = np.frombuffer(self.data, np.uint8, run.stop - run.start, run.start)
        if run.size == record_type.itemsize:
            messages = data.view(record_type)
            if np.all(messages["head"]["cdr"] == int.from_bytes(CDR_HEADER, "little")):
                return messages
        raise LogError(f"channel {run.channel}: a message does not match its schema")


def unpack_chunk(chunk: Chunk, context: str) -> UnpackedChunk:
    """Unpack a chunk and find its messages.

    Args:
        chunk: The chunk.
        context: Name of the chunk in error messages.

    Raises:
        LogError: The chunk is damaged or too large.
    """
    size = chunk.uncompressed_size
    check_size(context, size)
    try:
        data = _decompress(chunk.data, chunk.compression, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise LogError(f"{context} cannot be unpacked: {error}") from error
    if len(data) != size:
        raise LogError(f"{context} has {len(data)} bytes, expected {size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise LogError(f"{context} does not match its checksum")
    runs, definitions, _ = parse_records(data, context)
    start, end = chunk.message_start_time, chunk.message_end_time
    if any(int(run.log_time.min()) < start or int(run.log_time.max()) > end for run in runs):
        raise LogError(f"{context} holds messages outside of the time range that it states")
    return UnpackedChunk(chunk, data, runs, definitions)


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    """Return decompressed data, at most one byte more than the expected size."""
    if compression == "":
        return packed
    if compression == "lz4":
        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(packed, max_length=size + 1)
        if not decompressor.eof or decompressor.unused_data:
            raise ValueError("the lz4 frame is truncated or too long")
        return data
    if compression != "zstd":
        raise ValueError(f"compression {compression!r} is unknown; expected lz4 or zstd")
    stated_size = zstandard.frame_content_size(packed)
    if stated_size not in (-1, size):
        raise ValueError(f"the zstd frame states {stated_size} bytes, expected {size}")
    return zstandard.ZstdDecompressor().decompress(
        packed, max_output_size=size, allow_extra_data=False
    )


def parse_records(
    data: bytes, context: str, partial: bool = False
) -> tuple[list[MessageRun], list[Schema | Channel], int]:
    """Find the records of a chunk.

    Args:
        data: Uncompressed data of the chunk, or the data from the start of a section on.
        context: Name of the chunk in error messages.
        partial: End before the first record that is incomplete or does not belong to a chunk,
            instead of raising an error.

    Returns:
        The messages, the schemas and channels, and the offset of the end of the last record.

    Raises:
        LogError: A record is damaged or does not belong to a chunk.
    """
    octets = np.frombuffer(data, np.uint8)
    id_stop, time = _OFFSETS["sequence"], _OFFSETS["log_time"]
    runs: list[MessageRun] = []
    definitions: list[Schema | Channel] = []
    offset, max_count = 0, 1
    while offset < len(data):
        opcode = length = 0
        is_complete = offset + RECORD.size <= len(data)
        if is_complete:
            opcode, length = RECORD.unpack_from(data, offset)
        size = RECORD.size + length
        is_definition = opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
        is_message = opcode == Opcode.MESSAGE and size >= _OFFSETS["cdr"]
        # Schemas and channels have ids of 16 bits.
        is_known = is_message or (is_definition and len(definitions) < 2**17)
        is_cut = not is_complete or offset + size > len(data)
        if is_cut or not is_known:
            if partial:
                break
            if is_cut:
                raise LogError(f"{context}: the record at offset {offset} is cut off")
            raise LogError(
                f"{context}: the record at offset {offset} has opcode {opcode} and {length} bytes;"
                " expected a schema, a channel or a message"
            )
        if is_definition:
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            body = ReadDataStream(io.BytesIO(data[offset + RECORD.size : offset + size]))
            try:
                definitions.append(kind.read(body))
            except (McapError, struct.error, ValueError) as error:
                raise LogError(f"{context} holds a damaged {kind.__name__}") from error
            offset += size
            continue
        # Consecutive messages with the same opcode, length and channel are one run.
        max_count = min(2 * max_count, (len(data) - offset) // size)
        block = octets[offset : offset + max_count * size].reshape(max_count, size)
        different = np.flatnonzero((block[:, :id_stop] != block[0, :id_stop]).any(axis=1))
        count = int(different[0]) if len(different) else max_count
        log_time = np.ascontiguousarray(block[:count, time : time + 8]).view("<u8")[:, 0]
        channel = int.from_bytes(data[offset + _OFFSETS["channel"] : offset + id_stop], "little")
        last = runs[-1] if runs else None
        if last is not None and (last.channel, last.size, last.stop) == (channel, size, offset):
            log_time = np.concatenate([last.log_time, log_time])
            runs[-1] = MessageRun(channel, last.start, size, log_time)
        else:
            runs.append(MessageRun(channel, offset, size, log_time))
        offset += count * size
        max_count = max(count, 1)
    return runs, definitions, offset
