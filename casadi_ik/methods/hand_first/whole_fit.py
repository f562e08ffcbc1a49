"""Whole-system stage: damped least squares on all motors at once, within their bounds."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.bounded_step import Bounded, clip, damped_step
from casadi_ik.methods.common.contact_fit import Tried, weighted_residual
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.so3 import skew

PASSES = 2
"""Corrections of the active set in a step."""


def whole_residual(robot: RobotDescription, q: Expr, p: dict[str, Expr]) -> Expr:
    """Residual (6 f, 1) of all contacts at q, base frame; see `weighted_residual`."""
    kinematics = actuated(robot, q).kinematics
    pairs = [kinematics.contact(name) for name in robot.finger_names]
    return weighted_residual(
        [point - p["points"][i, :].T for i, (point, _) in enumerate(pairs)],
        [normal - p["normals"][i, :].T for i, (_, normal) in enumerate(pairs)],
        p["weights"],
    )


def whole_jacobian(robot: RobotDescription, q: Expr, p: dict[str, Expr]) -> Expr:
    """Its Jacobian (6 f, n)."""
    body = actuated(robot, q)
    every = range(len(robot.actuators))
    positions, normals = [], []
    for name in robot.finger_names:
        linear, angular = body.contact_jacobian(name, every)
        _, normal = body.kinematics.contact(name)
        positions.append(ca.sparsify(linear))
        normals.append(ca.sparsify(-skew(normal) @ angular))
    return weighted_residual(positions, normals, p["weights"])


def whole_step(robot: RobotDescription, q: Expr, damping: Expr, p: dict[str, Expr]) -> Tried:
    """One damped step from q (n, 1)."""
    bounds = Bounded(q, p["lower"], p["upper"], first=0)
    residual = whole_residual(robot, q, p)
    damped = damped_step(whole_jacobian(robot, q, p), residual, damping, bounds, PASSES)
    reached = clip(q + damped.step, bounds)
    there = whole_residual(robot, reached, p)
    return Tried(reached, residual, there, damped.promised, ca.mmax(ca.fabs(reached - q)))
