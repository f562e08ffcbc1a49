"""Mobility and active joints from the chain's numbers, for thumbs of one to four joints."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from robot_variants import thumb_of

from casadi_ik.symbolic.closed_chain import VIRTUAL, closed_chain, mobility, pivoted, split
from casadi_ik.symbolic.kinematics import actuated

LENGTH = 0.1


def matrices(robot, platform="palm"):
    """``q -> C, J_cc, motor steps, thumb's linear and angular rows, normal`` as a Function."""
    n = len(robot.actuators)
    q = ca.SX.sym("q", n)
    body, parts = actuated(robot.description, q), split(robot.description)
    chain = closed_chain(body, parts, LENGTH, platform)
    step = ca.SX.sym("step", len(parts.active))
    motors = ca.jacobian(chain.motor_steps(step, n), step)
    thumb = body.contact_jacobian(robot.thumb, range(n))
    normal = body.kinematics.contact(robot.thumb)[1]
    outputs = [chain.constraint, chain.J_cc, motors, *thumb, normal]
    function = ca.Function("matrices", [q], [ca.densify(x) for x in outputs])
    return parts, lambda row: [np.array(x) for x in function.call([ca.DM(row)])]


def test_pivoting_finds_rank_and_independent_columns(rng):
    for rank, k in ((6, 10), (4, 10), (3, 3), (1, 5)):
        C = rng.normal(size=(6, rank)) @ rng.normal(size=(rank, k))
        active, passive = pivoted(C)
        assert sorted(active + passive) == list(range(k))
        assert len(passive) == rank
        assert mobility(C) == k - rank
        assert np.linalg.matrix_rank(C[:, list(passive)]) == rank


def test_pivoting_of_nothing():
    assert pivoted(np.zeros((6, 3))) == ((0, 1, 2), ())
    assert mobility(np.zeros((6, 0))) == 0


def test_pivoting_conditions_better_than_a_fixed_choice(robot, rng):
    """H_p over random configurations, lengths in 0.1 m: the paper's set against pivoting."""
    parts, evaluate = matrices(robot)
    fixed = [i for i, column in enumerate(parts.columns) if column in parts.passive]
    paper, ours, rates = [], [], []
    for q in robot.random(rng, 400):
        C = evaluate(q)[0]
        active, passive = (list(columns) for columns in pivoted(C))
        paper.append(np.linalg.cond(C[:, fixed]))
        ours.append(np.linalg.cond(C[:, passive]))
        rates.append(np.abs(np.linalg.solve(C[:, passive], C[:, active])).max())
    assert np.median(paper) > 3 * np.median(ours)
    assert np.percentile(paper, 90) > 10 * np.percentile(ours, 90)
    assert np.percentile(ours, 99) < 100
    assert np.percentile(rates, 99) < 2


@pytest.fixture(scope="module", params=[1, 2, 3, 4])
def derived(request, tmp_path_factory):
    """The shipped arm with a thumb of one to four joints."""
    return request.param, thumb_of(tmp_path_factory.mktemp("thumb"), request.param)


def test_mobility_is_computed(derived, rng):
    joints, robot = derived
    parts, evaluate = matrices(robot)
    assert len(parts.columns) == 8 + joints
    assert len(parts.active) == joints + 2
    assert len(parts.passive) == 6
    assert parts.active[0] == VIRTUAL
    for q in robot.random(rng, 10):
        assert mobility(evaluate(q)[0]) == joints + 2


def test_the_palm_moves_as_the_thumb_lets_it(derived, rng):
    """Rank of the palm's J_cc: virtual joint and thumb, six at most; the elbow adds nothing."""
    joints, robot = derived
    _, evaluate = matrices(robot)
    checked = 0
    for q in robot.random(rng, 60):
        _, J_cc, motors, *_ = evaluate(q)
        if np.abs(motors).max() > 30:
            continue
        s = np.linalg.svd(J_cc, compute_uv=False)
        assert np.sum(s > 1e-8 * s[0]) == min(joints + 1, 6)
        checked += 1
    assert checked > 3


def test_the_chain_is_the_null_space_of_the_thumbs_rows(derived, rng):
    """Virtual joint and reversed thumb against three rows of the point and two of the normal."""
    joints, robot = derived
    _, evaluate = matrices(robot)
    columns = [*robot.description.arm_actuators, *robot.description.finger_actuators(robot.thumb)]
    checked = 0
    for q in robot.random(rng, 60):
        _, _, motors, linear, angular, normal = evaluate(q)
        if np.abs(motors).max() > 30:
            continue
        task = np.vstack([linear / LENGTH, (np.eye(3) - normal @ normal.T) @ angular])[:, columns]
        null = np.linalg.svd(task)[2][5:].T
        assert null.shape[1] == joints + 2
        chain = np.linalg.qr(motors[columns])[0]
        np.testing.assert_allclose(null @ (null.T @ chain), chain, atol=1e-8)
        checked += 1
    assert checked > 3


def test_rows_two_to_six_of_h_are_the_arms(robot, rng):
    """Not h_1 to h_5, as eq. (8) prints: with q_p of eq. (7) the first row is the thumb's."""
    q = ca.SX.sym("q", 14)
    body, parts = actuated(robot.description, q), split(robot.description)
    chain = closed_chain(body, parts)
    thumb_1 = robot.actuators.index("bh_thumb_proximal")
    order = [thumb_1, 0, 1, 2, 3, 4]
    H = chain.H[[parts.passive.index(c) for c in order], :]
    twist = body.palm_body_jacobian(range(6))
    last = ca.DM([[0, 0, 0, 1]])
    assert parts.active == (VIRTUAL, robot.actuators.index("bh_thumb_distal"), 6, 5)
    right, printed = (twist @ ca.vertcat(rows, last) for rows in (H[1:, :], H[:5, :]))
    f = ca.Function("f", [q], [chain.J_cc, right, printed, chain.H])
    checked = 0
    for row in robot.random(rng, 40):
        J_cc, right_, printed_, H_ = (np.array(x) for x in f.call([ca.DM(row)]))
        if np.abs(H_).max() > 50:
            continue
        scale = np.linalg.norm(J_cc)
        assert np.linalg.norm(right_ - J_cc) < 1e-9 * scale
        assert np.linalg.norm(printed_ - J_cc) > 1e-2 * scale
        checked += 1
    assert checked > 5
