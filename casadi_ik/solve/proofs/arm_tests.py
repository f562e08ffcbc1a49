"""Relations between the contacts of a hand and the workspace of the arm.

*Wrist.* The distance of the wrist, located by the contacts, from the shoulder must be one that the
arm can assume.

*Cones.* At a given wrist position the elbow of a seven-joint arm lies on a circle. The limit of
joint 2 leaves an arc of the circle, on which the upper arm is within a cone about axis 1; the limit
of joint 6 leaves another arc, on which the forearm is within a cone about axis 7, which moves with
the palm. No elbow position is on both arcs if the midpoints of the arcs are separated by more than
the sum of their half lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.kinematics.linear_algebra import solve_spd
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.solve.proofs.boxes import BOUND_MARGIN, BoxContact
from casadi_ik.solve.proofs.contact_tests import Inequality
from casadi_ik.solve.proofs.premises import ArmCones, ArmSpan

ANGLE_MARGIN = 1e-7
"""Margin of angles [rad] and cosines of the arm's cones against rounding errors."""


@dataclass(frozen=True, eq=False)
class Ball:
    """Ball in the base frame that contains a point or a unit vector of the palm.

    Attributes:
        centre: (3, 1) centre.
        radius: Radius.
        shares: Contribution of each coordinate of the box to the radius, h of them.
    """

    centre: Expr
    radius: Expr
    shares: list[Expr]


def _combination_coefficients(
    contacts: list[BoxContact], vector: Expr, sum_of_points: int, of_targets: bool
) -> list[tuple[Expr, Expr]]:
    """Return coefficients of points and normals that approximately combine to a vector.

    They have the smallest weighted sum of squares among those whose point coefficients sum to
    `sum_of_points`.

    Args:
        contacts: Contacts of the box.
        vector: (3, 1) vector to represent.
        sum_of_points: 1 for a point, 0 for a direction.
        of_targets: True to combine the targets (base frame), False to combine the contacts of the
            hand (palm frame).
    """
    sources = [
        (c.target_point, c.target_normal) if of_targets else (c.point, c.normal) for c in contacts
    ]
    point_weights = [contact.has_point / contact.radius**2 for contact in contacts]
    total = sum(point_weights, ca.SX(1e-300))
    point_shares = [w / total for w in point_weights]
    mean = sum(
        (w * point for w, (point, _) in zip(point_shares, sources, strict=True)), ca.SX(3, 1)
    )
    columns, weights = [], []
    for w, contact, (point, direction) in zip(point_weights, contacts, sources, strict=True):
        columns += [point - mean, direction]
        weights += [w, contact.has_normal / contact.chord**2]
    A, W = ca.horzcat(*columns), ca.diag(ca.vertcat(*weights))
    normal = A @ W @ A.T
    scale = normal[0, 0] + normal[1, 1] + normal[2, 2]
    normal += 1e-9 * (scale + 1e-300) * ca.DM.eye(3)
    coefficients = W @ A.T @ solve_spd(ca.densify(normal), vector - sum_of_points * mean)
    # The mean distributes the missing sum over all contacts.
    missing = sum_of_points - sum((coefficients[2 * i] for i in range(len(contacts))), ca.SX(0))
    return [
        (coefficients[2 * i] + w * missing, coefficients[2 * i + 1])
        for i, w in enumerate(point_shares)
    ]


def palm_ball(contacts: list[BoxContact], vector: Expr, sum_of_points: int) -> Ball:
    """Return the ball that contains a point or a unit vector of the palm.

    With contacts x, normals n and any coefficients a, b a point of the palm equals
    sum(a x) + sum(b n) + unexplained. The same combination of the targets deviates by at most
    sum(|a| radius) + sum(|b| chord) + |unexplained|, or by the bound from the slopes if that is
    smaller.

    Args:
        contacts: Contacts of the box.
        vector: (3, 1) point or unit vector, palm frame.
        sum_of_points: 1 for a point, 0 for a unit vector.
    """
    centre, unexplained = ca.SX(3, 1), vector
    slopes, radius, slope_radius = ca.SX(3, contacts[0].point_slopes.shape[1]), ca.SX(0), ca.SX(0)
    pairs = zip(
        _combination_coefficients(contacts, vector, sum_of_points, of_targets=False),
        contacts,
        strict=True,
    )
    for (p, n), contact in pairs:
        centre += p * contact.target_point + n * contact.target_normal
        unexplained -= p * contact.point + n * contact.normal
        slopes += p * contact.point_slopes + n * contact.normal_slopes
        radius += ca.fabs(p) * contact.radius + ca.fabs(n) * contact.chord
        slope_radius += ca.fabs(p) * contact.point_remainder + ca.fabs(n) * contact.normal_remainder
    # A common motion of the contacts is a motion of the palm relative to them.
    shares = _list_of_column_norms(slopes)
    slope_radius += sum(shares, ca.SX(0))
    return Ball(
        centre, safe_norm(unexplained) + BOUND_MARGIN + ca.fmin(radius, slope_radius), shares
    )


