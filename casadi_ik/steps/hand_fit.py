"""Hand stage: palm pose and hand posture that fit the contacts, without the arm.

Three contacts with normals fix both: thirteen unknowns (palm 6, hand 7 for the Barrett) against
fifteen equations. The palm's coordinates are its pose; a step turns and shifts it in its own frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.robots.description import RobotDescription
from casadi_ik.steps.contact_fit import LENGTH, clip, damped_step, weighted_residual
from casadi_ik.steps.hand_first_state import HandFirstLayouts
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.alignment import align
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.so3 import exp_so3, skew


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


def fit_step(
    layouts: HandFirstLayouts, x: PalmAndHand, damping: Expr, p: dict[str, Expr], q: Expr
) -> tuple[PalmAndHand, Expr, Expr]:
    """One damped step.

    Returns:
        Where it leads, the residual before, and the residual there.
    """
    robot, columns = layouts.robot, layouts.hand
    contacts = hand_contacts(robot, x.hand, columns)
    residual = fit_residual(contacts, x, p)
    bounds = layouts.hand_bounds(q, p, first=6)
    step = damped_step(fit_jacobian(contacts, x, p), residual, damping, bounds)
    reached = PalmAndHand(
        x.rotation @ exp_so3(step[3:6]),
        x.origin + x.rotation @ step[:3],
        clip(x.hand + step[6:], bounds),
    )
    there = fit_residual(hand_contacts(robot, reached.hand, columns), reached, p)
    return reached, residual, there
