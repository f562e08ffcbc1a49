"""Steps within bounds, and the balance of contacts that contradict each other."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from toy_robots import grasp_of

import casadi_ik as ik
from casadi_ik.methods.common.bounded_step import Bounded, damped_step

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


FINGERS, JOINTS, PALM = 5, 4, 6


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


TOLERANCE = ik.Tolerance()
THREE = ("index", "thumb", "middle")
ALL = "kuka_lwr_barrett"
"""All of its fingers are asked."""


def displaced(robot, rng, count, part, fingers=None):
    """Contacts of configurations, moved and turned by a part of the tolerance: still met by q."""
    q = robot.random(rng, count)
    points, normals = robot.contacts(q)
    aside = rng.normal(size=points.shape)
    aside /= np.linalg.norm(aside, axis=2, keepdims=True)
    points = points + part * TOLERANCE.position * aside
    across = rng.normal(size=points.shape)
    across -= normals * (across * normals).sum(axis=2, keepdims=True)
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    angle = part * TOLERANCE.angle
    normals = np.cos(angle) * normals + np.sin(angle) * across
    free = [name not in (fingers or robot.fingers) for name in robot.fingers]
    points[:, free] = normals[:, free] = np.nan
    return points, normals


def noisy(robot, rng, count):
    """Contacts as a camera sees them; about one in fifty cannot be met."""
    points, normals = robot.contacts(robot.random(rng, count))
    normals = normals + rng.normal(0, np.radians(2.0), normals.shape)
    return points + rng.normal(0, 4e-3, points.shape), normals


@pytest.mark.parametrize(
    ("name", "count", "fingers"),
    [(ALL, 2000, None), ("ar10", 200, THREE), ("baxter_ar10", 200, THREE)],
)
def test_what_a_configuration_meets_is_solved(name, count, fingers):
    """Least squares alone missed 1.2, 54 and 3.4 % of them."""
    robot = ik.load_robot(name)
    points, normals = displaced(robot, np.random.default_rng(1), count, 0.98, fingers)
    batch = ik.Solver(robot).solve_batch(points, normals)
    assert np.flatnonzero(~batch.success).tolist() == []
    assert batch.phases["balance"].any()


def test_limits_and_held_actuators_are_kept(robot):
    points, normals = noisy(robot, np.random.default_rng(3), 500)
    free = ik.Solver(robot).solve_batch(points, normals)
    balanced = np.flatnonzero((free.phases["balance"] > 0) & free.success)
    assert len(balanced)
    assert ((free.q >= robot.lower) & (free.q <= robot.upper)).all()
    spread, again = robot.actuators.index("bh_spread"), 0
    for row in balanced[:20]:
        held = float(np.clip(free.q[row, spread] + 0.005, robot.lower[spread], robot.upper[spread]))
        one = slice(row, row + 1)
        batch = ik.Solver(robot).solve_batch(points[one], normals[one], fixed={"bh_spread": held})
        assert batch.q[0, spread] == held
        again += batch.phases["balance"].sum()
    assert again


def test_alone_in_a_batch_and_in_blocks_the_answer_is_the_same(robot):
    solver = ik.Solver(robot)
    points, normals = noisy(robot, np.random.default_rng(5), 300)
    batch = solver.solve_batch(points, normals)
    blocks = [(points[:100], normals[:100]), (points[100:], normals[100:])]
    streamed = np.concatenate([block.solution.q for block in solver.solve_blocks(blocks)])
    np.testing.assert_array_equal(streamed, batch.q)
    rows = np.flatnonzero(batch.phases["balance"])[:8]
    assert len(rows)
    for row in rows:
        alone = solver.solve(grasp_of(robot, points[row], normals[row]), diagnose=False)
        # A grasp normalises its normals itself, so the last digit may differ.
        np.testing.assert_allclose(alone.q, batch.q[row], atol=1e-6)
        assert alone.success == batch.success[row]


def test_fits_that_come_back_to_a_minimum_that_misses_end_the_rounds_of_tables(robot):
    """They took every round, and up to 60 steps of a balance, to be given up."""
    points, normals = noisy(robot, np.random.default_rng(11), 1000)
    solver = ik.Solver(robot)
    batch = solver.solve_batch(points, normals)
    missed = ~batch.success
    assert missed.sum() >= 10
    # Two rounds of tables instead of six.
    given_up = 8 * (2 + 3 + 2) - 1
    assert np.median(batch.restarts[missed]) == given_up
    assert np.median(batch.phases["balance"][missed]) < 15
    patient = ik.Solver(robot, options={"same_minimum": (10**6, 10**6), "far_cost": (1e9, 1e9)})
    assert not patient.solve_batch(points[missed], normals[missed]).success.any()
    row = np.flatnonzero(missed)[batch.restarts[missed] == given_up][0]
    grasp = grasp_of(robot, points[row], normals[row])
    assert max(record["restart"] for record in solver.stepper(grasp)) <= given_up + 1


def test_what_is_missed_by_far_is_not_balanced(robot):
    points, normals = noisy(robot, np.random.default_rng(7), 20)
    points[:, 0] += 0.5
    batch = ik.Solver(robot).solve_batch(points, normals)
    assert not batch.success.any()
    assert not batch.phases["balance"].any()
