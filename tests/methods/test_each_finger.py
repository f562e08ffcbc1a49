"""Postures of hands with many motors are mended finger by finger before fits begin from them."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.hand_first.each_finger import each_finger, mends
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.restarts import Restarts
from casadi_ik.problem.problems import Problems


@pytest.fixture(scope="module")
def hand() -> ik.ArmHand:
    return ik.load_robot("ar10")


@pytest.fixture(scope="module")
def kernel(hand) -> FunctionKernel:
    return FunctionKernel(each_finger(hand.description))


def postures(hand, q):
    return q[:, list(hand.description.hand_actuators)]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("ar10", True), ("panda+leap", True), ("panda+shadow", True), ("kuka_lwr_barrett", False)],
)
def test_whose_postures_are_mended(name, wanted):
    """Not those of hands with few motors, whose fingers share one besides."""
    assert mends(ik.load_robot(name).description) == wanted


def test_mended_postures_are_nearer_to_the_target_in_its_measure(hand, kernel, rng):
    points, normals = hand.contacts(hand.random(rng, 200))
    begun = postures(hand, hand.random(rng, 200))
    once, left = kernel(points, normals, begun)
    _, less = kernel(points, normals, once)
    lower, upper = (postures(hand, np.atleast_2d(end))[0] for end in (hand.lower, hand.upper))
    assert (once >= lower).all()
    assert (once <= upper).all()
    assert (less <= left * (1 + 1e-9) + 1e-12).all()
    # What is left of postures that were drawn as these were, without being mended.
    moved = np.array(hand.random(rng, 200))
    moved[:, list(hand.description.hand_actuators)] = once
    apart = [_misfit(*hand.contacts(q), points, normals) for q in (moved, hand.random(rng, 200))]
    assert np.median(apart[0]) < 0.5 * np.median(apart[1])


def _misfit(points, normals, wanted, directions):
    """Differences of what no rigid motion changes: distances of points, cosines of normals."""
    shapes = [
        np.concatenate(
            [
                np.linalg.norm(p[:, :, None] - p[:, None], axis=3) / 0.1,
                np.einsum("kfi,kgi->kfg", n, n),
            ],
            axis=1,
        )
        for p, n in ((points, normals), (wanted, directions))
    ]
    return np.linalg.norm(shapes[0] - shapes[1], axis=(1, 2))


def test_a_finger_without_contact_stays(hand, kernel, rng):
    points, normals = hand.contacts(hand.random(rng, 50))
    points[:, 1] = normals[:, 1] = np.nan
    begun = postures(hand, hand.random(rng, 50))
    mended, left = kernel(points, normals, begun)
    columns = list(hand.description.hand_actuators)
    own = [columns.index(a) for a in hand.description.finger_actuators(hand.fingers[1])]
    np.testing.assert_array_equal(mended[:, own], begun[:, own])
    assert np.isfinite(left).all()
    assert (mended != begun).any(axis=1).all()


def test_every_round_begins_elsewhere(hand, rng):
    description = hand.description
    options = HandFirstParameters(table=64, wide_table=512)
    hands = Restarts(description, description.hand_actuators, options, compiled=False)
    points, normals = hand.contacts(hand.random(rng, 4))
    problems = Problems(points, normals, ik.Tolerance(), True)
    assert hands.mends(problems)
    assert not hands.mends(Problems(points, normals, ik.Tolerance(), False))
    rounds = [hands.mended(problems, number) for number in (2, 3)]
    size = options.candidates, len(description.hand_actuators)
    assert all(found.shape == (4, *size) for found in rounds)
    assert (rounds[0] != rounds[1]).any(axis=2).mean() > 0.9
    # Half of them begin at the best so far but for a finger or two.
    found = hands.mended(problems, 2, np.array(hand.random(rng, 4)))
    assert found.shape == (4, *size)
    assert (found != rounds[0]).any()
    assert hands.kept.shape == (15, 10)
    # AR10: two motors a finger, one or two of its five fingers anew.
    assert sorted(hands.kept.sum(axis=1)) == [6] * 10 + [8] * 5


def test_one_finger_that_came_to_rest_is_taken_out(hand, rng):
    """The rest of the hand is right: what is begun from is nearer than any hand of the table."""
    description = hand.description
    options = HandFirstParameters(table=64, wide_table=512)
    hands = Restarts(description, description.hand_actuators, options, compiled=False)
    q = np.array(hand.random(rng, 8))
    problems = Problems(*hand.contacts(q), ik.Tolerance(), True)
    best = np.array(q)
    columns = list(description.finger_actuators(hand.fingers[2]))
    best[:, columns] = hand.random(rng, 8)[:, columns]
    apart = [
        np.abs(found - q[:, None]).sum(axis=2).min(axis=1).mean()
        for found in (hands.mended(problems, 2, best), hands.mended(problems, 2))
    ]
    assert apart[0] < 0.5 * apart[1]


def test_what_is_out_of_reach_ends_the_same_alone_and_in_a_batch(hand, rng):
    """All rounds are made for it: in compiled code for one target, in Python for a batch."""
    points, normals = hand.contacts(hand.random(rng, 6))
    points = points + rng.normal(0, 0.008, points.shape)
    solver = ik.Solver(hand)
    batch = solver.solve_batch(points, normals)
    assert not batch.success.all()
    assert batch.restarts.max() > 100
    alone = solver.fast()
    for row in range(len(points)):
        q, _ = alone(points[row], normals[row])
        np.testing.assert_array_equal(q, batch.q[row])
