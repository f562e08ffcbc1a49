"""One damped Gauss-Newton step for a least-squares problem with simple bounds.

The step solves ``min |r + J s|^2 + damping |s|^2`` with the bounded coordinates kept between their
bounds. The coordinates without bounds are eliminated first; what is left is a small quadratic
problem in a box, whose active set is corrected in a few passes (primal-dual active set method,
Hintermueller, Ito & Kunisch 2002): a coordinate that leaves its box is held at the bound it passed,
one that is held against its will is let go. Every pass costs one small factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.symbolic.linear_algebra import PIVOT_FLOOR, solve_spd
from casadi_ik.symbolic.smooth import Expr


@dataclass(frozen=True, eq=False)
class Bounded:
    """Bounds of the last coordinates of a problem.

    Attributes:
        value: (k, 1) where the coordinates are.
        lower: (k, 1).
        upper: (k, 1).
        first: How many coordinates without bounds come before them.
    """

    value: Expr
    lower: Expr
    upper: Expr
    first: int


@dataclass(frozen=True, eq=False)
class DampedStep:
    """A step and what the linear model promises of it.

    Attributes:
        step: (n, 1).
        promised: By how much ``|r + J s|^2`` falls.
    """

    step: Expr
    promised: Expr


def damped_step(
    jacobian: Expr, residual: Expr, damping: Expr, bounded: Bounded, passes: int
) -> DampedStep:
    """Levenberg-Marquardt step within the bounds.

    Args:
        jacobian: (m, n), structurally sparse if possible.
        residual: (m, 1).
        damping: Scalar added to the diagonal of J'J.
        bounded: The bounded coordinates, the last ones.
        passes: Corrections of the active set, at least one.

    Returns:
        The step; value + step is within the bounds, to rounding.
    """
    n, first = jacobian.shape[1], bounded.first
    gradient = ca.densify(jacobian.T @ residual)
    damped = ca.densify(jacobian.T @ jacobian) + damping * ca.DM.eye(n)
    rows = _eliminate(damped, gradient, first)
    reduced = ca.vertcat(*(ca.horzcat(*row[first:n]) for row in rows[first:]))
    slope = ca.vertcat(*(row[n] for row in rows[first:]))
    low, high = bounded.lower - bounded.value, bounded.upper - bounded.value
    step = list(ca.vertsplit(_in_box(reduced, slope, low, high, passes)))
    for j in reversed(range(first)):
        behind = sum(
            (rows[j][first + i] * s for i, s in enumerate(step[first - j - 1 :])), rows[j][n]
        )
        behind = behind + sum((rows[j][i] * step[i - j - 1] for i in range(j + 1, first)), ca.SX(0))
        step.insert(0, -behind / ca.fmax(rows[j][j], PIVOT_FLOOR))
    s = ca.vertcat(*step)
    change = jacobian @ s
    return DampedStep(s, -ca.dot(change, 2 * residual + change))


def _eliminate(matrix: Expr, right: Expr, count: int) -> list[list[Expr]]:
    """Rows of [matrix, right] after the first unknowns are eliminated; symmetric, upper part."""
    n = matrix.shape[0]
    rows = [[matrix[min(i, j), max(i, j)] for j in range(n)] + [right[i]] for i in range(n)]
    for j in range(count):
        inverse = 1 / ca.fmax(rows[j][j], PIVOT_FLOOR)
        for i in range(j + 1, n):
            factor = rows[j][i] * inverse
            for column in range(i, n + 1):
                rows[i][column] = rows[i][column] - factor * rows[j][column]
    for i in range(n):
        for j in range(i):
            rows[i][j] = rows[j][i]
    return rows


def _in_box(matrix: Expr, slope: Expr, low: Expr, high: Expr, passes: int) -> Expr:
    """Minimiser of x' M x / 2 + slope' x in a box that holds the origin."""
    at_low = ca.logic_and(low >= 0, slope > 0)
    at_high = ca.logic_and(high <= 0, slope < 0)
    x = ca.SX.zeros(*slope.shape)
    for number in range(passes):
        held = ca.logic_or(at_low, at_high)
        x = _solve_held(matrix, slope, held, ca.if_else(at_low, low, high))
        if number == passes - 1:
            break
        force = matrix @ x + slope
        at_low = ca.if_else(held, ca.logic_and(at_low, force > 0), x < low)
        at_high = ca.if_else(held, ca.logic_and(at_high, force < 0), x > high)
    return ca.fmin(ca.fmax(x, low), high)


def _solve_held(matrix: Expr, slope: Expr, held: Expr, values: Expr) -> Expr:
    """Minimiser of the quadratic with some coordinates held at given values."""
    free, fixed = 1 - held, held * values
    masked = matrix * (free @ free.T) + ca.diag(held)
    right = -free * (slope + matrix @ fixed)
    return solve_spd(ca.densify(masked), ca.densify(right)) * free + fixed


def clip(value: Expr, bounded: Bounded) -> Expr:
    """Value moved into the bounds."""
    return ca.fmin(ca.fmax(value, bounded.lower), bounded.upper)
