"""The contacts as a function of all motors at once: residual, Jacobian, and their balance."""

from __future__ import annotations

import casadi as ca

from casadi_ik.methods.common.balance import Balanced, balance_step
from casadi_ik.methods.common.bounded_step import Bounded
from casadi_ik.problem.contacts.rows import ContactRows, resting, tip_rates, tip_vectors
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.smooth import Expr


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


def whole_balance(
    robot: RobotDescription, rows: ContactRows, s: dict[str, Expr], p: dict[str, Expr]
) -> Balanced:
    """One step of `balance_step` for all motors from q of the state, within their bounds."""
    return balance_step(
        lambda q: whole_residual(robot, rows, q, p),
        whole_jacobian(robot, rows, s["q"], p),
        Bounded(s["q"], p["lower"], p["upper"], first=0),
        rows,
        s,
        p,
    )
