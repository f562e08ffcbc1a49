"""Least-squares fits of the contacts, and their convergence criteria.

A trial step is evaluated by the change of the cost. The damping follows the ratio of the actual to
the predicted decrease (Nielsen 1999: Damping parameter in Marquardt's method).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import casadi as ca

from casadi_ik.compile.layout import Layout
from casadi_ik.kinematics.box_qp import BoxBounds, clip, damped_step
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    chord,
    fixed_goal_rates,
    tip_jacobians,
    tip_vectors,
    within_tolerance,
)
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.smooth import Expr, call_function
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True)
class FitParameters:
    """Damping and convergence criteria of a fit.

    Attributes:
        damping: Initial damping of the normal matrix, whose rows are of order one per radian and
            0.1 m.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends the fit.
        damping_down: Smallest factor of the damping after an accepted step.
        growth: Factor of the damping after a rejected step; doubles with every further rejection.
        slow: Ratio of costs after and before a step above which progress is slow.
        quadratic: Ratio of costs below which convergence is fast, so that another step pays.
        patience: Number of consecutive steps with slow progress that ends the fit.
        budget: Maximum number of steps.
        promising: Cost below which `patience` and `budget` are multiplied by `persistence`.
        persistence: Factor of the effort for fits near a solution.
        exact: Square root of the cost below which contacts are met exactly (0.1 nm per 100 mm, or
            rad).
        fine: Fraction of the tolerance below which errors count as exact.
        passes: Number of corrections of the active set in a step.
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
class TolerantFitParameters:
    """Parameters of a fit of the errors beyond the tolerances.

    Attributes:
        free_fraction: Fraction of the tolerance within which an error costs nothing.
        max_start_ratio: Largest `tolerance_ratio` at a minimum of the exact fit from which a
            tolerant fit starts.
        near_miss_ratio: Largest `tolerance_ratio` at which a minimum counts as a near miss.
        patience: Number of consecutive steps with slow progress that ends the fit.
        budget: Maximum number of steps.
    """

    free_fraction: float = 0.95
    max_start_ratio: float = 1.0
    near_miss_ratio: float = 2.0
    patience: int = 4
    budget: int = 40


FIT, TOLERANT_FIT = FitParameters(), TolerantFitParameters()

SMALLEST_NORM = 1e-100
"""Lower bound of norms and costs in divisors."""


@dataclass(frozen=True, eq=False)
class TrialStep:
    """A damped step whose residual has been evaluated.

    Attributes:
        x: Unknowns of the stage after the step.
        residual_before: Residual before the step.
        residual: Residual after the step.
        predicted_decrease: Decrease of the cost that the linear model predicts.
        max_change: Largest change of a motor position [rad or m].
    """

    x: Any
    residual_before: Expr
    residual: Expr
    predicted_decrease: Expr
    max_change: Expr


def lm_step(
    linearise: Callable[[Any], tuple[Expr, Expr]],
    x: Any,
    damping: Expr,
    bounds: BoxBounds,
    retract: Callable[[Expr], Any],
    motors: Callable[[Any], Expr] = lambda x: x,
) -> TrialStep:
    """Return a damped least-squares step within bounds.

    Args:
        linearise: Residual (m, 1) and Jacobian (m, n) as a function of the unknowns.
        x: Unknowns before the step: all motors, palm and hand, or the arm.
        damping: Scalar.
        bounds: Bounds of the motors.
        retract: Unknowns as a function of a step (n, 1).
        motors: Motor positions (k, 1) as a function of the unknowns.
    """
    residual_before, jacobian = linearise(x)
    damped = damped_step(jacobian, residual_before, damping, bounds, FIT.passes)
    x_after = retract(damped.step)
    change = ca.fabs(motors(x_after) - bounds.value)
    # A rigid tool has no motors.
    max_change = ca.mmax(change) if change.numel() else ca.SX(0)
    return TrialStep(
        x_after, residual_before, linearise(x_after)[0], damped.predicted_decrease, max_change
    )


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """Outcome of a damped step.

    Attributes:
        accepted: 1 if the step decreases the cost.
        within: 1 if the errors are within tolerance.
        settled: 1 if the fit has ended.
        cost: Cost after the step if accepted, else before it.
        lm_state: New values of the state fields of the fit.
    """

    accepted: Expr
    within: Expr
    settled: Expr
    cost: Expr
    lm_state: dict[str, Expr]