@dataclass(frozen=True, eq=False)
class PointInPalm:
    """Position in the palm frame of a point of the base, as a combination of the targets.

    In the palm frame the wrist is constant and the direction of every slope is known.

    Attributes:
        centre: (3, 1) position at the centre of the box [m], palm frame.
        slopes: (3, h) derivatives by the scaled coordinates u [m].
        remainder: Largest deviation beyond that of the slopes [m].
    """

    centre: Expr
    slopes: Expr
    remainder: Expr

    @classmethod
    def from_point(cls, contacts: list[BoxContact], point: Expr) -> PointInPalm:
        """Return the position of a point (3, 1) given in the base frame."""
        centre, unexplained = ca.SX(3, 1), point
        slopes, remainder = ca.SX(3, contacts[0].point_slopes.shape[1]), ca.SX(BOUND_MARGIN)
        for (p, n), contact in zip(
            _combination_coefficients(contacts, point, 1, of_targets=True), contacts, strict=True
        ):
            centre += p * contact.point + n * contact.normal
            unexplained -= p * contact.target_point + n * contact.target_normal
            slopes += p * contact.point_slopes + n * contact.normal_slopes
            remainder += (
                ca.fabs(p) * contact.point_remainder + ca.fabs(n) * contact.normal_remainder
            )
        return cls(centre, slopes, remainder + safe_norm(unexplained))

    def distances(self, p_palm: Expr) -> tuple[Expr, Expr, Expr]:
        """Return the smallest and largest distance from a point (3, 1) of the palm [m].

        Returns:
            Smallest distance, largest distance, and the contribution of each coordinate to their
            difference (1, h).
        """
        offset = self.centre - p_palm
        length = safe_norm(offset)
        direction = offset / length
        parallel = direction.T @ self.slopes
        perpendicular = self.slopes - direction @ parallel
        shares = ca.fabs(parallel)
        parallel_motion, perpendicular_motion = (
            ca.sum2(shares),
            sum(_list_of_column_norms(perpendicular), ca.SX(0)),
        )
        largest = (
            ca.sqrt((length + parallel_motion) ** 2 + perpendicular_motion**2) + self.remainder
        )
        return length - parallel_motion - self.remainder, largest, shares


def _list_of_column_norms(matrix: Expr) -> list[Expr]:
    """Return the norms of columns as a list."""
    return [safe_norm(matrix[:, k]) for k in range(matrix.shape[1])]


def wrist_excess(
    contacts: list[BoxContact], arm: ArmSpan, span: Expr, ball: Ball
) -> tuple[list[Expr], list[Inequality]]:
    """Return tests that are > 0 if the arm cannot reach the wrist, and the deciding inequalities.

    Args:
        contacts: Contacts of the box.
        arm: Shoulder and wrist of the arm.
        span: Smallest and largest distance of the wrist from the shoulder [m].
        ball: Ball that contains the wrist, see `palm_ball`.
    """
    shoulder, nearest, farthest = ca.SX(ca.DM(arm.shoulder)), span[0], span[1]
    point, tests = ca.SX(ca.DM(arm.wrist)), []
    for contact in contacts:
        distance = safe_norm(contact.target_point - shoulder)
        palm_distance = safe_norm(point - contact.point)
        tests.append(contact.has_point * (distance - palm_distance - contact.radius - farthest))
        tests.append(contact.has_point * (palm_distance - contact.radius - distance - farthest))
        tests.append(contact.has_point * (nearest - distance - palm_distance - contact.radius))
    shoulder_in_palm = PointInPalm.from_point(contacts, shoulder)
    smallest, largest, shares = shoulder_in_palm.distances(point)
    distance = safe_norm(shoulder_in_palm.centre - point)
    tests += [smallest - farthest, nearest - largest]
    rows = [
        Inequality(
            _distance_outside(distance, span),
            ca.fmax(distance - smallest, largest - distance),
            ca.horzsplit(shares),
        )
    ]
    # The shoulder is far from the contacts, so that its position in the palm frame is less certain
    # than that of the wrist in the base frame.
    distance = safe_norm(ball.centre - shoulder)
    tests += [distance - ball.radius - farthest, nearest - distance - ball.radius]
    return tests, [*rows, Inequality(_distance_outside(distance, span), ball.radius, ball.shares)]


def _distance_outside(distance: Expr, span: Expr) -> Expr:
    """Return the distance of a value from an interval; 0 within it."""
    return ca.fmax(ca.fmax(distance - span[1], span[0] - distance), 0.0)


