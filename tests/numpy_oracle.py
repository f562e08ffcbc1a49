"""Forward kinematics and limits in numpy alone, for many configurations at once.

It uses only the numbers of the description, and none of the package's arithmetic.
"""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.model.couplings import FourBar, LeadScrew


def joint_positions(robot: ik.ArmHand, q: np.ndarray) -> dict[str, np.ndarray]:
    """Return the positions (k,) of actuators and movable joints by name."""
    values = dict(zip(robot.actuators, q.T, strict=True))
    joints = {joint.name: joint for joint in robot.description.movable}

    def value(name: str) -> np.ndarray:
        if name not in values:
            coupling = joints[name].coupling
            values[name] = _coupled(coupling, value(coupling.of))
        return values[name]

    for name in joints:
        value(name)
    return values


def _coupled(coupling, x: np.ndarray) -> np.ndarray:
    if isinstance(coupling, LeadScrew):
        b, c = coupling.b, coupling.c
        return np.arccos((b * b + c * c - x * x) / (2 * b * c)) - coupling.theta_0
    if isinstance(coupling, FourBar):
        return _four_bar(coupling, coupling.phi_0 + x)
    return coupling.ratio * x + coupling.offset


def _four_bar(bar: FourBar, phi: np.ndarray) -> np.ndarray:
    """Return the coupler angle by intersecting circles, on the branch of the known pose."""
    pin = bar.p * np.exp(1j * phi)
    line = bar.g - pin
    crank_fraction = (np.abs(line) ** 2 + bar.h**2 - bar.q**2) / (2 * np.abs(line))
    across = np.sqrt(bar.h**2 - crank_fraction**2)
    unit = line / np.abs(line)
    solutions = []
    for side in (1, -1):
        angle = np.angle((crank_fraction + side * 1j * across) * unit * np.exp(-1j * phi))
        solutions.append((angle - bar.theta_3_0 + np.pi) % (2 * np.pi) - np.pi)
    return np.where(
        np.abs(solutions[0]).mean() < np.abs(solutions[1]).mean(), solutions[0], solutions[1]
    )


def contacts(robot: ik.ArmHand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals like `ArmHand.contacts`."""
    poses = links(robot, joint_positions(robot, q))
    points, normals = [], []
    for finger in robot.description.fingers:
        pose = poses[finger.link] @ finger.placement
        points.append(pose[:, :3, 3])
        normals.append(pose[:, :3, :3] @ finger.normal)
    return np.stack(points, axis=1), np.stack(normals, axis=1)


def links(robot: ik.ArmHand, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the poses (k, 4, 4) of links by name, from positions (k,) of all joints."""
    count = len(next(iter(values.values()), [0]))
    poses = {robot.description.root: np.tile(np.eye(4), (count, 1, 1))}
    for joint in robot.description.joints:
        pose = poses[joint.parent] @ joint.placement
        if joint.type == "prismatic":
            moved_poses = np.tile(np.eye(4), (count, 1, 1))
            moved_poses[:, :3, 3] = values[joint.name][:, None] * joint.axis
            pose = pose @ moved_poses
        elif joint.type == "revolute":
            pose = pose @ _rotation_about(joint.axis, values[joint.name])
        poses[joint.child] = pose
    return poses


def _rotation_about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return rotations by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = np.tile(np.eye(4), (len(angle), 1, 1))
    sine, versine = np.sin(angle)[:, None, None], 1 - np.cos(angle)[:, None, None]
    pose[:, :3, :3] += sine * cross + versine * (cross @ cross)
    return pose


def beyond_limits(robot: ik.ArmHand, q: np.ndarray) -> np.ndarray:
    """Return by how much the worst actuator or joint exceeds its limits (k,)."""
    values = joint_positions(robot, q)
    limited = [*robot.description.actuators, *robot.description.movable]
    return np.max(
        [np.maximum(x.lower - values[x.name], values[x.name] - x.upper) for x in limited], axis=0
    )
