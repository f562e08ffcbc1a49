"""Rotations: exponential and logarithm, quaternions, Euler angles, means and projections.

A rotation matrix R (3, 3) maps coordinates in the rotated frame to the outer frame. Quaternions
are (4, 1), scalar first (w, x, y, z). Angles are in rad. All functions accept SX, MX and DM and
return dense results; values and first derivatives are finite at zero rotation, and values at a
half turn as well (where the logarithm jumps).
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.smooth import Expr, even_function, safe_sqrt

TINY_SQUARED = 1e-8
"""Two Taylor terms are exact to rounding below; the closed forms here never cancel above."""

HALF_SINC = (1.0, -1 / 24)
HALF_COSINE = (1.0, -1 / 8)
ARC_OVER_SINE = (2.0, 1 / 3)
GIMBAL_LOCK_COSINE_SQUARED = 1e-20


def skew(w: Expr) -> Expr:
    """Return the matrix [w] (3, 3) with [w] x = w cross x, for w (3, 1)."""
    return ca.densify(ca.skew(w))


def unskew(S: Expr) -> Expr:
    """Return the vector (3, 1) of the skew part of S (3, 3): the inverse of `skew`."""
    return 0.5 * ca.vertcat(S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1])


def rotation_about_axis(axis: Expr, angle: Expr) -> Expr:
    """Rotation by an angle about a fixed unit axis (Rodrigues).

    Written as `u u' + cos (I - u u') + sin [u]`, which folds to the few nonzero terms when the
    axis is a numeric coordinate axis.

    Args:
        axis: (3, 1), unit.
        angle: scalar [rad].

    Returns:
        R (3, 3).
    """
    outer = ca.mtimes(axis, axis.T)
    return ca.densify(outer + ca.cos(angle) * (ca.DM.eye(3) - outer) + ca.sin(angle) * skew(axis))


def exp_so3(w: Expr) -> Expr:
    """Rotation matrix (3, 3) of the rotation vector w (3, 1) [rad]."""
    return quaternion_to_matrix(quaternion_exp(w))


def log_so3(R: Expr) -> Expr:
    """Rotation vector w (3, 1) [rad] of R (3, 3), with |w| <= pi.

    Goes through the quaternion, so it is accurate to rounding both near 0 and near pi. At exactly
    pi the sign of w is a free choice.
    """
    return quaternion_log(quaternion_from_matrix(R))


def quaternion_exp(w: Expr) -> Expr:
    """Unit quaternion (4, 1) of the rotation vector w (3, 1) [rad]."""
    s = ca.dot(w, w)
    cosine = even_function(s, lambda x: ca.cos(0.5 * ca.sqrt(x)), HALF_COSINE, TINY_SQUARED)
    return ca.vertcat(cosine, (0.5 * half_sinc(s)) * w)


def half_sinc(s: Expr) -> Expr:
    """sin(theta/2) / (theta/2) as a function of s = theta^2 [rad^2]."""
    return even_function(
        s, lambda x: ca.sin(0.5 * ca.sqrt(x)) / (0.5 * ca.sqrt(x)), HALF_SINC, TINY_SQUARED
    )


def quaternion_log(q: Expr) -> Expr:
    """Rotation vector (3, 1) [rad], |w| <= pi, of the unit quaternion q (4, 1) of either sign."""
    sign = ca.if_else(q[0] < 0, -1.0, 1.0)
    return (sign * angle_over_half_sine(sign * q[0], ca.dot(q[1:], q[1:]))) * q[1:]


def angle_over_half_sine(cosine: Expr, s: Expr) -> Expr:
    """Ratio theta / sin(theta/2), 2 at 0, of cos(theta/2) >= 0 and s = sin(theta/2)^2."""
    return even_function(
        s, lambda x: 2 * ca.atan2(ca.sqrt(x), cosine) / ca.sqrt(x), ARC_OVER_SINE, TINY_SQUARED
    )


def quaternion_from_matrix(R: Expr) -> Expr:
    """Unit quaternion (4, 1) of R (3, 3); its sign is not fixed.

    Takes the row of 4 q q' (linear in R) with the largest diagonal entry, so nothing small is
    ever divided by (Shepperd 1978).
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
    """Rotation matrix (3, 3) of the unit quaternion q (4, 1)."""
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


def rpy_to_matrix(rpy: Expr) -> Expr:
    """R = Rz(yaw) Ry(pitch) Rx(roll) (3, 3) of rpy (3, 1) [rad]: URDF's fixed-axis convention."""
    sr, cr = ca.sin(rpy[0]), ca.cos(rpy[0])
    sp, cp = ca.sin(rpy[1]), ca.cos(rpy[1])
    sy, cy = ca.sin(rpy[2]), ca.cos(rpy[2])
    return ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )


def matrix_to_rpy(R: Expr) -> Expr:
    """Roll, pitch, yaw (3, 1) [rad] of R (3, 3), pitch in [-pi/2, pi/2].

    In gimbal lock (pitch = +-pi/2) roll is set to 0 and yaw carries the whole rotation.
    """
    s = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]
    free = s > GIMBAL_LOCK_COSINE_SQUARED
    return ca.vertcat(
        ca.atan2(ca.if_else(free, R[2, 1], 0.0), ca.if_else(free, R[2, 2], 1.0)),
        ca.atan2(-R[2, 0], safe_sqrt(s)),
        ca.atan2(ca.if_else(free, R[1, 0], -R[0, 1]), ca.if_else(free, R[0, 0], R[1, 1])),
    )


def euler_zyx(R: Expr) -> Expr:
    """Euler angles (alpha, beta, gamma) (3, 1) [rad] with R = Rz(alpha) Ry(beta) Rx(gamma).

    The angles of `matrix_to_rpy` in reverse order; one reading of the palm's Euler angles of Qiu
    & Kermani 2021, section II-B2, which leaves the convention open.
    """
    rpy = matrix_to_rpy(R)
    return ca.vertcat(rpy[2], rpy[1], rpy[0])


def euler_zyx_to_angular_velocity(angles: Expr) -> Expr:
    """Matrix E (3, 3) with omega = E d(angles)/dt, omega in the outer frame.

    Args:
        angles: (alpha, beta, gamma) (3, 1) [rad] as in `euler_zyx`.

    Returns:
        E (3, 3), with determinant -cos(beta).
    """
    sa, ca_ = ca.sin(angles[0]), ca.cos(angles[0])
    sb, cb = ca.sin(angles[1]), ca.cos(angles[1])
    return ca.vertcat(
        ca.horzcat(0.0, -sa, ca_ * cb), ca.horzcat(0.0, ca_, sa * cb), ca.horzcat(1.0, 0.0, -sb)
    )


def angular_velocity_to_euler_zyx(angles: Expr, min_cosine: float = 1e-6) -> Expr:
    """Matrix E^-1 (3, 3): d(angles)/dt = E^-1 omega; times J_omega it is the analytic Jacobian.

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
    """Rotation closest to both Ra and Rb: the SVD projection of Qiu & Kermani 2021, eq. (12).

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
    """Rotation closest to M in the Frobenius norm: the polar factor, U V' of the SVD.

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