def evaluate_contact_step(
    s: dict[str, Expr],
    p: dict[str, Expr],
    trial: TrialStep,
    rows: ContactRows,
    tolerance_fraction: float = 1.0,
    stop_fraction: Expr = 1.0,
) -> StepOutcome:
    """Evaluate a step whose residual is that of the contacts; see `evaluate_step`.

    Args:
        s: State.
        p: Parameters.
        trial: Trial step.
        rows: Rows of the contacts.
        tolerance_fraction: Fraction of the tolerances that counts as within tolerance.
        stop_fraction: Fraction of the tolerances at which a slowly converging fit stops, if
            smaller than `tolerance_fraction`.
    """
    residual = ca.if_else(decreases_cost(trial), trial.residual, trial.residual_before)
    positions, chords = rows.errors(residual)
    tolerances = p["position_tolerance"], chord(p["angle_tolerance"])

    def are_within(tolerance_fraction: Expr) -> Expr:
        return within_tolerance(
            positions, chords, *(tolerance_fraction * tolerance for tolerance in tolerances)
        )

    stop_fraction = ca.fmin(tolerance_fraction, stop_fraction)
    return replace(
        evaluate_step(s, trial, are_within(stop_fraction), are_within(FIT.fine * stop_fraction)),
        within=are_within(tolerance_fraction),
    )


def evaluate_excess_step(
    s: dict[str, Expr],
    p: dict[str, Expr],
    trial: TrialStep,
    rows: ContactRows,
    tolerance_fraction: float = 1.0,
) -> StepOutcome:
    """Evaluate a step whose residual is that of `beyond_tolerance`; see `evaluate_step`.

    Args:
        s: State.
        p: Parameters.
        trial: Trial step.
        rows: Rows of the contacts.
        tolerance_fraction: Fraction of the tolerances at which the fit ends.
    """
    residual = ca.if_else(decreases_cost(trial), trial.residual, trial.residual_before)
    max_excess = (tolerance_fraction - TOLERANT_FIT.free_fraction) * residual_tolerances(p)
    lengths = ca.vertcat(*(ca.norm_2(residual[rows_of_contact]) for rows_of_contact in rows.slices))
    within = ca.mmax(lengths - max_excess) <= 0
    return evaluate_step(s, trial, within, within, TOLERANT_FIT.patience, TOLERANT_FIT.budget)


def decreases_cost(trial: TrialStep) -> Expr:
    """Return whether a step decreases the cost."""
    return ca.sumsqr(trial.residual) < ca.sumsqr(trial.residual_before)


def evaluate_step(
    s: dict[str, Expr],
    trial: TrialStep,
    within: Expr,
    exact: Expr,
    patience: int = FIT.patience,
    budget: int = FIT.budget,
) -> StepOutcome:
    """Accept a step that decreases the cost, and decide whether the fit has ended.

    Args:
        s: State.
        trial: Trial step.
        within: 1 if the residual is small enough to stop unless convergence is fast.
        exact: 1 if the residual is small enough to stop in any case.
        patience: Number of consecutive steps with slow progress that ends the fit.
        budget: Maximum number of steps.
    """
    cost_before, cost_after = ca.sumsqr(trial.residual_before), ca.sumsqr(trial.residual)
    accepted = decreases_cost(trial)
    cost = ca.if_else(accepted, cost_after, cost_before)
    cost_ratio = cost / ca.fmax(cost_before, 1e-300)
    slow_steps = ca.if_else(cost_ratio > FIT.slow, s["slow_steps"] + 1, 0.0)
    evaluations = s["stage_iterations"] + 1
    effort = ca.if_else(cost < FIT.promising, float(FIT.persistence), 1.0)
    is_exhausted = ca.logic_or(slow_steps >= patience * effort, evaluations >= budget * effort)
    is_stuck = ca.logic_and(ca.logic_not(accepted), s["damping"] > FIT.damping_ceiling)
    is_exhausted = ca.logic_or(is_exhausted, is_stuck)
    is_good_enough = ca.logic_and(within, cost_ratio > FIT.quadratic)
    gain_ratio = (cost_before - cost_after) / ca.fmax(trial.predicted_decrease, 1e-300)
    centred_ratio = 2 * gain_ratio - 1
    factor = ca.if_else(
        accepted,
        ca.fmax(FIT.damping_down, 1 - centred_ratio * centred_ratio * centred_ratio),
        s["growth"],
    )
    settled = ca.logic_or(
        ca.logic_or(exact, cost < FIT.exact * FIT.exact), ca.logic_or(is_exhausted, is_good_enough)
    )
    lm_state = initial_lm_state() | {
        "damping": ca.fmax(s["damping"] * factor, FIT.damping_floor),
        "growth": ca.if_else(accepted, FIT.growth, 2 * s["growth"]),
        "slow_steps": slow_steps,
        "stage_iterations": evaluations,
    }
    lm_state = {
        name: ca.if_else(settled, initial_lm_state()[name], lm_state[name]) for name in lm_state
    }
    return StepOutcome(accepted, within, settled, cost, lm_state | {"cost": cost})


