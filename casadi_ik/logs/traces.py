"""Traces of many solves as arrays: columns, previous rows, bits of masks, and Jacobians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Field
from casadi_ik.files.arrays import Bools, Rows
from casadi_ik.solve.trace import (
    ACTIVE_MASK,
    ANGLE_ERROR,
    CONDITION,
    COST,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    SIGMA,
    WORD_BITS,
    Q,
    TraceFormat,
)

Words = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Traces:
    """Rows of several solves, one solve after another.

    Attributes:
        form: Format of the rows.
        rows: (m,) rows of the layout of the format.
        counts: (k,) number of rows of each solve.
    """

    form: TraceFormat
    rows: NDArray[Any]
    counts: NDArray[np.int64]
    _columns: dict[str, NDArray[Any]] = field(default_factory=dict, init=False)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the fields."""
        return self.form.layout.names

    @cached_property
    def solve(self) -> Rows:
        """(m,) index of the solve of each row, from 0."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @cached_property
    def starts(self) -> Rows:
        """(k,) first row of each solve."""
        return np.cumsum(self.counts) - self.counts

    @cached_property
    def firsts(self) -> Rows:
        """First rows of all solves that have rows."""
        return self.starts[self.counts > 0]

    @cached_property
    def run(self) -> NDArray[np.int32]:
        """(m,) number of the run of rows with the same solve, phase and restart."""
        new = np.zeros(len(self.rows), dtype=bool)
        new[self.firsts] = True
        for name in (PHASE.name, RESTART.name):
            if name in self.names:
                codes = self.column(name)
                new[1:] |= codes[1:] != codes[:-1]
        return np.cumsum(new, dtype=np.int32)

    def matrix(self, name: str) -> NDArray[Any]:
        """Return a view of a field of all rows, (m, size)."""
        return as_matrix(self.rows[name])

    def column(self, name: str, column: int = 0) -> NDArray[Any]:
        """Return a contiguous column of a field of all rows, (m,)."""
        key = f"{name}.{column}"
        if key not in self._columns:
            self._columns[key] = np.ascontiguousarray(self.matrix(name)[:, column])
        return self._columns[key]

    def columns(self, name: str) -> NDArray[Any]:
        """Return a field of all rows as (size, m), which is faster to process by column."""
        return self.matrix(name).T.copy(order="C")

    def previous(self, values: NDArray[Any], start: ArrayLike) -> NDArray[Any]:
        """Return the values (m, ...) of the previous rows, and `start` in first rows of solves."""
        previous = np.empty_like(values)
        previous[1:] = values[:-1]
        previous[self.firsts] = start
        return previous

    def longer_than(self, window: int) -> tuple[Self, Rows]:
        """Return the solves with more rows than a window, and the indices of their rows."""
        is_long = self.counts > window
        indices = np.flatnonzero(np.repeat(is_long, self.counts))
        if is_long.all():
            return self, indices
        rows = np.take(self.rows, indices)
        return replace(self, rows=rows, counts=self.counts[is_long]), indices

    def words(self, joints: Bools) -> Words:
        """Pack flags of actuators (e, n) into words (e, words) of a mask."""
        padded = np.zeros((len(joints), 32 * mask_words(self.form)), dtype=bool)
        padded[:, : joints.shape[1]] = joints
        return words_of(padded)

    def positions(self, row: Rows, bit: Rows) -> NDArray[Any]:
        """Return actuator positions (e,); NaN if the trace has none."""
        values = np.full(len(row), np.nan)
        if Q.name in self.names:
            q = self.matrix(Q.name)
            has_position = bit < q.shape[1]
            values[has_position] = q[row[has_position], bit[has_position]]
        return values

    def errors(self) -> list[NDArray[Any]]:
        """Return the errors that a solve minimises, (columns, m) per unit, 0 for free columns."""
        fields = (COST,) if COST.name in self.names else (POSITION_ERROR, ANGLE_ERROR)
        groups = []
        for name in (item.name for item in fields if item.name in self.names and len(self.rows)):
            errors = np.abs(self.columns(name))
            is_missing = np.isnan(errors)
            if is_missing.any():
                is_free = np.logical_and.reduceat(is_missing, self.starts, axis=1)
                errors[np.repeat(is_free, self.counts, axis=1)] = 0
            groups.append(errors)
        return groups

    def same_run(self, window: int) -> Bools:
        """Return True for rows whose last `window` steps have one phase and restart."""
        return self.run[window:] == self.run[:-window]


def jacobian_names(form: TraceFormat) -> tuple[str, ...]:
    """Return the names of the measured Jacobians, one per element of their fields."""
    names = (name for item in form.layout for name in measured_jacobians(form, item))
    return tuple(dict.fromkeys(names))


def measured_jacobians(form: TraceFormat, item: Field) -> tuple[str, ...]:
    """Return the names of the Jacobians of a field of measurements; () for other fields."""
    name = item.name.removeprefix(SIGMA).removeprefix(CONDITION)
    if name == item.name:
        return ()
    labels = form.labels.get(item.name, ())
    parts = (*labels[: item.size], *map(str, range(len(labels), item.size)))
    return tuple(f"{name}[{part}]" for part in parts) if item.shape else (name,)


def mask_words(form: TraceFormat) -> int:
    """Return the number of 32-bit words of a mask of all actuators."""
    sizes = {item.name: item.size for item in form.layout}
    coordinates = -(-sizes.get(Q.name, 1) // WORD_BITS)
    masks = (sizes.get(mask.name, 1) for mask in (LIMIT_MASK, ACTIVE_MASK))
    return max(coordinates, *masks)


def actuator_names(form: TraceFormat) -> tuple[str, ...]:
    """Return the names of the actuators, or () if the format does not have them."""
    return form.labels.get(Q.name) or form.labels.get(LIMIT_MASK.name, ())


def as_matrix(values: NDArray[Any]) -> NDArray[Any]:
    """Return values (k, ...) as a matrix (k, size)."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def bits_of(mask: NDArray[Any]) -> Bools:
    """Unpack unsigned words (m, words) to bits (m, 8 * bytes), least significant bit first."""
    octets = np.ascontiguousarray(mask).view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little").astype(bool)


def words_of(bits: Bools) -> Words:
    """Pack bits into 32-bit words; the inverse of `bits_of`."""
    return np.packbits(bits, axis=1, bitorder="little").view("<u4")


def set_bits(words: NDArray[Any]) -> tuple[Rows, Rows]:
    """Return row and bit, both (e,), of every bit that is set in words (m, words)."""
    flat = words.reshape(-1)
    nonzero = np.flatnonzero(flat)
    index, bit = np.nonzero(bits_of(flat[nonzero][:, None]))
    row, word = np.divmod(nonzero[index], words.shape[1])
    return row, word * 32 + bit
