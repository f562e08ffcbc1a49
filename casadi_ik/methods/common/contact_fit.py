"""Contacts as a least-squares problem, and when a fit of them is at its end.

A step is judged by what it made of the cost. The damping follows the ratio of what was gained to
what the linear model promised (Nielsen 1999: Damping parameter in Marquardt's method).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from casadi_ik.problem.contacts import ContactRows, chord, within_tolerance
from casadi_ik.symbolic.smooth import Expr

DAMPING_START = 1e-3
DAMPING_FLOOR = 1e-12
"""Damping [-] of the normal matrix; the rows are of order one per radian and 0.1 m."""

DAMPING_CEILING = 1e4
"""Damping at which a step that gains nothing shows that nothing is to be gained."""

DAMPING_DOWN = 1 / 8
"""Smallest factor of the damping after a step that gained."""

GROWTH_START = 4.0
"""Factor of the damping after a step that gained nothing; it doubles with every such step."""

SLOW = 0.9
"""A step that leaves more than this part of the cost gained little."""

QUADRATIC = 0.1
"""A step that leaves less than this part is converging fast: worth another one."""

PATIENCE, BUDGET = 3, 15
"""Evaluations with little gain, and evaluations in all, before a fit is given up."""

PROMISING = 1e-3
"""Cost below which a fit is close enough to be worth `PERSISTENCE` times as much."""

PERSISTENCE = 10

EXACT = 1e-8
"""Root of the cost at which contacts count as met exactly (0.1 nm per 100 mm, or rad)."""

FINE = 1e-3
"""Part of the tolerance that is as good as exact."""


@dataclass(frozen=True, eq=False)
class Tried:
    """A damped step that was tried.

    Attributes:
        reached: Where it leads: whatever the stage's unknowns are.
        before: Residual before.
        there: Residual there.
        promised: By how much the linear model says the cost falls.
        size: Largest change of a motor.
    """

    reached: Any
    before: Expr
    there: Expr
    promised: Expr
    size: Expr


@dataclass(frozen=True, eq=False)
class Judged:
    """A damped step after it was judged by its cost; `fit` goes into the state."""

    accepted: Expr
    within: Expr
    settled: Expr
    cost: Expr
    fit: dict[str, Expr]


def judge_contacts(
    s: dict[str, Expr], p: dict[str, Expr], tried: Tried, rows: ContactRows, part: float = 1.0
) -> Judged:
    """Judge a step by the contacts, its residuals those of `rows`; see `judge`.

    Args:
        s: State.
        p: Parameters.
        tried: The step.
        rows: The contacts.
        part: Of the tolerances; what is within that is within them.
    """
    residual = ca.if_else(gains(tried), tried.there, tried.before)
    positions, chords = rows.errors(residual)
    tolerances = part * p["position_tolerance"], part * chord(p["angle_tolerance"])
    exact = within_tolerance(positions / FINE, chords / FINE, *tolerances)
    return judge(s, tried, within_tolerance(positions, chords, *tolerances), exact)


def gains(tried: Tried) -> Expr:
    """Whether the step lowers the cost."""
    return ca.sumsqr(tried.there) < ca.sumsqr(tried.before)


def judge(s: dict[str, Expr], tried: Tried, within: Expr, exact: Expr) -> Judged:
    """Accept a step that lowers the cost, and decide whether the fit is at its end.

    Args:
        s: State.
        tried: The step.
        within: Whether what is left of the residual after it is good enough to stop at, should
            it fall slowly.
        exact: Whether it is so good that nothing more is to be gained.
    """
    cost_before, cost_there = ca.sumsqr(tried.before), ca.sumsqr(tried.there)
    accepted = gains(tried)
    cost = ca.if_else(accepted, cost_there, cost_before)
    left = cost / ca.fmax(cost_before, 1e-300)
    waited = ca.if_else(left > SLOW, s["waited"] + 1, 0.0)
    spent = s["spent"] + 1
    worth = ca.if_else(cost < PROMISING, float(PERSISTENCE), 1.0)
    over = ca.logic_or(waited >= PATIENCE * worth, spent >= BUDGET * worth)
    stuck = ca.logic_and(ca.logic_not(accepted), s["damping"] > DAMPING_CEILING)
    over = ca.logic_or(over, stuck)
    slowing = ca.logic_and(within, left > QUADRATIC)
    kept = (cost_before - cost_there) / ca.fmax(tried.promised, 1e-300)
    bent = 2 * kept - 1
    factor = ca.if_else(accepted, ca.fmax(DAMPING_DOWN, 1 - bent * bent * bent), s["growth"])
    settled = ca.logic_or(ca.logic_or(exact, cost < EXACT * EXACT), ca.logic_or(over, slowing))
    fit = fresh_fit() | {
        "damping": ca.fmax(s["damping"] * factor, DAMPING_FLOOR),
        "growth": ca.if_else(accepted, GROWTH_START, 2 * s["growth"]),
        "waited": waited,
        "spent": spent,
    }
    fit = {name: ca.if_else(settled, fresh_fit()[name], fit[name]) for name in fit}
    return Judged(accepted, within, settled, cost, fit | {"cost": cost})


def fresh_fit() -> dict[str, float]:
    """Counters and damping of a fit that begins."""
    return {"damping": DAMPING_START, "growth": GROWTH_START, "waited": 0.0, "spent": 0.0}
