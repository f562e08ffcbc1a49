"""Forward kinematics in numpy, of one or many configurations: nothing is built or compiled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.robots.description import Joint


def joint_positions(joints: Iterable[Joint], motors: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Positions (k,) of all movable joints behind their couplings, by name.

    Args:
        joints: All joints that couplings refer to, in any order.
        motors: Positions by motor [rad or m], numbers or (k,).
    """
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    found = {name: np.atleast_1d(np.asarray(value, float)) for name, value in motors.items()}

    def position(name: str) -> Array:
        if name not in found:
            coupling = by_name[name].coupling
            assert coupling is not None, f"joint {name!r} has no motor"
            found[name] = coupling.followed(position(coupling.of))
        return found[name]

    return {name: position(name) for name in by_name}


def link_poses(
    root: str, joints: Iterable[Joint], values: Mapping[str, ArrayLike]
) -> dict[str, Array]:
    """Poses of links in the root's frame, by name.

    Args:
        root: The base link.
        joints: Joints from the root outwards: all, or those of some chains.
        values: Positions by joint name [rad or m], numbers or (k,); joints that are not named
            stay at zero.

    Returns:
        (4, 4) each, or (k, 4, 4) of links that a joint with k positions moves.
    """
    poses = {root: np.eye(4)}
    for joint in joints:
        pose = poses[joint.parent] @ joint.placement
        if joint.name in values:
            pose = pose @ motion(joint.type, joint.axis, values[joint.name])
        poses[joint.child] = pose
    return poses


def motion(kind: str, axis: Array, positions: ArrayLike) -> Array:
    """(4, 4) or (k, 4, 4): what a joint of a type does at positions () or (k,) [rad or m]."""
    value = np.asarray(positions, dtype=float)[..., None, None]
    moved = np.zeros((*value.shape[:-2], 4, 4)) + np.eye(4)
    if kind == "prismatic":
        moved[..., :3, 3] = value[..., 0] * axis
    elif kind == "revolute":
        # Rodrigues' formula.
        x, y, z = axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        moved[..., :3, :3] += np.sin(value) * cross + (1 - np.cos(value)) * (cross @ cross)
    return moved
