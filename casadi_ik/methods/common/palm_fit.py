"""The hand seen from its palm, and the palm pose that brings it closest to the contacts."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.methods.common.contact_fit import LENGTH
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.alignment import align
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.so3 import skew


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
