"""The damped step within bounds, against an exact solver of the same problem."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from casadi_ik.methods.common.bounded_step import Bounded, clip, damped_step, elimination

M, N, FIRST = 9, 7, 3


@pytest.fixture(scope="module")
def step():
    """(J, r, damping, value, lower, upper, passes) -> step, promised."""
    J, r, damping = ca.SX.sym("J", M, N), ca.SX.sym("r", M), ca.SX.sym("damping")
    value, lower, upper = (ca.SX.sym(name, N - FIRST) for name in ("value", "lower", "upper"))
    functions = {}

    def call(*inputs, passes=4):
        if passes not in functions:
            found = damped_step(J, r, damping, Bounded(value, lower, upper, FIRST), passes)
            symbols = [J, r, damping, value, lower, upper]
            functions[passes] = ca.Function("step", symbols, [found.step, found.promised])
        s, promised = functions[passes](*inputs)
        return np.array(s).ravel(), float(promised)

    return call


def problem(rng, tight):
    """A problem whose solution has some coordinates at bounds, or none."""
    J, r = rng.normal(size=(M, N)), rng.normal(size=M)
    lower, upper = -rng.uniform(0, tight, N - FIRST), rng.uniform(0, tight, N - FIRST)
    value = rng.uniform(lower, upper)
    # Some stand at a bound to begin with.
    at = rng.integers(0, 4, N - FIRST)
    value = np.where(at == 0, lower, np.where(at == 1, upper, value))
    return J, r, rng.uniform(1e-6, 1e-1), value, lower, upper


def exact(J, r, damping, value, lower, upper):
    """The same problem by scipy."""
    matrix = np.vstack([J, np.sqrt(damping) * np.eye(N)])
    right = np.concatenate([-r, np.zeros(N)])
    free = np.full(FIRST, np.inf)
    # lsq_linear wants lower < upper and an interior: bounds are widened by next to nothing.
    low = np.concatenate([-free, lower - value]) - 1e-13
    high = np.concatenate([free, upper - value]) + 1e-13
    return lsq_linear(matrix, right, (low, high), method="bvls", tol=1e-14).x


def test_without_active_bounds_it_is_the_damped_least_squares_step(step, rng):
    for _ in range(20):
        J, r, damping, value, lower, upper = problem(rng, 1.0)
        s, promised = step(J, r, damping, 0 * value, lower - 100, upper + 100)
        expected = -np.linalg.solve(J.T @ J + damping * np.eye(N), J.T @ r)
        np.testing.assert_allclose(s, expected, atol=1e-10)
        assert promised == pytest.approx(r @ r - np.sum((r + J @ expected) ** 2))


@pytest.mark.parametrize("tight", [0.05, 0.3, 1.0])
def test_enough_passes_give_the_exact_solution(step, rng, tight):
    same, held = 0, 0
    for _ in range(100):
        inputs = problem(rng, tight)
        _, _, _, value, lower, upper = inputs
        s, expected = step(*inputs, passes=6)[0], exact(*inputs)
        there = value + s[FIRST:]
        assert (there >= lower - 1e-12).all()
        assert (there <= upper + 1e-12).all()
        same += np.allclose(s, expected, atol=1e-6)
        held += np.sum((there <= lower + 1e-12) | (there >= upper - 1e-12))
    # The method is no cure-all for any quadratic, but nearly so for a handful of coordinates.
    assert same >= 95
    assert held > 50


@pytest.mark.parametrize("passes", [1, 2, 4])
def test_every_step_descends_and_stays_within(step, rng, passes):
    ascents = 0
    for _ in range(100):
        inputs = problem(rng, 0.3)
        J, r, _, value, lower, upper = inputs
        s, promised = step(*inputs, passes=passes)
        there = value + s[FIRST:]
        assert (there >= lower - 1e-12).all()
        assert (there <= upper + 1e-12).all()
        assert promised == pytest.approx(r @ r - np.sum((r + J @ s) ** 2), abs=1e-9)
        ascents += promised < 0
    assert ascents <= (5 if passes == 1 else 0)


def test_a_held_coordinate_is_let_go_when_the_others_pull_it_inside(step):
    """Its own slope points outwards, but not once the others have moved."""
    J, r = np.zeros((M, N)), np.zeros(M)
    J[:N, :N] = np.eye(N)
    J[3, 4] = -1.0
    r[3:5] = [0.5, -2.0]
    value, lower, upper = np.zeros(4), np.array([0.0, -5, -5, -5]), np.full(4, 5.0)
    assert (J.T @ r)[3] > 0
    inputs = (J, r, 1e-9, value, lower, upper)
    s = step(*inputs)[0]
    assert s[3] > 0.1
    np.testing.assert_allclose(s, exact(*inputs), atol=1e-6)


def test_a_locked_coordinate_does_not_move(step, rng):
    J, r, damping, value, lower, upper = problem(rng, 1.0)
    lower, upper = lower.copy(), upper.copy()
    lower[1] = upper[1] = value[1]
    s, _ = step(J, r, damping, value, lower, upper)
    assert s[FIRST + 1] == 0.0


def test_a_singular_problem_is_finite(step):
    s, _ = step(np.zeros((M, N)), np.ones(M), 1e-12, np.zeros(4), -np.ones(4), np.ones(4))
    np.testing.assert_array_equal(s, 0)


def test_clip():
    bounds = Bounded(ca.DM.zeros(2), ca.DM([-1, -1]), ca.DM([1, 1]), 0)
    np.testing.assert_array_equal(np.array(clip(ca.DM([3, -2]), bounds)).ravel(), [1, -1])


FINGERS, JOINTS, PALM = 5, 4, 6


def test_fingers_that_share_a_palm_alone_are_eliminated_one_by_one():
    """The order of least fill: no pivot is coupled with more than its finger and the palm."""
    normal = ca.sparsify(fingers().T @ fingers())
    order = elimination(normal.sparsity(), PALM, 2)
    assert not order.once
    assert max(len(pivot.others) for pivot in order.each) == JOINTS - 1 + PALM
    # Of few motors the palm comes first, once.
    assert elimination(ca.Sparsity.dense(N, N), FIRST, 2).once


def test_a_sparse_problem_has_the_solution_of_the_dense_one(rng):
    count = PALM + FINGERS * JOINTS
    J = fingers()
    r, damping = ca.SX.sym("r", J.shape[0]), ca.SX.sym("damping")
    value, lower, upper = (ca.SX.sym(name, count - PALM) for name in ("value", "lower", "upper"))
    found = damped_step(J, r, damping, Bounded(value, lower, upper, PALM), 6)
    inputs = [ca.vertcat(*J.nonzeros()), r, damping, value, lower, upper]
    step = ca.Function("step", inputs, [found.step])
    same, held = 0, 0
    for _ in range(10):
        numbers = rng.normal(size=J.nnz())
        dense = np.array(ca.DM(J.sparsity(), numbers))
        low, high = -rng.uniform(0, 0.3, count - PALM), rng.uniform(0, 0.3, count - PALM)
        at, right = rng.uniform(low, high), rng.normal(size=J.shape[0])
        s = np.array(step(numbers, right, 1e-2, at, low, high)).ravel()
        matrix = np.vstack([dense, 0.1 * np.eye(count)])
        free = np.full(PALM, np.inf)
        ends = np.r_[-free, low - at] - 1e-13, np.r_[free, high - at] + 1e-13
        expected = lsq_linear(
            matrix, np.r_[-right, np.zeros(count)], ends, method="bvls", tol=1e-14
        )
        same += np.allclose(s, expected.x, atol=1e-6)
        held += np.sum(np.isclose(at + s[PALM:], low) | np.isclose(at + s[PALM:], high))
    assert same >= 8
    assert held > 10


def fingers():
    """A Jacobian of fingers with joints of their own on a palm that moves them all."""
    rows = []
    for i in range(FINGERS):
        own = [ca.SX(6, JOINTS) for _ in range(FINGERS)]
        own[i] = ca.SX.sym(f"own{i}", 6, JOINTS)
        rows.append(ca.horzcat(ca.SX.sym(f"palm{i}", 6, PALM), *own))
    return ca.vertcat(*rows)
