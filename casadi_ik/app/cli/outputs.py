"""What a command puts out: lines on stderr, and files that are complete or not there at all."""

from __future__ import annotations

import contextlib
import json
import os
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from casadi_ik.app.cli.options import PROGRAM
from casadi_ik.errors import CasadiIKError, os_errors, shortened
from casadi_ik.files.writing import atomic_write, resolve_links, temporary_path


class OutputError(CasadiIKError):
    """An output cannot be written."""


def say(kind: str, text: str) -> None:
    """Print one line on stderr behind the program's name.

    Args:
        kind: What it is about: "error", "warning".
        text: The rest; line breaks in it become spaces, and it is cut to a few hundred characters.
    """
    print(f"{PROGRAM}: {kind}: {shortened(' '.join(text.split()))}", file=sys.stderr)  # noqa: T201


def check_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[Path] = ()) -> None:
    """See to it that outputs can be written and overwrite neither each other nor an input.

    Args:
        outputs: The path of each by option; None if it was not asked for.
        inputs: Files that are read.

    Raises:
        OutputError: The message names path and option.
    """
    taken: dict[object, str] = {}
    for path in inputs:
        with contextlib.suppress(OSError):
            taken |= dict.fromkeys(_identities(resolve_links(path)), "the input")
    for option, path in outputs.items():
        if path is None:
            continue
        with writing(path, option):
            target = resolve_links(path)
            same = _identities(target)
            for identity in same:
                if identity in taken:
                    owner = taken[identity]
                    problem = f"found the file of {owner}, expected another"
                    raise OutputError(f"{path}: {option}: {problem}")
            taken |= dict.fromkeys(same, option)
            _refuse_special(target)
            part = temporary_path(target)
            part.touch(exist_ok=False)
            part.unlink()


@contextlib.contextmanager
def output(path: Path, option: str = "--out") -> Iterator[Path]:
    """Give a path beside a file's place, of the same suffix, and put the file there once complete.

    Args:
        path: Where it shall stand.
        option: The option that asked for it.

    Raises:
        OutputError: It cannot be written; nothing is left behind.
    """
    with writing(path, option), atomic_write(path) as part:
        yield part


def write_json(path: Path, data: Any) -> None:
    """Write what ``--out`` asks for as JSON.

    Raises:
        OutputError: It cannot be written.
    """
    with output(path) as part:
        part.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def writing(path: Path, option: str) -> contextlib.AbstractContextManager[None]:
    """Say of what the system refuses which output it concerns.

    Args:
        path: Where the output shall stand.
        option: The option that asked for it.

    Raises:
        OutputError: The system refused.
    """
    return os_errors(f"{path}: {option}: cannot be written", OutputError)


def folder_of(path: Path) -> Path:
    """The folder an output will stand in, whatever links lead there."""
    return resolve_links(path).parent


def _identities(target: Path) -> list[object]:
    """By what a file is known: its path, and its place on the disk if it is there (hard links)."""
    try:
        found = target.stat()
    except OSError:
        return [target]
    return [target, (found.st_dev, found.st_ino)]


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
