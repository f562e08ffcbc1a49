"""Relations between the contacts of a hand that no palm motion changes.

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
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca

from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.solve.proofs.boxes import BoxContact


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
