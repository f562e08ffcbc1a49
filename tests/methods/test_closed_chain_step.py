"""The step along the closed chain: frozen joints and the quadratic program, side by side."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_ik.methods.thumb_first.closed_chain_step import (
    THUMB_DAMPING,
    Linear,
    Room,
    contact_errors,
    freezing,
    linearised,
    quadratic_program,
)
from casadi_ik.problem.contacts import LENGTH, ContactRows, usual
from casadi_ik.symbolic.kinematics import motor_scales

WIDE = 1e3
ROWS = ContactRows(usual(3))


@pytest.fixture(scope="module")
def problem(robot):
    """``(q, points, normals, weights) -> linear problem, residuals`` as a Function."""
    q, points = ca.SX.sym("q", 14), ca.SX.sym("points", 3, 3)
    normals, weights = ca.SX.sym("normals", 3, 3), ca.SX.sym("weights", 3, 2)
    p = {"points": points, "normals": normals, "weights": weights}
    linear = linearised(robot.description, ROWS, q, p)
    outputs = [linear.thumb, linear.thumb_error, linear.others, linear.others_error]
    residuals = ca.vertcat(*map(ca.vertcat, *contact_errors(robot.description, ROWS, q, p)))
    return ca.Function("problem", [q, points, normals, weights], [*outputs, residuals])


@pytest.fixture(scope="module")
def steps(problem):
    """Both solvers as Functions ``(linear, lower, upper, damping) -> step, held``."""
    shapes = [problem.size_out(i) for i in range(4)] + [(14, 1), (14, 1), (1, 1)]
    symbols = [ca.MX.sym("x", *shape) for shape in shapes]
    return [
        ca.Function("step", symbols, list(solve(Linear(*symbols[:4]), Room(*symbols[4:]))))
        for solve in (freezing, quadratic_program)
    ]


def cases(robot, rng, problem, count):
    """Linear problems near their targets, the hand near its limits."""
    for q in robot.random(rng, count):
        q[7:] = np.where(rng.random(7) < 0.3, robot.lower[7:] + 0.02, q[7:])
        goal = np.clip(q + rng.uniform(-0.2, 0.2, 14), robot.lower, robot.upper)
        points, normals = robot.contacts(goal)
        *linear, _ = problem(q, points, normals, np.ones((3, 2)))
        yield q, [np.array(x) for x in linear]


def test_rows_are_the_slopes_of_the_residuals(robot, problem, rng):
    """Five rows of the thumb and ten of the others against central differences at the target."""
    for q in robot.random(rng, 5):
        points, normals = robot.contacts(q)
        target = (points, normals, np.ones((3, 2)))
        thumb, _, others, _, _ = (np.array(x) for x in problem(q, *target))
        slopes = np.array(
            [
                (np.array(problem(q - 1e-6 * e, *target)[4]) - problem(q + 1e-6 * e, *target)[4])
                / 2e-6
                for e in np.eye(14)
            ]
        )[:, :, 0].T
        # Three rows of position and three of the normal's rotation vector per finger; two rows
        # across the normal hold the same.
        gram = slopes.T @ slopes
        rows = np.vstack([thumb, others])
        np.testing.assert_allclose(rows.T @ rows, gram, rtol=1e-6, atol=1e-5)


def test_free_contacts_have_no_rows(robot, problem, rng):
    points, normals = robot.contacts(robot.random(rng, 1)[0])
    weights = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    thumb, thumb_error, others, others_error, _ = problem(robot.home, points, normals, weights)
    assert not np.array(thumb).any()
    assert not np.array(thumb_error).any()
    assert not np.array(others)[3:5].any()
    assert not np.array(others_error)[3:5].any()
    assert np.array(others)[:3].any()
    assert np.array(others)[5:].any()


def test_unlimited_both_take_the_same_step(robot, problem, steps, rng):
    """The projector's formula is the minimiser under the thumb's equations."""
    far = np.full(14, WIDE)
    for damping in (0.03, 1.0):
        for _, linear in cases(robot, rng, problem, 15):
            (one, held), (other, _) = (f(*linear, -far, far, damping) for f in steps)
            one, other = np.array(one).ravel(), np.array(other).ravel()
            assert not np.array(held).any()
            np.testing.assert_allclose(one, other, atol=1e-5 * max(1.0, np.abs(one).max()))
            thumb, error, rows, rest = linear
            # The thumb gets what its own damped step would give it.
            damped = thumb @ thumb.T + max(THUMB_DAMPING, damping) ** 2 * np.eye(5)
            wanted = thumb @ thumb.T @ np.linalg.solve(damped, error)
            np.testing.assert_allclose(thumb @ one, wanted.ravel(), atol=1e-6)
            # And no motion of the closed chain would serve the others better.
            null = np.linalg.svd(thumb)[2][5:].T
            slope = null.T @ (rows.T @ (rows @ one - rest.ravel()) + damping**2 * one)
            assert np.abs(slope).max() < 1e-4 * np.abs(null.T @ rows.T @ rest).max() + 1e-9


def test_both_keep_to_the_limits(robot, problem, steps, rng):
    """What is fixed stands at its limit, and the thumb keeps its place as far as it can."""
    fixed, agree, total = 0, 0, 0
    for q, linear in cases(robot, rng, problem, 40):
        lower, upper = robot.lower - q, robot.upper - q
        (one, held), (other, _) = (f(*linear, lower, upper, 0.03) for f in steps)
        one, other, held = (np.array(x).ravel() for x in (one, other, held))
        for step in (one, other):
            assert (step >= lower).all()
            assert (step <= upper).all()
        at = held > 0
        np.testing.assert_allclose(
            np.minimum(one - lower, upper - one)[at], 0.0, atol=1e-9, err_msg="held off its limit"
        )
        fixed += at.any()
        agree += np.abs(one - other).max() < 1e-3
        total += 1
    assert fixed > 10
    # Joints once fixed are not let go again, which the program may do: seldom another answer.
    assert agree > 0.7 * total


def test_a_motor_that_cannot_move_is_held(robot, problem, steps, rng):
    q, linear = next(cases(robot, rng, problem, 1))
    lower, upper = robot.lower - q, robot.upper - q
    lower[3] = upper[3] = 0.0
    step, held = steps[0](*linear, lower, upper, 0.03)
    assert float(step[3]) == 0.0
    assert float(held[3]) == 1.0


def test_units_of_sliders(robot, coupled_robot):
    assert np.array_equal(np.array(motor_scales(robot.description)).ravel(), np.ones(14))
    scales = np.array(motor_scales(coupled_robot.description)).ravel()
    screw = coupled_robot.actuators.index("screw_1")
    assert scales[screw] == pytest.approx(0.018)
    assert LENGTH == 0.1
