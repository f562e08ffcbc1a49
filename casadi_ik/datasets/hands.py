"""A robot's hand at postures given joint by joint, whether or not its motors can take them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.grasps.pose import inverse
from casadi_ik.robots.description import RobotDescription


def link_poses(
    robot: RobotDescription, joints: Mapping[str, Array], count: int
) -> dict[str, Array]:
    """Poses (k, 4, 4) of all links in the base frame.

    Args:
        robot: The robot.
        joints: Positions (k,) by joint [rad or m]; the others are at zero.
        count: k.
    """
    poses = {robot.root: np.tile(np.eye(4), (count, 1, 1))}
    for joint in robot.joints:
        pose = poses[joint.parent] @ joint.placement
        if joint.name in joints:
            pose = pose @ motion(joint.type, joint.axis, joints[joint.name])
        poses[joint.child] = pose
    return poses


def motion(kind: str, axis: Array, positions: Array) -> Array:
    """(k, 4, 4) what a joint does (Rodrigues)."""
    moved = np.tile(np.eye(4), (len(positions), 1, 1))
    if kind == "prismatic":
        moved[:, :3, 3] = positions[:, None] * axis
        return moved
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(positions)[:, None, None], np.cos(positions)[:, None, None]
    moved[:, :3, :3] += s * cross + (1 - c) * (cross @ cross)
    return moved


def palms_of(
    robot: ArmHand, link: str, frames: Array, joints: Mapping[str, Array]
) -> tuple[Array, Array, Array]:
    """Palms and fingertips of hands whose frames are given.

    Args:
        robot: The robot.
        link: The link whose frames are given.
        frames: (k, 4, 4) its poses.
        joints: Positions (k,) by joint.

    Returns:
        Poses (k, 4, 4) of the robot's palm frame, contact points (k, f, 3) and normals (k, f, 3),
        in the frame in which the link's are given.
    """
    described = robot.description
    poses = link_poses(described, joints, len(frames))
    back = np.stack([inverse(pose) for pose in poses[link]])
    moved = frames @ back
    palms = moved @ poses[described.palm_link] @ described.palm_placement
    pads = np.stack([moved @ poses[f.link] @ f.placement for f in described.fingers], axis=1)
    normals = [pads[:, i, :3, :3] @ f.normal for i, f in enumerate(described.fingers)]
    return palms, pads[:, :, :3, 3], np.stack(normals, axis=1)
