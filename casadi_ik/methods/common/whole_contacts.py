"""The contacts as a function of all motors at once, and steps of all motors towards them.

What a step is made of are functions of their own, which fits and balances share: written out in
each of them they would be most of a method's code.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.kernels.layout import Layout
from casadi_ik.methods.common.balance import DAMPING, reweighted
from casadi_ik.methods.common.bounded_step import in_box
from casadi_ik.methods.common.contact_fit import Tried
from casadi_ik.problem.contacts import ContactRows, resting, tip_rates, tip_vectors
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import actuated
from casadi_ik.symbolic.smooth import Expr, shared

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
