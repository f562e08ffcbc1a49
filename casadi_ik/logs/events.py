"""Finds in a trace what is worth a line of its own, going by the names of the fields.

======================  ============================================================
field                   events
======================  ============================================================
``phase``               PHASE_CHANGE
``restart``             RESTART (a counter)
``limit_mask``          LIMIT_HIT, LIMIT_LEFT (one bit per actuated coordinate)
``active_mask``         ACTIVE_SET (one bit per constraint)
``sigma_<jacobian>``    NEAR_SINGULAR (smallest singular value; NaN while not computed)
``cost``, or else       STALL, and the progress that OSCILLATION asks for
``position_error`` and
``angle_error``
``q``                   OSCILLATION
======================  ============================================================

Fields that a layout does not have give no events.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.kernels.layout import Layout
from casadi_ik.logs.columns import (
    Labels,
    Rows,
    bits_of,
    changes,
    columns,
    entries,
    label_of,
    name_of,
    settled,
)
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.standstill import oscillations, stalls
from casadi_ik.solvers.recorder import Event, EventKind


def detect_events(
    layout: Layout,
    trace: Rows,
    labels: Labels | None = None,
    rules: EventRules | None = None,
) -> tuple[Event, ...]:
    """All events of one solve, by iteration.

    Args:
        layout: Fields of a row.
        trace: The rows of one solve in order, (k,) of `layout.dtype`.
        labels: Names of phases, mask bits and elements, as in `SolveRecord.labels`.
        rules: When something counts as an event.
    """
    if len(trace) == 0:
        return ()
    labels, rules = labels or {}, rules or EventRules()
    with np.errstate(invalid="ignore"):
        found = [
            *phase_changes(layout, trace, labels),
            *limit_events(layout, trace, labels, rules),
            *active_set_changes(layout, trace, labels),
            *near_singular(layout, trace, labels, rules),
            *stalls(layout, trace, labels, rules),
            *oscillations(layout, trace, labels, rules),
        ]
    return tuple(sorted(found, key=lambda event: (event.iteration, event.kind)))


def phase_changes(layout: Layout, trace: Rows, labels: Labels) -> list[Event]:
    """Where ``phase`` or ``restart`` differs from the row before; the first row is no change."""
    events: list[Event] = []
    for name, kind in (("phase", EventKind.PHASE_CHANGE), ("restart", EventKind.RESTART)):
        if name not in layout.names:
            continue
        codes = trace[name].astype(int)
        for i in np.flatnonzero(np.diff(codes)) + 1:
            before, after = int(codes[i - 1]), int(codes[i])
            subject = f"{label_of(labels, name, before)} -> {label_of(labels, name, after)}"
            events.append(Event(int(i), kind, subject, float(after), float(before)))
    return events


def limit_events(layout: Layout, trace: Rows, labels: Labels, rules: EventRules) -> list[Event]:
    """Bits of ``limit_mask`` that come (LIMIT_HIT) or go (LIMIT_LEFT).

    Before the first row no bit counts as set, so a start on a limit is a hit. A bit that goes
    while the coordinate stays within `EventRules.limit_slack` of where it was is no leaving. The
    value is the coordinate in that row, the threshold the coordinate when last on the limit.
    """
    if "limit_mask" not in layout.names:
        return []
    bits = bits_of(trace["limit_mask"])
    names = labels.get("limit_mask") or labels.get("q", ())
    q = np.full(bits.shape, np.nan)
    if "q" in layout.names:
        found = columns(trace["q"])[:, : bits.shape[1]]
        q[:, : found.shape[1]] = found
    rows = np.arange(len(bits))[:, None]
    last = np.maximum.accumulate(np.where(bits, rows, 0), axis=0)
    limit = np.take_along_axis(q, last, axis=0)
    left = ~bits & ~(np.abs(q - limit) <= rules.limit_slack)
    return [
        Event(
            i,
            EventKind.LIMIT_HIT if sign > 0 else EventKind.LIMIT_LEFT,
            name_of(names, bit, "coordinate"),
            float(q[i, bit]),
            float(limit[i, bit]),
        )
        for i, bit, sign in changes(settled(bits, left))
    ]


def active_set_changes(layout: Layout, trace: Rows, labels: Labels) -> list[Event]:
    """Rows whose ``active_mask`` differs from the row before, with what came (+) and went (-).

    The value is the number of active constraints, the threshold the number before.
    """
    if "active_mask" not in layout.names:
        return []
    bits = bits_of(trace["active_mask"])
    names = labels.get("active_mask") or labels.get("q", ())
    change = np.diff(bits.astype(np.int8), axis=0)
    events: list[Event] = []
    for i in np.flatnonzero(change.any(axis=1)).tolist():
        subject = ", ".join(
            f"{'+' if change[i, bit] > 0 else '-'}{name_of(names, bit, 'constraint')}"
            for bit in np.flatnonzero(change[i]).tolist()
        )
        count, before = float(bits[i + 1].sum()), float(bits[i].sum())
        events.append(Event(i + 1, EventKind.ACTIVE_SET, subject, count, before))
    return events


def near_singular(layout: Layout, trace: Rows, labels: Labels, rules: EventRules) -> list[Event]:
    """Where a ``sigma_<jacobian>`` falls below its threshold; the entry only.

    It may enter again once it was above `EventRules.singular_release` times the threshold, or
    was not computed (NaN) in between.
    """
    events: list[Event] = []
    for item in layout:
        if not item.name.startswith("sigma_"):
            continue
        jacobian = item.name.removeprefix("sigma_")
        threshold = rules.singular.get(jacobian, rules.singular_default)
        sigma = columns(trace[item.name])
        below = sigma < threshold
        released = ~(sigma <= threshold * rules.singular_release)
        for i, column in entries(below, released):
            part = f"[{name_of(labels.get(item.name, ()), column, '')}]" if item.shape else ""
            value = float(sigma[i, column])
            events.append(Event(i, EventKind.NEAR_SINGULAR, jacobian + part, value, threshold))
    return events
