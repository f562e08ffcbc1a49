"""Messages of fixed size in the chunks of an MCAP file, packed and unpacked many at a time.

A log has a message of fixed size per iteration, so all messages of a channel in a chunk are one
numpy array. This is the part of MCAP that is not left to the `mcap` library, which handles
messages one by one: it would read a log of a million iterations 15 to 60 times slower.

Nothing in a chunk is trusted: size and checksum are verified, and opcode, length and time of every
record in it. No chunk is unpacked that is larger than `RECORD_LIMIT`.
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

from casadi_ik.errors import LogError
from casadi_ik.kernels.layout import opaque

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


def fill(
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


def packed_chunk(
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
class Unpacked:
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


def unpack(chunk: Chunk, where: str) -> Unpacked:
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
    return Unpacked(chunk, data, runs, definitions)


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
