"""The palm pose that brings the hand closest to the contacts, and arms brought there by steps.

An arm of no family starts from a table of arm configurations in the order of how far their palm is
from the one wanted: the next start is the nearest that is farther than the last one. Where a family
solves a nominal arm beside the real one, Newton's steps lead from there to the real one.
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
from casadi_ik.kinematics.box_qp import Bounded, clip
from casadi_ik.kinematics.contact_fit import FIT, Tried, lm_step
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    Rates,
    Vectors,
    tip_rates,
    tip_vectors,
)
from casadi_ik.kinematics.forward import Pose, actuated, sparse
from casadi_ik.kinematics.se3 import align, skew
from casadi_ik.kinematics.smooth import Expr, call_function, with_cse
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True, eq=False)
class HandContacts:
    """Fingertips of a hand posture in the palm frame, and what moves them.

    Attributes:
        tips: Per finger.
        rates: Jacobians over the hand's actuators.
    """

    tips: list[Vectors]
    rates: list[Rates]


def hand_contacts(robot: RobotDescription, hand: Expr, columns: tuple[int, ...]) -> HandContacts:
    """Fingertips and their Jacobians (3, k) over the hand's actuators, in the palm frame.

    Args:
        robot: The description.
        hand: (k, 1) positions of the hand's actuators.
        columns: Their positions in q.
    """
    # With the arm at zero the palm is a constant, and everything up to it folds away.
    q = ca.SX.zeros(len(robot.actuators), 1)
    for i, column in enumerate(columns):
        q[column] = hand[i]
    body = actuated(robot, q)
    palm = body.kinematics.palm
    tips, rates = [], []
    for name in robot.finger_names:
        tip = tip_vectors(body.kinematics, name)
        turned = {key: palm.rotation.T @ axis for key, axis in tip.items() if key != "point"}
        tips.append({"point": palm.inverse_apply(tip["point"]), **turned})
        rates.append(
            {
                key: ca.sparsify(palm.rotation.T @ rate)
                for key, rate in tip_rates(body, name, columns).items()
            }
        )
    return HandContacts(tips, rates)


def base_rotation(robot: RobotDescription) -> Array:
    """Return the rotation (3, 3) that the fixed joints before the first motor make.

    A choice relative to it does not depend on how the robot is mounted.
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

    A line or a plane is taken for the point it goes through.

    Args:
        contacts: Of the posture.
        rows: What is asked.
        p: Parameters with the target.
        number: Where contacts leave the palm's rotation free (two fingers that face each other, one
            finger), another one for every number from 0, evenly spread; None: always the same.
        base: (3, 3) rotation that these turns are relative to; None: the base frame.

    Returns:
        rotation (3, 3) and origin (3, 1) [m], base frame.
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
    rotation = R_base @ align(R_base.T @ B, None if number is None else even_turn(number))
    return rotation, target_centre - rotation @ hand_centre


def even_turn(number: Expr) -> Expr:
    """Unit quaternion (4, 1) of a number from 0, evenly spread over all rotations (Shoemake)."""
    first, *steps = (float(step) for step in spread_steps(3))
    share = ca.fmod(0.5 + first * number, 1.0)
    one, other = (2 * np.pi * ca.fmod(0.5 + step * number, 1.0) for step in steps)
    short, long = ca.sqrt(1 - share), ca.sqrt(share)
    return ca.vertcat(
        short * ca.sin(one), short * ca.cos(one), long * ca.sin(other), long * ca.cos(other)
    )


SIX = 6
"""An arm with fewer free motors brings a palm where it is asked for by chance only."""


@dataclass(frozen=True)
class NumericArmParameters:
    """How an arm is searched step by step.

    Attributes:
        table: Configurations of the arm to start from.
        starts: Of these, how many are tried for a palm pose; all rounds of a solve together try
            them all.
        near: A start of an arm of fewer than `SIX` free motors that ends as near as this (cost, by
            the sum of the squared tolerances) is good enough: a hand on a wrist takes 20
            evaluations of its arm instead of 250.
        gap: A joint that can turn all around but for so much [rad] may rest at the wrong end of its
            range: what is beyond one end is nearly what is beyond the other.
        at_end: How near to a limit [rad] counts as at it.
    """

    table: int = 1024
    starts: int = 22
    near: float = 4.0
    gap: float = 1.0
    at_end: float = 1e-6


