"""Contacts that are made impossible in several ways; some of them stay possible."""

from __future__ import annotations

import numpy as np

import casadi_ik as ik
from casadi_ik.files.arrays import Array

Targets = tuple[Array, Array]

CLASSES = (
    "too far",
    "around the shoulder",
    "contacts 250 mm apart",
    "one contact moved by 30 to 150 mm",
    "contacts moved by 50 mm",
    "one normal reversed",
    "normals turned by 30 deg",
    "mirrored",
    "a motor 0.3 to 1 rad beyond its limit",
    "an arm joint 0.3 to 1 rad beyond its limit",
    "turned any way",
)
"""The last two need an arm: see `classes_of`."""


def classes_of(robot: ik.ArmHand) -> tuple[str, ...]:
    """Return the classes that apply to a robot."""
    return CLASSES if robot.description.arm_actuators else CLASSES[:-2]


def rigidly_moved(
    targets: Targets, rng: np.random.Generator, metres: float, angle: float
) -> Targets:
    """Displace every contact and rotate every normal in random directions."""
    points, normals = targets
    shift, turn = rng.normal(size=points.shape), rng.normal(size=normals.shape)
    points = points + metres * shift / np.linalg.norm(shift, axis=2, keepdims=True)
    turn -= (turn * normals).sum(axis=2, keepdims=True) * normals
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    return points, normals * np.cos(angle) + turn * np.sin(angle)


def impossible(robot: ik.ArmHand, name: str, rng: np.random.Generator, count: int) -> Targets:
    """Targets of a class, of which some or most cannot be reached."""
    points, normals = hands = robot.contacts(robot.random(rng, count))
    centre, rows = points.mean(axis=1, keepdims=True), np.arange(count)
    finger = rng.integers(0, points.shape[1], count)
    if name == "too far":
        displacement = rng.uniform(0.2, 1.5, (count, 1, 1)) * _unit(rng.normal(size=(count, 1, 3)))
        return points + displacement, normals
    if name == "around the shoulder":
        displacement = np.array([0, 0, 0.31]) + 0.05 * rng.normal(size=(count, 1, 3))
        return points - centre + displacement, normals
    if name == "contacts 250 mm apart":
        return points + 0.25 * _unit(rng.normal(size=points.shape)), normals
    if name == "one contact moved by 30 to 150 mm":
        shifted = points.copy()
        excess = rng.uniform(0.03, 0.15, (count, 1))
        shifted[rows, finger] += excess * _unit(rng.normal(size=(count, 3)))
        return shifted, normals
    if name == "contacts moved by 50 mm":
        return rigidly_moved(hands, rng, 0.05, 0.0)
    if name == "one normal reversed":
        rotated_normals = normals.copy()
        rotated_normals[rows, finger] *= -1
        return points, rotated_normals
    if name == "normals turned by 30 deg":
        return rigidly_moved(hands, rng, 0.0, np.deg2rad(30))
    if name == "mirrored":
        return points * np.array([-1, 1, 1]), normals * np.array([-1, 1, 1])
    if name == "turned any way":
        turns = _rotations(rng, count)
        rotated = np.einsum("kij,kfj->kfi", turns, points - centre)
        return centre + rotated, np.einsum("kij,kfj->kfi", turns, normals)
    arm = list(robot.description.arm_actuators)
    motors = arm if name.startswith("an arm") else range(len(robot.actuators))
    q, joint = robot.random(rng, count), rng.choice(list(motors), count)
    q[rows, joint] = robot.upper[joint] + rng.uniform(0.3, 1.0, count)
    return robot.contacts(q)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _rotations(rng: np.random.Generator, count: int) -> Array:
    """(k, 3, 3) uniform rotations, from unit quaternions."""
    w, x, y, z = _unit(rng.normal(size=(count, 4))).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
