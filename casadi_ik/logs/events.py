"""Events of a log: their kinds with phrases and colours, thresholds, and how they are found.

They are found in the traces of many solves at once, going by the names of the fields:

========================  ==============================================================
standard field            events
========================  ==============================================================
``PHASE``                 PHASE_CHANGE
``RESTART``               RESTART
``LIMIT_MASK``            LIMIT_HIT, LIMIT_LEFT
``ACTIVE_MASK``           ACTIVATED, RELEASED
``sigma_<jacobian>``      NEAR_SINGULAR (smallest singular value; NaN while not measured)
``condition_<jacobian>``  ILL_CONDITIONED (condition number; NaN while not measured)
``COST``, or else         STALL, and the progress that OSCILLATION asks for
``POSITION_ERROR`` and
``ANGLE_ERROR``
``Q``                     OSCILLATION
``CLEARANCE``             COLLISION_ENTERED, COLLISION_LEFT (of a log with a scene)
========================  ==============================================================

The standard fields are those of `casadi_ik.solve.trace`. One that a layout does not have gives
no events. A finder is a function in `FINDERS`.
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

    "Value against threshold" in the docstrings is what the event's two numbers are.

    Attributes:
        phrase: The event in a few words, with fields of `Happening` in braces; `mm` is the value
            in millimetres.
        subject: What it is about, likewise; `before` and `after` are names of phases.
        color: Of its marks in diagrams; "": not marked, it shows as a phase or a limit.
        serious: Whether it may be why a solve fails.

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
        """A member by its row."""
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
    """A Jacobian's smallest singular value has fallen below its threshold."""
    ILL_CONDITIONED = (
        1,
        "{jacobian} ill-conditioned: condition number {value} (above {threshold})",
        "{jacobian}",
        "#b48ad6",
        True,
    )
    """A Jacobian's condition number has risen above its threshold."""
    LIMIT_HIT = 2, "{joints} at its limit ({value})"
    """An actuator has come to a limit: its position, twice."""
    LIMIT_LEFT = 3, "{joints} off its limit ({threshold}), now {value}"
    """An actuator has left a limit: its position against that on the limit."""
    ACTIVATED = 4, "{joints} activated: {value} active constraints, {threshold} before"
    """Constraints have joined the active set: its size against that before."""
    RELEASED = 5, "{joints} released: {value} active constraints, {threshold} before"
    """Constraints have left the active set: its size against that before."""
    RESTART = 6, "restart {value}", "{threshold} -> {value}", "#2f6db3"
    """A new start: its number against that before."""
    PHASE_CHANGE = 7, "on to {phase}", "{before} -> {after}"
    """Another phase: its code against that before."""
    STALL = 8, "{phase} stalls: errors change by {value} of themselves", "{phase}", "#2b333b", True
    """The errors stand still: their relative spread against what counts as still."""
    OSCILLATION = (
        9,
        "{joints} to and fro without progress: steps up to {value}",
        "{joints}",
        "#0f8b8d",
        True,
    )
    """Actuators go to and fro without progress: the longest step against what counts as one."""
    COLLISION_ENTERED = 10, "something touches: clearance {mm} mm"
    """Two shapes have come nearer than they may: the clearance against the margin."""
    COLLISION_LEFT = 11, "nothing touches any more: clearance {mm} mm"
    """No two shapes are nearer than they may be any more: the clearance against the margin."""


SINGULAR = (EventKind.NEAR_SINGULAR, EventKind.ILL_CONDITIONED)
"""The kinds that make a solve a singular one."""

MOVES = (EventKind.LIMIT_HIT, EventKind.LIMIT_LEFT, EventKind.OSCILLATION)
"""The kinds whose numbers are positions or steps of actuators."""

SERIOUS = tuple(kind.name for kind in EventKind if kind.serious)
"""Names of the kinds that may be why a solve fails."""

EVENT_COLORS: Mapping[str, str] = {kind.name: kind.color for kind in EventKind if kind.color}
"""Colours of the kinds that are marked in diagrams, by name."""


