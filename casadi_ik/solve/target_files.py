"""Readers of targets in npz and Parquet files, and their division into parts."""

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
from casadi_ik.model.targets import DIRECTIONS_KEY, EXTRA_ARRAY_NAMES

if TYPE_CHECKING:
    import polars

REQUIRED_KEYS = ("points", "normals")
"""Names of the required arrays."""

COLUMN_SUFFIXES = {"points": ("x", "y", "z"), "normals": ("nx", "ny", "nz")}
"""Suffixes of the columns of a finger in a table: ``thumb_x``, ..., ``thumb_nz``."""


@dataclass(frozen=True)
class TargetFile:
    """Targets in an npz file, read without unpickling.

    Attributes:
        path: Path of the file.
        fingers: Number of fingers of the robot.
    """

    path: Path
    fingers: int

    def check(self, size: int) -> int:
        """Read the whole file, `size` targets at a time.

        Returns:
            Number of targets.

        Raises:
            InputError: The file is missing, not an npz file or damaged, or an array is unexpected;
                the message names file and key.
        """
        return sum(len(block["points"]) for block in self.blocks(lambda: size))

    def rows(self) -> int:
        """Return the number of targets from the headers of the arrays.

        Raises:
            InputError: See `check`; the data are not read.
        """
        with self._open() as archive, self._member(archive, REQUIRED_KEYS[0]) as points:
            return points.count

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Yield arrays (up to size, f, 3) by name, block by block.

        Args:
            size: Function that returns the maximum size of the next block.

        Raises:
            InputError: See `check`.
        """
        with self._open() as archive, ExitStack() as opened:
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
                        "expected the same number"
                    )
            start = 0
            while start < count:
                rows = min(size(), count - start)
                start += rows
                last = start == count
                yield {key: member.read(rows, last) for key, member in members.items()}

    @contextmanager
    def _open(self) -> Iterator[zipfile.ZipFile]:
        try:
            if self.path.exists() and not (self.path.is_file() or self.path.is_dir()):
                raise InputError(f"{self.path}: not a regular file, expected an npz file")
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
        location, names = f"{self.path}: {key}", archive.namelist()
        if f"{key}.npy" not in names:
            member_names = ", ".join(name.removesuffix(".npy") for name in names) or "nothing"
            raise InputError(
                f"{location}: missing, expected {' and '.join(REQUIRED_KEYS)}; found {member_names}"
            )
        try:
            stream = archive.open(f"{key}.npy")
            format_version = np.lib.format.read_magic(stream)
            if format_version == (1, 0):
                shape, column_major, dtype = np.lib.format.read_array_header_1_0(stream)
            elif format_version == (2, 0):
                shape, column_major, dtype = np.lib.format.read_array_header_2_0(stream)
            else:
                raise ValueError("unsupported version of the npy format")
        except (*READ_ERRORS, OSError) as error:
            raise InputError(f"{location}: cannot be read: {error}") from error
        with stream:
            if dtype.kind not in "fiu":
                raise InputError(f"{location}: found values of type {dtype}, expected numbers")
            expected = f"expected (k, {self.fingers}, 3)"
            if len(shape) != 3 or shape[1:] != (self.fingers, 3) or shape[0] < 0:
                raise InputError(f"{location}: found shape {shape}, {expected}")
            if shape[0] == 0:
                raise InputError(f"{location}: found no targets, {expected}")
            info, size = archive.getinfo(f"{key}.npy"), shape[0] * self.fingers * 3 * dtype.itemsize
            # The longest header that numpy reads has 10,064 bytes, magic and padding included.
            if not size <= info.file_size <= size + 10_064:
                comparison = "fewer" if info.file_size < size else "more"
                raise InputError(f"{location}: damaged: {comparison} bytes than its shape requires")
            refuse_zip_bomb(location, info.file_size, info.compress_size)
            yield _Member(location, stream, shape[0], self.fingers, dtype, column_major)


def refuse_zip_bomb(location: str, unpacked: int, packed: int) -> None:
    """Refuse data that unpack to more than 256 MiB and to more than 200 times their size.

    Raises:
        InputError: The data exceed both limits.
    """
    if unpacked > scaled_limit(max(2**28, 200 * packed)):
        raise InputError(
            f"{location}: unpacks to {unpacked >> 20} MiB from {packed} bytes, expected at most "
            f"{scaled_limit(200)} times its size {RAISE_HINT}"
        )


@dataclass
class _Member:
    """An array (k, f, 3) inside a zip file, read sequentially."""

    location: str
    stream: IO[bytes]
    count: int
    fingers: int
    dtype: np.dtype[np.generic]
    column_major: bool
    position: int = 0

    @cached_property
    def _all_rows(self) -> Array:
        """Rows of a column-major array, which are not contiguous in the file."""
        return self._rows(self.count, "F")

    def read(self, rows: int, last: bool) -> Array:
        """Return the next rows; after the last rows, check the end of the file and the checksum."""
        if self.column_major:
            block = self._all_rows[self.position : self.position + rows]
        else:
            block = self._rows(rows, "C")
        self.position += rows
        if last and self._bytes(1):
            raise InputError(f"{self.location}: damaged: more bytes than its shape requires")
        return block

    def _rows(self, rows: int, order: Literal["C", "F"]) -> Array:
        size = rows * self.fingers * 3
        data = self._bytes(size * self.dtype.itemsize)
        if len(data) < size * self.dtype.itemsize:
            raise InputError(f"{self.location}: damaged: fewer bytes than its shape requires")
        shape = (rows, self.fingers, 3)
        values = np.frombuffer(data, self.dtype).reshape(shape, order=order)
        return values.astype(np.float64)

    def _bytes(self, size: int) -> bytes:
        try:
            return self.stream.read(size)
        except (*READ_ERRORS, OSError) as error:
            raise InputError(f"{self.location}: cannot be read: {error}") from error


@dataclass(frozen=True)
class TargetTable:
    """Targets in a Parquet file; null and NaN mark free values.

    Attributes:
        path: Path of the file.
        fingers: Names of the robot's fingers, the prefixes of the columns.
    """

    path: Path
    fingers: tuple[str, ...]

    def rows(self) -> int:
        """Return the number of targets.

        Raises:
            InputError: The file is not a Parquet file, columns are missing or not numeric, or
                there are no rows.
            UnsupportedError: polars is not installed.
        """
        pl, frame = import_polars(), self._scan()
        try:
            schema = frame.collect_schema()
            count = int(frame.select(pl.len()).collect().item())
        except (pl.exceptions.PolarsError, OSError) as error:
            raise InputError(f"{self.path}: not a Parquet file: {error}") from error
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
        """Yield arrays (up to size, f, 3) by name, see `TargetFile.blocks`."""
        pl, frame, count = import_polars(), self._scan(), self.rows()
        start = 0
        while start < count:
            rows = min(size(), count - start)
            block = {}
            for key, names in self._columns().items():
                columns = [pl.col(name).cast(pl.Float64).fill_null(np.nan) for name in names]
                try:
                    table = frame.slice(start, rows).select(columns).collect()
                except (pl.exceptions.PolarsError, OSError) as error:
                    raise InputError(f"{self.path}: damaged: {error}") from error
                block[key] = table.to_numpy().reshape(rows, len(self.fingers), 3)
            yield block
            start += rows

    def _columns(self) -> dict[str, list[str]]:
        return {
            key: [f"{finger}_{ending}" for finger in self.fingers for ending in endings]
            for key, endings in COLUMN_SUFFIXES.items()
        }

    def _scan(self) -> polars.LazyFrame:
        return import_polars().scan_parquet(self.path)


def import_polars() -> Any:
    """Import polars, which reads Parquet files.

    Raises:
        UnsupportedError: polars is not installed.
    """
    try:
        import polars as pl
    except ImportError as error:
        raise UnsupportedError("Parquet files need polars: pip install polars") from error
    return pl


@dataclass(frozen=True, eq=False)
class BatchPart:
    """Targets that are solved together.

    Attributes:
        number: Number of the part, from 0.
        first_row: Number of the first target of the part among all targets.
        arrays: (k, f, 3) arrays by name: points, normals, further vectors.
    """

    number: int
    first_row: int
    arrays: dict[str, Array]


@dataclass(frozen=True, eq=False)
class TargetSource:
    """Targets in files, divided into parts; a part lies within one file.

    Attributes:
        files: The files in order.
        size: Maximum number of targets of a part.
    """

    files: tuple[TargetFile | TargetTable, ...]
    size: int

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of targets of each file.

        Raises:
            InputError: A file does not contain targets of this robot.
        """
        return tuple(file.rows() for file in self.files)

    @property
    def count(self) -> int:
        """Number of all targets."""
        return sum(self.counts)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of targets of each part."""
        return tuple(
            min(self.size, count - start)
            for count in self.counts
            for start in range(0, count, self.size)
        )

    @cached_property
    def first_rows(self) -> tuple[int, ...]:
        """Number of the first target of each part among all targets."""
        return (0, *accumulate(self.sizes))[:-1]

    def remaining_parts(self, done: Container[int]) -> Iterator[BatchPart]:
        """Yield the parts whose numbers are not in `done`, read on demand.

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
        """Name, size and digest of the end of each file, which identify its content.

        The end of a zip file contains the checksums of its members, that of a Parquet file the
        positions and statistics of its columns.
        """
        return [_fingerprint(file.path) for file in self.files]


def open_targets(path: Path, fingers: tuple[str, ...], size: int) -> TargetSource:
    """Return the targets at a path.

    Args:
        path: An npz or Parquet file, or a folder of such files, which are sorted by name.
        fingers: Names of the robot's fingers.
        size: Maximum number of targets of a part.

    Raises:
        InputError: The path contains no such file.
    """
    endings, paths = (".npz", ".parquet"), [path]
    if path.is_dir():
        paths = sorted(file for file in path.iterdir() if file.suffix.lower() in endings)
    if not paths:
        raise InputError(f"{path}: contains no .npz or .parquet file, expected at least one")
    files = (
        TargetTable(file, fingers)
        if file.suffix.lower() == ".parquet"
        else TargetFile(file, len(fingers))
        for file in paths
    )
    return TargetSource(tuple(files), size)


def _fingerprint(path: Path) -> str:
    with os_errors(f"{path}: cannot be read", InputError), path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(size - 2**16, 0))
        digest = hashlib.sha256(file.read()).hexdigest()[:16]
    return f"{path.name} {size} {digest}"