def initial_lm_state() -> dict[str, float]:
    """Return the initial values of the state fields of a fit."""
    return {
        "damping": FIT.damping,
        "growth": FIT.growth,
        "slow_steps": 0.0,
        "stage_iterations": 0.0,
    }


def contact_residual(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]
) -> Expr:
    """Return the residual of `ContactRows` at q, base frame."""
    kinematics = actuated(robot, q).kinematics
    tips = [tip_vectors(kinematics, name) for name in robot.finger_names]
    return rows.residual(tips, rows.goals(p), p["weights"])


def contact_jacobian(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]
) -> Expr:
    """Return the Jacobian (size, n) of `contact_residual`."""
    body = actuated(robot, q)
    n, goals = len(robot.actuators), rows.goals(p)
    tips = [tip_vectors(body.kinematics, name) for name in robot.finger_names]
    rates = [
        {key: ca.sparsify(rate) for key, rate in tip_jacobians(body, name, range(n)).items()}
        for name in robot.finger_names
    ]
    return rows.jacobian(tips, rates, goals, fixed_goal_rates(goals, n), p["weights"])


class ContactLeastSquares:
    """Least-squares problem of the contacts in all motors q (n, 1).

    Attributes:
        rows: Rows of the contacts.
        layout: Layout of the parameters of a method.
    """

    def __init__(self, robot: RobotDescription, rows: ContactRows, parameters: Layout) -> None:
        """Store the ingredients; the graph is built at the first use.

        Args:
            robot: Description of the robot.
            rows: Rows of the contacts.
            parameters: Layout of the parameters of a method: fields of the rows, tolerances and
                bounds.
        """
        self.rows, self.layout, self._robot = rows, parameters, robot

    @cached_property
    def linearised(self) -> ca.Function:
        """Graph ``(q, parameters) -> (residual, jacobian)`` with a sparse Jacobian."""
        parameters = self.layout.symbols("parameters")
        q, p = ca.SX.sym("q", len(self._robot.actuators)), self.layout.unpack(parameters)
        residual = contact_residual(self._robot, self.rows, q, p)
        # Rows of a contact have one pattern, so that least squares and minimax share functions.
        slopes = contact_jacobian(self._robot, self.rows, q, p)
        factors = (in_columns(slopes[rows_of_contact, :]) for rows_of_contact in self.rows.slices)
        jacobian = ca.vertcat(*(dense @ columns for dense, columns in factors))
        return call_function("whole_at", [q, parameters], [ca.densify(residual), jacobian])

    def lm_trial(self, q: Expr, damping: Expr, parameters: Expr) -> TrialStep:
        """Return a damped least-squares step within the bounds.

        Args:
            q: (n, 1) configuration before the step.
            damping: Scalar.
            parameters: Parameters of the method.
        """
        bounds = self.bounds(q, parameters)
        return lm_step(
            lambda x: self.linearised(x, parameters),
            q,
            damping,
            bounds,
            lambda step: clip(q + step, bounds),
        )

    def excess_trial(self, q: Expr, damping: Expr, parameters: Expr) -> TrialStep:
        """Return a damped step of the least squares of `beyond_tolerance` within the bounds.

        Args:
            q: (n, 1) configuration before the step.
            damping: Scalar.
            parameters: Parameters of the method.
        """
        bounds, p = self.bounds(q, parameters), self.layout.unpack(parameters)

        def excess(x: Expr) -> tuple[Expr, Expr]:
            residual, jacobian = self.linearised(x, parameters)
            return beyond_tolerance(residual, jacobian, self.rows, p)

        return lm_step(excess, q, damping, bounds, lambda step: clip(q + step, bounds))

    def bounds(self, q: Expr, parameters: Expr) -> BoxBounds:
        """Return the bounds of a step from q within the limits of the motors."""
        p = self.layout.unpack(parameters)
        return BoxBounds(q, p["lower"], p["upper"], first=0)


