"""The slider triangle: a lead screw of length s between two arms b and c of a joint.

s^2 = b^2 + c^2 - 2 b c cos(theta), Chandra et al. 2019, eq. (8). All lengths share one unit (m);
theta in (0, pi) is the angle between the arms, from which a joint angle differs by an offset.
Outside [|b - c|, b + c] no triangle exists; there theta stays within 1e-8 rad of 0 or pi, with
derivative 0, so that nothing turns into NaN.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.smooth import Expr

FLAT = 1e-16
"""The triangle's two slacks are kept above FLAT b c [m^2]."""


def angle_from_slider(s: Expr, b: Expr, c: Expr) -> Expr:
    """Angle theta [rad] of a slider length s [m]: Chandra eq. (8).

    As 2 atan sqrt((s^2 - (b - c)^2) / ((b + c)^2 - s^2)), which unlike acos keeps all digits
    near the flat triangles.

    Args:
        s: slider length [m].
        b: first arm [m].
        c: second arm [m].
    """
    low, high = _slacks(s, b, c)
    return 2 * ca.atan(ca.sqrt(low / high))


def slider_from_angle(theta: Expr, b: Expr, c: Expr) -> Expr:
    """Slider length s [m] of an angle theta [rad]; arms b, c [m], b != c. Inverts eq. (8)."""
    half = ca.sin(0.5 * theta)
    return ca.sqrt((b - c) * (b - c) + (4 * b * c) * (half * half))


def angle_rate(s: Expr, b: Expr, c: Expr) -> Expr:
    """Rate d theta / d s = s / (b c sin theta) [rad/m] at the slider length s [m]."""
    low, high = _slacks(s, b, c)
    return 2 * s / ca.sqrt(low * high)


def toggle(s: Expr, b: Expr, c: Expr) -> Expr:
    """Distance from the flat triangle: sin^2(theta).

    1 where the slider pushes at right angles to the crank, 0 where the triangle is flat and the
    rate blows up, negative where there is no triangle. Smooth.
    """
    return ((s * s - (b - c) * (b - c)) * ((b + c) * (b + c) - s * s)) / (4 * b * b * c * c)


def _slacks(s: Expr, b: Expr, c: Expr) -> tuple[Expr, Expr]:
    """s^2 - (b - c)^2 = 4 b c sin^2(theta/2) and (b + c)^2 - s^2 = 4 b c cos^2(theta/2)."""
    short, long, flat = b - c, b + c, FLAT * b * c
    return (
        ca.fmax((s - short) * (s + short), flat),
        ca.fmax((long - s) * (long + s), flat),
    )
