"""Free poses, and transformation of points and directions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array


@dataclass(frozen=True)
class Free:
    """A pose with free components: x, y, z [m], then angles about the fixed axes x, y, z [rad].

    Attributes:
        lower: Six lower bounds, base frame.
        upper: Six upper bounds.

    Raises:
        InputError: The bounds are not six finite numbers each, or a lower one is above its upper
            one.

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
                bounds = np.asarray(getattr(self, name), dtype=float)
            except (TypeError, ValueError) as error:
                raise InputError(f"{name}: expected six numbers: {error}") from error
            if bounds.shape != (6,) or not np.isfinite(bounds).all():
                raise InputError(f"{name}: found {bounds.tolist()}, expected six finite numbers")
            object.__setattr__(self, name, tuple(bounds.tolist()))
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise InputError(f"lower: found {self.lower}, expected none above {self.upper}")


def inverse(pose: Array) -> Array:
    """Return the inverse of poses (..., 4, 4)."""
    result = np.zeros_like(pose) + np.eye(4)
    result[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, 3] = -(result[..., :3, :3] @ pose[..., :3, 3, None])[..., 0]
    return result


def transform_arrays(arrays: Mapping[str, Array], pose: Array) -> dict[str, Array]:
    """Return points and directions, (..., 3) each, transformed from a frame into the base frame.

    Args:
        arrays: Arrays by name: "points" are points, all others are directions.
        pose: (4, 4) pose of the frame.
    """
    transposed = pose[:3, :3].T
    return {
        name: array @ transposed + pose[:3, 3] if name == "points" else array @ transposed
        for name, array in arrays.items()
    }
