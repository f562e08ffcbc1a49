"""Finds in traces what is worth a line of its own, going by the names of the fields.

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
no events. All solves of a block are looked at in one go.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arrays import Bools
from casadi_ik.logs.events.collisions import collisions
from casadi_ik.logs.events.kinds import EventKind, event_format, mask_words
from casadi_ik.logs.events.limits import limit_changes
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.events.singular import jacobians, near_singular, nearest_singular
from casadi_ik.logs.events.standstill import oscillations, stalls
from casadi_ik.logs.events.traces import Rows, Traces, Words, bits_of, words_of
from casadi_ik.problem.trace import (
    ACTIVE_MASK,
    CLEARANCE,
    LIMIT_MASK,
    PHASE,
    RESTART,
    TraceFormat,
)


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
    traces, rules = Traces(form, rows, counts), rules or EventRules()
    collected = _Collected(traces)
    if len(rows):
        with np.errstate(invalid="ignore"):
            _collect(collected, traces, rules)
    return collected.sorted()


def _collect(collected: _Collected, traces: Traces, rules: EventRules) -> None:
    for field, kind in ((PHASE, EventKind.PHASE_CHANGE), (RESTART, EventKind.RESTART)):
        if field.name in traces.names:
            codes = traces.column(field.name)
            row = np.flatnonzero((codes[1:] != codes[:-1]) & ~traces.first[1:]) + 1
            collected.add(row, kind, codes[row], codes[row - 1])
    if LIMIT_MASK.name in traces.names:
        for kind, change in limit_changes(traces, rules.limit_slack):
            joints = np.zeros((len(change.row), collected.words), np.uint32)
            joints[np.arange(len(joints)), change.bit >> 5] = 1 << (change.bit & 31)
            collected.add(change.row, kind, change.value, change.limit, joints)
    if ACTIVE_MASK.name in traces.names:
        mask = traces.mask(ACTIVE_MASK.name)
        before = traces.before(mask, mask[traces.firsts])
        changes = ((EventKind.ACTIVATED, mask & ~before), (EventKind.RELEASED, before & ~mask))
        for kind, joints in changes:
            row = np.flatnonzero(joints.any(axis=1))
            size, size_before = (bits_of(words[row]).sum(axis=1) for words in (mask, before))
            collected.add(row, kind, size, size_before, joints[row])
    if CLEARANCE in traces.names:
        for kind, row, value in collisions(traces, rules):
            collected.add(row, kind, value, rules.clearance)
    known = jacobians(traces.form, rules)
    for number, jacobian in enumerate(known, start=1):
        for kind, row, value, threshold in near_singular(traces, jacobian, rules):
            collected.add(row, kind, value, threshold, collected.mask(jacobian.joints), number)
    row, value = stalls(traces, rules)
    at_limit = traces.matrix(LIMIT_MASK.name)[row] if LIMIT_MASK.name in traces.names else 0
    number = nearest_singular(traces, known, row, rules)
    collected.add(row, EventKind.STALL, value, rules.stall_change, at_limit, number)
    row, value, swinging = oscillations(traces, rules)
    joints, number = collected.masks(swinging), nearest_singular(traces, known, row, rules)
    collected.add(row, EventKind.OSCILLATION, value, rules.oscillation_step, joints, number)


class _Collected:
    """Events as they are found, in any order."""

    def __init__(self, traces: Traces) -> None:
        self._traces = traces
        self._form = event_format(traces.form)
        self._found: list[tuple[NDArray[Any], ...]] = []
        self.words = mask_words(traces.form)

    def masks(self, joints: Bools) -> Words:
        """Which actuators (e, n) as words (e, words)."""
        padded = np.zeros((len(joints), 32 * self.words), dtype=bool)
        padded[:, : joints.shape[1]] = joints
        return words_of(padded)

    def mask(self, joints: tuple[str, ...]) -> Words:
        """(1, words) these actuators."""
        names = self._form.labels["joint_mask"]
        return self.masks(np.array([[name in joints for name in names]], dtype=bool))

    def add(
        self,
        row: Rows,
        kind: EventKind,
        value: ArrayLike,
        threshold: ArrayLike,
        joints: ArrayLike = 0,
        jacobian: ArrayLike = 0,
    ) -> None:
        """Take events: their rows (e,), and the rest as numbers or (e,), the joints (e, words)."""
        count = len(row)
        if not count:
            return
        words = np.zeros((count, self.words), np.uint32)
        joints = np.asarray(joints)
        words[:, : joints.shape[-1] if joints.ndim else None] = joints
        columns = [np.broadcast_to(column, count) for column in (kind, value, threshold, jacobian)]
        self._found.append((row, words, *columns))

    def sorted(self) -> NDArray[Any]:
        """The events by row and kind, their solve, iteration and phase filled in."""
        dtype = self._form.layout.dtype
        if not self._found:
            return np.zeros(0, dtype)
        row, words, kind, *rest = map(np.concatenate, zip(*self._found, strict=True))
        order = np.argsort(row * len(EventKind) + kind, kind="stable")
        events = np.zeros(len(order), dtype)
        events["joint_mask"] = words[order].reshape(events["joint_mask"].shape)
        row, events["kind"] = row[order], kind[order]
        for name, column in zip(("value", "threshold", "jacobian"), rest, strict=True):
            events[name] = column[order]
        solve = self._traces.solve[row]
        events["solve_id"] = solve
        events["iteration"] = row - self._traces.starts[solve]
        if PHASE.name in self._traces.names:
            events["phase"] = self._traces.column(PHASE.name)[row]
        return events
