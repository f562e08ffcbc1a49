"""An arm-hand as solids: thick tubes for the arm, thin ones for the hand, a body for the palm.

The shape follows from the kinematics alone, so any robot can be drawn; it is not its real shell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.views.solids import Solid, capsule, drum, rounded_prism

Array = NDArray[np.float64]

ARM_COLOR, ARM_JOINT_COLOR = "#e8944a", "#5f6975"
HAND_COLOR, PALM_COLOR, HAND_JOINT_COLOR = "#65727f", "#414c58", "#333c46"

ARM_RADIUS = 0.048
"""Of the arm's tubes [m]."""

FINGER_RADIUS = 0.009
"""Of a finger whose pad does not say how far it is from the finger's axis [m]."""

SHORTEST = 2e-3
"""Links shorter than this have no tube [m]."""


@dataclass(frozen=True, eq=False)
class RobotBody:
    """A robot in one configuration.

    Attributes:
        arm: Solids of the arm.
        hand: Solids of the hand.
        outline: (k, 3) link origins and fingertips in the base frame, for framing a picture.
    """

    arm: tuple[Solid, ...]
    hand: tuple[Solid, ...]
    outline: Array


def robot_body(robot: ArmHand, q: ArrayLike) -> RobotBody:
    """The body of a robot.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].

    Raises:
        InputError: Bad q.
    """
    links = robot.links(q)
    description = robot.description
    arm, hand = _pedestal(description, links), [*_palm(description, links)]
    for joint in description.joints:
        if joint.part == "hand":
            hand += _finger_link(description, joint, links)
        else:
            arm += _arm_link(joint, links, joint.parent == description.root)
    tips = []
    for finger in description.fingers:
        pose = links[finger.link]
        contact = pose @ finger.placement
        normal = contact[:3, :3] @ finger.normal
        radius = _pad_height(description, finger.name)
        tips.append(contact[:3, 3])
        hand.append(capsule(pose[:3, 3], contact[:3, 3] - radius * normal, radius, HAND_COLOR))
    origins = [pose[:3, 3] for pose in links.values()]
    return RobotBody(tuple(arm), tuple(hand), np.array([*origins, *tips]))


def _pedestal(description: RobotDescription, links: Mapping[str, Array]) -> list[Solid]:
    """The foot of an arm; a hand alone stands on its palm."""
    if not description.arm_actuators:
        return []
    root = links[description.root]
    axis = root[:3, 2]
    foot = root[:3, 3] + 0.0125 * axis
    return [drum(foot, axis, 1.9 * ARM_RADIUS, 0.025, ARM_JOINT_COLOR)]


def _arm_link(joint: Joint, links: Mapping[str, Array], lowest: bool) -> list[Solid]:
    start, end = links[joint.parent][:3, 3], links[joint.child][:3, 3]
    axis = links[joint.child][:3, :3] @ joint.axis
    solids = []
    length = float(np.linalg.norm(end - start))
    if length > SHORTEST:
        # The round end of the lowest link must not come out below the foot.
        begin = start + min(1.0, ARM_RADIUS / length) * (end - start) if lowest else start
        solids.append(capsule(begin, end, ARM_RADIUS, ARM_COLOR))
    if joint.type != "revolute":
        return solids
    along = length > SHORTEST and abs(axis @ (end - start)) > 0.9 * length
    if along:  # a roll joint: a band around the tube
        solids.append(drum(end, axis, 1.09 * ARM_RADIUS, 0.35 * ARM_RADIUS, ARM_JOINT_COLOR))
    else:  # a pitch joint: a drum across it
        solids.append(drum(end, axis, 1.12 * ARM_RADIUS, 2.5 * ARM_RADIUS, ARM_JOINT_COLOR))
    return solids


def _finger_link(
    description: RobotDescription, joint: Joint, links: Mapping[str, Array]
) -> list[Solid]:
    start, end = links[joint.parent][:3, 3], links[joint.child][:3, 3]
    solids = []
    if joint.parent != description.palm_link and np.linalg.norm(end - start) > SHORTEST:
        solids.append(capsule(start, end, 1.15 * FINGER_RADIUS, HAND_COLOR))
    if joint.type == "revolute":
        axis = links[joint.child][:3, :3] @ joint.axis
        solids.append(drum(end, axis, 1.3 * FINGER_RADIUS, 2.7 * FINGER_RADIUS, HAND_JOINT_COLOR))
    return solids


def _palm(description: RobotDescription, links: Mapping[str, Array]) -> list[Solid]:
    """A prism, upright in the palm frame, around the palm's origin and where the fingers begin."""
    pose = links[description.palm_link] @ description.palm_placement
    link = links[description.palm_link][:3, 3]
    bases = [
        links[joint.child][:3, 3]
        for joint in description.joints
        if joint.part == "hand" and joint.parent == description.palm_link
    ]
    if not bases:
        return []
    inside = (np.array([link, *bases]) - pose[:3, 3]) @ pose[:3, :3]
    radius = 2.2 * FINGER_RADIUS
    low, high = float(inside[:, 2].min()), float(inside[:, 2].max())
    if high - low < 2 * radius:
        middle = (low + high) / 2
        low, high = middle - radius, middle + radius
    return [rounded_prism(inside[:, :2], pose, low, high, radius, PALM_COLOR)]


def _pad_height(description: RobotDescription, name: str) -> float:
    """How far the pad is from the axis of the last link, along the normal [m]."""
    finger = description.finger(name)
    height = float(finger.placement[:3, 3] @ (finger.placement[:3, :3] @ finger.normal))
    return height if 0.004 < height < 0.02 else FINGER_RADIUS
