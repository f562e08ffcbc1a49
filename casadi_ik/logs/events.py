"""Events of a log: kinds with phrases and colours, thresholds, and detection.

Events are detected in the traces of many solves at once by the names of the fields:

========================  ==============================================================
standard field            events
========================  ==============================================================
``PHASE``                 PHASE_CHANGE
``RESTART``               RESTART
``LIMIT_MASK``            LIMIT_HIT, LIMIT_LEFT
``ACTIVE_MASK``           ACTIVATED, RELEASED
``sigma_<jacobian>``      NEAR_SINGULAR (smallest singular value; NaN while not measured)
``condition_<jacobian>``  ILL_CONDITIONED (condition number; NaN while not measured)
``COST``, or else         STALL, and the progress that excludes OSCILLATION
``POSITION_ERROR`` and
``ANGLE_ERROR``
``Q``                     OSCILLATION
``CLEARANCE``             COLLISION_ENTERED, COLLISION_LEFT (of a log with a scene)
========================  ==============================================================

The standard fields are those of `casadi_ik.solve.trace`. A layout without a field has none of its
events. Each function of `DETECTORS` detects some kinds of events.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Bools, Rows
from casadi_ik.logs.traces import (
    Traces,
    actuator_names,
    as_matrix,
    bits_of,
    jacobian_names,
    mask_words,
    measured_jacobians,
    set_bits,
)
from casadi_ik.logs.wording import format_number, format_quantity, joined_names, plain_name
from casadi_ik.solve.trace import (
    ACTIVE_MASK,
    CLEARANCE,
    CONDITION,
    LIMIT_MASK,
    PHASE,
    RESTART,
    SIGMA,
    Q,
    RecordedJacobian,
    TraceFormat,
)


class EventKind(IntEnum):
    """Kind of an event in an iteration: its code, phrase and colour.

    The docstrings of the kinds state the value and the threshold of their events.

    Attributes:
        phrase: Format of a short description, with fields of `Event` in braces; `mm` is the value
            in millimetres.
        subject: Format of the subject; `before` and `after` are names of phases.
        color: Colour of marks in diagrams; "" for events that appear as phases or limits.
        serious: True if the event can be the cause of a failure.

    Example:
        >>> ik.logs.EventKind.LIMIT_HIT.name
        'LIMIT_HIT'
    """

    phrase: str
    subject: str
    color: str
    serious: bool

    def __new__(
        cls,
        code: int,
        phrase: str,
        subject: str = "{joints}",
        color: str = "",
        serious: bool = False,
    ) -> Self:
        """Create a member from its code and attributes."""
        kind = int.__new__(cls, code)
        kind._value_ = code
        kind.phrase, kind.subject, kind.color, kind.serious = phrase, subject, color, serious
        return kind

    NEAR_SINGULAR = (
        0,
        "{jacobian} near singular: smallest singular value {value} (below {threshold})",
        "{jacobian}",
        "#8e4ec6",
        True,
    )
    """The smallest singular value of a Jacobian has fallen below its threshold."""
    ILL_CONDITIONED = (
        1,
        "{jacobian} ill-conditioned: condition number {value} (above {threshold})",
        "{jacobian}",
        "#b48ad6",
        True,
    )
    """The condition number of a Jacobian has risen above its threshold."""
    LIMIT_HIT = 2, "{joints} at its limit ({value})"
    """An actuator has reached a limit. Value and threshold: its position."""
    LIMIT_LEFT = 3, "{joints} left its limit ({threshold}), now {value}"
    """An actuator has left a limit. Value: its position; threshold: its position on the limit."""
    ACTIVATED = 4, "{joints} activated: {value} active constraints, {threshold} before"
    """Constraints have joined the active set. Value and threshold: its size now and before."""
    RELEASED = 5, "{joints} released: {value} active constraints, {threshold} before"
    """Constraints have left the active set. Value and threshold: its size now and before."""
    RESTART = 6, "restart {value}", "{threshold} -> {value}", "#2f6db3"
    """A restart. Value and threshold: its number and the number before."""
    PHASE_CHANGE = 7, "phase {phase}", "{before} -> {after}"
    """A change of phase. Value and threshold: codes of the new and the previous phase."""
    STALL = 8, "{phase} stalled (relative error change {value})", "{phase}", "#2b333b", True
    """The errors no longer change. Value and threshold: relative spread of the errors."""
    OSCILLATION = (
        9,
        "oscillation of {joints} without progress: steps up to {value}",
        "{joints}",
        "#0f8b8d",
        True,
    )
    """Actuators oscillate without progress. Value: largest step; threshold: smallest step."""
    COLLISION_ENTERED = 10, "collision: clearance {mm} mm"
    """The clearance has fallen below the margin. Value: clearance; threshold: margin."""
    COLLISION_LEFT = 11, "end of collision: clearance {mm} mm"
    """The clearance has risen above the margin. Value: clearance; threshold: margin."""


SINGULAR = (EventKind.NEAR_SINGULAR, EventKind.ILL_CONDITIONED)
"""Kinds of events near singularities."""

MOVES = (EventKind.LIMIT_HIT, EventKind.LIMIT_LEFT, EventKind.OSCILLATION)
"""Kinds whose values are positions or steps of actuators."""

SERIOUS = tuple(kind.name for kind in EventKind if kind.serious)
"""Names of the kinds that can be the cause of a failure."""

EVENT_COLORS: Mapping[str, str] = {kind.name: kind.color for kind in EventKind if kind.color}
"""Colours of the kinds that are marked in diagrams by name."""


@dataclass(frozen=True)
class EventRules:
    """Thresholds of events; studies/event_thresholds.py checks the defaults.

    Attributes:
        singular: Smallest singular value below which a Jacobian is near singular, by the name
            after ``sigma_``, in the unit of that field. Other Jacobians have the threshold of
            their method (`RecordedJacobian.singular`).
        condition: Condition number above which a Jacobian is ill-conditioned, by the name after
            ``condition_``; other Jacobians have the threshold of their method.
        release: Factor of hysteresis: a singular value must exceed its threshold by this factor
            (a condition number must fall below it) before the event can occur again.
        limit_slack: Distance from a limit at which an actuator has left it [rad or m]; it
            excludes events due to rounding.
        stall_window: Number of iterations over which a stall is detected.
        stall_change: Spread of the error over the window, relative to the error, below which the
            solve has stalled.
        oscillation_window: Number of iterations over which an oscillation is detected, at least 3.
        oscillation_step: Smallest step of an oscillating actuator [rad or m].
        oscillation_progress: Relative decrease of the error over the window that counts as
            progress.
        clearance: Clearance below which the robot is in collision [m]; logs with a scene use the
            margin of the scene.

    Example:
        >>> ik.logs.EventRules(release=3.0).release
        3.0
    """

    singular: Mapping[str, float] = field(default_factory=dict)
    condition: Mapping[str, float] = field(default_factory=dict)
    release: float = 1.5
    limit_slack: float = 1e-6
    stall_window: int = 10
    stall_change: float = 1e-4
    oscillation_window: int = 6
    oscillation_step: float = 1e-4
    oscillation_progress: float = 0.05
    clearance: float = 0.0

    def __post_init__(self) -> None:
        if self.stall_window < 1 or self.oscillation_window < 3:
            raise InputError(
                f"event rules: found windows {self.stall_window} and {self.oscillation_window},"
                " expected at least 1 (stall) and 3 (oscillation)"
            )
        if self.release < 1:
            raise InputError(f"event rules: release: found {self.release}, expected at least 1")


@dataclass(frozen=True)
class Event:
    """An event of a solve.

    Attributes:
        iteration: Iteration of the event, from 0.
        kind: Name of its `EventKind`, e.g. "NEAR_SINGULAR".
        jacobian: Name of the Jacobian; "" for kinds without one.
        joints: Names of the actuators.
        phase: Phase of the iteration; "" if the method has no phases.
        value: Value that caused the event.
        threshold: Threshold of the value, or the previous value.
        unit: Unit of both, "rad" or "m", if they are positions or steps of actuators.
        subject: Subject of the event in the format of `EventKind.subject`.
    """

    iteration: int
    kind: str
    jacobian: str
    joints: tuple[str, ...]
    phase: str
    value: float
    threshold: float
    unit: str = ""
    subject: str = ""


def describe(event: Event) -> str:
    """Return a short description of an event."""
    if event.kind not in EventKind.__members__:
        return f"{plain_name(event.kind.lower())}: {format_number(event.value)}"
    return EventKind[event.kind].phrase.format(
        jacobian=plain_name(event.jacobian),
        joints=joined_names(event.joints),
        phase=plain_name(event.phase),
        value=format_quantity(event.value, event.unit),
        threshold=format_quantity(event.threshold, event.unit),
        mm=f"{1e3 * event.value:.2f}",
    )


# Storage of events.


def event_layout(words: int) -> Layout:
    """Return the fields of an event; its mask of actuators has `words` words."""
    return Layout.record(
        Field("value", (), "f8", "", "value that caused the event"),
        Field("threshold", (), "f8", "", "threshold of the value, or the previous value"),
        Field("solve_id", (), "u4"),
        Field("iteration", (), "u4", "", "number of the iteration, from 0"),
        Field("joint_mask", () if words == 1 else (words,), "u4", "", "bit i: actuator i"),
        Field("kind", (), "u1"),
        Field("jacobian", (), "u1", "", "Jacobian of the event"),
        Field("phase", (), "u1"),
    )


def event_format(form: TraceFormat) -> TraceFormat:
    """Return layout and labels of the events of traces of a format."""
    labels = {
        "kind": tuple(kind.name for kind in EventKind),
        "jacobian": ("none", *jacobian_names(form)),
        "joint_mask": actuator_names(form),
        "joint_unit": form.labels.get("q_unit", ()),
        "phase": form.labels.get(PHASE.name, ()),
    }
    return TraceFormat(event_layout(mask_words(form)), labels)


# Detection of events.


class EventRows(NamedTuple):
    """Events of a kind: rows (e,), scalars or arrays (e,) of values, joints as masks (e, words)."""

    kind: EventKind
    row: Rows
    value: ArrayLike
    threshold: ArrayLike
    joints: ArrayLike = 0
    jacobian: ArrayLike = 0


def detect_events(
    form: TraceFormat,
    rows: NDArray[Any],
    counts: NDArray[np.int64],
    rules: EventRules | None = None,
) -> NDArray[Any]:
    """Detect the events of several solves.

    Args:
        form: Format of the rows.
        rows: (m,) rows of all solves, one solve after another.
        counts: (k,) number of rows of each solve.
        rules: Thresholds of events.

    Returns:
        (e,) rows of `event_format` sorted by solve and iteration; "solve_id" counts the solves
        from 0.
    """
    traces = EventTraces(form, rows, counts, rules or EventRules())
    with np.errstate(invalid="ignore"):
        batches = [batch for detect in DETECTORS for batch in detect(traces)] if len(rows) else []
    batches = [batch for batch in batches if len(batch.row)]
    row = np.concatenate([np.zeros(0, np.intp), *(batch.row for batch in batches)])
    events = np.zeros(len(row), event_format(form).layout.dtype)
    first, masks = 0, as_matrix(events["joint_mask"])
    for batch in batches:
        part = slice(first, first := first + len(batch.row))
        for name in ("kind", "value", "threshold", "jacobian"):
            events[name][part] = getattr(batch, name)
        joints = np.asarray(batch.joints)
        masks[part, : joints.shape[-1] if joints.ndim else None] = joints
    solve = traces.solve[row]
    events["solve_id"] = solve
    events["iteration"] = row - traces.starts[solve]
    if PHASE.name in traces.names:
        events["phase"] = traces.column(PHASE.name)[row]
    return events[np.argsort(row * len(EventKind) + events["kind"], kind="stable")]


@dataclass(frozen=True)
class MeasuredJacobian:
    """A Jacobian with the columns of a trace that measure it.

    Attributes:
        joints: Actuators of its columns.
        singular: Threshold of its smallest singular value.
        condition: Threshold of its condition number.
        columns: (field, column) of its measurements by `SIGMA` and `CONDITION`.
    """

    joints: tuple[str, ...]
    singular: float
    condition: float
    columns: dict[str, tuple[str, int]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class EventTraces(Traces):
    """Traces with the thresholds of events.

    Attributes:
        rules: Thresholds of events.
    """

    rules: EventRules

    @cached_property
    def jacobians(self) -> list[MeasuredJacobian]:
        """Measured Jacobians in the order of `jacobian_names`."""
        jacobians: dict[str, MeasuredJacobian] = {}
        for item in self.form.layout:
            kind = SIGMA if item.name.startswith(SIGMA) else CONDITION
            name = item.name.removeprefix(kind)
            recorded = self.form.jacobians.get(name, RecordedJacobian())
            singular = self.rules.singular.get(name, recorded.singular)
            condition = self.rules.condition.get(name, recorded.condition)
            for column, label in enumerate(measured_jacobians(self.form, item)):
                jacobian = MeasuredJacobian(recorded.joints, singular, condition)
                jacobians.setdefault(label, jacobian).columns[kind] = item.name, column
        return list(jacobians.values())

    def nearest_singular(self, row: Rows) -> NDArray[np.int64]:
        """Return the number, from 1, of the Jacobian nearest to its threshold in each row.

        The number is 0 if no singular value is within the factor `EventRules.release`.
        """
        distance = np.full((len(row), len(self.jacobians) + 1), np.inf)
        distance[:, 0] = self.rules.release
        for number, jacobian in enumerate(self.jacobians, start=1):
            if SIGMA in jacobian.columns and jacobian.singular > 0:
                value = self.column(*jacobian.columns[SIGMA])[row] / jacobian.singular
                distance[:, number] = np.where(np.isnan(value), np.inf, value)
        return np.argmin(distance, axis=1)


def _changes(traces: EventTraces) -> Iterator[EventRows]:
    """Detect changes of phase and restarts."""
    for name, kind in ((PHASE.name, EventKind.PHASE_CHANGE), (RESTART.name, EventKind.RESTART)):
        if name in traces.names:
            codes = traces.column(name)
            previous = traces.previous(codes, codes[traces.firsts])
            row = np.flatnonzero(codes != previous)
            yield EventRows(kind, row, codes[row], previous[row])


def _limits(traces: EventTraces) -> Iterator[EventRows]:
    """Detect changes of bits of the limit mask.

    A start at a limit is a hit. If a bit is cleared while the actuator stays within
    `EventRules.limit_slack` of its position on the limit, the actuator has not left the limit, and
    it does not hit the limit if the bit is set again before it has moved.
    """
    if LIMIT_MASK.name not in traces.names:
        return
    mask = np.ascontiguousarray(traces.matrix(LIMIT_MASK.name))
    previous = traces.previous(mask, 0)
    hit, hit_bit = set_bits(mask & ~previous)
    leave, leave_bit = set_bits(previous & ~mask)
    limit = traces.positions(leave - 1, leave_bit)
    stops = (traces.starts + traces.counts)[traces.solve[leave]]
    is_repeated, has_left = np.zeros(len(hit), dtype=bool), np.ones(len(leave), dtype=bool)
    # Actuators that have not moved yet are followed row by row to the next hit or the end.
    pending = np.arange(len(leave))
    while True:
        row, bit = leave[pending], leave_bit[pending]
        distance = np.abs(traces.positions(row, bit) - limit[pending])
        pending = pending[distance <= traces.rules.limit_slack]
        if not len(pending):
            break
        leave[pending] += 1
        row, bit = leave[pending], leave_bit[pending]
        at_end = row == stops[pending]
        words = mask[np.where(at_end, 0, row), bit >> 5] >> (bit & 31).astype(np.uint32)
        is_back = ~at_end & (words & 1 > 0)
        is_repeated |= np.isin(hit * 2**16 + hit_bit, (row * 2**16 + bit)[is_back])
        has_left[pending[at_end | is_back]] = False
        pending = pending[~(at_end | is_back)]
    hit, hit_bit = hit[~is_repeated], hit_bit[~is_repeated]
    leave, leave_bit, limit = leave[has_left], leave_bit[has_left], limit[has_left]
    for kind, row, bit, threshold in (
        (EventKind.LIMIT_HIT, hit, hit_bit, traces.positions(hit, hit_bit)),
        (EventKind.LIMIT_LEFT, leave, leave_bit, limit),
    ):
        joints = np.zeros((len(row), mask_words(traces.form)), np.uint32)
        joints[np.arange(len(row)), bit >> 5] = 1 << (bit & 31)
        yield EventRows(kind, row, traces.positions(row, bit), threshold, joints)


def _active(traces: EventTraces) -> Iterator[EventRows]:
    """Detect constraints that join or leave the active set."""
    if ACTIVE_MASK.name in traces.names:
        mask = np.ascontiguousarray(traces.matrix(ACTIVE_MASK.name))
        previous = traces.previous(mask, mask[traces.firsts])
        changes = ((EventKind.ACTIVATED, mask & ~previous), (EventKind.RELEASED, previous & ~mask))
        for kind, joints in changes:
            row = np.flatnonzero(joints.any(axis=1))
            size, size_before = (bits_of(words[row]).sum(axis=1) for words in (mask, previous))
            yield EventRows(kind, row, size, size_before, joints[row])


def _collisions(traces: EventTraces) -> Iterator[EventRows]:
    """Detect where the clearance falls below the margin and rises above it again.

    A start in collision is an entry.
    """
    if CLEARANCE in traces.names:
        clearance, margin = traces.column(CLEARANCE), traces.rules.clearance
        # The tolerance covers the single precision of logged clearances.
        in_collision = clearance < margin - 1e-7
        previous = traces.previous(in_collision, False)
        for kind, changes in (
            (EventKind.COLLISION_ENTERED, in_collision & ~previous),
            (EventKind.COLLISION_LEFT, ~in_collision & previous),
        ):
            row = np.flatnonzero(changes)
            yield EventRows(kind, row, clearance[row], margin)


def _singular(traces: EventTraces) -> Iterator[EventRows]:
    """Detect where a Jacobian becomes near singular or ill-conditioned.

    The event can occur again once the value was better than its threshold by the factor
    `EventRules.release`, or was not computed (NaN).
    """
    names, release = actuator_names(traces.form), traces.rules.release
    for number, jacobian in enumerate(traces.jacobians, start=1):
        joints = traces.words(np.array([[name in jacobian.joints for name in names]], dtype=bool))
        if SIGMA in jacobian.columns and jacobian.singular > 0:
            value, limit = traces.column(*jacobian.columns[SIGMA]), jacobian.singular
            row = _entries(traces, value < limit, ~(value <= limit * release))
            yield EventRows(EventKind.NEAR_SINGULAR, row, value[row], limit, joints, number)
        if CONDITION in jacobian.columns and jacobian.condition < math.inf:
            value, limit = traces.column(*jacobian.columns[CONDITION]), jacobian.condition
            row = _entries(traces, value > limit, ~(value >= limit / release))
            yield EventRows(EventKind.ILL_CONDITIONED, row, value[row], limit, joints, number)


def _stalls(traces: EventTraces) -> Iterator[EventRows]:
    """Detect where the error stalls.

    A solve has stalled if over the last `EventRules.stall_window` iterations of one phase and
    restart the errors spread by at most `EventRules.stall_change` of the largest error. The largest
    of all fingers counts, so that a converged finger does not hide one that is stuck.
    """
    window, limit = traces.rules.stall_window, traces.rules.stall_change
    long_traces, indices = traces.longer_than(window)
    if not (groups := long_traces.errors()):
        return
    relative_spread = largest = np.zeros(len(indices) - window)
    for errors in groups:
        high, low = (_over_window(errors, window + 1, pick) for pick in (np.maximum, np.minimum))
        top = high.max(axis=0)
        relative_spread = np.maximum(
            relative_spread, (high - low).max(axis=0) / np.where(top > 0, top, 1)
        )
        largest = np.maximum(largest, top)
    is_stalled = long_traces.same_run(window) & (relative_spread <= limit) & (largest > 0)
    starts = _rising_edges(is_stalled)
    row, at_limit = indices[starts + window], 0
    if LIMIT_MASK.name in traces.names:
        at_limit = traces.matrix(LIMIT_MASK.name)[row]
    jacobian = traces.nearest_singular(row)
    yield EventRows(EventKind.STALL, row, relative_spread[starts], limit, at_limit, jacobian)


def _oscillations(traces: EventTraces) -> Iterator[EventRows]:
    """Detect where actuators oscillate without progress.

    An actuator oscillates if each of its steps in the last `EventRules.oscillation_window`
    iterations is longer than `EventRules.oscillation_step` and opposite to the previous step. There
    is no progress if no error decreases by more than `EventRules.oscillation_progress`.
    """
    rules, window = traces.rules, traces.rules.oscillation_window
    long_traces, indices = traces.longer_than(window)
    if Q.name not in traces.names or not len(indices):
        return
    steps = np.diff(long_traces.columns(Q.name), axis=1)
    up, down = steps > rules.oscillation_step, steps < -rules.oscillation_step
    is_reversed = (up[:, 1:] & down[:, :-1]) | (down[:, 1:] & up[:, :-1])
    oscillates = _over_window(is_reversed, window - 1, np.minimum)
    without_progress = np.logical_or.reduce(oscillates, axis=0)
    if without_progress.any():
        without_progress &= long_traces.same_run(window)
        for errors in long_traces.errors():
            norm = np.sqrt(np.einsum("ij,ij->j", errors, errors))
            without_progress &= norm[window:] >= (1 - rules.oscillation_progress) * norm[:-window]
    starts = _rising_edges(without_progress)
    joints, row = oscillates[:, starts].T, indices[starts + window]
    step = np.where(joints, np.abs(steps[:, starts + window - 1]).T, 0).max(axis=1)
    words, jacobian = traces.words(joints), traces.nearest_singular(row)
    yield EventRows(EventKind.OSCILLATION, row, step, rules.oscillation_step, words, jacobian)


DETECTORS: tuple[Callable[[EventTraces], Iterator[EventRows]], ...] = (
    *(_changes, _limits, _active, _collisions, _singular, _stalls, _oscillations),
)
"""Detectors of events; each processes the traces of all solves at once."""


def _rising_edges(flags: Bools) -> Rows:
    """Return the rows whose flag is set and whose previous flag is not.

    The flags must not be set in the first rows of solves, so that solves need no separation.
    """
    return np.flatnonzero(flags & ~np.concatenate([[False], flags[:-1]]))


def _entries(traces: EventTraces, rising: Bools, falling: Bools) -> Rows:
    """Return the rows where a condition with hysteresis starts to hold.

    The condition holds from a row with `rising` to a row with `falling`. It does not hold before
    the first row of a solve.

    Args:
        traces: EventTraces of the solves.
        rising: (m,) True where the condition starts to hold.
        falling: (m,) True where the condition ceases to hold.
    """
    if not rising.any():
        return np.zeros(0, np.intp)
    # Only the few solves with a start are processed row by row.
    has_start = np.zeros(len(traces.counts), dtype=bool)
    has_start[traces.solve[rising]] = True
    decisive = np.flatnonzero((rising | falling) & has_start[traces.solve])
    previous = np.concatenate([[-1], decisive[:-1]])
    can_start = falling[previous] | (traces.solve[previous] != traces.solve[decisive])
    can_start[0] = True
    return decisive[rising[decisive] & can_start]


def _over_window(values: NDArray[Any], window: int, reduce: np.ufunc) -> NDArray[Any]:
    """Reduce every `window` consecutive columns to a maximum or minimum, (n, m - window + 1)."""
    width = 1
    while 2 * width <= window:
        values = reduce(values[:, width:], values[:, :-width])
        width *= 2
    shift = window - width
    return reduce(values[:, shift:], values[:, :-shift]) if shift else values
