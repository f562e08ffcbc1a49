"""Hands that hand-first could not see: every candidate lay on the other side of the spread."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik

HANDS = [
    [0, 100, 48, 78, 48, 48, 48],
    [0, 90, 48, 78, 46, 60, 31],
    [4, 94, 48, 78, 48, 47, 48],
]
"""Spread, thumb, finger 2, finger 3 (proximal, distal) [deg]."""

LOST = (87_229, 638_806)
"""Rows of a million random configurations that were not solved."""


@pytest.fixture(scope="module", params=[(5e-3, np.radians(3.0)), (1e-6, 1e-6)], ids=str)
def solver(robot, request):
    return ik.Solver(robot, tolerance=ik.Tolerance(*request.param))


@pytest.mark.parametrize("hand", HANDS, ids=str)
@pytest.mark.parametrize("off", [0.0, 3.4])
def test_hands_on_many_arms(robot, solver, rng, hand, off):
    q = robot.random(rng, 500)
    q[:, 7:] = np.radians(hand) + rng.uniform(-np.radians(off), np.radians(off), (500, 7))
    q = np.clip(q, robot.lower, robot.upper)
    batch = solver.solve_batch(*robot.contacts(q))
    assert np.flatnonzero(~batch.success).tolist() == []


def test_rows_that_were_lost(robot, solver):
    q = robot.random(np.random.default_rng(0), 1_000_000)[list(LOST)]
    assert solver.solve_batch(*robot.contacts(q)).success.all()


VALLEY = [
    -2.438682884,
    -2.086845784,
    0.517321565,
    2.089980567,
    -2.608389686,
    0.85207685,
    -2.960544108,
    3.134486618,
    0.007887824,
    0.827482835,
    0.006694567,
    0.825968859,
    0.009418381,
    0.834662853,
]
"""Three fingers side by side: hands of quite another bend come within 2e-6 m of the contacts."""


def test_a_fit_that_rests_in_a_valley_is_not_the_end(robot):
    q = np.array(VALLEY)[None]
    assert ((q >= robot.lower) & (q <= robot.upper)).all()
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-6, 1e-6))
    assert solver.solve_batch(*robot.contacts(q)).success.all()


def test_where_limits_are_ignored_hands_beyond_them_are_found(robot, rng):
    """Tables of postures within limits miss a hundredth of them."""
    q = robot.random(rng, 2000)
    q[:, 7:] += rng.uniform(-1, 1, (2000, 7))
    batch = ik.Solver(robot, limits="ignore").solve_batch(*robot.contacts(q))
    assert np.mean(~batch.success) <= 0.004
