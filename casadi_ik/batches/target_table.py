"""Targets in a Parquet file: a row each, named columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.batches.target_file import refuse_bombs
from casadi_ik.errors import InputError, UnsupportedError

if TYPE_CHECKING:
    import polars

ENDINGS = {"points": ("x", "y", "z"), "normals": ("nx", "ny", "nz")}
"""Of the columns of a finger: ``thumb_x``, ..., ``thumb_nz``."""


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
        pl, frame = polars_module(), self._scanned()
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
        refuse_bombs(str(self.path), 8 * width * count, self.path.stat().st_size)
        return count

    def blocks(self, size: Callable[[], int]) -> Iterator[dict[str, Array]]:
        """Arrays (up to size, f, 3) by name, one block after the other; as `TargetFile.blocks`."""
        pl, frame, count = polars_module(), self._scanned(), self.rows()
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
            for key, endings in ENDINGS.items()
        }

    def _scanned(self) -> polars.LazyFrame:
        return polars_module().scan_parquet(self.path)


def polars_module() -> Any:
    """The library that reads Parquet.

    Raises:
        UnsupportedError: It is not installed.
    """
    try:
        import polars as pl
    except ImportError as error:
        raise UnsupportedError(
            "Parquet files are read with polars: pip install casadi-ik[dataframes]"
        ) from error
    return pl
