"""The traces of many solves, one after the other, as the events see them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Bools, Rows
from casadi_ik.problem.trace import PHASE, RESTART, TraceFormat

Words = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Traces:
    """Rows of several solves.

    Attributes:
        form: How to read them.
        rows: (m,) of the format's layout.
        counts: (k,) rows of each solve.
    """

    form: TraceFormat
    rows: NDArray[Any]
    counts: NDArray[np.int64]
    _columns: dict[str, NDArray[Any]] = field(default_factory=dict, init=False)

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Fields there are."""
        return self.form.layout.names

    @cached_property
    def solve(self) -> Rows:
        """(m,) which solve a row belongs to, from 0."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @cached_property
    def starts(self) -> Rows:
        """(k,) first row of each solve."""
        return np.cumsum(self.counts) - self.counts

    @cached_property
    def first(self) -> Bools:
        """(m,) whether a row is the first of its solve."""
        first = np.zeros(len(self.rows), dtype=bool)
        first[self.firsts] = True
        return first

    @cached_property
    def firsts(self) -> Rows:
        """The rows that are the first of their solves."""
        return self.starts[self.counts > 0]

    @cached_property
    def piece(self) -> NDArray[np.int32]:
        """(m,) number of the stretch of one solve, phase and start that a row belongs to."""
        new = self.first.copy()
        for name in (PHASE.name, RESTART.name):
            if name in self.names:
                codes = self.column(name)
                new[1:] |= codes[1:] != codes[:-1]
        return np.cumsum(new, dtype=np.int32)

    def matrix(self, name: str) -> NDArray[Any]:
        """A field of all rows, (m, size); a view."""
        return as_matrix(self.rows[name])

    def column(self, name: str) -> NDArray[Any]:
        """A scalar field of all rows in one piece, (m,)."""
        if name not in self._columns:
            self._columns[name] = np.ascontiguousarray(self.rows[name])
        return self._columns[name]

    def mask(self, name: str) -> Words:
        """A mask of all rows in one piece, (m, words)."""
        return np.ascontiguousarray(self.matrix(name))

    def before(self, mask: Words, start: Words | int) -> Words:
        """A mask in the row before each, (m, words); in the first rows of solves `start`."""
        before = np.empty_like(mask)
        before[1:] = mask[:-1]
        before[self.firsts] = start
        return before

    def columns(self, name: str) -> NDArray[Any]:
        """The same as (size, m), each column in one piece: what is done to it then runs fast."""
        return self.matrix(name).T.copy(order="C")

    def of_solves(self, wanted: Bools) -> Traces:
        """Only some of the solves (k,)."""
        if wanted.all():
            return self
        rows = np.take(self.rows, np.flatnonzero(np.repeat(wanted, self.counts)))
        return Traces(self.form, rows, self.counts[wanted])


def as_matrix(values: NDArray[Any]) -> NDArray[Any]:
    """Values (k, ...) as (k, size)."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def bits_of(mask: NDArray[Any]) -> Bools:
    """The bits of unsigned words (m, words), least significant first, (m, 8 * bytes)."""
    octets = np.ascontiguousarray(mask).view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little").astype(bool)


def words_of(bits: Bools) -> NDArray[np.uint32]:
    """The inverse of `bits_of` for 32-bit words."""
    return np.packbits(bits, axis=1, bitorder="little").view("<u4")


def places_of(words: NDArray[np.uint32]) -> tuple[Rows, Rows]:
    """Row and bit, both (e,), of every bit that is set in 32-bit words (m, words)."""
    flat = words.reshape(-1)
    some = np.flatnonzero(flat)
    place = np.flatnonzero(bits_of(flat[some][:, None]))
    word, bit = some[place >> 5], place & 31
    row, number = np.divmod(word, words.shape[1])
    return row, number * 32 + bit


def entries(traces: Traces, begun: Bools, ended: Bools) -> Rows:
    """Rows where a condition begins to hold.

    It holds from a row where it has begun until one where it has ended; in between nothing
    changes. Before the first row of a solve it does not hold.

    Args:
        traces: Where the solves begin.
        begun: (m,).
        ended: (m,).
    """
    if not begun.any():
        return np.zeros(0, np.intp)
    # Most solves have none: only the others need be looked at row by row.
    concerned = np.zeros(len(traces.counts), dtype=bool)
    concerned[traces.solve[begun]] = True
    decided = np.flatnonzero((begun | ended) & concerned[traces.solve])
    before = np.concatenate([[-1], decided[:-1]])
    fresh = ended[before] | (traces.solve[before] != traces.solve[decided])
    fresh[0] = True
    return decided[begun[decided] & fresh]


def over_window(values: NDArray[Any], window: int, largest: bool) -> NDArray[Any]:
    """Largest or smallest of each `window` columns one after the other, (n, m - window + 1)."""
    pick = np.maximum if largest else np.minimum
    width = 1
    while 2 * width <= window:
        values = pick(values[:, width:], values[:, :-width])
        width *= 2
    rest = window - width
    return pick(values[:, rest:], values[:, :-rest]) if rest else values
