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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Layout
from casadi_ik.solvers.recorder import Event, EventKind

Labels = Mapping[str, tuple[str, ...]]
Rows = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class EventRules:
    """When something counts as an event.

    Attributes:
        singular: Smallest singular value below which a Jacobian is near singular, by the name
            behind ``sigma_``; in the unit of that field.
        singular_default: The same for every Jacobian not named there.
        singular_release: A near-singular Jacobian has to rise above this multiple of its
            threshold before it can enter again.
        stall_window: Iterations over which a stall is judged.
        stall_change: Spread of the error over the window, relative to the error, that counts as
            standing still.
        oscillation_window: Iterations over which an oscillation is judged, at least 3.
        oscillation_step: Shortest step of a coordinate that counts as moving [rad or m].
        oscillation_progress: Relative fall of the error over the window that counts as progress.
    """

    singular: Mapping[str, float] = field(default_factory=dict)
    singular_default: float = 0.01
    singular_release: float = 1.5
    stall_window: int = 10
    stall_change: float = 1e-4
    oscillation_window: int = 6
    oscillation_step: float = 1e-4
    oscillation_progress: float = 0.05

    def __post_init__(self) -> None:
        if self.stall_window < 1 or self.oscillation_window < 3:
            raise InputError(
                f"event rules: windows {self.stall_window} and {self.oscillation_window},"
                " expected at least 1 (stall) and 3 (oscillation)"
            )


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
            *limit_events(layout, trace, labels),
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
            subject = f"{_label(labels, name, before)} -> {_label(labels, name, after)}"
            events.append(Event(int(i), kind, subject, float(after), float(before)))
    return events


def limit_events(layout: Layout, trace: Rows, labels: Labels) -> list[Event]:
    """Bits of ``limit_mask`` that come (LIMIT_HIT) or go (LIMIT_LEFT).

    Before the first row no bit counts as set, so a start on a limit is a hit. The value is the
    coordinate in that row, the threshold the coordinate while on the limit.
    """
    if "limit_mask" not in layout.names:
        return []
    bits = _bits(trace["limit_mask"])
    names = labels.get("limit_mask") or labels.get("q", ())
    q: np.ndarray = _columns(trace["q"]) if "q" in layout.names else np.full(bits.shape, np.nan)
    change = np.diff(np.vstack([np.zeros_like(bits[:1]), bits]).astype(np.int8), axis=0)
    events: list[Event] = []
    for i, bit in np.argwhere(change).tolist():
        hit = change[i, bit] > 0
        kind = EventKind.LIMIT_HIT if hit else EventKind.LIMIT_LEFT
        value, limit = (
            (float(q[i, bit]), float(q[i if hit else i - 1, bit]))
            if bit < q.shape[1]
            else (np.nan, np.nan)
        )
        events.append(Event(i, kind, _name(names, bit, "coordinate"), value, limit))
    return events


