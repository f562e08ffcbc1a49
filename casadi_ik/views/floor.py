"""A floor under a robot: a grid that fades out, and a soft shadow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_ik.views.camera import Camera
from casadi_ik.views.rasterizer import rasterize
from casadi_ik.views.solids import Solid

Array = NDArray[np.float64]

GRID = 0.25
"""Distance of the grid's lines [m]."""


def floor_image(camera: Camera, solids: Sequence[Solid], height: float) -> Array:
    """How bright a floor is at every pixel (h, w), 1 where there is none.

    Args:
        camera: Where from.
        solids: What throws a shadow, from above.
        height: Of the floor [m].
    """
    shadow = 1 - 0.24 * _shadow(camera, solids, height)
    tilt = float(camera.towards[2])
    if tilt < 0.05:
        return shadow
    width, rows = camera.pixels
    scale = camera.height / rows
    x = (np.arange(width) + 0.5 - width / 2) * scale
    y = -(np.arange(rows) + 0.5 - rows / 2) * scale
    plane = camera.center + x[None, :, None] * camera.right + y[:, None, None] * camera.up
    points = (plane - ((plane[..., 2:] - height) / tilt) * camera.towards)[..., :2]
    vertices = np.concatenate([solid.vertices for solid in solids])[:, :2]
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = 0.35 + float(np.linalg.norm(vertices - middle, axis=1).max())
    fade = np.clip(1.6 * (1 - np.linalg.norm(points - middle, axis=-1) / radius), 0.0, 1.0)
    # ... and before the picture ends, so that it has no edge.
    fade *= np.clip((0.5 - np.abs(x) / (width * scale)) / 0.12, 0.0, 1.0)[None]
    fade *= np.clip((0.5 - np.abs(y) / (rows * scale)) / 0.12, 0.0, 1.0)[:, None]
    off_line = np.abs((points / GRID + 0.5) % 1.0 - 0.5).min(axis=-1) * GRID
    line = np.clip(1.5 - off_line / (0.0012 + 0.4 * scale), 0.0, 1.0)
    return shadow * (1 - fade * (0.035 + 0.10 * line))


def _shadow(camera: Camera, solids: Sequence[Solid], floor: float) -> Array:
    """(h, w) how much of the light from above is missing on a floor, softened."""
    corners = np.concatenate([solid.vertices[solid.faces] for solid in solids])
    corners = corners[corners[..., 2].min(axis=1) >= floor - 1e-6].copy()
    corners[..., 2] = floor
    face, _ = rasterize(camera.project(corners), camera.pixels)
    shade = (face >= 0).astype(float)
    radius = max(1, int(0.008 * camera.pixels[1]))
    for axis in (0, 1, 0, 1):
        shade = _blurred(shade, radius, axis)
    return shade


def _blurred(values: Array, radius: int, axis: int) -> Array:
    """Running mean over 2 radius + 1 samples."""
    padding = [(0, 0), (0, 0)]
    padding[axis] = (radius + 1, radius)
    total = np.cumsum(np.pad(values, padding, mode="edge"), axis=axis)
    size = values.shape[axis]
    span = 2 * radius + 1
    return (
        np.take(total, range(span, span + size), axis=axis) - np.take(total, range(size), axis=axis)
    ) / span
