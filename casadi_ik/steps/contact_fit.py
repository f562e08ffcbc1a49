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
    """Levenberg-Marquardt step for ``|residual + jacobian step|^2`` (n, 1).

    Args:
        jacobian: (m, n), structurally sparse if possible.
        residual: (m, 1).
        damping: Scalar added to the diagonal of J'J.
        bounded: The bounded coordinates, from column `bounded.first` on.
    """
    n = jacobian.shape[1]
    gradient = ca.densify(jacobian.T @ residual)
    outwards = blocked(gradient[bounded.first :], bounded)
    free = ca.vertcat(ca.SX.ones(bounded.first, 1), 1 - outwards)
    normal = ca.densify(jacobian.T @ jacobian)
    masked = normal * (free @ free.T)
    diagonal = ca.diag((1 - free) + damping * ca.SX.ones(n, 1))
    return solve_spd(ca.densify(masked + diagonal), -free * gradient)


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
