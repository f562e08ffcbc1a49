"""Finds in traces where actuated coordinates come to their limits and leave them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.logs.events.kinds import EventKind
from casadi_ik.logs.events.traces import Rows, Traces, places_of
from casadi_ik.problem.trace import LIMIT_MASK, Q


@dataclass(frozen=True, eq=False)
class LimitChanges:
    """Bits of ``limit_mask`` that come or go.

    Attributes:
        row: (e,) where.
        bit: (e,) which coordinate.
        value: (e,) the coordinate there; NaN if the trace has none.
        limit: (e,) the coordinate when last on the limit.
    """

    row: Rows
    bit: Rows
    value: Array
    limit: Array

    @classmethod
    def at(cls, traces: Traces, row: Rows, bit: Rows, last: Rows) -> Self:
        """Those at rows and bits (e,) that were last on the limit in other rows (e,)."""
        value = _q(traces, row, bit)
        return cls(row, bit, value, value if last is row else _q(traces, last, bit))

    def corrected(self, wrong: Bools, right: Self) -> Self:
        """These without the wrong ones (e,), and others instead."""
        pairs = [(getattr(self, f.name), getattr(right, f.name)) for f in fields(self)]
        return type(self)(*(np.concatenate([mine[~wrong], more]) for mine, more in pairs))


def limit_changes(traces: Traces, slack: float) -> Iterator[tuple[EventKind, LimitChanges]]:
    """Where bits come (LIMIT_HIT) and where they go (LIMIT_LEFT).

    Before the first row of a solve no bit counts as set, so a start on a limit is a hit. A bit
    that goes while the coordinate stays within `slack` of where it was is no leaving.
    """
    mask = traces.mask(LIMIT_MASK.name)
    before = traces.before(mask, 0)
    row, bit = places_of(mask & ~before)
    hit = LimitChanges.at(traces, row, bit, row)
    row, bit = places_of(before & ~mask)
    left = LimitChanges.at(traces, row, bit, row - 1)
    flickers = np.abs(left.value - left.limit) <= slack
    if flickers.any():
        bits = 32 * mask.shape[1]
        of_hit, of_left = (traces.solve[found.row] * bits + found.bit for found in (hit, left))
        unsure = np.zeros(len(traces.counts) * bits, dtype=bool)
        unsure[of_left[flickers]] = True
        hits, lefts = _follow(traces, *np.divmod(np.flatnonzero(unsure), bits), slack)
        hit = hit.corrected(unsure[of_hit], hits)
        left = left.corrected(unsure[of_left], lefts)
    yield EventKind.LIMIT_HIT, hit
    yield EventKind.LIMIT_LEFT, left


def _follow(
    traces: Traces, solve: Rows, bit: Rows, slack: float
) -> tuple[LimitChanges, LimitChanges]:
    """Hits and leavings of coordinates whose bits flicker, through their whole solves.

    Args:
        traces: All solves.
        solve: (p,) the solves.
        bit: (p,) a coordinate for each.
        slack: As in `limit_changes`.
    """
    counts = traces.counts[solve]
    ends = np.cumsum(counts)
    place = np.arange(ends[-1])
    start = np.repeat(ends - counts, counts)
    row = place - start + np.repeat(traces.starts[solve], counts)
    bits = np.repeat(bit, counts)
    words = traces.matrix(LIMIT_MASK.name)[row, bits // 32]
    on = (words >> (bits % 32).astype(np.uint32)) & np.uint32(1) > 0
    last = row[np.maximum.accumulate(np.where(on, place, start))]
    away = ~on & ~(np.abs(_q(traces, row, bits) - _q(traces, last, bits)) <= slack)
    decided = np.flatnonzero(on | away)
    before = np.concatenate([[False], on[decided][:-1]])
    before &= np.concatenate([[-1], start[decided][:-1]]) == start[decided]
    hit, left = decided[on[decided] & ~before], decided[~on[decided] & before]
    return (
        LimitChanges.at(traces, row[hit], bits[hit], last[hit]),
        LimitChanges.at(traces, row[left], bits[left], last[left]),
    )


def _q(traces: Traces, row: Rows, bit: Rows) -> Array:
    """Coordinates (e,); NaN where the trace has none."""
    if Q.name not in traces.names:
        return np.full(len(row), np.nan)
    q: NDArray[Any] = traces.matrix(Q.name)
    known = bit < q.shape[1]
    if known.all():
        return q[row, bit]
    values = np.full(len(row), np.nan)
    values[known] = q[row[known], bit[known]]
    return values
