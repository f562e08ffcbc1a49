"""Events on traces built so that the answer is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.logs import EventKind, EventRules, detect_events
from casadi_ik.logs.events import event_format
from casadi_ik.logs.tables import MethodRows, Table
from casadi_ik.problem.trace import RecordedJacobian, TraceFormat

STORAGE = {"phase": "u1", "restart": "u4", "limit_mask": "u4", "active_mask": "u4"}
Names = tuple[str, ...]


@dataclass(frozen=True)
class Event:
    """What a test expects."""

    iteration: int
    kind: EventKind
    subject: str
    value: float
    threshold: float
    joints: Names = ()
    jacobian: str = ""
    solve_id: int = 0


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


def found_in(
    layout: Layout,
    trace: np.ndarray,
    labels: Mapping[str, Names] | None = None,
    jacobians: Mapping[str, RecordedJacobian] | None = None,
    rules: EventRules | None = None,
    counts: Sequence[int] | None = None,
) -> tuple[Event, ...]:
    """All events, as a person reads them."""
    form = TraceFormat(layout, labels or {}, jacobians or {})
    count = np.array([len(trace)] if counts is None else counts)
    rows = detect_events(form, trace, count, rules)
    part = MethodRows("m", rows, rows["solve_id"], rows["iteration"], event_format(form).labels, {})
    return tuple(
        Event(
            record["iteration"],
            EventKind[record["kind"]],
            record["subject"],
            record["value"],
            record["threshold"],
            record["joint_mask"],
            record["jacobian"].removeprefix("none"),
            record["solve_id"],
        )
        for record in Table("event", (part,)).records()
    )


def where(events: tuple[Event, ...], kind: EventKind) -> list[int]:
    return [event.iteration for event in events if event.kind is kind]


def test_phase_changes_and_restarts() -> None:
    layout, trace = trace_of(phase=[0, 0, 1, 1, 0, 2], restart=[0, 0, 0, 0, 1, 1])
    events = found_in(layout, trace, {"phase": ("reach", "align", "refine")})
    assert events == (
        Event(2, EventKind.PHASE_CHANGE, "reach -> align", 1.0, 0.0),
        Event(4, EventKind.RESTART, "0 -> 1", 1.0, 0.0),
        Event(4, EventKind.PHASE_CHANGE, "align -> reach", 0.0, 1.0),
        Event(5, EventKind.PHASE_CHANGE, "reach -> refine", 2.0, 0.0),
    )
    assert found_in(layout, trace)[0].subject == "0 -> 1"
    assert found_in(layout, trace, {"phase": ("", "a")})[0].subject == "0 -> a"


def test_limits_hit_and_left() -> None:
    q = [[0.1, 2.0], [0.2, 1.9], [0.3, 1.8], [0.3, 1.7]]
    layout, trace = trace_of(q=q, limit_mask=[0b10, 0b00, 0b01, 0b01])
    events = found_in(layout, trace, {"q": ("elbow", "wrist")})
    assert events == (
        Event(0, EventKind.LIMIT_HIT, "wrist", 2.0, 2.0, ("wrist",)),
        Event(1, EventKind.LIMIT_LEFT, "wrist", 1.9, 2.0, ("wrist",)),
        Event(2, EventKind.LIMIT_HIT, "elbow", 0.3, 0.3, ("elbow",)),
    )


def test_a_rounding_error_does_not_leave_a_limit() -> None:
    layout, trace = trace_of(
        q=np.array([[0.0], [1e-16], [1e-9], [0.0], [0.1], [0.0]]), limit_mask=[1, 0, 0, 1, 0, 1]
    )
    events = found_in(layout, trace)
    assert [(e.iteration, e.kind) for e in events] == [
        (0, EventKind.LIMIT_HIT),
        (4, EventKind.LIMIT_LEFT),
        (5, EventKind.LIMIT_HIT),
    ]


def test_limits_without_coordinates() -> None:
    layout, trace = trace_of(limit_mask=[1, 0, 2])
    assert [(e.iteration, e.kind) for e in found_in(layout, trace)] == [
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
    events = found_in(layout, trace)
    assert [(e.iteration, e.kind, e.subject) for e in events] == [
        (1, EventKind.LIMIT_HIT, "coordinate 31"),
        (2, EventKind.LIMIT_HIT, "coordinate 37"),
        (2, EventKind.LIMIT_LEFT, "coordinate 31"),
    ]


def test_active_set() -> None:
    layout, trace = trace_of(active_mask=[0b001, 0b001, 0b110, 0b110])
    events = found_in(layout, trace, {"q": ("a", "b", "c")})
    assert events == (
        Event(2, EventKind.ACTIVATED, "b, c", 2.0, 1.0, ("b", "c")),
        Event(2, EventKind.RELEASED, "a", 2.0, 1.0, ("a",)),
    )


def test_near_singular_on_entry_only() -> None:
    """Below the threshold of the Jacobian's method, or the one given; with its joints."""
    nan = np.nan
    sigma = [0.5, 0.05, 0.01, 0.12, 0.05, 0.2, 0.09, nan, 0.09, 0.5]
    layout, trace = trace_of(sigma_closed_chain=sigma)
    chain = {"closed_chain": RecordedJacobian(("b", "c"), singular=0.1)}
    events = found_in(layout, trace, {"q": ("a", "b", "c")}, chain)
    assert [(e.iteration, e.value) for e in events] == [(1, 0.05), (6, 0.09), (8, 0.09)]
    assert {e.subject for e in events} == {e.jacobian for e in events} == {"closed_chain"}
    assert {e.threshold for e in events} == {0.1}
    assert {e.joints for e in events} == {("b", "c")}
    events = found_in(
        layout, trace, jacobians=chain, rules=EventRules(singular={"closed_chain": 0.02})
    )
    assert [(e.iteration, e.threshold) for e in events] == [(2, 0.02)]
    assert found_in(layout, trace) == (), "no threshold, no event"


