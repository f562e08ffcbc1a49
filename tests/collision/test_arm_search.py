"""The search for preferred free arms of hands, and for where unconstrained fingers have room."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.arm_search import ArmSearch
from casadi_ik.solve.free_hands import UnconstrainedFingers
from casadi_ik.solve.request import PREFERENCES


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    pole = {"kind": "capsule", "radius": 0.05, "length": 1.0, "xyz": [0.3, 0.25, 0.5]}
    return ik.Solver(robot, scene=ik.Scene({"pole": pole}))


@pytest.fixture(scope="module")
def hands(robot, solver):
    """Hands in reach, where the arms stand, and what they are checked against."""
    rng = np.random.default_rng(5)
    q = robot.random(rng, 60)
    around = solver._engine.collision_query(solver._request.of_arrays(*robot.contacts(q), None))
    room = around.hand_pairs.check(q).surplus
    kept = np.flatnonzero(room >= 0)
    return q[kept], robot.random(rng, len(kept)), around.rows(kept), room[kept]


@pytest.fixture(scope="module")
def search(solver) -> ArmSearch:
    found = solver._engine.finder.arm_search
    assert found is not None
    return found


@pytest.fixture(scope="module")
def plain(robot, search, solver) -> ArmSearch:
    finder = solver._engine.finder
    parts = search._family, search.scores, lambda: finder.manipulability
    return ArmSearch(robot, *parts, compiled=False)


def chosen(search, robot, hands, prefer, branches=False, **words):
    q, starts, around, room = hands
    return search.choose(
        q, starts, (robot.lower, robot.upper), prefer, around, room, branches, **words
    )


def scores(search, hands, found, prefer):
    if prefer == "clearance":
        return np.minimum(
            hands[2].rows(found.hand_index).check(found.q).surplus, hands[3][found.hand_index]
        )
    return search.scores(found.q, hands[1][found.hand_index], prefer)


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("prefer", PREFERENCES)
def test_without_a_compiler_the_same_hands_have_arms_no_better(
    search, plain, robot, hands, prefer, branches
):
    """It looks at the same values and those between, and no closer."""
    compiled, simple = (chosen(one, robot, hands, prefer, branches) for one in (search, plain))
    assert len(compiled.q) > 20
    assert set(compiled.hand_index) == set(simple.hand_index)
    for one in (compiled, simple):
        np.testing.assert_allclose(
            robot.palm(one.q), robot.palm(hands[0][one.hand_index]), atol=1e-9
        )
        assert (one.q >= robot.lower).all()
        assert (one.q <= robot.upper).all()
        if prefer != "clearance":
            assert hands[2].rows(one.hand_index).free(one.q).all()
    if not branches:
        np.testing.assert_array_equal(compiled.hand_index, simple.hand_index)
        better = scores(search, hands, compiled, prefer) - scores(search, hands, simple, prefer)
        # What is between the values may be better than what is about the best of them.
        assert np.mean(better >= -1e-9) > 0.7


def test_a_preference_of_ones_own_is_asked_by_the_compiled_search(search, robot, hands):
    """And its error comes through."""

    def high(q):
        return robot.palm(q)[:, 2, 3] - np.abs(q[:, 3] - 1.0)

    found = chosen(search, robot, hands, high)
    other = chosen(search, robot, hands, "limits")
    np.testing.assert_array_equal(found.hand_index, other.hand_index)
    assert (high(found.q) >= high(other.q) - 1e-9).mean() > 0.9
    assert (high(found.q) > high(other.q)).any()

    def broken(q):
        raise RuntimeError("no opinion")

    with pytest.raises(RuntimeError, match="no opinion"):
        chosen(search, robot, hands, broken)


def test_what_is_chosen_is_the_best_free_arm(search, robot, hands):
    """Any free arm of the same hand found by other means is no farther from its limits."""
    q, _, around, _ = hands
    found = chosen(search, robot, hands, "limits")
    given = around.free(q)[found.hand_index]
    best, own = (
        search.scores(each[given], each[given], "limits") for each in (found.q, q[found.hand_index])
    )
    assert (best >= own - 1e-12).all()
    assert given.sum() > 5


def test_each_hand_is_looked_at_alone(search, robot, hands):
    together, some = chosen(search, robot, hands, "limits"), np.array([7, 3, 11])
    q, starts, around, room = hands
    alone = chosen(search, robot, (q[some], starts[some], around.rows(some), room[some]), "limits")
    for i, hand in enumerate(some.tolist()):
        np.testing.assert_array_equal(
            alone.q[alone.hand_index == i], together.q[together.hand_index == hand]
        )


def test_the_first_hand_of_a_target_with_an_arm_is_enough(search, plain, robot, hands):
    whose = np.arange(len(hands[0])) // 3
    every = chosen(search, robot, hands, "limits")
    targets = whose[every.hand_index]
    firsts = every.hand_index[np.append(True, targets[1:] != targets[:-1])]
    for one in (search, plain):
        found = chosen(one, robot, hands, "limits", target_index=whose)
        np.testing.assert_array_equal(found.hand_index, firsts)
        assert (found.arms_tried[firsts] > 0).all()


def test_only_motors_of_unconstrained_fingers_move_and_only_for_more_room():
    robot = ik.load_robot("panda+shadow")
    rng, idle = np.random.default_rng(2), [robot.fingers.index(name) for name in ("ring", "little")]
    q = robot.random(rng, 120)
    points, normals = robot.contacts(q)
    points[:90, idle] = normals[:90, idle] = np.nan  # of the last thirty no finger is free
    fixed = np.full(len(robot.actuators), np.nan)
    motor = robot.actuators.index("shadow_rfj3")
    for given in (None, fixed):
        fixed[motor] = 0.0
        problems = TargetBatch(points, normals, ik.Tolerance(), True, fixed=given)
        around = SceneCheck(robot, ik.Scene({})).collision_query(problems).hand_pairs
        moved = UnconstrainedFingers(robot, problems).move_aside(q, np.arange(120), around)
        before, after = around.check(q).surplus, around.check(moved).surplus
        changed = (moved != q).any(axis=1)
        assert changed[:90].sum() > 5
        assert not changed[90:].any()
        assert (before[changed] < 0).all()
        assert (after[changed] > before[changed]).all()
        kept = [np.delete(robot.contacts(each)[0], idle, axis=1) for each in (moved, q)]
        np.testing.assert_array_equal(*kept)
        if given is not None:
            np.testing.assert_array_equal(moved[:, motor], q[:, motor])
