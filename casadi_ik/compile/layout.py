"""Named fields of a flat vector: one description for the graph, the loop and the log.

A step graph works on flat vectors of doubles. A `Layout` names the fields of such a vector, packs
and unpacks symbols and numbers, and defines the NumPy record type in which the loop stores a row,
which is byte for byte the CDR payload of the row in the log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.codegen import define, driver_text
from casadi_ik.errors import InputError

STORAGE = ("f8", "f4", "u4", "i4", "u1")
"""Storage types of a field in a record, widest first."""


@dataclass(frozen=True)
class Field:
    """A named field of a vector.

    Attributes:
        name: Identifier, also the column name in the log.
        shape: () for a scalar; arrays are stored row by row.
        dtype: Storage in a record, one of `STORAGE`; the vector itself always holds doubles.
        unit: SI unit, "" if dimensionless.
        doc: Description in one line.
    """

    name: str
    shape: tuple[int, ...] = ()
    dtype: str = "f8"
    unit: str = ""
    doc: str = ""

    @property
    def size(self) -> int:
        """Number of doubles in the vector."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class Layout:
    """An ordered set of fields.

    Attributes:
        fields: Fields in the order of the vector. The fields of a record are sorted by decreasing
            width (8, 4, 1 bytes), so that a packed row needs no padding; see `Layout.record`.
    """

    fields: tuple[Field, ...]
    _slices: dict[str, slice] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        slices: dict[str, slice] = {}
        offset = 0
        for item in self.fields:
            if item.name in slices:
                raise InputError(f"layout: field {item.name!r} appears twice")
            if item.dtype not in STORAGE:
                raise InputError(
                    f"layout: field {item.name!r} has dtype {item.dtype!r}, "
                    f"expected one of {STORAGE}"
                )
            slices[item.name] = slice(offset, offset + item.size)
            offset += item.size
        object.__setattr__(self, "_slices", slices)

    @classmethod
    def record(cls, *fields: Field) -> Layout:
        """Return a layout whose fields are sorted by decreasing storage width (stable)."""
        return cls(tuple(sorted(fields, key=lambda item: -np.dtype(item.dtype).itemsize)))

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return sum(item.size for item in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """Field names in order."""
        return tuple(item.name for item in self.fields)

    def __iter__(self) -> Iterator[Field]:
        return iter(self.fields)

    def slice(self, name: str) -> slice:
        """Return the slice of a field in the vector.

        Raises:
            InputError: There is no such field.
        """
        try:
            return self._slices[name]
        except KeyError:
            raise InputError(f"layout: no field {name!r}; known: {', '.join(self.names)}") from None

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Packed NumPy record type of a row (little endian, without padding)."""
        return np.dtype([(item.name, "<" + item.dtype, item.shape) for item in self.fields])

    def symbols(self, name: str) -> ca.SX:
        """Return a dense symbolic vector of this layout, shape (size, 1)."""
        return ca.SX.sym(name, self.size)

    def pack(self, values: Mapping[str, Any]) -> Any:
        """Pack values into a dense vector: a CasADi vector for symbols, an array for numbers.

        Args:
            values: One value for each field, of its shape (CasADi or NumPy objects).

        Raises:
            InputError: A field is missing, unknown or of the wrong size.
        """
        self._check_names(values)
        symbolic = any(isinstance(value, (ca.SX, ca.MX)) for value in values.values())
        parts: list[Any] = []
        for item in self.fields:
            value = values[item.name]
            if symbolic and isinstance(value, (ca.SX, ca.MX)):
                count = value.numel()
                part = ca.densify(ca.vec(value.T))
            else:
                array = np.asarray(value, dtype=float)
                count = array.size
                part = array.reshape(-1)
            if count != item.size:
                raise InputError(
                    f"layout: field {item.name!r} has {count} numbers, expected {item.size}"
                )
            parts.append(part)
        return ca.vertcat(*parts) if symbolic else np.concatenate(parts) if parts else np.zeros(0)

    def pack_rows(self, values: Mapping[str, Any], count: int) -> NDArray[np.float64]:
        """Pack numbers into the vectors of several solves.

        Args:
            values: One value for each field: of its shape (or a number) for all solves, or with a
                leading dimension of length `count`.
            count: Number of solves.

        Returns:
            (count, size).

        Raises:
            InputError: A field is missing, unknown or of the wrong shape.
        """
        self._check_names(values)
        vectors = np.empty((count, self.size))
        for item in self.fields:
            value = np.asarray(values[item.name], dtype=float)
            expected = () if value.ndim == 0 else item.shape
            if value.ndim == len(item.shape) + 1:
                expected = (count, *item.shape)
            if value.shape != expected:
                raise InputError(
                    f"layout: field {item.name!r} has shape {value.shape}, expected {item.shape} "
                    f"or {(count, *item.shape)}"
                )
            target = vectors[:, self._slices[item.name]]
            one_each = len(expected) > len(item.shape)
            target[...] = value.reshape(count, item.size) if one_each else value.reshape(-1)
        return vectors

    def _check_names(self, values: Mapping[str, Any]) -> None:
        extra = set(values) - set(self.names)
        missing = set(self.names) - set(values)
        if extra or missing:
            raise InputError(f"layout: missing {sorted(missing)}, unknown {sorted(extra)}")

    def unpack(self, vector: Any) -> dict[str, Any]:
        """Return the fields of a vector by name, the inverse of `pack`.

        Args:
            vector: CasADi vector (size, 1), or array (..., size).

        Returns:
            Fields of their shapes; arrays keep their leading dimensions.
        """
        result: dict[str, Any] = {}
        for item in self.fields:
            if isinstance(vector, np.ndarray):
                part = vector[..., self._slices[item.name]]
                result[item.name] = part.reshape((*vector.shape[:-1], *item.shape))
            else:
                part = vector[self._slices[item.name]]
                if len(item.shape) == 2:
                    part = ca.reshape(part, item.shape[1], item.shape[0]).T
                result[item.name] = part
        return result


def store_rows(layout: Layout, vectors: NDArray[np.float64], rows: NDArray[Any]) -> None:
    """Convert record vectors to rows.

    Args:
        layout: Layout of the record.
        vectors: Shape (m, layout.size).
        rows: Shape (m,) of `layout.dtype`; overwritten.
    """
    for name, values in layout.unpack(vectors).items():
        target = rows[name]
        if target.dtype.kind in "iu":
            info = np.iinfo(target.dtype)
            target[...] = np.clip(np.where(np.isnan(values), 0.0, values), info.min, info.max)
        else:
            with np.errstate(over="ignore"):
                target[...] = values


def opaque(rows: NDArray[Any]) -> NDArray[Any]:
    """View rows (k,) as opaque bytes, which NumPy copies at once instead of field by field."""
    return np.ascontiguousarray(rows).view(np.dtype((np.void, rows.dtype.itemsize)))


def split_rows(rows: NDArray[Any], counts: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
    """Return views of the rows (sum of counts,) of each solve, given the counts (k,)."""
    stops = np.cumsum(counts)
    pairs = zip((stops - counts).tolist(), stops.tolist(), strict=True)
    return tuple(rows[start:end] for start, end in pairs)


def row_driver(layout: Layout) -> str:
    """Return C code that defines N_RECORD, ROW_BYTES and `store_row(record, row)`."""
    offsets: Any = layout.dtype.fields
    lines = [
        f"  store_{item.dtype}(record + {layout.slice(item.name).start}, "
        f"row + {offsets[item.name][1]}, {item.size});\n"
        for item in layout
        if item.size
    ]
    return (
        define({"N_RECORD": layout.size, "ROW_BYTES": layout.dtype.itemsize})
        + driver_text("record")
        + "\nstatic inline void store_row(const double *record, unsigned char *row) {\n"
        + "  (void) record, (void) row;\n"
        + "".join(lines)
        + "}\n\n"
    )
