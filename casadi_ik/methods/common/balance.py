"""Balancing contacts that are nearly met: the largest error by its tolerance is brought down.

Least squares shares the errors out as the residual's units have it; where contacts contradict each
other a little (measured ones always do) one of them may then be beyond its tolerance while others
have room to spare. What has to fall is the largest part: with ``part_i = error_i / tolerance_i``
the sum of ``part_i^power``, for powers that grow towards the maximum. One step is Newton's on that
sum, without the curvature of the hand, damped and within bounds: least squares with weights
``part_i^(power - 2)`` (Lawson's way to the smallest maximum), whose rows along the errors count
``power - 1`` times, so that it does not oscillate as reweighting alone does.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.common.contact_fit import Tried
from casadi_ik.problem.contacts import LENGTH, ContactRows, chord, within_tolerance
from casadi_ik.symbolic.smooth import Expr

POWERS = (4.0, 10.0, 24.0, 60.0, 150.0, 400.0)
"""Powers in turn."""

NEAR = 2.0
"""A fit that misses the tolerances by no more than this factor is worth balancing."""

SAME = 1e-2
"""Relative difference of cost below which a fit counts as one that was balanced before."""

STEADY = 0.95
"""A step that leaves more than this part of the sum ends a power."""

HOPELESS = 1.05
"""Were all parts at most so large, the sum would be at most their number times this to the power:
one that is steady above that says that the contacts cannot be met near here."""

CLOSER = 0.99
"""A balance that leaves no less than this part of the least that others left is one of them."""

BUDGET = 60
"""Steps in all."""

DAMPING = 100.0
"""The rows are errors by tolerances: their damping is that of a fit, times this."""

EASED, TIGHTENED = 1 / 8, 4.0
"""Factors of the damping after a step that gained and after one that did not."""

DAMPING_FLOOR, DAMPING_CEILING = 1e-8, 10.0

FARTHEST = 2.0
"""A step to parts larger than so many times the largest before is refused in any case."""

TINY = 1e-100
"""What is divided by is at least this."""


@dataclass(frozen=True, eq=False)
class Balanced:
    """A step that was tried and what comes of it.

    Attributes:
        tried: The step, with the residuals of the contacts.
        q: (n, 1) where it leads, or where it began if it gained nothing.
        accepted: Whether it gained.
        within: Whether every contact is met at q.
        over: Whether nothing more is to be hoped for.
        largest: Largest part at q.
        fit: Damping, power and steps spent, for the state.
    """

    tried: Tried
    q: Expr
    accepted: Expr
    within: Expr
    over: Expr
    largest: Expr
    fit: dict[str, Expr]


def near_tolerance(residual: Expr, rows: ContactRows, p: dict[str, Expr]) -> Expr:
    """Whether the contacts of a residual are met, or missed by little."""
    positions, chords = rows.errors(residual)
    tolerances = p["position_tolerance"], chord(p["angle_tolerance"])
    return within_tolerance(positions / NEAR, chords / NEAR, *tolerances)


def differs(cost: Expr, before: Expr) -> Expr:
    """Whether the cost of a fit is another than that of the fit balanced before."""
    return ca.fabs(cost - before) > SAME * before


@dataclass(frozen=True, eq=False)
class _Weighed:
    """The contacts' errors as they count for a power."""

    scaled: Expr
    parts: Expr
    largest: Expr
    power: Expr
    weights: Expr


def _weighed(before: Expr, contacts: ContactRows, number: Expr, p: dict[str, Expr]) -> _Weighed:
    """Of a residual, for the power of a number."""
    scaled = _scaled(before, contacts, p)
    parts = _lengths(scaled, contacts)
    largest = ca.fmax(ca.mmax(parts), TINY)
    power = sum((ca.if_else(number == i, value, 0.0) for i, value in enumerate(POWERS)), ca.SX(0))
    return _Weighed(scaled, parts, largest, power, (parts / largest) ** (power - 2))