def active_set_changes(layout: Layout, trace: Rows, labels: Labels) -> list[Event]:
    """Rows whose ``active_mask`` differs from the row before, with what came (+) and went (-).

    The value is the number of active constraints, the threshold the number before.
    """
    if "active_mask" not in layout.names:
        return []
    bits = _bits(trace["active_mask"])
    names = labels.get("active_mask") or labels.get("q", ())
    change = np.diff(bits.astype(np.int8), axis=0)
    events: list[Event] = []
    for i in np.flatnonzero(change.any(axis=1)).tolist():
        subject = ", ".join(
            f"{'+' if change[i, bit] > 0 else '-'}{_name(names, bit, 'constraint')}"
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
        sigma = _columns(trace[item.name])
        below = sigma < threshold
        released = ~(sigma <= threshold * rules.singular_release)
        for i, column in _entries(below, released):
            part = f"[{_name(labels.get(item.name, ()), column, '')}]" if item.shape else ""
            value = float(sigma[i, column])
            events.append(Event(i, EventKind.NEAR_SINGULAR, jacobian + part, value, threshold))
    return events


def stalls(layout: Layout, trace: Rows, labels: Labels, rules: EventRules) -> list[Event]:
    """Where the error has stood still over the window; the entry only.

    Standing still: over the last `EventRules.stall_window` iterations, none of them in another
    phase or restart, the errors spread by at most `EventRules.stall_change` of the largest of
    them (largest of all fingers, so that a finger in place cannot hide the one that is stuck).
    """
    window = rules.stall_window
    groups = _errors(layout, trace)
    if not groups or len(trace) <= window:
        return []
    spread = np.zeros(len(trace) - window)
    largest = np.zeros(len(trace) - window)
    for errors in groups:
        views = np.lib.stride_tricks.sliding_window_view(errors, window + 1, axis=0)
        top = views.max(axis=(1, 2))
        reach = (views.max(axis=2) - views.min(axis=2)).max(axis=1)
        spread = np.maximum(spread, reach / np.where(top > 0, top, 1))
        largest = np.maximum(largest, top)
    still = (spread <= rules.stall_change) & (largest > 0) & _one_piece(layout, trace, window)
    return [
        Event(
            i + window,
            EventKind.STALL,
            _phase_of(layout, trace, labels, i + window),
            float(spread[i]),
            rules.stall_change,
        )
        for i, _ in _entries(still[:, None], ~still[:, None])
    ]


def oscillations(layout: Layout, trace: Rows, labels: Labels, rules: EventRules) -> list[Event]:
    """Where coordinates go to and fro without progress; the entry only.

    To and fro: every step of the coordinate in the last `EventRules.oscillation_window`
    iterations is longer than `EventRules.oscillation_step` and against the one before. Without
    progress: no error has fallen by more than `EventRules.oscillation_progress` over these
    iterations. The value is the longest step into that row.
    """
    window = rules.oscillation_window
    if "q" not in layout.names or len(trace) <= window:
        return []
    q = _columns(trace["q"])
    steps = q[1:] - q[:-1]
    moving = np.abs(steps) > rules.oscillation_step
    turning = (steps[1:] * steps[:-1] < 0) & moving[1:] & moving[:-1]
    views = np.lib.stride_tricks.sliding_window_view(turning, window - 1, axis=0)
    swinging: np.ndarray = np.all(views, axis=2)
    hopeless = _one_piece(layout, trace, window)
    for errors in _errors(layout, trace):
        norm = np.linalg.norm(errors, axis=1)
        hopeless &= norm[window:] >= (1 - rules.oscillation_progress) * norm[:-window]
    caught: np.ndarray = np.any(swinging & hopeless[:, None], axis=1)
    events: list[Event] = []
    for i, _ in _entries(caught[:, None], ~caught[:, None]):
        joints = np.flatnonzero(swinging[i]).tolist()
        subject = ", ".join(_name(labels.get("q", ()), joint, "coordinate") for joint in joints)
        step = float(np.abs(steps[i + window - 1, joints]).max())
        events.append(
            Event(i + window, EventKind.OSCILLATION, subject, step, rules.oscillation_step)
        )
    return events


def _columns(values: Rows) -> np.ndarray:
    """A field of all rows as a float matrix (k, size)."""
    return values.reshape(len(values), -1).astype(float)


def _bits(mask: Rows) -> np.ndarray:
    """The bits of an integer field, least significant first, (k, bits) bool."""
    rows = np.ascontiguousarray(mask).reshape(len(mask), -1)
    octets = rows.astype(rows.dtype.newbyteorder("<")).view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little").astype(bool)


def _errors(layout: Layout, trace: Rows) -> list[np.ndarray]:
    """What a solve brings down, one matrix per unit; columns that are never a number left out."""
    names = ("cost",) if "cost" in layout.names else ("position_error", "angle_error")
    matrices = [np.abs(_columns(trace[name])) for name in names if name in layout.names]
    matrices = [matrix[:, ~np.isnan(matrix).all(axis=0)] for matrix in matrices]
    return [matrix for matrix in matrices if matrix.shape[1]]


def _one_piece(layout: Layout, trace: Rows, window: int) -> np.ndarray:
    """For each row from `window` on: do the last `window` steps lie in one phase and restart."""
    piece = np.zeros(len(trace), dtype=int)
    for name in ("phase", "restart"):
        if name in layout.names:
            piece[1:] += np.cumsum(np.diff(trace[name].astype(int)) != 0)
    return piece[window:] == piece[:-window]


def _entries(inside: np.ndarray, released: np.ndarray) -> list[tuple[int, int]]:
    """Rows and columns where a condition begins to hold: inside now and released since the last.

    A row that is neither inside nor released keeps the state of the row before.
    """
    rows = np.arange(len(inside))[:, None]
    decided = np.maximum.accumulate(np.where(inside | released, rows, -1), axis=0)
    state = np.take_along_axis(inside, np.maximum(decided, 0), axis=0) & (decided >= 0)
    before = np.vstack([np.zeros((1, state.shape[1]), dtype=bool), state[:-1]])
    return [(int(i), int(column)) for i, column in np.argwhere(state & ~before)]


def _name(names: Sequence[str], index: int, what: str) -> str:
    return names[index] if index < len(names) else f"{what} {index}".strip()


def _label(labels: Labels, name: str, code: int) -> str:
    names = labels.get(name, ())
    return names[code] if 0 <= code < len(names) else str(code)


def _phase_of(layout: Layout, trace: Rows, labels: Labels, row: int) -> str:
    if "phase" not in layout.names:
        return "whole solve"
    return _label(labels, "phase", int(trace["phase"][row]))
