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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Bools, Rows
from casadi_ik.solve.trace import (
    ACTIVE_MASK,
    ANGLE_ERROR,
    CLEARANCE,
    CONDITION,
    COST,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    SIGMA,
    WORD_BITS,
    Q,
    RecordedJacobian,
    TraceFormat,
)

Words = NDArray[np.uint32]


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


def plain_name(name: str) -> str:
    """Return an identifier as words: "closed chain" for ``closed_chain``."""
    return name.replace("_", " ").replace("-", " ")


def format_number(value: float) -> str:
    """Format a number with three significant digits."""
    return f"{value:.3g}"


def format_quantity(value: float, unit: str) -> str:
    """Format a value with its unit: angles in degrees, lengths in millimetres."""
    if unit == "rad":
        return f"{math.degrees(value):.4g} deg"
    return f"{1e3 * value:.4g} mm" if unit == "m" else format_number(value)


def counted_noun(count: int, noun: str) -> str:
    """Return a count with its noun: "1 restart", "2 restarts"."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def joined_names(names: Sequence[str], max_names: int = 4) -> str:
    """Join the first names with commas and count the remaining ones."""
    text = ", ".join(names[:max_names])
    return text if len(names) <= max_names else f"{text} and {len(names) - max_names} more"


def errors_text(position: float, angle: float) -> str:
    """Format the errors of a contact; free components (NaN) are left out.

    Args:
        position: Position error [m].
        angle: Angle error [rad].
    """
    parts = [] if math.isnan(position) else [f"{1e3 * position:.2f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.2f} deg"]
    return " and ".join(parts) or "free"


# Storage of events.


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


def event_layout(words: int) -> Layout:
    """Return the fields of an event; its mask of actuators has `words` words."""
    return Layout.record(
        Field("value", (), "f8", "", "the number that made it an event"),
        Field("threshold", (), "f8", "", "what it was compared with, or the value before"),
        Field("solve_id", (), "u4"),
        Field("iteration", (), "u4", "", "counted from 0"),
        Field("joint_mask", () if words == 1 else (words,), "u4", "", "bit i: actuator i"),
        Field("kind", (), "u1"),
        Field("jacobian", (), "u1", "", "the Jacobian concerned"),
        Field("phase", (), "u1"),
    )


def event_format(form: TraceFormat) -> TraceFormat:
    """Return layout and labels of the events of traces of a format."""
    labels = {
        "kind": tuple(kind.name for kind in EventKind),
        "jacobian": ("none", *jacobian_names(form)),
        "joint_mask": _actuators(form),
        "joint_unit": form.labels.get("q_unit", ()),
        "phase": form.labels.get(PHASE.name, ()),
    }
    return TraceFormat(event_layout(mask_words(form)), labels)


def _actuators(form: TraceFormat) -> tuple[str, ...]:
    return form.labels.get(Q.name) or form.labels.get(LIMIT_MASK.name, ())


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
    traces = Traces(form, rows, counts, rules or EventRules())
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
class Traces:
    """Rows of several solves, one solve after another.

    Attributes:
        form: Format of the rows.
        rows: (m,) rows of the layout of the format.
        counts: (k,) number of rows of each solve.
        rules: Thresholds of events.
    """

    form: TraceFormat
    rows: NDArray[Any]
    counts: NDArray[np.int64]
    rules: EventRules
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

    def longer_than(self, window: int) -> tuple[Traces, Rows]:
        """Return the solves with more rows than a window, and the indices of their rows."""
        is_long = self.counts > window
        indices = np.flatnonzero(np.repeat(is_long, self.counts))
        if is_long.all():
            return self, indices
        rows = np.take(self.rows, indices)
        return Traces(self.form, rows, self.counts[is_long], self.rules), indices

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

    def words(self, joints: Bools) -> Words:
        """Pack flags of actuators (e, n) into words (e, words) of a mask."""
        padded = np.zeros((len(joints), 32 * mask_words(self.form)), dtype=bool)
        padded[:, : joints.shape[1]] = joints
        return words_of(padded)


def _changes(traces: Traces) -> Iterator[EventRows]:
    """Detect changes of phase and restarts."""
    for name, kind in ((PHASE.name, EventKind.PHASE_CHANGE), (RESTART.name, EventKind.RESTART)):
        if name in traces.names:
            codes = traces.column(name)
            previous = traces.previous(codes, codes[traces.firsts])
            row = np.flatnonzero(codes != previous)
            yield EventRows(kind, row, codes[row], previous[row])


def _limits(traces: Traces) -> Iterator[EventRows]:
    """Detect changes of bits of the limit mask.

    A start at a limit is a hit. If a bit is cleared while the actuator stays within
    `EventRules.limit_slack` of its position on the limit, the actuator has not left the limit, and
    it does not hit the limit if the bit is set again before it has moved.
    """
    if LIMIT_MASK.name not in traces.names:
        return
    mask = np.ascontiguousarray(traces.matrix(LIMIT_MASK.name))
    previous = traces.previous(mask, 0)
    hit, hit_bit = _set_bits(mask & ~previous)
    leave, leave_bit = _set_bits(previous & ~mask)
    limit = _positions(traces, leave - 1, leave_bit)
    ends = (traces.starts + traces.counts)[traces.solve[leave]]
    is_repeated, has_left = np.zeros(len(hit), dtype=bool), np.ones(len(leave), dtype=bool)
    # Actuators that have not moved yet are followed row by row to the next hit or the end.
    pending = np.arange(len(leave))
    while True:
        row, bit = leave[pending], leave_bit[pending]
        distance = np.abs(_positions(traces, row, bit) - limit[pending])
        pending = pending[distance <= traces.rules.limit_slack]
        if not len(pending):
            break
        leave[pending] += 1
        row, bit = leave[pending], leave_bit[pending]
        at_end = row == ends[pending]
        words = mask[np.where(at_end, 0, row), bit >> 5] >> (bit & 31).astype(np.uint32)
        is_back = ~at_end & (words & 1 > 0)
        is_repeated |= np.isin(hit * 2**16 + hit_bit, (row * 2**16 + bit)[is_back])
        has_left[pending[at_end | is_back]] = False
        pending = pending[~(at_end | is_back)]
    hit, hit_bit = hit[~is_repeated], hit_bit[~is_repeated]
    leave, leave_bit, limit = leave[has_left], leave_bit[has_left], limit[has_left]
    for kind, row, bit, threshold in (
        (EventKind.LIMIT_HIT, hit, hit_bit, _positions(traces, hit, hit_bit)),
        (EventKind.LIMIT_LEFT, leave, leave_bit, limit),
    ):
        joints = np.zeros((len(row), mask_words(traces.form)), np.uint32)
        joints[np.arange(len(row)), bit >> 5] = 1 << (bit & 31)
        yield EventRows(kind, row, _positions(traces, row, bit), threshold, joints)


def _active(traces: Traces) -> Iterator[EventRows]:
    """Detect constraints that join or leave the active set."""
    if ACTIVE_MASK.name in traces.names:
        mask = np.ascontiguousarray(traces.matrix(ACTIVE_MASK.name))
        previous = traces.previous(mask, mask[traces.firsts])
        changes = ((EventKind.ACTIVATED, mask & ~previous), (EventKind.RELEASED, previous & ~mask))
        for kind, joints in changes:
            row = np.flatnonzero(joints.any(axis=1))
            size, size_before = (bits_of(words[row]).sum(axis=1) for words in (mask, previous))
            yield EventRows(kind, row, size, size_before, joints[row])


def _collisions(traces: Traces) -> Iterator[EventRows]:
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


def _singular(traces: Traces) -> Iterator[EventRows]:
    """Detect where a Jacobian becomes near singular or ill-conditioned.

    The event can occur again once the value was better than its threshold by the factor
    `EventRules.release`, or was not computed (NaN).
    """
    names, release = _actuators(traces.form), traces.rules.release
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


def _stalls(traces: Traces) -> Iterator[EventRows]:
    """Detect where the error stalls.

    A solve has stalled if over the last `EventRules.stall_window` iterations of one phase and
    restart the errors spread by at most `EventRules.stall_change` of the largest error. The largest
    of all fingers counts, so that a converged finger does not hide one that is stuck.
    """
    window, limit = traces.rules.stall_window, traces.rules.stall_change
    long_traces, indices = traces.longer_than(window)
    if not (groups := _errors(long_traces)):
        return
    spread = largest = np.zeros(len(indices) - window)
    for errors in groups:
        high, low = (_over_window(errors, window + 1, pick) for pick in (np.maximum, np.minimum))
        top = high.max(axis=0)
        spread = np.maximum(spread, (high - low).max(axis=0) / np.where(top > 0, top, 1))
        largest = np.maximum(largest, top)
    is_stalled = _same_run(long_traces, window) & (spread <= limit) & (largest > 0)
    starts = _rising_edges(is_stalled)
    row, at_limit = indices[starts + window], 0
    if LIMIT_MASK.name in traces.names:
        at_limit = traces.matrix(LIMIT_MASK.name)[row]
    jacobian = traces.nearest_singular(row)
    yield EventRows(EventKind.STALL, row, spread[starts], limit, at_limit, jacobian)


def _oscillations(traces: Traces) -> Iterator[EventRows]:
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
        without_progress &= _same_run(long_traces, window)
        for errors in _errors(long_traces):
            norm = np.sqrt(np.einsum("ij,ij->j", errors, errors))
            without_progress &= norm[window:] >= (1 - rules.oscillation_progress) * norm[:-window]
    starts = _rising_edges(without_progress)
    joints, row = oscillates[:, starts].T, indices[starts + window]
    step = np.where(joints, np.abs(steps[:, starts + window - 1]).T, 0).max(axis=1)
    words, jacobian = traces.words(joints), traces.nearest_singular(row)
    yield EventRows(EventKind.OSCILLATION, row, step, rules.oscillation_step, words, jacobian)


DETECTORS: tuple[Callable[[Traces], Iterator[EventRows]], ...] = (
    *(_changes, _limits, _active, _collisions, _singular, _stalls, _oscillations),
)
"""Detectors of events; each processes the traces of all solves at once."""


def _rising_edges(flags: Bools) -> Rows:
    """Return the rows whose flag is set and whose previous flag is not.

    The flags must not be set in the first rows of solves, so that solves need no separation.
    """
    return np.flatnonzero(flags & ~np.concatenate([[False], flags[:-1]]))


def _errors(traces: Traces) -> list[NDArray[Any]]:
    """Return the errors that a solve minimises, (columns, m) per unit, with 0 for free columns."""
    fields = (COST,) if COST.name in traces.names else (POSITION_ERROR, ANGLE_ERROR)
    groups = []
    for name in (item.name for item in fields if item.name in traces.names and len(traces.rows)):
        errors = np.abs(traces.columns(name))
        is_missing = np.isnan(errors)
        if is_missing.any():
            is_free = np.logical_and.reduceat(is_missing, traces.starts, axis=1)
            errors[np.repeat(is_free, traces.counts, axis=1)] = 0
        groups.append(errors)
    return groups


def _same_run(traces: Traces, window: int) -> Bools:
    """Return for rows from `window` on if the last `window` steps have one phase and restart."""
    return traces.run[window:] == traces.run[:-window]


def _entries(traces: Traces, begins: Bools, ends: Bools) -> Rows:
    """Return the rows where a condition with hysteresis starts to hold.

    The condition holds from a row with `begins` to a row with `ends`. It does not hold before the
    first row of a solve.

    Args:
        traces: Traces of the solves.
        begins: (m,) True where the condition starts to hold.
        ends: (m,) True where the condition ceases to hold.
    """
    if not begins.any():
        return np.zeros(0, np.intp)
    # Only the few solves with a start are processed row by row.
    has_start = np.zeros(len(traces.counts), dtype=bool)
    has_start[traces.solve[begins]] = True
    decisive = np.flatnonzero((begins | ends) & has_start[traces.solve])
    previous = np.concatenate([[-1], decisive[:-1]])
    can_start = ends[previous] | (traces.solve[previous] != traces.solve[decisive])
    can_start[0] = True
    return decisive[begins[decisive] & can_start]


def _over_window(values: NDArray[Any], window: int, reduce: np.ufunc) -> NDArray[Any]:
    """Reduce every `window` consecutive columns to a maximum or minimum, (n, m - window + 1)."""
    width = 1
    while 2 * width <= window:
        values = reduce(values[:, width:], values[:, :-width])
        width *= 2
    shift = window - width
    return reduce(values[:, shift:], values[:, :-shift]) if shift else values


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


def _set_bits(words: NDArray[Any]) -> tuple[Rows, Rows]:
    """Return row and bit, both (e,), of every bit that is set in words (m, words)."""
    flat = words.reshape(-1)
    nonzero = np.flatnonzero(flat)
    index, bit = np.nonzero(bits_of(flat[nonzero][:, None]))
    row, word = np.divmod(nonzero[index], words.shape[1])
    return row, word * 32 + bit


def _positions(traces: Traces, row: Rows, bit: Rows) -> NDArray[Any]:
    """Return actuator positions (e,); NaN if the trace has none."""
    values = np.full(len(row), np.nan)
    if Q.name in traces.names:
        q = traces.matrix(Q.name)
        has_position = bit < q.shape[1]
        values[has_position] = q[row[has_position], bit[has_position]]
    return values