def tolerance_ratio(cost: Expr, p: dict[str, Expr]) -> Expr:
    """Return the root mean square error of a residual, relative to its tolerances.

    It is at most 1 at a minimum near which all contacts can be within tolerance: the cost of a
    minimum does not exceed that of a configuration near it, and the cost of a configuration within
    tolerance does not exceed the sum of the squared tolerances.

    Args:
        cost: Sum of squares of the residual.
        p: Parameters.
    """
    largest_cost = ca.sum1(p["weights"][:, 0] * (p["position_tolerance"] / LENGTH) ** 2)
    largest_cost += ca.sum1(p["weights"][:, 1] * chord(p["angle_tolerance"]) ** 2)
    return ca.sqrt(cost / ca.fmax(largest_cost, SMALLEST_NORM))


def beyond_tolerance(
    residual: Expr, jacobian: Expr, rows: ContactRows, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Return the part of a residual that exceeds the tolerances, and its Jacobian.

    The residual r of a contact, with tolerance t, becomes (1 - t / |r|) r where |r| > t, and zero
    elsewhere; rows after those of the contacts are unchanged.

    Args:
        residual: (m, 1) residual whose first rows are those of the contacts.
        jacobian: (m, n) its Jacobian.
        rows: Rows of the contacts.
        p: Parameters.
    """
    free_lengths = TOLERANT_FIT.free_fraction * residual_tolerances(p)
    residuals, slopes = [], []
    for i, rows_of_contact in enumerate(rows.slices):
        dense, columns = in_columns(jacobian[rows_of_contact, :])
        excess, slope = _shortened(*dense.shape)(residual[rows_of_contact], dense, free_lengths[i])
        residuals.append(excess)
        slopes.append(slope @ columns)
    return (
        ca.vertcat(*residuals, residual[rows.size :]),
        ca.vertcat(*slopes, jacobian[rows.size :, :]),
    )


@cache
def _shortened(rows: int, columns: int) -> ca.Function:
    """Return the graph (residual, slopes, tolerance) -> (excess, slopes of it) of a contact."""
    residual, slopes = ca.SX.sym("residual", rows), ca.SX.sym("slopes", rows, columns)
    free = ca.SX.sym("free")
    length = ca.fmax(ca.norm_2(residual), SMALLEST_NORM)
    direction, ratio = residual / length, ca.fmin(free / length, 1.0)
    exceeds = ca.if_else(length > free, 1.0, 0.0)
    excess_slopes = (1 - ratio) * slopes + exceeds * ratio * (direction @ (direction.T @ slopes))
    return call_function(
        "shortened", [residual, slopes, free], [(1 - ratio) * residual, excess_slopes]
    )


def in_columns(rows: Expr) -> tuple[Expr, ca.DM]:
    """Return rows (m, n) as the product of a dense matrix and a selection of columns."""
    columns = sorted(set(rows.sparsity().get_col()))
    return ca.densify(rows[:, columns]), ca.DM.eye(rows.shape[1])[columns, :]


def residual_tolerances(p: dict[str, Expr]) -> Expr:
    """Return the tolerances (2 f, 1) in the units of the residual."""
    tolerances = ca.vertcat(p["position_tolerance"] / LENGTH, chord(p["angle_tolerance"]))
    return ca.fmax(tolerances, SMALLEST_NORM)
