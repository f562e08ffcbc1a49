"""Palm targets as contacts of a robot whose only fingertip is its palm frame.

A palm pose with a hand posture determines all contacts, but a palm pose within tolerance may move
them beyond theirs: a rotation by 10 deg moves a fingertip at a distance of 150 mm by 26 mm. The
search for a palm pose within its tolerance therefore fits the palm frame itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casadi_ik.kinematics.contacts import Kinds, kind_from_vectors
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.link_shapes import NO_SHAPES
from casadi_ik.model.targets import TargetBatch

PALM_KINDS: Kinds = (kind_from_vectors(("tangent",)),)
"""The contact that determines a palm pose: a point with a whole frame."""


def palm_robot(robot: RobotDescription) -> RobotDescription:
    """Return the arm without its hand, with the palm frame as its only fingertip.

    Args:
        robot: An arm-hand.
    """
    joints = robot.chain(robot.palm_link)
    arm = list(robot.arm_actuators)
    palm = Finger(
        name="palm",
        link=robot.palm_link,
        placement=robot.palm_placement,
        normal=np.array([1.0, 0.0, 0.0]),
        joints=(),
        tangent=np.array([0.0, 1.0, 0.0]),
    )
    return replace(
        robot,
        name=f"{robot.name}.palm",
        joints=joints,
        actuators=tuple(robot.actuators[i] for i in arm),
        fingers=(palm,),
        named_thumb=None,
        home=robot.home[arm],
        shapes=NO_SHAPES,
    )


def palm_contacts(robot: RobotDescription, targets: TargetBatch) -> TargetBatch:
    """Return palm poses as contacts of `palm_robot`.

    Args:
        robot: The arm-hand.
        targets: k targets with palm poses.
    """
    palms, arm = targets.palms, list(robot.arm_actuators)
    assert palms is not None
    return replace(
        targets,
        points=palms[:, None, :3, 3],
        normals=palms[:, None, :3, 0],
        extra_vectors={"tangents": palms[:, None, :3, 1]},
        tolerance=targets.largest_tolerance,
        fixed=None if targets.fixed is None else targets.fixed[..., arm],
        q0=None if targets.q0 is None else targets.q0[..., arm],
        palms=None,
    )
