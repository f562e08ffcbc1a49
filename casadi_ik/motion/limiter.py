"""Motors on their way to a moving goal: as fast as velocities, accelerations and limits permit.

Lengths are steps: a velocity is counted as the way of one cycle, an acceleration as what a step may
differ from the one before. A motor whose steps shrink by ``change`` each stops after

    w + (w - c) + (w - 2 c) + ...        (w its step, c the change)

so the longest step from which it can stop within a distance follows in closed form (`brake`). It is
asked twice: to come to rest at the goal, relative to the goal's own motion, and at the limits,
whatever the goal does. A step that keeps the second can be followed by one that does too, so the
bounds below are never empty.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.smooth import Expr


def brake(distance: Expr, change: Expr) -> Expr:
    """The longest step now from which a motor can stop within a distance.

    Args:
        distance: (n, 1) >= 0.
        change: (n, 1) > 0 by how much steps may shrink.

    Returns:
        (n, 1); with u = distance / change and N the number of steps that follow, of which
        N (N + 1) / 2 <= u: change (u + N (N + 1) / 2) / (N + 1).
    """
    u = distance / change
    after = ca.floor((ca.sqrt(1 + 8 * u) - 1) / 2)
    return change * (u + after * (after + 1) / 2) / (after + 1)


SPARE = 0.7
"""Part of the acceleration that motors count on to come to rest at their goal: the rest is for what
the goal itself does meanwhile."""


TINY = 1e-15
"""Ways and rooms shorter than this are none [rad or m]."""


def step_bounds(s: dict[str, Expr], p: dict[str, Expr]) -> tuple[Expr, Expr]:
    """Least and largest step of the motors, (n, 1) each.

    Args:
        s: "q", "moved".
        p: "lower", "upper", "fastest", "change".
    """
    fastest, change = p["fastest"], p["change"]
    low = ca.fmax(-fastest, s["moved"] - change)
    low = ca.fmax(low, -brake(ca.fmax(s["q"] - p["lower"], 0.0), change))
    high = ca.fmin(fastest, s["moved"] + change)
    high = ca.fmin(high, brake(ca.fmax(p["upper"] - s["q"], 0.0), change))
    # Rounding may leave them a hair past each other.
    return ca.fmin(low, high), high


def share_within(start: Expr, end: Expr, low: Expr, high: Expr) -> Expr:
    """As far from a place towards another as bounds permit, (n, 1): all motors the same share.

    Args:
        start: (n, 1) within the bounds.
        end: (n, 1).
        low: (n, 1).
        high: (n, 1).
    """
    way = end - start
    room = ca.if_else(way > 0, high - start, start - low)
    length = ca.fmax(ca.fabs(way), TINY)
    share = ca.fmin(1.0, ca.mmin((room + TINY) / length))
    return ca.fmin(ca.fmax(start + share * way, low), high)


def chased(s: dict[str, Expr], goal: Expr, drawn: Expr, p: dict[str, Expr]) -> Expr:
    """Where motors are after the cycle that run after a goal, (n, 1).

    Args:
        s: "q", "moved".
        goal: (n, 1) where they are to go.
        drawn: (n, 1) the goal's own motion that they may count on.
        p: "lower", "upper", "fastest", "change".
    """
    left = goal - s["q"] - drawn
    wanted = drawn + ca.sign(left) * brake(ca.fabs(left), SPARE * p["change"])
    low, high = step_bounds(s, p)
    q = s["q"] + ca.fmin(ca.fmax(wanted, low), high)
    return ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
