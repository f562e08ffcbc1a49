"""Postures of hands with many motors are mended finger by finger before fits begin from them."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.seeds import Seeds, each_finger
from casadi_ik.problem.problems import Problems


@pytest.fixture(scope="module")
def hand() -> ik.ArmHand:
    return ik.load_robot("ar10")


@pytest.fixture(scope="module")
def kernel(hand) -> FunctionKernel:
    return FunctionKernel(each_finger(hand.description, HandFirstParameters()))


def postures(hand, q):
    return q[:, list(hand.description.hand_actuators)]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("ar10", True), ("panda+leap", True), ("panda+shadow", True), ("kuka_lwr_barrett", False)],
)
def test_whose_postures_are_mended(name, wanted):
    """Not those of hands with few motors, whose fingers share one besides."""
    robot = ik.load_robot(name).description
    assert Seeds(robot, HandFirstParameters(), compiled=False).mends == wanted


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


@pytest.mark.parametrize("prefer", ["limits", "q0"])
def test_what_is_out_of_reach_ends_the_same_alone_and_in_a_batch(hand, rng, prefer):
    """All rounds are made for it."""
    points, normals = hand.contacts(hand.random(rng, 6))
    points = points + rng.normal(0, 0.008, points.shape)
    solver = ik.Solver(hand)
    many = solver.solve_batch(points, normals, prefer=prefer)
    assert not many.success.all()
    assert many.restarts.max() > 100
    alone = solver.fast()
    for row in range(len(points)):
        start = hand.home if prefer == "q0" else None
        q, _ = alone(points[row], normals[row], start)
        np.testing.assert_array_equal(q, many.q[row])
        one = solver.solve_batch(points[row : row + 1], normals[row : row + 1], prefer=prefer)
        for name in ("q", "status", "restarts", "iterations"):
            assert np.array_equal(getattr(one, name)[0], getattr(many, name)[row])
        for name, spent in many.phases.items():
            assert one.phases[name][0] == spent[row]


def test_so_many_rounds_and_no_more(rng):
    """Whatever makes them."""
    hand = ik.load_robot("kuka_lwr_barrett")
    points, normals = hand.contacts(hand.random(rng, 4))
    points += 0.02 * rng.normal(size=points.shape)
    problems = Problems(points, normals, ik.Tolerance(), True)
    tried = HandFirstMethod(hand.description, HandFirstParameters())
    start = np.tile(hand.home, (4, 1))
    every = [(trace, rounds) for trace in (False, True) for rounds in (1, 3)]
    outcomes = [tried.run(problems, start, 0, *asked) for asked in every]
    few, more = outcomes[:2], outcomes[2:]
    for one, other in zip(few, more, strict=True):
        np.testing.assert_array_equal(one.q, other.q)
        np.testing.assert_array_equal(one.restarts, other.restarts)
        np.testing.assert_array_equal(one.status, other.status)
    assert few[0].restarts.max() < few[1].restarts.max() < 24
