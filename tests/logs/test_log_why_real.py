"""Explanations of real solves, each statement checked against the trace by other means."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.logs.explanation import explain
from casadi_ik.logs.solve import OneSolve, one_solve

COUNT = 5
"""Arms per grasp."""


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> list[OneSolve]:
    """What enhanced-dls does not solve of the shipped grasps with random arms."""
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
    log = ik.logs.open(path)
    found = [one_solve(log, int(i)) for i in np.flatnonzero(~batch.success)]
    assert len(found) > 4
    assert any(e.kind == "NEAR_SINGULAR" for each in found for e in each.events)
    return found


def test_the_fingers_that_are_named_are_those_out_of_tolerance(failed: list[OneSolve]) -> None:
    for solve in failed:
        story = explain(solve)
        out = [name for name, ok in zip(solve.fingers, solve.ok, strict=True) if not ok]
        assert [line.split()[0] for line in story.fingers if "lagged" in line] == out
        assert [line.split()[0] for line in story.verdict if "misses" in line] == out


def test_phases_tell_the_errors_of_the_robot_in_that_posture(
    failed: list[OneSolve], robot: ik.ArmHand
) -> None:
    """First and last distance of the thumb in a phase, recomputed from q."""
    thumb = robot.fingers.index(robot.thumb)
    for solve in failed:
        points, _ = robot.contacts(solve.rows["q"])
        distance = 1e3 * np.linalg.norm(points[:, thumb] - solve.target_points[thumb], axis=1)
        for line in explain(solve).phases:
            match = re.search(
                r"\(iterations (\d+) to (\d+), \d+\): .*?thumb ([\d.]+) mm .*? -> ([\d.]+) mm", line
            )
            assert match is not None, line
            first, last, begin, end = (float(text) for text in match.groups())
            assert begin == pytest.approx(distance[int(first)], abs=0.06)
            assert end == pytest.approx(distance[int(last)], abs=0.06)


def test_singularities_are_where_the_singular_value_is_small(failed: list[OneSolve]) -> None:
    told = 0
    for solve in failed:
        for line in explain(solve).met:
            match = re.match(
                r"closed chain near singular from iteration (\d+) on, (\d+) iterations in all; "
                r"smallest singular value ([\d.e-]+) in iteration (\d+) \(threshold ([\d.]+)\)",
                line,
            )
            if match is None:
                continue
            sigma = solve.rows["sigma_closed_chain"].astype(float)
            threshold = float(match[5])
            below = np.flatnonzero(sigma < threshold)
            assert int(match[1]) == below[0]
            assert int(match[2]) == len(below)
            assert int(match[4]) == np.nanargmin(sigma)
            assert float(match[3]) == pytest.approx(np.nanmin(sigma), rel=0.01)
            told += 1
    assert told


def test_motors_at_a_limit_are_at_a_limit(failed: list[OneSolve], robot: ik.ArmHand) -> None:
    told = 0
    for solve in failed:
        q = solve.rows["q"]
        at_limit = (q <= robot.lower) | (q >= robot.upper)
        for line in explain(solve).met:
            match = re.match(r"(\w+) at its limit from iteration (\d+) to the end", line)
            if match is None:
                continue
            column, since = at_limit[:, robot.actuators.index(match[1])], int(match[2])
            assert column[since:].all()
            assert since == 0 or not column[since - 1]
            told += 1
    assert told
