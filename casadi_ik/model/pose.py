"""Poses that a user gives, and what they move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array


@dataclass(frozen=True)
class Free:
    """A pose that is looked for: x, y, z [m], then angles about the fixed axes x, y, z [rad].

    Attributes:
        lower: Six lower ends, base frame.
        upper: Six upper ends.

    Raises:
        InputError: Not six finite numbers each, or a lower end above its upper one.

    Example:
        >>> before = ik.Free([0.3, -0.2, 0.1, 0, 0, -1.0], [0.5, 0.2, 0.4, 0, 0, 1.0])
        >>> before.lower[0]
        0.3
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            try:
                ends = np.asarray(getattr(self, name), dtype=float)
            except (TypeError, ValueError) as error:
                raise InputError(f"{name}: expected six numbers: {error}") from error
            if ends.shape != (6,) or not np.isfinite(ends).all():
                raise InputError(f"{name}: found {ends.tolist()}, expected six finite numbers")
            object.__setattr__(self, name, tuple(ends.tolist()))
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise InputError(f"lower: found {self.lower}, expected none above {self.upper}")


def checked_pose(pose: ArrayLike, name: str = "object_pose") -> Array:
    """A pose (4, 4), or (k, 4, 4), as an array.

    Raises:
        InputError: A wrong shape, a number that is not finite, or no rigid motion.
    """
    try:
        array = np.asarray(pose, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array of numbers: {error}") from error
    if array.ndim not in (2, 3) or array.shape[-2:] != (4, 4):
        raise InputError(f"{name}: found shape {array.shape}, expected (4, 4)")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: holds NaN or infinity, expected finite numbers")
    rotation = array[..., :3, :3]
    product = rotation @ np.swapaxes(rotation, -1, -2)
    if not (np.abs(product - np.eye(3)).max() < 1e-6 and (np.linalg.det(rotation) > 0).all()):
        raise InputError(f"{name}: its first three columns are no rotation")
    if not (array[..., 3, :] == [0.0, 0.0, 0.0, 1.0]).all():
        raise InputError(f"{name}: its last row is not 0 0 0 1")
    return array


def one_pose(pose: ArrayLike, name: str = "pose") -> Array:
    """A single pose (4, 4), see `checked_pose`.

    Raises:
        InputError: As there, or there are several.
    """
    array = checked_pose(pose, name)
    if array.ndim != 2:
        raise InputError(f"{name}: found shape {array.shape}, expected (4, 4)")
    return array


def rotations_of(quaternions: Array) -> Array:
    """(k, 3, 3) rotations of quaternions (k, 4) w x y z of any length; NaN of a zero one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def inverse(pose: Array) -> Array:
    """Of poses (..., 4, 4)."""
    back = np.zeros_like(pose) + np.eye(4)
    back[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, 3] = -(back[..., :3, :3] @ pose[..., :3, 3, None])[..., 0]
    return back


def moved(arrays: Mapping[str, Array], pose: Array) -> dict[str, Array]:
    """Points and directions, (..., 3) each, from a frame at a pose into the base frame.

    Args:
        arrays: "points" are points, everything else is a direction.
        pose: (4, 4).
    """
    turn = pose[:3, :3].T
    return {
        name: array @ turn + pose[:3, 3] if name == "points" else array @ turn
        for name, array in arrays.items()
    }
