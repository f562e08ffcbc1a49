"""Messages of one channel as rows: the bytes of a chunk taken as an array."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap import unpacking
from casadi_ik.logs.mcap.message_bytes import CDR_NUMBER, HEAD

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

    def in_chunk(self, index: ChunkIndex) -> bool:
        """Whether a chunk may hold any."""
        indexed = index.message_index_offsets
        times = index.message_start_time, index.message_end_time
        return (not indexed or self.channel in indexed) and (
            self.chunk is None or self.chunk(*times)
        )


def rows(
    stream: IO[bytes], chunks: list[ChunkIndex], wanted: Wanted, dtype: np.dtype[Any]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows of fixed size, in the order of the file.

    Args:
        stream: The file.
        chunks: Where its chunks are.
        wanted: Which messages.
        dtype: The payload behind its CDR header.

    Yields:
        Log times (k,) uint64 [ns] and rows (k,) of `dtype`, which are views where nothing had to
        be left out.

    Raises:
        LogError: A chunk is damaged, or a message is not what the schema says.
    """
    size = HEAD.itemsize + dtype.itemsize
    for index in filter(wanted.in_chunk, chunks):
        chunk = unpacking.read_chunk(stream, index)
        for run in chunk.runs:
            if run.channel != wanted.channel:
                continue
            if run.size != size:
                raise LogError(f"a message of channel {run.channel} is not what its schema says")
            octets = np.frombuffer(chunk.data, np.uint8, run.stop - run.start, run.start)
            messages = octets.reshape(-1, size)
            head = messages[:, : HEAD.itemsize].view(HEAD)[:, 0]
            if np.any(head["cdr"] != CDR_NUMBER):
                raise LogError(f"a message of channel {run.channel} is not what its schema says")
            log_times, payload = run.log_time, messages[:, HEAD.itemsize :]
            if wanted.times is not None:
                keep = wanted.times(log_times)
                if not keep.all():
                    log_times, payload = log_times[keep], payload[keep]
            yield log_times, payload.view(dtype)[:, 0]
