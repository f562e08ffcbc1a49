"""Reader of tables of grasps: CSV, npz and Parquet files with named columns."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import check_unpacked_size, read_npz
from casadi_ik.integrations.datasets.postures import HandPoses, rotations_from_rpy
from casadi_ik.solve.target_files import import_polars

POSITION_COLUMNS = ("x", "y", "z")
QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
ANGLE_COLUMNS = ("roll", "pitch", "yaw")

TABLE_SUFFIXES = (".csv", ".npz", ".parquet")

IGNORED_COLUMNS = (
    "index",
    "id",
    "name",
    "object",
    "label",
    "score",
    "quality",
    "confidence",
    "success",
)
"""Columns of a table that are ignored, regardless of case."""


def _is_ignored(column: str) -> bool:
    """Return whether a column is a note on a grasp, or the index that pandas writes."""
    column = column.strip().lower()
    return column in ("", *IGNORED_COLUMNS) or column.startswith(("unnamed:", "__index_level_"))


def read_table(path: Path) -> HandPoses:
    """Read a table of grasps: x y z [m], qw qx qy qz or roll pitch yaw [rad], joints by name.

    Raises:
        DescriptionError: The table is damaged, or columns are missing or not numeric.
        UnsupportedError: The file is Parquet, and polars is not installed.
    """
    readers: Mapping[str, Callable[[Path], Mapping[str, Array]]]
    readers = dict(
        zip(map(str, TABLE_SUFFIXES), (_read_csv, _read_npz_table, _read_parquet), strict=True)
    )
    with os_errors(f"{path}: cannot be read", DescriptionError):
        if path.suffix.lower() == ".csv":
            check_unpacked_size(str(path), path.stat().st_size, LIMITS.table_bytes)
        columns = readers[path.suffix.lower()](path)
    rotation_columns = QUATERNION_COLUMNS if QUATERNION_COLUMNS[0] in columns else ANGLE_COLUMNS
    for name in (*POSITION_COLUMNS, *rotation_columns):
        if name not in columns:
            raise DescriptionError(
                f"{path}: {name}: missing, expected columns x y z, qw qx qy qz or roll pitch yaw, "
                f"and joints; found {', '.join(columns)}"
            )
    names = tuple(name for name in columns if name not in (*POSITION_COLUMNS, *rotation_columns))
    count = len(columns[POSITION_COLUMNS[0]])

    def block(column_names: tuple[str, ...]) -> Array:
        """Return columns as a matrix (k, number of names)."""
        return (
            np.stack([columns[name] for name in column_names], axis=1)
            if column_names
            else np.zeros((count, 0))
        )

    rotate = (
        rotations_from_quaternions if rotation_columns is QUATERNION_COLUMNS else rotations_from_rpy
    )
    return HandPoses(
        str(path), block(POSITION_COLUMNS), rotate(block(rotation_columns)), block(names), names
    )


def _read_csv(path: Path) -> dict[str, Array]:
    """Return the columns of a CSV file by name; empty cells are NaN."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            names, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path}: not a CSV file: {error}") from error
    columns = {j: name.strip() for j, name in enumerate(names) if not _is_ignored(name)}
    if len(set(columns.values())) < len(columns):
        raise DescriptionError(f"{path}: found columns of the same name")
    values = {name: np.full(len(rows), np.nan) for name in columns.values()}
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise DescriptionError(
                f"{path}: row {i}: found {len(row)} values, expected {len(names)}"
            )
        for j, name in columns.items():
            try:
                # An empty cell is a missing number, which makes the row invalid.
                values[name][i] = float(row[j].strip() or "nan")
            except ValueError:
                raise DescriptionError(
                    f"{path}: row {i}: {name}: found {row[j]!r}, expected a number"
                ) from None
    return values


def _read_npz_table(path: Path) -> dict[str, Array]:
    """Return the columns of an npz file by name."""
    columns: dict[str, Array] = {}
    for name, array in read_npz(path, LIMITS.table_bytes).items():
        if _is_ignored(name):
            continue
        if array.ndim != 1:
            raise DescriptionError(
                f"{path}: {name}: found shape {array.shape}, expected a column of numbers"
            )
        columns[name] = array
    if len({len(column) for column in columns.values()}) > 1:
        raise DescriptionError(f"{path}: found columns of different lengths")
    return columns


def _read_parquet(path: Path) -> Mapping[str, Array]:
    """Return the columns of a Parquet file by name; missing values are NaN."""
    pl = import_polars()
    try:
        scanned = pl.scan_parquet(path)
        names = [name for name in scanned.collect_schema().names() if not _is_ignored(name)]
        scanned = scanned.select(names)
        schema = scanned.collect_schema()
        for name, kind in schema.items():
            if not kind.is_numeric():
                raise DescriptionError(
                    f"{path}: {name}: found values of type {kind}, expected numbers"
                )
        count = int(scanned.select(pl.len()).collect().item())
        check_unpacked_size(str(path), 8 * len(schema) * count, LIMITS.table_bytes)
        frame = scanned.select(pl.all().cast(pl.Float64).fill_null(np.nan)).collect()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise DescriptionError(f"{path}: not a Parquet file: {error}") from error
    return {name: frame[name].to_numpy() for name in frame.columns}
