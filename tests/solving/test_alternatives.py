"""Several solutions of one grasp: that they are solutions, all of them, and ranked as asked."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from toy_robots import grasp_at, grasp_of

import casadi_ik as ik

APART, DISTINCT = 0.25, 0.05
"""Least differences of answers unless said otherwise, and of hands that are searched."""


def contains(interval, swivels):
    start, end = interval
    return np.mod(swivels - start, 2 * np.pi) <= end - start


def test_they_are_solutions_and_they_differ(robot, solver):
    points_asked = robot.random(np.random.default_rng(11), 5)
    for q in points_asked:
        found = solver.solve_all(grasp_at(robot, q), limit=100, apart=0)
        assert len(found) > 3
        configurations = np.stack([one.q for one in found])
        points, normals = robot.contacts(q)
        batch = robot.contacts(configurations)
        assert np.abs(batch[0] - points).max() < 1e-5
        assert np.abs(batch[1] - normals).max() < 1e-4
        assert (configurations >= robot.lower - 1e-9).all()
        assert (configurations <= robot.upper + 1e-9).all()
        for one in found:
            assert all(contact.ok for contact in one.contacts.values())
            assert contains(one.branch.swivel, one.swivel)
        keys = {(one.posture, one.branch) for one in found}
        assert len(keys) == len(found)
        span = (robot.upper - robot.lower)[7:]
        hands = {one.posture: one.q[7:] for one in found}
        for a in hands:
            for b in hands:
                assert a == b or np.abs((hands[a] - hands[b]) / span).max() > DISTINCT


def differences(robot, first, second):
    """(k, l) the largest motion of a motor from one solution to another, in ranges."""
    one, other = (np.stack([each.q for each in found]) for found in (first, second))
    return np.abs((one[:, None] - other) / (robot.upper - robot.lower)).max(axis=2)


def least(robot, found):
    return differences(robot, found, found)[np.triu_indices(len(found), 1)].min(initial=np.inf)


@pytest.mark.parametrize("prefer", ["limits", "manipulability", "q0"])
def test_the_answers_for_the_cup_are_different_ones(robot, solver, prefer):
    """Its hand has a valley of postures; without a least distance they fill the list."""
    cup = ik.load_grasp("cup")
    every = solver.solve_all(cup, limit=1000, prefer=prefer, apart=0)
    assert least(robot, every) < 0.1
    few = solver.solve_all(cup, limit=4, prefer=prefer)
    assert len(few) == 4
    assert least(robot, few) >= APART
    # Each that is left out is like one before it.
    kept = solver.solve_all(cup, limit=1000, prefer=prefer)
    assert [one.branch for one in kept[:4]] == [one.branch for one in few]
    same = differences(robot, every, kept)
    places = same.argmin(axis=0)
    assert (np.diff(places) > 0).all()
    assert (same.min(axis=0) == 0).all()
    for place, row in enumerate(same):
        assert row[places <= place].min() < APART


@pytest.mark.slow
def test_how_different_they_are_is_a_parameter():
    """On a robot whose arm is only nearly of a closed form."""
    robot = ik.load_robot("baxter_ar10")
    asked = grasp_at(robot, robot.random(np.random.default_rng(1), 1)[0])
    solver = ik.Solver(robot)
    counts = []
    for apart in (0.0, 0.25, 0.6, 1.0):
        found = solver.solve_all(asked, limit=100, apart=apart)
        assert least(robot, found) >= apart
        counts.append(len(found))
    assert counts[1] > 1
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 1


@pytest.mark.parametrize(
    ("prefer", "measure"),
    [
        ("limits", lambda one: one.margin),
        ("manipulability", lambda one: one.manipulability),
        ("q0", lambda one: -one.distance),
    ],
)
def test_the_preferred_comes_first(robot, solver, prefer, measure):
    q = robot.random(np.random.default_rng(21), 1)[0]
    every = solver.solve_all(grasp_at(robot, q), limit=100, prefer=prefer, q0=q)
    values = [measure(one) for one in every]
    assert values == sorted(values, reverse=True)
    others = [p for p in ("limits", "manipulability", "q0") if p != prefer]
    for other in others:
        for one in solver.solve_all(grasp_at(robot, q), limit=100, prefer=other, q0=q):
            assert measure(one) <= values[0] + 1e-3 * abs(values[0])
    few = solver.solve_all(grasp_at(robot, q), limit=2, prefer=prefer, q0=q)
    assert [one.branch for one in few] == [one.branch for one in every[:2]]


def test_the_robot_is_close_to_itself(robot, solver):
    q = robot.random(np.random.default_rng(31), 1)[0]
    nearest = solver.solve_all(grasp_at(robot, q), prefer="q0", q0=q)[0]
    assert nearest.distance < 0.01
    np.testing.assert_allclose(nearest.q, q, atol=0.05)


def test_manipulability_is_yoshikawas(robot, solver):
    q = robot.random(np.random.default_rng(41), 1)[0]
    one = solver.solve_all(grasp_at(robot, q), prefer="q0", q0=q)[0]
    step, columns = 1e-6, []
    palm = robot.palm(one.q)
    for i in range(7):
        ends = [robot.palm(one.q + sign * step * np.eye(14)[i]) for sign in (1, -1)]
        rate = (ends[0] - ends[1]) / (2 * step)
        spin = rate[:3, :3] @ palm[:3, :3].T
        columns.append([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])
    J = np.array(columns).T
    assert one.manipulability == pytest.approx(np.sqrt(np.linalg.det(J @ J.T)), rel=1e-4)


def test_a_held_elbow_leaves_single_swivels(robot, solver):
    q = robot.random(np.random.default_rng(51), 1)[0]
    fixed = {"lwr_joint_3": float(q[2])}
    found = solver.solve_all(grasp_at(robot, q), fixed=fixed)
    assert found
    for one in found:
        assert one.q[2] == pytest.approx(q[2], abs=1e-9)
        assert one.branch.swivel[1] - one.branch.swivel[0] < 1e-6


def test_an_arm_without_a_closed_form(tmp_path_factory):
    robot = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    q = robot.random(np.random.default_rng(5), 1)[0]
    found = ik.Solver(robot).solve_all(grasp_at(robot, q), seed=1)
    assert len(found) > 1
    assert all(one.branch is None and one.swivel is None for one in found)
    reached = robot.contacts(np.stack([one.q for one in found]))
    np.testing.assert_allclose(
        reached[0], np.tile(robot.contacts(q)[0], (len(found), 1, 1)), atol=5e-3
    )


def test_none_where_there_is_none(robot, solver):
    points, normals = robot.contacts(robot.home)
    assert solver.solve_all(grasp_of(robot, points + 5.0, normals)) == ()


def test_what_is_refused(robot, solver):
    asked = grasp_at(robot, robot.home)
    with pytest.raises(ik.errors.InputError, match=r"limit:.*0.*>= 1"):
        solver.solve_all(asked, limit=0)
    for apart in (-0.1, 1.5, float("nan"), "far", True):
        with pytest.raises(ik.errors.InputError, match=r"apart:.*0.*1"):
            solver.solve_all(asked, apart=apart)
    with pytest.raises(ik.errors.InputError, match=r"prefer:.*'speed'"):
        solver.solve_all(asked, prefer="speed")
    with pytest.raises(ik.errors.InputError, match=r"q0:.*\(2, 14\).*\(14,\)"):
        solver.solve_all(asked, q0=np.zeros((2, 14)))
    with pytest.raises(ik.errors.UnsupportedError, match="method: 'ipopt' "):
        ik.Solver(robot, "ipopt").solve_all(asked)


@pytest.mark.slow
def test_arms_of_a_hand_with_a_wrist():
    """The wrist makes two joints more than a closed form takes: all its branches are there."""
    robot = ik.load_robot("ur5e+shadow")
    solver = ik.Solver(robot)
    for q in robot.random(np.random.default_rng(3), 3):
        found = solver.solve_all(grasp_at(robot, q), limit=50, prefer="manipulability")
        assert len(found) >= 6
        for one in found:
            assert np.abs(robot.contacts(one.q)[0] - robot.contacts(q)[0]).max() < 0.005
            assert all(contact.ok for contact in one.contacts.values())
