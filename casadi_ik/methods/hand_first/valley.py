"""The direction in which a hand moves while its contacts hardly do: along a long valley.

A graph, so that it gives the same bits wherever it runs: in a batch, alone, in an exported solver.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.kernels import FunctionGraph
from casadi_ik.kernels.recipe import recipe
from casadi_ik.symbolic.linear_algebra import solve_spd
from casadi_ik.symbolic.smooth import Expr

FLAT = 1e-12
"""Squared slope below which directions are alike."""

DEPENDENT = 1e-9
"""Part of a column that must be left for it to be a direction of its own."""

SQUARINGS = 7
"""Of the inverse: the flattest direction then counts (ratio of squared slopes)^128 times."""


def valley(rows: int, hand: int) -> FunctionGraph:
    """The flattest direction of a hand.

    Args:
        rows: How many numbers the contacts have.
        hand: How many motors the hand has.

    Returns:
        slopes (6, rows) of the contacts as the palm moves as a whole, zero for a palm that cannot;
        slopes (hand, rows) as the motors do; what holds each motor (hand, 1), squared -> (hand, 1)
        motion of the motors, 1 for the one that moves most.
    """
    name = f"valley_{rows}_{hand}"
    inputs = {"rigid": (6, rows), "slopes": (hand, rows), "held": (hand, 1)}
    return FunctionGraph(name, lambda: _build(name, rows, hand), inputs, ((hand, 1),), recipe(name))


def _build(name: str, rows: int, hand: int) -> ca.Function:
    """As operations on whole matrices: unrolled they would be tens of thousands."""
    rigid, given = ca.MX.sym("rigid", 6, rows), ca.MX.sym("slopes", hand, rows)
    held, slopes = ca.MX.sym("held", hand), given.T
    if not hand:  # a tool
        return ca.Function(name, [rigid, given, held], [ca.MX(0, 1)])
    # The palm follows as well as it can: what is left of a motor's motion counts.
    for base in _orthonormal(rigid.T):
        slopes = slopes - base @ (base.T @ slopes)
    inverse = _inverse(hand)(slopes.T @ slopes + ca.diag(held + FLAT))
    # With every squaring the largest eigenvalue stands out twice as much.
    for _ in range(SQUARINGS):
        inverse = inverse / ca.trace(inverse)
        inverse = inverse @ inverse
    # Any vector that no symmetry of a hand makes orthogonal to the direction.
    first = ca.DM((1 + np.arange(hand) * 0.6180339887 % 1.0).tolist())
    direction = inverse @ first
    motion = direction / ca.norm_inf(direction)
    return ca.Function(name, [rigid, given, held], [ca.densify(motion)])


def _inverse(n: int) -> ca.Function:
    """(n, n) -> its inverse, of a symmetric positive definite matrix."""
    a, b = ca.SX.sym("a", n, n), ca.SX.sym("b", n)
    one = ca.Function("one", [a, b], [solve_spd(a, b)])
    matrix = ca.MX.sym("matrix", n, n)
    columns = ca.MX(ca.DM.eye(n))
    return ca.Function(
        "inverse", [matrix], [one.map("columns", "serial", n, [0], [])(matrix, ca.densify(columns))]
    )


def _orthonormal(columns: Expr) -> list[Expr]:
    """Orthonormal columns that span the same, zero for one that depends on those before."""
    found: list[Expr] = []
    for i in range(columns.shape[1]):
        column = columns[:, i]
        whole = ca.norm_2(column)
        for base in found:
            column = column - base * ca.dot(base, column)
        left = ca.norm_2(column)
        own = left > DEPENDENT * whole
        found.append(column * ca.if_else(own, 1 / ca.if_else(own, left, 1.0), 0.0))
    return found