@dataclass(frozen=True)
class EventRules:
    """When something counts as an event; the defaults are checked by studies/event_thresholds.py.

    Attributes:
        singular: Smallest singular value below which a Jacobian is near singular, by the name
            behind ``sigma_``, in the unit of that field. One not named here has the threshold
            that its method states (`RecordedJacobian.singular`).
        condition: Condition number above which it is ill-conditioned, by the name behind
            ``condition_``; likewise.
        release: A Jacobian has to rise above this multiple of its threshold (a condition number
            to fall below the threshold by this factor) before it can enter again.
        limit_slack: How far a coordinate has to move from its limit to have left it [rad or m];
            so that a rounding error is not an event.
        stall_window: Iterations over which a stall is judged.
        stall_change: Spread of the error over the window, relative to the error, that counts as
            standing still.
        oscillation_window: Iterations over which an oscillation is judged, at least 3.
        oscillation_step: Shortest step of a coordinate that counts as moving [rad or m].
        oscillation_progress: Relative fall of the error over the window that counts as progress.
        clearance: Clearance below which something is touched [m]; a log with a scene takes the
            scene's margin.

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
                f"event rules: windows {self.stall_window} and {self.oscillation_window},"
                " expected at least 1 (stall) and 3 (oscillation)"
            )
        if self.release < 1:
            raise InputError(f"event rules: release {self.release}, expected at least 1")


@dataclass(frozen=True)
class Happening:
    """An event of a solve.

    Attributes:
        iteration: In which iteration, from 0.
        kind: Name of its `EventKind`, e.g. "NEAR_SINGULAR".
        jacobian: The Jacobian concerned; "" if none.
        joints: The actuators concerned.
        phase: The phase it happened in; "" without phases.
        value: The number that made it an event.
        threshold: The number it was compared with, or the value before.
        unit: Of both, "rad" or "m", if they are positions or steps of actuators.
        subject: What it is about, as `EventKind.subject` says.
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


def told(event: Happening) -> str:
    """An event in a few words."""
    if event.kind not in EventKind.__members__:
        return f"{plain_name(event.kind.lower())}: {number(event.value)}"
    return EventKind[event.kind].phrase.format(
        jacobian=plain_name(event.jacobian),
        joints=listed(event.joints),
        phase=plain_name(event.phase),
        value=quantity(event.value, event.unit),
        threshold=quantity(event.threshold, event.unit),
        mm=f"{1e3 * event.value:.2f}",
    )


def plain_name(name: str) -> str:
    """A name of the code as words: ``closed_chain`` is "closed chain"."""
    return name.replace("_", " ").replace("-", " ")


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}"


def quantity(value: float, unit: str) -> str:
    """A value with its unit as people read it: angles in degrees, lengths in millimetres."""
    if unit == "rad":
        return f"{math.degrees(value):.4g} deg"
    return f"{1e3 * value:.4g} mm" if unit == "m" else number(value)


def plural(count: int, thing: str) -> str:
    """How many of a thing: "1 restart", "2 restarts"."""
    return f"{count} {thing}" + ("" if count == 1 else "s")


