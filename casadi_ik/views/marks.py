"""What a grasp asks for and what is reached, as solids: one picture of each kind of contact."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.grasps import Contact, Grasp
from casadi_ik.views.captions import MISSED_COLOR, TARGET_COLOR
from casadi_ik.views.shapes import Solid, arrow, capsule, ring

BEYOND = 0.04
"""How far a line is drawn past what it is given by and reached at; radius of a plane's ring [m]."""


def contact_marks(
    robot: ArmHand, q: ArrayLike, grasp: Grasp, colors: Mapping[str, str]
) -> list[Solid]:
    """Contacts asked for (thick and short arrows) and reached (thin and long ones).

    A line is a rod, a plane a ring about the place in it that is nearest to the fingertip; second
    axes have arrows shorter than the normals'. Where the fingertip may be anywhere, what it must
    face is drawn where it is.

    Args:
        robot: The robot.
        q: (n,) where it is [rad or m].
        grasp: What is asked for.
        colors: Of what is reached, by finger.

    Raises:
        InputError: The grasp has a finger that the robot has not.
    """
    grasp.arrays(robot.fingers)
    marks: list[Solid] = []
    for finger, frame in zip(robot.fingers, robot.contact_frames(q), strict=True):
        contact = grasp.contacts.get(finger)
        if contact is not None:
            marks += _asked(contact, frame[:3, 3]) + _reached(contact, frame, colors[finger])
    return marks


def target_place(contact: Contact, tip: Array) -> Array:
    """(3,) of the places a contact allows the nearest to a fingertip (3,) [m]."""
    if np.isnan(contact.point[0]):
        return tip
    gap = tip - contact.point
    if contact.line is not None:
        return contact.point + contact.line * (contact.line @ gap)
    if contact.plane is not None:
        return tip - contact.plane * (contact.plane @ gap)
    return contact.point


def _asked(contact: Contact, tip: Array) -> list[Solid]:
    place = target_place(contact, tip)
    solids = []
    if contact.line is not None:
        along = float(contact.line @ (place - contact.point))
        low, high = min(0.0, along), max(0.0, along)
        first, last = (contact.point + t * contact.line for t in (low - BEYOND, high + BEYOND))
        solids.append(capsule(first, last, 0.0020))
    elif contact.plane is not None:
        solids.append(ring(place, contact.plane, BEYOND, 0.0016))
    elif not np.isnan(contact.point[0]):
        solids.append(capsule(place, place, 0.0036))
    if contact.normal is not None:
        solids.append(arrow(place, contact.normal, 0.030, 0.0048))
    if contact.tangent is not None:
        solids.append(arrow(place, contact.tangent, 0.021, 0.0048))
    return [(solid, TARGET_COLOR) for solid in solids]


def _reached(contact: Contact, frame: Array, color: str) -> list[Solid]:
    tip = frame[:3, 3]
    solids = [capsule(tip, tip, 0.0042), arrow(tip, frame[:3, 0], 0.046, 0.0022)]
    if contact.tangent is not None:
        solids.append(arrow(tip, frame[:3, 1], 0.034, 0.0022))
    if color == MISSED_COLOR:
        solids.append(capsule(tip, target_place(contact, tip), 0.0006))
    return [(solid, color) for solid in solids]
