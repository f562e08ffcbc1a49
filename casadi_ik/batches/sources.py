"""The targets of a batch: a file, or a folder of files one after the other, cut into parts."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Protocol

from casadi_ik.arrays import Array
from casadi_ik.batches.target_file import TargetFile
from casadi_ik.batches.target_table import TargetTable
from casadi_ik.errors import InputError

TAIL = 2**16
"""Bytes at the end of a file that stand for all: there a zip file keeps the checksums of its
members and a Parquet file the places and statistics of its columns."""


class Targets(Protocol):
    """A file of targets."""

    @property
    def path(self) -> Path:
        """The file."""
        ...

    def rows(self) -> int:
        """How many targets there are."""
        ...

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Their arrays, so many rows at a time."""
        ...


@dataclass(frozen=True, eq=False)
class Part:
    """Targets that are solved together.

    Attributes:
        number: Of the part, from 0.
        first_row: Number of its first target among all.
        arrays: Points, normals and more, (k, f, 3) by name.
    """

    number: int
    first_row: int
    arrays: dict[str, Array]


@dataclass(frozen=True, eq=False)
class Source:
    """Targets in files, in parts of at most `size`; no part reaches over two files.

    Attributes:
        files: The files in order.
        size: Targets of a part, at most.
    """

    files: tuple[Targets, ...]
    size: int

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Targets of each file.

        Raises:
            InputError: One is no file of targets of this robot.
        """
        return tuple(file.rows() for file in self.files)

    @property
    def count(self) -> int:
        """Targets of all."""
        return sum(self.counts)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Targets of each part."""
        return tuple(
            min(self.size, count - start)
            for count in self.counts
            for start in range(0, count, self.size)
        )

    @cached_property
    def first_rows(self) -> tuple[int, ...]:
        """Number of each part's first target among all."""
        return (0, *accumulate(self.sizes))[:-1]

    def without(self, done: Container[int]) -> Iterator[Part]:
        """The parts that are not done yet, read as they are asked for.

        Raises:
            InputError: A file is damaged.
        """
        number = first_row = 0
        for file, count in zip(self.files, self.counts, strict=True):
            parts = -(-count // self.size)
            if all(part in done for part in range(number, number + parts)):
                number, first_row = number + parts, first_row + count
                continue
            for arrays in file.blocks(lambda: self.size):
                if number not in done:
                    yield Part(number, first_row, arrays)
                number, first_row = number + 1, first_row + len(arrays["points"])

    @cached_property
    def fingerprint(self) -> list[str]:
        """What tells these files from others: names, sizes and a digest of their ends."""
        return [_fingerprint(file.path) for file in self.files]


def source_of(path: Path, fingers: tuple[str, ...], size: int) -> Source:
    """The targets at a path.

    Args:
        path: An npz or Parquet file, or a folder that holds such files; they are taken by name.
        fingers: The robot's.
        size: Targets of a part, at most.

    Raises:
        InputError: There is nothing of the kind.
    """
    if not path.is_dir():
        return Source((_file(path, fingers),), size)
    found = sorted(p for p in path.iterdir() if p.suffix.lower() in (".npz", ".parquet"))
    if not found:
        raise InputError(f"{path}: found no .npz or .parquet file in it, expected at least one")
    return Source(tuple(_file(p, fingers) for p in found), size)


def _file(path: Path, fingers: tuple[str, ...]) -> Targets:
    if path.suffix.lower() == ".parquet":
        return TargetTable(path, fingers)
    return TargetFile(path, len(fingers))


def _fingerprint(path: Path) -> str:
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - TAIL, 0))
            digest = hashlib.sha256(file.read()).hexdigest()[:16]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return f"{path.name} {size} {digest}"
