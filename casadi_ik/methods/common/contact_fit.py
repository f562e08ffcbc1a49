"""Contacts as a least-squares problem, and when a fit of them is at its end.

A step is judged by what it made of the cost. The damping follows the ratio of what was gained to
what the linear model promised (Nielsen 1999: Damping parameter in Marquardt's method).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from casadi_ik.kernels.layout import Layout
from casadi_ik.methods.common.balance import DAMPING, reweighted
from casadi_ik.methods.common.bounded_step import in_box
from casadi_ik.problem.contacts import (
    ContactRows,
    chord,
    resting,
    tip_rates,
    tip_vectors,
    within_tolerance,
)
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import actuated
from casadi_ik.symbolic.smooth import Expr, shared

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


PASSES = 2
"""Corrections of the active set in a step."""


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


@dataclass(frozen=True, eq=False)
class WholeStep:
    """A step of all motors that was tried.

    Attributes:
        reached: (n, 1) where it leads, within bounds.
        before: Residual where it begins.
        there: Residual where it leads.
        promised: By how much the linear model says the cost falls; 0 for a balance.
    """

    reached: Expr
    before: Expr
    there: Expr
    promised: Expr

    def as_inputs(self) -> tuple[WholeStep, list[ca.SX]]:
        """The same as symbols, and these: for a function that judges the step."""
        symbols = [
            ca.SX.sym(name, value.numel())
            for name, value in (
                ("reached", self.reached),
                ("before", self.before),
                ("there", self.there),
                ("promised", self.promised),
            )
        ]
        return WholeStep(*symbols), symbols

    @property
    def parts(self) -> list[Expr]:
        """What `as_inputs` stands for."""
        return [self.reached, self.before, self.there, self.promised]

    def tried(self, q: Expr) -> Tried:
        """As a step from q (n, 1)."""
        size = ca.mmax(ca.fabs(self.reached - q))
        return Tried(self.reached, self.before, self.there, self.promised, size)


class WholeContacts:
    """Functions of q (n, 1) and of a method's parameters."""

    def __init__(self, robot: RobotDescription, rows: ContactRows, parameters: Layout) -> None:
        """Remember what they are made of.

        Args:
            robot: The description.
            rows: The contacts' rows.
            parameters: Layout with the rows' fields, tolerances and bounds.
        """
        self._robot, self._rows, self._layout = robot, rows, parameters

    def fitted(self, q: Expr, damping: Expr, parameters: Expr) -> WholeStep:
        """One damped least-squares step within the bounds.

        Args:
            q: (n, 1) where it begins.
            damping: Scalar.
            parameters: Of the method.
        """
        before, slopes = self._at(q, parameters)
        normal, gradient = self._squares(before, slopes)
        reached = self._box(normal, gradient, damping, q, parameters)
        promised = self._promise(before, slopes, q, reached)
        return WholeStep(reached, before, self.residual(reached, parameters), promised)

    def balanced(self, q: Expr, damping: Expr, number: Expr, parameters: Expr) -> WholeStep:
        """One step towards the smallest largest error, see `balance`.

        Args:
            q: (n, 1) where it begins.
            damping: Scalar, of the state.
            number: How many powers are done.
            parameters: Of the method.
        """
        before, slopes = self._at(q, parameters)
        right, rows, stretched = self._reweighted(before, slopes, number, parameters)
        normal, gradient = self._squares(right, rows)
        normal = self._stretched(normal, stretched)
        reached = self._box(normal, gradient, DAMPING * damping, q, parameters)
        return WholeStep(reached, before, self.residual(reached, parameters), ca.MX(0))

    @cached_property
    def residual(self) -> ca.Function:
        """(q, parameters) -> residual of `ContactRows`."""
        q, parameters, p = self._symbols()
        outputs = shared(ca.densify(whole_residual(self._robot, self._rows, q, p)))
        return ca.Function("whole_residual", [q, parameters], outputs)

    @cached_property
    def _at(self) -> ca.Function:
        """(q, parameters) -> residual and its Jacobian, structurally sparse."""
        q, parameters, p = self._symbols()
        residual = whole_residual(self._robot, self._rows, q, p)
        jacobian = whole_jacobian(self._robot, self._rows, q, p)
        return ca.Function("whole_at", [q, parameters], shared(ca.densify(residual), jacobian))

    @cached_property
    def _squares(self) -> ca.Function:
        """(residual, Jacobian) -> upper triangle of J'J, and J'r."""
        residual, jacobian = self._linear()
        outputs = shared(*_normal(jacobian, residual))
        return ca.Function("whole_squares", [residual, jacobian], outputs)

    @cached_property
    def _reweighted(self) -> ca.Function:
        """(residual, Jacobian, number of the power, parameters) -> see `reweighted`."""
        residual, jacobian = self._linear()
        _, parameters, p = self._symbols()
        number = ca.SX.sym("number")
        right, slopes, stretched = reweighted(residual, jacobian, self._rows, number, p)
        slopes = ca.project(slopes, jacobian.sparsity())
        outputs = shared(right, slopes, ca.sparsify(stretched))
        return ca.Function("reweighted", [residual, jacobian, number, parameters], outputs)

    @cached_property
    def _stretched(self) -> ca.Function:
        """(J'J, further rows) -> J'J with them; it gets no entry that it has not."""
        normal = ca.SX.sym("normal", self._squares.sparsity_out(0))
        rows = ca.SX.sym("rows", self._reweighted.sparsity_out(2))
        more = normal + ca.triu(ca.sparsify(rows.T @ rows))
        outputs = shared(ca.project(more, normal.sparsity()))
        return ca.Function("stretched", [normal, rows], outputs)

    @cached_property
    def _box(self) -> ca.Function:
        """(J'J, J'r, damping, q, parameters) -> where the step leads."""
        normal = ca.SX.sym("normal", self._squares.sparsity_out(0))
        q, parameters, p = self._symbols()
        gradient, damping = ca.SX.sym("gradient", q.numel()), ca.SX.sym("damping")
        low, high = p["lower"] - q, p["upper"] - q
        damped = normal + damping * ca.DM.eye(q.numel())
        step = in_box(damped, gradient, low, high, PASSES)
        reached = ca.fmin(ca.fmax(q + step, p["lower"]), p["upper"])
        inputs = [normal, gradient, damping, q, parameters]
        return ca.Function("whole_box", inputs, shared(reached))

    @cached_property
    def _promise(self) -> ca.Function:
        """(residual, Jacobian, q, where a step leads) -> what the linear model promises of it."""
        residual, jacobian = self._linear()
        n = jacobian.shape[1]
        q, reached = ca.SX.sym("q", n), ca.SX.sym("reached", n)
        change = jacobian @ (reached - q)
        outputs = shared(-ca.dot(change, 2 * residual + change))
        return ca.Function("whole_promise", [residual, jacobian, q, reached], outputs)

    def _symbols(self) -> tuple[ca.SX, ca.SX, dict[str, ca.SX]]:
        parameters = self._layout.symbols("parameters")
        q = ca.SX.sym("q", len(self._robot.actuators))
        return q, parameters, self._layout.unpack(parameters)

    def _linear(self) -> tuple[ca.SX, ca.SX]:
        sparsity = self._at.sparsity_out(1)
        return ca.SX.sym("residual", self._rows.size), ca.SX.sym("jacobian", sparsity)


def _normal(jacobian: Expr, residual: Expr) -> tuple[Expr, Expr]:
    return ca.triu(ca.sparsify(jacobian.T @ jacobian)), ca.densify(jacobian.T @ residual)
