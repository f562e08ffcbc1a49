"""Finds in traces where a solve no longer gets anywhere: stalls and oscillations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.logs.events.rules import EventRules
from casadi_ik.logs.events.traces import Rows, Traces, over_window
from casadi_ik.problem.trace import ANGLE_ERROR, COST, POSITION_ERROR, Q


def stalls(traces: Traces, rules: EventRules) -> tuple[Rows, Array]:
    """Where the error has stood still over the window; the entry only.

    Standing still: over the last `EventRules.stall_window` iterations, none of them in another
    phase or restart, the errors spread by at most `EventRules.stall_change` of the largest of
    them (largest of all fingers, so that a finger in place cannot hide the one that is stuck).

    Returns:
        Rows (e,) and the relative spread there (e,).
    """
    window = rules.stall_window
    traces, number = _longer(traces, window)
    groups = _errors(traces) if len(traces) else []
    if not groups:
        return np.zeros(0, np.intp), np.zeros(0)
    still, spread = _one_piece(traces, window), np.zeros(len(traces) - window)
    largest = np.zeros(len(traces) - window)
    for errors in groups:
        high, low = (over_window(errors, window + 1, top) for top in (True, False))
        top = high.max(axis=0)
        spread = np.maximum(spread, (high - low).max(axis=0) / np.where(top > 0, top, 1))
        largest = np.maximum(largest, top)
    still &= (spread <= rules.stall_change) & (largest > 0)
    found = _begins(still)
    return number[found + window], spread[found].astype(float)


def oscillations(traces: Traces, rules: EventRules) -> tuple[Rows, Array, Bools]:
    """Where coordinates go to and fro without progress; the entry only.

    To and fro: every step of the coordinate in the last `EventRules.oscillation_window`
    iterations is longer than `EventRules.oscillation_step` and against the one before. Without
    progress: no error has fallen by more than `EventRules.oscillation_progress` over these
    iterations.

    Returns:
        Rows (e,), the longest step into each (e,), which coordinates (e, n).
    """
    window = rules.oscillation_window
    traces, number = _longer(traces, window)
    if Q.name not in traces.names or not len(traces):
        return np.zeros(0, np.intp), np.zeros(0), np.zeros((0, 0), dtype=bool)
    steps = np.diff(traces.columns(Q.name), axis=1)
    up, down = steps > rules.oscillation_step, steps < -rules.oscillation_step
    turning = (up[:, 1:] & down[:, :-1]) | (down[:, 1:] & up[:, :-1])
    swinging = over_window(turning, window - 1, largest=False)
    caught = np.logical_or.reduce(swinging, axis=0)
    if caught.any():
        caught &= _one_piece(traces, window)
        for errors in _errors(traces):
            norm = np.sqrt(np.einsum("ij,ij->j", errors, errors))
            caught &= norm[window:] >= (1 - rules.oscillation_progress) * norm[:-window]
    found = _begins(caught)
    joints = swinging[:, found].T
    step = np.where(joints, np.abs(steps[:, found + window - 1]).T, 0).max(axis=1)
    return number[found + window], step, joints


def _longer(traces: Traces, window: int) -> tuple[Traces, Rows]:
    """The solves that have more rows than the window, and the numbers of their rows."""
    wanted = traces.counts > window
    return traces.of_solves(wanted), np.flatnonzero(np.repeat(wanted, traces.counts))


def _begins(holds: Bools) -> Rows:
    """Where a condition holds that did not hold in the row before.

    It never holds in the first rows of a solve, so that solves need no telling apart.
    """
    return np.flatnonzero(holds & ~np.concatenate([[False], holds[:-1]]))


def _errors(traces: Traces) -> list[NDArray[Any]]:
    """What a solve brings down, (columns, m) per unit; a column that is never a number is zero."""
    fields = (COST,) if COST.name in traces.names else (POSITION_ERROR, ANGLE_ERROR)
    found = []
    for name in (field.name for field in fields):
        if name in traces.names:
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
