"""Whole-system stage: damped least squares on all motors at once, within their bounds."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.bounded_step import Bounded, clip, damped_step
from casadi_ik.methods.common.contact_fit import Tried
from casadi_ik.problem.contacts.rows import ContactRows, resting, tip_rates, tip_vectors
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.smooth import Expr

PASSES = 2
"""Corrections of the active set in a step."""


def whole_residual(robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]) -> Expr:
    """Residual of `ContactRows` at q, base frame."""
    kinematics = actuated(robot, q).kinematics
    tips = [tip_vectors(kinematics, name) for name in robot.finger_names]
    return rows.residual(tips, rows.goals(p), p["weights"])


def whole_jacobian(robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]) -> Expr:
    """Its Jacobian (size, n)."""
    body = actuated(robot, q)
    n, goals = len(robot.actuators), rows.goals(p)
    tips = [tip_vectors(body.kinematics, name) for name in robot.finger_names]
    rates = [
        {key: ca.sparsify(rate) for key, rate in tip_rates(body, name, range(n)).items()}
        for name in robot.finger_names
    ]
    return rows.jacobian(tips, rates, goals, resting(goals, n), p["weights"])


def whole_step(
    robot: RobotDescription, rows: ContactRows, q: Expr, damping: Expr, p: dict[str, Expr]
) -> Tried:
    """One damped step from q (n, 1)."""
    bounds = Bounded(q, p["lower"], p["upper"], first=0)
    residual = whole_residual(robot, rows, q, p)
    damped = damped_step(whole_jacobian(robot, rows, q, p), residual, damping, bounds, PASSES)
    reached = clip(q + damped.step, bounds)
    there = whole_residual(robot, rows, reached, p)
    return Tried(reached, residual, there, damped.promised, ca.mmax(ca.fabs(reached - q)))
