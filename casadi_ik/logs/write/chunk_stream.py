"""Messages on their way into chunks: gathered, cut at solve boundaries, written."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import partial

import numpy as np
from mcap.records import Channel, Schema

from casadi_ik.errors import LogError
from casadi_ik.files.in_background import InBackground
from casadi_ik.logs.mcap.chunk import Run, chunk_bytes, definitions
from casadi_ik.logs.mcap.file import McapFile
from casadi_ik.logs.mcap.message_bytes import fill
from casadi_ik.logs.mcap.records import check_size
from casadi_ik.logs.mcap.summary import Summary
from casadi_ik.logs.write.topic_messages import Messages

CHUNK_SIZE = 2**21
"""A chunk is closed at the end of the first solve with which it is no smaller [bytes]."""


class ChunkStream:
    """Writes messages to a file, chunk by chunk.

    A chunk is compressed and written while the next one is filled, and is on the disk before that
    one is. Of what `add` has taken a killed process loses these two, less than twice `CHUNK_SIZE`
    and a solve, and no more.
    """

    def __init__(
        self, file: McapFile, summary: Summary, beginning: bytes, compression: str
    ) -> None:
        """Take an open file.

        Args:
            file: Where to write.
            summary: Of the file; grows with it.
            beginning: What stands before the first chunk; goes to the disk with that.
            compression: Of the chunks.
        """
        self._file = file
        self._summary = summary
        self._beginning = beginning
        self._compression = compression
        self._waiting: list[Messages] = []
        self._size = 0
        self._new: tuple[list[Schema], list[Channel]] = ([], [])
        self._background = InBackground()

    @property
    def closed(self) -> bool:
        """Whether nothing more can be written.

        Raises:
            LogError: Nothing can, since a chunk could not be written; said once.
        """
        if self._file.closed:
            self._background.wait()
        return self._file.closed

    def define(self, schema: Schema, channel: Channel) -> None:
        """Take a schema and its channel; they stand in the chunk with the first messages."""
        self._summary.schemas[schema.id] = schema
        self._summary.channels[channel.id] = channel
        self._new[0].append(schema)
        self._new[1].append(channel)

    def check(self, parts: Sequence[Messages], where: str, first: int) -> None:
        """See that every solve fits into a chunk that can be read, whatever waits before it.

        Args:
            parts: Messages of the same solves on several channels.
            where: File and method, for messages.
            first: Number of the first of the solves.

        Raises:
            LogError: One is too large.
        """
        ends = np.sum([part.ends * part.size for part in parts], axis=0)
        sizes = np.diff(ends, prepend=0)
        worst = int(sizes.argmax())
        # Beside it there is room for what waits, and for what compression may add.
        check_size(f"{where}, solve {first + worst}", int(sizes[worst]) + 2 * CHUNK_SIZE)

    def add(self, parts: Sequence[Messages]) -> None:
        """Take messages of the same solves on several channels.

        Raises:
            LogError: A chunk, perhaps of an earlier call, could not be written; the chunks before
                can be read.
        """
        count, start = len(parts[0].ends), 0
        size = np.sum([part.ends * part.size for part in parts], axis=0)
        while start < count:
            done = int(size[start - 1]) if start else 0
            full = done + CHUNK_SIZE - self._size
            stop = min(int(np.searchsorted(size, full)) + 1, count)
            self._waiting += [part.of_solves(start, stop) for part in parts]
            self._size += int(size[stop - 1]) - done
            if self._size >= CHUNK_SIZE:
                self._write()
            start = stop

    def close(self) -> None:
        """Write what waits, and the summary.

        Raises:
            LogError: It could not be written; the chunks before can be read.
        """
        try:
            if self._waiting and not self.closed:
                self._write()
            self._background.wait()
            if not self._file.closed:
                self._finish()
        finally:
            self._background.end()

    def discard(self) -> None:
        """Give up what waits; a file that has nothing else goes away, any other is finished."""
        self._background.end()
        if not self._file.closed and self._file.position:
            with contextlib.suppress(LogError):
                self._finish()
        self._file.close()

    def _gathered(self) -> tuple[np.ndarray, list[Run]]:
        """What waits as the contents of a chunk, and where in it which messages are."""
        defined = np.frombuffer(definitions(*self._new), np.uint8)
        data = np.empty(len(defined) + self._size, np.uint8)
        data[: len(defined)] = defined
        runs, start = [], len(defined)
        for channel in sorted({part.channel for part in self._waiting}):
            first = start
            parts = [part for part in self._waiting if part.channel == channel]
            for part in parts:
                stop = start + len(part.rows) * part.size
                times = part.log_time, part.publish_time
                fill(data[start:stop], channel, part.rows, part.sequence, *times)
                start = stop
            if start > first:
                log_time = np.concatenate([part.log_time for part in parts])
                runs.append(Run(channel, first, parts[0].size, log_time))
        self._waiting, self._size, self._new = [], 0, ([], [])
        return data, runs

    def _write(self) -> None:
        """Make a chunk of what waits, and have it written."""
        self._background.do(partial(self._put, *self._gathered()))

    def _put(self, data: np.ndarray, runs: list[Run]) -> None:
        pieces = self._unwritten()
        position = self._file.position + sum(map(len, pieces))
        written, index = chunk_bytes(data.data, runs, self._compression, position)
        self._file.write([*pieces, *written])
        self._summary.chunks.append(index)
        counts = self._summary.counts
        for run in runs:
            counts[run.channel] = counts.get(run.channel, 0) + len(run.log_time)

    def _finish(self) -> None:
        pieces = self._unwritten()
        position = self._file.position + sum(map(len, pieces))
        self._file.write([*pieces, self._summary.ending(position)])
        self._file.close()

    def _unwritten(self) -> list[bytes | memoryview]:
        """What has to stand before what is written now."""
        return [] if self._file.position else [self._beginning]
