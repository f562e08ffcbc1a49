"""Contacts as a least-squares problem, and when a fit of them is at its end.

A step is judged by what it made of the cost. The damping follows the ratio of what was gained to
what the linear model promised (Nielsen 1999: Damping parameter in Marquardt's method).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import casadi as ca

from casadi_ik.compile.layout import Layout
from casadi_ik.kinematics.box_qp import Bounded, clip, damped_step, in_box, squares
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    chord,
    resting,
    tip_rates,
    tip_vectors,
    within_tolerance,
)
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.smooth import Expr, call_function
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True)
class FitParameters:
    """When a fit is at its end, and how it is damped.

    Attributes:
        damping: Of the normal matrix, whose rows are of order one per radian and 0.1 m.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a step that gains nothing shows that nothing is to be
            gained.
        damping_down: Smallest factor of the damping after a step that gained.
        growth: Factor of the damping after a step that gained nothing; doubles with every such
            step.
        slow: A step that leaves more than this part of the cost gained little.
        quadratic: A step that leaves less than this part is converging fast: worth another one.
        patience: Evaluations with little gain before a fit is given up.
        budget: Evaluations in all.
        promising: Cost below which a fit is close enough to be worth `persistence` times as much.
        persistence: See above.
        exact: Root of the cost at which contacts count as met exactly (0.1 nm per 100 mm, or rad).
        fine: Part of the tolerance that is as good as exact.
        passes: Corrections of the active set in a step.
    """

    damping: float = 1e-3
    damping_floor: float = 1e-12
    damping_ceiling: float = 1e4
    damping_down: float = 1 / 8
    growth: float = 4.0
    slow: float = 0.9
    quadratic: float = 0.1
    patience: int = 3
    budget: int = 15
    promising: float = 1e-3
    persistence: int = 10
    exact: float = 1e-8
    fine: float = 1e-3
    passes: int = 2


@dataclass(frozen=True)
class BalanceParameters:
    """How the largest error by its tolerance is brought down, and when that is given up.

    Attributes:
        powers: Powers in turn.
        near: A fit that misses the tolerances by no more than this factor is worth balancing.
        same: Relative difference of cost below which a fit counts as one that was balanced before.
        steady: A step that leaves more than this part of the sum ends a power.
        hopeless: Were all parts at most so large, the sum would be at most their number times this
            to the power: one that is steady above that says that the contacts cannot be met near
            here.
        closer: A balance that leaves no less than this part of the least that others left is one
            of them.
        budget: Steps in all.
        damping: The rows are errors by tolerances: their damping is that of a fit, times this.
        damping_floor: Smallest damping of a fit.
        damping_ceiling: Damping at which a power ends.
        eased: Factor of the damping after a step that gained.
        tightened: The same after one that did not.
        farthest: A step to parts larger than so many times the largest before is refused.
    """

    powers: tuple[float, ...] = (4.0, 10.0, 24.0, 60.0, 150.0, 400.0)
    near: float = 2.0
    same: float = 1e-2
    steady: float = 0.95
    hopeless: float = 1.05
    closer: float = 0.99
    budget: int = 60
    damping: float = 100.0
    damping_floor: float = 1e-8
    damping_ceiling: float = 10.0
    eased: float = 1 / 8
    tightened: float = 4.0
    farthest: float = 2.0


@dataclass(frozen=True)
class TolerantFitParameters:
    """Numbers of a fit whose residuals begin where the tolerances end.

    Attributes:
        free: Fraction of the tolerance within which an error costs nothing.
        promising: Largest `tolerance_ratio` at a minimum of the exact fit from which a tolerant fit
            starts.
        near: Largest `tolerance_ratio` at which a minimum counts as a near miss.
        patience: Evaluations with little gain before a tolerant fit is given up.
        budget: Evaluations in all.
    """

    free: float = 0.95
    promising: float = 1.0
    near: float = 2.0
    patience: int = 4
    budget: int = 40


FIT, BALANCE, TOLERANT = FitParameters(), BalanceParameters(), TolerantFitParameters()

TINY = 1e-100
"""What is divided by is no smaller."""


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


def lm_step(
    at: Callable[[Any], tuple[Expr, Expr]],
    x: Any,
    damping: Expr,
    bounds: Bounded,
    moved: Callable[[Expr], Any],
    motors: Callable[[Any], Expr] = lambda there: there,
) -> Tried:
    """One damped least-squares step within bounds: of all motors, of palm and hand, of the arm.

    Args:
        at: Residual (m, 1) and Jacobian (m, n) at a place.
        x: The place where it begins.
        damping: Scalar.
        bounds: Of the motors.
        moved: From a step (n, 1) to the place that it leads to.
        motors: (k, 1) of a place.
    """
    before, jacobian = at(x)
    damped = damped_step(jacobian, before, damping, bounds, FIT.passes)
    reached = moved(damped.step)
    change = ca.fabs(motors(reached) - bounds.value)
    # A tool has no motors that could move.
    size = ca.mmax(change) if change.numel() else ca.SX(0)
    return Tried(reached, before, at(reached)[0], damped.promised, size)


@dataclass(frozen=True, eq=False)
class Judged:
    """A damped step after it was judged by its cost; `fit` goes into the state."""

    accepted: Expr
    within: Expr
    settled: Expr
    cost: Expr
    fit: dict[str, Expr]


def judge_contacts(
    s: dict[str, Expr],
    p: dict[str, Expr],
    tried: Tried,
    rows: ContactRows,
    call_function: float = 1.0,
    fine: Expr = 1.0,
) -> Judged:
    """Judge a step by the contacts, its residuals those of `rows`; see `judge`.

    Args:
        s: State.
        p: Parameters.
        tried: The step.
        rows: The contacts.
        call_function: Of the tolerances; what is within that is within them.
        fine: What part of them, if less, is good enough to stop at, should the cost fall slowly.
    """
    residual = ca.if_else(gains(tried), tried.there, tried.before)
    positions, chords = rows.errors(residual)
    tolerances = p["position_tolerance"], chord(p["angle_tolerance"])

    def within(call_function: Expr) -> Expr:
        return within_tolerance(
            positions, chords, *(call_function * allowed for allowed in tolerances)
        )

    fine = ca.fmin(call_function, fine)
    return replace(
        judge(s, tried, within(fine), within(FIT.fine * fine)), within=within(call_function)
    )


def judge_beyond_tolerance(
    s: dict[str, Expr], p: dict[str, Expr], tried: Tried, rows: ContactRows, part: float = 1.0
) -> Judged:
    """Judge a step whose residuals are those of `beyond_tolerance`; see `judge`.

    Args:
        s: State.
        p: Parameters.
        tried: The step.
        rows: Rows of the contacts.
        part: Fraction of the tolerances at which the fit ends.
    """
    residual = ca.if_else(gains(tried), tried.there, tried.before)
    left = (part - TOLERANT.free) * _allowed(p)
    lengths = ca.vertcat(*(ca.norm_2(residual[own]) for own in rows.slices))
    within = ca.mmax(lengths - left) <= 0
    return judge(s, tried, within, within, TOLERANT.patience, TOLERANT.budget)


def gains(tried: Tried) -> Expr:
    """Whether the step lowers the cost."""
    return ca.sumsqr(tried.there) < ca.sumsqr(tried.before)


def judge(
    s: dict[str, Expr],
    tried: Tried,
    within: Expr,
    exact: Expr,
    patience: int = FIT.patience,
    budget: int = FIT.budget,
) -> Judged:
    """Accept a step that lowers the cost, and decide whether the fit is at its end.

    Args:
        s: State.
        tried: The step.
        within: Whether what is left of the residual after it is good enough to stop at, should
            it fall slowly.
        exact: Whether it is so good that nothing more is to be gained.
        patience: Evaluations with little gain before the fit is given up.
        budget: Evaluations in all.
    """
    cost_before, cost_there = ca.sumsqr(tried.before), ca.sumsqr(tried.there)
    accepted = gains(tried)
    cost = ca.if_else(accepted, cost_there, cost_before)
    left = cost / ca.fmax(cost_before, 1e-300)
    waited = ca.if_else(left > FIT.slow, s["waited"] + 1, 0.0)
    spent = s["spent"] + 1
    worth = ca.if_else(cost < FIT.promising, float(FIT.persistence), 1.0)
    over = ca.logic_or(waited >= patience * worth, spent >= budget * worth)
    stuck = ca.logic_and(ca.logic_not(accepted), s["damping"] > FIT.damping_ceiling)
    over = ca.logic_or(over, stuck)
    slowing = ca.logic_and(within, left > FIT.quadratic)
    kept = (cost_before - cost_there) / ca.fmax(tried.promised, 1e-300)
    bent = 2 * kept - 1
    factor = ca.if_else(accepted, ca.fmax(FIT.damping_down, 1 - bent * bent * bent), s["growth"])
    settled = ca.logic_or(
        ca.logic_or(exact, cost < FIT.exact * FIT.exact), ca.logic_or(over, slowing)
    )
    fit = fresh_fit() | {
        "damping": ca.fmax(s["damping"] * factor, FIT.damping_floor),
        "growth": ca.if_else(accepted, FIT.growth, 2 * s["growth"]),
        "waited": waited,
        "spent": spent,
    }
    fit = {name: ca.if_else(settled, fresh_fit()[name], fit[name]) for name in fit}
    return Judged(accepted, within, settled, cost, fit | {"cost": cost})


def fresh_fit() -> dict[str, float]:
    """Counters and damping of a fit that begins."""
    return {"damping": FIT.damping, "growth": FIT.growth, "waited": 0.0, "spent": 0.0}


def whole_residual(robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]) -> Expr:
    """Residual of `ContactRows` at q, base frame."""
    kinematics = actuated(robot, q).kinematics
    tips = [tip_vectors(kinematics, name) for name in robot.finger_names]
    return rows.residual(tips, rows.goals(p), p["weights"])


def whole_jacobian(robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]) -> Expr:
    """Its Jacobian (size, n)."""
    body = actuated(robot, q)
    n, goals = len(robot.actuators), rows.goals(p)
    tips = [tip_vectors(body.kinematics, name) for name in robot.finger_names]
    rates = [
        {key: ca.sparsify(rate) for key, rate in tip_rates(body, name, range(n)).items()}
        for name in robot.finger_names
    ]
    return rows.jacobian(tips, rates, goals, resting(goals, n), p["weights"])


class WholeContacts:
    """The contacts as least squares of all motors q (n, 1), and of a method's parameters."""

    def __init__(self, robot: RobotDescription, rows: ContactRows, parameters: Layout) -> None:
        """Remember what they are made of.

        Args:
            robot: The description.
            rows: The contacts' rows.
            parameters: Layout with the rows' fields, tolerances and bounds.
        """
        self._robot, self._rows, self._layout = robot, rows, parameters

    @cached_property
    def at(self) -> ca.Function:
        """(q, parameters) -> residual of `ContactRows` and its Jacobian, structurally sparse."""
        parameters = self._layout.symbols("parameters")
        q, p = ca.SX.sym("q", len(self._robot.actuators)), self._layout.unpack(parameters)
        residual = whole_residual(self._robot, self._rows, q, p)
        # Rows of a contact are alike, so that a fit and its balance are solved by the same code.
        slopes = whole_jacobian(self._robot, self._rows, q, p)
        both = (_in_columns(slopes[own, :]) for own in self._rows.slices)
        jacobian = ca.vertcat(*(dense @ columns for dense, columns in both))
        return call_function("whole_at", [q, parameters], [ca.densify(residual), jacobian])

    def fitted(self, q: Expr, damping: Expr, parameters: Expr) -> Tried:
        """One damped least-squares step within the bounds.

        Args:
            q: (n, 1) where it begins.
            damping: Scalar.
            parameters: Of the method.
        """
        bounds = self._bounds(q, parameters)
        return lm_step(
            lambda there: self.at(there, parameters),
            q,
            damping,
            bounds,
            lambda step: clip(q + step, bounds),
        )

    def fitted_beyond_tolerance(self, q: Expr, damping: Expr, parameters: Expr) -> Tried:
        """Return one damped step of the least squares of `beyond_tolerance` within the bounds.

        Args:
            q: (n, 1) configuration before the step.
            damping: Scalar.
            parameters: Parameters of the method.
        """
        bounds, p = self._bounds(q, parameters), self._layout.unpack(parameters)

        def excess(at: Expr) -> tuple[Expr, Expr]:
            residual, jacobian = self.at(at, parameters)
            return beyond_tolerance(residual, jacobian, self._rows, p)

        return lm_step(excess, q, damping, bounds, lambda step: clip(q + step, bounds))

    def balanced(self, q: Expr, damping: Expr, number: Expr, parameters: Expr) -> Tried:
        """One step towards the smallest largest error, see `balanced`; nothing is promised of it.

        Args:
            q: (n, 1) where it begins.
            damping: Scalar, of the state.
            number: How many powers are done.
            parameters: Of the method.
        """
        p, bounds = self._layout.unpack(parameters), self._bounds(q, parameters)
        before, jacobian = self.at(q, parameters)
        right, slopes = reweighted(before, jacobian, self._rows, number, p)
        normal, gradient = squares(slopes, right)
        low, high = bounds.lower - q, bounds.upper - q
        step = in_box(normal, BALANCE.damping * damping, gradient, low, high, FIT.passes)
        reached = clip(q + step, bounds)
        size = ca.mmax(ca.fabs(reached - q))
        return Tried(reached, before, self.at(reached, parameters)[0], ca.SX(0), size)

    def _bounds(self, q: Expr, parameters: Expr) -> Bounded:
        p = self._layout.unpack(parameters)
        return Bounded(q, p["lower"], p["upper"], first=0)


