"""Mechanisms that bend fingers: the slider triangle and the four-bar of Chandra et al. 2019.

*Lead screw*, eq. (8): a screw of length s between two arms b and c of a joint, s^2 = b^2 + c^2 -
2 b c cos(theta). All lengths share one unit (m); theta in (0, pi) is the angle between the arms,
from which a joint angle differs by an offset. Outside [|b - c|, b + c] there is no triangle;
there theta is within 1e-8 rad of 0 or pi and its derivative is 0, so that no result is NaN.

*Four-bar*, eqs. (9) to (11): it bends the last joint of a finger. Pivots O = (0, 0) and
C = (g, 0) are fixed to the proximal phalanx. The crank OP of length p is the middle phalanx at the
angle phi, the rod CQ of length q is at the angle psi, and PQ of length h is fixed to the distal
phalanx at the angle phi + theta3. All angles are in rad, all lengths in one unit. The loop closes
in two ways; `branch` = sigma = +-1 selects one and is the sign of sin(phi + theta3 - psi). The
paper states sigma = -1 only. Its symbol `a` in eq. (11) is the crank p (McCarthy's notation): with
a = g the formula disagrees with finite differences. Both branches share one form of (11). If the
linkage cannot be assembled (`linkage_toggle` < 0), rod and coupler are aligned, and values and
derivatives remain finite.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from casadi_ik.errors import InputError
from casadi_ik.kinematics.smooth import Expr

MIN_SINE = 1e-9
"""|sin(phi + theta3 - psi)| is kept above it; this bounds every rate at a toggle."""


class Linkage(NamedTuple):
    """Lengths of crank p, rod q, ground g and coupler h (one unit), and the branch +-1."""

    p: Expr
    q: Expr
    g: Expr
    h: Expr
    branch: Expr = -1


def coefficients(phi: Expr, bar: Linkage) -> tuple[Expr, Expr, Expr]:
    """Return A, B, C [length^2] of A cos(psi) + B sin(psi) = C, as printed below eq. (9)."""
    p, q, g, h = bar[:4]
    c, s = ca.cos(phi), ca.sin(phi)
    pq2 = 2 * p * q
    return pq2 * c - 2 * g * q, pq2 * s, (g * g + p * p + q * q - h * h) - (2 * p * g) * c


def linkage_toggle(phi: Expr, bar: Linkage) -> Expr:
    """Return the distance from the singular position: sin^2 of the angle between rod and coupler.

    (A^2 + B^2 - C^2) / (2 q h)^2: 1 where rod and coupler stand at right angles, 0 where they
    align and the rates blow up, negative where the linkage cannot be assembled. Smooth.
    """
    A, B, C = coefficients(phi, bar)
    return (A * A + B * B - C * C) / ((2 * bar.q * bar.h) * (2 * bar.q * bar.h))


def psi(phi: Expr, bar: Linkage) -> Expr:
    """Return rod angle psi [rad] in (-pi, pi]: atan2(B, A) + sigma acos(C / sqrt(A^2 + B^2))."""
    rod, _ = _rod(phi, bar)
    return ca.atan2(rod[1], rod[0])


def theta3(phi: Expr, bar: Linkage, reference: Expr = 0.0) -> Expr:
    """Return the angle theta3 [rad] of the distal phalanx against the middle one: eq. (9).

    Args:
        phi: crank angle [rad].
        bar: the linkage.
        reference: the result is the value within pi of this angle [rad]; a value amid the
            working range makes theta3 continuous over it.
    """
    (c, s), _ = _rod(phi, bar)
    x = bar.g + bar.q * c - bar.p * ca.cos(phi)
    y = bar.q * s - bar.p * ca.sin(phi)
    turn = phi + reference
    ct, st = ca.cos(turn), ca.sin(turn)
    return reference + ca.atan2(y * ct - x * st, x * ct + y * st)


def theta3_rate(phi: Expr, bar: Linkage) -> Expr:
    """Return coupling f = d theta3 / d phi of both branches: eq. (11) with a = p. Dimensionless.

    Its numerator p sin(psi - phi) - h sin(phi + theta3 - psi) is g sin(psi), the lever of O about
    the rod, so f = g sin(psi) / [h sin(phi + theta3 - psi)], where h sin(phi + theta3 - psi) =
    sigma sqrt(A^2 + B^2 - C^2) / (2 q). Therefore f is zero if rod and ground are aligned.
    """
    (_, s), root = _rod(phi, bar)
    return (2 * bar.g * bar.q) * s / (bar.branch * root)


def branch_from_pose(bar: Linkage, phi: float, theta: float) -> int:
    """Return the branch (+1 or -1) of a numeric linkage in a known pose.

    Args:
        bar: the linkage, numbers; its branch is ignored.
        phi: crank angle [rad] of the pose.
        theta: theta3 [rad] of the pose, modulo a turn; need not be exact.

    Raises:
        InputError: the linkage cannot be assembled at phi.
    """
    if float(linkage_toggle(ca.DM(phi), bar)) < 0:
        raise InputError(f"four-bar {tuple(bar[:4])} cannot be assembled at phi = {phi:g} rad")

    def distance(branch: int) -> float:
        return abs(float(theta3(ca.DM(phi), bar._replace(branch=branch), theta)) - theta)

    return min((-1, 1), key=distance)


def _rod(phi: Expr, bar: Linkage) -> tuple[tuple[Expr, Expr], Expr]:
    """Return (cos psi, sin psi) and the root sqrt(A^2 + B^2 - C^2), kept from vanishing."""
    A, B, C = coefficients(phi, bar)
    floor = 2 * bar.q * bar.h * MIN_SINE
    root = ca.sqrt(ca.fmax(A * A + B * B - C * C, floor * floor))
    signed = bar.branch * root
    # Unit length by construction where the loop closes; elsewhere C^2 + root^2 exceeds A^2 + B^2.
    scale = 1 / ca.sqrt((A * A + B * B) * (C * C + root * root))
    return (scale * (A * C - signed * B), scale * (B * C + signed * A)), root


MIN_SLACK = 1e-16
"""Lower bound of the two slacks of the triangle, relative to b c."""


def angle_from_slider(s: Expr, b: Expr, c: Expr) -> Expr:
    """Return the angle theta [rad] of a slider length s [m]: Chandra eq. (8).

    As 2 atan sqrt((s^2 - (b - c)^2) / ((b + c)^2 - s^2)), which unlike acos keeps all digits
    near the flat triangles.

    Args:
        s: slider length [m].
        b: first arm [m].
        c: second arm [m].
    """
    low, high = _slacks(s, b, c)
    return 2 * ca.atan(ca.sqrt(low / high))


def angle_rate(s: Expr, b: Expr, c: Expr) -> Expr:
    """Return the rate d theta / d s = s / (b c sin theta) [rad/m] at the slider length s [m]."""
    low, high = _slacks(s, b, c)
    return 2 * s / ca.sqrt(low * high)


def slider_toggle(s: Expr, b: Expr, c: Expr) -> Expr:
    """Return the distance from the flat triangle: sin^2(theta).

    1 where the slider pushes at right angles to the crank, 0 where the triangle is flat and the
    rate blows up, negative where there is no triangle. Smooth.
    """
    return ((s * s - (b - c) * (b - c)) * ((b + c) * (b + c) - s * s)) / (4 * b * b * c * c)


def _slacks(s: Expr, b: Expr, c: Expr) -> tuple[Expr, Expr]:
    """Return s^2 - (b - c)^2 = 4 b c sin^2(theta/2) and (b + c)^2 - s^2 = 4 b c cos^2(theta/2)."""
    short, long, flat = b - c, b + c, MIN_SLACK * b * c
    return (
        ca.fmax((s - short) * (s + short), flat),
        ca.fmax((long - s) * (long + s), flat),
    )
