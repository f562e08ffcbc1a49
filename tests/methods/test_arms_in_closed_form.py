"""Arms that are not S-R-S: every target is solved, by a closed form where one exists."""

from __future__ import annotations

import numpy as np
import pytest
from robot_variants import derived_robot
from samplers import near_limits
from toy_robots import EXACT, grasp_at

import casadi_ik as ik

SINGLE = ("ur5e", "puma560", "irb140")


def robot_of(arm: str) -> ik.ArmHand:
    return ik.load_robot(f"{arm}+barrett_bh8_280")


@pytest.fixture(scope="module")
def panda() -> ik.ArmHand:
    return robot_of("panda")


@pytest.fixture(scope="module")
def solver(panda) -> ik.Solver:
    return ik.Solver(panda, tolerance=EXACT)


@pytest.mark.parametrize(
    ("method", "tolerance", "min_solved"),
    [
        ("hand-first", ik.Tolerance(), 1),
        ("hand-first", EXACT, 1),
        ("thumb-first", ik.Tolerance(), 0.95),
    ],
)
def test_an_arm_without_a_closed_form(tmp_path_factory, method, tolerance, min_solved):
    robot = derived_robot(tmp_path_factory.mktemp("offset"), wrist_offset=0.045)
    # Few enough targets that no kernel in lanes is compiled.
    q = robot.random(np.random.default_rng(5), 60)
    batch = ik.Solver(robot, method, tolerance).solve_batch(*robot.contacts(q))
    assert batch.success.mean() >= min_solved
    if method == "hand-first":  # nearly all by the arm stage, not by the whole-system stage
        assert np.mean(batch.phases["refinement"] == 0) > 0.9
    else:
        assert batch.phases["arm-placement"].all()


@pytest.mark.slow
@pytest.mark.parametrize("arm", [*SINGLE, "kinova_gen3", "xarm6", "sawyer"])
def test_arm_follows_the_hand_immediately(arm):
    """A six-joint arm needs one evaluation; an arm that is only nearly of a family is refined."""
    robot = robot_of(arm)
    q = robot.random(np.random.default_rng(7), 12)
    batch = ik.Solver(robot, tolerance=EXACT, compiled=False).solve_batch(*robot.contacts(q))
    # The virtual machine has no restarts.
    assert batch.success.sum() >= 11
    assert batch.phases["arm-placement"].all()
    if arm in SINGLE:
        assert (batch.phases["refinement"] == 0).mean() > 0.9


@pytest.mark.slow
def test_every_target_of_a_panda_is_solved(panda, solver):
    rng = np.random.default_rng(2026)
    q = np.concatenate([panda.random(rng, 1000), near_limits(panda, rng, 500)])
    batch = solver.solve_batch(*panda.contacts(q))
    assert np.flatnonzero(~batch.success).tolist() == []
    assert (batch.q >= panda.lower).all()
    assert (batch.q <= panda.upper).all()
    # The closed form solves nearly all.
    assert (batch.phases["refinement"][:1000] == 0).mean() > 0.97


def test_targets_of_a_panda_with_a_joint_next_to_its_limit(panda, solver):
    """Intervals of the swept joint of a few thousandths of a degree are found."""
    rng = np.random.default_rng(3)
    q = panda.random(rng, 400)
    joint, side = rng.integers(0, 7, len(q)), rng.integers(0, 2, len(q)).astype(bool)
    rows, margin = np.arange(len(q)), np.radians(0.003)
    q[rows, joint] = np.where(side, panda.lower[joint] + margin, panda.upper[joint] - margin)
    assert solver.solve_batch(*panda.contacts(q)).success.all()


def held_hand(robot):
    """For a hand without motors, the arm must reach the one palm pose of the contacts."""
    description = robot.description
    hand = list(description.hand_actuators)
    middle = (robot.lower + robot.upper)[hand] / 2
    return dict(zip((description.actuators[i].name for i in hand), middle.tolist(), strict=True))


