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
