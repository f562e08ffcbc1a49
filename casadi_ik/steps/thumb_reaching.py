"""Thumb reaching: three tasks in a hierarchy (Qiu & Kermani 2021, section II-B).

Palm orientation first, then the thumb's contact point, then the thumb's normal, each solved by a
damped least-squares step and projected into the null space of those above it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from casadi_ik.steps.targets import Target
from casadi_ik.symbolic.actuated import ActuatedKinematics
from casadi_ik.symbolic.directions import normal_error
from casadi_ik.symbolic.linear_algebra import project_to_null_space
from casadi_ik.symbolic.smooth import safe_norm
from casadi_ik.symbolic.so3 import euler_zyx, log_so3

TaskSolver = Callable[[ca.SX, ca.SX], ca.SX]
"""Turns a task's Jacobian (m, k) and error (m, 1) into a joint step (k, 1)."""

MILLIMETRE = 1e-3
"""The paper's solver works in millimetres and radians: its damping factors say so."""


@dataclass(frozen=True, eq=False)
class Task:
    """A Jacobian (m, k) over some actuators and the error (m, 1) it is to remove."""

    jacobian: ca.SX
    error: ca.SX


def palm_orientation_task(
    body: ActuatedKinematics, desired: ca.SX, actuators: tuple[int, ...], euler: bool
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
        return Task(body.palm_euler_jacobian(actuators), wrapped)
    _, angular = body.palm_jacobian(actuators)
    return Task(angular, log_so3(desired @ current.T))


def thumb_tasks(
    body: ActuatedKinematics, goal: Target, actuators: tuple[int, ...]
) -> tuple[Task, Task]:
    """The thumb's contact point [mm] and normal [rad], eq. (3)."""
    thumb = body.robot.thumb
    point, normal = body.kinematics.contact(thumb)
    linear, angular = body.contact_jacobian(thumb, actuators)
    position = Task(linear / MILLIMETRE, (goal.point - point) / MILLIMETRE)
    return position, Task(angular, normal_error(normal, goal.normal))


def hierarchy_step(tasks: list[Task], solver: TaskSolver) -> ca.SX:
    """Successive null-space projection: dq = dq_1 + N_1 dq_2 + N_1 N_2 dq_3 + ... (k, 1).

    Every task is solved on its own; N_i = I - J_i^+ J_i.
    """
    total = ca.SX.zeros(tasks[0].jacobian.shape[1], 1)
    for level, task in enumerate(tasks):
        step = solver(task.jacobian, task.error)
        for higher in reversed(tasks[:level]):
            step = project_to_null_space(higher.jacobian, step)
        total = total + step
    return total


def clamped(error: ca.SX, longest: ca.SX) -> ca.SX:
    """An error shortened to a length, direction kept (Buss & Kim 2005)."""
    return error * ca.fmin(1.0, longest / ca.fmax(safe_norm(error), 1e-12))
