"""Record vectors (doubles) into packed rows of a layout, in C and in numpy alike.

Both conversions are defined for every double and agree: f4 rounds to nearest and overflows to
infinity; the integers drop the fraction and saturate, NaN becomes 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.codegen import define, driver_text
from casadi_ik.kernels.layout import Layout


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
