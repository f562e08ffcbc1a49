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
    bits, bits_before = bits_of(mask[changed]), bits_of(before[changed])
    hit, left = _places(changed, bits & ~bits_before, 0), _places(changed, bits_before & ~bits, 1)
    flickers = (
        np.abs(_q(traces, left[:, 0], left[:, 1]) - _q(traces, left[:, 2], left[:, 1])) <= slack
    )
    if flickers.any():
        key = traces.solve[left[:, 0]] * bits.shape[1] + left[:, 1]
        unsure = np.unique(key[flickers])
        hit = hit[~np.isin(traces.solve[hit[:, 0]] * bits.shape[1] + hit[:, 1], unsure)]
        left = left[~np.isin(key, unsure)]
        followed = [_follow(traces, *divmod(int(pair), bits.shape[1]), slack) for pair in unsure]
        hit = np.concatenate([hit, *(hits for hits, _ in followed)])
        left = np.concatenate([left, *(lefts for _, lefts in followed)])
    for kind, places in ((EventKind.LIMIT_HIT, hit), (EventKind.LIMIT_LEFT, left)):
        row, bit, last = places.T
        yield kind, LimitChanges(row, bit, _q(traces, row, bit), _q(traces, last, bit))


def _places(changed: Rows, bits: Bools, back: int) -> Rows:
    """(e, 3): row, bit, and the row `back` before, of every bit (changed, bits) that is set."""
    which, bit = np.nonzero(bits)
    row = changed[which]
    return np.stack([row, bit, row - back], axis=1)


def _follow(traces: Traces, solve: int, bit: int, slack: float) -> tuple[Rows, Rows]:
    """Hits and leavings (e, 3) of a coordinate whose bit flickers, through a whole solve."""
    start = int(traces.starts[solve])
    rows = np.arange(start, start + int(traces.counts[solve]))
    word, shift = divmod(bit, 32)
    on = (traces.matrix("limit_mask")[rows, word] >> np.uint32(shift)) & np.uint32(1) > 0
    last = np.maximum.accumulate(np.where(on, rows, start))
    bits = np.full(len(rows), bit)
    away = ~on & ~(np.abs(_q(traces, rows, bits) - _q(traces, last, bits)) <= slack)
    decided = np.flatnonzero(on | away)
    before = np.concatenate([[False], on[decided][:-1]])
    places = np.stack([rows, bits, last], axis=1)
    return places[decided[on[decided] & ~before]], places[decided[~on[decided] & before]]


def _q(traces: Traces, row: Rows, bit: Rows) -> NDArray[np.float64]:
    """Coordinates (e,); NaN where the trace has none."""
    values = np.full(len(row), np.nan)
    if "q" in traces.names:
        q: NDArray[Any] = traces.matrix("q")
        known = bit < q.shape[1]
        values[known] = q[row[known], bit[known]]
    return values
