"""Palm pose that best fits the contacts, and iterative inverse kinematics of arms.

An arm without a closed form starts from a table of arm configurations, in increasing distance of
their palm from the target pose. Where a closed form solves a nominal arm, Newton steps lead from
the nominal to the real arm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array, spread_points, spread_steps
from casadi_ik.kinematics.box_qp import BoxBounds, clip
from casadi_ik.kinematics.contact_fit import FIT, TrialStep, lm_step
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    Rates,
    Vectors,
    tip_jacobians,
    tip_vectors,
)
from casadi_ik.kinematics.forward import Pose, actuated, sparse
from casadi_ik.kinematics.se3 import align, skew
from casadi_ik.kinematics.smooth import Expr, call_function, with_cse
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True, eq=False)
class HandContacts:
    """Fingertips of a hand posture in the palm frame, with their Jacobians.

    Attributes:
        tips: Vectors of each fingertip.
        jacobians: Jacobians of these vectors by the actuators of the hand.
    """

    tips: list[Vectors]
    jacobians: list[Rates]


def hand_contacts(robot: RobotDescription, hand: Expr, columns: tuple[int, ...]) -> HandContacts:
    """Return the fingertips and their Jacobians (3, k) in the palm frame.

    Args:
        robot: Description of the robot.
        hand: (k, 1) positions of the actuators of the hand [rad or m].
        columns: Indices of these actuators in q.
    """
    # With the arm at zero the palm pose is a constant, so that the arm adds no operations.
    q = ca.SX.zeros(len(robot.actuators), 1)
    for i, column in enumerate(columns):
        q[column] = hand[i]
    body = actuated(robot, q)
    palm_pose = body.kinematics.palm
    tips, jacobians = [], []
    for name in robot.finger_names:
        tip = tip_vectors(body.kinematics, name)
        axes = {key: palm_pose.rotation.T @ axis for key, axis in tip.items() if key != "point"}
        tips.append({"point": palm_pose.inverse_apply(tip["point"]), **axes})
        jacobians.append(
            {
                key: ca.sparsify(palm_pose.rotation.T @ rate)
                for key, rate in tip_jacobians(body, name, columns).items()
            }
        )
    return HandContacts(tips, jacobians)


def base_rotation(robot: RobotDescription) -> Array:
    """Return the rotation R (3, 3) of the fixed joints before the first motor.

    Choices relative to it do not depend on how the robot is mounted.
    """
    rotation = np.eye(3)
    for joint in robot.chain(robot.movable[0].child) if robot.movable else ():
        rotation = rotation @ joint.placement[:3, :3]
    return rotation


def best_palm(
    contacts: HandContacts,
    rows: ContactRows,
    p: dict[str, Expr],
    number: Expr | None = None,
    base: Array | None = None,
) -> tuple[Expr, Expr]:
    """Return the palm pose that brings a given posture closest to the contacts.

    A line or a plane is represented by its point.

    Args:
        contacts: Contacts of the posture.
        rows: Rows of the target contacts.
        p: Parameters with the target.
        number: Index from 0 that selects the rotation where the contacts leave it free (two
            opposed fingers, or one finger), from a uniform sequence; None for a fixed choice.
        base: (3, 3) rotation to which this choice is relative; None for the base frame.

    Returns:
        Rotation R_base_palm (3, 3) and origin p_base_palm (3, 1) [m].
    """
    goals, weights = rows.goals(p), p["weights"]
    f = len(goals)
    total = ca.fmax(ca.sum1(weights[:, 0]), 1e-12)
    target_centre = sum((weights[i, 0] * goals[i]["point"] for i in range(f)), ca.SX.zeros(3, 1))
    hand_centre = sum(
        (weights[i, 0] * contacts.tips[i]["point"] for i in range(f)), ca.SX.zeros(3, 1)
    )
    target_centre, hand_centre = target_centre / total, hand_centre / total
    B = ca.SX.zeros(3, 3)
    for i, (tip, goal) in enumerate(zip(contacts.tips, goals, strict=True)):
        b = (goal["point"] - target_centre) / LENGTH
        a = (tip["point"] - hand_centre) / LENGTH
        B = B + weights[i, 0] * b @ a.T
        for axis in ("normal", "tangent"):
            if axis in goal:
                B = B + weights[i, 1] * goal[axis] @ tip[axis].T
    R_base = sparse(np.eye(3) if base is None else base)
    rotation = R_base @ align(R_base.T @ B, None if number is None else uniform_quaternion(number))
    return rotation, target_centre - rotation @ hand_centre


def uniform_quaternion(number: Expr) -> Expr:
    """Return the unit quaternion (4, 1) of an index in a uniform sequence (Shoemake 1992)."""
    first, *angle_steps = (float(step) for step in spread_steps(3))
    fraction = ca.fmod(0.5 + first * number, 1.0)
    angle_a, angle_b = (2 * np.pi * ca.fmod(0.5 + step * number, 1.0) for step in angle_steps)
    radius_a, radius_b = ca.sqrt(1 - fraction), ca.sqrt(fraction)
    return ca.vertcat(
        radius_a * ca.sin(angle_a),
        radius_a * ca.cos(angle_a),
        radius_b * ca.sin(angle_b),
        radius_b * ca.cos(angle_b),
    )


POSE_DIMENSION = 6
"""Number of free motors below which an arm cannot reach a generic palm pose."""


@dataclass(frozen=True)
class NumericArmParameters:
    """Parameters of the iterative search for an arm configuration.

    Attributes:
        table_size: Number of start configurations of the arm.
        starts: Maximum number of starts per palm pose; all restarts of a solve together use the
            whole table.
        good_start_cost: Cost, relative to the sum of the squared tolerances, at which the search
            ends for an arm of fewer than `POSE_DIMENSION` free motors. Source: a hand on a wrist
            takes 20 evaluations of its arm instead of 250.
        max_range_gap: Largest gap between the limits of a joint modulo 2 pi [rad] for which the
            solution of a joint at one limit may be near the other limit.
        limit_distance: Distance from a limit below which a joint is at the limit [rad].
    """

    table_size: int = 1024
    starts: int = 22
    good_start_cost: float = 4.0
    max_range_gap: float = 1.0
    limit_distance: float = 1e-6


NUMERIC_ARM_PARAMETERS = NumericArmParameters()


@cache
def start_table(robot: RobotDescription) -> tuple[Array, Array]:
    """Return start configurations of the arm (table, a) and features of their palms (table, 12).

    The features of a palm pose are its rotation, row by row, and its origin / `LENGTH`.
    """
    columns = list(robot.arm_actuators)
    samples = spread_points(NUMERIC_ARM_PARAMETERS.table_size, len(columns))
    arms = robot.lower[columns] + samples * (robot.upper - robot.lower)[columns]
    q = ca.SX.sym("q", len(columns))
    palm = _palm_of_arm(robot, q)
    features = ca.vertcat(ca.vec(palm.rotation.T), palm.origin / LENGTH)
    return arms, np.array(ca.Function("features", [q], [features])(arms.T)).T


def nearest_start(robot: RobotDescription) -> ca.Function:
    """Return the graph that selects the next start for a palm pose.

    Returns:
        ``(rotation, origin, previous_distance) -> (arm, distance)``: among the start configurations
        whose palm is farther than `previous_distance` the nearest one, and its distance.
    """
    arms, table = start_table(robot)
    rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
    previous_distance = ca.MX.sym("passed")
    features = ca.vertcat(ca.vec(rotation.T), origin / LENGTH)
    distances = ca.DM((table**2).sum(axis=1)) - 2 * ca.DM(table) @ features
    index, distance = _next_nearest(distances + ca.sumsqr(features), previous_distance)
    arm = ca.DM(arms.T) @ (ca.DM(range(len(arms))) == index)
    return ca.Function(
        "nearest_start", [rotation, origin, previous_distance], [ca.densify(arm), distance]
    )


def _next_nearest(distances: Expr, previous_distance: Expr) -> tuple[Expr, Expr]:
    """Return index and distance of the nearest row beyond `previous_distance`.

    After the last row the search wraps around to the nearest row. The operations act on whole
    vectors, because unrolled they would dominate the code size of the method.
    """
    is_farther = distances > previous_distance
    is_exhausted = 1 - ca.norm_inf(is_farther)
    masked = ca.if_else(
        ca.logic_or(is_farther, ca.repmat(is_exhausted, distances.numel(), 1)), distances, 1e30
    )
    nearest = ca.mmin(masked)
    return ca.find(masked <= nearest), nearest


def next_joint_at_limit(
    robot: RobotDescription, arm: Expr, joints_done: Expr, p: dict[str, Expr]
) -> Expr:
    """Return the next joint at a limit whose solution may be near the opposite limit.

    Args:
        robot: Description of the robot.
        arm: (a, 1) positions of the converged arm.
        joints_done: Number of leading joints already considered.
        p: Parameters.

    Returns:
        Index of the joint in the arm, from 1; 0 if there is none.
    """
    columns = list(robot.arm_actuators)
    lower, upper = p["lower"][columns], p["upper"][columns]
    result, limit_distance = ca.SX(0), NUMERIC_ARM_PARAMETERS.limit_distance
    for i, column in enumerate(columns):
        if robot.actuators[column].unit != "rad":
            continue
        gap = 2 * np.pi - (upper[i] - lower[i])
        is_at_limit = ca.logic_or(
            arm[i] - lower[i] <= limit_distance, upper[i] - arm[i] <= limit_distance
        )
        is_candidate = ca.logic_and(
            ca.logic_and(is_at_limit, ca.fabs(gap) < NUMERIC_ARM_PARAMETERS.max_range_gap),
            joints_done <= i,
        )
        result = ca.if_else(ca.logic_and(is_candidate, result <= 0), i + 1, result)
    return result


def pose_step(
    robot: RobotDescription, arm: Expr, palm: Pose, damping: Expr, p: dict[str, Expr]
) -> TrialStep:
    """Return a damped step of the arm (a, 1) towards a palm pose."""
    columns, pose_error = list(robot.arm_actuators), _pose_error_function(robot)
    bounds = BoxBounds(arm, p["lower"][columns], p["upper"][columns], first=0)
    return lm_step(
        lambda x: pose_error(x, palm.rotation, palm.origin),
        arm,
        damping,
        bounds,
        lambda step: clip(arm + step, bounds),
    )


@cache
def _pose_error_function(robot: RobotDescription) -> Callable[..., Any]:
    """Return ``(arm, rotation, origin) -> (error, jacobian)`` of the palm pose."""
    arm = ca.SX.sym("arm", len(robot.arm_actuators))
    target = Pose(ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3))
    error = _pose_error(_palm_of_arm(robot, arm), target)
    inputs = [arm, target.rotation, target.origin]
    return call_function("pose_at", inputs, [error, pose_jacobian(robot, arm)])


def newton_polish(robot: RobotDescription, model_error: float) -> ca.Function:
    """Return the graph of Newton steps from the solution of a nominal arm to the real arm.

    Args:
        robot: Description of the robot.
        model_error: Deviation of the nominal arm from the real one [m and rad].

    Returns:
        ``(arm, rotation, origin, lower, upper) -> (arm, is_exact)``: the arm (a, 1) within the
        bounds (n, 1) of all motors, and whether it reaches the palm pose.
    """
    columns, n = list(robot.arm_actuators), len(robot.actuators)
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    start = ca.SX.sym("arm", len(columns))
    p = {"lower": ca.SX.sym("lower", n), "upper": ca.SX.sym("upper", n)}
    clipped = ca.fmin(ca.fmax(start, p["lower"][columns]), p["upper"][columns])
    trial = pose_step(robot, clipped, Pose(rotation, origin), ca.SX(FIT.damping_floor), p)
    cost_before, cost_after = ca.sumsqr(trial.residual_before), ca.sumsqr(trial.residual)
    arm_after = ca.if_else(cost_after < cost_before, trial.x, clipped)
    is_exact = ca.fmin(cost_before, cost_after) < FIT.exact * FIT.exact
    target = [rotation, origin, p["lower"], p["upper"]]
    step = ca.Function("newton_step", [start, *target], with_cse(arm_after, is_exact))
    inputs: list[Expr] = [ca.MX.sym("x", x.shape) for x in step.mx_in()]
    arm, *target = inputs
    is_reached: Expr = ca.MX(0)
    for _ in range(newton_step_count(model_error)):
        arm, is_reached = step(arm, *target)
    return ca.Function("newton_polish", inputs, [arm, is_reached])


def newton_step_count(model_error: float) -> int:
    """Return the number of Newton steps for a model error [m and rad], which every step squares.

    An error of a millimetre is a micrometre after one step and rounding after two; an error of a
    centimetre needs three.
    """
    converged = 1e-12
    steps = math.log2(math.log(converged) / math.log(max(model_error, converged)))
    return max(1, math.ceil(steps))


def pose_jacobian(robot: RobotDescription, arm: Expr) -> Expr:
    """Return the Jacobian (12, a) of position / `LENGTH` and the columns of the palm rotation."""
    body = actuated(robot, _configuration_of_arm(robot, arm))
    linear, angular = body.palm_jacobian(robot.arm_actuators)
    rotation = body.kinematics.palm.rotation
    rows = [linear / LENGTH]
    rows += [-skew(rotation[:, i]) @ angular for i in range(3)]
    return ca.vertcat(*rows)


def _features(rotation: Expr, origin: Expr) -> Expr:
    """Return origin / `LENGTH` and the columns of the rotation of a palm pose, (12, 1)."""
    return ca.vertcat(origin / LENGTH, ca.reshape(rotation, 9, 1))


def _pose_error(palm: Pose, target: Pose) -> Expr:
    return _features(palm.rotation, palm.origin) - _features(target.rotation, target.origin)


def _palm_of_arm(robot: RobotDescription, arm: Expr) -> Pose:
    return actuated(robot, _configuration_of_arm(robot, arm)).kinematics.palm


def _configuration_of_arm(robot: RobotDescription, arm: Expr) -> Expr:
    """Return q with the given arm and the hand at zero, which does not affect the palm."""
    q = ca.SX.zeros(len(robot.actuators), 1)
    for i, column in enumerate(robot.arm_actuators):
        q[column] = arm[i]
    return q
