"""An MCAP file that grows by whole chunks, locked, and stays readable whatever happens."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Sequence
from pathlib import Path

from casadi_ik.errors import LogError

try:
    import fcntl
except ImportError:  # Windows: no lock
    fcntl = None


class McapFile:
    """Opened for writing; what stood at the path stays until the first write.

    Attributes:
        path: As it was given.
        position: How many bytes of whole records are written.
    """

    def __init__(self, path: Path) -> None:
        """Open and lock.

        Raises:
            LogError: The path cannot be written, or somebody else is writing it.
        """
        self.path = path
        self.position = 0
        try:
            self._created = not path.exists()
            if not self._created and not stat.S_ISREG(mode := path.stat().st_mode):
                what = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
                raise LogError(f"{path}: cannot write the log: the path is {what}")
            self._descriptor = os.open(
                path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666
            )
        except OSError as error:
            raise self._failure(error) from error
        self._open = True
        if not self._lock():
            os.close(self._descriptor)
            raise LogError(f"{path}: cannot write the log: another writer is at it")

    def write(self, pieces: Sequence[bytes | memoryview]) -> None:
        """Append, with one call to the system if it takes all at once; nothing is buffered.

        If it fails or is interrupted, the file ends where it ended before.

        Raises:
            LogError: It could not be written. The file is closed; if nothing is in it, it is gone.
        """
        data = memoryview(b"".join(pieces))
        try:
            if self.position == 0:
                os.ftruncate(self._descriptor, 0)
            done = 0
            while done < len(data):
                done += os.write(self._descriptor, data[done:])
            self.position += len(data)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self.position)
                os.lseek(self._descriptor, self.position, os.SEEK_SET)
            if not isinstance(error, OSError):
                raise
            self.close()
            raise self._failure(error) from error

    def close(self) -> None:
        """Close and unlock; a file this writer made and never wrote to goes away."""
        if not self._open:
            return
        self._open = False
        if self.position == 0 and (self._created or os.fstat(self._descriptor).st_size == 0):
            with contextlib.suppress(OSError):
                self.path.resolve().unlink()
        os.close(self._descriptor)

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return not self._open

    def _lock(self) -> bool:
        """Whether nobody else is writing; false too if the file went away in the meantime."""
        if fcntl is None:
            return True
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return os.path.samestat(os.fstat(self._descriptor), self.path.stat())
        except OSError:
            return False

    def _failure(self, error: OSError) -> LogError:
        return LogError(f"{self.path}: cannot write the log: {error.strerror or error}")
