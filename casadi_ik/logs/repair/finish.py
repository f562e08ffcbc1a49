"""Makes a log whole again whose writer was killed: nothing that was complete is lost."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.data_section import DataSection, check_magic, scan
from casadi_ik.logs.mcap.summary import read_summary

try:
    import fcntl
except ImportError:  # Windows: no lock
    fcntl = None


@dataclass(frozen=True)
class Finished:
    """The result of repairing a log.

    Attributes:
        path: The file.
        changed: False if it was whole already.
        chunks: Complete chunks in it.
        messages: Messages in it.
        cut: Bytes of the torn tail that were cut away.
    """

    path: Path
    changed: bool
    chunks: int
    messages: int
    cut: int


def finish_log(path: str | os.PathLike[str]) -> Finished:
    """Repair a truncated log in place.

    Every complete chunk is verified by its checksum; what is torn behind the last of them is cut,
    and the end that was never written is written. A log that is whole is left as it is.

    Args:
        path: An MCAP file.

    Raises:
        LogError: The file is missing, cannot be written, is still being written, is no MCAP file,
            or is damaged elsewhere than at its end. Then it has not been changed.

    Example:
        >>> finished = ik.logs.finish_log("cup.mcap")  # whole already: nothing is changed
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            section = scan(stream)
            whole = section.closed and _ends_well(stream, section)
        cut = 0 if whole else _close(path, section)
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot finish the log: {reason}") from error
    except LogError as error:
        raise type(error)(f"{path}: {error}") from error
    summary = section.summary
    return Finished(path, not whole, len(summary.chunks), sum(summary.counts.values()), cut)


def _close(path: Path, section: DataSection) -> int:
    """Cut what is torn and write the end; gives the bytes that were cut."""
    end = section.end
    indexes = section.owed_indexes()
    tail = indexes + section.summary.ending(end + len(indexes))
    with path.open("r+b") as stream:
        if not _locked(stream) or stream.seek(0, os.SEEK_END) != section.size:
            raise LogError("cannot finish the log: its writer is still at it")
        stream.truncate(end)
        stream.seek(end)
        stream.write(tail)
        stream.flush()
        os.fsync(stream.fileno())
    return section.size - end


def _locked(stream: IO[bytes]) -> bool:
    """Whether nobody else is writing."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _ends_well(stream: IO[bytes], section: DataSection) -> bool:
    """Whether a summary that matches its checksum stands behind the data, and says what they do."""
    if not check_magic(stream)[1]:
        return False
    try:
        summary, start = read_summary(stream)
    except LogError:
        return False
    return start >= section.end and summary.chunks == section.summary.chunks
