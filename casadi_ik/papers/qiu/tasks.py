"""Tasks of Qiu & Kermani 2021 and their combination.

Tasks of contacts and of the palm orientation, the estimate of this orientation from contacts (eqs.
1 and 2), steps by damped and selectively damped least squares, projection of a task to the null
space of tasks with higher priority, and the motion of the palm along the closed chain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import POINT_AND_NORMAL, Target, tip_vectors
from casadi_ik.kinematics.forward import ActuatedKinematics, forward, number
from casadi_ik.kinematics.linear_algebra import (
    damped_pinv_times,
    project_to_null_space,
    solve_spd,
    svd,
    weighted_damped_pinv_times,
)
from casadi_ik.kinematics.se3 import (
    euler_zyx,
    log_se3,
    log_so3,
    mean_rotation,
    project_to_rotation,
    rotation_between,
)
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.model.description import RobotDescription

MILLIMETRE = 1e-3
"""Length of a millimetre [m]; the damping factors of the paper refer to millimetres and radians."""


@dataclass(frozen=True, eq=False)
class Task:
    """Position or orientation task of one end effector.

    Attributes:
        jacobian: (3, k) Jacobian with respect to some actuators [mm or rad per rad or m].
        error: (3, 1) desired minus current value [mm or rad].
        is_position: True for a position [mm], False for an orientation [rad].
    """

    jacobian: Expr
    error: Expr
    is_position: bool


TaskSolver = Callable[[Task], Expr]
"""Solver that returns the step (k, 1) of the actuators of a task."""


def palm_orientation_task(
    body: ActuatedKinematics, desired: Expr, actuators: Sequence[int], euler: bool
) -> Task:
    """Return the task of the palm orientation, by Euler angles as in the paper or rotation vector.

    Args:
        body: Kinematics over q.
        desired: (3, 3) desired orientation of the palm, base frame.
        actuators: Indices in q of the actuators: the columns of the Jacobian.
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
    """Return the tasks of contact point and normal of a finger, Qiu & Kermani 2021, eq. (3)."""
    tip, target = tip_vectors(body.kinematics, finger), goal.vectors
    point_condition, normal_condition = POINT_AND_NORMAL.conditions
    linear, angular = body.contact_jacobian(finger, actuators)
    error = point_condition.error(tip, target) / MILLIMETRE
    position = Task(linear / MILLIMETRE, error, is_position=True)
    return position, Task(angular, normal_condition.error(tip, target), is_position=False)


def damped(damping: Expr) -> TaskSolver:
    """Return the damped least-squares solver (Wampler 1986) for a damping factor [mm; rad/rad]."""
    return lambda task: damped_pinv_times(task.jacobian, task.error, damping)


def selective(gamma_max: Expr, longest: Expr, widest: Expr) -> TaskSolver:
    """Return the selectively damped least-squares solver (Buss & Kim 2005).

    Args:
        gamma_max: Largest change of any actuator [rad or m].
        longest: Largest position error; longer errors are scaled down [mm].
        widest: Largest orientation error; larger errors are scaled down [rad].
    """

    def solve(task: Task) -> Expr:
        limit = longest if task.is_position else widest
        return selectively_damped(task.jacobian, clamped(task.error, limit), gamma_max)

    return solve


def weighted_damped(damping: Expr, weights: Expr) -> TaskSolver:
    """Return the weighted damped least-squares solver (Chan & Dubey 1995) for weights (k, 1)."""
    return lambda task: weighted_damped_pinv_times(task.jacobian, task.error, damping, weights)


def weighted(solver: TaskSolver, weights: Expr) -> TaskSolver:
    """Return a solver in the weighted coordinates sqrt(w_i) q_i."""
    scale = 1 / ca.sqrt(weights)

    def solve(task: Task) -> Expr:
        scaled = task.jacobian * ca.repmat(scale.T, task.jacobian.shape[0], 1)
        return scale * solver(Task(scaled, task.error, task.is_position))

    return solve


def clamped(error: Expr, longest: Expr) -> Expr:
    """Return an error scaled down to at most a length."""
    return error * ca.fmin(1.0, longest / ca.fmax(safe_norm(error), 1e-12))


HIERARCHIES = ("successive", "augmented", "none")
"""Hierarchies of tasks; see `combine`."""

EXACT_DAMPING = 1e-6
"""Damping of a projector without a given damping [unit of the task's Jacobian]."""

