"""Files that are there whole or not at all.

What killed processes left behind is told by the number of a process in its name and by its age.

What takes long to write is written in the background, in order, while the next is made.
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
    """Remove files and folders that a process made and cannot have use for any more.

    That is so if the process is gone and nothing was written for an hour: it could run on another
    machine that shares the folder, so its number alone does not count. Without a number it takes
    a day. What cannot be removed stays.

    Args:
        folder: Where to look.
        pattern: Names (`Path.glob`).
        word: Which word of the name, parted by "-" and ".", is the number of the process.
    """
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError, IndexError):
            number = "" if word is None else path.name.replace(".", "-").split("-")[word]
            patience = HOUR if number.isdigit() else DAY
            if (number.isdigit() and _alive(int(number))) or _age(path) < patience:
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


def _age(path: Path) -> float:
    """Seconds since something in it was last written."""
    inside = path.iterdir() if path.is_dir() and not path.is_symlink() else ()
    return time.time() - max(item.lstat().st_mtime for item in (path, *inside))


def _alive(process: int) -> bool:
    """Whether a process of that number runs here; so it is said where that cannot be found out."""
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
    """Where a file really stands, links followed."""
    return Path(os.path.realpath(path))


def temporary_path(target: Path) -> Path:
    """A hidden neighbour of the same suffix, to be written before it is put in place."""
    return target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Gives a path to write to, and puts what was written in its place once it is complete.

    An error of the package about what is written meanwhile names the path that was asked for.

    Raises:
        OSError: It cannot be written; nothing is left behind, and what stood there stays.
    """
    target = resolve_links(path)
    part = temporary_path(target)
    remove_stale(target.parent, f".{glob.escape(target.stem)}.*.part{glob.escape(target.suffix)}")
    try:
        yield part
        part.replace(target)
    except CasadiIKError as error:
        error.args = tuple(str(one).replace(str(part), str(path)) for one in error.args)
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def to_json(value: Any, infinite: Callable[[float], Any] = str) -> Any:
    """A value as standard JSON holds it: arrays as lists, enums by name, records by their fields.

    Args:
        value: The value; of records what `repr` shows of them.
        infinite: What stands for NaN and infinity.
    """
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value):
        value = {one.name: getattr(value, one.name) for one in fields(value) if one.repr}
    if isinstance(value, Mapping):
        return {str(key): to_json(item, infinite) for key, item in value.items()}
    if hasattr(value, "tolist"):  # of numpy, which is not imported to say what the program can do
        value = value.tolist()
    if isinstance(value, list | tuple | set | frozenset):
        return [to_json(item, infinite) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return infinite(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


class BackgroundWriter:
    """One thread that does jobs in their order, at most one behind.

    To check, compress and write a log takes as long as to solve what it holds; all of it runs in
    compiled code that holds no lock of the interpreter. The thread is made with the second job, so
    that a single solve, or a log of one chunk, does without.
    """

    def __init__(self) -> None:
        self._first = True
        self._pool: ThreadPoolExecutor | None = None
        self._pending: Future[None] | None = None

    def do(self, job: Callable[[], None]) -> None:
        """Have a job done; raises what the one before has raised."""
        if self._first:
            self._first = False
            job()
            return
        self.wait()
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "casadi_ik_log")
        self._pending = self._pool.submit(job)

    def wait(self) -> None:
        """Wait until nothing is left to do; raises what the last job has raised."""
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
        """Wait for the last job; what it raises counts unless something else has been raised."""
        try:
            if error is None:
                self.wait()
        finally:
            self.end()

    def end(self) -> None:
        """Wait for the last job, whatever becomes of it, and end the thread."""
        self._pending = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
