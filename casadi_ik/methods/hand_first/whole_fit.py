"""Whole-system stage: damped least squares on all motors at once, within their bounds."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.bounded_step import Bounded, clip, damped_step
from casadi_ik.methods.common.contact_fit import Tried
from casadi_ik.methods.common.whole_contacts import whole_jacobian, whole_residual
from casadi_ik.problem.contacts.rows import ContactRows
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.smooth import Expr

PASSES = 2
"""Corrections of the active set in a step."""


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