def listed(names: Sequence[str], most: int = 4) -> str:
    """Names with commas, the first few of many."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def errors_text(position: float, angle: float) -> str:
    """Distance and angle to a contact; what is free (NaN) is left out.

    Args:
        position: [m].
        angle: [rad].
    """
    parts = [] if math.isnan(position) else [f"{1e3 * position:.2f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.2f} deg"]
    return " and ".join(parts) or "free"


# How events are stored.


def jacobian_names(form: TraceFormat) -> tuple[str, ...]:
    """Names of the Jacobians whose measures a trace holds; one per element of such a field."""
    found = (name for item in form.layout for name in measured_jacobians(form, item))
    return tuple(dict.fromkeys(found))


def measured_jacobians(form: TraceFormat, item: Field) -> tuple[str, ...]:
    """Names of the Jacobians that the elements of a field measure; none if it measures none."""
    name = item.name.removeprefix(SIGMA).removeprefix(CONDITION)
    if name == item.name:
        return ()
    labels = form.labels.get(item.name, ())
    parts = (*labels[: item.size], *map(str, range(len(labels), item.size)))
    return tuple(f"{name}[{part}]" for part in parts) if item.shape else (name,)


def mask_words(form: TraceFormat) -> int:
    """Number of 32-bit words of a mask of all actuators."""
    sizes = {item.name: item.size for item in form.layout}
    coordinates = -(-sizes.get(Q.name, 1) // WORD_BITS)
    masks = (sizes.get(mask.name, 1) for mask in (LIMIT_MASK, ACTIVE_MASK))
    return max(coordinates, *masks)


def event_layout(words: int) -> Layout:
    """Fields of an event whose mask of actuators has so many words."""
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
    """Layout and labels of the events of a method whose traces have the given format."""
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


# How they are found.


class Found(NamedTuple):
    """Events of a kind: their rows (e,), and the rest as numbers or (e,), joints as (e, words)."""

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
    """All events of several solves, by solve and iteration.

    Args:
        form: How to read the rows.
        rows: (m,) the rows of one solve after the other.
        counts: (k,) how many rows each solve has.
        rules: When something counts as an event.

    Returns:
        (e,) rows of `event_format`; "solve_id" counts the solves from 0.
    """
    traces = Traces(form, rows, counts, rules or EventRules())
    with np.errstate(invalid="ignore"):
        found = [each for finder in FINDERS for each in finder(traces)] if len(rows) else []
    found = [each for each in found if len(each.row)]
    row = np.concatenate([np.zeros(0, np.intp), *(each.row for each in found)])
    events = np.zeros(len(row), event_format(form).layout.dtype)
    first, masks = 0, as_matrix(events["joint_mask"])
    for each in found:
        part = slice(first, first := first + len(each.row))
        for name in ("kind", "value", "threshold", "jacobian"):
            events[name][part] = getattr(each, name)
        joints = np.asarray(each.joints)
        masks[part, : joints.shape[-1] if joints.ndim else None] = joints
    solve = traces.solve[row]
    events["solve_id"] = solve
    events["iteration"] = row - traces.starts[solve]
    if PHASE.name in traces.names:
        events["phase"] = traces.column(PHASE.name)[row]
    return events[np.argsort(row * len(EventKind) + events["kind"], kind="stable")]


@dataclass(frozen=True)
class Measured:
    """A Jacobian with the columns of a trace that measure it.

    Attributes:
        joints: Actuators whose motion it maps.
        singular: Threshold of its smallest singular value.
        condition: Threshold of its condition number.
        columns: Field and column of `SIGMA` and of `CONDITION`, as far as there are any.
    """

    joints: tuple[str, ...]
    singular: float
    condition: float
    columns: dict[str, tuple[str, int]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Traces:
    """Rows of several solves, one solve after the other.

    Attributes:
        form: How to read them.
        rows: (m,) of the format's layout.
        counts: (k,) rows of each solve.
        rules: When something counts as an event.
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
        """(m,) the solve that a row belongs to, from 0."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @cached_property
    def starts(self) -> Rows:
        """(k,) first row of each solve."""
        return np.cumsum(self.counts) - self.counts

    @cached_property
    def firsts(self) -> Rows:
        """The rows that are the first of their solves."""
        return self.starts[self.counts > 0]

    @cached_property
    def piece(self) -> NDArray[np.int32]:
        """(m,) number of the stretch of one solve, phase and start that a row belongs to."""
        new = np.zeros(len(self.rows), dtype=bool)
        new[self.firsts] = True
        for name in (PHASE.name, RESTART.name):
            if name in self.names:
                codes = self.column(name)
                new[1:] |= codes[1:] != codes[:-1]
        return np.cumsum(new, dtype=np.int32)

    @cached_property
    def jacobians(self) -> list[Measured]:
        """The measured Jacobians in the order of `jacobian_names`."""
        found: dict[str, Measured] = {}
        for item in self.form.layout:
            kind = SIGMA if item.name.startswith(SIGMA) else CONDITION
            name = item.name.removeprefix(kind)
            known = self.form.jacobians.get(name, RecordedJacobian())
            singular = self.rules.singular.get(name, known.singular)
            condition = self.rules.condition.get(name, known.condition)
            for column, label in enumerate(measured_jacobians(self.form, item)):
                new = Measured(known.joints, singular, condition)
                found.setdefault(label, new).columns[kind] = item.name, column
        return list(found.values())

    def matrix(self, name: str) -> NDArray[Any]:
        """A field of all rows, (m, size); a view."""
        return as_matrix(self.rows[name])

    def column(self, name: str, column: int = 0) -> NDArray[Any]:
        """One column of a field of all rows, (m,) in one piece."""
        key = f"{name}.{column}"
        if key not in self._columns:
            self._columns[key] = np.ascontiguousarray(self.matrix(name)[:, column])
        return self._columns[key]

    def columns(self, name: str) -> NDArray[Any]:
        """A field of all rows as (size, m), each column in one piece: this runs faster."""
        return self.matrix(name).T.copy(order="C")

    def before(self, values: NDArray[Any], start: ArrayLike) -> NDArray[Any]:
        """Values (m, ...) in the row before each; in the first rows of solves `start`."""
        before = np.empty_like(values)
        before[1:] = values[:-1]
        before[self.firsts] = start
        return before

    def longer(self, window: int) -> tuple[Traces, Rows]:
        """The solves that have more rows than a window, and the numbers of their rows."""
        wanted = self.counts > window
        number = np.flatnonzero(np.repeat(wanted, self.counts))
        if wanted.all():
            return self, number
        return Traces(
            self.form, np.take(self.rows, number), self.counts[wanted], self.rules
        ), number

    def nearest_singular(self, row: Rows) -> NDArray[np.int64]:
        """Number of the Jacobian that is nearest to its threshold in each row, from 1 on.

        0 where none has come nearer than the factor `EventRules.release`.
        """
        distance = np.full((len(row), len(self.jacobians) + 1), np.inf)
        distance[:, 0] = self.rules.release
        for number, jacobian in enumerate(self.jacobians, start=1):
            if SIGMA in jacobian.columns and jacobian.singular > 0:
                value = self.column(*jacobian.columns[SIGMA])[row] / jacobian.singular
                distance[:, number] = np.where(np.isnan(value), np.inf, value)
        return np.argmin(distance, axis=1)

    def words(self, joints: Bools) -> Words:
        """Actuators (e, n) as words (e, words) of a mask."""
        padded = np.zeros((len(joints), 32 * mask_words(self.form)), dtype=bool)
        padded[:, : joints.shape[1]] = joints
        return words_of(padded)


def _changes(traces: Traces) -> Iterator[Found]:
    """Another phase, or another start."""
    for name, kind in ((PHASE.name, EventKind.PHASE_CHANGE), (RESTART.name, EventKind.RESTART)):
        if name in traces.names:
            codes = traces.column(name)
            before = traces.before(codes, codes[traces.firsts])
            row = np.flatnonzero(codes != before)
            yield Found(kind, row, codes[row], before[row])


def _limits(traces: Traces) -> Iterator[Found]:
    """Bits of the limit mask that come and go.

    Before the first row of a solve no bit counts as set, so a start on a limit is a hit. A bit
    that goes while the coordinate stays within `EventRules.limit_slack` of where it was on the
    limit is no leaving; if it comes again before the coordinate has moved, that is no hit.
    """
    if LIMIT_MASK.name not in traces.names:
        return
    mask = np.ascontiguousarray(traces.matrix(LIMIT_MASK.name))
    before = traces.before(mask, 0)
    hit, hit_bit = _places(mask & ~before)
    left, left_bit = _places(before & ~mask)
    limit, ends = (
        _q(traces, left - 1, left_bit),
        (traces.starts + traces.counts)[traces.solve[left]],
    )
    no_hit, leaves = np.zeros(len(hit), dtype=bool), np.ones(len(left), dtype=bool)
    # Those that have not moved yet are looked at a row later, up to the next hit or the end.
    still = np.arange(len(left))
    while True:
        row, bit = left[still], left_bit[still]
        still = still[np.abs(_q(traces, row, bit) - limit[still]) <= traces.rules.limit_slack]
        if not len(still):
            break
        left[still] += 1
        row, bit = left[still], left_bit[still]
        over = row == ends[still]
        words = mask[np.where(over, 0, row), bit >> 5] >> (bit & 31).astype(np.uint32)
        back = ~over & (words & 1 > 0)
        no_hit |= np.isin(hit * 2**16 + hit_bit, (row * 2**16 + bit)[back])
        leaves[still[over | back]] = False
        still = still[~(over | back)]
    hit, hit_bit = hit[~no_hit], hit_bit[~no_hit]
    left, left_bit, limit = left[leaves], left_bit[leaves], limit[leaves]
    for kind, row, bit, threshold in (
        (EventKind.LIMIT_HIT, hit, hit_bit, _q(traces, hit, hit_bit)),
        (EventKind.LIMIT_LEFT, left, left_bit, limit),
    ):
        joints = np.zeros((len(row), mask_words(traces.form)), np.uint32)
        joints[np.arange(len(row)), bit >> 5] = 1 << (bit & 31)
        yield Found(kind, row, _q(traces, row, bit), threshold, joints)


def _active(traces: Traces) -> Iterator[Found]:
    """Constraints that join or leave the active set."""
    if ACTIVE_MASK.name in traces.names:
        mask = np.ascontiguousarray(traces.matrix(ACTIVE_MASK.name))
        before = traces.before(mask, mask[traces.firsts])
        changes = ((EventKind.ACTIVATED, mask & ~before), (EventKind.RELEASED, before & ~mask))
        for kind, joints in changes:
            row = np.flatnonzero(joints.any(axis=1))
            size, size_before = (bits_of(words[row]).sum(axis=1) for words in (mask, before))
            yield Found(kind, row, size, size_before, joints[row])


def _collisions(traces: Traces) -> Iterator[Found]:
    """Where the clearance falls below the margin and where it is back above it.

    Before the first row of a solve nothing counts as touched, so a start in collision is an entry.
    """
    if CLEARANCE in traces.names:
        clearance, margin = traces.column(CLEARANCE), traces.rules.clearance
        # Clearances are kept in single precision.
        touching = clearance < margin - 1e-7
        before = traces.before(touching, False)
        for kind, there in (
            (EventKind.COLLISION_ENTERED, touching & ~before),
            (EventKind.COLLISION_LEFT, ~touching & before),
        ):
            row = np.flatnonzero(there)
            yield Found(kind, row, clearance[row], margin)


def _singular(traces: Traces) -> Iterator[Found]:
    """Where a Jacobian comes to be singular; the entry only.

    It may enter again once it was better than its threshold by the factor `EventRules.release`,
    or was not computed (NaN) in between.
    """
    names, release = _actuators(traces.form), traces.rules.release
    for number, jacobian in enumerate(traces.jacobians, start=1):
        joints = traces.words(np.array([[name in jacobian.joints for name in names]], dtype=bool))
        if SIGMA in jacobian.columns and jacobian.singular > 0:
            value, limit = traces.column(*jacobian.columns[SIGMA]), jacobian.singular
            row = _entries(traces, value < limit, ~(value <= limit * release))
            yield Found(EventKind.NEAR_SINGULAR, row, value[row], limit, joints, number)
        if CONDITION in jacobian.columns and jacobian.condition < math.inf:
            value, limit = traces.column(*jacobian.columns[CONDITION]), jacobian.condition
            row = _entries(traces, value > limit, ~(value >= limit / release))
            yield Found(EventKind.ILL_CONDITIONED, row, value[row], limit, joints, number)


def _stalls(traces: Traces) -> Iterator[Found]:
    """Where the error has stood still over the window; the entry only.

    Standing still: over the last `EventRules.stall_window` iterations, none of them in another
    phase or restart, the errors spread by at most `EventRules.stall_change` of the largest of
    them (largest of all fingers, so that a finger in place cannot hide the one that is stuck).
    """
    window, limit = traces.rules.stall_window, traces.rules.stall_change
    longer, number = traces.longer(window)
    if not (groups := _errors(longer)):
        return
    spread = largest = np.zeros(len(number) - window)
    for errors in groups:
        high, low = (_over_window(errors, window + 1, pick) for pick in (np.maximum, np.minimum))
        top = high.max(axis=0)
        spread = np.maximum(spread, (high - low).max(axis=0) / np.where(top > 0, top, 1))
        largest = np.maximum(largest, top)
    found = _begins(_one_piece(longer, window) & (spread <= limit) & (largest > 0))
    row, at_limit = number[found + window], 0
    if LIMIT_MASK.name in traces.names:
        at_limit = traces.matrix(LIMIT_MASK.name)[row]
    near = traces.nearest_singular(row)
    yield Found(EventKind.STALL, row, spread[found], limit, at_limit, near)


def _oscillations(traces: Traces) -> Iterator[Found]:
    """Where coordinates go to and fro without progress; the entry only.

    To and fro: every step of the coordinate in the last `EventRules.oscillation_window`
    iterations is longer than `EventRules.oscillation_step` and against the one before. Without
    progress: no error has fallen by more than `EventRules.oscillation_progress` over these
    iterations.
    """
    rules, window = traces.rules, traces.rules.oscillation_window
    longer, number = traces.longer(window)
    if Q.name not in traces.names or not len(number):
        return
    steps = np.diff(longer.columns(Q.name), axis=1)
    up, down = steps > rules.oscillation_step, steps < -rules.oscillation_step
    turning = (up[:, 1:] & down[:, :-1]) | (down[:, 1:] & up[:, :-1])
    swinging = _over_window(turning, window - 1, np.minimum)
    caught = np.logical_or.reduce(swinging, axis=0)
    if caught.any():
        caught &= _one_piece(longer, window)
        for errors in _errors(longer):
            norm = np.sqrt(np.einsum("ij,ij->j", errors, errors))
            caught &= norm[window:] >= (1 - rules.oscillation_progress) * norm[:-window]
    found = _begins(caught)
    joints, row = swinging[:, found].T, number[found + window]
    step = np.where(joints, np.abs(steps[:, found + window - 1]).T, 0).max(axis=1)
    words, near = traces.words(joints), traces.nearest_singular(row)
    yield Found(EventKind.OSCILLATION, row, step, rules.oscillation_step, words, near)


FINDERS: tuple[Callable[[Traces], Iterator[Found]], ...] = (
    *(_changes, _limits, _active, _collisions, _singular, _stalls, _oscillations),
)
"""Each looks at the traces of all solves in one go."""


def _begins(holds: Bools) -> Rows:
    """Where a condition holds that did not hold in the row before.

    It never holds in the first rows of a solve, so that solves need no telling apart.
    """
    return np.flatnonzero(holds & ~np.concatenate([[False], holds[:-1]]))


def _errors(traces: Traces) -> list[NDArray[Any]]:
    """What a solve brings down, (columns, m) per unit; a column that is never a number is zero."""
    fields = (COST,) if COST.name in traces.names else (POSITION_ERROR, ANGLE_ERROR)
    found = []
    for name in (item.name for item in fields if item.name in traces.names and len(traces.rows)):
        errors = np.abs(traces.columns(name))
        missing = np.isnan(errors)
        if missing.any():
            never = np.logical_and.reduceat(missing, traces.starts, axis=1)
            errors[np.repeat(never, traces.counts, axis=1)] = 0
        found.append(errors)
    return found


def _one_piece(traces: Traces, window: int) -> Bools:
    """For each row from `window` on: do the last `window` steps lie in one phase and restart."""
    return traces.piece[window:] == traces.piece[:-window]


def _entries(traces: Traces, begun: Bools, ended: Bools) -> Rows:
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


def _over_window(values: NDArray[Any], window: int, pick: np.ufunc) -> NDArray[Any]:
    """Largest or smallest of each `window` columns one after the other, (n, m - window + 1)."""
    width = 1
    while 2 * width <= window:
        values = pick(values[:, width:], values[:, :-width])
        width *= 2
    rest = window - width
    return pick(values[:, rest:], values[:, :-rest]) if rest else values


def as_matrix(values: NDArray[Any]) -> NDArray[Any]:
    """Values (k, ...) as (k, size)."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def bits_of(mask: NDArray[Any]) -> Bools:
    """The bits of unsigned words (m, words), least significant first, (m, 8 * bytes)."""
    octets = np.ascontiguousarray(mask).view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little").astype(bool)


def words_of(bits: Bools) -> Words:
    """The inverse of `bits_of` for 32-bit words."""
    return np.packbits(bits, axis=1, bitorder="little").view("<u4")


def _places(words: NDArray[Any]) -> tuple[Rows, Rows]:
    """Row and bit, both (e,), of every bit that is set in words (m, words)."""
    flat = words.reshape(-1)
    some = np.flatnonzero(flat)
    place, bit = np.nonzero(bits_of(flat[some][:, None]))
    row, word = np.divmod(some[place], words.shape[1])
    return row, word * 32 + bit


def _q(traces: Traces, row: Rows, bit: Rows) -> NDArray[Any]:
    """Coordinates (e,); NaN where the trace has none."""
    values = np.full(len(row), np.nan)
    if Q.name in traces.names:
        q = traces.matrix(Q.name)
        known = bit < q.shape[1]
        values[known] = q[row[known], bit[known]]
    return values
