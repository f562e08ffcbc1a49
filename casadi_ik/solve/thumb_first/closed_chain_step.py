"""A Gauss-Newton step along the closed chain of arm and thumb, within the joint limits.

The thumb's contact is a constraint, the other fingers are what is left to minimise:

    y = J_t^# e_t + N z,    z = argmin |J_o (J_t^# e_t + N z) - e_o|^2 + damping^2 |z|^2

with J_t the thumb's rows (five for point and normal), N the projector into their null space (the
motions of the closed chain, one dimension per mobility, together with the other fingers' own
joints) and J_o the rows of the other fingers. No active joints have to be chosen, so there is no
H_p that could be singular.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

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
"""How much more the thumb's squared errors count when a step is judged: a step serves the thumb
first, and one that does so at the others' cost is not to be refused for it. On 2400 targets (12
shipped grasps, distal joints 25-45 deg, random arms) the failures of one start fell from 24 to 11;
10 gained nothing more."""


@dataclass(frozen=True, eq=False)
class Merit:
    """Contacts at a configuration: (f, 1) distances [m], (f, 1) angles [rad], summed squares."""

    positions: Expr
    angles: Expr
    cost: Expr


def merit(robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]) -> Merit:
    """Judge a configuration.

    Args:
        robot: The description.
        rows: The contacts' kinds.
        q: (n, 1) the configuration.
        p: Parameters.
    """
    positions, angles = contact_errors(robot, rows, q, p)
    return Merit(
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


ITERATIONS = 30
"""Of its outer loop: contradictions in a narrow box converge slowly, and the step is only tried."""

ACCURACY = 1e-9
"""Residuals at which a program counts as solved."""


class ProxqpNode(ca.Callback):
    """``(H, g, A, b, lower, upper) -> x``, the minimiser of x'Hx/2 + g'x with Ax = b in a box."""

    def __init__(self, n: int, m: int) -> None:
        """Make the node for n unknowns and m equations."""
        ca.Callback.__init__(self)
        self._shapes = [(n, n), (n, 1), (m, n), (m, 1), (n, 1), (n, 1)]
        self.construct(f"proxqp_{n}_{m}", {})

    def get_n_in(self) -> int:
        """Number of inputs."""
        return len(self._shapes)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of an input, dense."""
        return ca.Sparsity.dense(*self._shapes[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Shape of the output, dense."""
        del i
        return ca.Sparsity.dense(*self._shapes[1])

    def eval(self, arg: Any) -> list[Any]:
        """Solve one program; with contradicting equations the nearest that can be solved."""
        from proxsuite import proxqp as backend

        H, g, A, b, lower, upper = (np.array(x) for x in arg)
        program = backend.dense.QP(len(g), len(b), 0, True)
        program.settings.eps_abs = ACCURACY
        program.settings.primal_infeasibility_solving = True
        program.settings.max_iter = ITERATIONS
        nothing = None
        vectors = (lower.ravel(), upper.ravel())
        program.init(H, g.ravel(), A, b.ravel(), nothing, nothing, nothing, *vectors)
        program.solve()
        return [ca.DM(program.results.x.tolist())]


@cache
def proxqp(n: int, m: int) -> ProxqpNode:
    """The node for n unknowns and m equations; kept, since a graph does not keep it alive."""
    return ProxqpNode(n, m)


THUMB_DAMPING = 0.01
"""Least damping [-] of the thumb's rows, 1 mm per rad: J_t^# stays finite where J_t is singular."""

PROJECTOR_DAMPING = 1e-5
"""Damping [-] of the projector N: what it leaks is below rounding of what the contacts need."""

ROUNDING = 1e-9
"""A limit may be passed by this much [scaled motor units] before its motor is fixed."""

PASSES = 8
"""Joints that may be fixed at their limits one by one in a step."""


@dataclass(frozen=True, eq=False)
class Linear:
    """Contacts linearised at a configuration: errors and what moves them.

    Attributes:
        thumb: (m, n) rows of the thumb, places by `LENGTH`, facings in rad: five for a point and a
            normal.
        thumb_error: (m, 1) what is left.
        others: (m', n) rows of the other fingers, one finger after the other.
        others_error: (m', 1).
    """

    thumb: Expr
    thumb_error: Expr
    others: Expr
    others_error: Expr


@dataclass(frozen=True, eq=False)
class Room:
    """Where a step may go.

    Attributes:
        lower: (n, 1) smallest change of every motor, <= 0.
        upper: (n, 1) largest, >= 0.
        damping: Of z.
    """

    lower: Expr
    upper: Expr
    damping: Expr


StepSolver = Callable[[Linear, Room], tuple[Expr, Expr]]
"""Gives the step (n, 1) and which motors it holds at their limits (n, 1)."""


def contact_errors(
    robot: RobotDescription, rows: ContactRows, q: Expr, p: dict[str, Expr]
) -> tuple[list[Expr], list[Expr]]:
    """What is left of every contact: places (3, 1) by `LENGTH`, facings (3, 1) [rad]; 0 if free."""
    return _errors(actuated(robot, q), rows, p)


def _errors(
    body: ActuatedKinematics, rows: ContactRows, p: dict[str, Expr]
) -> tuple[list[Expr], list[Expr]]:
    positions, angles = [], []
    goals = zip(body.robot.finger_names, rows.kinds, rows.goals(p), strict=True)
    for i, (name, kind, goal) in enumerate(goals):
        tip = tip_vectors(body.kinematics, name)
        place, facing = kind.conditions
        positions.append(p["weights"][i, 0] * place.error(tip, goal) / LENGTH)
        angles.append(p["weights"][i, 1] * facing.error(tip, goal))
    return positions, angles


def linearised(
    robot: RobotDescription, contacts: ContactRows, q: Expr, p: dict[str, Expr]
) -> Linear:
    """The contacts at q (n, 1); rows of what is free are zero."""
    body, scales = actuated(robot, q), motor_scales(robot)
    left = _errors(body, contacts, p)
    rows: dict[bool, list[Expr]] = {True: [], False: []}
    errors: dict[bool, list[Expr]] = {True: [], False: []}
    goals = contacts.goals(p)
    for i, (name, kind) in enumerate(zip(robot.finger_names, contacts.kinds, strict=True)):
        moved = body.contact_jacobian(name, range(q.numel()))
        tip, rates = (
            tip_vectors(body.kinematics, name),
            tip_jacobians(body, name, range(q.numel())),
        )
        mine = name == robot.thumb
        weighted = []
        for aspect, condition in enumerate(kind.conditions):
            across = condition.directions(tip, goals[i]) if condition.directions else None
            slope, error = moved[aspect], left[aspect][i]
            if condition.aspect == POSITION and condition.directions is None:
                slope = condition.jacobian(
                    tip, rates, goals[i], fixed_goal_rates(goals, q.numel())[i]
                )
            if across is not None:
                slope, error = across @ slope, across @ error
            slope = p["weights"][i, aspect] * slope
            weighted.append(slope / LENGTH if condition.aspect == POSITION else slope)
            errors[mine].append(error)
        together = ca.vertcat(*weighted)
        rows[mine].append(ca.sparsify(together) * ca.repmat(scales.T, together.shape[0], 1))
    n = q.numel()
    return Linear(
        ca.vertcat(*rows[True]),
        ca.vertcat(*errors[True]),
        ca.vertcat(ca.SX(0, n), *rows[False]),
        ca.vertcat(ca.SX(0, 1), *errors[False]),
    )


def thumb_step(linear: Linear, damping: Expr) -> Expr:
    """J_t^# e_t: the shortest step (n, 1) that serves the thumb alone, damped."""
    return damped_pinv_times(linear.thumb, linear.thumb_error, ca.fmax(THUMB_DAMPING, damping))


def free_step(linear: Linear, damping: Expr) -> Expr:
    """The step (n, 1) without limits."""
    first = thumb_step(linear, damping)
    if linear.others.shape[0] == 0:
        return first
    # J_o N; its transpose is in the range of N, so what it gives needs no further projection.
    within = project_to_null_space(linear.thumb, linear.others.T, PROJECTOR_DAMPING).T
    rest = linear.others_error - linear.others @ first
    return first + damped_pinv_times(within, rest, damping)


def freezing(linear: Linear, room: Room) -> tuple[Expr, Expr]:
    """Within the limits: what violates them most is fixed there, and the step is solved again.

    Args:
        linear: Of MX symbols, since further passes are only made where they are needed.
        room: Likewise.

    Returns:
        The step (n, 1) and 1 for every motor that was fixed (n, 1).
    """
    problem = [linear.thumb, linear.thumb_error, linear.others, linear.others_error]
    problem += [room.lower, room.upper, room.damping]
    once = _solved_and_fixed([matrix.sparsity() for matrix in problem])
    step, held, values, over = once(*problem, room.lower >= room.upper, room.lower)
    symbols = [ca.MX.sym("x", once.sparsity_in(i)) for i in range(once.n_in())]
    inputs = [*symbols, ca.MX.sym("step", *step.shape)]
    again = ca.Function("again", inputs, list(once(*symbols)))
    same = ca.Function("same", inputs, [inputs[-1], symbols[-2], symbols[-1], ca.MX(0)])
    choose = ca.Function.if_else("fix_another", again, same)
    for _ in range(PASSES - 1):
        step, held, values, over = choose(over, *problem, held, values, step)
    return ca.fmin(ca.fmax(step, room.lower), room.upper), held


def _solved_and_fixed(sparsities: list[ca.Sparsity]) -> ca.Function:
    """``(problem, held, values) -> (step, held', values', over)``; over: one more was fixed."""
    n = sparsities[0].size2()
    thumb, thumb_error, others, others_error, lower, upper, damping = (
        ca.SX.sym("x", sparsity) for sparsity in sparsities
    )
    held, values = ca.SX.sym("held", n), ca.SX.sym("values", n)
    free, fixed = (1 - held).T, held * values
    masked = Linear(
        thumb * ca.repmat(free, thumb.shape[0], 1),
        thumb_error - thumb @ fixed,
        others * ca.repmat(free, others.shape[0], 1),
        others_error - others @ fixed,
    )
    step = free_step(masked, damping) + fixed
    beyond = ca.fmax(lower - step, step - upper) * (1 - held)
    worst = ca.mmax(beyond)
    over = worst > ROUNDING
    fix = ca.logic_and(over, beyond >= worst)
    outputs = [
        step,
        ca.if_else(fix, 1.0, held),
        ca.if_else(fix, ca.if_else(step > upper, upper, lower), values),
        over,
    ]
    inputs = [thumb, thumb_error, others, others_error, lower, upper, damping, held, values]
    return ca.Function("solved_and_fixed", inputs, with_cse(*map(ca.densify, outputs)))


def quadratic_program(linear: Linear, room: Room) -> tuple[Expr, Expr]:
    """The same problem as a quadratic program within the limits, by ProxQP.

    The thumb's rows are equations; where the limits leave no solution, ProxQP takes the nearest
    that there is, so that the thumb still comes first. Returns as `freezing`.
    """
    m, n = linear.thumb.shape
    demanded = linear.thumb @ thumb_step(linear, room.damping)
    hessian = linear.others.T @ linear.others + room.damping**2 * ca.DM.eye(n)
    gradient = -linear.others.T @ linear.others_error
    program = (hessian, gradient, linear.thumb, demanded, room.lower, room.upper)
    found = proxqp(n, m)(*map(ca.densify, program))
    step = ca.fmin(ca.fmax(found, room.lower), room.upper)
    return step, ca.logic_or(step <= room.lower, step >= room.upper)


STEP_SOLVERS: dict[str, StepSolver] = {"freeze": freezing, "proxqp": quadratic_program}
"""By the name of `ThumbFirstParameters.step`."""
