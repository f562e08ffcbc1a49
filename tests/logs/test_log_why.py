"""Explanations of made-up and real solves."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from made_up_traces import LAYOUT, Layout, describe, event, make_one, make_rows

import casadi_ik as ik
from casadi_ik import errors, logs

DEGREE = float(np.deg2rad(1.0))


def values(text: str) -> list[float]:
    """Return the numbers in a sentence that are not parts of names."""
    return [
        float(word)
        for word in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)", text)
    ]


def test_dip_without_threshold_is_compared_with_the_median() -> None:
    rows = make_rows()
    rows["sigma_closed_chain"][:20] = np.nan
    rows["sigma_closed_chain"][33] = 0.004
    (line,) = logs.explain(make_one(rows)).incidents
    assert values(line) == [0.004, 34, 0.5]
    rows["sigma_closed_chain"][33] = 0.06
    (line,) = logs.explain(make_one(rows)).incidents
    assert values(line) == [0.06]
    rows["sigma_closed_chain"] = np.nan
    (line,) = logs.explain(make_one(rows)).incidents
    assert "closed chain" in line
    assert values(line) == []


def test_finger_that_lost_its_contact() -> None:
    rows = make_rows()
    rows["position_error"], rows["angle_error"] = 0.001, 0.0
    rows["angle_error"][31:, 0] = 10 * DEGREE
    explanation = logs.explain(make_one(rows))
    (line,) = explanation.fingers
    assert line.startswith("thumb ")
    assert values(line) == [1.0, 10.0, 31, 31]
    assert explanation.verdict[0].startswith("thumb ")
    assert values(explanation.verdict[0]) == [10.0]


def test_last_finger_of_a_solved_target() -> None:
    rows = make_rows()
    rows["position_error"], rows["angle_error"] = 0.001, 0.0
    rows["position_error"][:22, 0] = 0.05
    rows["position_error"][:34, 1] = 0.05
    explanation = logs.explain(make_one(rows, restarts=2))
    assert values(explanation.headline) == [8, 40, 2]
    (line,) = explanation.fingers
    assert line.startswith("finger_2 ")
    assert values(line) == [35, 23]
    assert len(explanation.verdict) == 2
    rows["position_error"][:34, 0] = 0.05
    (line,) = logs.explain(make_one(rows)).fingers
    assert values(line) == [35]


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        (0.06, [40, 4]),
        (0.099, [4]),
    ],
)
def test_exhausted_budget(end: float, expected: list[float]) -> None:
    rows = make_rows()
    rows["angle_error"] = 0.0
    rows["position_error"][-4:] = np.linspace(0.1, end, 5)[1:, None]
    explanation = logs.explain(make_one(rows, status="ITERATION_LIMIT"))
    assert values(explanation.verdict[-1]) == expected


def test_restless_joints_and_oscillations() -> None:
    events = [event(i, "LIMIT_HIT", 1.0, joints=("joint_c",)) for i in range(5, 30, 5)]
    events += [event(3, "LIMIT_HIT", 1.0, joints=("joint_a",))]
    events += [event(i, "OSCILLATION", 0.1, joints=("joint_a", "joint_c")) for i in (11, 22)]
    events += [event(12, "OSCILLATION", 0.1, joints=("joint_c",))]
    explanation = logs.explain(
        make_one(make_rows(), events=tuple(sorted(events, key=lambda e: e.iteration)))
    )
    assert [values(line) for line in explanation.incidents] == [[0.5], [5], [12, 3]]
    assert "joint_c" in explanation.incidents[1]
    assert "joint_a" not in explanation.incidents[1]
    assert explanation.incidents[2].startswith("joint_c, joint_a ")


def test_repeated_phases_are_described() -> None:
    rows = make_rows()
    rows["phase"] = np.arange(40) // 10 % 2 + 1
    rows["position_error"][35:] = 0.02
    names = [line.partition(" (")[0] for line in logs.explain(make_one(rows)).phases]
    assert names == [
        "thumb reaching 1",
        "hand alignment 1",
        "thumb reaching 2",
        "hand alignment 2",
    ]
    rows["phase"] = np.arange(40) % 2 + 1
    lines = logs.explain(make_one(rows)).phases
    assert [values(line)[:4] for line in lines] == [[1, 39, 20, 20], [2, 40, 20, 20]]
    assert [line.partition(" (")[0] for line in lines] == ["thumb reaching", "hand alignment"]
    assert "-> 20.0 mm" in lines[0]


def test_free_fingers_and_unmeasured_rows() -> None:
    rows = make_rows()
    rows["position_error"][:, 1] = rows["angle_error"][:, 1] = np.nan
    rows["position_error"][:20] = rows["angle_error"][:20] = np.nan
    rows["position_error"][25:, 0], rows["angle_error"][25:, 0] = 0.001, 0.0
    rows["position_error"][-1] = rows["angle_error"][-1] = np.nan
    nan = np.array([0.001, np.nan]), np.array([0.0, np.nan])
    solve = make_one(rows, position_error=nan[0], angle_error=nan[1])
    explanation = logs.explain(solve)
    assert [values(line) for line in explanation.phases] == [
        [1, 20],
        [21, 40, 100.0, 11.5, 1.0, 0.0],
    ]
    assert explanation.fingers[0].startswith("thumb ")


def test_free_finger_with_zero_errors_is_omitted() -> None:
    rows = make_rows()
    rows["position_error"][:, 1] = rows["angle_error"][:, 1] = 0.0
    free = np.array([0.1, np.nan])
    explanation = logs.explain(make_one(rows, position_error=free, angle_error=free))
    assert "finger_2" not in " ".join(
        (*explanation.phases, *explanation.fingers, *explanation.verdict)
    )


def test_without_a_trace_only_the_result_is_described() -> None:
    solve = make_one(make_rows())
    explanation = logs.explain(dataclasses.replace(solve, rows=solve.rows[:0]))
    assert [values(line) for line in explanation.verdict] == [
        [],
        [100.0, 11.46],
        [100.0, 11.46],
        [],
    ]
    assert [line.split()[0] for line in explanation.verdict[1:3]] == ["thumb", "finger_2"]


def test_without_limits_phases_or_singular_values() -> None:
    """A method that records less has a shorter explanation."""
    lean = Layout.record(*(f for f in LAYOUT if f.name in ("q", "position_error", "angle_error")))
    rows = np.zeros(3, lean.dtype)
    rows["position_error"] = 0.1
    explanation = logs.explain(make_one(rows, layout=lean))
    assert values(explanation.phases[0])[:3] == [1, 3, 100.0]
    assert [values(line) for line in explanation.incidents] == [[]]


@pytest.mark.parametrize(
    ("occurrence", "parts"),
    [
        (
            event(1, "NEAR_SINGULAR", 0.00312, jacobian="closed_chain", threshold=0.01),
            ("closed chain", "0.00312", "0.01"),
        ),
        (
            event(1, "ILL_CONDITIONED", 2.5e4, jacobian="closed_chain", threshold=1e4),
            ("closed chain", "2.5e+04", "1e+04"),
        ),
        (event(1, "LIMIT_HIT", 2.09, joints=("a",)), ("a ", "2.09")),
        (event(1, "LIMIT_HIT", np.pi / 4, joints=("a",), unit="rad"), ("a ", "45 deg")),
        (event(1, "LIMIT_HIT", 0.0125, joints=("a",), unit="m"), ("a ", "12.5 mm")),
        (event(1, "LIMIT_LEFT", 1.5, joints=("a",), threshold=2), ("a ", "(2)", "1.5")),
        (event(1, "ACTIVATED", 3, joints=("a", "b"), threshold=1), ("a, b", "3", "1")),
        (event(1, "RESTART", 2), ("restart 2",)),
        (event(1, "PHASE_CHANGE", phase="hand-alignment"), ("hand alignment",)),
        (event(1, "STALL", 1e-5, phase="refinement"), ("refinement", "1e-05")),
        (
            event(1, "OSCILLATION", 0.2, joints=("a", "b", "c", "d", "e", "f")),
            ("a, b, c, d and 2 more", "0.2"),
        ),
        (event(1, "SOMETHING_NEW", 0.2), ("something new: 0.2",)),
    ],
)
def test_events_in_words(occurrence, parts: tuple[str, ...]) -> None:
    text = describe(occurrence)
    assert all(part in text for part in parts), text
    assert "{" not in text


def test_two_methods_compared() -> None:
    rows = make_rows()
    rows["position_error"][30:], rows["angle_error"][30:] = 0.001, 0.0
    rows["sigma_closed_chain"][7] = 0.03
    solved = make_one(rows)
    failed = make_one(make_rows()[20:], method="original-dls", time=0.5)
    lines = {
        line.quantity: (line.first, line.second) for line in logs.compare_solves(solved, failed)
    }
    assert lines["status"] == ("SOLVED", "STALLED")
    assert lines["time"] == ("12 ms", "500 ms")
    assert lines["thumb error"] == ("1.00 mm and 0.00 deg", "100.00 mm and 11.46 deg")
    assert lines["phases"] == ("thumb reaching 20, hand alignment 20", "hand alignment 20")
    assert lines["all within tolerance"] == ("from iteration 31", "never")
    assert values(lines["smallest error"][1]) == [20, 1]
    assert lines["smallest sigma, closed chain"] == ("0.03 in iteration 8", "0.5 in iteration 1")
    assert lines["limits at the end"] == ("none", "none")
    other_solve = make_one(make_rows(), target_points=np.ones((2, 3)))
    with pytest.raises(errors.InputError, match=r"8.*enhanced-dls"):
        logs.compare_solves(solved, other_solve)


def test_targets_are_compared_up_to_rounding() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(2, 3, 3))
    normals[1] = np.nan
    key = logs.explanation.target_key(points, normals)
    assert logs.explanation.target_key(points * (1 + 1e-15), normals) == key
    assert logs.explanation.target_key(points + 1e-6, normals) != key
    assert logs.explanation.target_key(points, np.nan_to_num(normals)) != key
    target_key = logs.explanation.target_key
    assert target_key(np.zeros((3, 3)), normals) == target_key(-np.zeros((3, 3)), normals)


COUNT = 5
"""Number of arms per grasp."""


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> list[logs.SolveRecord]:
    """Unsolved shipped grasps of enhanced-dls with random arms."""
    names = ik.shipped_grasps(robot.name)
    q = robot.random(np.random.default_rng(0), len(names) * COUNT)
    for i, name in enumerate(names):
        for actuator, value in ik.load_grasp(name).posture.items():
            q[i * COUNT : (i + 1) * COUNT, robot.actuators.index(actuator)] = value
    path: Path = tmp_path_factory.mktemp("study") / "enhanced.mcap"
    solver = ik.Solver(
        robot, "enhanced-dls", finger_step="closed-form", options={"max_iterations": 400}
    )
    batch = solver.solve_batch(*robot.contacts(q), log=path)
    log = logs.open(path)
    solves = [logs.one_solve(log, int(i)) for i in np.flatnonzero(~batch.success)]
    assert len(solves) > 4
    assert any(e.kind == "NEAR_SINGULAR" for solve in solves for e in solve.events)
    return solves


def test_named_fingers_are_out_of_tolerance(
    failed: list[logs.SolveRecord],
) -> None:
    for solve in failed:
        story = logs.explain(solve)
        out = [name for name, ok in zip(solve.fingers, solve.ok, strict=True) if not ok]
        assert [line.split()[0] for line in story.fingers[: len(out)]] == out
        assert [line.split()[0] for line in story.verdict[: len(out)]] == out


def test_phase_errors_match_the_robot(failed: list[logs.SolveRecord], robot: ik.ArmHand) -> None:
    """The stated distances of the thumb at the start and end of a phase are recomputed from q."""
    thumb = robot.fingers.index(robot.thumb)
    for solve in failed:
        points, _ = robot.contacts(solve.rows["q"])
        distance = 1e3 * np.linalg.norm(points[:, thumb] - solve.target_points[thumb], axis=1)
        for line in logs.explain(solve).phases:
            match = re.search(
                r"\(iterations (\d+) to (\d+)[^)]*\): .*?thumb ([\d.]+) mm .*? -> ([\d.]+) mm", line
            )
            assert match is not None, line
            first, last, begin, end = (float(text) for text in match.groups())
            assert begin == pytest.approx(distance[int(first) - 1], abs=0.06)
            assert end == pytest.approx(distance[int(last) - 1], abs=0.06)


def test_named_singularities_have_small_singular_values(
    failed: list[logs.SolveRecord],
) -> None:
    count = 0
    for solve in failed:
        for line in logs.explain(solve).incidents:
            if not line.startswith("closed chain near singular"):
                continue
            sigma = solve.rows["sigma_closed_chain"].astype(float)
            start, duration, smallest, iteration, threshold, *_ = values(line)
            below = np.flatnonzero(sigma < threshold)
            assert start - 1 == below[0]
            assert duration == len(below)
            assert iteration - 1 == np.nanargmin(sigma)
            assert smallest == pytest.approx(np.nanmin(sigma), rel=0.01)
            count += 1
    assert count


def test_named_limits_are_active(failed: list[logs.SolveRecord], robot: ik.ArmHand) -> None:
    count = 0
    for solve in failed:
        q = solve.rows["q"]
        at_limit = (q <= robot.lower) | (q >= robot.upper)
        for line in logs.explain(solve).incidents:
            match = re.match(r"(\w+) at its limit from iteration (\d+) to the end", line)
            if match is None:
                continue
            column, since = at_limit[:, robot.actuators.index(match[1])], int(match[2]) - 1
            assert column[since:].all()
            assert since == 0 or not column[since - 1]
            count += 1
    assert count