def test_ill_conditioned_by_its_own_threshold() -> None:
    condition = [10.0, 400.0, 300.0, 150.0, 400.0, np.nan, 201.0]
    layout, trace = trace_of(condition_arm=condition, sigma_arm=np.ones(7))
    arm = {"arm": RecordedJacobian(("a",), singular=0.1, condition=200.0)}
    events = found_in(layout, trace, {"q": ("a",)}, arm)
    assert {e.kind for e in events} == {EventKind.ILL_CONDITIONED}
    # 150 is no release: it would have to fall below 200 / 1.5.
    assert [(e.iteration, e.value) for e in events] == [(1, 400.0), (6, 201.0)]
    assert {(e.jacobian, e.joints, e.threshold) for e in events} == {("arm", ("a",), 200.0)}


def test_near_singular_from_the_start_and_per_finger() -> None:
    layout, trace = trace_of(sigma_finger=[[0.001, 1.0], [0.001, 1.0], [1.0, 0.001]])
    fingers = {"finger": RecordedJacobian(singular=0.01)}
    events = found_in(layout, trace, {"sigma_finger": ("thumb", "index")}, fingers)
    assert [(e.iteration, e.subject) for e in events] == [
        (0, "finger[thumb]"),
        (2, "finger[index]"),
    ]


def test_a_singular_row_of_a_known_jacobian() -> None:
    """The singular values of an arm of two links, elbow straight in the middle of the way."""
    elbow = np.linspace(-0.5, 0.5, 11)
    shoulder = 0.3
    sigma, condition = [], []
    for angle in elbow:
        tip = np.exp(1j * (shoulder + angle))
        J = np.array(
            [
                [-(np.exp(1j * shoulder) + tip).imag, -tip.imag],
                [(np.exp(1j * shoulder) + tip).real, tip.real],
            ]
        )
        values = np.linalg.svd(J, compute_uv=False)
        sigma.append(values[-1])
        condition.append(min(values[0] / values[-1] if values[-1] else np.inf, 1e12))
    layout, trace = trace_of(sigma_arm=sigma, condition_arm=condition)
    arm = {"arm": RecordedJacobian(("shoulder", "elbow"), singular=0.03, condition=100.0)}
    events = found_in(layout, trace, {"q": ("shoulder", "elbow")}, arm)
    assert [(e.iteration, e.kind) for e in events] == [
        (5, EventKind.NEAR_SINGULAR),
        (5, EventKind.ILL_CONDITIONED),
    ]
    assert {e.joints for e in events} == {("shoulder", "elbow")}


def test_no_events_while_converging() -> None:
    decay = 0.5 ** np.arange(40)
    q = np.stack([1 - decay, decay], axis=1)
    layout, trace = trace_of(q=q, cost=decay, sigma_arm=np.full(40, 0.3))
    assert found_in(layout, trace, jacobians={"arm": RecordedJacobian(singular=0.1)}) == ()


def test_stall_once_per_standstill() -> None:
    cost = np.concatenate([np.linspace(2, 1, 20), np.ones(30), np.linspace(0.9, 0.5, 5)])
    layout, trace = trace_of(cost=cost)
    events = found_in(layout, trace)
    assert where(events, EventKind.STALL) == [29]
    assert events[0].subject == "whole solve"
    assert events[0].value <= events[0].threshold == 1e-4


def test_stall_by_errors_when_one_finger_is_stuck() -> None:
    """A finger that sits still in place is no stall while another one moves; then it is."""
    errors = np.full((40, 2), np.nan)
    errors[:, 0] = 1e-9 * (1 + np.arange(40) % 2)
    moving = errors.copy()
    moving[:, 1] = np.linspace(1, 0.5, 40)
    assert found_in(*trace_of(position_error=moving)) == ()
    stuck = errors.copy()
    stuck[:, 1] = 0.3
    assert where(found_in(*trace_of(position_error=stuck)), EventKind.STALL) == [10]
    free = np.stack([np.full(40, 0.3), np.full(40, np.nan)], axis=1)
    assert where(found_in(*trace_of(position_error=free)), EventKind.STALL) == [10]


