"""Unit vectors: the rotation between two of them, the angle and the error vector.

Contact normals live on the sphere, where two points are special: equal vectors (the error is
zero) and opposite vectors (the error is a half turn about an axis that is free to choose). All
functions are finite at both, and so are their first derivatives; at opposite vectors one
perpendicular axis is chosen so that a solver is not left standing on the saddle.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.symbolic.smooth import Expr, even_function, safe_norm

OPPOSITE_SQUARED = 1e-24
"""|a + b|^2 below which two unit vectors count as opposite."""

ANGLE_OVER_SINE = (0.5, 1 / 12)
"""angle / (|a - b| |a + b|) in powers of |a - b|^2, used below 1e-8."""


def perpendicular(n: Expr) -> Expr:
    """A unit vector (3, 1) perpendicular to the unit vector n (3, 1) (Duff et al. 2017)."""
    sign = ca.if_else(n[2] < 0, -1.0, 1.0)
    y = n[1] / (sign + n[2])
    return ca.vertcat(-n[0] * y, sign - n[1] * y, -n[1])


def angle_between(a: Expr, b: Expr) -> Expr:
    """Angle in [0, pi] between two vectors (3, 1) of any nonzero length.

    Kahan's 2 atan2(|U|, |V|) with U = |b| a - |a| b, V = |b| a + |a| b, as below eq. (3) of Qiu &
    Kermani 2021: accurate to rounding at 0 and at pi, where acos loses half the digits.
    """
    x, y = safe_norm(b) * a, safe_norm(a) * b
    return 2 * ca.atan2(safe_norm(x - y), safe_norm(x + y))


def normal_error(current: Expr, desired: Expr) -> Expr:
    """Rotation vector (3, 1) [rad] that turns one unit normal into another, Qiu eq. (3).

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
    """Shortest rotation R (3, 3) with R a = b for unit vectors a, b (3, 1): Qiu eq. (11).

    Equal to I + [w] sin + [w]^2 (1 - cos), but written as the product of the reflections in the
    planes perpendicular to a and to a + b: two outer products, no angle, no normalised axis.

    Args:
        a: unit vector (3, 1).
        b: unit vector (3, 1), in the same frame.

    Returns:
        R (3, 3); a half turn about a perpendicular axis if b = -a.
    """
    u = a + b
    # Normals are unit up to rounding only; near -a that tilts u unless a - b is taken out of it.
    u = u - (0.25 * ca.dot(u, a - b)) * (a - b)
    u = ca.if_else(ca.dot(u, u) < OPPOSITE_SQUARED, perpendicular(a), u)
    scaled = (2 / ca.dot(u, u)) * u
    return ca.densify(ca.DM.eye(3) - ca.mtimes(scaled, u.T) + ca.mtimes(2 * b, a.T))
