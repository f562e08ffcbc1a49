"""Every kind of event is detected where it happens, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collision_queries import query_of_contacts
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_solves import (
    SINGULARITY_THRESHOLDS,
    Field,
    JacobianMeasures,
    Layout,
    RecordedJacobian,
    TraceFormat,
    event_format,
)

import casadi_ik as ik
from casadi_ik import errors, logs

STORAGE = {"phase": "u1", "restart": "u4", "limit_mask": "u4", "active_mask": "u4"}
Names = tuple[str, ...]


@dataclass(frozen=True)
class Event:
    """Expected event."""

    iteration: int
    kind: logs.EventKind
    subject: str
    value: float
    threshold: float
    joints: Names = ()
    jacobian: str = ""
    solve_id: int = 0


def trace_of(**columns: Any) -> tuple[Layout, np.ndarray]:
    """Return a layout and a trace with these columns, (k,) or (k, ...)."""
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
    rules: logs.EventRules | None = None,
    counts: Sequence[int] | None = None,
) -> tuple[Event, ...]:
    """Return all events with names instead of codes."""
    form = TraceFormat(layout, labels or {}, jacobians or {})
    count = np.array([len(trace)] if counts is None else counts)
    rows = logs.detect_events(form, trace, count, rules)
    part = logs.MethodRows(
        "m", rows, rows["solve_id"], rows["iteration"], event_format(form).labels, {}
    )
    return tuple(
        Event(
            record["iteration"],
            logs.EventKind[record["kind"]],
            record["subject"],
            record["value"],
            record["threshold"],
            record["joint_mask"],
            record["jacobian"].removeprefix("none"),
            record["solve_id"],
        )
        for record in logs.Table("event", (part,)).records()
    )


def iterations_of(events: tuple[Event, ...], kind: logs.EventKind) -> list[int]:
    return [event.iteration for event in events if event.kind is kind]


PHASES = ("reach", "align", "refine")
KIND = logs.EventKind
K = np.arange(40)


@pytest.mark.parametrize(
    ("columns", "labels", "expected"),
    [
        (
            {"phase": [0, 0, 1, 1, 0, 2], "restart": [0, 0, 0, 0, 1, 1]},
            {"phase": PHASES},
            [
                Event(2, KIND.PHASE_CHANGE, "reach -> align", 1.0, 0.0),
                Event(4, KIND.RESTART, "0 -> 1", 1.0, 0.0),
                Event(4, KIND.PHASE_CHANGE, "align -> reach", 0.0, 1.0),
                Event(5, KIND.PHASE_CHANGE, "reach -> refine", 2.0, 0.0),
            ],
        ),
        ({"phase": [0, 1]}, {}, [Event(1, KIND.PHASE_CHANGE, "0 -> 1", 1.0, 0.0)]),
        ({"phase": [0, 1]}, {"phase": ("", "a")}, [Event(1, KIND.PHASE_CHANGE, "0 -> a", 1, 0)]),
        (  # limits hit and left
            {"q": [[0.1, 2.0], [0.2, 1.9], [0.3, 1.8], [0.3, 1.7]], "limit_mask": [2, 0, 1, 1]},
            {"q": ("elbow", "wrist")},
            [
                Event(0, KIND.LIMIT_HIT, "wrist", 2.0, 2.0, ("wrist",)),
                Event(1, KIND.LIMIT_LEFT, "wrist", 1.9, 2.0, ("wrist",)),
                Event(2, KIND.LIMIT_HIT, "elbow", 0.3, 0.3, ("elbow",)),
            ],
        ),
        (  # a rounding error does not leave a limit
            {"q": [[0.0], [1e-16], [1e-9], [0.0], [0.1], [0.0]], "limit_mask": [1, 0, 0, 1, 0, 1]},
            {"q": ("a",)},
            [
                Event(0, KIND.LIMIT_HIT, "a", 0.0, 0.0, ("a",)),
                Event(4, KIND.LIMIT_LEFT, "a", 0.1, 0.0, ("a",)),
                Event(5, KIND.LIMIT_HIT, "a", 0.0, 0.0, ("a",)),
            ],
        ),
        (  # the active set
            {"active_mask": [0b001, 0b001, 0b110, 0b110]},
            {"q": ("a", "b", "c")},
            [
                Event(2, KIND.ACTIVATED, "b, c", 2.0, 1.0, ("b", "c")),
                Event(2, KIND.RELEASED, "a", 2.0, 1.0, ("a",)),
            ],
        ),
        # No events for convergence, a standstill at zero, or alternating progress.
        ({"q": np.stack([1 - 0.5**K, 0.5**K], axis=1), "cost": 0.5**K}, {}, []),
        ({"cost": np.zeros(40)}, {}, []),
        ({"q": 0.1 * (-0.8) ** K[:, None], "cost": 0.1 * 0.8**K}, {}, []),
        ({"q": 1e-6 * (-1.0) ** K[:, None]}, {}, []),
        ({"q": np.where(K < 5, 0.1 * (-1.0) ** K, 0.0)[:, None]}, {}, []),
        # No events for non-finite numbers or unknown fields.
        ({"q": np.zeros((1, 2)), "cost": [1.0], "phase": [0]}, {}, []),
        ({"cost": np.full(40, np.inf), "q": np.full((40, 2), np.nan)}, {}, []),
        ({"sigma_arm": np.full(40, np.nan)}, {}, []),
        ({"damping": np.ones(40)}, {}, []),
    ],
)
def test_events_of_a_trace(columns: dict, labels: dict, expected: list) -> None:
    assert found_in(*trace_of(**columns), labels) == tuple(expected)


def test_limits_without_coordinates_and_the_highest_bits() -> None:
    masks = np.zeros((3, 2), np.uint32)
    masks[0, 0], masks[1, 0], masks[2, 1] = 1, 1 << 31, 1 << 5
    layout = Layout.record(Field("limit_mask", (2,), "u4"))
    trace = np.zeros(3, layout.dtype)
    trace["limit_mask"] = masks
    events = found_in(layout, trace)
    assert [(e.iteration, e.kind, e.subject) for e in events] == [
        (0, KIND.LIMIT_HIT, "coordinate 0"),
        (1, KIND.LIMIT_HIT, "coordinate 31"),
        (1, KIND.LIMIT_LEFT, "coordinate 0"),
        (2, KIND.LIMIT_HIT, "coordinate 37"),
        (2, KIND.LIMIT_LEFT, "coordinate 31"),
    ]


def test_a_stall_ends_with_its_phase() -> None:
    layout, trace = trace_of(cost=np.ones(36), phase=np.arange(36) // 9)
    assert iterations_of(found_in(layout, trace), KIND.STALL) == []


def test_near_singular_on_entry_only() -> None:
    """The threshold is that of the Jacobian or of the rules; the event names its joints."""
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
        layout, trace, jacobians=chain, rules=logs.EventRules(singular={"closed_chain": 0.02})
    )
    assert [(e.iteration, e.threshold) for e in events] == [(2, 0.02)]
    assert found_in(layout, trace) == (), "no threshold, no event"


def test_ill_conditioned_by_its_own_threshold() -> None:
    condition = [10.0, 400.0, 300.0, 150.0, 400.0, np.nan, 201.0]
    layout, trace = trace_of(condition_arm=condition, sigma_arm=np.ones(7))
    arm = {"arm": RecordedJacobian(("a",), singular=0.1, condition=200.0)}
    events = found_in(layout, trace, {"q": ("a",)}, arm)
    assert {e.kind for e in events} == {logs.EventKind.ILL_CONDITIONED}
    # 150 does not end the event: the value would have to fall below 200 / 1.5.
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


def test_stall_once_per_standstill() -> None:
    cost = np.concatenate([np.linspace(2, 1, 20), np.ones(30), np.linspace(0.9, 0.5, 5)])
    layout, trace = trace_of(cost=cost)
    events = found_in(layout, trace)
    assert iterations_of(events, logs.EventKind.STALL) == [29]
    assert events[0].subject == "whole solve"
    assert events[0].value <= events[0].threshold == 1e-4


def test_stall_by_errors_when_one_finger_is_stuck() -> None:
    """A resting finger is a stall only once the other fingers rest, too."""
    errors = np.full((40, 2), np.nan)
    errors[:, 0] = 1e-9 * (1 + np.arange(40) % 2)
    moving = errors.copy()
    moving[:, 1] = np.linspace(1, 0.5, 40)
    assert found_in(*trace_of(position_error=moving)) == ()
    stuck = errors.copy()
    stuck[:, 1] = 0.3
    assert iterations_of(found_in(*trace_of(position_error=stuck)), logs.EventKind.STALL) == [10]
    free = np.stack([np.full(40, 0.3), np.full(40, np.nan)], axis=1)
    assert iterations_of(found_in(*trace_of(position_error=free)), logs.EventKind.STALL) == [10]


def test_oscillation_names_the_joints() -> None:
    k = np.arange(30)
    q = np.zeros((30, 3))
    q[5:, 1] = 0.1 * (-1.0) ** k[5:]
    q[:, 2] = 0.01 * k
    layout, trace = trace_of(q=q, cost=1 + 0.01 * (k % 2))
    events = found_in(layout, trace, {"q": ("a", "b", "c")})
    assert [e.kind for e in events] == [logs.EventKind.OSCILLATION]
    assert events[0].subject == "b"
    assert events[0].iteration == 10  # the step into row 5 is the first of six
    assert events[0].value == pytest.approx(0.2)


def test_stall_names_singularity_and_active_limits() -> None:
    k = np.arange(30)
    sigma = np.stack([np.full(30, 0.02), np.full(30, 0.11)], axis=1)
    layout, trace = trace_of(
        q=0.1 * (-1.0) ** k[:, None], cost=np.ones(30), sigma_arm=sigma, limit_mask=np.full(30, 2)
    )
    arm = {"arm": RecordedJacobian(singular=0.1)}
    labels = {"q": ("a", "b"), "sigma_arm": ("point", "normal")}
    events = found_in(layout, trace, labels, arm)
    still = [e for e in events if e.kind in (logs.EventKind.STALL, logs.EventKind.OSCILLATION)]
    assert [(e.kind, e.jacobian, e.joints) for e in still] == [
        (logs.EventKind.OSCILLATION, "arm[point]", ("a",)),
        (logs.EventKind.STALL, "arm[point]", ("b",)),
    ]
    events_at_limits = found_in(layout, trace, labels, {"arm": RecordedJacobian(singular=0.01)})
    assert {e.jacobian for e in events_at_limits} == {""}


def test_windows_are_checked() -> None:
    with pytest.raises(errors.InputError, match="windows"):
        logs.EventRules(oscillation_window=2)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), counts=st.lists(st.integers(0, 40), min_size=1, max_size=5))
def test_solves_have_independent_events(seed: int, counts: list[int]) -> None:
    """The events of a solve do not depend on the solves before and after it in a block."""
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
    batch_events = found_in(layout, trace, None, arm, counts=counts)
    ends = np.cumsum(counts)
    single_events = [
        Event(**{**vars(event), "solve_id": solve})
        for solve, (end, count) in enumerate(zip(ends, counts, strict=True))
        for event in found_in(layout, trace[end - count : end], None, arm)
    ]
    assert list(map(repr, batch_events)) == list(map(repr, single_events))


def test_collision_entries_and_exits() -> None:
    """Entries and exits of two solves: one starts in collision, the other is always free."""
    form = TraceFormat(Layout.record(Field("clearance", (), "f4", "m")))
    rows = np.zeros(9, form.layout.dtype)
    rows["clearance"] = [-0.01, 0.001, 0.003, 0.001, 0.004, 0.002, 0.005, np.nan, 0.002]
    events = logs.detect_events(form, rows, np.array([6, 3]), logs.EventRules(clearance=0.002))
    event_rows = [(e["solve_id"], e["iteration"], logs.EventKind(e["kind"]).name) for e in events]
    assert event_rows == [
        (0, 0, "COLLISION_ENTERED"),
        (0, 2, "COLLISION_LEFT"),
        (0, 3, "COLLISION_ENTERED"),
        (0, 4, "COLLISION_LEFT"),
    ]
    np.testing.assert_allclose(events["value"], [-0.01, 0.003, 0.001, 0.004], rtol=1e-6)
    assert (events["threshold"] == 0.002).all()


def test_a_log_with_a_scene(robot, tmp_path: Path) -> None:
    grasps = [ik.load_grasp(name) for name in ("cup", "mug", "banana")]
    arrays = [grasp.arrays(robot.fingers) for grasp in grasps]
    points, normals = (np.stack(parts) for parts in zip(*arrays, strict=True))
    poses = np.stack([grasp.object_pose for grasp in grasps])
    scene = ik.Scene(
        {
            "table": {"kind": "box", "size": [2, 2, 0.04], "xyz": [0, 0, -0.02]},
            "cup": {"kind": "object", "object": "cup"},
        },
        margin=0.001,
        grasped="cup",
    )
    solver = ik.Solver(robot, scene=scene)
    path = tmp_path / "scene.mcap"
    batch = solver.solve_batch(points, normals, log=path, object_pose=poses)
    log = logs.open(path)
    solves, rows = log.solves(), log.iterations()
    np.testing.assert_allclose(solves.rows["clearance"], batch.clearance)
    named = [(record["closest_first"], record["closest_second"]) for record in solves.records()]
    assert named == list(batch.closest)
    # The clearance of every iteration is that of its q with the object's pose of its solve.
    around = query_of_contacts(solver, points, normals, ("cup", poses))
    expected = around.rows(rows.solve_id).check(np.ascontiguousarray(rows.rows["q"]))
    np.testing.assert_allclose(
        rows.rows["clearance"], expected.surplus + scene.margin, atol=1e-6, equal_nan=True
    )
    kinds = {record["kind"] for record in log.events().records()}
    touching = np.flatnonzero(expected.surplus < -1e-6)
    assert ("COLLISION_ENTERED" in kinds) == bool(len(touching))
    first = logs.one_solve(log, 0)
    assert first.clearance == pytest.approx(batch.clearance[0])
    assert any(" and ".join(batch.closest[0]) in line for line in logs.explain(first).verdict)


def test_explanation_names_obstacle_or_missing_check(robot, tmp_path: Path) -> None:
    cup = ik.load_grasp("cup")
    wall = {"kind": "sphere", "radius": 0.3, "xyz": cup.object_pose[:3, 3]}
    path = tmp_path / "blocked.mcap"
    solver = ik.Solver(robot, scene=ik.Scene({"balloon": wall}))
    blocked = solver.solve(cup, log=path, diagnose=False)
    assert blocked.status is ik.Status.COLLISION
    story = logs.explain(logs.one_solve(logs.open(path)))
    assert any("collision" in line for line in story.incidents)
    text = "\n".join(story.verdict)
    assert "collision" in text
    assert f"balloon overlap by {-1e3 * blocked.clearance:.2f} mm" in text
    plain = tmp_path / "plain.mcap"
    ik.Solver(robot).solve(cup, log=plain)
    log = logs.open(plain)
    assert "collision not checked" in logs.explain(logs.one_solve(log)).verdict
    assert "clearance" not in log.iterations().names


def margins(robot, q):
    return np.min(list(robot.toggle_margins(q).values()), axis=0)


def logged(robot, path, q, rules=None):
    """Return the rows and events of a log of a solve that ends at q."""
    points, normals = robot.contacts(q)
    solver = ik.Solver(robot)
    with logs.McapRecorder(path, robot_name=robot.name, rules=rules) as recorder:
        batch = solver.solve_batch(points[None], normals[None], log=recorder)
    assert batch.success.all()
    log = logs.open(path)
    return log.iterations().rows, list(log.events(event="NEAR_SINGULAR").records())


def test_lowest_clearance_is_recorded(ar10, tmp_path):
    q = ar10.random(np.random.default_rng(1), 1)[0]
    rows, _ = logged(ar10, tmp_path / "a.mcap", q)
    expected = [margins(ar10, row) for row in rows["q"].astype(float)]
    np.testing.assert_allclose(rows["sigma_coupling"], expected, rtol=1e-5)


def test_near_a_toggle_is_an_event_that_names_the_motors(ar10, tmp_path):
    """The shipped strokes avoid toggles, so that the threshold is raised."""
    q = ar10.random(np.random.default_rng(1), 1)[0]
    _, events = logged(ar10, tmp_path / "clear.mcap", q)
    assert events == []
    rules = logs.EventRules(singular={"coupling": 1.0})
    rows, events = logged(ar10, tmp_path / "near.mcap", q, rules)
    assert (rows["sigma_coupling"] < 1.0).all()
    assert events
    assert {event["jacobian"] for event in events} == {"coupling"}
    assert {joint for event in events for joint in event["joint_mask"]} == set(ar10.actuators)


LENGTH = 0.1
OPTIONS = {"enhanced-dls": {"max_iterations": 200}, "enhanced-sdls": {"max_iterations": 200}}
OPTIONS |= {"original-dls": {"max_iterations": 200}, "original-sdls": {"max_iterations": 200}}
OPTIONS |= {"ipopt": {"restarts": 1}}
STEP = 1e-6


def spread(robot: ik.ArmHand, q: np.ndarray, of: str, columns: tuple[int, ...]) -> np.ndarray:
    """Return the singular values of a Jacobian by central differences, in descending order."""
    jacobian_columns = []
    for column in columns:
        ahead, behind = q.copy(), q.copy()
        ahead[column] += STEP
        behind[column] -= STEP
        if of == "palm":
            first, second = (robot.palm(x) for x in (behind, ahead))
            turn = (second[:3, :3] - first[:3, :3]) @ robot.palm(q)[:3, :3].T / (2 * STEP)
            angular = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
            velocity = (second[:3, 3] - first[:3, 3]) / (2 * STEP * LENGTH)
            jacobian_columns.append(np.concatenate([velocity, angular]))
        else:
            finger = robot.fingers.index(of)
            first, second = (robot.contacts(x)[0][finger] for x in (behind, ahead))
            jacobian_columns.append((second - first) / (2 * STEP * LENGTH))
    return np.linalg.svd(np.array(jacobian_columns).T, compute_uv=False)


@pytest.fixture(scope="module")
def arms(robot: ik.ArmHand) -> np.ndarray:
    """Configurations with an elbow straight to 1e-3 rad, so that the arm is singular."""
    rng = np.random.default_rng(40)
    q = robot.random(rng, 6)
    q[:, robot.actuators.index("lwr_joint_4")] = rng.normal(0, 1e-3, 6)
    return q


@pytest.fixture(scope="module", params=ik.METHODS)
def log(request, robot, arms, tmp_path_factory) -> logs.Log:
    """Log of solves that start at the answer, close to the singularity."""
    path = tmp_path_factory.mktemp("singular") / f"{request.param}.mcap"
    solver = ik.Solver(
        robot, request.param, options=OPTIONS.get(request.param, {}), finger_step="closed-form"
    )
    solver.solve_batch(*robot.contacts(arms), q0=arms, log=path)
    return logs.open(path)


def test_recorded_values_match_recomputation(robot, log):
    """Recorded values equal singular values of central differences."""
    rows = log.iterations().rows
    row_sample = rows[:: max(len(rows) // 12, 1)]
    arm = robot.description.arm_actuators
    fingers = {name: robot.description.finger_actuators(name) for name in robot.fingers}
    unplaced = log.iterations().method == "hand-first"
    assert "sigma_coupling" not in log.iterations().names, "it has no mechanisms"
    for row in row_sample:
        q = row["q"].astype(float)
        hands = [spread(robot, q, name, columns) for name, columns in fingers.items()]
        assert row["sigma_hand"] == pytest.approx(min(s[-1] for s in hands), rel=1e-3, abs=1e-5)
        assert row["condition_hand"] == pytest.approx(max(s[0] / s[-1] for s in hands), rel=1e-2)
        if unplaced and row["phase"] in (ik.solve.Phase.CANDIDATE, ik.solve.Phase.HAND_FIT):
            assert np.isnan(row["sigma_arm"])
            assert np.isnan(row["condition_arm"])
            continue
        values = spread(robot, q, "palm", arm)
        assert row["sigma_arm"] == pytest.approx(values[-1], rel=1e-3, abs=1e-5)
        if values[-1] > 1e-3:
            assert row["condition_arm"] == pytest.approx(values[0] / values[-1], rel=1e-2)


def test_singular_arms_are_events_in_every_method(robot, log):
    """Every solve that meets a singular arm has the event with its joints and its threshold."""
    solves = log.solves()
    lowest = solves.rows["lowest_sigma"][:, solves.labels["lowest_sigma"].index("arm")]
    events = [r for r in log.events(event="NEAR_SINGULAR").records() if r["jacobian"] == "arm"]
    near_singular = set(np.flatnonzero(lowest < SINGULARITY_THRESHOLDS["arm"][0]).tolist())
    assert {event["solve_id"] for event in events} == near_singular
    assert near_singular, "the answers are singular: someone has to come there"
    for event in events:
        assert event["value"] < event["threshold"] == SINGULARITY_THRESHOLDS["arm"][0]
        assert set(event["joint_mask"]) == set(robot.actuators[:7])


def test_thumb_first_measures_its_closed_chain(robot):
    """The closed chain is five rows of the thumb's contact, by central differences."""
    measures = JacobianMeasures(robot.description, closed_chain=True)
    q = robot.random(np.random.default_rng(3), 5)
    rows = np.zeros(5, [("q", "f8", q.shape[1]), ("phase", "u1")])
    rows["q"] = q
    names = [field.name for field in measures.fields]
    values = dict(zip(names, measures(rows).T, strict=True))
    description = robot.description
    columns = (*description.arm_actuators, *description.finger_actuators("thumb"))
    for row, x in enumerate(q):
        chain_columns, (_, normals) = [], robot.contacts(x)
        normal = normals[0]
        across = np.linalg.svd(normal[None])[2][1:]
        for column in columns:
            ahead, behind = x.copy(), x.copy()
            ahead[column] += STEP
            behind[column] -= STEP
            (p1, n1), (p2, n2) = robot.contacts(behind), robot.contacts(ahead)
            angular_rate = across @ np.cross(normal, (n2[0] - n1[0]) / (2 * STEP))
            chain_columns.append([*(p2[0] - p1[0]) / (2 * STEP * LENGTH), *angular_rate])
        s = np.linalg.svd(np.array(chain_columns).T, compute_uv=False)
        assert values["sigma_closed_chain"][row] == pytest.approx(s[-1], rel=1e-3)
        assert values["condition_closed_chain"][row] == pytest.approx(s[0] / s[-1], rel=1e-3)
