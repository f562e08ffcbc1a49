"""Contacts as a least-squares problem with simple bounds, and one damped step of it.

The step is Levenberg-Marquardt on the free coordinates: one at a bound whose gradient points
outwards is left where it is. What a step leads to is clipped to the bounds and judged by its cost
there, so the iterates never leave them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.symbolic.linear_algebra import solve_spd
from casadi_ik.symbolic.smooth import Expr

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like the normals' (unit vectors)."""

DAMPING_START = 1e-3
DAMPING_DOWN = 1 / 8
DAMPING_UP = 8.0
DAMPING_FLOOR = 1e-9
"""Damping [-] of the normal matrix; the rows are of order one per radian and 0.1 m."""


@dataclass(frozen=True, eq=False)
class Bounded:
    """Bounds of some of the coordinates: value, lower and upper (k, 1); and where they start."""

    value: Expr
    lower: Expr
    upper: Expr
    first: int

    @property
    def slack(self) -> Expr:
        """How close to a bound counts as standing there (k, 1)."""
        return 1e-9 * (1 + ca.fabs(self.value))


def damped_step(jacobian: Expr, residual: Expr, damping: Expr, bounded: Bounded) -> Expr:
    """Levenberg-Marquardt step for ``|residual + jacobian step|^2`` within the bounds (n, 1).

    Two passes of an active set: what the free step carries beyond a bound is held at that bound,
    and the others are solved for again.

    Args:
        jacobian: (m, n), structurally sparse if possible.
        residual: (m, 1).
        damping: Scalar added to the diagonal of J'J.
        bounded: The bounded coordinates, from column `bounded.first` on.
    """
    n, first = jacobian.shape[1], bounded.first
    gradient = ca.densify(jacobian.T @ residual)
    normal = ca.densify(jacobian.T @ jacobian + damping * ca.DM.eye(n))
    nowhere = ca.SX.zeros(n, 1)
    held = ca.vertcat(ca.SX.zeros(first, 1), blocked(gradient[first:], bounded))
    step = _step_with(normal, gradient, held, nowhere)
    inside = clip(bounded.value + step[first:], bounded) - bounded.value
    beyond = ca.fabs(inside - step[first:]) > 0
    again = ca.vertcat(ca.SX.zeros(first, 1), ca.logic_or(held[first:], beyond))
    return _step_with(normal, gradient, again, ca.vertcat(ca.SX.zeros(first, 1), inside))


def _step_with(normal: Expr, gradient: Expr, held: Expr, values: Expr) -> Expr:
    """Minimiser of the quadratic with some coordinates held at given steps."""
    free, fixed = 1 - held, held * values
    masked = normal * (free @ free.T) + ca.diag(held)
    right = -free * (gradient + normal @ fixed)
    return solve_spd(ca.densify(masked), ca.densify(right)) * free + fixed


def blocked(gradient: Expr, bounded: Bounded) -> Expr:
    """1 for every bounded coordinate at a bound whose descent points outwards (k, 1)."""
    at_lower = ca.logic_and(bounded.value <= bounded.lower + bounded.slack, gradient > 0)
    at_upper = ca.logic_and(bounded.value >= bounded.upper - bounded.slack, gradient < 0)
    return ca.logic_or(at_lower, at_upper)


def clip(value: Expr, bounded: Bounded) -> Expr:
    """Value moved into the bounds."""
    return ca.fmin(ca.fmax(value, bounded.lower), bounded.upper)


def weighted_residual(position: Sequence[Expr], normal: Sequence[Expr], weights: Expr) -> Expr:
    """Residual (6 f, 1) of all contacts: positions by `LENGTH`, then normals.

    Args:
        position: Per finger (3, k) rows in metres (an error, or its Jacobian).
        normal: Per finger (3, k) rows.
        weights: (f, 2) 1 where the contact (its normal) counts, 0 where it is free.
    """
    rows = [position[i] / LENGTH * weights[i, 0] for i in range(len(position))]
    rows += [normal[i] * weights[i, 1] for i in range(len(normal))]
    return ca.vertcat(*rows)
