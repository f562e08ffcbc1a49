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


GIVEN_UP = [
    -1.0823446688711351,
    2.093505007835794,
    -2.9670597283903604,
    2.0943951023931953,
    2.5184993288908664,
    1.7900808858143713,
    -2.9670597283903604,
    2.0646400459501404,
    1.9958382699133406,
    0.8376496860071355,
    2.443460952792061,
    0.08985158483199428,
    2.443460952792061,
    0.49739587144523323,
]
"""Eight of its fits end in the same place, 7 mm off; the nineteenth hand solves it."""


def test_fits_that_end_where_others_did_do_not_end_the_search(robot):
    batch = ik.Solver(robot).solve_batch(*robot.contacts(np.array(GIVEN_UP)[None]))
    assert batch.success.all()


BEYOND_THE_GAP = [
    "1.6298881 -2.147 2.79523804 2.618 1.10860363 -1.5708 3.059 0.0596 0.044728396 0.0424540268 "
    "0.0540126198 0.06 0.0575 0.0599965934 0.0415 0.06 0.0575",
    "-1.7017 -0.735710291 -3.0542 -0.05 -3.059 2.094 -1.05059845 0.0483462426 0.04148 0.0540111353 "
    "0.0429328684 0.0456974828 0.0575 0.0533711112 0.0575 0.042 0.052163977",
]
"""Wrists at one end of a range of 351 deg: every start came to rest at the other end."""


def test_arms_at_either_end_of_nearly_a_full_turn():
    robot = ik.load_robot("baxter_ar10")
    q = np.array([row.split() for row in BEYOND_THE_GAP], dtype=float)
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-6, 1e-6))
    assert solver.solve_batch(*robot.contacts(q)).success.all()
    # Nearly all of those missed among corners had joints there: 17 of 10,000.
    rng = np.random.default_rng(4)
    q, where = robot.random(rng, 500), rng.integers(0, 3, (500, len(robot.lower)))
    q = np.where(where == 0, robot.lower, np.where(where == 1, robot.upper, q))
    q[:, 3], q[:, 5] = robot.lower[3], robot.upper[5]
    q[:, 4] = np.where(rng.random(500) < 0.5, robot.lower[4], robot.upper[4])
    assert solver.solve_batch(*robot.contacts(q)).success.all()


def test_where_limits_are_ignored_hands_beyond_them_are_found(robot, rng):
    """Tables of postures within limits miss a hundredth of them."""
    q = robot.random(rng, 2000)
    q[:, 7:] += rng.uniform(-1, 1, (2000, 7))
    batch = ik.Solver(robot, limits="ignore").solve_batch(*robot.contacts(q))
    assert np.mean(~batch.success) <= 0.004


FALLING = [
    2.96705972839036,
    2.094395102393195,
    2.957666599978023,
    2.092660133925822,
    2.916178503456599,
    2.015553214338501,
    -0.6231548652933716,
    3.141592653589793,
    0,
    0.5564127005107,
    0.0002649701736958878,
    0.8377580409572782,
    0,
    0.8018415500469888,
]
"""The floor of this hand's valley falls by 3e-5 over 24 degrees: one refinement is too few."""


def test_a_refinement_that_gave_up_in_a_valley_goes_on(robot):
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-6, 1e-6))
    q = np.array([FALLING])
    assert solver.solve_batch(*robot.contacts(q)).success.all()


AT_THE_TOLERANCE = [
    -2.940961824074429,
    0.9047366301093562,
    -2.54675589188411,
    -2.094395102393195,
    -2.96705972839036,
    -2.094395102393195,
    -2.96705972839036,
    3.141592653589793,
    2.443460952792061,
    2.443460952792061,
    2.443379429526629,
]
"""A hand that is fitted to 1e-6 rad and not a bit better; its arm adds 6.5e-13."""


def test_what_the_arm_adds_does_not_cost_the_verdict():
    robot = ik.load_robot("kuka_lwr_barrett_coupled")
    solver = ik.Solver(robot, tolerance=ik.Tolerance(1e-6, 1e-6))
    assert solver.solve_batch(*robot.contacts(np.array([AT_THE_TOLERANCE]))).success.all()
