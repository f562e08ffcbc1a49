"""The best arm of `PassingArm` at a position of the swept joint.

First all branches are seen with the last joint somewhere, and each then once more with the last
joint as the ideal arm turned it: near enough for the best of them to be chosen. That one is
followed by secants to where the ideal arm is the real one but for a thousandth.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from casadi_ik.symbolic.closed_arms.passing import BENDS, CLOSED, PassingArm, next_turn
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared

SECANTS = 2
"""Steps on the branch that was chosen."""

LOOSE = 0.5
"""What may be left of the condition [rad] on the branches that one is chosen from."""

Scored = Callable[[Expr, Expr, Expr, Expr, Expr], tuple[Expr, Expr]]
"""(arm, slack, lower, upper, near) -> arm and score."""


def best_at(form: PassingArm, name: str, scored: Scored, near: bool) -> ca.Function:
    """(position, rotation, origin, lower, upper, near or t) -> the best arm (n, 1), its score.

    Args:
        form: The arm.
        name: Of the function.
        scored: How an arm is scored, and by whole turns moved.
        near: Whether the last input is an arm (n, 1) to be near to, else where the search for the
            last joint begins.
    """
    count = len(form.screws)
    position = ca.MX.sym("position")
    rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
    lower, upper = ca.MX.sym("lower", count), ca.MX.sym("upper", count)
    given = ca.MX.sym("given", count if near else 1)
    left_rotation, left_origin, plus, minus = form.begin()(rotation, origin, position)
    branch, turned, secant = form.branch(), form.turned(), next_turn()
    loose, strict = (_score(form, scored, near, most) for most in (LOOSE, CLOSED))
    first = given[form.last] if near else given
    seen = []
    for one, two in BENDS:
        signs = [plus if sign > 0 else minus for sign in (one, two)]
        left = turned(left_rotation, left_origin, first, *signs, plus)
        for end, was in zip((plus, minus), _both(left), strict=True):
            t = first + was
            arm, slack, left_then = branch(left_rotation, left_origin, t, *signs, end)
            _, reached = loose(position, arm, slack, left_then, lower, upper, given)
            seen.append((reached, *signs, end, t, left_then, first, was))
    signs_and_turns = _best(len(seen))(*(value for each in seen for value in each))
    one, two, end, t, left, before, was = signs_and_turns
    arm, slack = ca.MX(6, 1), ca.MX(1)
    for _ in range(SECANTS):
        t, before, was = secant(t, left, before, was), t, left
        arm, slack, left = branch(left_rotation, left_origin, t, one, two, end)
    found, reached = strict(position, arm, slack, left, lower, upper, given)
    return ca.Function(name, [position, rotation, origin, lower, upper, given], [found, reached])


def _both(left: Expr) -> tuple[Expr, Expr]:
    """What is left of the condition at one end and at the other, half a turn away."""
    given = ca.SX.sym("left")
    other = given + ca.if_else(given > 0, -np.pi, np.pi)
    one, two = ca.Function("both", [given], [given, other])(left)
    return one, two


def _score(form: PassingArm, scored: Scored, near: bool, most: float) -> ca.Function:
    """`scored` of six joints; more than `most` [rad] left of the condition is out of reach."""
    count = len(form.screws)
    position, arm = ca.SX.sym("position"), ca.SX.sym("arm", 6)
    slack, left = ca.SX.sym("slack"), ca.SX.sym("left")
    lower, upper = ca.SX.sym("lower", count), ca.SX.sym("upper", count)
    given = ca.SX.sym("given", count if near else 1)
    short = ca.if_else(ca.fabs(left) > most, -ca.fabs(left), np.inf)
    short = ca.fmin(short, ca.if_else(slack < 0, slack, np.inf))
    outputs = scored(form.whole(arm, position), short, lower, upper, given)
    inputs = [position, arm, slack, left, lower, upper, given]
    return ca.Function(f"scored_{'loose' if most == LOOSE else 'strict'}", inputs, shared(*outputs))


def _best(count: int) -> ca.Function:
    """Of so many rows of eight numbers the seven behind the largest first one."""
    rows = [[ca.SX.sym("value") for _ in range(8)] for _ in range(count)]
    best = rows[0]
    for row in rows[1:]:
        keep = best[0] >= row[0]
        best = [ca.if_else(keep, a, b) for a, b in zip(best, row, strict=True)]
    return ca.Function("best_branch", [value for row in rows for value in row], shared(*best[1:]))