RANK_FLOOR = 1e-3
"""Damping of the augmented projector [rad/rad, and m/rad]. The component of a row that higher tasks
leave free counts as zero below this norm."""


def combine(
    tasks: Sequence[Task],
    steps: Sequence[Expr],
    projection: str,
    damping: float | None = None,
) -> Expr:
    """Return the step (k, 1) for all tasks.

    Args:
        tasks: Tasks of the same actuators in order of decreasing priority.
        steps: (k, 1) step of each task without the other tasks.
        projection: "successive": dq_1 + N_1 dq_2 + N_1 N_2 dq_3 + ..., where N_i projects to the
            null space of task i. "augmented": dq_1 + N_1 dq_2 + N_12 dq_3 + ..., where N_12
            projects to that of the stacked tasks 1 and 2. "none": the sum, without priorities.
        damping: Damping of the pseudoinverse in the projectors [mm; rad/rad], with which lower
            tasks disturb higher ones; None: exact projectors except near singularities.
    """
    if projection == "none":
        return sum(steps[1:], steps[0])
    if projection == "successive":
        total = steps[0]
        for level in range(1, len(tasks)):
            step = steps[level]
            for higher in reversed(tasks[:level]):
                step = project_to_null_space(higher.jacobian, step, damping or EXACT_DAMPING)
            total = total + step
        return total
    projectors: list[Projector] = []
    for higher in tasks[:-1]:
        projectors.append(_projector(higher, projectors, damping))
    total = steps[-1]
    for step, projector in zip(reversed(steps[:-1]), reversed(projectors), strict=True):
        total = step + projector.of_column(total)
    return total


@dataclass(frozen=True, eq=False)
class Projector:
    """Projector N = I - Y' Z with Z = (Y Y' + damping^2 I)^-1 Y, stored as factors (3, k).

    Products of the factors with a vector take a third of the instructions of the matrix N.
    """

    Y: Expr
    Z: Expr

    def of_column(self, column: Expr) -> Expr:
        """Return N v for v (k, 1)."""
        return column - self.Y.T @ (self.Z @ column)

    def of_rows(self, rows: Expr) -> Expr:
        """Return R N for R (r, k)."""
        return rows - (rows @ self.Y.T) @ self.Z


def _projector(task: Task, higher: Sequence[Projector], damping: float | None) -> Projector:
    """Return the factor N_k of the projector N_1 N_2 ... N_k onto the null space of k tasks.

    Y = J N_1 ... N_k-1 is the component of the task in the null space of the higher tasks.
    """
    Y = task.jacobian
    if damping is None:
        damping, Y = RANK_FLOOR, Y * (MILLIMETRE if task.is_position else 1.0)
    for projector in higher:
        Y = projector.of_rows(Y)
    G = Y @ Y.T + damping**2 * ca.DM.eye(Y.shape[0])
    # Structural zeros are kept, because the highest tasks have many zero columns.
    columns = sorted(set(Y.sparsity().get_col()))
    Z = type(Y)(*Y.shape)
    Z[:, columns] = solve_spd(G, Y[:, columns])
    return Projector(Y, Z)


NEGLIGIBLE = 1e-9
"""Fraction of the largest singular value below which a singular value counts as zero."""


def selectively_damped(jacobian: Expr, error: Expr, gamma_max: Expr) -> Expr:
    """Return an SDLS step for one end effector.

    With J = sum sigma_i u_i v_i', alpha_i = u_i' e, N_i = |u_i| = 1 and
    M_i = sum_j |v_ji| |J_j| / sigma_i:  gamma_i = min(1, N_i / M_i) gamma_max and
    phi_i = clamp(alpha_i v_i / sigma_i, gamma_i); the step is clamp(sum phi_i, gamma_max). `clamp`
    shortens a vector so that no entry is larger in magnitude.

    Args:
        jacobian: (m, n) Jacobian of the position or orientation of an end effector.
        error: (m, 1) error, scaled down to the largest error that a step follows.
        gamma_max: Largest change of any joint in one step [rad or m].

    Returns:
        (n, 1) joint step; without damping, the step of the pseudoinverse.
    """
    n = jacobian.shape[1]
    U, s, V = svd(jacobian)
    reach = ca.vertcat(*(safe_norm(jacobian[:, j]) for j in range(n)))
    total = ca.SX.zeros(n, 1)
    largest = ca.fmax(ca.mmax(s), 1e-300)
    for i in range(s.shape[0]):
        v = V[:, i]
        is_nonzero = s[i] > NEGLIGIBLE * largest
        inverse = 1 / ca.if_else(is_nonzero, s[i], 1.0)
        effort = inverse * ca.dot(ca.fabs(v), reach)
        gamma = gamma_max * ca.fmin(1.0, 1 / ca.fmax(effort, 1e-300))
        phi = shorten(inverse * ca.dot(U[:, i], error) * v, gamma)
        total = total + ca.if_else(is_nonzero, phi, 0.0)
    return shorten(total, gamma_max)


