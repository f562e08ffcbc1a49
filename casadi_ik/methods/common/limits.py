"""Joint limits inside a step: kept or ignored, and what stands at them."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.trace import WORD
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.smooth import Expr


def kept_within(robot: RobotDescription, q: Expr, enforce: Expr) -> Expr:
    """Move q (n, 1) into the limits where `enforce` is 1; leave it as it is where it is 0."""
    lower, upper = ca.DM(robot.lower.tolist()), ca.DM(robot.upper.tolist())
    return ca.if_else(enforce > 0, ca.fmin(ca.fmax(q, lower), upper), q)


def starts_within(robot: RobotDescription, problems: Problems, q0: Array) -> Array:
    """Starts (k, n), moved into the limits where the targets enforce them."""
    return np.clip(q0, robot.lower, robot.upper) if problems.enforce_limits else q0


def limit_mask(robot: RobotDescription, q: Expr) -> Expr:
    """Bit i is set where actuator i stands at or beyond a limit."""
    lower, upper = ca.DM(robot.lower.tolist()), ca.DM(robot.upper.tolist())
    return bits(ca.logic_or(q <= lower, q >= upper))


def bits(flags: Expr) -> Expr:
    """Bit i is set where flag i (n, 1) is; a word (1, 1) for every `WORD` of them."""
    n = flags.numel()
    words = [flags[first : min(first + WORD, n)] for first in range(0, n, WORD)]
    return ca.vertcat(
        *(ca.dot(word, ca.DM([2.0**i for i in range(word.numel())])) for word in words)
    )