def cone_excess(arm: ArmCones, wrist: Ball, last: Ball, span: Expr, cosines: Expr) -> Expr:
    """Return a value > 0 if no elbow position is within both cones.

    Args:
        arm: Cones of the arm.
        wrist: Ball that contains the wrist, base frame.
        last: Ball that contains axis 7, base frame.
        span: Smallest and largest distance of the wrist from the shoulder [m].
        cosines: (2, 1) cosines of the half angles of the cones.
    """
    a, b = arm.lengths
    shoulder_to_wrist, wrist_margin = (
        wrist.centre - ca.DM(arm.shoulder),
        wrist.radius + ANGLE_MARGIN,
    )
    length = safe_norm(shoulder_to_wrist)
    is_bounded = ca.logic_and(wrist_margin < length, span[1] > 0)
    direction = shoulder_to_wrist / length
    tilt = ca.asin(ca.fmin(wrist_margin / length, 1.0))
    nearest = ca.fmax(ca.fmax(length - wrist_margin, span[0]), 1e-9)
    farthest = ca.fmax(ca.fmin(length + wrist_margin, span[1]), nearest)
    # Angles between the line and the elbow circle, at the shoulder and at the wrist.
    upper_angle, upper_margin = _triangle_angle(a, b, nearest, farthest)
    forearm_angle, forearm_margin = _triangle_angle(b, a, nearest, farthest)
    first, axis = ca.SX(ca.DM(arm.first)), last.centre
    margin = tilt + ANGLE_MARGIN
    upper_arc = _feasible_arc(direction, first, upper_angle, cosines[0] - margin - upper_margin)
    # From the wrist the line points the opposite way, so that the sign of the angle changes.
    forearm_arc = _feasible_arc(
        direction, axis, -forearm_angle, cosines[1] - margin - forearm_margin - last.radius
    )
    cross = ca.cross(upper_arc[0], forearm_arc[0])
    arc_angle = ca.atan2(ca.dot(cross, direction), ca.dot(upper_arc[0], forearm_arc[0]))
    arc_gap = ca.fabs(arc_angle) - upper_arc[1] - forearm_arc[1] - ANGLE_MARGIN
    excess = ca.fmax(ca.fmax(upper_arc[2], forearm_arc[2]), arc_gap)
    return ca.if_else(is_bounded, excess, -1.0)


def _triangle_angle(a: float, b: float, nearest: Expr, farthest: Expr) -> tuple[Expr, Expr]:
    """Return the angle between side a and a side c of a triangle with the sides a, b, c.

    Args:
        a: Length of the adjacent side [m].
        b: Length of the opposite side [m].
        nearest: Lower bound of c [m].
        farthest: Upper bound of c [m].

    Returns:
        Midpoint and half width of the interval of the angle [rad].
    """

    def cosine(side: Expr) -> Expr:
        return ca.fmax(ca.fmin((side * side + a * a - b * b) / (2 * a * side), 1.0), -1.0)

    cosines = cosine(nearest), cosine(farthest)
    smallest, largest = ca.fmin(*cosines), ca.fmax(*cosines)
    if a > b:
        # The cosine has a minimum where sides b and c are perpendicular.
        tangent_length = float(np.sqrt(a * a - b * b))
        contains_tangent = ca.logic_and(nearest < tangent_length, farthest > tangent_length)
        smallest = ca.if_else(
            contains_tangent, ca.fmin(smallest, cosine(ca.SX(tangent_length))), smallest
        )
    low, high = ca.acos(largest), ca.acos(smallest)
    return (low + high) / 2, (high - low) / 2 + ANGLE_MARGIN


def _feasible_arc(line: Expr, axis: Expr, opening: Expr, cosine: Expr) -> tuple[Expr, Expr, Expr]:
    """Return the arc of a cone about `line` on which a direction is close enough to an axis.

    Args:
        line: (3, 1) unit axis of the cone that the direction lies on.
        axis: (3, 1) axis to which the direction must be close.
        opening: Angle between the direction and `line` [rad].
        cosine: Smallest admissible dot product of the direction and `axis`.

    Returns:
        Midpoint of the arc as a vector perpendicular to the line (3, 1), half of its length [rad],
        and a test that is > 0 if the arc is empty.
    """
    parallel = ca.dot(axis, line)
    perpendicular = axis - parallel * line
    size = ca.fabs(ca.sin(opening)) * safe_norm(perpendicular)
    required = cosine - ca.cos(opening) * parallel
    half_arc = ca.acos(ca.fmax(ca.fmin(required / ca.fmax(size, 1e-6), 1.0), -1.0))
    middle = ca.if_else(opening < 0, -perpendicular, perpendicular)
    return middle, ca.if_else(size < 1e-6, np.pi, half_arc), required - size
