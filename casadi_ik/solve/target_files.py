"""Targets in files: npz and Parquet, checked before they are used, and cut into parts."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Container, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

import numpy as np

from casadi_ik.errors import InputError, UnsupportedError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import RAISE_HINT, scaled_limit
from casadi_ik.files.number_files import READ_ERRORS
from casadi_ik.kinematics.contacts import EXTRA_ARRAY_NAMES
from casadi_ik.model.targets import DIRECTIONS_KEY

if TYPE_CHECKING:
    import polars

REQUIRED_KEYS = ("points", "normals")
"""What has to be there; the others may be."""

COLUMN_SUFFIXES = {"points": ("x", "y", "z"), "normals": ("nx", "ny", "nz")}
"""Of the columns of a finger in a table: ``thumb_x``, ..., ``thumb_nz``."""


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
        with self._opened() as archive, self._member(archive, REQUIRED_KEYS[0]) as points:
            return points.count

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Arrays (up to size, f, 3) by name, one block after the other.

        Args:
            size: Says before every block how large it may be.

        Raises:
            InputError: As `check`.
        """
        with self._opened() as archive, ExitStack() as opened:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
            optional = [key for key in (*EXTRA_ARRAY_NAMES, DIRECTIONS_KEY) if key in names]
            members = {
                key: opened.enter_context(self._member(archive, key))
                for key in (*REQUIRED_KEYS, *optional)
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
        except READ_ERRORS as error:
            raise InputError(f"{self.path}: damaged: {error}") from error
        with archive:
            yield archive

    @contextmanager
    def _member(self, archive: zipfile.ZipFile, key: str) -> Iterator[_Member]:
        where, names = f"{self.path}: {key}", archive.namelist()
        if f"{key}.npy" not in names:
            found = ", ".join(name.removesuffix(".npy") for name in names) or "nothing"
            raise InputError(
                f"{where}: missing, expected {' and '.join(REQUIRED_KEYS)}; found {found}"
            )
        try:
            stream = archive.open(f"{key}.npy")
            format_version = np.lib.format.read_magic(stream)
            if format_version == (1, 0):
                shape, column_major, dtype = np.lib.format.read_array_header_1_0(stream)
            elif format_version == (2, 0):
                shape, column_major, dtype = np.lib.format.read_array_header_2_0(stream)
            else:
                raise ValueError("a version of the npy format that is not for numbers")
        except (*READ_ERRORS, OSError) as error:
            raise InputError(f"{where}: cannot be read: {error}") from error
        with stream:
            if dtype.kind not in "fiu":
                raise InputError(f"{where}: found values of type {dtype}, expected numbers")
            expected = f"expected (k, {self.fingers}, 3)"
            if len(shape) != 3 or shape[1:] != (self.fingers, 3) or shape[0] < 0:
                raise InputError(f"{where}: found shape {shape}, {expected}")
            if shape[0] == 0:
                raise InputError(f"{where}: found no targets, {expected}")
            info, size = archive.getinfo(f"{key}.npy"), shape[0] * self.fingers * 3 * dtype.itemsize
            # The longest header that numpy reads has 10,064 bytes, magic and padding included.
            if not size <= info.file_size <= size + 10_064:
                problem = "fewer" if info.file_size < size else "more"
                raise InputError(f"{where}: damaged: {problem} bytes than its shape says")
            refuse_zip_bomb(where, info.file_size, info.compress_size)
            yield _Member(where, stream, shape[0], self.fingers, dtype, column_major)


def refuse_zip_bomb(where: str, unpacked: int, packed: int) -> None:
    """Refuse what unpacks to more than 256 MiB and to more than 200 times its own size.

    Raises:
        InputError: It does.
    """
    if unpacked > scaled_limit(max(2**28, 200 * packed)):
        raise InputError(
            f"{where}: unpacks to {unpacked >> 20} MiB from {packed} bytes, expected at most "
            f"{scaled_limit(200)} times its size {RAISE_HINT}"
        )


@dataclass
class _Member:
    """An array (k, f, 3) inside a zip file, read from its first row to its last."""

    where: str
    stream: IO[bytes]
    count: int
    fingers: int
    dtype: np.dtype[np.generic]
    column_major: bool
    place: int = 0

    @cached_property
    def _whole(self) -> Array:
        """All rows of a column-major array: its first row is known only when its last is read."""
        return self._rows(self.count, "F")

    def read(self, rows: int, last: bool) -> Array:
        """The next rows; at the last, the member has to end and its checksum to be right."""
        if self.column_major:
            block = self._whole[self.place : self.place + rows]
        else:
            block = self._rows(rows, "C")
        self.place += rows
        if last and self._bytes(1):
            raise InputError(f"{self.where}: damaged: more bytes than its shape says")
        return block

    def _rows(self, rows: int, order: Literal["C", "F"]) -> Array:
        size = rows * self.fingers * 3
        data = self._bytes(size * self.dtype.itemsize)
        if len(data) < size * self.dtype.itemsize:
            raise InputError(f"{self.where}: damaged: fewer bytes than its shape says")
        shape = (rows, self.fingers, 3)
        values = np.frombuffer(data, self.dtype).reshape(shape, order=order)
        return values.astype(np.float64)

    def _bytes(self, size: int) -> bytes:
        try:
            return self.stream.read(size)
        except (*READ_ERRORS, OSError) as error:
            raise InputError(f"{self.where}: cannot be read: {error}") from error


@dataclass(frozen=True)
class TargetTable:
    """Points and normals of k targets in a Parquet file; null and NaN mark what is free.

    Attributes:
        path: The file.
        fingers: The robot's, by whose names columns are called.
    """

    path: Path
    fingers: tuple[str, ...]

    def rows(self) -> int:
        """How many targets there are.

        Raises:
            InputError: No Parquet file, columns missing or not of numbers, or no rows.
            UnsupportedError: polars is not installed.
        """
        pl, frame = import_polars(), self._scanned()
        try:
            schema = frame.collect_schema()
            count = int(frame.select(pl.len()).collect().item())
        except (pl.exceptions.PolarsError, OSError) as error:
            raise InputError(f"{self.path}: no Parquet file: {error}") from error
        for names in self._columns().values():
            for name in names:
                if name not in schema:
                    raise InputError(
                        f"{self.path}: {name}: missing, expected columns {', '.join(names)}; "
                        f"found {', '.join(schema)}"
                    )
                if not schema[name].is_numeric():
                    raise InputError(
                        f"{self.path}: {name}: found values of type {schema[name]}, expected "
                        "numbers"
                    )
        if not count:
            raise InputError(f"{self.path}: found no rows, expected at least one")
        width = sum(len(names) for names in self._columns().values())
        refuse_zip_bomb(str(self.path), 8 * width * count, self.path.stat().st_size)
        return count

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Arrays (up to size, f, 3) by name, one block after the other; as `TargetFile.blocks`."""
        pl, frame, count = import_polars(), self._scanned(), self.rows()
        start = 0
        while start < count:
            rows = min(size(), count - start)
            block = {}
            for key, names in self._columns().items():
                wanted = [pl.col(name).cast(pl.Float64).fill_null(np.nan) for name in names]
                try:
                    part = frame.slice(start, rows).select(wanted).collect()
                except (pl.exceptions.PolarsError, OSError) as error:
                    raise InputError(f"{self.path}: damaged: {error}") from error
                block[key] = part.to_numpy().reshape(rows, len(self.fingers), 3)
            yield block
            start += rows

    def _columns(self) -> dict[str, list[str]]:
        return {
            key: [f"{finger}_{ending}" for finger in self.fingers for ending in endings]
            for key, endings in COLUMN_SUFFIXES.items()
        }

    def _scanned(self) -> polars.LazyFrame:
        return import_polars().scan_parquet(self.path)


def import_polars() -> Any:
    """The library that reads Parquet.

    Raises:
        UnsupportedError: It is not installed.
    """
    try:
        import polars as pl
    except ImportError as error:
        raise UnsupportedError(
            "Parquet files need polars: pip install 'casadi-ik[dataframes]'"
        ) from error
    return pl


@dataclass(frozen=True, eq=False)
class BatchPart:
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
class TargetSource:
    """Targets in files, in parts of at most `size`; no part reaches over two files.

    Attributes:
        files: The files in order.
        size: Targets of a part, at most.
    """

    files: tuple[TargetFile | TargetTable, ...]
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

    def without(self, done: Container[int]) -> Iterator[BatchPart]:
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
                    yield BatchPart(number, first_row, arrays)
                number, first_row = number + 1, first_row + len(arrays["points"])

    @cached_property
    def fingerprint(self) -> list[str]:
        """Name, size and a digest of the end of each file, which tell these from others.

        At its end a zip file keeps the checksums of its members and a Parquet file the places and
        statistics of its columns.
        """
        return [_fingerprint(file.path) for file in self.files]


def open_targets(path: Path, fingers: tuple[str, ...], size: int) -> TargetSource:
    """The targets at a path.

    Args:
        path: An npz or Parquet file, or a folder that holds such files; they are taken by name.
        fingers: The robot's.
        size: Targets of a part, at most.

    Raises:
        InputError: There is nothing of the kind.
    """
    endings, paths = (".npz", ".parquet"), [path]
    if path.is_dir():
        paths = sorted(each for each in path.iterdir() if each.suffix.lower() in endings)
    if not paths:
        raise InputError(f"{path}: found no .npz or .parquet file in it, expected at least one")
    found = (
        TargetTable(each, fingers)
        if each.suffix.lower() == ".parquet"
        else TargetFile(each, len(fingers))
        for each in paths
    )
    return TargetSource(tuple(found), size)


def _fingerprint(path: Path) -> str:
    with os_errors(f"{path}: cannot be read", InputError), path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 2**16, 0))
        digest = hashlib.sha256(file.read()).hexdigest()[:16]
    return f"{path.name} {size} {digest}"
