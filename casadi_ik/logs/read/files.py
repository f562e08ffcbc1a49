"""Which files a log consists of."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

from casadi_ik.errors import LogError, printable
from casadi_ik.logs.mcap.data_section import NothingWrittenError
from casadi_ik.logs.read.shard import Shard

logger = logging.getLogger(__name__)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


def log_files(path: Paths) -> list[tuple[Path, str]]:
    """The files that are meant, and what each is called among them.

    Args:
        path: A file, a folder (all .mcap files in it and below, by the order of their paths;
            hidden ones are unfinished work of others), or several of these.

    Raises:
        LogError: A folder holds no log, or nothing was named.
    """
    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    files: list[tuple[Path, str]] = []
    for item in map(Path, given):
        if not item.is_dir():
            files.append((item, item.name))
            continue
        try:
            inside = sorted(file for file in item.rglob("*.mcap") if file.name[0] != ".")
        except OSError as error:
            raise LogError(f"{item}: cannot be read: {error.strerror or error}") from error
        if not inside:
            raise LogError(f"{item}: no log in this folder")
        files += [(file, file.relative_to(item).as_posix()) for file in inside]
    if not files:
        raise LogError("no log was named")
    return files


def open_shards(path: Paths) -> tuple[list[Shard], list[Path]]:
    """The shards of a log, and the files that were left out: those in which nothing is whole.

    A writer that is killed before its first chunk leaves an empty or torn file, with which
    nothing is lost. Among others it is named and left out.

    Raises:
        LogError: A file is missing, is no MCAP file, is damaged, or is not a log of casadi_ik; or
            nothing is whole in any.
    """
    files = log_files(path)
    shards: list[Shard] = []
    empty: list[Path] = []
    for file, name in files:
        try:
            shards.append(Shard(file, name))
        except NothingWrittenError as error:
            if len(files) == 1:
                raise
            empty.append(file)
            logger.warning("%s; left out, nothing in it is whole", printable(str(error)))
    if not shards:
        raise LogError(f"{files[0][0]}: nothing in it is whole, nor in {len(files) - 1} others")
    return shards, empty
