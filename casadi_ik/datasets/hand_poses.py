"""Poses and postures of a hand, as a data set has them: checked, whatever file they are from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from casadi_ik.arrays import Array, Bools
from casadi_ik.errors import DescriptionError

FAR = 5.0
"""A hand farther from its object than this [m] is one in millimetres."""

LARGE = 4 * np.pi
"""A joint that is turned farther than this [rad] is one in degrees."""

SKEW = 2e-3
"""How far a rotation may be from one: data sets keep four bytes a number."""


@dataclass(frozen=True, eq=False)
class HandPoses:
    """k grasps by one hand.

    Attributes:
        where: File and key, for messages.
        position: (k, 3) origin of the hand's frame in the object's [m].
        rotation: (k, 3, 3) its axes, exact rotations.
        joints: (k, m) joint positions [rad or m].
        names: Of the joints as the file calls them; none: the order of the hand's description.
        objects: What each grasp is of, as the file calls it; none: all are of one thing.
    """

    where: str
    position: Array
    rotation: Array
    joints: Array
    names: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check what is given.

        Raises:
            DescriptionError: No grasps, another number of poses than postures, numbers that are
                not finite or in other units, or no rotations.
        """
        count = len(self.position)
        shapes = {"position": (count, 3), "rotation": (count, 3, 3)}
        for name, shape in shapes.items():
            found = getattr(self, name).shape
            if found != shape:
                self._fail(f"{name}: found shape {found}, expected {shape}")
        if not count:
            self._fail("found no grasps, expected at least one")
        if self.joints.ndim != 2 or len(self.joints) != count:
            self._fail(f"joints: found shape {self.joints.shape}, expected ({count}, joints)")
        for name in ("position", "rotation", "joints"):
            finite = np.isfinite(getattr(self, name)).reshape(count, -1).all(axis=1)
            self._refuse(
                np.asarray(~finite), f"{name}: holds NaN or infinity, expected finite numbers"
            )
        away = np.linalg.norm(self.position, axis=1)
        if (away > FAR).any():
            row = int(np.argmax(away))
            self._fail(
                f"row {row}: position: found {away[row]:.4g} m from the object, expected at most "
                f"{FAR:g} m (numbers in mm?)"
            )
        self._refuse(
            np.asarray((np.abs(self.joints) > LARGE).any(axis=1)),
            "joints: found angles beyond two turns, expected radians (numbers in degrees?)",
        )
        object.__setattr__(self, "rotation", self._exact())

    def of(self, name: str | None) -> HandPoses:
        """The grasps of one thing.

        Args:
            name: What the file calls it; None: there is only one.

        Raises:
            DescriptionError: There are several, or none of that name.
        """
        if name is None and len(set(self.objects)) <= 1:
            return self
        known = sorted(set(self.objects))
        said = f"{len(known)} objects ({', '.join(known[:3])}{', ...' if known[3:] else ''})"
        if name is None:
            self._fail(f"found grasps of {said}, expected one; say which (of)")
        if name not in known:
            self._fail(f"of: found {name!r}, expected one of {said}")
        rows = np.flatnonzero(np.array(self.objects) == name)
        return HandPoses(
            f"{self.where}: {name}",
            self.position[rows],
            self.rotation[rows],
            self.joints[rows],
            self.names,
        )

    def _exact(self) -> Array:
        """The nearest rotations."""
        left, _, right = np.linalg.svd(self.rotation)
        exact = left @ right
        off = np.abs(exact - self.rotation).reshape(len(exact), -1).max(axis=1)
        bad = (off > SKEW) | (np.linalg.det(exact) < 0)
        self._refuse(bad, "rotation: its columns are no rotation, expected a rigid pose")
        return exact

    def _refuse(self, bad: Bools, problem: str) -> None:
        if bad.any():
            self._fail(f"row {int(np.argmax(bad))}: {problem}")

    def _fail(self, problem: str) -> NoReturn:
        raise DescriptionError(f"{self.where}: {problem}")

    @property
    def poses(self) -> Array:
        """(k, 4, 4)."""
        poses = np.tile(np.eye(4), (len(self.position), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.rotation, self.position
        return poses


def of_quaternions(quaternions: Array) -> Array:
    """(k, 3, 3) rotations of quaternions (k, 4) w x y z of any length; NaN of a zero one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def of_fixed_axes(angles: Array) -> Array:
    """(k, 3, 3) rotations about fixed axes by (k, 3) roll, pitch, yaw [rad], as URDF has them."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(angles).T, np.cos(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def of_two_columns(columns: Array) -> Array:
    """(k, 3, 3) rotations of (k, 6) two columns, from whose right angle both are as far as before.

    Their sum and their difference are at a right angle whatever they are. Columns that are none, or
    the same, become NaN. After `robust_compute_rotation_matrix_from_ortho6d` of GenDexGrasp.
    """

    def unit(vectors: Array) -> Array:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    with np.errstate(invalid="ignore", divide="ignore"):
        first, second = unit(columns[:, :3]), unit(columns[:, 3:])
        middle, across = unit(first + second), unit(first - second)
        first, second = unit(middle + across), unit(middle - across)
    return np.stack([first, second, np.cross(first, second)], axis=2)
