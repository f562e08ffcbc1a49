"""Finds events in the traces of many solves at once, going by the names of the fields.

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

The standard fields are those of `casadi_ik.problem.trace`. One that a layout does not have gives
no events. A finder is a function in `FINDERS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arrays import Bools, Rows
from casadi_ik.logs.events import (
    EventKind,
    EventRules,
    event_format,
    mask_words,
    measured_jacobians,
)
from casadi_ik.problem.trace import (
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
    Q,
    RecordedJacobian,
    TraceFormat,
)

Words = NDArray[np.uint32]


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
    names, release = traces.form.labels.get(Q.name) or (), traces.rules.release
    names = names or traces.form.labels.get(LIMIT_MASK.name, ())
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
