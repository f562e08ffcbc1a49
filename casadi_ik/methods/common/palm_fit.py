"""The hand seen from its palm, and the palm pose that brings it closest to the contacts."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import even_steps
from casadi_ik.problem.contacts import LENGTH, ContactRows, Rates, Vectors, tip_rates, tip_vectors
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import actuated
from casadi_ik.symbolic.se3 import align
from casadi_ik.symbolic.smooth import Expr


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


def best_palm(
    contacts: HandContacts, rows: ContactRows, p: dict[str, Expr], number: Expr | None = None
) -> tuple[Expr, Expr]:
    """The palm pose that brings a given posture closest to the contacts.

    A line or a plane is taken for the point it goes through.

    Args:
        contacts: Of the posture.
        rows: What is asked.
        p: Parameters with the target.
        number: Where contacts leave the palm's rotation free (two fingers that face each other, one
            finger), another one for every number from 0, evenly spread; None: always the same.

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
    rotation = align(B, None if number is None else even_turn(number))
    return rotation, target_centre - rotation @ hand_centre


def even_turn(number: Expr) -> Expr:
    """Unit quaternion (4, 1) of a number from 0, evenly spread over all rotations (Shoemake)."""
    first, *steps = (float(step) for step in even_steps(3))
    share = ca.fmod(0.5 + first * number, 1.0)
    one, other = (2 * np.pi * ca.fmod(0.5 + step * number, 1.0) for step in steps)
    short, long = ca.sqrt(1 - share), ca.sqrt(share)
    return ca.vertcat(
        short * ca.sin(one), short * ca.cos(one), long * ca.sin(other), long * ca.cos(other)
    )
