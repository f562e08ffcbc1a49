"""Turns about constant axes that bring a point to a height, or one direction to another.

The subproblems 1 and 4 of Paden and Kahan, as IK-Geo numbers them (Elias and Wen 2022), with turns
as cosine and sine so that what follows from them needs no more of either. Out of reach the nearest
turn is given, and where an axis passes through the point, none: nothing is ever NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.symbolic.kinematics import sparse
from casadi_ik.symbolic.smooth import Expr

TINY = 1e-24
"""Squared length below which a vector has no direction."""

TINIEST = TINY * TINY
"""Likewise of a product of two vectors: of those that are longer each has one."""


@dataclass(frozen=True, eq=False)
class Turn:
    """An angle by its cosine and sine."""

    cosine: Expr
    sine: Expr

    @property
    def angle(self) -> Expr:
        """In [-pi, pi] [rad]."""
        return ca.atan2(self.sine, self.cosine)

    @property
    def back(self) -> Turn:
        """The opposite turn."""
        return Turn(self.cosine, -self.sine)

    def plus(self, other: Turn) -> Turn:
        """Both turns, one after the other."""
        return Turn(
            self.cosine * other.cosine - self.sine * other.sine,
            self.sine * other.cosine + self.cosine * other.sine,
        )

    def or_other(self, first: Expr, other: Turn) -> Turn:
        """This one where a condition holds, else another."""
        if isinstance(first, bool):
            return self if first else other
        cosine = ca.if_else(first, self.cosine, other.cosine)
        return Turn(cosine, ca.if_else(first, self.sine, other.sine))

    def about(self, axis: Array) -> Expr:
        """As a rotation (3, 3) about a constant unit axis (3,)."""
        outer = np.outer(axis, axis)
        x, y, z = axis
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return (
            ca.SX(sparse(outer))
            + ca.SX(sparse(np.eye(3) - outer)) * self.cosine
            + ca.SX(sparse(across)) * self.sine
        )


def turn(cosine: Expr, sine: Expr) -> Turn:
    """The turn towards a direction of any length; none where it has no length."""
    squared = cosine * cosine + sine * sine
    scale = 1 / ca.sqrt(ca.fmax(squared, TINIEST))
    known = squared > TINIEST
    return Turn(ca.if_else(known, cosine * scale, 1.0), ca.if_else(known, sine * scale, 0.0))


def subproblem_4(cosine: Expr, sine: Expr, height: Expr) -> tuple[Turn, Turn, Expr]:
    """Both turns t with ``cosine cos(t) + sine sin(t) = height``.

    Returns:
        The turns, and the slack: one less the squared part of the largest height that is asked
        for, negative if that is too much.
    """
    squared = cosine * cosine + sine * sine
    safe = ca.fmax(squared, TINY)
    slack = 1 - height * height / safe
    root = ca.sqrt(ca.fmax(squared - height * height, 0.0))
    # Too high or too low: towards where it is highest or lowest.
    length = ca.sqrt(safe)
    within = ca.fmin(ca.fmax(height, -length), length)
    known = squared > TINY
    found = [
        Turn(
            ca.if_else(known, (cosine * within - sine * side) / safe, 1.0),
            ca.if_else(known, (sine * within + cosine * side) / safe, 0.0),
        )
        for side in (root, -root)
    ]
    return found[0], found[1], slack


def subproblem_1(axis: Array, start: Expr, end: Expr) -> Turn:
    """The turn about a constant unit axis that brings one vector nearest to another."""
    a = ca.DM(axis)
    along = ca.dot(a, start) * ca.dot(a, end)
    return turn(ca.dot(start, end) - along, ca.dot(a, ca.cross(start, end)))


def about_axis(axis: Array, vector: Expr) -> tuple[Expr, Expr, Expr]:
    """A vector as what a turn about a constant unit axis does to it.

    Returns:
        ``constant``, ``cosine``, ``sine`` (3, 1) each: turned by t the vector is
        ``constant + cosine cos(t) + sine sin(t)``.
    """
    a = ca.SX(sparse(axis.reshape(3, 1)))
    constant = a * ca.dot(a, vector)
    return constant, vector - constant, ca.cross(a, vector)
