"""A Gauss-Newton step along the closed chain of arm and thumb, within the joint limits.

The contact of the thumb is a constraint; the errors of the other fingers are minimised:

    y = J_t^# e_t + N z,    z = argmin |J_o (J_t^# e_t + N z) - e_o|^2 + damping^2 |z|^2

J_t are the rows of the thumb (five for point and normal), N projects onto their null space (the
motions of the closed chain, one dimension per mobility, and the joints of the other fingers), and
J_o are the rows of the other fingers. The method selects no active joints, so that no H_p can be
singular.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.errors import optional_import
from casadi_ik.kinematics.contacts import (
    LENGTH,
    POSITION,
    ContactRows,
    fixed_goal_rates,
    tip_jacobians,
    tip_vectors,
)
from casadi_ik.kinematics.forward import ActuatedKinematics, actuated, motor_scales
from casadi_ik.kinematics.linear_algebra import damped_pinv_times, project_to_null_space
from casadi_ik.kinematics.smooth import Expr, safe_norm, with_cse
from casadi_ik.model.description import RobotDescription

THUMB_MERIT = 4.0
"""Weight of the squared errors of the thumb in the cost [-]: steps that improve the thumb at the
expense of the other fingers remain acceptable. Source: on 2400 targets (12 shipped grasps, distal
joints 25-45 deg, random arms) the failures of one start fell from 24 to 11; a weight of 10 had no
further effect."""


@dataclass(frozen=True, eq=False)
class ContactErrors:
    """Distances (f, 1) [m], angles (f, 1) [rad] and weighted sum of squares at a configuration."""

    positions: Expr
    angles: Expr
    cost: Expr


def evaluate_contacts(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]
) -> ContactErrors:
    """Return the contact errors and the cost of a configuration.

    Args:
        robot: Description of the robot.
        rows: Rows of the contacts.
        q: (n, 1) configuration.
        p: Parameters.
    """
    positions, angles = contact_errors(robot, rows, q, p)
    return ContactErrors(
        ca.vertcat(*(LENGTH * safe_norm(x) for x in positions)),
        ca.vertcat(*(safe_norm(x) for x in angles)),
        sum(
            (
                (THUMB_MERIT if name == robot.thumb else 1.0)
                * ca.sumsqr(ca.vertcat(position, angle))
                for name, position, angle in zip(robot.finger_names, positions, angles, strict=True)
            ),
            ca.SX(0),
        ),
    )


PROXQP_ITERATIONS = 30
"""Maximum number of outer iterations; infeasible programs in a narrow box converge slowly."""

PROXQP_ACCURACY = 1e-9
"""Absolute residual at which a program counts as solved."""


class ProxqpNode(ca.Callback):
    """Node ``(H, g, A, b, lower, upper) -> x``: minimiser of x'Hx/2 + g'x, Ax = b, in a box."""

    def __init__(self, n: int, m: int) -> None:
        """Construct the node for n unknowns and m equations."""
        ca.Callback.__init__(self)
        self._shapes = [(n, n), (n, 1), (m, n), (m, 1), (n, 1), (n, 1)]
        self.construct(f"proxqp_{n}_{m}", {})

    def get_n_in(self) -> int:
        """Return the number of inputs."""
        return len(self._shapes)

    def get_n_out(self) -> int:
        """Return the number of outputs."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of an input, dense."""
        return ca.Sparsity.dense(*self._shapes[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Return the shape of the output, dense."""
        del i
        return ca.Sparsity.dense(*self._shapes[1])

    def eval(self, arg: Any) -> list[Any]:
        """Solve one program; infeasible equations are replaced by the closest feasible ones."""
        with optional_import('step="proxqp"'):
            from proxsuite import proxqp as backend

        H, g, A, b, lower, upper = (np.array(x) for x in arg)
        program = backend.dense.QP(len(g), len(b), 0, True)
        program.settings.eps_abs = PROXQP_ACCURACY
        program.settings.primal_infeasibility_solving = True
        program.settings.max_iter = PROXQP_ITERATIONS
        absent = None
        vectors = (lower.ravel(), upper.ravel())
        program.init(H, g.ravel(), A, b.ravel(), absent, absent, absent, *vectors)
        program.solve()
        return [ca.DM(program.results.x.tolist())]


@cache
def proxqp(n: int, m: int) -> ProxqpNode:
    """Return the node for n unknowns and m equations; cached, as a graph does not own its nodes."""
    return ProxqpNode(n, m)


THUMB_DAMPING = 0.01
"""Smallest damping [-] of the thumb rows, 1 mm per rad: keeps J_t^# finite at singularities."""

PROJECTOR_DAMPING = 1e-5
"""Damping [-] of the projector N; the resulting error of the thumb is negligible."""

LIMIT_ROUNDING = 1e-9
"""Violation of a limit above which its motor is fixed [scaled motor units]."""

MAX_FIXED_JOINTS = 8
"""Maximum number of motors that one step fixes at limits."""


@dataclass(frozen=True, eq=False)
class LinearisedContacts:
    """Contact errors linearised at a configuration.

    Attributes:
        thumb: (m, n) Jacobian of the thumb, positions divided by `LENGTH`, orientations in rad;
            five rows for a point and a normal.
        thumb_error: (m, 1) errors of the thumb.
        other_fingers: (m', n) Jacobian of the other fingers, stacked by finger.
        other_fingers_error: (m', 1) errors of the other fingers.
    """

    thumb: Expr
    thumb_error: Expr
    other_fingers: Expr
    other_fingers_error: Expr


@dataclass(frozen=True, eq=False)
class StepLimits:
    """Bounds and damping of a step.

    Attributes:
        lower: (n, 1) smallest change of every motor, <= 0.
        upper: (n, 1) largest change of every motor, >= 0.
        damping: Damping of z.
    """

    lower: Expr
    upper: Expr
    damping: Expr


StepSolver = Callable[[LinearisedContacts, StepLimits], tuple[Expr, Expr]]
"""Solver that returns the step (n, 1) and a mask of the motors fixed at limits (n, 1)."""


def contact_errors(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]
) -> tuple[list[Expr], list[Expr]]:
    """Return errors of all contacts (3, 1): positions / `LENGTH` and orientations [rad]."""
    return _condition_errors(actuated(robot, q), rows, p)


def _condition_errors(
    body: ActuatedKinematics, rows: ContactRows, p: dict[str, Expr]
) -> tuple[list[Expr], list[Expr]]:
    positions, angles = [], []
    goals = zip(body.robot.finger_names, rows.kinds, rows.goals(p), strict=True)
    for i, (name, kind, goal) in enumerate(goals):
        tip = tip_vectors(body.kinematics, name)
        position, orientation = kind.conditions
        positions.append(p["weights"][i, 0] * position.error(tip, goal) / LENGTH)
        angles.append(p["weights"][i, 1] * orientation.error(tip, goal))
    return positions, angles


def linearise_contacts(
    robot: RobotDescription, contacts: ContactRows, q: Expr, p: dict[str, Expr]
) -> LinearisedContacts:
    """Return the contacts linearised at q (n, 1); rows of free conditions are zero."""
    body, scales = actuated(robot, q), motor_scales(robot)
    condition_errors = _condition_errors(body, contacts, p)
    rows: dict[bool, list[Expr]] = {True: [], False: []}
    errors: dict[bool, list[Expr]] = {True: [], False: []}
    goals = contacts.goals(p)
    for i, (name, kind) in enumerate(zip(robot.finger_names, contacts.kinds, strict=True)):
        contact_jacobians = body.contact_jacobian(name, range(q.numel()))
        tip, jacobians = (
            tip_vectors(body.kinematics, name),
            tip_jacobians(body, name, range(q.numel())),
        )
        is_thumb = name == robot.thumb
        weighted = []
        for aspect, condition in enumerate(kind.conditions):
            directions = condition.directions(tip, goals[i]) if condition.directions else None
            slope, error = contact_jacobians[aspect], condition_errors[aspect][i]
            if condition.aspect == POSITION and condition.directions is None:
                slope = condition.jacobian(
                    tip, jacobians, goals[i], fixed_goal_rates(goals, q.numel())[i]
                )
            if directions is not None:
                slope, error = directions @ slope, directions @ error
            slope = p["weights"][i, aspect] * slope
            weighted.append(slope / LENGTH if condition.aspect == POSITION else slope)
            errors[is_thumb].append(error)
        stacked = ca.vertcat(*weighted)
        rows[is_thumb].append(ca.sparsify(stacked) * ca.repmat(scales.T, stacked.shape[0], 1))
    n = q.numel()
    return LinearisedContacts(
        ca.vertcat(*rows[True]),
        ca.vertcat(*errors[True]),
        ca.vertcat(ca.SX(0, n), *rows[False]),
        ca.vertcat(ca.SX(0, 1), *errors[False]),
    )


def thumb_step(linearised: LinearisedContacts, damping: Expr) -> Expr:
    """Return J_t^# e_t, the damped minimum-norm step (n, 1) for the thumb alone."""
    return damped_pinv_times(
        linearised.thumb, linearised.thumb_error, ca.fmax(THUMB_DAMPING, damping)
    )


def free_step(linearised: LinearisedContacts, damping: Expr) -> Expr:
    """Return the step (n, 1) without limits."""
    step_of_thumb = thumb_step(linearised, damping)
    if linearised.other_fingers.shape[0] == 0:
        return step_of_thumb
    # The rows of J_o N are in the range of N; the result requires no further projection.
    J_o_N = project_to_null_space(linearised.thumb, linearised.other_fingers.T, PROJECTOR_DAMPING).T
    remaining_error = linearised.other_fingers_error - linearised.other_fingers @ step_of_thumb
    return step_of_thumb + damped_pinv_times(J_o_N, remaining_error, damping)


def solve_by_fixing(linearised: LinearisedContacts, limits: StepLimits) -> tuple[Expr, Expr]:
    """Solve within limits by repeatedly fixing the motor with the largest violation.

    Args:
        linearised: Linearised contacts as MX expressions, because further passes are conditional.
        limits: Bounds and damping as MX expressions.

    Returns:
        Step (n, 1) and 1 for every fixed motor (n, 1).
    """
    problem = [
        linearised.thumb,
        linearised.thumb_error,
        linearised.other_fingers,
        linearised.other_fingers_error,
    ]
    problem += [limits.lower, limits.upper, limits.damping]
    first_pass = _pass_function([matrix.sparsity() for matrix in problem])
    step, is_fixed, values, is_violated = first_pass(
        *problem, limits.lower >= limits.upper, limits.lower
    )
    symbols = [ca.MX.sym("x", first_pass.sparsity_in(i)) for i in range(first_pass.n_in())]
    inputs = [*symbols, ca.MX.sym("step", *step.shape)]
    next_pass = ca.Function("next_pass", inputs, list(first_pass(*symbols)))
    unchanged = ca.Function("unchanged", inputs, [inputs[-1], symbols[-2], symbols[-1], ca.MX(0)])
    pass_if_violated = ca.Function.if_else("pass_if_violated", next_pass, unchanged)
    for _ in range(MAX_FIXED_JOINTS - 1):
        step, is_fixed, values, is_violated = pass_if_violated(
            is_violated, *problem, is_fixed, values, step
        )
    return ca.fmin(ca.fmax(step, limits.lower), limits.upper), is_fixed


def _pass_function(sparsities: list[ca.Sparsity]) -> ca.Function:
    """Return ``(problem, is_fixed, values) -> (step, is_fixed, values, is_violated)``.

    A motor that violates its limit most is fixed there for the next pass.
    """
    n = sparsities[0].size2()
    thumb, thumb_error, other_fingers, other_fingers_error, lower, upper, damping = (
        ca.SX.sym("x", sparsity) for sparsity in sparsities
    )
    is_fixed, values = ca.SX.sym("is_fixed", n), ca.SX.sym("values", n)
    free, contribution = (1 - is_fixed).T, is_fixed * values
    masked = LinearisedContacts(
        thumb * ca.repmat(free, thumb.shape[0], 1),
        thumb_error - thumb @ contribution,
        other_fingers * ca.repmat(free, other_fingers.shape[0], 1),
        other_fingers_error - other_fingers @ contribution,
    )
    step = free_step(masked, damping) + contribution
    violation = ca.fmax(lower - step, step - upper) * (1 - is_fixed)
    worst = ca.mmax(violation)
    is_violated = worst > LIMIT_ROUNDING
    fix_now = ca.logic_and(is_violated, violation >= worst)
    outputs = [
        step,
        ca.if_else(fix_now, 1.0, is_fixed),
        ca.if_else(fix_now, ca.if_else(step > upper, upper, lower), values),
        is_violated,
    ]
    inputs = [
        thumb,
        thumb_error,
        other_fingers,
        other_fingers_error,
        lower,
        upper,
        damping,
        is_fixed,
        values,
    ]
    return ca.Function("solve_and_fix", inputs, with_cse(*map(ca.densify, outputs)))


def solve_by_proxqp(linearised: LinearisedContacts, limits: StepLimits) -> tuple[Expr, Expr]:
    """Solve the same problem as a quadratic program within limits, by ProxQP.

    The rows of the thumb are equations. If the limits make them infeasible, ProxQP solves the
    closest feasible problem, so that the thumb keeps its priority. Returns as `solve_by_fixing`.
    """
    m, n = linearised.thumb.shape
    thumb_motion = linearised.thumb @ thumb_step(linearised, limits.damping)
    hessian = linearised.other_fingers.T @ linearised.other_fingers + limits.damping**2 * ca.DM.eye(
        n
    )
    gradient = -linearised.other_fingers.T @ linearised.other_fingers_error
    program = (hessian, gradient, linearised.thumb, thumb_motion, limits.lower, limits.upper)
    solution = proxqp(n, m)(*map(ca.densify, program))
    step = ca.fmin(ca.fmax(solution, limits.lower), limits.upper)
    return step, ca.logic_or(step <= limits.lower, step >= limits.upper)


STEP_SOLVERS: dict[str, StepSolver] = {"freeze": solve_by_fixing, "proxqp": solve_by_proxqp}
"""Step solvers by value of `ThumbFirstParameters.step`."""
