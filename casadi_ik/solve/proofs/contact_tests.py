"""Relations that the contacts of a hand must satisfy: among themselves, and with the arm.

*Pairs.* A palm motion preserves distance, angle, heights and handedness of two contacts. Each of
these invariants is an inequality ``|value| <= width``: the value is the invariant of the target
minus that at the centre of the box, and the width covers the tolerances and the variation within
the box. The width is the smaller of two bounds: one from the balls of the contacts, one from the
slopes of the invariant itself, which ignores motion that does not change it. The second bound adds
the products of two variations, `point_remainder` and `normal_remainder` of the contacts. With
target unit vectors a, b and a = (n + T u) + r in the palm frame, |r| <= normal_remainder, products
are split such that one factor is a target vector, whose length is known.

*Rigid fit.* The largest trace tr(R S) over all rotations R is the largest eigenvalue of Horn's
symmetric 4 x 4 matrix (Horn 1987). Newton's method on its characteristic polynomial converges to
it from above (Theobald 2005), so that every iterate is an upper bound.

*Wrist.* The distance of the wrist, located by the contacts, from the shoulder must be one that the
arm can assume.

*Cones.* At a given wrist position the elbow of a seven-joint arm lies on a circle. The limit of
joint 2 leaves an arc of the circle, on which the upper arm is within a cone about axis 1; the limit
of joint 6 leaves another arc, on which the forearm is within a cone about axis 7, which moves with
the palm. No elbow position is on both arcs if the midpoints of the arcs are separated by more than
the sum of their half lengths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.kinematics.linear_algebra import solve_spd
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.solve.proofs.boxes import BOUND_MARGIN, BoxContact
from casadi_ik.solve.proofs.premises import ArmCones, ArmSpan


@dataclass(frozen=True, eq=False)
class Inequality:
    """A necessary condition ``|value| <= width`` of a box.

    Attributes:
        value: Deviation of an invariant at the centre of the box from that of the target.
        width: Largest admissible deviation within the box and the tolerances.
        shares: Contribution of each coordinate to the width, h of them.
    """

    value: Expr
    width: Expr
    shares: list[Expr]


def pair_rows(a: BoxContact, b: BoxContact) -> Iterator[Inequality]:
    """Yield the inequalities of two contacts; zero where a point or normal is unconstrained."""
    target_line, line = b.target_point - a.target_point, b.point - a.point
    target_distance, distance, radii = safe_norm(target_line), safe_norm(line), a.radius + b.radius
    has_points, point_remainders = a.has_point * b.has_point, a.point_remainder + b.point_remainder
    line_slopes = b.point_slopes - a.point_slopes
    point_shares = [
        share_a + share_b for share_a, share_b in zip(a.radius_shares, b.radius_shares, strict=True)
    ]
    normal_shares = [
        share_a + share_b for share_a, share_b in zip(a.chord_shares, b.chord_shares, strict=True)
    ]
    line_slope_lengths, normal_slopes_a, normal_slopes_b = (
        _column_norms(slopes) for slopes in (line_slopes, a.normal_slopes, b.normal_slopes)
    )
    direction = line / distance
    parallel = ca.fabs(direction.T @ line_slopes)
    perpendicular = _column_norms(line_slopes - direction @ (direction.T @ line_slopes))
    growth = ca.sqrt((distance + ca.sum2(parallel)) ** 2 + ca.sum2(perpendicular) ** 2) - distance
    yield Inequality(
        has_points * (target_distance - distance),
        ca.fmin(radii, growth + point_remainders),
        point_shares,
    )
    has_normals = has_points * a.has_normal * b.has_normal
    cosine = ca.dot(a.target_normal, b.target_normal) - ca.dot(a.normal, b.normal)
    slope_bound = _sum_of_magnitudes(b.normal.T @ a.normal_slopes + a.normal.T @ b.normal_slopes)
    slope_bound += (
        ca.sum2(normal_slopes_a) * ca.sum2(normal_slopes_b)
        + a.normal_remainder
        + b.normal_remainder
        + a.normal_remainder * b.normal_remainder
    )
    yield Inequality(has_normals * cosine, ca.fmin(a.chord + b.chord, slope_bound), normal_shares)
    for contact, normal_slope_lengths in ((a, normal_slopes_a), (b, normal_slopes_b)):
        height = ca.dot(contact.target_normal, target_line) - ca.dot(contact.normal, line)
        shares = [
            m + t * target_distance for m, t in zip(point_shares, contact.chord_shares, strict=True)
        ]
        slope_bound = _sum_of_magnitudes(
            line.T @ contact.normal_slopes + contact.normal.T @ line_slopes
        )
        slope_bound += (
            ca.sum2(normal_slope_lengths) * ca.sum2(line_slope_lengths)
            + contact.normal_remainder * target_distance
            + (1 + contact.normal_remainder) * point_remainders
        )
        yield Inequality(
            has_points * contact.has_normal * height,
            ca.fmin(radii + contact.chord * target_distance, slope_bound),
            shares,
        )
    normal_of_normals, target_normal_of_normals = (
        ca.cross(a.normal, b.normal),
        ca.cross(a.target_normal, b.target_normal),
    )
    yield Inequality(
        has_normals
        * (ca.dot(target_normal_of_normals, target_line) - ca.dot(normal_of_normals, line)),
        radii + (a.chord + b.chord) * target_distance,
        [m + t * target_distance for m, t in zip(point_shares, normal_shares, strict=True)],
    )


def _column_norms(slopes: Expr) -> Expr:
    """Return the norms of columns, (1, h)."""
    return ca.horzcat(*(safe_norm(slopes[:, k]) for k in range(slopes.shape[1])))


def _sum_of_magnitudes(slopes: Expr) -> Expr:
    """Return the largest change within the box of a value with slopes (1, h)."""
    return ca.sum2(ca.fabs(slopes))


def pair_angles(a: BoxContact, b: BoxContact) -> Iterator[Expr]:
    """Yield tests of angles: between the normals, and of each normal with the line of points.

    A test > 0 refutes the box. Angles are sharper than cosines near 0 and pi, for example for
    opposed normals.
    """
    target_line, line = b.target_point - a.target_point, b.point - a.point
    target_distance, distance, radii = safe_norm(target_line), safe_norm(line), a.radius + b.radius
    has_points, longer_distance = a.has_point * b.has_point, ca.fmax(target_distance, distance)
    cosines = ca.dot(a.target_normal, b.target_normal), ca.dot(a.normal, b.normal)
    rotations = _cos_sin_of_chord(a.chord), _cos_sin_of_chord(b.chord)
    yield has_points * a.has_normal * b.has_normal * _angle_excess(cosines, rotations)
    # The line between the points rotates by at most asin(radii / longer distance).
    sine = ca.fmin(radii / longer_distance, 1.0)
    tilt = ca.sqrt(1 - sine * sine), sine
    for contact, rotation in zip((a, b), rotations, strict=True):
        cosines = (
            ca.dot(contact.target_normal, target_line) / target_distance,
            ca.dot(contact.normal, line) / distance,
        )
        test = ca.if_else(radii < longer_distance, _angle_excess(cosines, (rotation, tilt)), -1.0)
        yield has_points * contact.has_normal * test


def _cos_sin_of_chord(chord: Expr) -> tuple[Expr, Expr]:
    """Return cosine and sine of the angle that a chord subtends, at most pi."""
    half_chord = ca.fmin(chord, 2.0) / 2
    return 1 - 2 * half_chord * half_chord, 2 * half_chord * ca.sqrt(
        ca.fmax(1 - half_chord * half_chord, 0.0)
    )


def _angle_excess(
    cosines: tuple[Expr, Expr], widths: tuple[tuple[Expr, Expr], tuple[Expr, Expr]]
) -> Expr:
    """Return a value > 0 if two angles differ by more than the sum of two others.

    Args:
        cosines: Cosines of the two angles.
        widths: Cosine and sine of the angles whose sum is the largest admissible difference; a sum
            of pi or more admits every difference.
    """
    rounding = 1e-8  # exceeds the cancellation error of a sine computed from a cosine near 1
    cosine_a, cosine_b = cosines
    sines = [ca.sqrt(ca.fmax(1 - c * c, 0.0)) for c in cosines]
    (cos_a, sin_a), (cos_b, sin_b) = widths
    cosine_of_sum = cos_a * cos_b - sin_a * sin_b
    excess = cosine_of_sum - rounding - (cosine_a * cosine_b + sines[0] * sines[1])
    # Both angles are at most pi: their sum is below pi exactly where cos a > -cos b.
    return ca.if_else(cos_a + cos_b > rounding, excess, -1.0)


def largest_trace(S: Expr, bound: Expr, steps: int = 7) -> Expr:
    """Return an upper bound of tr(R S) over all rotations R, (1, 1).

    Args:
        S: (3, 3) sum of weight x_source x_target'.
        bound: A coarser upper bound, > 0; the rounding error of the result is relative to it.
        steps: Number of Newton steps.
    """
    s = S / bound
    xx, xy, xz = s[0, 0], s[0, 1], s[0, 2]
    yx, yy, yz = s[1, 0], s[1, 1], s[1, 2]
    zx, zy, zz = s[2, 0], s[2, 1], s[2, 2]
    K = ca.vertcat(
        ca.horzcat(xx + yy + zz, yz - zy, zx - xz, xy - yx),
        ca.horzcat(yz - zy, xx - yy - zz, xy + yx, zx + xz),
        ca.horzcat(zx - xz, xy + yx, yy - xx - zz, yz + zy),
        ca.horzcat(xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    # x^4 + c2 x^2 + c1 x + c0; the trace of K is zero.
    c2, c1, c0 = -2 * ca.sumsqr(s), -8 * ca.det(s), ca.det(K)
    x = ca.SX(1)
    for _ in range(steps):
        value = ((x * x + c2) * x + c1) * x + c0
        slope = (4 * x * x + 2 * c2) * x + c1
        # A step whose numerator is rounding noise must not pass the root.
        is_above_root = ca.logic_and(value > 1e-13, slope > 0)
        x = x - ca.if_else(is_above_root, value / ca.fmax(slope, 1e-300), 0.0)
    return x * bound


def rigid_excess(contacts: list[BoxContact]) -> Expr:
    """Return a value > 0 if no palm motion brings all contacts within their balls and chords.

    The test compares the residual of the best weighted rigid fit with the largest sum of weighted
    squares that the balls and chords allow.
    """
    point_weights = [contact.has_point / contact.radius**2 for contact in contacts]
    normal_weights = [contact.has_normal / contact.chord**2 for contact in contacts]
    total = sum(point_weights, ca.SX(1e-300))
    target_mean = (
        sum((w * c.target_point for w, c in zip(point_weights, contacts, strict=True)), ca.SX(3, 1))
        / total
    )
    mean = (
        sum((w * c.point for w, c in zip(point_weights, contacts, strict=True)), ca.SX(3, 1))
        / total
    )
    S, size, allowed = ca.SX(3, 3), ca.SX(1e-300), ca.SX(0)
    for w, v, contact in zip(point_weights, normal_weights, contacts, strict=True):
        x, y = contact.point - mean, contact.target_point - target_mean
        S += w * (x @ y.T) + v * (contact.normal @ contact.target_normal.T)
        size += w * (ca.sumsqr(x) + ca.sumsqr(y)) + 2 * v
        allowed += contact.has_point + contact.has_normal
    smallest_residual = size - 2 * largest_trace(S, size / 2)
    # 3e-8: relative accuracy of a double root in double precision.
    return (smallest_residual - 3e-8 * size) / ca.fmax(allowed, 1.0) - 1


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
