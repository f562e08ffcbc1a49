"""Newton's steps from the joints of an ideal arm to those of the real one beside it."""

from __future__ import annotations

import math

import casadi as ca

from casadi_ik.methods.common.contact_fit import DAMPING_FLOOR, EXACT
from casadi_ik.methods.common.numeric_arm import pose_step
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_arms.held import HeldArm
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.srs_arm import SrsArm
from casadi_ik.symbolic.subexpressions import shared

RIGHT = 1e-12
"""What is left [m and rad] when an arm is right to rounding."""


def is_searched_later(arm: ArmForm | HeldArm) -> bool:
    """Whether rounds after the first search for the arm.

    So do those of every arm that its form is a little off from: near a singularity Newton's steps
    lead from the ideal arm nowhere near.
    """
    if isinstance(arm, SrsArm):
        return False
    return isinstance(arm, HeldArm) or not arm.exact


def steps(off: float) -> int:
    """Newton's steps for an arm that is off by so much [m and rad]: each of them squares it.

    One that is off by a millimetre is right to a micrometre after one, to rounding after two; one
    that is off by a centimetre needs three.
    """
    squarings = math.log2(math.log(RIGHT) / math.log(max(off, RIGHT)))
    return max(1, math.ceil(squarings))


def brought_to(
    robot: RobotDescription, arm: Expr, palm: Pose, lower: Expr, upper: Expr, off: float
) -> tuple[Expr, Expr]:
    """The arm, within its bounds, that brings the palm to a pose.

    Args:
        robot: The description.
        arm: (a, 1) of the ideal arm [rad].
        palm: Palm pose, base frame.
        lower: (n, 1) bounds of all motors.
        upper: (n, 1).
        off: How far the ideal arm is from the real one [m and rad].

    Returns:
        The arm (a, 1), and whether it does.
    """
    columns, n = list(robot.arm_actuators), len(robot.actuators)
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    start = ca.SX.sym("arm", len(columns))
    p = {"lower": ca.SX.sym("lower", n), "upper": ca.SX.sym("upper", n)}
    inside = ca.fmin(ca.fmax(start, p["lower"][columns]), p["upper"][columns])
    tried = pose_step(robot, inside, Pose(rotation, origin), ca.SX(DAMPING_FLOOR), p)
    before, there = ca.sumsqr(tried.before), ca.sumsqr(tried.there)
    keep = there < before
    reached = ca.if_else(keep, tried.reached, inside)
    hits = ca.fmin(before, there) < EXACT * EXACT
    inputs = [start, rotation, origin, p["lower"], p["upper"]]
    step = ca.Function("newton_step", inputs, shared(reached, hits))
    found: Expr = ca.MX(0)
    for _ in range(steps(off)):
        arm, found = step(arm, palm.rotation, palm.origin, lower, upper)
    return arm, found
