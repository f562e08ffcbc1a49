"""Minimax fits of the contacts: the largest error relative to its tolerance is reduced.

The p-norm of the ratios of error to tolerance is minimised by reweighted least squares, for
increasing powers p.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca

from casadi_ik.kinematics.box_qp import clip, normal_equations, solve_box_qp
from casadi_ik.kinematics.contact_fit import (
    FIT,
    SMALLEST_NORM,
    ContactLeastSquares,
    TrialStep,
    in_columns,
    residual_tolerances,
)
from casadi_ik.kinematics.contacts import ContactRows
from casadi_ik.kinematics.smooth import Expr, call_function


@dataclass(frozen=True)
class MinimaxParameters:
    """Parameters of the minimax stage, which reduces the largest error relative to its tolerance.

    Attributes:
        powers: Successive exponents p of the p-norm of the error ratios.
        max_tolerance_ratio: Largest ratio of error to tolerance from which the minimax stage
            starts.
        same_cost_tolerance: Relative difference of costs below which two minima are the same.
        stall_ratio: Ratio of sums after and before a step above which the next power begins.
        infeasible_ratio: If the sum stalls above n * infeasible_ratio**power for n errors, the
            largest error cannot fall below its tolerance near this configuration.
        improvement_ratio: Ratio of the largest errors of two minimax fits above which the second is
            no improvement.
        budget: Maximum number of steps.
        damping: Factor of the damping relative to a fit, because rows are divided by tolerances.
        damping_floor: Smallest damping of a fit.
        damping_ceiling: Damping at which the next power begins.
        damping_decrease: Factor of the damping after an accepted step.
        damping_increase: Factor of the damping after a rejected step.
        max_growth: Error ratio, relative to the largest before the step, at which ratios saturate.
    """

    powers: tuple[float, ...] = (4.0, 10.0, 24.0, 60.0, 150.0, 400.0)
    max_tolerance_ratio: float = 2.0
    same_cost_tolerance: float = 1e-2
    stall_ratio: float = 0.95
    infeasible_ratio: float = 1.05
    improvement_ratio: float = 0.99
    budget: int = 60
    damping: float = 100.0
    damping_floor: float = 1e-8
    damping_ceiling: float = 10.0
    damping_decrease: float = 1 / 8
    damping_increase: float = 4.0
    max_growth: float = 2.0


MINIMAX = MinimaxParameters()


@dataclass(frozen=True, eq=False)
class MinimaxStep:
    """Outcome of a trial step of the minimax stage.

    Attributes:
        q: (n, 1) configuration after the step, or before it if the step is rejected.
        accepted: 1 if the step decreases the p-norm.
        within: 1 if every contact is within tolerance at q.
        is_finished: 1 if the stage has ended.
        largest: Largest ratio of error to tolerance at q.
        state: New values of the state fields of the stage.
    """

    q: Expr
    accepted: Expr
    within: Expr
    is_finished: Expr
    largest: Expr
    state: dict[str, Expr]


def is_new_cost(cost: Expr, previous: Expr) -> Expr:
    """Return whether the cost of a fit differs from that of the previous minimax start."""
    return ca.fabs(cost - previous) > MINIMAX.same_cost_tolerance * previous


@dataclass(frozen=True, eq=False)
class _ContactWeights:
    """Error ratios of the contacts and their weights in the p-norm.

    Attributes:
        scaled: Residual rows divided by the tolerances (size, 1).
        ratios: Ratio of error to tolerance of each position and orientation (2 f, 1).
        largest: Largest ratio.
        power: Exponent p.
        weights: Weights ``(ratio / largest)**(p - 2)``.
    """

    scaled: Expr
    ratios: Expr
    largest: Expr
    power: Expr
    weights: Expr


def _contact_weights(
    residual: Expr, contacts: ContactRows, powers_done: Expr, p: dict[str, Expr]
) -> _ContactWeights:
    """Return the error ratios of a residual and their weights for the current power."""
    scaled = _relative_to_tolerances(residual, contacts, p)
    ratios = _contact_norms(scaled, contacts)
    largest = ca.fmax(ca.mmax(ratios), SMALLEST_NORM)
    power = sum(
        (ca.if_else(powers_done == i, value, 0.0) for i, value in enumerate(MINIMAX.powers)),
        ca.SX(0),
    )
    return _ContactWeights(scaled, ratios, largest, power, (ratios / largest) ** (power - 2))


def reweighted(
    residual_before: Expr,
    jacobian: Expr,
    contacts: ContactRows,
    powers_done: Expr,
    p: dict[str, Expr],
) -> tuple[Expr, Expr]:
    """Return the reweighted least-squares problem of a Gauss-Newton step of the p-norm.

    The rows of a contact are weighted by `_ContactWeights.weights`. Along its error the weight is
    p - 1 times as large: the Jacobian is stretched along the error and the residual is shortened.

    Args:
        residual_before: Residual (size, 1) of the contacts.
        jacobian: Jacobian (size, n) of the residual.
        contacts: Rows of the contacts.
        powers_done: Number of completed powers of `MINIMAX.powers`.
        p: Parameters.

    Returns:
        Residual (size, 1) and Jacobian (size, n).
    """
    weights = _contact_weights(residual_before, contacts, powers_done, p)
    tolerances = residual_tolerances(p)
    residual, rows = [], []
    for i, rows_of_contact in enumerate(contacts.slices):
        dense, columns = in_columns(jacobian[rows_of_contact, :])
        scalars = (weights.ratios[i], weights.weights[i], weights.power, tolerances[i])
        contact_residual, contact_slopes = _stretched(*dense.shape)(
            residual_before[rows_of_contact], dense, *scalars
        )
        residual.append(contact_residual)
        rows.append(contact_slopes @ columns)
    return ca.vertcat(*residual), ca.vertcat(*rows)


@cache
def _stretched(rows: int, columns: int) -> ca.Function:
    """Return ``(residual, slopes, ratio, weight, power, tolerance) -> (residual, slopes)``."""
    residual, slopes = ca.SX.sym("residual", rows), ca.SX.sym("slopes", rows, columns)
    scalars = length, weight, power, tolerance = [
        ca.SX.sym(name) for name in ("length", "weight", "power", "allowed")
    ]
    factor, size = ca.sqrt(power - 1), ca.sqrt(weight) / tolerance
    direction = residual / (tolerance * ca.fmax(length, SMALLEST_NORM))
    stretched_residual = size / factor * residual
    stretched_slopes = size * (slopes + direction @ ((factor - 1) * (direction.T @ slopes)))
    return call_function(
        "stretched", [residual, slopes, *scalars], [stretched_residual, stretched_slopes]
    )


def minimax_trial(
    problem: ContactLeastSquares, q: Expr, damping: Expr, powers_done: Expr, parameters: Expr
) -> TrialStep:
    """Return a step that reduces the p-norm of the error ratios, see `minimax_step`.

    Args:
        problem: Problem of the contacts.
        q: (n, 1) configuration before the step.
        damping: Scalar, of the state.
        powers_done: Number of completed powers of `MINIMAX.powers`.
        parameters: Parameters of the method.
    """
    p, bounds = problem.layout.unpack(parameters), problem.bounds(q, parameters)
    residual_before, jacobian = problem.linearised(q, parameters)
    right, slopes = reweighted(residual_before, jacobian, problem.rows, powers_done, p)
    normal, gradient = normal_equations(slopes, right)
    low, high = bounds.lower - q, bounds.upper - q
    step = solve_box_qp(normal, MINIMAX.damping * damping, gradient, low, high, FIT.passes)
    x_after = clip(q + step, bounds)
    max_change = ca.mmax(ca.fabs(x_after - q))
    return TrialStep(
        x_after, residual_before, problem.linearised(x_after, parameters)[0], ca.SX(0), max_change
    )


def minimax_step(
    q: Expr, trial: TrialStep, contacts: ContactRows, s: dict[str, Expr], p: dict[str, Expr]
) -> MinimaxStep:
    """Evaluate a trial step of the minimax stage.

    Args:
        q: (n, 1) configuration before the step.
        trial: Trial step with the residuals of the contacts.
        contacts: Rows of the contacts.
        s: State with damping, power (number of completed `MINIMAX.powers`) and spent.
        p: Parameters.
    """
    initial = _contact_weights(trial.residual_before, contacts, s["power"], p)
    weights, ratios_before, largest = initial.weights, initial.ratios, initial.largest
    power = initial.power
    ratios_after = _contact_norms(_relative_to_tolerances(trial.residual, contacts, p), contacts)
    # Saturated because large ratios overflow at high powers.
    growth = ca.fmin(ratios_after / largest, MINIMAX.max_growth)
    sum_before, sum_after = (
        ca.dot(weights, ratios_before**2),
        ca.dot(growth ** (power - 2), ratios_after**2),
    )
    accepted = sum_after < sum_before
    ratios = ca.if_else(accepted, ratios_after, ratios_before)
    damping = MINIMAX.damping * s["damping"]
    is_stalled = ca.if_else(
        accepted, sum_after > MINIMAX.stall_ratio * sum_before, damping > MINIMAX.damping_ceiling
    )
    powers_done = s["power"] + is_stalled
    steps = s["stage_iterations"] + 1
    is_finished = ca.logic_or(powers_done >= len(MINIMAX.powers), steps >= MINIMAX.budget)
    power_sum = ca.if_else(accepted, sum_after, sum_before) * largest ** (power - 2)
    is_infeasible = power_sum > len(contacts.slices) * MINIMAX.infeasible_ratio**power
    is_finished = ca.logic_or(is_finished, ca.logic_and(is_stalled, is_infeasible))
    damping_factor = ca.if_else(accepted, MINIMAX.damping_decrease, MINIMAX.damping_increase)
    state = {
        "damping": ca.fmax(s["damping"] * damping_factor, MINIMAX.damping_floor),
        "power": powers_done,
        "stage_iterations": steps,
    }
    return MinimaxStep(
        q=ca.if_else(accepted, trial.x, q),
        accepted=accepted,
        within=ca.mmax(ratios) <= 1,
        is_finished=is_finished,
        largest=ca.mmax(ratios),
        state=state,
    )


def _relative_to_tolerances(values: Expr, contacts: ContactRows, p: dict[str, Expr]) -> Expr:
    """Return rows (size, k) of the contacts divided by the tolerances."""
    return values / _repeat_by_rows(residual_tolerances(p), contacts)


def _repeat_by_rows(values: Expr, contacts: ContactRows) -> Expr:
    """Repeat a value of each position and orientation (2 f, 1) for each of its rows (size, 1)."""
    sizes = [rows.stop - rows.start for rows in contacts.slices]
    return ca.vertcat(*(ca.repmat(values[i], size, 1) for i, size in enumerate(sizes)))


def _contact_norms(scaled: Expr, contacts: ContactRows) -> Expr:
    return ca.vertcat(*(ca.norm_2(scaled[rows]) for rows in contacts.slices))
