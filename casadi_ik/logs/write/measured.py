"""What a log measures of finished traces, as further fields of their rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.layout import Layout
from casadi_ik.problem.trace import TraceFormat

BLOCK = 2048
"""Rows taken at once: what is made of them stays in the cache."""


def measured_format(form: TraceFormat) -> TraceFormat:
    """The format of rows with what is measured of them.

    Raises:
        InputError: A measured field has the name of one that the method records.
    """
    measures = form.measures
    if measures is None:
        return form
    layout = Layout.record(*form.layout, *measures.fields)
    return replace(form, layout=layout, jacobians={**measures.jacobians, **form.jacobians})


def measured_rows(form: TraceFormat, rows: NDArray[Any]) -> NDArray[Any]:
    """Rows (m,) of a format as rows of its `measured_format`."""
    measures = form.measures
    if measures is None:
        return rows
    dtype = measured_format(form).layout.dtype
    wide = np.empty(len(rows), dtype)
    # The new fields stand together, behind the others of their width: three pieces of bytes.
    added = dtype.itemsize - rows.dtype.itemsize
    places: Any = dtype.fields
    start = min((places[field.name][1] for field in measures.fields), default=0)
    for first in range(0, len(rows), BLOCK):
        block = np.ascontiguousarray(rows[first : first + BLOCK])
        source, target = (
            array.view(np.uint8).reshape(len(block), -1)
            for array in (block, wide[first : first + BLOCK])
        )
        target[:, :start] = source[:, :start]
        target[:, start : start + added] = measures(block).view(np.uint8)
        target[:, start + added :] = source[:, start:]
    return wide
