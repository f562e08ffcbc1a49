"""Forward kinematics in numpy, of many configurations at once: no graph, nothing compiled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.robots.description import Joint, RobotDescription


def link_frames(
    robot: RobotDescription,
    values: Mapping[str, Array],
    count: int,
    joints: Iterable[Joint] | None = None,
) -> dict:
    """Pose of every link in the base frame: rotations (count, 3, 3) and origins (count, 3).

    Args:
        robot: The description.
        values: (count,) by joint name [rad or m]; joints that are not named stay at zero.
        count: How many configurations.
        joints: Those that are wanted, from the root outwards; None: all.
    """
    frames = {robot.root: (np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))}
    for joint in robot.joints if joints is None else joints:
        rotation, origin = placed(frames[joint.parent], joint.placement)
        if joint.name in values and joint.type == "prismatic":
            origin = origin + rotation @ joint.axis * values[joint.name][:, None]
        elif joint.name in values and joint.type == "revolute":
            rotation = rotation @ turn(joint.axis, values[joint.name])
        frames[joint.child] = rotation, origin
    return frames


def placed(frame: tuple[Array, Array], placement: Array) -> tuple[Array, Array]:
    """The frame with a constant (4, 4) pose in another."""
    rotation, origin = frame
    return rotation @ placement[:3, :3], origin + rotation @ placement[:3, 3]


def turn(axis: Array, angles: Array) -> Array:
    """Rotations (k, 3, 3) about a unit axis by angles (k,) [rad], after Rodrigues."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, rest = np.sin(angles)[:, None, None], (1 - np.cos(angles))[:, None, None]
    return np.eye(3) + sine * K + rest * (K @ K)
