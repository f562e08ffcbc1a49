"""Grasps in tables with named columns: CSV, npz, Parquet."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.batches.target_table import polars_module
from casadi_ik.datasets.hand_poses import HandPoses, of_fixed_axes
from casadi_ik.errors import DescriptionError
from casadi_ik.files.npz import read_npz, refuse_giants
from casadi_ik.grasps.pose import rotations_of

PLACE = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll", "pitch", "yaw")

MOST = 2**26
"""Bytes of a file, and of what is in it."""

SUFFIXES = (".csv", ".npz", ".parquet")


def read_table(path: Path) -> HandPoses:
    """Grasps of a table: x y z [m], qw qx qy qz or roll pitch yaw [rad], then joints by name.

    Raises:
        DescriptionError: It is damaged, columns are missing, or not of numbers.
        UnsupportedError: Parquet, and polars is not installed.
    """
    readers: Mapping[str, Callable[[Path], Mapping[str, Array]]]
    readers = dict(zip(map(str, SUFFIXES), (_of_csv, _of_npz, _of_parquet), strict=True))
    try:
        if path.suffix.lower() == ".csv":
            refuse_giants(str(path), path.stat().st_size, MOST)
        columns = readers[path.suffix.lower()](path)
    except OSError as error:
        raise DescriptionError(f"{path}: cannot be read: {error.strerror or error}") from error
    turned = QUATERNION if QUATERNION[0] in columns else ANGLES
    for name in (*PLACE, *turned):
        if name not in columns:
            raise DescriptionError(
                f"{path}: {name}: missing, expected columns x y z, qw qx qy qz or roll pitch yaw, "
                f"and joints; found {', '.join(columns)}"
            )
    names = tuple(name for name in columns if name not in (*PLACE, *turned))
    count = len(columns[PLACE[0]])

    def block(of: tuple[str, ...]) -> Array:
        return np.stack([columns[name] for name in of], axis=1) if of else np.zeros((count, 0))

    rotate = rotations_of if turned is QUATERNION else of_fixed_axes
    return HandPoses(str(path), block(PLACE), rotate(block(turned)), block(names), names)


def _of_csv(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            names, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path}: no CSV file: {error}") from error
    names = [name.strip() for name in names]
    if len(set(names)) < len(names):
        raise DescriptionError(f"{path}: found columns of the same name")
    values = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise DescriptionError(
                f"{path}: row {i}: found {len(row)} values, expected {len(names)}"
            )
        for j, text in enumerate(row):
            try:
                values[i, j] = float(text)
            except ValueError:
                raise DescriptionError(
                    f"{path}: row {i}: {names[j]}: found {text!r}, expected a number"
                ) from None
    return {name: values[:, j] for j, name in enumerate(names)}


def _of_npz(path: Path) -> dict[str, Array]:
    columns: dict[str, Array] = {}
    for name, array in read_npz(path, MOST).items():
        if array.ndim != 1:
            raise DescriptionError(
                f"{path}: {name}: found shape {array.shape}, expected a column of numbers"
            )
        columns[name] = array
    if len({len(column) for column in columns.values()}) > 1:
        raise DescriptionError(f"{path}: found columns of different lengths")
    return columns


def _of_parquet(path: Path) -> Mapping[str, Array]:
    pl = polars_module()
    try:
        scanned = pl.scan_parquet(path)
        schema = scanned.collect_schema()
        for name, kind in schema.items():
            if not kind.is_numeric():
                raise DescriptionError(
                    f"{path}: {name}: found values of type {kind}, expected numbers"
                )
        count = int(scanned.select(pl.len()).collect().item())
        refuse_giants(str(path), 8 * len(schema) * count, MOST)
        frame = scanned.select(pl.all().cast(pl.Float64).fill_null(np.nan)).collect()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise DescriptionError(f"{path}: no Parquet file: {error}") from error
    return {name: frame[name].to_numpy() for name in frame.columns}
