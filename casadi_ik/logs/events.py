"""Finds in traces what is worth a line of its own, going by the names of the fields.

==========================  ============================================================
field                       events
==========================  ============================================================
``phase``                   PHASE_CHANGE
``restart``, ``candidate``  RESTART (counters)
``limit_mask``              LIMIT_HIT, LIMIT_LEFT (one bit per actuated coordinate)
``active_mask``             ACTIVATED, RELEASED (one bit per constraint)
``sigma_<jacobian>``        NEAR_SINGULAR (smallest singular value; NaN while not computed)
``condition_<jacobian>``    ILL_CONDITIONED (condition number; NaN while not computed)
``cost``, or else           STALL, and the progress that OSCILLATION asks for
``position_error`` and
``angle_error``
``q``                       OSCILLATION
==========================  ============================================================

Fields that a layout does not have give no events. All solves of a block are looked at in one go.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.logs.event_kinds import EventKind, event_format, mask_words
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.logs.limit_events import limit_changes
from casadi_ik.logs.message import octets_of
from casadi_ik.logs.singular_events import jacobians, near_singular, nearest_singular
from casadi_ik.logs.standstill import oscillations, stalls
from casadi_ik.logs.traces import Bools, Rows, Traces, bits_of, words_of
from casadi_ik.solvers.method import TraceFormat


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
    for name, kind in (
        ("phase", EventKind.PHASE_CHANGE),
        *((name, EventKind.RESTART) for name in traces.starts_fields),
    ):
        if name in traces.names:
            row, before, after = _code_changes(traces, name)
            collected.add(row, kind, after, before)
    if "limit_mask" in traces.names:
        for kind, change in limit_changes(traces, rules.limit_slack):
            joints = np.zeros((len(change.row), collected.bits), dtype=bool)
            joints[np.arange(len(joints)), change.bit] = True
            collected.add(change.row, kind, change.value, change.limit, joints)
    if "active_mask" in traces.names:
        bits, before = _mask_changes(traces, "active_mask")
        size, size_before = bits.sum(axis=1), before.sum(axis=1)
        changes = ((EventKind.ACTIVATED, bits & ~before), (EventKind.RELEASED, before & ~bits))
        for kind, joints in changes:
            row = np.flatnonzero(joints.any(axis=1))
            collected.add(row, kind, size[row], size_before[row], joints[row])
    known = jacobians(traces.form, rules)
    for number, jacobian in enumerate(known, start=1):
        for kind, row, value, threshold in near_singular(traces, jacobian, rules):
            joints = np.tile(collected.mask(jacobian.joints), (len(row), 1))
            collected.add(row, kind, value, threshold, joints, number)
    row, value = stalls(traces, rules)
    at_limit = None
    if "limit_mask" in traces.names:
        at_limit = bits_of(traces.matrix("limit_mask")[row])
    number = nearest_singular(traces, known, row, rules)
    collected.add(row, EventKind.STALL, value, rules.stall_change, at_limit, number)
    row, value, joints = oscillations(traces, rules)
    number = nearest_singular(traces, known, row, rules)
    collected.add(row, EventKind.OSCILLATION, value, rules.oscillation_step, joints, number)


def _code_changes(traces: Traces, name: str) -> tuple[Rows, NDArray[Any], NDArray[Any]]:
    """Rows whose code differs from that before, the first rows excepted, and both codes."""
    codes = traces.matrix(name)[:, 0]
    row = np.flatnonzero((codes[1:] != codes[:-1]) & ~traces.first[1:]) + 1
    return row, codes[row - 1], codes[row]


def _mask_changes(traces: Traces, name: str) -> tuple[Bools, Bools]:
    """The bits of a mask and those in the row before, the same in the first row."""
    bits = bits_of(traces.matrix(name))
    before = np.concatenate([bits[:1], bits[:-1]])
    before[traces.first] = bits[traces.first]
    return bits, before


class _Collected:
    """Events as they are found, in any order."""

    def __init__(self, traces: Traces) -> None:
        self._traces = traces
        self._form = event_format(traces.form)
        self._dtype = self._form.layout.dtype
        self._rows = [np.zeros(0, np.intp)]
        self._events = [np.zeros(0, self._dtype)]
        self.bits = 32 * mask_words(traces.form)

    def mask(self, joints: tuple[str, ...]) -> Bools:
        """(bits,) which actuators these are."""
        names = self._form.labels["joint_mask"]
        mask = np.zeros(self.bits, dtype=bool)
        mask[[names.index(joint) for joint in joints if joint in names]] = True
        return mask

    def add(
        self,
        row: Rows,
        kind: EventKind,
        value: ArrayLike,
        threshold: ArrayLike,
        joints: Bools | None = None,
        jacobian: ArrayLike = 0,
    ) -> None:
        """Take events: their rows (e,), and the rest as numbers or (e,), the joints (e, n)."""
        if not len(row):
            return
        events = np.zeros(len(row), self._dtype)
        events["kind"], events["value"], events["threshold"] = kind, value, threshold
        events["jacobian"] = jacobian
        if joints is not None:
            padded = np.zeros((len(row), self.bits), dtype=bool)
            padded[:, : joints.shape[1]] = joints
            events["joint_mask"] = words_of(padded).reshape(events["joint_mask"].shape)
        self._rows.append(row)
        self._events.append(events)

    def sorted(self) -> NDArray[Any]:
        """The events by row and kind, their solve, iteration and phase filled in."""
        row, octets = np.concatenate(self._rows), np.concatenate(list(map(octets_of, self._events)))
        kind = np.concatenate([events["kind"] for events in self._events])
        order = np.argsort(row * len(EventKind) + kind, kind="stable")
        row, events = row[order], octets[order].view(self._dtype)[:, 0]
        solve = self._traces.solve[row]
        events["solve_id"] = solve
        events["iteration"] = row - self._traces.starts[solve]
        if "phase" in self._traces.names:
            events["phase"] = self._traces.matrix("phase")[row, 0]
        return events
