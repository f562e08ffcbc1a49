"""The preferred free arms of hands: compiled code and numpy come to the same."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.arms.recognise import arm_family
from casadi_ik.arms.search import arms_graph
from casadi_ik.problem.preference import PREFERENCES
from casadi_ik.solving.alternatives.arm_places import arm_places
from casadi_ik.solving.alternatives.swings import ArmSwings


@pytest.fixture(scope="module")
def robot() -> ik.ArmHand:
    return ik.load_robot("kuka_lwr_barrett")


@pytest.fixture(scope="module")
def solver(robot) -> ik.Solver:
    pole = {"kind": "capsule", "radius": 0.05, "length": 1.0, "xyz": [0.3, 0.25, 0.5]}
    return ik.Solver(robot, scene=ik.Scene({"pole": pole}))


@pytest.fixture(scope="module")
def hands(robot, solver):
    """Hands in reach, where the arms stand, and what they are checked against."""
    rng = np.random.default_rng(5)
    q = robot.random(rng, 60)
    around = solver._engine.around(solver._questions.of_arrays(*robot.contacts(q), None))
    room = around.held.check(q).room
    kept = np.flatnonzero(room >= 0)
    return q[kept], robot.random(rng, len(kept)), around.rows(kept), room[kept]


@pytest.fixture(scope="module")
def swings(solver) -> ArmSwings:
    found = solver._engine.freer.swings
    assert found is not None
    return found


def chosen(swings, robot, hands, prefer, branches, around):
    q, starts, _, room = hands
    bounds = robot.lower, robot.upper
    return swings.choose(q, starts, bounds, prefer, around, room, branches)


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("prefer", PREFERENCES)
def test_compiled_code_and_numpy_agree(swings, robot, hands, prefer, branches, monkeypatch):
    around = hands[2]
    compiled = chosen(swings, robot, hands, prefer, branches, around)
    monkeypatch.setattr(swings._kernel, "can", lambda *_: False)
    plain = chosen(swings, robot, hands, prefer, branches, around)
    assert len(compiled.q) > 20
    np.testing.assert_array_equal(compiled.owner, plain.owner)
    np.testing.assert_allclose(compiled.q, plain.q, atol=1e-9)
    if prefer != "clearance":
        np.testing.assert_array_equal(compiled.tried, plain.tried)


def test_what_is_chosen_holds_the_hand_and_is_the_best_free_arm(swings, robot, hands):
    q, _, around, _ = hands
    found = chosen(swings, robot, hands, "limits", False, around)
    np.testing.assert_allclose(robot.palm(found.q), robot.palm(q[found.owner]), atol=1e-9)
    mine = around.rows(found.owner)
    swung = mine.kernel.least(found.q, mine.poses, mine.table.swung)[0]
    assert (swung >= -1e-9).all()
    margin = np.minimum(found.q - robot.lower, robot.upper - found.q) / (robot.upper - robot.lower)
    arm = list(robot.description.arm_actuators)
    # Any free arm of the same hand found by other means is no farther from its limits.
    given = around.free(q)[found.owner]
    own = np.minimum(q - robot.lower, robot.upper - q) / (robot.upper - robot.lower)
    best = margin[given][:, arm].min(axis=1)
    assert (best >= own[found.owner][given][:, arm].min(axis=1) - 1e-12).all()
    assert given.sum() > 5


def test_each_hand_is_looked_at_alone(swings, robot, hands):
    q, starts, around, room = hands
    together = chosen(swings, robot, hands, "limits", False, around)
    some = np.array([7, 3, 11])
    alone = swings.choose(
        q[some], starts[some], (robot.lower, robot.upper), "limits", around.rows(some), room[some]
    )
    for i, hand in enumerate(some.tolist()):
        np.testing.assert_array_equal(alone.q[alone.owner == i], together.q[together.owner == hand])


def test_pairs_are_those_of_the_hand_or_of_the_arm(solver, robot, hands):
    table = hands[2].table
    assert len(table.held.pairs) + len(table.swung.pairs) == len(table.pairs)
    for first, second in table.held.names:
        assert not {first, second} & {f"lwr_link_{i}" for i in range(1, 6)}
    # With the hand where it is, the first do not change while the arm does.
    around = hands[2]
    found = chosen(solver._engine.freer.swings, robot, hands, "q0", False, around)
    one = around.rows(found.owner).held.check(found.q).room
    np.testing.assert_allclose(one, hands[3][found.owner], atol=1e-8)
    assert len(found.q) > 20


def test_the_first_hand_of_a_target_with_an_arm_is_enough(swings, robot, hands, monkeypatch):
    q, starts, around, room = hands
    whose = np.arange(len(q)) // 3
    words = q, starts, (robot.lower, robot.upper), "limits", around, room
    every, compiled = swings.choose(*words), swings.choose(*words, of_one=whose)
    targets = whose[every.owner]
    firsts = every.owner[np.append(True, targets[1:] != targets[:-1])]
    np.testing.assert_array_equal(compiled.owner, firsts)
    monkeypatch.setattr(swings._kernel, "can", lambda *_: False)
    plain = swings.choose(*words, of_one=whose)
    np.testing.assert_array_equal(plain.owner, firsts)
    np.testing.assert_array_equal(plain.tried, compiled.tried)
    np.testing.assert_allclose(plain.q, compiled.q, atol=1e-9)


@pytest.mark.parametrize(("name", "sides"), [("ur5e+shadow", 8), ("xarm6+shadow", 32)])
def test_an_arm_with_a_wrist_is_seen_with_the_wrist_anywhere(name, sides):
    """All arms at the wrist of a posture have its palm; one of them is the posture's own."""
    robot = ik.load_robot(name)
    arm = arm_family(robot.description)
    assert arm is not None
    assert len(arm.held) == 2
    at = arms_graph(arm, "arms_of_wrist", "").function
    columns = list(robot.description.arm_actuators)
    places = arm_places(robot, arm)
    for q in robot.random(np.random.default_rng(1), 4):
        palm = robot.palm(q)
        wrist = q[columns][list(arm.held)]
        found = np.array(at(np.concatenate([palm[:3, :3].ravel(), palm[:3, 3], wrist]))).ravel()
        arms, slack = found[:-sides].reshape(sides, len(columns)), found[-sides:]
        whole = np.tile(q, (sides, 1))
        whole[:, columns] = arms
        reached = robot.palm(whole[slack >= 0])
        np.testing.assert_allclose(reached, np.tile(palm, (len(reached), 1, 1)), atol=1e-8)
        off = np.abs(np.angle(np.exp(1j * (arms - q[columns])))).max(axis=1)
        assert off[slack >= 0].min() < 1e-6
    assert places.sides == sides
    for level in places.levels:
        assert level.shape[1] == 2
        assert (level >= robot.lower[columns][list(arm.held)]).all()
        assert (level <= robot.upper[columns][list(arm.held)]).all()
