"""Chunks of an MCAP file taken apart: unpacked, and the messages in them found.

Nothing is taken on trust: sizes and the checksum of a chunk are verified, and of every record in
it opcode, length and time. No chunk is unpacked that is larger than `RECORD_LIMIT`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import IO

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.chunk import Run
from casadi_ik.logs.mcap.message_bytes import PREFIX
from casadi_ik.logs.mcap.records import HEAD, Record, check_size, record_at

_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time, unpacked size, checksum, length of the compression's name."""

_SAME = HEAD.size + 2
"""Bytes at the beginning of a message that are the same in those of its channel and size."""

_LOG_TIME = slice(HEAD.size + 6, HEAD.size + 14)
"""Where in a message its log time is, behind channel and sequence."""

_DEFINITIONS = 2**17
"""Of schemas and channels there are no more than their numbers of 16 bits allow."""


@dataclass(frozen=True, eq=False)
class Unpacked:
    """A chunk taken apart.

    Attributes:
        index: Where it stands; without its message indexes, which stand outside of it.
        data: What is in it.
        runs: Where the messages are, in their order.
        definitions: Its Schema and Channel records.
    """

    index: ChunkIndex
    data: bytes
    runs: Sequence[Run]
    definitions: Sequence[Record]

    def entries(self) -> dict[int, np.ndarray]:
        """Log time and offset of every message, (k, 2) uint64, by channel."""
        found: dict[int, list[np.ndarray]] = {}
        for run in self.runs:
            found.setdefault(run.channel, []).append(run.entries)
        return {channel: np.concatenate(parts) for channel, parts in found.items()}


def read_chunk(stream: IO[bytes], index: ChunkIndex) -> Unpacked:
    """The chunk that a summary names.

    Raises:
        LogError: It is damaged, too large, or not what its index says.
    """
    start = index.chunk_start_offset
    found = unpacked(record_at(stream, start, start + index.chunk_length))
    expected = replace(index, message_index_length=0, message_index_offsets={})
    if found.index != expected:
        raise LogError(f"the chunk at byte {start} is not what its index says")
    return found


def unpacked(record: Record) -> Unpacked:
    """A Chunk record taken apart.

    Raises:
        LogError: It is damaged or too large.
    """
    where = f"the chunk at byte {record.offset}"
    body = memoryview(record.body)
    if record.opcode != Opcode.CHUNK or len(body) < _CHUNK_HEAD.size:
        raise LogError(f"no chunk at byte {record.offset}")
    first, last, size, checksum, length = _CHUNK_HEAD.unpack_from(body)
    place = _CHUNK_HEAD.size + length
    packed = body[place + 8 :]
    if len(body) < place + 8 or int.from_bytes(body[place : place + 8], "little") != len(packed):
        raise LogError(f"{where} contradicts its own length")
    check_size(where, size)
    compression = bytes(body[_CHUNK_HEAD.size : place]).decode(errors="replace")
    try:
        data = _decompressed(packed, compression, size)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError) as error:
        raise LogError(f"{where} cannot be unpacked: {error}") from error
    if len(data) != size:
        raise LogError(f"{where} has {len(data)} bytes for {size}")
    if checksum and zlib.crc32(data) != checksum:
        raise LogError(f"{where} fails its checksum")
    runs, definitions = _walked(data, where)
    if any(int(run.log_time.min()) < first or int(run.log_time.max()) > last for run in runs):
        raise LogError(f"{where} holds messages of other times than it says")
    index = ChunkIndex(
        chunk_length=record.end - record.offset,
        chunk_start_offset=record.offset,
        compression=compression,
        compressed_size=len(packed),
        message_end_time=last,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=first,
        uncompressed_size=size,
    )
    return Unpacked(index, data, runs, definitions)


def _decompressed(packed: memoryview, compression: str, size: int) -> bytes:
    """Never more than one byte beyond the size, whatever is announced inside."""
    if compression == "":
        return bytes(packed)
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


def _walked(data: bytes, where: str) -> tuple[list[Run], list[Record]]:
    """Where the messages of a chunk are, and its other records."""
    octets = np.frombuffer(data, np.uint8)
    runs: list[Run] = []
    definitions: list[Record] = []
    offset, most = 0, 1
    while offset < len(data):
        if offset + HEAD.size > len(data):
            raise LogError(f"{where} ends within a record")
        opcode, length = HEAD.unpack_from(data, offset)
        size = HEAD.size + length
        if offset + size > len(data):
            raise LogError(f"{where} holds a record that reaches beyond it")
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and len(definitions) < _DEFINITIONS:
            definitions.append(Record(opcode, offset, data[offset + HEAD.size : offset + size]))
            offset += size
            continue
        if opcode != Opcode.MESSAGE or size < PREFIX.itemsize:
            raise LogError(f"{where} holds a record that does not belong there ({opcode})")
        # Messages of one channel and size that follow each other are taken at once.
        most = min(2 * most, (len(data) - offset) // size)
        block = octets[offset : offset + most * size].reshape(most, size)
        other = np.flatnonzero((block[:, :_SAME] != block[0, :_SAME]).any(axis=1))
        count = int(other[0]) if len(other) else most
        log_time = np.ascontiguousarray(block[:count, _LOG_TIME]).view("<u8")[:, 0]
        channel = int.from_bytes(data[offset + HEAD.size : offset + _SAME], "little")
        last = runs[-1] if runs else None
        if last is not None and (last.channel, last.size, last.stop) == (channel, size, offset):
            log_time = np.concatenate([last.log_time, log_time])
            runs[-1] = Run(channel, last.start, size, log_time)
        else:
            runs.append(Run(channel, offset, size, log_time))
        offset += count * size
        most = max(count, 1)
    return runs, definitions
