"""Locked log files, and chunks of messages that are compressed and written in the background.

Chunks are cut between solves.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, McapRecord, Schema
from mcap.summary import Summary
from numpy.typing import NDArray

from casadi_ik.errors import LogError
from casadi_ik.files.writing import BackgroundWriter
from casadi_ik.logs.chunks import MESSAGE, MessageRun, check_size, pack_chunk, write_messages
from casadi_ik.logs.container import add_chunk, file_tail

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None


class LogFile:
    """A locked file that holds complete records only, even if a write fails.

    An existing file keeps its contents until the first write.

    Attributes:
        path: Path of the file.
        position: Size of the complete records that are written [bytes].
        closed: True once the file is closed.
    """

    def __init__(self, path: Path) -> None:
        """Open and lock the file.

        Raises:
            LogError: The path cannot be written, or another process writes it.
        """
        self.path = path
        self.position = 0
        self.closed = False
        try:
            self._created = not path.exists()
            if not self._created and not stat.S_ISREG(mode := path.stat().st_mode):
                file_type = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
                raise LogError(f"{path}: cannot write the log: the path is {file_type}")
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
            self._descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            raise self._write_error(error) from error
        if not lock_file(self._descriptor, path):
            os.close(self._descriptor)
            raise LogError(f"{path}: cannot write the log: another writer has locked it")

    def write(self, data: bytes) -> None:
        """Append data without buffering, with a single system call if it takes all of them.

        If writing fails or is interrupted, the file is cut back to its previous size.

        Raises:
            LogError: The data cannot be written. The file is closed, and removed if it is empty.
        """
        remaining = memoryview(data)
        try:
            if self.position == 0:
                os.ftruncate(self._descriptor, 0)
            while len(remaining):
                remaining = remaining[os.write(self._descriptor, remaining) :]
            self.position += len(data)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.position)
                os.lseek(self._descriptor, self.position, os.SEEK_SET)
            if not isinstance(error, OSError):
                raise
            self.close()
            raise self._write_error(error) from error

    def close(self) -> None:
        """Close and unlock the file; remove it if this writer created it and wrote nothing."""
        if self.closed:
            return
        self.closed = True
        if self.position == 0 and (self._created or os.fstat(self._descriptor).st_size == 0):
            with contextlib.suppress(OSError):
                self.path.resolve().unlink()
        os.close(self._descriptor)

    def _write_error(self, error: OSError) -> LogError:
        return LogError(f"{self.path}: cannot write the log: {error.strerror or error}")


def lock_file(descriptor: int, path: Path) -> bool:
    """Lock an open file, if the file system supports locks.

    Returns:
        False if another process writes the file, or if the file is no longer at its path.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass  # ENOLCK, ENOTSUP or ENOSYS: network file systems often have no locks
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False


CHUNK_SIZE = 2**21
"""Minimum size of the messages of a chunk; it ends with the solve that reaches the size [bytes]."""


class TopicMessages(NamedTuple):
    """Messages of k solves on one topic.

    Attributes:
        channel: Channel id.
        rows: (m,) rows in the order of the solves.
        sequence: (m,) sequence numbers.
        log_time: (m,) log times [ns].
        publish_time: (m,) publish times [ns].
        stops: (k,) index of the row after the last row of each solve.
    """

    channel: int
    rows: NDArray[Any]
    sequence: NDArray[Any]
    log_time: NDArray[Any]
    publish_time: NDArray[Any]
    stops: NDArray[np.int64]

    @property
    def message_size(self) -> int:
        """Size of a message [bytes]."""
        return MESSAGE.itemsize + self.rows.dtype.itemsize

    def slice_solves(self, start: int, stop: int) -> TopicMessages:
        """Return the messages of a range of solves."""
        first = int(self.stops[start - 1]) if start else 0
        rows = slice(first, int(self.stops[stop - 1]))
        return TopicMessages(
            self.channel,
            self.rows[rows],
            self.sequence[rows],
            self.log_time[rows],
            self.publish_time[rows],
            self.stops[start:stop] - first,
        )


