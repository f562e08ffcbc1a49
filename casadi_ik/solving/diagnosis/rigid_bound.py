"""How well two sets of points and directions fit at best, however the one is moved: a bound.

The largest trace tr(R S) over all rotations R is the largest eigenvalue of Horn's symmetric 4 x 4
matrix (Horn 1987). Newton's method on its characteristic polynomial falls towards it from above
(Theobald 2005), so that every iterate is a bound. Graphs without branches.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.solving.diagnosis.box_contacts import BoxContact
from casadi_ik.symbolic.smooth import Expr

STEPS = 7
"""Newton's steps."""

ROUNDING = 3e-8
"""Of the bound, as a part of its largest terms: what is left of a double root in doubles."""

SETTLED = 1e-13
"""Where the scaled polynomial is smaller than this the iteration stands still: rounding errors
must not carry it past the root."""


def largest_trace(S: Expr, bound: Expr) -> Expr:
    """An upper bound of tr(R S) over all rotations R, (1, 1).

    Args:
        S: (3, 3), the sum of weight x_source x_target'.
        bound: A bound that is known, > 0; the result is as close as rounding to `bound` allows.
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
    c2, c1, c0 = -2 * ca.sumsqr(s), -8 * _determinant(s), _determinant(K)
    x = ca.SX(1)
    for _ in range(STEPS):
        value = ((x * x + c2) * x + c1) * x + c0
        slope = (4 * x * x + 2 * c2) * x + c1
        ahead = ca.logic_and(value > SETTLED, slope > 0)
        x = x - ca.if_else(ahead, value / ca.fmax(slope, 1e-300), 0.0)
    return x * bound


def rigid_excess(contacts: list[BoxContact]) -> Expr:
    """> 0 if no motion of the palm brings all contacts within their balls and chords.

    The least weighted sum of squares of what is left, against what would be allowed.
    """
    heavy = [contact.placed / contact.radius**2 for contact in contacts]
    light = [contact.faced / contact.chord**2 for contact in contacts]
    total = sum(heavy, ca.SX(1e-300))
    there = sum((w * c.target for w, c in zip(heavy, contacts, strict=True)), ca.SX(3, 1)) / total
    here = sum((w * c.point for w, c in zip(heavy, contacts, strict=True)), ca.SX(3, 1)) / total
    S, size, allowed = ca.SX(3, 3), ca.SX(1e-300), ca.SX(0)
    for w, v, contact in zip(heavy, light, contacts, strict=True):
        x, y = contact.point - here, contact.target - there
        S += w * (x @ y.T) + v * (contact.normal @ contact.facing.T)
        size += w * (ca.sumsqr(x) + ca.sumsqr(y)) + 2 * v
        allowed += contact.placed + contact.faced
    least = size - 2 * largest_trace(S, size / 2)
    return (least - ROUNDING * size) / ca.fmax(allowed, 1.0) - 1


def _determinant(M: Expr) -> Expr:
    """By minors of the first rows, with few operations."""
    if M.shape[0] == 3:
        return (
            M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
            - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
            + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
        )

    def minor(rows: tuple[int, int], a: int, b: int) -> Expr:
        return M[rows[0], a] * M[rows[1], b] - M[rows[0], b] * M[rows[1], a]

    top, low = (0, 1), (2, 3)
    return (
        minor(top, 0, 1) * minor(low, 2, 3)
        - minor(top, 0, 2) * minor(low, 1, 3)
        + minor(top, 0, 3) * minor(low, 1, 2)
        + minor(top, 1, 2) * minor(low, 0, 3)
        - minor(top, 1, 3) * minor(low, 0, 2)
        + minor(top, 2, 3) * minor(low, 0, 1)
    )
