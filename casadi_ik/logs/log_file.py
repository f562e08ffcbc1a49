"""A locked file to which complete records are appended."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from casadi_ik.errors import LogError

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