@dataclass(frozen=True, eq=False)
class Balanced:
    """A step that was tried and what comes of it.

    Attributes:
        q: (n, 1) where it leads, or where it began if it gained nothing.
        accepted: Whether it gained.
        within: Whether every contact is met at q.
        over: Whether nothing more is to be hoped for.
        largest: Largest part at q.
        fit: Damping, power and steps spent, for the state.
    """

    q: Expr
    accepted: Expr
    within: Expr
    over: Expr
    largest: Expr
    fit: dict[str, Expr]


def tolerance_ratio(cost: Expr, p: dict[str, Expr]) -> Expr:
    """Return the root mean square error of a residual, relative to its tolerances.

    It is at most 1 at a minimum near which all contacts can be within tolerance: the cost of a
    minimum does not exceed that of a configuration near it, and the cost of a configuration within
    tolerance does not exceed the sum of the squared tolerances.

    Args:
        cost: Sum of squares of the residual.
        p: Parameters.
    """
    squares = ca.sum1(p["weights"][:, 0] * (p["position_tolerance"] / LENGTH) ** 2)
    squares += ca.sum1(p["weights"][:, 1] * chord(p["angle_tolerance"]) ** 2)
    return ca.sqrt(cost / ca.fmax(squares, TINY))


def beyond_tolerance(
    residual: Expr, jacobian: Expr, rows: ContactRows, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Return the part of a residual that exceeds the tolerances, and its Jacobian.

    The residual r of a contact, with tolerance t, becomes (1 - t / |r|) r where |r| > t, and zero
    elsewhere; rows that follow those of the contacts remain as they are.

    Args:
        residual: (m, 1) residual whose first rows are those of the contacts.
        jacobian: (m, n) its Jacobian.
        rows: Rows of the contacts.
        p: Parameters.
    """
    free = TOLERANT.free * _allowed(p)
    residuals, slopes = [], []
    for i, own in enumerate(rows.slices):
        dense, columns = _in_columns(jacobian[own, :])
        excess, bent = _shortened(*dense.shape)(residual[own], dense, free[i])
        residuals.append(excess)
        slopes.append(bent @ columns)
    return (
        ca.vertcat(*residuals, residual[rows.size :]),
        ca.vertcat(*slopes, jacobian[rows.size :, :]),
    )


@cache
def _shortened(rows: int, columns: int) -> ca.Function:
    """Return the graph (residual, slopes, tolerance) -> (excess, slopes of it) of a contact."""
    residual, slopes = ca.SX.sym("residual", rows), ca.SX.sym("slopes", rows, columns)
    free = ca.SX.sym("free")
    length = ca.fmax(ca.norm_2(residual), TINY)
    along, ratio = residual / length, ca.fmin(free / length, 1.0)
    exceeds = ca.if_else(length > free, 1.0, 0.0)
    bent = (1 - ratio) * slopes + exceeds * ratio * (along @ (along.T @ slopes))
    return call_function("shortened", [residual, slopes, free], [(1 - ratio) * residual, bent])


def differs(cost: Expr, before: Expr) -> Expr:
    """Whether the cost of a fit is another than that of the fit balanced before."""
    return ca.fabs(cost - before) > BALANCE.same * before


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
    power = sum(
        (ca.if_else(number == i, value, 0.0) for i, value in enumerate(BALANCE.powers)), ca.SX(0)
    )
    return _Weighed(scaled, parts, largest, power, (parts / largest) ** (power - 2))


def reweighted(
    before: Expr, jacobian: Expr, contacts: ContactRows, number: Expr, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """The least squares that a step solves.

    The rows of a contact count by its weight, and along its error k - 1 times as much for the power
    k: they are stretched that way, and its residual, which lies along it, is shortened.

    Args:
        before: Residual (size, 1) of the contacts.
        jacobian: (size, n) its Jacobian.
        contacts: Their rows.
        number: How many of `BALANCE.powers` are done.
        p: Parameters.

    Returns:
        Residual (size, 1) and Jacobian (size, n).
    """
    weighed = _weighed(before, contacts, number, p)
    allowed = _allowed(p)
    residual, rows = [], []
    for i, own in enumerate(contacts.slices):
        dense, columns = _in_columns(jacobian[own, :])
        given = (weighed.parts[i], weighed.weights[i], weighed.power, allowed[i])
        right, slopes = _stretched(*dense.shape)(before[own], dense, *given)
        residual.append(right)
        rows.append(slopes @ columns)
    return ca.vertcat(*residual), ca.vertcat(*rows)


def _in_columns(rows: Expr) -> tuple[Expr, ca.DM]:
    """Two factors of rows (m, n): what is structurally not zero in one of them, and its columns."""
    columns = sorted(set(rows.sparsity().get_col()))
    return ca.densify(rows[:, columns]), ca.DM.eye(rows.shape[1])[columns, :]


@cache
def _stretched(rows: int, columns: int) -> ca.Function:
    """Of a contact: residual, slopes, part of its tolerance, weight, power, tolerance -> both."""
    residual, slopes = ca.SX.sym("residual", rows), ca.SX.sym("slopes", rows, columns)
    numbers = length, weight, power, allowed = [
        ca.SX.sym(name) for name in ("length", "weight", "power", "allowed")
    ]
    stretch, size = ca.sqrt(power - 1), ca.sqrt(weight) / allowed
    along = residual / (allowed * ca.fmax(length, TINY))
    right = size / stretch * residual
    bent = size * (slopes + along @ ((stretch - 1) * (along.T @ slopes)))
    return call_function("stretched", [residual, slopes, *numbers], [right, bent])


def balanced(
    value: Expr, tried: Tried, contacts: ContactRows, s: dict[str, Expr], p: dict[str, Expr]
) -> Balanced:
    """What comes of a step.

    Args:
        value: (n, 1) where it begins.
        tried: The step, with the residuals of the contacts.
        contacts: Their rows.
        s: State with damping, power (how many of `BALANCE.powers` are done) and spent.
        p: Parameters.
    """
    weighed = _weighed(tried.before, contacts, s["power"], p)
    weights, parts, largest = weighed.weights, weighed.parts, weighed.largest
    power = weighed.power
    parts_there = _lengths(_scaled(tried.there, contacts, p), contacts)
    # Bounded, since a large number to a high power is none.
    grown = ca.fmin(parts_there / largest, BALANCE.farthest)
    total, total_there = ca.dot(weights, parts**2), ca.dot(grown ** (power - 2), parts_there**2)
    accepted = total_there < total
    left = ca.if_else(accepted, parts_there, parts)
    damping = BALANCE.damping * s["damping"]
    steady = ca.if_else(
        accepted, total_there > BALANCE.steady * total, damping > BALANCE.damping_ceiling
    )
    done = s["power"] + steady
    spent = s["spent"] + 1
    over = ca.logic_or(done >= len(BALANCE.powers), spent >= BALANCE.budget)
    powers = ca.if_else(accepted, total_there, total) * largest ** (power - 2)
    hopeless = powers > len(contacts.slices) * BALANCE.hopeless**power
    over = ca.logic_or(over, ca.logic_and(steady, hopeless))
    eased = ca.if_else(accepted, BALANCE.eased, BALANCE.tightened)
    fit = {
        "damping": ca.fmax(s["damping"] * eased, BALANCE.damping_floor),
        "power": done,
        "spent": spent,
    }
    return Balanced(
        q=ca.if_else(accepted, tried.reached, value),
        accepted=accepted,
        within=ca.mmax(left) <= 1,
        over=over,
        largest=ca.mmax(left),
        fit=fit,
    )


def _scaled(values: Expr, contacts: ContactRows, p: dict[str, Expr]) -> Expr:
    """Rows (size, k) of the contacts as parts of the tolerances."""
    return values / _each(_allowed(p), contacts)


def _allowed(p: dict[str, Expr]) -> Expr:
    """The tolerances (2 f, 1) in the units of residuals."""
    both = ca.vertcat(p["position_tolerance"] / LENGTH, chord(p["angle_tolerance"]))
    return ca.fmax(both, TINY)


def _each(values: Expr, contacts: ContactRows) -> Expr:
    """A value for each place and facing (2 f, 1) as one for each of its rows (size, 1)."""
    sizes = [own.stop - own.start for own in contacts.slices]
    return ca.vertcat(*(ca.repmat(values[i], size, 1) for i, size in enumerate(sizes)))


def _lengths(scaled: Expr, contacts: ContactRows) -> Expr:
    return ca.vertcat(*(ca.norm_2(scaled[own]) for own in contacts.slices))
