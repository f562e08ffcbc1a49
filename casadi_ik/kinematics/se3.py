"""Rotations, rigid transforms and directions: exponentials, logarithms, errors, best fits.

A rotation matrix R (3, 3) maps coordinates in the rotated frame to the outer frame. Quaternions
are (4, 1), scalar first (w, x, y, z). A transform (R, p (3, 1) [m]) maps the coordinates of a
point in the moved frame to the outer frame: x -> R x + p. A twist is (6, 1), **[v; w]**: linear
part first, angular part second (pinocchio's order). Angles are in rad.

All functions accept SX, MX and DM and return dense results; values and first derivatives are
finite at zero rotation, and values are also finite at a half turn (where the logarithm jumps).
Contact normals are unit vectors with two special cases: equal vectors, whose error is zero, and
opposite vectors, whose error is a half turn about an arbitrary axis. All results are finite in both
cases. For opposite vectors a perpendicular axis is chosen, so that solvers leave the saddle point.
"""

from __future__ import annotations

from functools import cache
from typing import TypeAlias

import casadi as ca
import numpy as np

from casadi_ik.kinematics.smooth import Expr, call_function, even_function, safe_norm, safe_sqrt

TINY_SQUARED = 1e-8
"""Bound below which two Taylor terms are exact; above, closed forms do not lose digits."""

HALF_SINC = (1.0, -1 / 24)
HALF_COSINE = (1.0, -1 / 8)
ARC_OVER_SINE = (2.0, 1 / 3)


def skew(w: Expr) -> Expr:
    """Return the matrix [w] (3, 3) with [w] x = w cross x, for w (3, 1)."""
    return ca.densify(ca.skew(w))


def exp_so3(w: Expr) -> Expr:
    """Return the rotation matrix (3, 3) of the rotation vector w (3, 1) [rad]."""
    return quaternion_to_matrix(quaternion_exp(w))


def log_so3(R: Expr) -> Expr:
    """Return the rotation vector w (3, 1) [rad] of R (3, 3), with |w| <= pi.

    It is computed from the quaternion, which is accurate to rounding near 0 and near pi. At exactly
    pi the sign of w is arbitrary.
    """
    return quaternion_log(quaternion_from_matrix(R))


def quaternion_exp(w: Expr) -> Expr:
    """Return the unit quaternion (4, 1) of the rotation vector w (3, 1) [rad]."""
    s = ca.dot(w, w)
    cosine = even_function(s, lambda x: ca.cos(0.5 * ca.sqrt(x)), HALF_COSINE, TINY_SQUARED)
    return ca.vertcat(cosine, (0.5 * half_sinc(s)) * w)


def half_sinc(s: Expr) -> Expr:
    """Return sin(theta/2) / (theta/2) as a function of s = theta^2 [rad^2]."""
    return even_function(
        s, lambda x: ca.sin(0.5 * ca.sqrt(x)) / (0.5 * ca.sqrt(x)), HALF_SINC, TINY_SQUARED
    )


def quaternion_log(q: Expr) -> Expr:
    """Return the rotation vector (3, 1) [rad], |w| <= pi, of a unit quaternion q of either sign."""
    sign = ca.if_else(q[0] < 0, -1.0, 1.0)
    return (sign * angle_over_half_sine(sign * q[0], ca.dot(q[1:], q[1:]))) * q[1:]


def angle_over_half_sine(cosine: Expr, s: Expr) -> Expr:
    """Return ratio theta / sin(theta/2), 2 at 0, of cos(theta/2) >= 0 and s = sin(theta/2)^2."""
    return even_function(
        s, lambda x: 2 * ca.atan2(ca.sqrt(x), cosine) / ca.sqrt(x), ARC_OVER_SINE, TINY_SQUARED
    )


def quaternion_from_matrix(R: Expr) -> Expr:
    """Return the unit quaternion (4, 1) of R (3, 3); its sign is not fixed.

    It is the row of 4 q q' (linear in R) with the largest diagonal entry, so that no divisor is
    small (Shepperd 1978).
    """
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    d, e, f = R[1, 0] + R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2]
    plus, minus = R[1, 1] + R[2, 2], R[1, 1] - R[2, 2]
    up, down = 1 + R[0, 0], 1 - R[0, 0]
    ww, xx, yy, zz = up + plus, up - plus, down + minus, down - minus
    first = ca.if_else(ww >= xx, ca.vertcat(ww, a, b, c), ca.vertcat(a, xx, d, e))
    second = ca.if_else(yy >= zz, ca.vertcat(b, d, yy, f), ca.vertcat(c, e, f, zz))
    row = ca.if_else(ca.fmax(ww, xx) >= ca.fmax(yy, zz), first, second)
    return row / ca.sqrt(ca.dot(row, row))


