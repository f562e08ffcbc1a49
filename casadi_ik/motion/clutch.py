"""Clutch of a follower: displacement from the targets of an operator to those of the robot."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

Poses = Mapping[str | None, Array]
"""Poses of palms (4, 4) by side; the side is None for a single arm-hand."""


def rotation_between(a: Array, b: Array) -> Array:
    """Return the smallest rotation (3, 3) that turns a unit vector a (3,) into b (3,)."""
    cosine, (x, y, z) = a @ b, np.cross(a, b)
    if cosine < -1 + 1e-12:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        axis /= np.linalg.norm(axis)
        return np.array(2.0 * axis[:, None] * axis - np.eye(3), dtype=float)  # half a turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


class Clutch:
    """Displacement of targets such that the first target after a pause does not move the robot.

    Points are translated, and normals and palms are rotated. Each finger and palm is anchored
    when its first target arrives.
    """

    def __init__(self, robot: ArmHand) -> None:
        """Start without anchored targets; NaN marks fingers without a displacement."""
        self._robot = robot
        self._offsets = np.full((len(robot.fingers), 3), np.nan)
        self._rotations = np.full((len(robot.fingers), 3, 3), np.nan)
        self._palm_displacements = dict[str | None, tuple[Array, Array]]()

    def displaced(
        self, q: Array, points: Array, normals: Array | None, palms: Poses
    ) -> tuple[Array, Array | None, Poses]:
        """Return the points, normals and palm poses of the robot for those of the operator.

        Args:
            q: (n,) posture to which new targets are anchored.
            points: (f, 3) contact points [m].
            normals: (f, 3) pad normals of any length, or None.
            palms: Target poses of palms.
        """
        self._anchor_contacts(q, points, normals)
        displaced_palms = {side: self._displaced_palm(q, side, palms[side]) for side in palms}
        points = np.where(np.isnan(self._offsets), points, points + self._offsets)
        if normals is None:
            return points, None, displaced_palms
        rotated = np.einsum("fij,fj->fi", self._rotations, normals)
        normals = np.where(np.isnan(self._rotations[:, 0]), normals, rotated)
        return points, normals, displaced_palms

    def _anchor_contacts(self, q: Array, points: Array, normals: Array | None) -> None:
        """Store the displacements of points and normals that are set for the first time."""
        directions = np.full_like(points, np.nan) if normals is None else normals
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        is_new_point = np.isnan(self._offsets[:, 0]) & np.isfinite(points).all(axis=1)
        # The length of a normal is NaN if it is free, and 0 or infinite if it is invalid.
        is_new_normal = np.isnan(self._rotations[:, 0, 0]) & np.isfinite(1 / lengths[:, 0])
        if is_new_point.any() or is_new_normal.any():
            tip_points, tip_normals = self._robot.contacts(q)
            self._offsets[is_new_point] = (tip_points - points)[is_new_point]
            for i in np.flatnonzero(is_new_normal):
                self._rotations[i] = rotation_between(directions[i] / lengths[i], tip_normals[i])

    def _displaced_palm(self, q: Array, side: str | None, target: Array) -> Array:
        """Return a target pose (4, 4) of a palm, displaced; the first one is anchored to q (n,)."""
        if side not in self._palm_displacements:
            palm = self._robot.palm(q, side)
            rotation = target[:3, :3].T @ palm[:3, :3]
            self._palm_displacements[side] = rotation, palm[:3, 3] - target[:3, 3]
        rotation, offset = self._palm_displacements[side]
        displaced = target.copy()
        displaced[:3, :3] = target[:3, :3] @ rotation
        displaced[:3, 3] += offset
        return displaced
