"""Several solutions of one grasp: valid, complete, and in the requested order."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from toy_robots import grasp_at, grasp_of

import casadi_ik as ik

MIN_DIFFERENCE, DISTINCT = 0.25, 0.05
"""Minimal difference of answers by default, and of searched hands."""


def contains(interval, swivels):
    start, end = interval
    return np.mod(swivels - start, 2 * np.pi) <= end - start


def test_alternatives_are_distinct_solutions(robot, solver):
    points_asked = robot.random(np.random.default_rng(11), 5)
    for q in points_asked:
        solutions = solver.solve_all(grasp_at(robot, q), limit=100, apart=0)
        assert len(solutions) > 3
        configurations = np.stack([solution.q for solution in solutions])
        points, normals = robot.contacts(q)
        batch = robot.contacts(configurations)
        assert np.abs(batch[0] - points).max() < 1e-5
        assert np.abs(batch[1] - normals).max() < 1e-4
        assert (configurations >= robot.lower - 1e-9).all()
        assert (configurations <= robot.upper + 1e-9).all()
        for solution in solutions:
            assert all(contact.ok for contact in solution.contacts.values())
            assert contains(solution.branch.swivel, solution.swivel)
        keys = {(solution.posture, solution.branch) for solution in solutions}
        assert len(keys) == len(solutions)
        span = (robot.upper - robot.lower)[7:]
        hands = {solution.posture: solution.q[7:] for solution in solutions}
        for a in hands:
            for b in hands:
                assert a == b or np.abs((hands[a] - hands[b]) / span).max() > DISTINCT


def differences(robot, first, second):
    """Return the largest motion of a motor between solutions (k, l), in ranges."""
    first_q, second_q = (
        np.stack([solution.q for solution in solutions]) for solutions in (first, second)
    )
    return np.abs((first_q[:, None] - second_q) / (robot.upper - robot.lower)).max(axis=2)


def min_difference(robot, solutions):
    return differences(robot, solutions, solutions)[np.triu_indices(len(solutions), 1)].min(
        initial=np.inf
    )


@pytest.mark.parametrize("prefer", ["limits", "manipulability", "q0"])
def test_cup_alternatives_differ(robot, solver, prefer):
    """The hand has a continuum of postures, which fill the list without a minimal distance."""
    cup = ik.load_grasp("cup")
    all_solutions = solver.solve_all(cup, limit=1000, prefer=prefer, apart=0)
    assert min_difference(robot, all_solutions) < 0.1
    few = solver.solve_all(cup, limit=4, prefer=prefer)
    assert len(few) == 4
    assert min_difference(robot, few) >= MIN_DIFFERENCE
    # Each solution that is left out is similar to an earlier one.
    different_solutions = solver.solve_all(cup, limit=1000, prefer=prefer)
    assert [solution.branch for solution in different_solutions[:4]] == [
        solution.branch for solution in few
    ]
    distances = differences(robot, all_solutions, different_solutions)
    places = distances.argmin(axis=0)
    assert (np.diff(places) > 0).all()
    assert (distances.min(axis=0) == 0).all()
    for place, row in enumerate(distances):
        assert row[places <= place].min() < MIN_DIFFERENCE


@pytest.mark.slow
def test_min_separation_is_a_parameter():
    """The robot has an arm that is only nearly of a closed form."""
    robot = ik.load_robot("baxter_ar10")
    grasp = grasp_at(robot, robot.random(np.random.default_rng(1), 1)[0])
    solver = ik.Solver(robot)
    counts = []
    for min_distance in (0.0, 0.25, 0.6, 1.0):
        solutions = solver.solve_all(grasp, limit=100, apart=min_distance)
        assert min_difference(robot, solutions) >= min_distance
        counts.append(len(solutions))
    assert counts[1] > 1
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 1


@pytest.mark.parametrize(
    ("prefer", "measure"),
    [
        ("limits", lambda solution: solution.margin),
        ("manipulability", lambda solution: solution.manipulability),
        ("q0", lambda solution: -solution.distance),
    ],
)
def test_preferred_solution_is_first(robot, solver, prefer, measure):
    q = robot.random(np.random.default_rng(21), 1)[0]
    all_solutions = solver.solve_all(grasp_at(robot, q), limit=100, prefer=prefer, q0=q)
    values = [measure(solution) for solution in all_solutions]
    assert values == sorted(values, reverse=True)
    other_preferences = [p for p in ("limits", "manipulability", "q0") if p != prefer]
    for preference in other_preferences:
        for solution in solver.solve_all(grasp_at(robot, q), limit=100, prefer=preference, q0=q):
            assert measure(solution) <= values[0] + 1e-3 * abs(values[0])
    few = solver.solve_all(grasp_at(robot, q), limit=2, prefer=prefer, q0=q)
    assert [solution.branch for solution in few] == [
        solution.branch for solution in all_solutions[:2]
    ]


def test_generating_configuration_is_nearest(robot, solver):
    q = robot.random(np.random.default_rng(31), 1)[0]
    nearest = solver.solve_all(grasp_at(robot, q), prefer="q0", q0=q)[0]
    assert nearest.distance < 0.01
    np.testing.assert_allclose(nearest.q, q, atol=0.05)


def test_manipulability_is_the_yoshikawa_measure(robot, solver):
    q = robot.random(np.random.default_rng(41), 1)[0]
    solution = solver.solve_all(grasp_at(robot, q), prefer="q0", q0=q)[0]
    step, columns = 1e-6, []
    palm = robot.palm(solution.q)
    for i in range(7):
        ends = [robot.palm(solution.q + sign * step * np.eye(14)[i]) for sign in (1, -1)]
        rate = (ends[0] - ends[1]) / (2 * step)
        spin = rate[:3, :3] @ palm[:3, :3].T
        columns.append([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])
    J = np.array(columns).T
    assert solution.manipulability == pytest.approx(np.sqrt(np.linalg.det(J @ J.T)), rel=1e-4)


def test_fixed_elbow_gives_single_swivels(robot, solver):
    q = robot.random(np.random.default_rng(51), 1)[0]
    fixed = {"lwr_joint_3": float(q[2])}
    solutions = solver.solve_all(grasp_at(robot, q), fixed=fixed)
    assert solutions
    for solution in solutions:
        assert solution.q[2] == pytest.approx(q[2], abs=1e-9)
        assert solution.branch.swivel[1] - solution.branch.swivel[0] < 1e-6


def test_an_arm_without_a_closed_form(tmp_path_factory):
    robot = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    q = robot.random(np.random.default_rng(5), 1)[0]
    solutions = ik.Solver(robot).solve_all(grasp_at(robot, q), seed=1)
    assert len(solutions) > 1
    assert all(solution.branch is None and solution.swivel is None for solution in solutions)
    contacts = robot.contacts(np.stack([solution.q for solution in solutions]))
    np.testing.assert_allclose(
        contacts[0], np.tile(robot.contacts(q)[0], (len(solutions), 1, 1)), atol=5e-3
    )


def test_unreachable_grasp_has_no_alternatives(robot, solver):
    points, normals = robot.contacts(robot.home)
    assert solver.solve_all(grasp_of(robot, points + 5.0, normals)) == ()


def test_bad_alternative_options_are_refused(robot, solver):
    grasp = grasp_at(robot, robot.home)
    with pytest.raises(ik.errors.InputError, match=r"limit:.*0.*>= 1"):
        solver.solve_all(grasp, limit=0)
    for min_distance in (-0.1, 1.5, float("nan"), "far", True):
        with pytest.raises(ik.errors.InputError, match=r"apart:.*0.*1"):
            solver.solve_all(grasp, apart=min_distance)
    with pytest.raises(ik.errors.InputError, match=r"prefer:.*'speed'"):
        solver.solve_all(grasp, prefer="speed")
    with pytest.raises(ik.errors.InputError, match=r"q0:.*\(2, 14\).*\(14,\)"):
        solver.solve_all(grasp, q0=np.zeros((2, 14)))
    with pytest.raises(ik.errors.UnsupportedError, match="method: 'ipopt' "):
        ik.Solver(robot, "ipopt").solve_all(grasp)


@pytest.mark.slow
def test_arms_of_a_hand_with_a_wrist():
    """The wrist has two joints more than a closed form takes; all its branches are included."""
    robot = ik.load_robot("ur5e+shadow")
    solver = ik.Solver(robot)
    for q in robot.random(np.random.default_rng(3), 3):
        solutions = solver.solve_all(grasp_at(robot, q), limit=50, prefer="manipulability")
        assert len(solutions) >= 6
        for solution in solutions:
            assert np.abs(robot.contacts(solution.q)[0] - robot.contacts(q)[0]).max() < 0.005
            assert all(contact.ok for contact in solution.contacts.values())
