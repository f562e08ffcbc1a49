"""One damped Gauss-Newton step for a least-squares problem with simple bounds.

The step solves ``min |r + J s|^2 + damping |s|^2`` with the bounded coordinates kept between their
bounds: a small quadratic problem in a box, whose active set is corrected in a few passes
(primal-dual active set method, Hintermueller, Ito & Kunisch 2002). A coordinate that leaves its box
is held at the bound it passed, one that is held against its will is let go. Every pass costs one
small factorisation.

What is structurally zero costs nothing: fingers share no more than the palm and what drives several
of them, so in the right order (`elimination`) code and time grow with the number of fingers, where
those of dense matrices grow with the cube of the number of motors.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.common.elimination import elimination
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
    gradient = ca.densify(jacobian.T @ residual)
    normal = ca.sparsify(jacobian.T @ jacobian) + damping * ca.DM.eye(jacobian.shape[1])
    low, high = bounded.lower - bounded.value, bounded.upper - bounded.value
    step = in_box(normal, gradient, low, high, passes)
    change = jacobian @ step
    return DampedStep(step, -ca.dot(change, 2 * residual + change))


def in_box(matrix: Expr, slope: Expr, low: Expr, high: Expr, passes: int) -> Expr:
    """Minimiser of x' M x / 2 + slope' x, the last coordinates in a box that holds the origin.

    Args:
        matrix: (n, n) symmetric positive definite; only its upper triangle is read.
        slope: (n, 1).
        low: (k, 1) lower ends of the box, <= 0.
        high: (k, 1) upper ends, >= 0.
        passes: Corrections of the active set, at least one.
    """
    first = slope.numel() - low.numel()
    order = elimination(matrix.sparsity(), first, passes)
    begun = order.begun(matrix, slope)
    force = ca.vertcat(*order.resting(begun))
    at_low = ca.logic_and(low >= 0, force > 0)
    at_high = ca.logic_and(high <= 0, force < 0)
    bounded = range(first, slope.numel())
    inside = low
    for number in range(passes):
        held = ca.logic_or(at_low, at_high)
        x = order.solved(begun, held, held * ca.if_else(at_low, low, high))
        inside = ca.vertcat(*(x[i] for i in bounded))
        if number == passes - 1:
            break
        force = ca.vertcat(*order.forces(begun, x))
        at_low = ca.if_else(held, ca.logic_and(at_low, force > 0), inside < low)
        at_high = ca.if_else(held, ca.logic_and(at_high, force < 0), inside > high)
    inside = ca.fmin(ca.fmax(inside, low), high)
    return order.completed(begun, dict(zip(bounded, ca.vertsplit(inside), strict=True)))


def clip(value: Expr, bounded: Bounded) -> Expr:
    """Value moved into the bounds."""
    return ca.fmin(ca.fmax(value, bounded.lower), bounded.upper)
