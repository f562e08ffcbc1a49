"""Unit dual quaternions: poses, screws and lines (Chandra et al. 2019, section II-A).

A dual quaternion is (8, 1): the real quaternion, then the dual one, each scalar first
(w, x, y, z). The pose (R, p) is `x = r + eps (1/2) p r` with r the quaternion of R and p the
translation [m] as a pure quaternion; x and -x are the same pose. A directed line is the pair
(l, m) of its unit direction and its moment m = point x l [m] about the origin. A twist is the pair
(w, v) = (theta l, theta m + d l): the rotation vector [rad] and the velocity [m] of the point
instantly at the origin. As a 6-vector of `se3` that is [v; w].
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.kinematics.se3 import (
    angle_over_half_sine,
    half_sinc,
    quaternion_exp,
    quaternion_from_matrix,
    quaternion_to_matrix,
)
from casadi_ik.kinematics.smooth import Expr, even_function, safe_sqrt

LEVER_REMAINDER = (2 / 3, 4 / 15, 16 / 105)
"""(2 - theta cot(theta/2)) / sin(theta/2)^2 in powers of sin(theta/2)^2, used below 1e-4."""

PITCH_REMAINDER = (-1 / 24, 1 / 960, -1 / 107520)
"""(cos(theta/2)/2 - sin(theta/2)/theta) / theta^2 in powers of theta^2, used below 1e-4."""


def quaternion_multiply(a: Expr, b: Expr) -> Expr:
    """Return the Hamilton product of two quaternions (4, 1)."""
    return ca.vertcat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def multiply(a: Expr, b: Expr) -> Expr:
    """Return the product of two dual quaternions (8, 1); as poses, b acts on a point first."""
    real = quaternion_multiply(a[:4], b[:4])
    dual = quaternion_multiply(a[:4], b[4:]) + quaternion_multiply(a[4:], b[:4])
    return ca.vertcat(real, dual)


def conjugate(x: Expr) -> Expr:
    """Return the classical conjugate (8, 1), both quaternions conjugated: inverse of a unit x."""
    return ca.vertcat(x[0], -x[1:4], x[4], -x[5:])


def identity() -> ca.DM:
    """Return the identity pose (8, 1)."""
    return ca.DM([1.0, 0, 0, 0, 0, 0, 0, 0])


def norm(x: Expr) -> Expr:
    """Return the dual-number norm (2, 1) of x (8, 1): (|r|, r . d / |r|); (1, 0) for a unit x."""
    length = ca.sqrt(ca.dot(x[:4], x[:4]))
    return ca.vertcat(length, ca.dot(x[:4], x[4:]) / length)


def from_pose(R: Expr, p: Expr) -> Expr:
    """Return unit dual quaternion (8, 1) of R (3, 3) and p (3, 1) [m]; its sign is not fixed."""
    return from_quaternion(quaternion_from_matrix(R), p)


def from_quaternion(r: Expr, p: Expr) -> Expr:
    """Return the dual quaternion (8, 1) of a quaternion r (4, 1) and a translation p (3, 1)."""
    return ca.vertcat(r, quaternion_multiply(ca.vertcat(0.0, 0.5 * p), r))


def from_translation(p: Expr) -> Expr:
    """Return the unit dual quaternion (8, 1) of a translation p (3, 1) [m]."""
    return ca.vertcat(1.0, 0.0, 0.0, 0.0, 0.0, 0.5 * p)


def to_pose(x: Expr) -> tuple[Expr, Expr]:
    """Return R (3, 3) and translation (3, 1) [m] of a unit dual quaternion x (8, 1)."""
    return quaternion_to_matrix(x[:4]), translation(x)


def translation(x: Expr) -> Expr:
    """Return the translation p = 2 d r* (3, 1) [m] of a unit dual quaternion x (8, 1)."""
    r, d = x[1:4], x[5:]
    return 2 * (x[0] * d - x[4] * r + ca.cross(r, d))


def directed_line(direction: Expr, point: Expr) -> tuple[Expr, Expr]:
    """Return unit dual vector l + eps m of a line: Chandra eq. (2), where m = point x direction.

    Args:
        direction: l (3, 1), unit.
        point: (3, 1) [m], any point of the line.

    Returns:
        l (3, 1) and m (3, 1) [m].
    """
    return direction, ca.cross(point, direction)


def exp_screw(angle: Expr, distance: Expr, direction: Expr, moment: Expr) -> Expr:
    """Return the displacement along a screw, exp((theta + eps d)/2 (l + eps m)): Chandra eq. (1).

    There is no singularity; a revolute joint has d = 0, a prismatic one theta = 0.

    Args:
        angle: theta [rad].
        distance: d [m] along the axis.
        direction: l (3, 1), unit.
        moment: m = p x l (3, 1) [m], p any point of the axis.

    Returns:
        Unit dual quaternion (8, 1).
    """
    c, s = ca.cos(0.5 * angle), ca.sin(0.5 * angle)
    half_distance = 0.5 * distance
    dual = s * moment + (half_distance * c) * direction
    return ca.vertcat(c, s * direction, -half_distance * s, dual)


def exp(w: Expr, v: Expr) -> Expr:
    """Return the unit dual quaternion (8, 1) of a twist: the inverse of `log`, smooth at w = 0.

    Args:
        w: theta l (3, 1) [rad].
        v: theta m + d l (3, 1) [m].
    """
    s = ca.dot(w, w)
    sinc = 0.5 * half_sinc(s)
    travel = ca.dot(w, v)
    factor = even_function(
        s,
        lambda x: (0.5 * ca.cos(0.5 * ca.sqrt(x)) - ca.sin(0.5 * ca.sqrt(x)) / ca.sqrt(x)) / x,
        PITCH_REMAINDER,
        1e-4,
    )
    return ca.vertcat(quaternion_exp(w), -0.5 * sinc * travel, sinc * v + (factor * travel) * w)


def log(x: Expr) -> tuple[Expr, Expr]:
    """Return twist (w, v) = (theta l, theta m + d l) of a unit dual quaternion: Chandra eq. (14).

    Of x and -x, the one with theta in [0, pi] is used. The result is robust at theta = 0, where v
    is the translation.

    Args:
        x: unit dual quaternion (8, 1).

    Returns:
        w (3, 1) [rad] and v (3, 1) [m].
    """
    sign = ca.if_else(x[0] < 0, -1.0, 1.0)
    cosine, r, d = sign * x[0], x[1:4], x[5:]
    s = ca.dot(r, r)
    ratio = angle_over_half_sine(cosine, s)

    def closed(y: Expr) -> Expr:
        return (2 - 2 * cosine * ca.atan2(ca.sqrt(y), cosine) / ca.sqrt(y)) / y

    lever = even_function(s, closed, LEVER_REMAINDER, 1e-4)
    signed = sign * ratio
    return signed * r, signed * d - (lever * x[4]) * r


def act_on_point(x: Expr, point: Expr) -> Expr:
    """Return R point + p (3, 1) [m] for a point (3, 1) [m] and a pose x (8, 1)."""
    return rotate(x, point) + translation(x)


def rotate(x: Expr, vector: Expr) -> Expr:
    """Return R vector (3, 1) for the rotation of the unit (dual) quaternion x (4, 1) or (8, 1)."""
    r = x[1:4]
    t = 2 * ca.cross(r, vector)
    return vector + x[0] * t + ca.cross(r, t)


def act_on_line(x: Expr, direction: Expr, moment: Expr) -> tuple[Expr, Expr]:
    """Return the line moved by the pose x: x s x* with the classical conjugate, Chandra eq. (6).

    Args:
        x: unit dual quaternion (8, 1).
        direction: l (3, 1).
        moment: m (3, 1) [m].

    Returns:
        (R l, R m + p x R l).
    """
    new_direction = rotate(x, direction)
    return new_direction, rotate(x, moment) + ca.cross(translation(x), new_direction)


def error(current: Expr, desired: Expr) -> Expr:
    """Return e = x_c x_d* (8, 1) from the desired to the current pose: Chandra eq. (13).

    In the base frame: current = e desired. The control law (14) is the twist -gain log(e).
    """
    return multiply(current, conjugate(desired))


def twist(x: Expr, rate: Expr) -> tuple[Expr, Expr]:
    """Return the twist w + eps v = 2 x' x* of a moving pose, in the base frame: Chandra eq. (4).

    Args:
        x: unit dual quaternion (8, 1).
        rate: its derivative x' (8, 1) [1/s, m/s].

    Returns:
        w (3, 1) [rad/s] and v (3, 1) [m/s], the velocity of the moving point that is
        instantaneously at the origin.
    """
    product = 2 * multiply(rate, conjugate(x))
    return product[1:4], product[5:]


def control_twist(e: Expr, gain: Expr) -> tuple[Expr, Expr]:
    """Return the twist -gain log(e) of the screw control law: Chandra eq. (14).

    Args:
        e: unit dual quaternion (8, 1) of the error, see `error`.
        gain: Gain [1/s], or the fraction of the error that a discrete step removes.

    Returns:
        w (3, 1) and v (3, 1), as `twist`.
    """
    w, v = log(e)
    return -gain * w, -gain * v


def screw_error_norm(e: Expr) -> Expr:
    """Return sqrt(|w|^2 + |v|^2) of log(e), which adds rad^2 and m^2: Chandra eq. (17)."""
    w, v = log(e)
    return safe_sqrt(ca.dot(w, w) + ca.dot(v, v))
