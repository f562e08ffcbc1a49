"""Finds in a trace where a solve no longer gets anywhere: stalls and oscillations."""

from __future__ import annotations

import numpy as np

from casadi_ik.kernels.layout import Layout
from casadi_ik.logs.columns import Labels, Rows, columns, entries, label_of, name_of
from casadi_ik.logs.event_rules import EventRules
from casadi_ik.solvers.recorder import Event, EventKind


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
        for i, _ in entries(still[:, None], ~still[:, None])
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
    q = columns(trace["q"])
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
    for i, _ in entries(caught[:, None], ~caught[:, None]):
        joints = np.flatnonzero(swinging[i]).tolist()
        subject = ", ".join(name_of(labels.get("q", ()), joint, "coordinate") for joint in joints)
        step = float(np.abs(steps[i + window - 1, joints]).max())
        events.append(
            Event(i + window, EventKind.OSCILLATION, subject, step, rules.oscillation_step)
        )
    return events


def _errors(layout: Layout, trace: Rows) -> list[np.ndarray]:
    """What a solve brings down, one matrix per unit; columns that are never a number left out."""
    names = ("cost",) if "cost" in layout.names else ("position_error", "angle_error")
    matrices = [np.abs(columns(trace[name])) for name in names if name in layout.names]
    matrices = [matrix[:, ~np.isnan(matrix).all(axis=0)] for matrix in matrices]
    return [matrix for matrix in matrices if matrix.shape[1]]


def _one_piece(layout: Layout, trace: Rows, window: int) -> np.ndarray:
    """For each row from `window` on: do the last `window` steps lie in one phase and restart."""
    piece = np.zeros(len(trace), dtype=int)
    for name in ("phase", "restart"):
        if name in layout.names:
            piece[1:] += np.cumsum(np.diff(trace[name].astype(int)) != 0)
    return piece[window:] == piece[:-window]


def _phase_of(layout: Layout, trace: Rows, labels: Labels, row: int) -> str:
    if "phase" not in layout.names:
        return "whole solve"
    return label_of(labels, "phase", int(trace["phase"][row]))