def with_hand(robot, arms, hand):
    return np.concatenate([arms, np.tile(list(hand.values()), (len(arms), 1))], axis=1)


def test_short_intervals_of_the_swept_joint_are_found(panda, solver):
    """With six of seven joints near their limits, some intervals are tiny."""
    hand = held_hand(panda)
    q_missed = [
        0.12332358,
        -1.75856779,
        2.88167321,
        -0.95126358,
        -2.89537776,
        -0.01444861,
        2.88507954,
    ]
    targets = near_limits(panda, np.random.default_rng(12), 1000)[:, :7]
    q = with_hand(panda, np.concatenate([[q_missed], targets]), hand)
    batch = solver.solve_batch(*panda.contacts(q), fixed=hand)
    assert np.flatnonzero(~batch.success).tolist() == []
    # Targets that the first restart misses are mostly solved by the first trials of the second.
    used_restarts = batch.restarts[batch.restarts > 0]
    assert len(used_restarts) > 3
    assert np.median(used_restarts) == solver.parameters["options"]["candidates"]


def test_nearly_closed_form_straight_arm():
    """From the nominal arm, Newton's method fails there, and the search succeeds."""
    robot = robot_of("kinova_gen3")
    hand = held_hand(robot)
    arms = [
        "-2.25590562 1.11213278 0.174661621 -3.82220308e-3 4.56551379 -1.40069069 -2.57414118",
        "-5.8510545 -1.55882184 0.104356153 0.0169097239 -5.75443661 2.06294144 -4.37043832",
    ]
    q = with_hand(robot, np.array([row.split() for row in arms], dtype=float), hand)
    solver = ik.Solver(robot, tolerance=EXACT)
    assert solver.solve_batch(*robot.contacts(q), fixed=hand).success.all()


def test_nearby_solutions_of_a_panda_are_found(panda, solver):
    q = panda.random(np.random.default_rng(4), 200)
    start = np.clip(
        q + np.random.default_rng(5).normal(scale=0.3, size=q.shape), panda.lower, panda.upper
    )
    contacts = panda.contacts(q)
    near_batch = solver.solve_batch(*contacts, q0=start, prefer="q0")
    limits_batch = solver.solve_batch(*contacts)
    assert near_batch.success.all()
    near_by, far_by = (
        np.abs(batch.q - start)[:, :7].max(axis=1) for batch in (near_batch, limits_batch)
    )
    assert np.median(near_by) < 0.5 * np.median(far_by)


@pytest.mark.parametrize("name", ["xarm6+barrett_bh8_280", "xarm6+shadow"])
def test_nearby_solutions_of_a_searched_last_joint_are_found(name):
    """A search of the branches would miss the arm; it starts where the robot is."""
    robot = ik.load_robot(name)
    rng = np.random.default_rng(4)
    q = robot.random(rng, 40)
    start = np.clip(q + rng.normal(scale=0.2, size=q.shape), robot.lower, robot.upper)
    solver = ik.Solver(robot, tolerance=EXACT, compiled=False)
    batch = solver.solve_batch(*robot.contacts(q), q0=start, prefer="q0")
    assert batch.success.all()
    batch_distance, known_distance = (
        np.abs(q_rows - start)[:, :6].max(axis=1) for q_rows in (batch.q, q)
    )
    assert (batch_distance < 1.5 * known_distance + 0.05).mean() > 0.9


def test_all_solutions_of_a_panda(panda, solver):
    q = panda.random(np.random.default_rng(6), 1)[0]
    solutions = solver.solve_all(grasp_at(panda, q), limit=100, apart=0)
    assert len(solutions) > 1
    for solution in solutions:
        assert all(contact.ok for contact in solution.contacts.values())
        assert solution.branch is not None
        assert solution.branch.swivel is not None
        start, end = solution.branch.swivel
        assert start - 1e-9 <= solution.swivel <= end + 1e-9
    assert len({(solution.posture, solution.branch) for solution in solutions}) == len(solutions)
