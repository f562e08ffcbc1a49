"""Whether the limits of shoulder and wrist leave an arm any way to hold the palm: a bound.

For a place of the wrist the elbow can be anywhere on a circle. The limit of joint 2 leaves an arc
of it, in which the upper arm is within a cone about axis 1; the limit of joint 6 another, in which
the forearm is within a cone about axis 7, which goes with the palm. No elbow is in both if the
middles of the arcs are further apart than half their lengths.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.problem.arm_cones import ArmCones
from casadi_ik.solving.diagnosis.wrist_bound import Ball
from casadi_ik.symbolic.smooth import Expr, safe_norm

ROUNDING = 1e-7
"""What angles and cosines are let off by."""

FLAT = 1e-6
"""Where the elbow's circle changes a cosine by less than this nothing is said of the arc."""


def cone_excess(arm: ArmCones, wrist: Ball, last: Ball, span: Expr, cosines: Expr) -> Expr:
    """> 0 if no elbow is within both cones.

    Args:
        arm: The cones.
        wrist: Ball that holds the wrist, base frame.
        last: Ball that holds axis 7.
        span: Smallest and largest distance of the wrist from the shoulder [m].
        cosines: (2, 1) of the half angles.
    """
    a, b = arm.lengths
    reach, loose = wrist.centre - ca.DM(arm.shoulder), wrist.radius + ROUNDING
    length = safe_norm(reach)
    known = ca.logic_and(loose < length, span[1] > 0)
    line = reach / length
    tilt = ca.asin(ca.fmin(loose / length, 1.0))
    near = ca.fmax(ca.fmax(length - loose, span[0]), 1e-9)
    far = ca.fmax(ca.fmin(length + loose, span[1]), near)
    # The elbow's circle, seen from the shoulder and from the wrist: its angles to the line.
    upper, upper_give = _opening(a, b, near, far)
    fore, fore_give = _opening(b, a, near, far)
    first, axis = ca.SX(ca.DM(arm.first)), last.centre
    slack = tilt + ROUNDING
    one = _arc(line, first, upper, cosines[0] - slack - upper_give)
    # Seen from the wrist the circle is on the other side of the line.
    other = _arc(line, axis, -fore, cosines[1] - slack - fore_give - last.radius)
    cross = ca.cross(one[0], other[0])
    between = ca.atan2(ca.dot(cross, line), ca.dot(one[0], other[0]))
    apart = ca.fabs(between) - one[1] - other[1] - ROUNDING
    excess = ca.fmax(ca.fmax(one[2], other[2]), apart)
    return ca.if_else(known, excess, -1.0)


def _opening(a: float, b: float, near: Expr, far: Expr) -> tuple[Expr, Expr]:
    """Angle at the end of side a of a triangle with the sides a, b and one in [near, far].

    Its middle, and how much less or more it can be.
    """

    def cosine(side: Expr) -> Expr:
        return ca.fmax(ca.fmin((side * side + a * a - b * b) / (2 * a * side), 1.0), -1.0)

    ends = cosine(near), cosine(far)
    least, most = ca.fmin(*ends), ca.fmax(*ends)
    if a > b:
        # In between, where the angle at the end of b is a right one.
        turn = float(np.sqrt(a * a - b * b))
        inside = ca.logic_and(near < turn, far > turn)
        least = ca.if_else(inside, ca.fmin(least, cosine(ca.SX(turn))), least)
    low, high = ca.acos(most), ca.acos(least)
    return (low + high) / 2, (high - low) / 2 + ROUNDING


def _arc(line: Expr, axis: Expr, opening: Expr, cosine: Expr) -> tuple[Expr, Expr, Expr]:
    """Where on the circle a direction at an angle to the line has at least a cosine to an axis.

    Returns:
        The middle of the arc (3, 1) as a vector across the line, half its length [rad], and a test
        that is > 0 if there is no such arc.
    """
    along = ca.dot(axis, line)
    across = axis - along * line
    size = ca.fabs(ca.sin(opening)) * safe_norm(across)
    least = cosine - ca.cos(opening) * along
    half = ca.acos(ca.fmax(ca.fmin(least / ca.fmax(size, FLAT), 1.0), -1.0))
    middle = ca.if_else(opening < 0, -across, across)
    return middle, ca.if_else(size < FLAT, np.pi, half), least - size
