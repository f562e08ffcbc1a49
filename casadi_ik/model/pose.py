"""Poses that a user gives, and what they move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

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


def inverse(pose: Array) -> Array:
    """Of poses (..., 4, 4)."""
    back = np.zeros_like(pose) + np.eye(4)
    back[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, 3] = -(back[..., :3, :3] @ pose[..., :3, 3, None])[..., 0]
    return back


def transform_arrays(arrays: Mapping[str, Array], pose: Array) -> dict[str, Array]:
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
