"""Solves of hand-first that only move the palms of a multi-arm robot to given poses."""

from typing import Any

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.registry import build_method
from casadi_ik.solve.subproblems import SubproblemSolver, carry_palms, side_palms

COUNT = 12


@pytest.fixture(scope="module")
def setup() -> tuple[ik.ArmHand, SubproblemSolver, TargetBatch, np.ndarray]:
    robot = ik.load_robot("g1+dex3")
    part = np.random.default_rng(2).uniform(0.2, 0.8, (COUNT, len(robot.home)))
    q = robot.lower + part * (robot.upper - robot.lower)
    method: Any = build_method("hand-first", robot.description, {})
    targets = TargetBatch(*robot.contacts(q), ik.Tolerance(), True)
    return robot, SubproblemSolver(robot, method), targets, q


def carrying(robot: ik.ArmHand) -> list[int]:
    """Return the motors of trunk and arms."""
    body = robot.description
    return [*body.trunk_actuators, *(motor for arm, _ in body.side_actuators for motor in arm)]


def test_trunk_and_arms_carry_the_palms_and_hands_stay(setup) -> None:
    robot, trials, targets, q = setup
    motors, starts = carrying(robot), q.copy()
    shift = 0.05 * (robot.upper - robot.lower)[motors]
    starts[:, motors] += shift * np.random.default_rng(3).uniform(-1.0, 1.0, (COUNT, len(motors)))
    palms = side_palms(robot, q)
    ends = carry_palms(trials, targets, starts, palms, np.arange(COUNT), False)
    np.testing.assert_allclose(side_palms(robot, ends), palms, atol=1e-5)
    hands = np.setdiff1d(np.arange(len(robot.home)), motors)
    np.testing.assert_array_equal(ends[:, hands], q[:, hands])


def test_arms_are_placed_for_the_current_trunk(setup) -> None:
    robot, trials, targets, q = setup
    arms = carrying(robot)[len(robot.description.trunk_actuators) :]
    starts, palms = q.copy(), side_palms(robot, q)
    starts[:, arms] = robot.home[arms]
    ends = carry_palms(trials, targets, starts, palms, np.arange(COUNT), np.ones(COUNT, bool))
    is_placed = np.abs(side_palms(robot, ends) - palms).max(axis=(1, 2, 3)) < 1e-6
    assert is_placed.sum() >= COUNT // 2
    np.testing.assert_array_equal(ends[~is_placed], starts[~is_placed])


def test_arms_that_cannot_follow_stay(setup) -> None:
    """Arms that could not follow moved to zero, as if the palms had been reached."""
    robot, trials, targets, q = setup
    palms = side_palms(robot, q)
    palms[..., 2, 3] += 3.0
    ends = carry_palms(trials, targets, q, palms, np.arange(COUNT), np.ones(COUNT, bool))
    np.testing.assert_array_equal(ends, q)
