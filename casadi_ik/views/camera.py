"""Where a picture is taken from: a parallel projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A parallel projection.

    Attributes:
        right: (3,) unit, what is to the right in the image.
        up: (3,) unit.
        center: (3,) what the middle of the image shows [m].
        height: Of the visible part [m].
        pixels: Width and height of the image.
    """

    right: Array
    up: Array
    center: Array
    height: float
    pixels: tuple[int, int]

    @property
    def towards(self) -> Array:
        """(3,) unit, from the scene to the viewer."""
        return np.cross(self.right, self.up)

    def project(self, points: ArrayLike) -> Array:
        """Pixel coordinates (x to the right, y down) and depth [m] (away) of points (..., 3)."""
        axes = np.stack([self.right, -self.up, -self.towards])
        scale = self.pixels[1] / self.height
        seen = (np.asarray(points, dtype=float) - self.center) @ axes.T
        seen[..., :2] = seen[..., :2] * scale + np.array(self.pixels) / 2
        return seen


def camera_at(
    azimuth: float,
    elevation: float,
    points: ArrayLike,
    pixels: tuple[int, int],
    margin: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """A camera that shows given points.

    Args:
        azimuth: Where the viewer stands, about z from x [rad].
        elevation: How high above the horizon [rad].
        points: (k, 3) what must be in the image [m].
        pixels: Width and height of the image.
        margin: What is left free on either side, as parts of width and height.
    """
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    up = np.cos(elevation) * np.array([0, 0, 1.0]) - np.sin(elevation) * level
    axes = np.stack([right, up, np.cross(right, up)])
    seen = np.asarray(points, dtype=float) @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    width, height = (high - low)[:2] / (1 - 2 * np.array(margin))
    visible = max(height, width * pixels[1] / pixels[0])
    return Camera(right, up, (low + high) / 2 @ axes, visible, pixels)
