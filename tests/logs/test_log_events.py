"""Events on traces built so that the answer is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs import EventRules, detect_events
from casadi_ik.solvers.recorder import Event, EventKind

STORAGE = {"phase": "u1", "restart": "u4", "limit_mask": "u4", "active_mask": "u4"}


def trace_of(**columns: Any) -> tuple[Layout, np.ndarray]:
    """A layout and trace with these columns, (k,) or (k, ...)."""
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    layout = Layout.record(
        *(Field(name, a.shape[1:], STORAGE.get(name, "f8")) for name, a in arrays.items())
    )
    trace = np.zeros(len(next(iter(arrays.values()))), layout.dtype)
    for name, values in arrays.items():
        trace[name] = values
    return layout, trace


def where(events: tuple[Event, ...], kind: EventKind) -> list[int]:
    return [event.iteration for event in events if event.kind is kind]


def test_phase_changes_and_restarts() -> None:
    layout, trace = trace_of(phase=[0, 0, 1, 1, 0, 2], restart=[0, 0, 0, 0, 1, 1])
    events = detect_events(layout, trace, {"phase": ("reach", "align", "refine")})
    assert events == (
        Event(2, EventKind.PHASE_CHANGE, "reach -> align", 1.0, 0.0),
        Event(4, EventKind.RESTART, "0 -> 1", 1.0, 0.0),
        Event(4, EventKind.PHASE_CHANGE, "align -> reach", 0.0, 1.0),
        Event(5, EventKind.PHASE_CHANGE, "reach -> refine", 2.0, 0.0),
    )
    assert detect_events(layout, trace)[0].subject == "0 -> 1"
    assert detect_events(layout, trace, {"phase": ("", "a")})[0].subject == "0 -> a"


def test_limits_hit_and_left() -> None:
    q = [[0.1, 2.0], [0.2, 1.9], [0.3, 1.8], [0.3, 1.7]]
    layout, trace = trace_of(q=q, limit_mask=[0b10, 0b00, 0b01, 0b01])
    events = detect_events(layout, trace, {"q": ("elbow", "wrist")})
    assert events == (
        Event(0, EventKind.LIMIT_HIT, "wrist", 2.0, 2.0),
        Event(1, EventKind.LIMIT_LEFT, "wrist", 1.9, 2.0),
        Event(2, EventKind.LIMIT_HIT, "elbow", 0.3, 0.3),
    )


def test_a_rounding_error_does_not_leave_a_limit() -> None:
    layout, trace = trace_of(
        q=np.array([[0.0], [1e-16], [1e-9], [0.0], [0.1], [0.0]]), limit_mask=[1, 0, 0, 1, 0, 1]
    )
    events = detect_events(layout, trace)
    assert [(e.iteration, e.kind) for e in events] == [
        (0, EventKind.LIMIT_HIT),
        (4, EventKind.LIMIT_LEFT),
        (5, EventKind.LIMIT_HIT),
    ]


def test_limits_without_coordinates() -> None:
    layout, trace = trace_of(limit_mask=[1, 0, 2])
    assert [(e.iteration, e.kind) for e in detect_events(layout, trace)] == [
        (0, EventKind.LIMIT_HIT),
        (1, EventKind.LIMIT_LEFT),
        (2, EventKind.LIMIT_HIT),
    ]


def test_the_highest_bits_and_wide_masks() -> None:
    masks = np.zeros((3, 2), np.uint32)
    masks[1, 0] = 1 << 31
    masks[2, 1] = 1 << 5
    layout = Layout.record(Field("limit_mask", (2,), "u4"))
    trace = np.zeros(3, layout.dtype)
    trace["limit_mask"] = masks
    events = detect_events(layout, trace)
    assert [(e.iteration, e.kind, e.subject) for e in events] == [
        (1, EventKind.LIMIT_HIT, "coordinate 31"),
        (2, EventKind.LIMIT_HIT, "coordinate 37"),
        (2, EventKind.LIMIT_LEFT, "coordinate 31"),
    ]


def test_active_set() -> None:
    layout, trace = trace_of(active_mask=[0b001, 0b001, 0b110, 0b110])
    events = detect_events(layout, trace, {"active_mask": ("a", "b", "c")})
    assert events == (Event(2, EventKind.ACTIVE_SET, "-a, +b, +c", 2.0, 1.0),)


def test_near_singular_on_entry_only() -> None:
    nan = np.nan
    sigma = [0.5, 0.05, 0.01, 0.12, 0.05, 0.2, 0.09, nan, 0.09, 0.5]
    layout, trace = trace_of(sigma_closed_chain=sigma)
    events = detect_events(layout, trace, rules=EventRules(singular={"closed_chain": 0.1}))
    assert [(e.iteration, e.value) for e in events] == [(1, 0.05), (6, 0.09), (8, 0.09)]
    assert {e.subject for e in events} == {"closed_chain"}
    assert {e.threshold for e in events} == {0.1}


def test_near_singular_from_the_start_and_per_finger() -> None:
    layout, trace = trace_of(sigma_finger=[[0.001, 1.0], [0.001, 1.0], [1.0, 0.001]])
    events = detect_events(layout, trace, {"sigma_finger": ("thumb", "index")})
    assert [(e.iteration, e.subject) for e in events] == [
        (0, "finger[thumb]"),
        (2, "finger[index]"),
    ]
    assert events[0].threshold == EventRules().singular_default


def test_no_events_while_converging() -> None:
    decay = 0.5 ** np.arange(40)
    q = np.stack([1 - decay, decay], axis=1)
    layout, trace = trace_of(q=q, cost=decay, sigma_arm=np.full(40, 0.3))
    assert detect_events(layout, trace) == ()


def test_stall_once_per_standstill() -> None:
    cost = np.concatenate([np.linspace(2, 1, 20), np.ones(30), np.linspace(0.9, 0.5, 5)])
    layout, trace = trace_of(cost=cost)
    events = detect_events(layout, trace)
    assert where(events, EventKind.STALL) == [29]
    assert events[0].subject == "whole solve"
    assert events[0].value <= events[0].threshold == 1e-4


def test_stall_by_errors_when_one_finger_is_stuck() -> None:
    """A finger that sits still in place is no stall while another one moves; then it is."""
    errors = np.full((40, 2), np.nan)
    errors[:, 0] = 1e-9 * (1 + np.arange(40) % 2)
    moving = errors.copy()
    moving[:, 1] = np.linspace(1, 0.5, 40)
    assert detect_events(*trace_of(position_error=moving)) == ()
    stuck = errors.copy()
    stuck[:, 1] = 0.3
    assert where(detect_events(*trace_of(position_error=stuck)), EventKind.STALL) == [10]
    free = np.stack([np.full(40, 0.3), np.full(40, np.nan)], axis=1)
    assert where(detect_events(*trace_of(position_error=free)), EventKind.STALL) == [10]


def test_no_stall_at_zero_error_or_across_phases() -> None:
    assert detect_events(*trace_of(cost=np.zeros(40))) == ()
    layout, trace = trace_of(cost=np.ones(36), phase=np.arange(36) // 9)
    assert where(detect_events(layout, trace), EventKind.STALL) == []


def test_oscillation_names_the_joints() -> None:
    k = np.arange(30)
    q = np.zeros((30, 3))
    q[5:, 1] = 0.1 * (-1.0) ** k[5:]
    q[:, 2] = 0.01 * k
    layout, trace = trace_of(q=q, cost=1 + 0.01 * (k % 2))
    events = detect_events(layout, trace, {"q": ("a", "b", "c")})
    assert [e.kind for e in events] == [EventKind.OSCILLATION]
    assert events[0].subject == "b"
    assert events[0].iteration == 10  # the step into row 5 is the first of six
    assert events[0].value == pytest.approx(0.2)


def test_oscillation_with_progress_is_none() -> None:
    k = np.arange(30)
    q = 0.1 * (-0.8) ** k
    assert detect_events(*trace_of(q=q[:, None], cost=np.abs(q))) == ()


def test_five_swings_or_tiny_ones_are_no_oscillation() -> None:
    k = np.arange(30)
    q = np.where(k < 6, 0.1 * (-1.0) ** k, 0.0)[:, None]
    assert where(detect_events(*trace_of(q=q)), EventKind.OSCILLATION) == [6]
    q = np.where(k < 5, 0.1 * (-1.0) ** k, 0.0)[:, None]
    assert where(detect_events(*trace_of(q=q)), EventKind.OSCILLATION) == []
    tiny = 1e-6 * (-1.0) ** k[:, None]
    assert detect_events(*trace_of(q=tiny)) == ()


def test_a_short_or_empty_or_foreign_trace() -> None:
    layout, trace = trace_of(q=np.zeros((1, 2)), cost=[1.0], phase=[0])
    assert detect_events(layout, trace) == ()
    assert detect_events(layout, trace[:0]) == ()
    assert detect_events(*trace_of(damping=np.ones(40))) == ()


def test_non_finite_numbers_are_no_event() -> None:
    cost = np.full(40, np.inf)
    q = np.full((40, 2), np.nan)
    assert detect_events(*trace_of(cost=cost, q=q, sigma_arm=np.full(40, np.nan))) == ()


def test_windows_are_checked() -> None:
    with pytest.raises(InputError, match="windows"):
        EventRules(oscillation_window=2)