def reweighted(
    before: Expr, jacobian: Expr, contacts: ContactRows, number: Expr, p: dict[str, Expr]
) -> tuple[Expr, Expr, Expr]:
    """The least squares that a step solves.

    Args:
        before: Residual (size, 1) of the contacts.
        jacobian: (size, n) its Jacobian.
        contacts: Their rows.
        number: How many of `POWERS` are done.
        p: Parameters.

    Returns:
        Residual (size, 1), Jacobian (size, n), and rows (2 f, n) that stretch it along the errors:
        further ones, whose residual is zero.
    """
    weighed = _weighed(before, contacts, number, p)
    weights, parts, scaled = weighed.weights, weighed.parts, weighed.scaled
    rows = ca.sqrt(_each(weights, contacts))
    slopes = _scaled(jacobian, contacts, p)
    stretched = [
        ca.sqrt(weights[i] * (weighed.power - 2))
        / ca.fmax(parts[i], TINY)
        * (scaled[own].T @ slopes[own, :])
        for i, own in enumerate(contacts.slices)
    ]
    return rows * scaled, rows * slopes, ca.vertcat(*stretched)


def balanced(
    value: Expr, tried: Tried, contacts: ContactRows, s: dict[str, Expr], p: dict[str, Expr]
) -> Balanced:
    """What comes of a step.

    Args:
        value: (n, 1) where it begins.
        tried: The step, with the residuals of the contacts.
        contacts: Their rows.
        s: State with damping, power (how many of `POWERS` are done) and spent.
        p: Parameters.
    """
    weighed = _weighed(tried.before, contacts, s["power"], p)
    weights, parts, largest = weighed.weights, weighed.parts, weighed.largest
    power = weighed.power
    parts_there = _lengths(_scaled(tried.there, contacts, p), contacts)
    # Bounded, since a large number to a high power is none.
    grown = ca.fmin(parts_there / largest, FARTHEST)
    total, total_there = ca.dot(weights, parts**2), ca.dot(grown ** (power - 2), parts_there**2)
    accepted = total_there < total
    left = ca.if_else(accepted, parts_there, parts)
    damping = DAMPING * s["damping"]
    steady = ca.if_else(accepted, total_there > STEADY * total, damping > DAMPING_CEILING)
    done = s["power"] + steady
    spent = s["spent"] + 1
    over = ca.logic_or(done >= len(POWERS), spent >= BUDGET)
    powers = ca.if_else(accepted, total_there, total) * largest ** (power - 2)
    hopeless = powers > len(contacts.slices) * HOPELESS**power
    over = ca.logic_or(over, ca.logic_and(steady, hopeless))
    eased = ca.if_else(accepted, EASED, TIGHTENED)
    fit = {
        "damping": ca.fmax(s["damping"] * eased, DAMPING_FLOOR),
        "power": done,
        "spent": spent,
    }
    return Balanced(
        tried=tried,
        q=ca.if_else(accepted, tried.reached, value),
        accepted=accepted,
        within=ca.mmax(left) <= 1,
        over=over,
        largest=ca.mmax(left),
        fit=fit,
    )


def _scaled(values: Expr, contacts: ContactRows, p: dict[str, Expr]) -> Expr:
    """Rows (size, k) of the contacts as parts of the tolerances."""
    allowed = ca.vertcat(p["position_tolerance"] / LENGTH, chord(p["angle_tolerance"]))
    return values / _each(ca.fmax(allowed, TINY), contacts)


def _each(values: Expr, contacts: ContactRows) -> Expr:
    """A value for each place and facing (2 f, 1) as one for each of its rows (size, 1)."""
    sizes = [own.stop - own.start for own in contacts.slices]
    return ca.vertcat(*(ca.repmat(values[i], size, 1) for i, size in enumerate(sizes)))


def _lengths(scaled: Expr, contacts: ContactRows) -> Expr:
    return ca.vertcat(*(ca.norm_2(scaled[own]) for own in contacts.slices))
