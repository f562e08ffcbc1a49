"""Rigid transforms as pairs (R, p), their exponential, logarithm and adjoint.

A transform (R (3, 3), p (3, 1) [m]) maps the coordinates of a point in the moved frame to the
outer frame: x -> R x + p. A twist is (6, 1), **[v; w]**: linear part first, angular part second
(pinocchio's order). All functions accept SX, MX and DM.
"""

from __future__ import annotations

from typing import TypeAlias

import casadi as ca

from casadi_ik.symbolic.smooth import Expr, even_function
from casadi_ik.symbolic.so3 import exp_so3, half_sinc, log_so3, skew

Transform: TypeAlias = tuple[Expr, Expr]
"""(R (3, 3), p (3, 1) [m])."""

SMALL_ANGLE_SQUARED = 1e-4
"""Below it three Taylor terms are exact to rounding, above it the closed forms still are."""

SINE_REMAINDER = (1 / 6, -1 / 120, 1 / 5040)
COTANGENT_REMAINDER = (1 / 12, 1 / 720, 1 / 30240)


def compose(first: Transform, second: Transform) -> Transform:
    """Product of two transforms: (Ra Rb, Ra pb + pa); `second` acts on a point first."""
    (Ra, pa), (Rb, pb) = first, second
    return ca.mtimes(Ra, Rb), ca.mtimes(Ra, pb) + pa


def inverse(transform: Transform) -> Transform:
    """Inverse transform: (R', -R' p)."""
    R, p = transform
    return R.T, -ca.mtimes(R.T, p)


def act(transform: Transform, points: Expr) -> Expr:
    """Coordinates of points in the outer frame.

    Args:
        transform: (R, p).
        points: (3, k) [m] in the moved frame, one per column.

    Returns:
        (3, k) [m].
    """
    R, p = transform
    return ca.mtimes(R, points) + ca.repmat(p, 1, points.shape[1])


def to_matrix(transform: Transform) -> Expr:
    """Homogeneous matrix (4, 4) of a transform."""
    R, p = transform
    return ca.densify(ca.vertcat(ca.horzcat(R, p), ca.DM([[0.0, 0.0, 0.0, 1.0]])))


def from_matrix(T: Expr) -> Transform:
    """Transform of a homogeneous matrix (4, 4)."""
    return T[:3, :3], T[:3, 3]


def adjoint(transform: Transform) -> Expr:
    """Matrix (6, 6) that takes a twist [v; w] from the moved to the outer frame.

    [[R, [p] R], [0, R]]: both twists describe the same motion, each at its own frame's origin.
    """
    R, p = transform
    return ca.densify(
        ca.vertcat(
            ca.horzcat(R, ca.mtimes(skew(p), R)),
            ca.horzcat(ca.DM.zeros(3, 3), R),
        )
    )


def exp_se3(twist: Expr) -> Transform:
    """Transform reached by following a constant twist for unit time.

    Args:
        twist: [v; w] (6, 1) [m, rad].

    Returns:
        (R, p) with p = (I + (1 - cos)/theta^2 [w] + (theta - sin)/theta^3 [w]^2) v.
    """
    v, w = twist[:3], twist[3:]
    s = ca.dot(w, w)
    half = half_sinc(s)
    remainder = even_function(
        s,
        lambda x: (1 - ca.sin(ca.sqrt(x)) / ca.sqrt(x)) / x,
        SINE_REMAINDER,
        SMALL_ANGLE_SQUARED,
    )
    wv = ca.cross(w, v)
    return exp_so3(w), v + 0.5 * half * half * wv + remainder * ca.cross(w, wv)


def log_se3(transform: Transform) -> Expr:
    """Twist [v; w] (6, 1) [m, rad] with |w| <= pi whose exponential is the transform.

    Qiu & Kermani 2021, eq. (14), and the control law of Chandra et al. 2019, eq. (14).
    """
    R, p = transform
    w = log_so3(R)
    wp = ca.cross(w, p)
    factor = cotangent_remainder(ca.dot(w, w))
    return ca.vertcat(p - 0.5 * wp + factor * ca.cross(w, wp), w)


def cotangent_remainder(s: Expr) -> Expr:
    """(1 - (theta/2) cot(theta/2)) / theta^2 as a function of s = theta^2 [rad^2]; 1/12 at 0."""

    def closed(x: Expr) -> Expr:
        half = 0.5 * ca.sqrt(x)
        return (1 - half * ca.cos(half) / ca.sin(half)) / x

    return even_function(s, closed, COTANGENT_REMAINDER, SMALL_ANGLE_SQUARED)