class ChunkWriter:
    """A writer that collects messages, cuts them into chunks between solves, and writes these.

    A chunk is compressed and written while the next one is filled, and is in the file before the
    next one is written. A killed process loses at most these two chunks: less than twice
    `CHUNK_SIZE` and one solve.
    """

    def __init__(self, file: LogFile, summary: Summary, head: bytes, compression: str) -> None:
        """Create a writer for an open file.

        Args:
            file: The file.
            summary: Summary of the file, which is extended by each chunk.
            head: Bytes before the first chunk, which are written together with it.
            compression: Compression of the chunks.
        """
        self._file = file
        self._summary = summary
        self._head = head
        self._compression = compression
        self._pending: list[TopicMessages] = []
        self._pending_size = 0
        self._pending_definitions: list[McapRecord] = []
        self._background = BackgroundWriter()

    @property
    def closed(self) -> bool:
        """True if the file is closed.

        Raises:
            LogError: The file was closed because a chunk could not be written; raised once.
        """
        if self._file.closed:
            self._background.wait()
        return self._file.closed

    def define(self, schema: Schema, channel: Channel) -> None:
        """Add a schema and its channel; they are written in the chunk with the next messages."""
        self._summary.schemas[schema.id] = schema
        self._summary.channels[channel.id] = channel
        self._pending_definitions += [schema, channel]

    def check(self, topics: Sequence[TopicMessages], context: str, first: int) -> None:
        """Check that every solve fits into a chunk that can be read.

        Args:
            topics: Messages of the same solves on several topics.
            context: File and method for error messages.
            first: Number of the first solve.

        Raises:
            LogError: A solve is too large.
        """
        stops = np.sum([messages.stops * messages.message_size for messages in topics], axis=0)
        sizes = np.diff(stops, prepend=0)
        largest = int(sizes.argmax())
        # The chunk also holds the pending messages, and compression can enlarge it.
        check_size(f"{context}, solve {first + largest}", int(sizes[largest]) + 2 * CHUNK_SIZE)

    def add(self, topics: Sequence[TopicMessages]) -> None:
        """Add messages of the same solves on several topics.

        Raises:
            LogError: A chunk of this or an earlier call cannot be written; earlier chunks can be
                read.
        """
        count, start = len(topics[0].stops), 0
        stops = np.sum([messages.stops * messages.message_size for messages in topics], axis=0)
        while start < count:
            added = int(stops[start - 1]) if start else 0
            chunk_stop = added + CHUNK_SIZE - self._pending_size
            stop = min(int(np.searchsorted(stops, chunk_stop)) + 1, count)
            self._pending += [messages.slice_solves(start, stop) for messages in topics]
            self._pending_size += int(stops[stop - 1]) - added
            if self._pending_size >= CHUNK_SIZE:
                self._background.do(partial(self._write_chunk, *self._take_pending()))
            start = stop

    def close(self) -> None:
        """Write the pending messages and the summary, and close the file.

        Raises:
            LogError: They cannot be written; earlier chunks can be read.
        """
        try:
            if self._pending and not self.closed:
                self._background.do(partial(self._write_chunk, *self._take_pending()))
            self._background.wait()
            if not self._file.closed:
                self._finish()
        finally:
            self._background.end()

    def discard(self) -> None:
        """Discard the pending messages; finish the file, or remove it if it is empty."""
        self._background.end()
        if not self._file.closed and self._file.position:
            with contextlib.suppress(LogError):
                self._finish()
        self._file.close()

    def _take_pending(self) -> tuple[np.ndarray, list[MessageRun]]:
        """Remove the pending messages and return them as the data of a chunk."""
        builder = RecordBuilder()
        for record in self._pending_definitions:
            record.write(builder)
        start = builder.count
        data = np.empty(start + self._pending_size, np.uint8)
        data[:start] = np.frombuffer(builder.end(), np.uint8)
        runs: list[MessageRun] = []
        for channel in sorted({messages.channel for messages in self._pending}):
            blocks = [
                messages
                for messages in self._pending
                if messages.channel == channel and len(messages.rows)
            ]
            run_start = start
            for block in blocks:
                stop = start + len(block.rows) * block.message_size
                write_messages(
                    data[start:stop],
                    channel,
                    block.rows,
                    block.sequence,
                    block.log_time,
                    block.publish_time,
                )
                start = stop
            if blocks:
                log_time = np.concatenate([block.log_time for block in blocks])
                runs.append(MessageRun(channel, run_start, blocks[0].message_size, log_time))
        self._pending, self._pending_size, self._pending_definitions = [], 0, []
        return data, runs

    def _write_chunk(self, data: np.ndarray, runs: list[MessageRun]) -> None:
        """Write a chunk, after the head of the file if it is the first one."""
        head = b"" if self._file.position else self._head
        position = self._file.position + len(head)
        chunk, index = pack_chunk(data.data, runs, self._compression, position)
        self._file.write(head + chunk)
        add_chunk(self._summary, index, runs)

    def _finish(self) -> None:
        head = b"" if self._file.position else self._head
        self._file.write(head + file_tail(self._summary, self._file.position + len(head)))
        self._file.close()
