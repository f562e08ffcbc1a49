"""Every arm of `PassingArm` at a position of its swept joint: all roots on all branches.

On a branch the condition is looked at all around the last joint's turn, and between each two of
these places where a parabola is highest or lowest, since two roots may be near each other; where it
changes its sign there is a root. What is lost are two arms near each other at the edge of reach,
where the condition has a kink.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.symbolic.closed_arms.form import SIGNS
from casadi_ik.symbolic.closed_arms.passing import ROOTS, PassingArm
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.subexpressions import shared

PLACES = 40
"""Turns of the last joint looked at."""

STEPS = 20
"""From there to the root."""

CLOSED = 1e-9
"""What they may leave of the condition [rad]."""

TINY = 1e-300

EDGE = 0.01
"""Nearer to a place, as a part of the way to the next, it is not looked at again."""


def passing_at(form: PassingArm) -> ca.Function:
    """The arms at a position of the swept joint, as `arm_branches.form_at`.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], position [rad]) -> configurations (8 `ROOTS`, n) [rad],
        `ROOTS` rows for each of `closed_arms.form.SIGNS`, and the slack of each: negative where
        there is no root.
    """
    rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
    position = ca.MX.sym("position")
    left_rotation, left_origin, *_ = form.begin()(rotation, origin, position)
    on_branch = _on_branch(form)
    arms, slacks = [], []
    for signs in SIGNS:
        found, slack = on_branch(left_rotation, left_origin, *signs)
        arms += [form.whole(found[i, :], position).T for i in range(ROOTS)]
        slacks.append(slack)
    inputs = [rotation, origin, position]
    return ca.Function("form_at", inputs, [ca.vertcat(*arms), ca.vertcat(*slacks)])


def _on_branch(form: PassingArm) -> ca.Function:
    """(rotation, origin, three signs) -> six joints of every root (`ROOTS`, 6), the slack."""
    rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
    signs = [ca.MX.sym("sign") for _ in range(3)]
    at, turned, narrowed = form.branch(), form.turned(), _narrowed()
    step, between = 2 * np.pi / PLACES, _between()
    first = [form.middle + step * i for i in range(PLACES)]
    around = [turned(rotation, origin, place, *signs) for place in first]
    places, lefts = [], []
    for i, place in enumerate(first):
        part = between(*(around[(i + k) % PLACES] for k in (-1, 0, 1, 2)))
        places += [ca.MX(place), place + step * part]
        lefts += [around[i], turned(rotation, origin, places[-1], *signs)]
    begins = _changes()(*places, *lefts)
    arms, slacks = [], []
    for root in range(ROOTS):
        *bracket, t, is_root = begins[6 * root : 6 * root + 6]
        for _ in range(STEPS):
            *bracket, t = narrowed(*bracket, t, turned(rotation, origin, t, *signs))
        arm, slack, left = at(rotation, origin, t, *signs)
        arms.append(arm.T)
        slacks.append(_known(slack, left, is_root))
    outputs = [ca.vertcat(*arms), ca.vertcat(*slacks)]
    return ca.Function("on_branch", [rotation, origin, *signs], outputs)


def _between() -> ca.Function:
    """(what is left at four places) -> the part of the way from the second to the third.

    Where a parabola through three of them is highest or lowest, if that is between the two.
    """
    before, here, there, behind = given = [ca.SX.sym("left") for _ in range(4)]
    part: Expr = ca.SX(0.5)
    for one, middle, other, start in ((here, there, behind, 1.0), (before, here, there, 0.0)):
        bent, rise = one + other - 2 * middle, other - one
        straight = ca.fabs(bent) < TINY
        at = start - ca.if_else(straight, 0.0, rise / (2 * ca.if_else(straight, 1.0, bent)))
        part = ca.if_else(ca.logic_and(at > EDGE, at < 1 - EDGE), at, part)
    return ca.Function("between", given, shared(part))


def _changes() -> ca.Function:
    """(places ..., what is left at every place ...) -> six numbers for every root.

    The place before it and what is left there, the place behind it likewise, where a line between
    them is zero, and whether there is a root at all.
    """
    places = [ca.SX.sym("place") for _ in range(2 * PLACES)]
    left = [ca.SX.sym("left") for _ in places]
    passed: Expr = ca.SX(0)
    found = [[ca.SX(0) for _ in range(6)] for _ in range(ROOTS)]
    for i, place in enumerate(places):
        behind = places[i + 1] if i + 1 < len(places) else places[0] + 2 * np.pi
        here, there = left[i], left[(i + 1) % len(places)]
        changes = ca.logic_and(here * there <= 0, ca.fabs(there - here) < np.pi)
        values = (place, here, behind, there, _zero(place, here, behind, there), 1.0)
        for root in range(ROOTS):
            taken = ca.logic_and(changes, passed == root)
            found[root] = [
                ca.if_else(taken, value, old)
                for value, old in zip(values, found[root], strict=True)
            ]
        passed = passed + changes
    outputs = [value for each in found for value in each]
    return ca.Function("changes", [*places, *left], shared(*outputs))


def _zero(one: Expr, left: Expr, other: Expr, there: Expr) -> Expr:
    """Where a line is zero; the middle where it is level."""
    rise = there - left
    level = ca.fabs(rise) < TINY
    part = ca.if_else(level, 0.5, -left / ca.if_else(level, 1.0, rise))
    return one + part * (other - one)


def _narrowed() -> ca.Function:
    """A step of Anderson and Bjorck's (1973) method: secants that keep the root between two places.

    Returns:
        (one place, what is left there, the other, what is left there, t, what is left at it) ->
        the first four and t anew.
    """
    one, left, other, there, t, at = given = [ca.SX.sym("value") for _ in range(6)]
    crossed = at * there <= 0
    ratio = 1 - at / ca.if_else(ca.fabs(there) < TINY, 1.0, there)
    weight = ca.if_else(ratio > 0, ratio, 0.5)
    start = ca.if_else(crossed, other, one)
    left_there = ca.if_else(crossed, there, weight * left)
    outputs = [start, left_there, t, at, _zero(start, left_there, t, at)]
    return ca.Function("narrowed", given, shared(*outputs))


def _known(slack: Expr, left: Expr, is_root: Expr) -> Expr:
    """The slack of a root, negative where there is none."""
    given = [ca.SX.sym(name) for name in ("slack", "left", "is_root")]
    within, rest, known = given
    closed = ca.logic_and(known > 0, ca.fabs(rest) <= CLOSED)
    output = ca.if_else(closed, within, ca.fmin(within, -1.0))
    known_slack: Expr = ca.Function("known", given, [output])(slack, left, is_root)
    return known_slack
