"""Files a command writes: found unwritable before the work starts, complete or not there at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from casadi_ik.errors import CasadiIKError


class OutputError(CasadiIKError):
    """An output cannot be written."""


def check_outputs(outputs: Iterable[tuple[str, Path | None]], inputs: Iterable[Path] = ()) -> None:
    """See to it that outputs can be written and overwrite neither each other nor an input.

    Args:
        outputs: Option and path of each; None if it was not asked for.
        inputs: Files that are read.

    Raises:
        OutputError: The message names path and option.
    """
    taken = {_target(path): "the input" for path in inputs}
    for option, path in outputs:
        if path is None:
            continue
        where, target = f"{path}: {option}", _target(path)
        if target in taken:
            raise OutputError(f"{where}: found the file of {taken[target]}, expected another")
        taken[target] = option
        try:
            _refuse_special(target)
            part = _part(target)
            part.touch(exist_ok=False)
            part.unlink()
        except OSError as error:
            raise OutputError(f"{where}: cannot be written: {_reason(error)}") from error


def write_output(path: Path, option: str, write: Callable[[Path], object]) -> None:
    """Have a file written beside its place and put it there once it is complete.

    Args:
        path: Where it shall stand.
        option: The option that asked for it.
        write: Writes to the path it is given, which has the same suffix.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    target = _target(path)
    part = _part(target)
    try:
        with writing(path, option):
            write(part)
            part.replace(target)
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


@contextlib.contextmanager
def writing(path: Path, option: str) -> Iterator[None]:
    """Say of what the system refuses which output it concerns.

    Args:
        path: Where the output shall stand.
        option: The option that asked for it.

    Raises:
        OutputError: The system refused.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: {option}: cannot be written: {_reason(error)}") from error


def folder_of(path: Path) -> Path:
    """The folder an output will stand in, whatever links lead there."""
    return _target(path).parent


def _target(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _part(target: Path) -> Path:
    return target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")


def _refuse_special(target: Path) -> None:
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(mode):
        raise OSError("the path is a directory")
    if not stat.S_ISREG(mode):
        raise OSError("the path is not a regular file")
    if not os.access(target, os.W_OK):
        raise OSError("the file is read-only")


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