def quaternion_to_matrix(q: Expr) -> Expr:
    """Return the rotation matrix (3, 3) of the unit quaternion q (4, 1)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    x2, y2, z2 = 2 * x, 2 * y, 2 * z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return ca.vertcat(
        ca.horzcat(1 - (yy + zz), xy - wz, xz + wy),
        ca.horzcat(xy + wz, 1 - (xx + zz), yz - wx),
        ca.horzcat(xz - wy, yz + wx, 1 - (xx + yy)),
    )


def matrix_to_rpy(R: Expr) -> Expr:
    """Return the roll, pitch, yaw (3, 1) [rad] of R (3, 3), pitch in [-pi/2, pi/2].

    In gimbal lock (pitch = +-pi/2) roll is set to 0 and yaw carries the whole rotation.
    """
    s = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]
    free = s > 1e-20
    return ca.vertcat(
        ca.atan2(ca.if_else(free, R[2, 1], 0.0), ca.if_else(free, R[2, 2], 1.0)),
        ca.atan2(-R[2, 0], safe_sqrt(s)),
        ca.atan2(ca.if_else(free, R[1, 0], -R[0, 1]), ca.if_else(free, R[0, 0], R[1, 1])),
    )


def euler_zyx(R: Expr) -> Expr:
    """Return Euler angles (alpha, beta, gamma) (3, 1) [rad] with R = Rz(alpha) Ry(beta) Rx(gamma).

    The angles of `matrix_to_rpy` in reverse order; one reading of the palm's Euler angles of Qiu
    & Kermani 2021, section II-B2, which leaves the convention open.
    """
    rpy = matrix_to_rpy(R)
    return ca.vertcat(rpy[2], rpy[1], rpy[0])


def angular_velocity_to_euler_zyx(angles: Expr, min_cosine: float = 1e-6) -> Expr:
    """Return E^-1 (3, 3) of d(angles)/dt = E^-1 omega; E^-1 J_omega is the analytic Jacobian.

    Args:
        angles: (alpha, beta, gamma) (3, 1) [rad] as in `euler_zyx`.
        min_cosine: |cos(beta)| is kept above it, so that gimbal lock stays finite.

    Returns:
        E^-1 (3, 3).
    """
    sa, ca_ = ca.sin(angles[0]), ca.cos(angles[0])
    sb, cb = ca.sin(angles[1]), ca.cos(angles[1])
    secant = ca.if_else(cb < 0, -1.0, 1.0) / ca.fmax(ca.fabs(cb), min_cosine)
    x, y = ca_ * secant, sa * secant
    return ca.vertcat(
        ca.horzcat(x * sb, y * sb, 1.0), ca.horzcat(-sa, ca_, 0.0), ca.horzcat(x, y, 0.0)
    )


def mean_rotation(Ra: Expr, Rb: Expr) -> Expr:
    """Return the rotation closest to Ra and Rb: SVD projection, Qiu & Kermani 2021, eq. (12).

    The least-squares solution of (12) is (Ra + Rb)/2 and its projection to SO(3) the chordal
    mean. For two rotations that equals the normalised sum of their sign-aligned quaternions, which
    needs no SVD. At a relative half turn the mean is not unique; one of the two is returned.

    Args:
        Ra: (3, 3).
        Rb: (3, 3).

    Returns:
        R (3, 3).
    """
    a, b = quaternion_from_matrix(Ra), quaternion_from_matrix(Rb)
    total = a + ca.if_else(ca.dot(a, b) < 0, -b, b)
    return quaternion_to_matrix(total / ca.sqrt(ca.dot(total, total)))


def project_to_rotation(M: Expr, iterations: int = 8) -> Expr:
    """Return the rotation closest to M in the Frobenius norm: the polar factor, U V' of the SVD.

    Newton's iteration X <- (g X + X^-T / g) / 2 with g = |det X|^(-1/3) (Higham 1986). Eight
    steps reach rounding up to condition number 1e4.

    Args:
        M: (3, 3) with positive determinant.
        iterations: number of Newton steps.

    Returns:
        R (3, 3).
    """
    X = M
    for _ in range(iterations):
        x, y, z = X[:, 0], X[:, 1], X[:, 2]
        cofactors = ca.horzcat(ca.cross(y, z), ca.cross(z, x), ca.cross(x, y))
        det = ca.fmax(ca.dot(x, cofactors[:, 0]), 1e-300)
        scale = det ** (-1 / 3)
        X = (0.5 * scale) * X + (0.5 / (det * scale)) * cofactors
    return ca.densify(X)


Transform: TypeAlias = tuple[Expr, Expr]
"""(R (3, 3), p (3, 1) [m])."""

SMALL_ANGLE_SQUARED = 1e-4
"""Switching point: three Taylor terms are exact below it, the closed forms above it."""

SINE_REMAINDER = (1 / 6, -1 / 120, 1 / 5040)
COTANGENT_REMAINDER = (1 / 12, 1 / 720, 1 / 30240)


def compose(first: Transform, second: Transform) -> Transform:
    """Return the product of two transforms: (Ra Rb, Ra pb + pa); `second` acts on a point first."""
    (Ra, pa), (Rb, pb) = first, second
    return ca.mtimes(Ra, Rb), ca.mtimes(Ra, pb) + pa


def inverse(transform: Transform) -> Transform:
    """Return the inverse transform: (R', -R' p)."""
    R, p = transform
    return R.T, -ca.mtimes(R.T, p)


def exp_se3(twist: Expr) -> Transform:
    """Return the transform reached by following a constant twist for unit time.

    Args:
        twist: [v; w] (6, 1) [m, rad].

    Returns:
        (R, p) with p = (I + (1 - cos)/theta^2 [w] + (theta - sin)/theta^3 [w]^2) v.
    """
    v, w = twist[:3], twist[3:]
    s = ca.dot(w, w)
    sinc = half_sinc(s)
    remainder = even_function(
        s,
        lambda x: (1 - ca.sin(ca.sqrt(x)) / ca.sqrt(x)) / x,
        SINE_REMAINDER,
        SMALL_ANGLE_SQUARED,
    )
    wv = ca.cross(w, v)
    return exp_so3(w), v + 0.5 * sinc * sinc * wv + remainder * ca.cross(w, wv)


def log_se3(transform: Transform) -> Expr:
    """Return the twist [v; w] (6, 1) [m, rad] with |w| <= pi whose exponential is the transform.

    Qiu & Kermani 2021, eq. (14), and the control law of Chandra et al. 2019, eq. (14).
    """
    R, p = transform
    w = log_so3(R)
    wp = ca.cross(w, p)
    factor = cotangent_remainder(ca.dot(w, w))
    return ca.vertcat(p - 0.5 * wp + factor * ca.cross(w, wp), w)


def cotangent_remainder(s: Expr) -> Expr:
    """Return (1 - (theta/2) cot(theta/2)) / theta^2 for s = theta^2 [rad^2]; 1/12 at 0."""

    def closed(x: Expr) -> Expr:
        half_angle = 0.5 * ca.sqrt(x)
        return (1 - half_angle * ca.cos(half_angle) / ca.sin(half_angle)) / x

    return even_function(s, closed, COTANGENT_REMAINDER, SMALL_ANGLE_SQUARED)


OPPOSITE_SQUARED = 1e-24
"""|a + b|^2 below which two unit vectors count as opposite."""

ANGLE_OVER_SINE = (0.5, 1 / 12)
"""angle / (|a - b| |a + b|) in powers of |a - b|^2, used below 1e-8."""


def perpendicular(n: Expr) -> Expr:
    """Return a unit vector (3, 1) perpendicular to the unit vector n (3, 1) (Duff et al. 2017)."""
    sign = ca.if_else(n[2] < 0, -1.0, 1.0)
    y = n[1] / (sign + n[2])
    return ca.vertcat(-n[0] * y, sign - n[1] * y, -n[1])


def angle_between(a: Expr, b: Expr) -> Expr:
    """Return the angle in [0, pi] between two vectors (3, 1) of any nonzero length.

    Kahan's 2 atan2(|U|, |V|) with U = |b| a - |a| b, V = |b| a + |a| b, as below eq. (3) of Qiu &
    Kermani 2021: accurate to rounding at 0 and at pi, where acos loses half the digits.
    """
    x, y = safe_norm(b) * a, safe_norm(a) * b
    return 2 * ca.atan2(safe_norm(x - y), safe_norm(x + y))


def normal_error(current: Expr, desired: Expr) -> Expr:
    """Return the rotation vector (3, 1) [rad] that turns one unit normal into another, Qiu eq. (3).

    phi (n_c x n_d) / |n_c x n_d| with Kahan's angle phi, written with U = n_c - n_d and
    V = n_c + n_d as phi (U x V) / (|U| |V|): the cross product of nearly opposite normals
    cancels, that of U and V does not.

    Args:
        current: n_c (3, 1), unit.
        desired: n_d (3, 1), unit, in the same frame.

    Returns:
        Error (3, 1) [rad] in the frame of the normals; 0 for equal normals, of length pi for
        opposite ones.
    """
    U, V = current - desired, current + desired
    u2, v2 = ca.dot(U, U), ca.dot(V, V)
    opposite = v2 < OPPOSITE_SQUARED
    v2 = ca.if_else(opposite, 1.0, v2)

    def factor(s: Expr) -> Expr:
        return 2 * ca.atan2(ca.sqrt(s), ca.sqrt(v2)) / ca.sqrt(s * v2)

    error = even_function(u2, factor, ANGLE_OVER_SINE, 1e-8) * ca.cross(U, V)
    return ca.if_else(opposite, np.pi * perpendicular(current), error)


def rotation_between(a: Expr, b: Expr) -> Expr:
    """Return shortest rotation R (3, 3) with R a = b for unit vectors a, b (3, 1): Qiu eq. (11).

    Equal to I + [w] sin + [w]^2 (1 - cos), but written as the product of the reflections in the
    planes perpendicular to a and to a + b: two outer products, no angle, no normalised axis.

    Args:
        a: unit vector (3, 1).
        b: unit vector (3, 1), in the same frame.

    Returns:
        R (3, 3); a half turn about a perpendicular axis if b = -a.
    """
    u = a + b
    # Normals have rounding errors, which would tilt u near b = -a; its component along a - b is
    # removed.
    u = u - (0.25 * ca.dot(u, a - b)) * (a - b)
    u = ca.if_else(ca.dot(u, u) < OPPOSITE_SQUARED, perpendicular(a), u)
    scaled = (2 / ca.dot(u, u)) * u
    return ca.densify(ca.DM.eye(3) - ca.mtimes(scaled, u.T) + ca.mtimes(2 * b, a.T))


def align(correlation: Expr, free: Expr | None = None) -> Expr:
    """Return the rotation R (3, 3) that maximises trace(R B') for B = sum of weighted b a'.

    The best R takes the vectors a to the vectors b in the least-squares sense. The dominant
    eigenvector of Davenport's matrix is its quaternion; it is found by squaring, so that two
    vectors (B of rank two or one) are as good as many.

    Args:
        correlation: B (3, 3), any scale; zero if `free` is given only.
        free: Unit quaternion (4, 1), scalar first. Where several R are as good (one vector turns
            about itself), the one nearest to it; None: any of them.
    """
    B = correlation / ca.fmax(ca.norm_fro(correlation), 1e-300)
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    z = ca.vertcat(B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1])
    K = ca.vertcat(ca.horzcat(trace, z.T), ca.horzcat(z, B + B.T - trace * ca.DM.eye(3)))
    # Eigenvalues lie in [-sqrt(3), sqrt(3)]: shifted, the dominant one is the largest.
    M = K + 2 * ca.DM.eye(4)
    squared = _squared()
    for _ in range(7):  # a power iteration of 128 steps
        M = ca.triu2symm(squared(ca.triu(M)))
    column = M[:, 0]
    for j in range(1, 4):
        better = ca.sumsqr(M[:, j]) > ca.sumsqr(column)
        column = ca.if_else(better, M[:, j], column)
    if free is not None:
        # M is the projection onto the best quaternions, by how many dimensions they have: its
        # squared length is 1 if they are one vector's multiples, 1/2 if they fill a plane. So
        # they do, nearly enough, for two fingers that face each other; not for three.
        column = ca.if_else(ca.sumsqr(M) < 0.55, M @ free, column)
    return quaternion_to_matrix(column / ca.fmax(ca.norm_2(column), 1e-300))


@cache
def _squared() -> ca.Function:
    """Return ``upper triangle of S (4, 4) -> upper triangle of S^2 / trace(S^2)``."""
    upper = ca.SX.sym("upper", ca.Sparsity.upper(4))
    matrix = ca.triu2symm(upper)
    square = matrix @ matrix
    return call_function("squared", [upper], [ca.triu(square / ca.trace(square))])
