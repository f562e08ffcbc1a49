"""Grasps in tables with named columns: CSV, npz, Parquet."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.batches.target_table import polars_module
from casadi_ik.datasets.hand_poses import HandPoses, of_fixed_axes, of_quaternions
from casadi_ik.errors import DescriptionError

PLACE = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll", "pitch", "yaw")

MOST = 2**26
"""Bytes of a file, or of an array."""

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
        if path.suffix.lower() != ".parquet" and path.stat().st_size > MOST:
            raise DescriptionError(f"{path}: found more than {MOST} bytes")
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

    rotate = of_quaternions if turned is QUATERNION else of_fixed_axes
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
    try:
        with zipfile.ZipFile(path) as members:
            unpacked = sum(member.file_size for member in members.infolist())
        if unpacked > MOST:
            raise DescriptionError(f"{path}: unpacks to {unpacked} bytes, expected {MOST} at most")
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if array.dtype.kind not in "fiu" or array.ndim != 1:
                    raise DescriptionError(
                        f"{path}: {name}: found shape {array.shape} of {array.dtype}, expected "
                        "a column of numbers"
                    )
                columns[name] = array.astype(np.float64)
    except (ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
        raise DescriptionError(f"{path}: damaged: {error}") from error
    if len({len(column) for column in columns.values()}) > 1:
        raise DescriptionError(f"{path}: found columns of different lengths")
    return columns


def _of_parquet(path: Path) -> Mapping[str, Array]:
    pl = polars_module()
    try:
        frame = pl.read_parquet(path)
    except pl.exceptions.PolarsError as error:
        raise DescriptionError(f"{path}: no Parquet file: {error}") from error
    columns: dict[str, Array] = {}
    for name in frame.columns:
        if not frame[name].dtype.is_numeric():
            raise DescriptionError(
                f"{path}: {name}: found values of type {frame[name].dtype}, expected numbers"
            )
        columns[name] = frame[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
    return columns
