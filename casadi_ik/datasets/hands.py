"""A robot's hand at postures given joint by joint, whether or not its motors can take them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.grasps.pose import inverse
from casadi_ik.problem.hand_motors import finger_joints, hand_motors
from casadi_ik.robots.description import RobotDescription

BEYOND = 0.02
"""A posture may be so far beyond a motor's limits [rad or m]; it is then at the limit."""

APART = 0.02
"""How far a joint may be from where its coupling puts it [rad or m]."""


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


def motor_positions(
    robot: ArmHand, where: str, joints: Mapping[str, Array]
) -> tuple[tuple[str, ...], Array]:
    """Positions of the motors that move fingers.

    Args:
        robot: The robot.
        where: File, for messages.
        joints: Positions (k,) by joint.

    Returns:
        Names of the motors, and (k, m) positions within their limits.

    Raises:
        DescriptionError: A motor is not among the joints, or beyond its limits; or a joint that
            others move is where they do not put it.
    """
    motors = hand_motors(robot.description)
    moved = _moved(robot.description, joints)
    for name in motors:
        if name not in moved:
            raise DescriptionError(f"{where}: {name}: missing, expected a position")
    columns = [robot.actuators.index(name) for name in motors]
    given = np.stack([moved[name] for name in motors], axis=1)
    lower, upper = robot.lower[columns], robot.upper[columns]
    found = np.clip(given, lower, upper)
    beyond = np.abs(given - found)
    if (beyond > BEYOND).any():
        row, i = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        raise DescriptionError(
            f"{where}: row {row}: {motors[i]}: found {given[row, i]:.4g}, expected "
            f"{lower[i]:.4g} to {upper[i]:.4g}"
        )
    reached = joints_at(robot, motors, found)
    for name in finger_joints(robot.description):
        if name not in joints or name in motors:
            continue
        off = np.abs(joints[name] - reached[name])
        if (off > APART).any():
            row = int(np.argmax(off))
            raise DescriptionError(
                f"{where}: row {row}: {name}: found {joints[name][row]:.4g}, where its coupling "
                f"has it at {reached[name][row]:.4g}; fingertips can be asked for instead "
                "(take='contacts')"
            )
    return motors, found


def _moved(robot: RobotDescription, joints: Mapping[str, Array]) -> dict[str, Array]:
    """The joints, and the motors whose joints are given alone: by the first that follows them."""
    found = dict(joints)
    for joint in robot.movable:
        slope = joint.coupling.slope if joint.coupling is not None else None
        if joint.coupling is None or slope is None or joint.name not in joints:
            continue
        if joint.coupling.of in robot.actuator_names:
            found.setdefault(joint.coupling.of, (joints[joint.name] - slope[1]) / slope[0])
    return found


def joints_at(robot: ArmHand, motors: tuple[str, ...], positions: Array) -> dict[str, Array]:
    """Positions (k,) of all joints with motors at (k, m), the others where they are at home."""
    q = np.tile(robot.home, (len(positions), 1))
    q[:, [robot.actuators.index(name) for name in motors]] = positions
    return robot.joints(q)
