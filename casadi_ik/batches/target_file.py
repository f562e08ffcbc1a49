"""Files of targets: checked from end to end, then read block by block."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.files.limits import RAISED, limit
from casadi_ik.files.npz import UNREADABLE
from casadi_ik.problem.contacts import NAMES
from casadi_ik.problem.problems import DIRECTIONS

KEYS = ("points", "normals")
"""What has to be there; the others may be."""

OPTIONAL = (*NAMES, DIRECTIONS)

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}

LONGEST_HEADER = 10_064
"""Bytes of the longest header that numpy reads, magic and padding included."""

HARMLESS, MOST_UNPACKED = 2**28, 200
"""Bytes that any member may unpack to, and beyond that how many times its own size."""


@dataclass(frozen=True)
class TargetFile:
    """Points, normals and more of k targets in an npz file; nothing in it is ever executed.

    Attributes:
        path: The file.
        fingers: How many contacts a target has.
    """

    path: Path
    fingers: int

    def check(self, size: int) -> int:
        """Read all of it once, `size` targets at a time.

        Returns:
            How many targets there are.

        Raises:
            InputError: Missing, no npz, damaged, or other arrays than expected; the message names
                file and key.
        """
        return sum(len(block["points"]) for block in self.blocks(lambda: size))

    def rows(self) -> int:
        """How many targets there are, by the heads of its arrays alone.

        Raises:
            InputError: As `check`, as far as the heads tell.
        """
        with self._opened() as archive, self._member(archive, KEYS[0]) as points:
            return points.count

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Arrays (up to size, f, 3) by name, one block after the other.

        Args:
            size: Says before every block how large it may be.

        Raises:
            InputError: As `check`.
        """
        with self._opened() as archive, ExitStack() as opened:
            there = {name.removesuffix(".npy") for name in archive.namelist()}
            members = {
                key: opened.enter_context(self._member(archive, key))
                for key in (*KEYS, *(key for key in OPTIONAL if key in there))
            }
            count = members["points"].count
            for key, member in members.items():
                if member.count != count:
                    raise InputError(
                        f"{self.path}: points and {key}: found {count} and {member.count} rows, "
                        "expected as many"
                    )
            start = 0
            while start < count:
                rows = min(size(), count - start)
                start += rows
                last = start == count
                yield {key: member.read(rows, last) for key, member in members.items()}

    @contextmanager
    def _opened(self) -> Iterator[zipfile.ZipFile]:
        try:
            if self.path.exists() and not (self.path.is_file() or self.path.is_dir()):
                raise InputError(f"{self.path}: no plain file, expected an npz file")
            if self.path.is_file() and not zipfile.is_zipfile(self.path):
                raise InputError(
                    f"{self.path}: not an npz file, expected one with points and normals"
                )
            archive = zipfile.ZipFile(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}") from error
        except UNREADABLE as error:
            raise InputError(f"{self.path}: damaged: {error}") from error
        with archive:
            yield archive

    @contextmanager
    def _member(self, archive: zipfile.ZipFile, key: str) -> Iterator[_Member]:
        name = f"{key}.npy"
        if name not in archive.namelist():
            found = ", ".join(n.removesuffix(".npy") for n in archive.namelist()) or "nothing"
            raise InputError(
                f"{self.path}: {key}: missing, expected {' and '.join(KEYS)}; found {found}"
            )
        where = f"{self.path}: {key}"
        try:
            stream = archive.open(name)
            header = _HEADERS.get(np.lib.format.read_magic(stream))
            if header is None:
                raise ValueError("a version of the npy format that is not for numbers")
            shape, column_major, dtype = header(stream)
        except (*UNREADABLE, OSError) as error:
            raise InputError(f"{where}: cannot be read: {error}") from error
        with stream:
            if dtype.kind not in "fiu":
                raise InputError(f"{where}: found values of type {dtype}, expected numbers")
            expected = f"expected (k, {self.fingers}, 3)"
            if len(shape) != 3 or shape[1:] != (self.fingers, 3):
                raise InputError(f"{where}: found shape {shape}, {expected}")
            if shape[0] == 0:
                raise InputError(f"{where}: found no targets, {expected}")
            if shape[0] < 0:
                raise InputError(f"{where}: found shape {shape}, {expected}")
            _check_size(where, archive.getinfo(name), shape[0] * self.fingers * 3 * dtype.itemsize)
            yield _Member(where, stream, shape[0], self.fingers, dtype, column_major)


def _check_size(where: str, member: zipfile.ZipInfo, size: int) -> None:
    """Whether a member holds what its shape says, and is no bomb."""
    if not size <= member.file_size <= size + LONGEST_HEADER:
        problem = "fewer" if member.file_size < size else "more"
        raise InputError(f"{where}: damaged: {problem} bytes than its shape says")
    refuse_bombs(where, member.file_size, member.compress_size)


def refuse_bombs(where: str, unpacked: int, packed: int) -> None:
    """Refuse what unpacks to much more bytes than it has.

    Raises:
        InputError: It does.
    """
    if unpacked > limit(max(HARMLESS, MOST_UNPACKED * packed)):
        raise InputError(
            f"{where}: unpacks to {unpacked >> 20} MiB from {packed} bytes, expected at most "
            f"{limit(MOST_UNPACKED)} times its size {RAISED}"
        )


class _Member:
    """An array (k, f, 3) inside a zip file, read from its first row to its last."""

    def __init__(
        self,
        where: str,
        stream: IO[bytes],
        count: int,
        fingers: int,
        dtype: np.dtype[np.generic],
        column_major: bool,
    ) -> None:
        self.count = count
        self._where = where
        self._stream = stream
        self._fingers = fingers
        self._dtype = dtype
        # Its first row is known only when its last is read: it has to be held as a whole.
        self._whole = self._rows(count, "F") if column_major else None
        self._read = 0

    def read(self, rows: int, last: bool) -> Array:
        """The next rows; at the last, the member has to end and its checksum to be right."""
        if self._whole is not None:
            block = self._whole[self._read : self._read + rows]
        else:
            block = self._rows(rows, "C")
        self._read += rows
        if last and self._bytes(1):
            raise InputError(f"{self._where}: damaged: more bytes than its shape says")
        return block

    def _rows(self, rows: int, order: Literal["C", "F"]) -> Array:
        size = rows * self._fingers * 3
        data = self._bytes(size * self._dtype.itemsize)
        if len(data) < size * self._dtype.itemsize:
            raise InputError(f"{self._where}: damaged: fewer bytes than its shape says")
        shape = (rows, self._fingers, 3)
        values = np.frombuffer(data, self._dtype).reshape(shape, order=order)
        return values.astype(np.float64)

    def _bytes(self, size: int) -> bytes:
        try:
            return self._stream.read(size)
        except (*UNREADABLE, OSError) as error:
            raise InputError(f"{self._where}: cannot be read: {error}") from error
