"""Finds in traces where actuated coordinates come to their limits and leave them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.logs.event_kinds import EventKind
from casadi_ik.logs.traces import Bools, Rows, Traces, bits_of


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
    value: NDArray[np.float64]
    limit: NDArray[np.float64]


def limit_changes(traces: Traces, slack: float) -> Iterator[tuple[EventKind, LimitChanges]]:
    """Where bits come (LIMIT_HIT) and where they go (LIMIT_LEFT).

    Before the first row of a solve no bit counts as set, so a start on a limit is a hit. A bit
    that goes while the coordinate stays within `slack` of where it was is no leaving.
    """
    mask = np.ascontiguousarray(traces.matrix("limit_mask"))
    before = np.concatenate([np.zeros_like(mask[:1]), mask[:-1]])
    before[traces.first] = 0
    changed = np.flatnonzero((mask != before).any(axis=1))
    bits_now, bits_before = bits_of(mask[changed]), bits_of(before[changed])
    hit = _places(changed, bits_now & ~bits_before, 0)
    left = _places(changed, bits_before & ~bits_now, 1)
    gone = _q(traces, left[:, 2], left[:, 1]) - _q(traces, left[:, 0], left[:, 1])
    flickers = np.abs(gone) <= slack
    if flickers.any():
        bits = bits_now.shape[1]
        of_hit, of_left = (
            traces.solve[places[:, 0]] * bits + places[:, 1] for places in (hit, left)
        )
        unsure = np.zeros(len(traces.counts) * bits, dtype=bool)
        unsure[of_left[flickers]] = True
        hits, lefts = _follow(traces, *np.divmod(np.flatnonzero(unsure), bits), slack)
        hit = np.concatenate([hit[~unsure[of_hit]], hits])
        left = np.concatenate([left[~unsure[of_left]], lefts])
    for kind, places in ((EventKind.LIMIT_HIT, hit), (EventKind.LIMIT_LEFT, left)):
        row, bit, last = places.T
        yield kind, LimitChanges(row, bit, _q(traces, row, bit), _q(traces, last, bit))


def _places(changed: Rows, bits: Bools, back: int) -> Rows:
    """(e, 3): row, bit, and the row `back` before, of every bit (changed, bits) that is set."""
    which, bit = np.nonzero(bits)
    row = changed[which]
    return np.stack([row, bit, row - back], axis=1)


def _follow(traces: Traces, solve: Rows, bit: Rows, slack: float) -> tuple[Rows, Rows]:
    """Hits and leavings (e, 3) of coordinates whose bits flicker, through their whole solves.

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
    words = traces.matrix("limit_mask")[row, bits // 32]
    on = (words >> (bits % 32).astype(np.uint32)) & np.uint32(1) > 0
    last = row[np.maximum.accumulate(np.where(on, place, start))]
    away = ~on & ~(np.abs(_q(traces, row, bits) - _q(traces, last, bits)) <= slack)
    decided = np.flatnonzero(on | away)
    before = np.concatenate([[False], on[decided][:-1]])
    before &= np.concatenate([[-1], start[decided][:-1]]) == start[decided]
    places = np.stack([row, bits, last], axis=1)
    return places[decided[on[decided] & ~before]], places[decided[~on[decided] & before]]


def _q(traces: Traces, row: Rows, bit: Rows) -> NDArray[np.float64]:
    """Coordinates (e,); NaN where the trace has none."""
    values = np.full(len(row), np.nan)
    if "q" in traces.names:
        q: NDArray[Any] = traces.matrix("q")
        known = bit < q.shape[1]
        values[known] = q[row[known], bit[known]]
    return values
