"""Messages of one channel as rows: chunk bytes taken as an array, after a look at every message.

Nothing is taken on trust: the chunk's checksum is verified, and of every message opcode, length,
channel and time against the index. What is not of our fixed layout is decoded message by message.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Message
from mcap.stream_reader import breakup_chunk
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.cdr import Codec
from casadi_ik.logs.mcap.contents import Contents
from casadi_ik.logs.mcap.message import CDR_NUMBER, HEAD, RECORD_HEAD

_INDEX_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4")])

TimeFilter = Callable[[np.ndarray], NDArray[np.bool_]]
"""Which of log times (k,) are wanted."""


@dataclass(frozen=True)
class Wanted:
    """Which messages are wanted.

    Attributes:
        channel: Channel id.
        chunk: Whether a chunk with messages from a first to a last log time may hold any;
            None: it always may.
        times: Which of them are; None: all.
    """

    channel: int
    chunk: Callable[[int, int], bool] | None = None
    times: TimeFilter | None = None


def rows(
    stream: IO[bytes], contents: Contents, wanted: Wanted, dtype: np.dtype[Any]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows of fixed size, chunk by chunk.

    Args:
        stream: The file.
        contents: Where in it what is.
        wanted: Which messages.
        dtype: The payload behind its CDR header.

    Yields:
        Log times (k,) uint64 [ns] and rows (k,) of `dtype`, which are views where nothing had to
        be left out.

    Raises:
        LogError: A message is not what the index or the schema says.
    """
    size = HEAD.itemsize + dtype.itemsize
    for chunk in _chunks(contents, wanted):
        data = chunk_data(stream, chunk)
        entries = _entries(stream, chunk, wanted.channel)
        if entries is None:
            entries = _walked(stream, chunk, wanted.channel)
        if not len(entries):
            continue
        log_times, offsets = entries[:, 0], entries[:, 1].astype(np.int64)
        if offsets.min() < 0 or offsets.max() > len(data) - size:
            raise LogError("the message index points outside its chunk")
        messages = _taken(data, offsets, size)
        head = messages[:, : HEAD.itemsize].view(HEAD)[:, 0]
        prefix = head["prefix"]
        if not (
            np.all(prefix["opcode"] == Opcode.MESSAGE)
            and np.all(prefix["length"] == size - RECORD_HEAD)
            and np.all(prefix["channel"] == wanted.channel)
            and np.all(prefix["log_time"] == log_times)
            and np.all(head["cdr"] == CDR_NUMBER)
        ):
            raise LogError(
                f"a message of channel {wanted.channel} is not what index and schema say"
            )
        payload = messages[:, HEAD.itemsize :]
        if wanted.times is not None:
            keep = wanted.times(log_times)
            if not keep.all():
                log_times, payload = log_times[keep], payload[keep]
        yield log_times, payload.view(dtype)[:, 0]


def decoded(
    stream: IO[bytes], contents: Contents, wanted: Wanted, codec: Codec
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Messages of any kind, one by one: log time [ns] and values by name.

    Raises:
        LogError: A message is not what the schema says.
    """
    for chunk in _chunks(contents, wanted):
        for message in _messages(stream, chunk, wanted.channel):
            if wanted.times is None or wanted.times(np.array([message.log_time], np.uint64))[0]:
                yield message.log_time, codec.decode(message.data)


def chunk_data(stream: IO[bytes], index: ChunkIndex) -> bytes:
    """The records in a chunk, uncompressed, header and checksum verified.

    Raises:
        LogError: The chunk is not what its index says.
    """
    chunk = _chunk(stream, index)
    if chunk.compression == "zstd":
        data = zstandard.decompress(chunk.data, max_output_size=chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        data = lz4.frame.decompress(chunk.data)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise LogError(f"a chunk is compressed by {chunk.compression!r}, which is not known here")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise LogError(f"the chunk at byte {index.chunk_start_offset} fails its checksum")
    return data


def _chunks(contents: Contents, wanted: Wanted) -> Iterator[ChunkIndex]:
    """The chunks that may hold wanted messages."""
    for chunk in contents.chunks:
        indexed = chunk.message_index_offsets
        times = chunk.message_start_time, chunk.message_end_time
        if (not indexed or wanted.channel in indexed) and (
            wanted.chunk is None or wanted.chunk(*times)
        ):
            yield chunk


def _chunk(stream: IO[bytes], index: ChunkIndex) -> Chunk:
    stream.seek(index.chunk_start_offset)
    head = stream.read(RECORD_HEAD)
    if len(head) < RECORD_HEAD or head[0] != Opcode.CHUNK:
        raise LogError(f"no chunk at byte {index.chunk_start_offset}")
    chunk = Chunk.read(ReadDataStream(stream))
    found = (
        int.from_bytes(head[1:], "little") + RECORD_HEAD,
        chunk.compression,
        len(chunk.data),
        chunk.message_start_time,
        chunk.message_end_time,
        chunk.uncompressed_size,
    )
    expected = (
        index.chunk_length,
        index.compression,
        index.compressed_size,
        index.message_start_time,
        index.message_end_time,
        index.uncompressed_size,
    )
    if found != expected:
        raise LogError(f"the chunk at byte {index.chunk_start_offset} is not what its index says")
    return chunk


def _entries(stream: IO[bytes], chunk: ChunkIndex, channel: int) -> np.ndarray | None:
    """The (log time, offset) pairs of a chunk's index (k, 2) uint64; None if it has none."""
    position = chunk.message_index_offsets.get(channel)
    if position is None:
        return None
    stream.seek(position)
    head = np.frombuffer(stream.read(_INDEX_HEAD.itemsize), _INDEX_HEAD, 1)[0]
    size = int(head["size"])
    consistent = head["length"] == size + 6 and size % 16 == 0
    if head["opcode"] != Opcode.MESSAGE_INDEX or head["channel"] != channel or not consistent:
        raise LogError(f"no message index of channel {channel} at byte {position}")
    return np.frombuffer(stream.read(size), "<u8", size // 8).reshape(-1, 2)


def _walked(stream: IO[bytes], chunk: ChunkIndex, channel: int) -> np.ndarray:
    """The same by going through the chunk."""
    data, found, position = chunk_data(stream, chunk), [], 0
    while position < len(data):
        length = int.from_bytes(data[position + 1 : position + RECORD_HEAD], "little")
        if data[position] == Opcode.MESSAGE:
            head = np.frombuffer(data, HEAD["prefix"], 1, position)[0]
            if head["channel"] == channel:
                found.append((int(head["log_time"]), position))
        position += RECORD_HEAD + length
    return np.array(found, np.uint64).reshape(-1, 2)


def _messages(stream: IO[bytes], chunk: ChunkIndex, channel: int) -> Iterator[Message]:
    for record in breakup_chunk(_chunk(stream, chunk), validate_crc=True):
        if isinstance(record, Message) and record.channel_id == channel:
            yield record


def _taken(data: bytes, offsets: NDArray[np.int64], size: int) -> np.ndarray:
    """The bytes (k, size) from each offset on; a view where they stand one after the other."""
    octets = np.frombuffer(data, np.uint8)
    if np.all(np.diff(offsets) == size):
        start = int(offsets[0])
        return octets[start : start + len(offsets) * size].reshape(-1, size)
    return np.lib.stride_tricks.sliding_window_view(octets, size)[offsets]
