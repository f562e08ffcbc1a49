"""Hand stage: palm pose and hand posture that fit the contacts, without the arm.

Three contacts with normals fix both: thirteen unknowns (palm 6, hand 7 for the Barrett) against
fifteen equations. The palm's coordinates are its pose; a step turns and shifts it in its own frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.robots.description import RobotDescription
from casadi_ik.steps.bounded_step import clip, damped_step
from casadi_ik.steps.contact_fit import LENGTH, Tried, weighted_residual
from casadi_ik.steps.hand_first_state import HandFirstLayouts
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.alignment import align
from casadi_ik.symbolic.se3 import compose, exp_se3
from casadi_ik.symbolic.smooth import Expr, safe_norm
from casadi_ik.symbolic.so3 import skew
from casadi_ik.symbolic.srs_arm import SrsArm, reach

PASSES = 2
"""Corrections of the active set in a step."""


@dataclass(frozen=True, eq=False)
class HandContacts:
    """Contacts of a hand posture in the palm frame: per finger point (3, 1) [m], normal (3, 1)."""

    points: list[Expr]
    normals: list[Expr]
    point_jacobians: list[Expr]
    normal_jacobians: list[Expr]


def hand_contacts(robot: RobotDescription, hand: Expr, columns: tuple[int, ...]) -> HandContacts:
    """Contacts and their Jacobians (3, k) over the hand's actuators, in the palm frame.

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
    points, normals, point_jacobians, normal_jacobians = [], [], [], []
    for name in robot.finger_names:
        point, normal = body.kinematics.contact(name)
        linear, angular = body.contact_jacobian(name, columns)
        points.append(palm.inverse_apply(point))
        normals.append(palm.rotation.T @ normal)
        point_jacobians.append(ca.sparsify(palm.rotation.T @ linear))
        normal_jacobians.append(ca.sparsify(palm.rotation.T @ (-skew(normal) @ angular)))
    return HandContacts(points, normals, point_jacobians, normal_jacobians)


@dataclass(frozen=True, eq=False)
class PalmAndHand:
    """The unknowns of the hand stage."""

    rotation: Expr
    origin: Expr
    hand: Expr


def best_palm(contacts: HandContacts, p: dict[str, Expr]) -> tuple[Expr, Expr]:
    """The palm pose that brings a given posture closest to the contacts.

    Returns:
        rotation (3, 3) and origin (3, 1) [m], base frame.
    """
    f = len(contacts.points)
    total = ca.fmax(ca.sum1(p["weights"][:, 0]), 1e-12)
    target_centre = sum(
        (p["weights"][i, 0] * p["points"][i, :].T for i in range(f)), ca.SX.zeros(3, 1)
    )
    hand_centre = sum(
        (p["weights"][i, 0] * contacts.points[i] for i in range(f)), ca.SX.zeros(3, 1)
    )
    target_centre, hand_centre = target_centre / total, hand_centre / total
    B = ca.SX.zeros(3, 3)
    for i in range(f):
        b = (p["points"][i, :].T - target_centre) / LENGTH
        a = (contacts.points[i] - hand_centre) / LENGTH
        B = B + p["weights"][i, 0] * b @ a.T
        B = B + p["weights"][i, 1] * p["normals"][i, :].T @ contacts.normals[i].T
    rotation = align(B)
    return rotation, target_centre - rotation @ hand_centre


def fit_residual(contacts: HandContacts, x: PalmAndHand, p: dict[str, Expr]) -> Expr:
    """Residual (6 f, 1) of `weighted_residual`, in the palm frame."""
    f = len(contacts.points)
    positions = [
        contacts.points[i] - x.rotation.T @ (p["points"][i, :].T - x.origin) for i in range(f)
    ]
    normals = [contacts.normals[i] - x.rotation.T @ p["normals"][i, :].T for i in range(f)]
    return weighted_residual(positions, normals, p["weights"])


def fit_jacobian(contacts: HandContacts, x: PalmAndHand, p: dict[str, Expr]) -> Expr:
    """Jacobian (6 f, 6 + k) over palm shift [m], palm turn [rad] (palm frame) and hand."""
    positions, normals = [], []
    for i in range(len(contacts.points)):
        seen = x.rotation.T @ (p["points"][i, :].T - x.origin)
        facing = x.rotation.T @ p["normals"][i, :].T
        positions.append(ca.horzcat(ca.DM.eye(3), -skew(seen), contacts.point_jacobians[i]))
        normals.append(ca.horzcat(ca.DM(3, 3), -skew(facing), contacts.normal_jacobians[i]))
    return weighted_residual(positions, normals, p["weights"])


def reach_row(
    arm: SrsArm, columns: Sequence[int], x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """How far the wrist is out of the arm's reach, by `LENGTH`, and its slope (1, 6).

    Where contacts leave the hand a freedom (three parallel fingers), it is spent on bringing the
    wrist where the elbow can follow. Zero, with slope zero, within reach.
    """
    near, far = reach(arm, p["lower"][columns[3]], p["upper"][columns[3]])
    wrist = ca.DM(arm.wrist_in_palm)
    line = x.origin + x.rotation @ wrist - ca.DM(arm.shoulder)
    distance = safe_norm(line)
    beyond = distance - ca.fmin(ca.fmax(distance, near), far)
    along = x.rotation.T @ line / distance
    slope = ca.horzcat(along.T, ca.cross(wrist, along).T) * (ca.fabs(beyond) > 0)
    return p["reach"] * beyond / LENGTH, p["reach"] * slope / LENGTH


def fit_step(
    layouts: HandFirstLayouts,
    arm: SrsArm | None,
    x: PalmAndHand,
    damping: Expr,
    p: dict[str, Expr],
    q: Expr,
) -> Tried:
    """One damped step; it turns and shifts the palm along one screw.

    With the palm on a screw, a palm that turns about the common axis of several joints while they
    turn back leaves the contacts exactly alone: the long valleys of nearly singular hands are
    straight.

    Args:
        layouts: Of the robot.
        arm: An arm whose reach is to be kept to, if known.
        x: Where the step begins.
        damping: Scalar.
        p: Parameters.
        q: (n, 1) with the hand's part at `x.hand`.
    """
    before, jacobian = _rows(layouts, arm, x, p)
    bounds = layouts.hand_bounds(q, p, first=6)
    damped = damped_step(jacobian, before, damping, bounds, PASSES)
    rotation, origin = compose((x.rotation, x.origin), exp_se3(damped.step[:6]))
    reached = PalmAndHand(rotation, origin, clip(x.hand + damped.step[6:], bounds))
    there, _ = _rows(layouts, arm, reached, p)
    size = ca.mmax(ca.fabs(reached.hand - x.hand))
    return Tried(reached, before, there, damped.promised, size)


def _rows(
    layouts: HandFirstLayouts, arm: SrsArm | None, x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Residual and Jacobian of contacts and reach."""
    contacts = hand_contacts(layouts.robot, x.hand, layouts.hand)
    residual, jacobian = fit_residual(contacts, x, p), fit_jacobian(contacts, x, p)
    if arm is None:
        return residual, jacobian
    beyond, slope = reach_row(arm, layouts.robot.arm_actuators, x, p)
    slope = ca.horzcat(slope, ca.SX(1, len(layouts.hand)))
    return ca.vertcat(residual, beyond), ca.vertcat(jacobian, slope)
