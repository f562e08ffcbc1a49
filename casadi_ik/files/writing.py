"""Atomic writes, removal of stale temporary files, JSON values, and writing in the background.

Names of temporary files contain the id of the process, so that files of killed processes can be
recognised and removed.
"""

from __future__ import annotations

import contextlib
import glob
import math
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from casadi_ik.errors import CasadiIKError

HOUR, DAY = 3600.0, 86400.0


def remove_stale(folder: Path, pattern: str, word: int | None = None) -> None:
    """Remove temporary files and folders of processes that have ended.

    A file is stale if its process is gone and nothing was written for an hour: the process could
    run on another machine that shares the folder, so its id alone is not enough. A file without a
    process id is stale after a day. Files that cannot be removed stay.

    Args:
        folder: Folder to search.
        pattern: Pattern of the names (`Path.glob`).
        word: Index of the word of the name, separated by "-" and ".", that is the process id; None
            for names without one.
    """
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError, IndexError):
            number = "" if word is None else path.name.replace(".", "-").split("-")[word]
            patience = HOUR if number.isdigit() else DAY
            if (number.isdigit() and _is_alive(int(number))) or _age(path) < patience:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _age(path: Path) -> float:
    """Return the time since the last write to a file or folder [s]."""
    entries = path.iterdir() if path.is_dir() and not path.is_symlink() else ()
    return time.time() - max(item.lstat().st_mtime for item in (path, *entries))


def _is_alive(process: int) -> bool:
    """Return False if no process with this id runs on this machine; True if that is unknown."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def resolve_links(path: Path) -> Path:
    """Return the path of a file with symbolic links resolved."""
    return Path(os.path.realpath(path))


def temporary_path(target: Path) -> Path:
    """Return a hidden path in the same folder and with the same suffix."""
    return target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path, and move the file from there to `path` once it is complete.

    Errors of the package in the block name `path` instead of the temporary path.

    Raises:
        OSError: The file cannot be written; an existing file stays unchanged and no temporary file
            remains.
    """
    target = resolve_links(path)
    temporary = temporary_path(target)
    remove_stale(target.parent, f".{glob.escape(target.stem)}.*.part{glob.escape(target.suffix)}")
    try:
        yield temporary
        temporary.replace(target)
    except CasadiIKError as error:
        error.args = tuple(str(arg).replace(str(temporary), str(path)) for arg in error.args)
        raise
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def to_json(value: Any, infinite: Callable[[float], Any] = str) -> Any:
    """Return a value as JSON types: arrays as lists, enums by name, records as mappings.

    Args:
        value: The value; of records, the fields that `repr` shows.
        infinite: Function that converts NaN and infinity.
    """
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value) if field.repr}
    if isinstance(value, Mapping):
        return {str(key): to_json(item, infinite) for key, item in value.items()}
    if hasattr(value, "tolist"):  # a NumPy value; importing NumPy would slow down `--help`
        value = value.tolist()
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json(item, infinite) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return infinite(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


class BackgroundWriter:
    """A thread that runs jobs in order, at most one of them pending.

    Checking, compressing and writing a log takes as long as solving, and runs in compiled code that
    releases the interpreter's lock. The first job runs in the calling thread, so that a single
    solve, or a log of one chunk, needs no thread.
    """

    def __init__(self) -> None:
        self._first = True
        self._pool: ThreadPoolExecutor | None = None
        self._pending: Future[None] | None = None

    def do(self, job: Callable[[], None]) -> None:
        """Run a job in the background; raises the error of the previous job."""
        if self._first:
            self._first = False
            job()
            return
        self.wait()
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "casadi_ik_log")
        self._pending = self._pool.submit(job)

    def wait(self) -> None:
        """Wait for the pending job; raises its error."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Wait for the pending job; raises its error unless the block has raised one."""
        try:
            if error is None:
                self.wait()
        finally:
            self.end()

    def end(self) -> None:
        """Wait for the pending job, ignore its error, and end the thread."""
        self._pending = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
