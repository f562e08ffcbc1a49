"""Messages of one channel, a chunk at a time, by way of the message index."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from casadi_ik.errors import LogError
from casadi_ik.logs.cdr import HEADER

_PREFIX = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""An MCAP Message record up to its payload."""

_INDEX_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("size", "<u4")])
_RECORD_HEAD = 9
_MESSAGE_HEAD = 22


@dataclass(frozen=True)
class Slice:
    """Where messages are wanted from.

    Attributes:
        channel: Channel id.
        start: First log time [ns].
        stop: First log time no longer wanted [ns]; None for no end.
    """

    channel: int
    start: int = 0
    stop: int | None = None


def rows(
    stream: IO[bytes], summary: Summary, wanted: Slice, dtype: np.dtype[Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Payloads of fixed size as numpy rows, by log time.

    Args:
        stream: The MCAP file.
        summary: Its summary.
        wanted: Which messages.
        dtype: The payload behind its CDR header.

    Returns:
        Log times (k,) uint64 [ns] and rows (k,) of `dtype`.

    Raises:
        LogError: A message is not what the index or the schema says.
    """
    message = np.dtype([*_PREFIX, ("cdr", "<u4"), ("row", dtype)])
    times, parts = [np.zeros(0, np.uint64)], [np.zeros(0, dtype)]
    for log_times, offsets, data in _indexed(stream, summary, wanted):
        if offsets.size and int(offsets.max()) + message.itemsize > len(data):
            raise LogError("the message index points outside its chunk")
        windows = np.lib.stride_tricks.sliding_window_view(
            np.frombuffer(data, np.uint8), message.itemsize
        )
        found = windows[offsets.astype(np.int64)].view(message)[:, 0]
        if not (
            np.all(found["opcode"] == Opcode.MESSAGE)
            and np.all(found["length"] == message.itemsize - _RECORD_HEAD)
            and np.all(found["channel"] == wanted.channel)
            and np.all(found["log_time"] == log_times)
            and np.all(found["cdr"] == int.from_bytes(HEADER, "little"))
        ):
            raise LogError(f"a message of channel {wanted.channel} is not of its schema's size")
        times.append(log_times)
        parts.append(found["row"])
    joined = np.concatenate(times)
    order = np.argsort(joined, kind="stable")
    return joined[order], np.concatenate(parts)[order]


def payloads(stream: IO[bytes], summary: Summary, wanted: Slice) -> list[bytes]:
    """Payloads of any size with their CDR headers, by log time.

    Raises:
        LogError: A message is not where the index says.
    """
    found: list[tuple[int, bytes]] = []
    prefix = np.dtype(_PREFIX)
    for log_times, offsets, data in _indexed(stream, summary, wanted):
        for log_time, offset in zip(log_times.tolist(), offsets.tolist(), strict=True):
            if offset + prefix.itemsize > len(data):
                raise LogError("the message index points outside its chunk")
            head = np.frombuffer(data, prefix, 1, offset)[0]
            end = offset + _RECORD_HEAD + int(head["length"])
            if (
                head["opcode"] != Opcode.MESSAGE
                or head["channel"] != wanted.channel
                or head["log_time"] != log_time
                or end > len(data)
            ):
                raise LogError(f"no message of channel {wanted.channel} where the index says")
            found.append((log_time, data[offset + prefix.itemsize : end]))
    return [payload for _, payload in sorted(found, key=lambda item: item[0])]


def _indexed(
    stream: IO[bytes], summary: Summary, wanted: Slice
) -> Iterator[tuple[np.ndarray, np.ndarray, bytes]]:
    """Log times, offsets and uncompressed bytes of every chunk that holds wanted messages."""
    for chunk in summary.chunk_indexes:
        late = wanted.stop is not None and chunk.message_start_time >= wanted.stop
        if late or chunk.message_end_time < wanted.start:
            continue
        position = chunk.message_index_offsets.get(wanted.channel)
        if position is None:
            continue
        entries = _message_index(stream, position, wanted.channel)
        keep = entries[:, 0] >= wanted.start
        if wanted.stop is not None:
            keep &= entries[:, 0] < wanted.stop
        if keep.any():
            yield entries[keep, 0], entries[keep, 1], _chunk_bytes(stream, chunk)


def _message_index(stream: IO[bytes], position: int, channel: int) -> np.ndarray:
    """The (log time, offset) pairs of a MessageIndex record, (k, 2) uint64."""
    stream.seek(position)
    head = np.frombuffer(stream.read(_INDEX_HEAD.itemsize), _INDEX_HEAD, 1)[0]
    size = int(head["size"])
    consistent = head["length"] == size + 6 and size % 16 == 0
    if head["opcode"] != Opcode.MESSAGE_INDEX or head["channel"] != channel or not consistent:
        raise LogError(f"no message index of channel {channel} at byte {position}")
    return np.frombuffer(stream.read(size), "<u8", size // 8).reshape(-1, 2)


def _chunk_bytes(stream: IO[bytes], index: ChunkIndex) -> bytes:
    """The records of a chunk, uncompressed, their checksum verified."""
    stream.seek(index.chunk_start_offset)
    opcode = stream.read(_RECORD_HEAD)[:1]
    if opcode != bytes([Opcode.CHUNK]):
        raise LogError(f"no chunk at byte {index.chunk_start_offset}")
    chunk = Chunk.read(ReadDataStream(stream))
    data, length = get_chunk_data_stream(chunk, validate_crc=True)
    return data.read(length)
