"""Joint positions, link poses and vectors that the guesses about an imported hand use."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.joints import link_poses
from casadi_ik.model.parts import RobotPart


def mid_range_positions(part: RobotPart) -> dict[str, float]:
    """Return the middle of the range of every joint [rad or m]."""
    return {
        joint.name: (joint.lower + joint.upper) / 2
        for joint in part.joints
        if joint.type != "fixed"
    }


def random_positions(part: RobotPart, rng: np.random.Generator) -> dict[str, float]:
    """Return random positions in the middle half of the range of every joint."""
    return {
        joint.name: joint.lower + (0.25 + 0.5 * rng.random()) * (joint.upper - joint.lower)
        for joint in part.joints
        if joint.type != "fixed"
    }


def part_poses(part: RobotPart, positions: Mapping[str, float]) -> dict[str, Array]:
    """Return the pose (4, 4) of every link in the root frame."""
    return link_poses(part.root, part.joints, positions)


def transform_point(pose: Array, point: Array) -> Array:
    """Return a point (3,) in the frame in which its frame has a (4, 4) pose."""
    return pose[:3, :3] @ point + pose[:3, 3]


def unit_vector(vector: Array, fallback: Array) -> Array:
    """Return the direction of a vector; that of `fallback` if the vector is nearly zero."""
    length = float(np.linalg.norm(vector))
    direction = vector if length > 1e-9 else fallback
    return direction / np.linalg.norm(direction)


def perpendicular_part(vector: Array, axis: Array) -> Array:
    """Return the component of a vector that is perpendicular to a unit axis."""
    return vector - (vector @ axis) * axis


def any_perpendicular(axis: Array) -> Array:
    """Return a unit vector that is perpendicular to an axis."""
    perpendicular: Array = np.asarray(
        np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]), dtype=float
    )
    return unit_vector(perpendicular, axis)