def test_no_stall_at_zero_error_or_across_phases() -> None:
    assert found_in(*trace_of(cost=np.zeros(40))) == ()
    layout, trace = trace_of(cost=np.ones(36), phase=np.arange(36) // 9)
    assert where(found_in(layout, trace), EventKind.STALL) == []


def test_oscillation_names_the_joints() -> None:
    k = np.arange(30)
    q = np.zeros((30, 3))
    q[5:, 1] = 0.1 * (-1.0) ** k[5:]
    q[:, 2] = 0.01 * k
    layout, trace = trace_of(q=q, cost=1 + 0.01 * (k % 2))
    events = found_in(layout, trace, {"q": ("a", "b", "c")})
    assert [e.kind for e in events] == [EventKind.OSCILLATION]
    assert events[0].subject == "b"
    assert events[0].iteration == 10  # the step into row 5 is the first of six
    assert events[0].value == pytest.approx(0.2)


def test_a_standstill_names_the_singularity_and_the_limits_it_is_at() -> None:
    k = np.arange(30)
    sigma = np.stack([np.full(30, 0.02), np.full(30, 0.11)], axis=1)
    layout, trace = trace_of(
        q=0.1 * (-1.0) ** k[:, None], cost=np.ones(30), sigma_arm=sigma, limit_mask=np.full(30, 2)
    )
    arm = {"arm": RecordedJacobian(singular=0.1)}
    labels = {"q": ("a", "b"), "sigma_arm": ("point", "normal")}
    events = found_in(layout, trace, labels, arm)
    still = [e for e in events if e.kind in (EventKind.STALL, EventKind.OSCILLATION)]
    assert [(e.kind, e.jacobian, e.joints) for e in still] == [
        (EventKind.OSCILLATION, "arm[point]", ("a",)),
        (EventKind.STALL, "arm[point]", ("b",)),
    ]
    far = found_in(layout, trace, labels, {"arm": RecordedJacobian(singular=0.01)})
    assert {e.jacobian for e in far} == {""}


def test_oscillation_with_progress_is_none() -> None:
    k = np.arange(30)
    q = 0.1 * (-0.8) ** k
    assert found_in(*trace_of(q=q[:, None], cost=np.abs(q))) == ()


def test_five_swings_or_tiny_ones_are_no_oscillation() -> None:
    k = np.arange(30)
    q = np.where(k < 6, 0.1 * (-1.0) ** k, 0.0)[:, None]
    assert where(found_in(*trace_of(q=q)), EventKind.OSCILLATION) == [6]
    q = np.where(k < 5, 0.1 * (-1.0) ** k, 0.0)[:, None]
    assert where(found_in(*trace_of(q=q)), EventKind.OSCILLATION) == []
    tiny = 1e-6 * (-1.0) ** k[:, None]
    assert found_in(*trace_of(q=tiny)) == ()


def test_a_short_or_empty_or_foreign_trace() -> None:
    layout, trace = trace_of(q=np.zeros((1, 2)), cost=[1.0], phase=[0])
    assert found_in(layout, trace) == ()
    assert found_in(layout, trace[:0]) == ()
    assert found_in(*trace_of(damping=np.ones(40))) == ()


def test_non_finite_numbers_are_no_event() -> None:
    cost = np.full(40, np.inf)
    q = np.full((40, 2), np.nan)
    assert found_in(*trace_of(cost=cost, q=q, sigma_arm=np.full(40, np.nan))) == ()


def test_windows_are_checked() -> None:
    with pytest.raises(InputError, match="windows"):
        EventRules(oscillation_window=2)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), counts=st.lists(st.integers(0, 40), min_size=1, max_size=5))
def test_solves_do_not_see_each_other(seed: int, counts: list[int]) -> None:
    """A block of solves has the events of its solves, whatever stands before and after them."""
    rng = np.random.default_rng(seed)
    m = sum(counts)
    k = np.arange(m)
    still = rng.random() < 0.5
    layout, trace = trace_of(
        q=np.round(rng.normal(size=(m, 3)) * (-1.0) ** k[:, None], 1) * (rng.random(3) < 0.5),
        cost=np.ones(m) if still else rng.random(m),
        phase=np.sort(rng.integers(0, 3, m)),
        restart=np.sort(rng.integers(0, 2, m)),
        limit_mask=rng.integers(0, 4, m),
        active_mask=rng.integers(0, 4, m),
        sigma_arm=np.where(rng.random(m) < 0.2, np.nan, 10 ** rng.uniform(-2, 1, m)),
    )
    arm = {"arm": RecordedJacobian(singular=0.1)}
    together = found_in(layout, trace, None, arm, counts=counts)
    ends = np.cumsum(counts)
    alone = [
        Event(**{**vars(event), "solve_id": solve})
        for solve, (end, count) in enumerate(zip(ends, counts, strict=True))
        for event in found_in(layout, trace[end - count : end], None, arm)
    ]
    assert list(map(repr, together)) == list(map(repr, alone))
