"""Tasks: what is to be brought to zero, and how the motors move it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.qiu.selectively_damped import selectively_damped
from casadi_ik.problem.contacts.kinds import USUAL
from casadi_ik.problem.contacts.rows import tip_vectors
from casadi_ik.problem.target import Target
from casadi_ik.symbolic.actuated import ActuatedKinematics
from casadi_ik.symbolic.linear_algebra import damped_pinv_times, weighted_damped_pinv_times
from casadi_ik.symbolic.smooth import Expr, safe_norm
from casadi_ik.symbolic.so3 import euler_zyx, log_so3

MILLIMETRE = 1e-3
"""The paper's solvers work in millimetres and radians: their damping factors say so."""


@dataclass(frozen=True, eq=False)
class Task:
    """One end effector's position or orientation.

    Attributes:
        jacobian: (3, k) over some actuators [mm or rad per rad or m].
        error: (3, 1) what is left [mm or rad].
        is_position: Whether it is a position [mm], else an orientation [rad].
    """

    jacobian: Expr
    error: Expr
    is_position: bool


TaskSolver = Callable[[Task], Expr]
"""Turns a task into a step (k, 1) of its actuators."""


def palm_orientation_task(
    body: ActuatedKinematics, desired: Expr, actuators: Sequence[int], euler: bool
) -> Task:
    """The palm's orientation; error by Euler angles as in the paper, or by rotation vector.

    Args:
        body: Kinematics over q.
        desired: (3, 3) desired orientation of the palm, base frame.
        actuators: Columns of the Jacobian.
        euler: True: differences of ZYX Euler angles, each wrapped to (-pi, pi], and the analytic
            Jacobian. False: rotation logarithm and geometric Jacobian.
    """
    current = body.kinematics.palm.rotation
    if euler:
        difference = euler_zyx(desired) - euler_zyx(current)
        wrapped = ca.atan2(ca.sin(difference), ca.cos(difference))
        return Task(body.palm_euler_jacobian(actuators), wrapped, is_position=False)
    _, angular = body.palm_jacobian(actuators)
    return Task(angular, log_so3(desired @ current.T), is_position=False)


def contact_tasks(
    body: ActuatedKinematics, finger: str, goal: Target, actuators: Sequence[int]
) -> tuple[Task, Task]:
    """A finger's contact point and normal, Qiu & Kermani 2021, eq. (3)."""
    tip, target = tip_vectors(body.kinematics, finger), goal.vectors
    place, facing = USUAL.conditions
    linear, angular = body.contact_jacobian(finger, actuators)
    position = Task(linear / MILLIMETRE, place.error(tip, target) / MILLIMETRE, is_position=True)
    return position, Task(angular, facing.error(tip, target), is_position=False)


def damped(damping: Expr) -> TaskSolver:
    """Damped least squares (Wampler 1986) with one damping factor [mm; rad/rad]."""
    return lambda task: damped_pinv_times(task.jacobian, task.error, damping)


def selective(gamma_max: Expr, longest: Expr, widest: Expr) -> TaskSolver:
    """Selectively damped least squares (Buss & Kim 2005).

    Args:
        gamma_max: Largest change of any actuator [rad or m].
        longest: Position errors are shortened to this [mm].
        widest: Orientation errors are shortened to this [rad].
    """

    def solve(task: Task) -> Expr:
        limit = longest if task.is_position else widest
        return selectively_damped(task.jacobian, clamped(task.error, limit), gamma_max)

    return solve


def weighted_damped(damping: Expr, weights: Expr) -> TaskSolver:
    """Weighted damped least squares (Chan & Dubey 1995); a heavy actuator (k, 1) moves little."""
    return lambda task: weighted_damped_pinv_times(task.jacobian, task.error, damping, weights)


def weighted(solver: TaskSolver, weights: Expr) -> TaskSolver:
    """Any solver in the weighted coordinates sqrt(w_i) q_i, as weighted damping does it."""
    scale = 1 / ca.sqrt(weights)

    def solve(task: Task) -> Expr:
        scaled = task.jacobian * ca.repmat(scale.T, task.jacobian.shape[0], 1)
        return scale * solver(Task(scaled, task.error, task.is_position))

    return solve


def clamped(error: Expr, longest: Expr) -> Expr:
    """An error shortened to a length, its direction kept."""
    return error * ca.fmin(1.0, longest / ca.fmax(safe_norm(error), 1e-12))
