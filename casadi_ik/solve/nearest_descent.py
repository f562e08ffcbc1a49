"""Descent of the distance between a robot and contacts that are out of reach, to a local minimum.

The distance of a configuration from a target is the sum of its squared contact errors, each
multiplied by a weight.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.compile import RUNNING
from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.kinematics.box_qp import normal_equations, solve_box_qp
from casadi_ik.kinematics.contact_curvature import residual_curvature
from casadi_ik.kinematics.contact_fit import contact_jacobian, contact_residual
from casadi_ik.kinematics.contacts import ContactRows, Kinds, kinds_suffix
from casadi_ik.kinematics.forward import motor_scales
from casadi_ik.kinematics.smooth import with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.status import Status


@dataclass(frozen=True)
class DescentParameters:
    """Parameters of the descent to a local minimum. Source: ``studies/best_effort.py``.

    Attributes:
        damping: First damping of the normal matrix.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends the descent.
        good_gain: Ratio of actual and predicted decrease above which the damping decreases most.
        poor_gain: Ratio below which the damping increases after an accepted step.
        good_factor: Factor of the damping after a step with a good gain.
        fair_factor: Factor of the damping after a step between the two ratios.
        poor_factor: Factor of the damping after an accepted step with a poor gain.
        rejected_factor: Factor of the damping after a rejected step.
        slow: Ratio of distances after and before a step above which steps use the exact second
            derivatives: Gauss-Newton steps converge slowly where errors remain.
        settled: Relative decrease of the distance below which a descent has ended.
        local_step: Longest step of a descent that stays near its start [rad, or part of a slider's
            range]: long steps would lead to other minima.
        passes: Number of corrections of the active set in a step.
        max_iterations: Maximum number of steps.
    """

    damping: float = 1.0
    damping_floor: float = 1e-12
    damping_ceiling: float = 1e6
    good_gain: float = 0.75
    poor_gain: float = 0.25
    good_factor: float = 0.2
    fair_factor: float = 0.7
    poor_factor: float = 3.0
    rejected_factor: float = 8.0
    slow: float = 0.5
    settled: float = 1e-11
    local_step: float = 0.1
    passes: int = 2
    max_iterations: int = 200


DESCENT = DescentParameters()


@dataclass(frozen=True)
class DescentStep:
    """Step of the bounded descent of the distance between a robot and its contacts.

    Attributes:
        robot: Description of the robot.
        kinds: Kind of contact of each finger.
    """

    robot: RobotDescription
    kinds: Kinds

    @cached_property
    def contacts(self) -> ContactRows:
        """Rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """Layout of the state."""
        return Layout(
            (
                Field("q", (len(self.robot.actuators),), unit="rad or m"),
                Field("damping", doc="damping of the next step"),
                Field("is_exact", doc="1: the next step uses exact second derivatives"),
                Field("distance", doc="half the squared residual after the last step"),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters."""
        n = len(self.robot.actuators)
        bounds = (Field(name, (n,), unit="rad or m") for name in ("lower", "upper"))
        max_step = Field("max_step", doc="longest step [rad, or part of a slider's range]")
        return Layout((*self.contacts.fields, *bounds, max_step))

    @cached_property
    def graph(self) -> StepGraph:
        """``(state, parameters) -> (state', record, status)``."""
        name = ca.Function.fix_name(f"{self.robot.name}_descent{kinds_suffix(self.kinds)}")
        record = Layout.record(Field("distance", doc="half the squared residual after the step"))
        key = recipe(name, self.robot, self.kinds)
        return StepGraph(
            name, lambda: self._build(name), self.state, self.parameters, record, recipe=key
        )

    def _build(self, name: str) -> ca.Function:
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self.parameters.unpack(parameters)
        q = ca.SX.sym("q", len(self.robot.actuators))
        residual = contact_residual(self.robot, self.contacts, q, p)
        distance = ca.sumsqr(residual) / 2
        # Structural zeros between motors of different fingers shorten the elimination.
        jacobian = contact_jacobian(self.robot, self.contacts, q, p)
        gauss_newton, gradient = normal_equations(jacobian, residual)
        hessian = gauss_newton + residual_curvature(self.robot, self.contacts, q, p, residual)
        inputs = [q, parameters]
        value = ca.Function("distance", inputs, [distance])
        model = ca.Function("model", inputs, with_cse(distance, gradient, gauss_newton, hessian))
        distance_before, slope, approximate, exact = model(s["q"], parameters)
        matrix = ca.if_else(s["is_exact"] > 0.5, exact, approximate)
        longest = p["max_step"] * motor_scales(self.robot)
        low = ca.fmax(p["lower"] - s["q"], -longest)
        high = ca.fmin(p["upper"] - s["q"], longest)
        step = solve_box_qp(matrix, s["damping"], slope, low, high, DESCENT.passes)
        trial = s["q"] + ca.fmin(ca.fmax(step, -longest), longest)
        trial = ca.fmin(ca.fmax(trial, p["lower"]), p["upper"])
        distance_after = value(trial, parameters)
        is_accepted = distance_after < distance_before
        change = trial - s["q"]
        symmetric = matrix + ca.triu(matrix, False).T
        predicted_decrease = -ca.dot(change, slope + symmetric @ change / 2)
        decrease = distance_before - distance_after
        is_slow = distance_after > DESCENT.slow * distance_before
        factor = DESCENT.poor_factor
        for gain, gain_factor in (
            (DESCENT.poor_gain, DESCENT.fair_factor),
            (DESCENT.good_gain, DESCENT.good_factor),
        ):
            factor = ca.if_else(decrease > gain * predicted_decrease, gain_factor, factor)
        factor = ca.if_else(is_accepted, factor, DESCENT.rejected_factor)
        new_state = {
            "q": ca.if_else(is_accepted, trial, s["q"]),
            "damping": ca.fmax(s["damping"] * factor, DESCENT.damping_floor),
            "is_exact": ca.if_else(is_accepted, is_slow, s["is_exact"]),
            "distance": ca.if_else(is_accepted, distance_after, distance_before),
        }
        has_settled = ca.logic_and(is_accepted, decrease <= DESCENT.settled * distance_before)
        is_stuck = ca.logic_and(ca.logic_not(is_accepted), s["damping"] > DESCENT.damping_ceiling)
        status = ca.if_else(
            ca.logic_or(has_settled, is_stuck), float(Status.STALLED), float(RUNNING)
        )
        outputs = [
            ca.densify(self.state.pack(new_state)),
            ca.densify(ca.if_else(is_accepted, distance_after, distance_before)),
            status,
        ]
        return ca.Function(name, [state, parameters], outputs)