NUMERIC_ARM = NumericArmParameters()


@cache
def start_table(robot: RobotDescription) -> tuple[Array, Array]:
    """Configurations of the arm (table, a) to start from, and their palms (table, 12).

    Of a palm the rotation, row by row, and the origin / `LENGTH`.
    """
    columns = list(robot.arm_actuators)
    spread = spread_points(NUMERIC_ARM.table, len(columns))
    arms = robot.lower[columns] + spread * (robot.upper - robot.lower)[columns]
    q = ca.SX.sym("q", len(columns))
    palm = _palm(robot, q)
    features = ca.vertcat(ca.vec(palm.rotation.T), palm.origin / LENGTH)
    return arms, np.array(ca.Function("features", [q], [features])(arms.T)).T


def nearest_start(robot: RobotDescription) -> ca.Function:
    """The next start for a palm pose.

    Returns:
        ``(rotation, origin, passed) -> (arm, distance)``: the configuration whose palm is nearest
        of those farther than `passed`, and its distance.
    """
    arms, table = start_table(robot)
    rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
    passed = ca.MX.sym("passed")
    wanted = ca.vertcat(ca.vec(rotation.T), origin / LENGTH)
    distances = ca.DM((table**2).sum(axis=1)) - 2 * ca.DM(table) @ wanted
    index, distance = _next_nearest(distances + ca.sumsqr(wanted), passed)
    arm = ca.DM(arms.T) @ (ca.DM(range(len(arms))) == index)
    return ca.Function("nearest_start", [rotation, origin, passed], [ca.densify(arm), distance])


def _next_nearest(distances: Expr, passed: Expr) -> tuple[Expr, Expr]:
    """Index and distance of the nearest row beyond `passed`; of the nearest of all after the last.

    As operations on whole vectors, since unrolled they would be most of the method's code.
    """
    beyond = distances > passed
    over = 1 - ca.norm_inf(beyond)
    masked = ca.if_else(ca.logic_or(beyond, ca.repmat(over, distances.numel(), 1)), distances, 1e30)
    nearest = ca.mmin(masked)
    return ca.find(masked <= nearest), nearest


def next_at_end(robot: RobotDescription, arm: Expr, turned: Expr, p: dict[str, Expr]) -> Expr:
    """The next joint that rests at an end of its range and may be sent to the other one.

    Args:
        robot: The description.
        arm: (a, 1) where the arm came to rest.
        turned: How many joints were seen to.
        p: Parameters.

    Returns:
        Its number in the arm, from 1; 0 if none is left.
    """
    columns = list(robot.arm_actuators)
    lower, upper = p["lower"][columns], p["upper"][columns]
    found, end = ca.SX(0), NUMERIC_ARM.at_end
    for i, column in enumerate(columns):
        if robot.actuators[column].unit != "rad":
            continue
        gap = 2 * np.pi - (upper[i] - lower[i])
        ends = ca.logic_or(arm[i] - lower[i] <= end, upper[i] - arm[i] <= end)
        due = ca.logic_and(ca.logic_and(ends, ca.fabs(gap) < NUMERIC_ARM.gap), turned <= i)
        found = ca.if_else(ca.logic_and(due, found <= 0), i + 1, found)
    return found


def pose_step(
    robot: RobotDescription, arm: Expr, palm: Pose, damping: Expr, p: dict[str, Expr]
) -> Tried:
    """One damped step of the arm (a, 1) towards a palm pose."""
    columns, seen = list(robot.arm_actuators), _pose_at(robot)
    bounds = Bounded(arm, p["lower"][columns], p["upper"][columns], first=0)
    return lm_step(
        lambda there: seen(there, palm.rotation, palm.origin),
        arm,
        damping,
        bounds,
        lambda step: clip(arm + step, bounds),
    )


