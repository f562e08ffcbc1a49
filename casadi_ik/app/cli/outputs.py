"""Outputs of commands: messages on stderr, and files that are written completely or not at all."""

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
    """Error of an output that cannot be written."""


def print_message(kind: str, text: str) -> None:
    """Print one line on stderr that starts with the name of the program.

    Args:
        kind: Kind of message, such as "error" or "warning".
        text: Message; line breaks become spaces, and long texts are shortened.
    """
    print(f"{PROGRAM}: {kind}: {shortened(' '.join(text.split()))}", file=sys.stderr)  # noqa: T201


def check_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[Path] = ()) -> None:
    """Check that outputs can be written and overwrite neither each other nor an input.

    Args:
        outputs: Path by option; None if the option is not given.
        inputs: Files that the command reads.

    Raises:
        OutputError: A file cannot be written, or two paths mean the same file.
    """
    owners: dict[object, str] = {}
    for path in inputs:
        with contextlib.suppress(OSError):
            owners |= dict.fromkeys(_identities(resolve_links(path)), "the input")
    for option, path in outputs.items():
        if path is None:
            continue
        with writing(path, option):
            target = resolve_links(path)
            identities = _identities(target)
            for identity in identities:
                if identity in owners:
                    raise OutputError(
                        f"{path}: {option}: file is the same as that of {owners[identity]}; "
                        "expected a different file"
                    )
            owners |= dict.fromkeys(identities, option)
            _refuse_special(target)
            part = temporary_path(target)
            part.touch(exist_ok=False)
            part.unlink()


@contextlib.contextmanager
def output(path: Path, option: str = "--out") -> Iterator[Path]:
    """Yield a temporary path of the same suffix, and move the file to `path` once it is complete.

    Args:
        path: Path of the output.
        option: Option that names the output, for errors.

    Raises:
        OutputError: The file cannot be written; no partial file remains.
    """
    with writing(path, option), atomic_write(path) as part:
        yield part


def write_json(path: Path, data: Any) -> None:
    """Write data as JSON to the file of ``--out``.

    Raises:
        OutputError: The file cannot be written.
    """
    with output(path) as part:
        part.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def writing(path: Path, option: str) -> contextlib.AbstractContextManager[None]:
    """Return a context that turns an OSError into an OutputError with path and option.

    Args:
        path: Path of the output.
        option: Option that names the output.

    Raises:
        OutputError: The block raised an OSError.
    """
    return os_errors(f"{path}: {option}: cannot be written", OutputError)


def folder_of(path: Path) -> Path:
    """Return the folder of an output after resolving symbolic links."""
    return resolve_links(path).parent


def _identities(target: Path) -> list[object]:
    """Return the path of a file and, if it exists, its device and inode (hard links share them)."""
    try:
        info = target.stat()
    except OSError:
        return [target]
    return [target, (info.st_dev, info.st_ino)]


def _refuse_special(target: Path) -> None:
    """Raise an OSError if a path exists but is not a file that can be written."""
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
