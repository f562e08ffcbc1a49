"""Search for preferred collision-free arms, and for clearance of unconstrained fingers."""

from __future__ import annotations

import numpy as np
import pytest
from collision_queries import query_at

import casadi_ik as ik
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.model.targets import PREFERENCES, TargetBatch
from casadi_ik.solve.arm_search import ArmSearch
from casadi_ik.solve.free_hands import UnconstrainedFingers


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    pole = {"kind": "capsule", "radius": 0.05, "length": 1.0, "xyz": [0.3, 0.25, 0.5]}
    return ik.Solver(robot, scene=ik.Scene({"pole": pole}))


@pytest.fixture(scope="module")
def hands(robot, solver):
    """Reachable hands, the arms that reach them, and their collision query."""
    rng = np.random.default_rng(5)
    q = robot.random(rng, 60)
    around = query_at(solver, q)
    clearance = around.hand_pairs.check(q).surplus
    free_rows = np.flatnonzero(clearance >= 0)
    return (
        q[free_rows],
        robot.random(rng, len(free_rows)),
        around.rows(free_rows),
        clearance[free_rows],
    )


@pytest.fixture(scope="module")
def search(solver) -> ArmSearch:
    arm_search = solver._engine.finder.arm_search
    assert arm_search is not None
    return arm_search


@pytest.fixture(scope="module")
def plain(robot, search, solver) -> ArmSearch:
    finder = solver._engine.finder
    parts = search._family, search.scores, lambda: finder.manipulability
    return ArmSearch(robot, *parts, compiled=False)


def run_search(search, robot, hands, prefer, branches=False, **words):
    q, starts, around, clearance = hands
    return search.choose(
        q, starts, (robot.lower, robot.upper), prefer, around, clearance, branches, **words
    )


def scores(search, hands, arms, prefer):
    if prefer == "clearance":
        return np.minimum(
            hands[2].rows(arms.hand_index).check(arms.q).surplus, hands[3][arms.hand_index]
        )
    return search.scores(arms.q, hands[1][arms.hand_index], prefer)


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("prefer", PREFERENCES)
def test_compiled_search_is_no_worse_than_numpy(search, plain, robot, hands, prefer, branches):
    """Both searches cover the same values and the values between them."""
    compiled, simple = (
        run_search(arm_search, robot, hands, prefer, branches) for arm_search in (search, plain)
    )
    assert len(compiled.q) > 20
    assert set(compiled.hand_index) == set(simple.hand_index)
    for arm_search in (compiled, simple):
        np.testing.assert_allclose(
            robot.palm(arm_search.q), robot.palm(hands[0][arm_search.hand_index]), atol=1e-9
        )
        assert (arm_search.q >= robot.lower).all()
        assert (arm_search.q <= robot.upper).all()
        if prefer != "clearance":
            assert hands[2].rows(arm_search.hand_index).free(arm_search.q).all()
    if not branches:
        np.testing.assert_array_equal(compiled.hand_index, simple.hand_index)
        better = scores(search, hands, compiled, prefer) - scores(search, hands, simple, prefer)
        # A value between samples may be better than the neighbourhood of the best sample.
        assert np.mean(better >= -1e-9) > 0.7


def test_compiled_search_uses_custom_preferences(search, robot, hands):
    """The error of a thread is raised."""

    def high(q):
        return robot.palm(q)[:, 2, 3] - np.abs(q[:, 3] - 1.0)

    arms = run_search(search, robot, hands, high)
    limit_arms = run_search(search, robot, hands, "limits")
    np.testing.assert_array_equal(arms.hand_index, limit_arms.hand_index)
    assert (high(arms.q) >= high(limit_arms.q) - 1e-9).mean() > 0.9
    assert (high(arms.q) > high(limit_arms.q)).any()

    def broken(q):
        raise RuntimeError("no opinion")

    with pytest.raises(RuntimeError, match="no opinion"):
        run_search(search, robot, hands, broken)


def test_best_collision_free_arm_is_chosen(search, robot, hands):
    """No other collision-free arm of the same hand is farther from its limits."""
    q, _, around, _ = hands
    arms = run_search(search, robot, hands, "limits")
    is_free = around.free(q)[arms.hand_index]
    best, start_scores = (
        search.scores(q_rows[is_free], q_rows[is_free], "limits")
        for q_rows in (arms.q, q[arms.hand_index])
    )
    assert (best >= start_scores - 1e-12).all()
    assert is_free.sum() > 5


def test_hands_are_searched_independently(search, robot, hands):
    all_arms, rows = run_search(search, robot, hands, "limits"), np.array([7, 3, 11])
    q, starts, around, clearance = hands
    arms_of_rows = run_search(
        search, robot, (q[rows], starts[rows], around.rows(rows), clearance[rows]), "limits"
    )
    for i, hand in enumerate(rows.tolist()):
        np.testing.assert_array_equal(
            arms_of_rows.q[arms_of_rows.hand_index == i], all_arms.q[all_arms.hand_index == hand]
        )


def test_search_stops_at_the_first_hand_with_an_arm(search, plain, robot, hands):
    whose = np.arange(len(hands[0])) // 3
    all_arms = run_search(search, robot, hands, "limits")
    targets = whose[all_arms.hand_index]
    firsts = all_arms.hand_index[np.append(True, targets[1:] != targets[:-1])]
    for arm_search in (search, plain):
        arms = run_search(arm_search, robot, hands, "limits", target_index=whose)
        np.testing.assert_array_equal(arms.hand_index, firsts)
        assert (arms.arms_tried[firsts] > 0).all()


def test_only_unconstrained_fingers_move_to_gain_clearance():
    robot = ik.load_robot("panda+shadow")
    rng, idle = np.random.default_rng(2), [robot.fingers.index(name) for name in ("ring", "little")]
    q = robot.random(rng, 120)
    points, normals = robot.contacts(q)
    points[:90, idle] = normals[:90, idle] = np.nan  # of the last thirty no finger is free
    fixed = np.full(len(robot.actuators), np.nan)
    motor = robot.actuators.index("shadow_rfj3")
    for fixed_motors in (None, fixed):
        fixed[motor] = 0.0
        problems = TargetBatch(points, normals, ik.Tolerance(), True, fixed=fixed_motors)
        around = SceneCheck(robot, ik.Scene({})).collision_query(problems).hand_pairs
        q_aside = UnconstrainedFingers(robot, problems).move_aside(q, np.arange(120), around)
        clearance_before, after = around.check(q).surplus, around.check(q_aside).surplus
        changed = (q_aside != q).any(axis=1)
        assert changed[:90].sum() > 5
        assert not changed[90:].any()
        assert (clearance_before[changed] < 0).all()
        assert (after[changed] > clearance_before[changed]).all()
        constrained_points = [
            np.delete(robot.contacts(q_rows)[0], idle, axis=1) for q_rows in (q_aside, q)
        ]
        np.testing.assert_array_equal(*constrained_points)
        if fixed_motors is not None:
            np.testing.assert_array_equal(q_aside[:, motor], q[:, motor])
