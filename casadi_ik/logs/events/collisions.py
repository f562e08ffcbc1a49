"""Finds in traces where a robot comes to touch something, and where it is free again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.logs.events.kinds import EventKind
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.events.traces import Rows, Traces
from casadi_ik.problem.trace import CLEARANCE

ROUNDING = 1e-7
"""What a clearance may be below the margin [m]: it is kept in single precision."""


def collisions(traces: Traces, rules: EventRules) -> Iterator[tuple[EventKind, Rows, Array]]:
    """Where the clearance falls below the margin and where it is back above it.

    Before the first row of a solve nothing counts as touched, so a start in collision is an entry.

    Returns:
        Kind, rows (e,), the clearances there (e,).
    """
    clearance = traces.column(CLEARANCE)
    touching = clearance < rules.clearance - ROUNDING
    before = np.empty_like(touching)
    before[1:] = touching[:-1]
    before[traces.firsts] = False
    for kind, there in (
        (EventKind.COLLISION_ENTERED, touching & ~before),
        (EventKind.COLLISION_LEFT, ~touching & before),
    ):
        row = np.flatnonzero(there)
        yield kind, row, clearance[row].astype(float)
