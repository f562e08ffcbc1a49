"""Where a fingertip can be while joints are within intervals: guaranteed balls, and slopes.

From the middle of the intervals the joints are moved one after the other, the last of the finger
first. A turn by delta about an axis at the distance rho moves a point by 2 rho sin(delta / 2), and
a unit normal at the angle alpha to the axis by 2 sin(alpha) sin(delta / 2); what the joints beyond
have moved before adds to rho and to sin(alpha) at most.

The same numbers bound what the slopes at the middle leave out: the second derivative of a point by
two joints is no longer than its distance from the axis of the joint nearer to the tip.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.robots.description import Finger, RobotDescription
from casadi_ik.symbolic.joint_ranges import Range
from casadi_ik.symbolic.kinematics import Kinematics, forward, number
from casadi_ik.symbolic.smooth import Expr, safe_norm


@dataclass(frozen=True, eq=False)
class ContactRange:
    """All contacts that a finger can make; joints in the order of `Finger.joints`.

    Attributes:
        point: (3, 1) in the middle [m].
        normal: (3, 1) in the middle, unit.
        radius: How far the point can be from there [m].
        chord: How far the normal can be from there, at most 2.
        moves: (3, j) slopes of the point [m per joint unit].
        turns: (3, j) slopes of the normal.
        reaches: (j) each joint's part of the radius [m].
        swings: (j) each joint's part of the chord.
        bend: What the slopes leave out of the point [m].
        curl: What they leave out of the normal.
    """

    point: Expr
    normal: Expr
    radius: Expr
    chord: Expr
    moves: Expr
    turns: Expr
    reaches: list[Expr]
    swings: list[Expr]
    bend: Expr
    curl: Expr


def contact_ranges(
    robot: RobotDescription, ranges: dict[str, Range], in_palm: bool
) -> list[ContactRange]:
    """The contacts of all fingers.

    Args:
        robot: The description.
        ranges: Intervals of the joints of the fingers.
        in_palm: Whether in the palm frame; else in the base frame, with all other joints at zero.
    """
    theta = ca.SX.zeros(len(robot.movable), 1)
    for i, name in enumerate(robot.joint_names):
        if name in ranges:
            theta[i] = ranges[name].middle
    body = forward(robot, theta)
    return [_contact(body, finger, ranges, in_palm) for finger in robot.fingers]


def _contact(
    body: Kinematics, finger: Finger, ranges: dict[str, Range], in_palm: bool
) -> ContactRange:
    kinds = {joint.name: joint for joint in body.robot.movable}
    point, normal = body.contact(finger.name)
    radius, chord, bend, total = ca.SX(0), ca.SX(0), ca.SX(0), ca.SX(0)
    moves, turns, reaches, swings, levers, halves = [], [], [], [], [], []
    for name in reversed(finger.joints):
        axis, half = body.axes[name], ranges[name].half
        if kinds[name].type == "prismatic":
            moves.append(axis)
            turns.append(ca.SX.zeros(3, 1))
            reaches.append(half)
            swings.append(ca.SX(0))
            levers.append(ca.SX(1))
        else:
            moves.append(ca.cross(axis, point - body.links[kinds[name].child].origin))
            turns.append(ca.cross(axis, normal))
            sine = ca.sin(ca.fmin(half, np.pi) / 2)
            levers.append(safe_norm(moves[-1]) + radius)
            reaches.append(2 * sine * levers[-1])
            swings.append(2 * sine * ca.fmin(safe_norm(turns[-1]) + chord, 1.0))
            total += half
        halves.append(half)
        radius += reaches[-1]
        chord += swings[-1]
    for i, (lever, half) in enumerate(zip(levers, halves, strict=True)):
        bend += lever * half * (half / 2 + sum(halves[i + 1 :], ca.SX(0)))
    slopes = ca.horzcat(ca.SX(3, 0), *reversed(moves)), ca.horzcat(ca.SX(3, 0), *reversed(turns))
    if in_palm:
        palm = body.palm
        point, normal = palm.inverse_apply(point), palm.rotation.T @ normal
        slopes = palm.rotation.T @ slopes[0], palm.rotation.T @ slopes[1]
    return ContactRange(
        point=point,
        normal=normal,
        radius=radius,
        chord=ca.fmin(chord, 2.0),
        moves=slopes[0],
        turns=slopes[1],
        reaches=reaches[::-1],
        swings=swings[::-1],
        bend=bend,
        curl=total * total / 2,
    )


def palm_at_zero(robot: RobotDescription) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and origin (3,) [m] of the palm with every joint at zero, base frame."""
    palm = forward(robot, ca.SX.zeros(len(robot.movable), 1)).palm
    return number(palm.rotation).reshape(3, 3), number(palm.origin)