@cache
def _pose_at(robot: RobotDescription) -> Callable[..., Any]:
    """(arm, rotation, origin) -> how far the palm is off, and the Jacobian of that."""
    arm = ca.SX.sym("arm", len(robot.arm_actuators))
    wanted = Pose(ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3))
    error = _error(_palm(robot, arm), wanted)
    inputs = [arm, wanted.rotation, wanted.origin]
    return call_function("pose_at", inputs, [error, pose_jacobian(robot, arm)])


def newton_polish(robot: RobotDescription, model_error: float) -> ca.Function:
    """From a nominal arm to the real one.

    Args:
        robot: The description.
        model_error: How far the nominal arm is from the real one [m and rad].

    Returns:
        ``(arm, rotation, origin, lower, upper) -> (arm, hits)``: the arm (a, 1), within bounds
        (n, 1) of all motors, that brings the palm to a pose, and whether it does.
    """
    columns, n = list(robot.arm_actuators), len(robot.actuators)
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    start = ca.SX.sym("arm", len(columns))
    p = {"lower": ca.SX.sym("lower", n), "upper": ca.SX.sym("upper", n)}
    inside = ca.fmin(ca.fmax(start, p["lower"][columns]), p["upper"][columns])
    tried = pose_step(robot, inside, Pose(rotation, origin), ca.SX(FIT.damping_floor), p)
    before, there = ca.sumsqr(tried.before), ca.sumsqr(tried.there)
    reached = ca.if_else(there < before, tried.reached, inside)
    hits = ca.fmin(before, there) < FIT.exact * FIT.exact
    given = [rotation, origin, p["lower"], p["upper"]]
    step = ca.Function("newton_step", [start, *given], with_cse(reached, hits))
    inputs: list[Expr] = [ca.MX.sym("x", x.shape) for x in step.mx_in()]
    arm, *given = inputs
    found: Expr = ca.MX(0)
    for _ in range(newton_steps(model_error)):
        arm, found = step(arm, *given)
    return ca.Function("newton_polish", inputs, [arm, found])


def newton_steps(model_error: float) -> int:
    """Newton's steps for an arm that is off by so much [m and rad]: each of them squares it.

    One that is off by a millimetre is right to a micrometre after one, to rounding after two; one
    that is off by a centimetre needs three.
    """
    right = 1e-12
    squarings = math.log2(math.log(right) / math.log(max(model_error, right)))
    return max(1, math.ceil(squarings))


def pose_jacobian(robot: RobotDescription, arm: Expr) -> Expr:
    """Jacobian (12, a) of position / `LENGTH` and of the columns of the palm's rotation."""
    body = actuated(robot, _whole(robot, arm))
    linear, angular = body.palm_jacobian(robot.arm_actuators)
    rotation = body.kinematics.palm.rotation
    rows = [linear / LENGTH]
    rows += [-skew(rotation[:, i]) @ angular for i in range(3)]
    return ca.vertcat(*rows)


def _features(rotation: Expr, origin: Expr) -> Expr:
    """A palm pose as twelve numbers: origin / `LENGTH` and the columns of its rotation."""
    return ca.vertcat(origin / LENGTH, ca.reshape(rotation, 9, 1))


def _error(palm: Pose, wanted: Pose) -> Expr:
    return _features(palm.rotation, palm.origin) - _features(wanted.rotation, wanted.origin)


def _palm(robot: RobotDescription, arm: Expr) -> Pose:
    return actuated(robot, _whole(robot, arm)).kinematics.palm


def _whole(robot: RobotDescription, arm: Expr) -> Expr:
    """Q with the hand at zero: it does not move the palm."""
    q = ca.SX.zeros(len(robot.actuators), 1)
    for i, column in enumerate(robot.arm_actuators):
        q[column] = arm[i]
    return q
