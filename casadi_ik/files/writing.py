"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from casadi_ik.files.leftovers import tidy


def target_of(path: Path) -> Path:
    """Where a file really stands, links followed."""
    return Path(os.path.realpath(path))


def part_of(target: Path) -> Path:
    """A hidden neighbour of the same suffix, to be written before it is put in place."""
    return target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Gives a path to write to, and puts what was written in its place once it is complete.

    Raises:
        OSError: It cannot be written; nothing is left behind, and what stood there stays.
    """
    target = target_of(path)
    part = part_of(target)
    tidy(target.parent, f".{glob.escape(target.stem)}.*.part{glob.escape(target.suffix)}")
    try:
        yield part
        part.replace(target)
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
