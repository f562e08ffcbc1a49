"""An arm-hand as solids: thick tubes for the arm, thin ones for the hand, a body for the palm.

The shape follows from the kinematics alone, so any robot can be drawn; it is not its real shell.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.views.shapes import Solid, capsule, drum, stretched

ARM_COLOR, ARM_JOINT_COLOR = palette.ARM, palette.ARM_JOINT
HAND_COLOR, PALM_COLOR, HAND_JOINT_COLOR = palette.HAND, palette.PALM, palette.HAND_JOINT

ARM_RADIUS = 0.048
"""Of the arm's tubes [m]."""

FINGER_RADIUS = 0.009
"""Of a finger whose pad does not say how far it is from the finger's axis [m]."""

SHORTEST = 2e-3
"""Links shorter than this have no tube [m]."""


def robot_body(robot: ArmHand, q: ArrayLike) -> tuple[list[Solid], list[Solid]]:
    """The arm, and the hand with the fingertips last.

    Args:
        robot: The robot.
        q: (n,) actuator positions [rad or m].

    Raises:
        InputError: Bad q.
    """
    links = robot.links(q)
    description = robot.description
    arm, hand = _pedestal(description, links), _palm(description, links)
    for joint in description.joints:
        if joint.part == "hand":
            hand += _finger_link(description, joint, links)
        else:
            arm += _arm_link(joint, links, joint.parent == description.root)
    for finger in description.fingers:
        pose = links[finger.link]
        contact = pose @ finger.placement
        # How far the pad is from the axis of the last link, along the normal.
        height = float(finger.placement[:3, 3] @ (finger.placement[:3, :3] @ finger.normal))
        radius = height if 0.004 < height < 0.02 else FINGER_RADIUS
        middle = contact[:3, 3] - radius * contact[:3, :3] @ finger.normal
        hand.append((capsule(pose[:3, 3], middle, radius), HAND_COLOR))
    return arm, hand


def _pedestal(description: RobotDescription, links: Mapping[str, Array]) -> list[Solid]:
    """The foot of an arm; a hand alone stands on its palm."""
    if not description.arm_actuators:
        return []
    root = links[description.root]
    axis = root[:3, 2]
    foot = root[:3, 3] + 0.0125 * axis
    return [(drum(foot, axis, 1.9 * ARM_RADIUS, 0.025), ARM_JOINT_COLOR)]


def _arm_link(joint: Joint, links: Mapping[str, Array], lowest: bool) -> list[Solid]:
    start, end = links[joint.parent][:3, 3], links[joint.child][:3, 3]
    axis = links[joint.child][:3, :3] @ joint.axis
    solids: list[Solid] = []
    length = float(np.linalg.norm(end - start))
    if length > SHORTEST:
        # The round end of the lowest link must not come out below the foot.
        begin = start + min(1.0, ARM_RADIUS / length) * (end - start) if lowest else start
        solids.append((capsule(begin, end, ARM_RADIUS), ARM_COLOR))
    if joint.type != "revolute":
        return solids
    # A roll joint is a band around the tube, a pitch joint a drum across it.
    along = length > SHORTEST and abs(axis @ (end - start)) > 0.9 * length
    radius, width = (1.09, 0.35) if along else (1.12, 2.5)
    band = drum(end, axis, radius * ARM_RADIUS, width * ARM_RADIUS)
    return [*solids, (band, ARM_JOINT_COLOR)]


def _finger_link(
    description: RobotDescription, joint: Joint, links: Mapping[str, Array]
) -> list[Solid]:
    start, end = links[joint.parent][:3, 3], links[joint.child][:3, 3]
    solids: list[Solid] = []
    if joint.parent != description.palm_link and np.linalg.norm(end - start) > SHORTEST:
        solids.append((capsule(start, end, 1.15 * FINGER_RADIUS), HAND_COLOR))
    if joint.type == "revolute":
        axis = links[joint.child][:3, :3] @ joint.axis
        knuckle = drum(end, axis, 1.3 * FINGER_RADIUS, 2.7 * FINGER_RADIUS)
        solids.append((knuckle, HAND_JOINT_COLOR))
    return solids


def _palm(description: RobotDescription, links: Mapping[str, Array]) -> list[Solid]:
    """Drums upright in the palm frame, at the palm's origin and where the fingers begin, in one."""
    bases = [
        links[joint.child][:3, 3]
        for joint in description.joints
        if joint.part == "hand" and joint.parent == description.palm_link
    ]
    if not bases:
        return []
    corners = np.array([links[description.palm_link][:3, 3], *bases])
    up = (links[description.palm_link] @ description.palm_placement)[:3, 2]
    heights, radius = corners @ up, 2.2 * FINGER_RADIUS
    middle = (heights.min() + heights.max()) / 2 * up
    block = drum(middle, up, radius, max(float(np.ptp(heights)), 2 * radius))
    return [(stretched(block, corners - heights[:, None] * up), PALM_COLOR)]
