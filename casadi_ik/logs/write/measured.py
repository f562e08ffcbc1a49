"""What a log measures of finished traces, as further fields of their rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.recorder import SolveBlock
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.problem.trace import CLEARANCE, TraceFormat

BLOCK = 2048
"""Rows taken at once: what is made of them stays in the cache."""

CLEAR = Field(
    CLEARANCE,
    (),
    "f4",
    "m",
    "of the pair nearest to being too near; what one has to keep beyond the margin is taken off",
)
"""What is added to a row where there is a scene."""


def measured_format(form: TraceFormat, checked: bool = False) -> TraceFormat:
    """The format of rows with what is measured of them.

    Args:
        form: The format of the rows.
        checked: Whether they were checked against a scene.

    Raises:
        InputError: A measured field has the name of one that the method records.
    """
    added, measures = _added(form, checked), form.measures
    if not added:
        return form
    layout = Layout.record(*form.layout, *added)
    known = {} if measures is None else measures.jacobians
    return replace(form, layout=layout, jacobians={**known, **form.jacobians})


def measured_rows(block: SolveBlock) -> NDArray[Any]:
    """Rows (m,) of a block as rows of its `measured_format`."""
    form, rows, checked = block.format, block.rows, block.around is not None
    added = _added(form, checked)
    if not added:
        return rows
    dtype = measured_format(form, checked).layout.dtype
    wide = np.empty(len(rows), dtype)
    # The new fields stand together, behind the others of their width: three pieces of bytes.
    places: Any = dtype.fields
    start = min(places[field.name][1] for field in added)
    end = start + dtype.itemsize - rows.dtype.itemsize
    solve = np.repeat(np.arange(len(block)), block.batch.iterations)
    for first in range(0, len(rows), BLOCK):
        part = np.ascontiguousarray(rows[first : first + BLOCK])
        source, target = (
            array.view(np.uint8).reshape(len(part), -1)
            for array in (part, wide[first : first + BLOCK])
        )
        target[:, :start] = source[:, :start]
        values = _values(block, part, solve[first : first + BLOCK])
        target[:, start:end] = np.ascontiguousarray(values).view(np.uint8)
        target[:, end:] = source[:, start:]
    return wide


def _added(form: TraceFormat, checked: bool) -> tuple[Field, ...]:
    fields = () if form.measures is None else form.measures.fields
    return (*fields, CLEAR) if checked else fields


def _values(block: SolveBlock, rows: NDArray[Any], solve: NDArray[np.intp]) -> NDArray[np.float32]:
    """(m, fields) what is measured of some rows of solves (m,)."""
    measures, around = block.format.measures, block.around
    values = None if measures is None else measures(rows)
    if around is None:
        assert values is not None
        return values
    room = around.rows(solve).check(np.ascontiguousarray(rows["q"])).room
    clear = (room + around.margin).astype(np.float32)[:, None]
    return clear if values is None else np.concatenate([values, clear], axis=1)