def shorten(step: Expr, largest: Expr) -> Expr:
    """Return a vector scaled down so that no entry exceeds `largest` in magnitude."""
    return step * ca.fmin(1.0, largest / ca.fmax(ca.mmax(ca.fabs(step)), 1e-300))


def axes_through(points: list[ca.SX]) -> ca.SX:
    """Return the frame of eqs. (1) and (2) through three or more points.

    X points from the last point to the second, Y from their midpoint to the first (the thumb), Z is
    X x Y, and X is replaced by Y x Z to make the axes orthogonal.

    Args:
        points: Points (3, 1) [m], the thumb's first.

    Returns:
        R (3, 3) with columns X, Y, Z.
    """
    thumb, second, last = points[0], points[1], points[-1]
    x = second - last
    y = thumb - (second + last) / 2
    z = ca.cross(x, y)
    z = z / ca.fmax(safe_norm(z), 1e-12)
    y = y / ca.fmax(safe_norm(y), 1e-12)
    return ca.horzcat(ca.cross(y, z), y, z)


def base_axes(robot: RobotDescription) -> Array:
    """Return the frame of eqs. (1), (2) through the finger bases, palm frame (3, 3).

    It is the identity for the palm frame of the paper; palm frames of other hands may be rotated.

    Raises:
        UnsupportedError: The robot has fewer than three fingers.
    """
    if len(robot.fingers) < 3:
        raise UnsupportedError(
            f"robot {robot.name!r} has {len(robot.fingers)} fingers; the palm estimate of "
            "eqs. (1) and (2) needs at least three"
        )
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    child = {joint.name: joint.child for joint in robot.movable}
    origins = [
        kinematics.palm.inverse_apply(kinematics.links[child[robot.finger(name).joints[0]]].origin)
        for name in thumb_first(robot)
    ]
    return number(axes_through(origins)).reshape(3, 3)


def palm_orientation(robot: RobotDescription, goal: dict[str, Target]) -> ca.SX:
    """Return the estimated palm orientation (3, 3) in the frame of the targets.

    The contact points replace the base points of the fingers.
    """
    points = [goal[name].point for name in thumb_first(robot)]
    return ca.densify(axes_through(points) @ ca.SX(ca.DM(base_axes(robot).T)))


def thumb_first(robot: RobotDescription) -> tuple[str, ...]:
    """Return the finger names with the thumb in front."""
    fingers = tuple(name for name in robot.finger_names if name != robot.thumb)
    return (robot.thumb, *fingers)


def palm_motion(body: ActuatedKinematics, goals: dict[str, Target]) -> tuple[ca.SX, ca.SX]:
    """Return the mean translation and rotation demanded by the fingers, in the palm frame.

    Args:
        body: Kinematics over q.
        goals: Targets of the fingers in the base frame.

    Returns:
        translation (3, 1) [mm], eq. (13), and rotation vector (3, 1) [rad], eq. (12).
    """
    palm = body.kinematics.palm
    rotations, translations = [], []
    for name, goal in goals.items():
        point, normal = body.kinematics.contact(name)
        # In palm coordinates, the shortest rotation between the normals already includes the
        # similarity transform of eq. (12) by the fingertip frame.
        rotation = rotation_between(palm.rotation.T @ normal, palm.rotation.T @ goal.normal)
        shift = palm.rotation.T @ (goal.point - point) / MILLIMETRE
        twist = log_se3((rotation, shift))
        lever = palm.inverse_apply(point) / MILLIMETRE
        rotations.append(rotation)
        translations.append(twist[:3] - ca.cross(twist[3:], lever))
    translation = sum(translations[1:], translations[0]) / len(translations)
    if len(rotations) == 2:
        mean = mean_rotation(*rotations)
    else:
        mean = project_to_rotation(sum(rotations[1:], rotations[0]) / len(rotations))
    return translation, log_so3(mean)
