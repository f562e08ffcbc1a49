"""Named fields over a flat vector: one description for the graph, the loop and the log.

A step graph works on flat vectors of doubles. A `Layout` names the pieces of such a vector, packs
and unpacks them (symbols as well as numbers), and gives the numpy record type in which the loop
stores a row, which is byte for byte the row's CDR payload in the log.
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
"""How a field may be stored in a record, widest first."""


@dataclass(frozen=True)
class Field:
    """One named piece of a vector.

    Attributes:
        name: Identifier, also the column name in the log.
        shape: () for a scalar; arrays are stored row by row.
        dtype: Storage in a record, one of `STORAGE`; the vector itself always holds doubles.
        unit: SI unit, "" if dimensionless.
        doc: What it is, one line.
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
        fields: The fields in the order of the vector. For a record the order is by falling width
            (8, 4, 1 bytes), so that the packed row needs no padding; `Layout.record` sorts.
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
        """A layout whose fields are sorted by falling storage width (stable)."""
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
        """Where the field lies in the vector.

        Raises:
            InputError: No such field.
        """
        try:
            return self._slices[name]
        except KeyError:
            raise InputError(f"layout: no field {name!r}; known: {', '.join(self.names)}") from None

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The packed numpy record type of one row (little endian, no padding)."""
        return np.dtype([(item.name, "<" + item.dtype, item.shape) for item in self.fields])

    def symbols(self, name: str) -> ca.SX:
        """A dense symbolic vector of this layout, shape (size, 1)."""
        return ca.SX.sym(name, self.size)

    def pack(self, values: Mapping[str, Any]) -> Any:
        """Lay values out as a dense vector; symbols give a CasADi vector, numbers an array.

        Args:
            values: One value per field, no more and no fewer, each of the field's shape
                (matrices as CasADi or numpy objects).

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
        """Lay numbers out as the vectors of several solves.

        Args:
            values: One value per field, no more and no fewer: of the field's shape (or a number)
                for all solves, or with a leading dimension of `count` for one each.
            count: How many solves.

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
        """The fields of a vector by name: the inverse of `pack`.

        Args:
            vector: CasADi vector (size, 1), or array (..., size).

        Returns:
            Scalars and vectors as they are; a 2-D field as a matrix of its shape. Arrays keep
            their leading dimensions.
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
    """Convert record vectors and write them into rows.

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
    """Rows (k,) as indivisible bytes: numpy copies these at once, records field by field."""
    return np.ascontiguousarray(rows).view(np.dtype((np.void, rows.dtype.itemsize)))


def split_rows(rows: NDArray[Any], counts: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
    """Views of the rows (sum of counts,) of each solve, by how many each of them has (k,)."""
    ends = np.cumsum(counts)
    pairs = zip((ends - counts).tolist(), ends.tolist(), strict=True)
    return tuple(rows[start:end] for start, end in pairs)


def row_driver(layout: Layout) -> str:
    """C text that defines N_RECORD, ROW_BYTES and `store_row(record, row)` for a layout."""
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
