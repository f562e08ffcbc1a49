"""Triangles to pixels: a z-buffer without a loop over triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FRAGMENTS = 3_000_000
"""How many pixels of triangles are worked on at a time, which bounds the memory."""


FLAT = 1e-9
"""Doubled area below which a triangle is seen edge on [pixels^2]."""


def rasterize(
    corners: Array, pixels: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Which triangle is nearest at every pixel.

    Args:
        corners: (t, 3, 3) triangles as pixel coordinates and depth.
        pixels: Width and height of the image.

    Returns:
        Index of the triangle (h, w), -1 where there is none, and depth (h, w), infinite there.
    """
    width, height = pixels
    face = np.full(width * height, -1)
    depth = np.full(width * height, np.inf)
    flat = corners[..., :2]
    area, edges = _edges(flat)
    # Depth of a triangle's plane as a x + b y + c.
    planes = np.einsum("tcx,tc->tx", edges, corners[..., 2])
    top = np.clip(np.ceil(flat[..., 1].min(axis=1) - 0.5), 0, height).astype(int)
    bottom = np.clip(np.ceil(flat[..., 1].max(axis=1) - 0.5), 0, height).astype(int)
    rows = np.where(np.abs(area) > FLAT, bottom - top, 0)

    # A line is one triangle in one row of pixels, a fragment one of its pixels.
    owner, y = _expanded(top, rows)
    first, count = _covered(edges[owner], y, width)
    slope = planes[owner, 0]
    offset = planes[owner, 1] * (y + 0.5) + planes[owner, 2] + 0.5 * slope
    parts = np.searchsorted(np.cumsum(count), np.arange(0, count.sum(), FRAGMENTS)[1:])
    for lines in np.split(np.arange(len(owner)), parts):
        line, x = _expanded(first[lines], count[lines])
        line = lines[line]
        distance = slope[line] * x + offset[line]
        pixel = y[line] * width + x
        np.minimum.at(depth, pixel, distance)
        won = np.flatnonzero(distance <= depth[pixel])
        face[pixel[won]] = owner[line[won]]
    return face.reshape(height, width), depth.reshape(height, width)


def corner_weights(
    corners: Array,
    face: NDArray[np.int64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
) -> Array:
    """(k, 3) how much of each corner there is at pixels of triangles.

    Args:
        corners: (t, 3, 3) triangles as pixel coordinates and depth.
        face: (k,) the triangle at each pixel.
        rows: (k,) of the pixels.
        columns: (k,) of the pixels.
    """
    _, edges = _edges(corners[..., :2])
    x, y = columns + 0.5, rows + 0.5
    weights = [
        edges[:, i, 0][face] * x + edges[:, i, 1][face] * y + edges[:, i, 2][face] for i in range(3)
    ]
    return np.stack(weights, axis=1)


def _edges(flat: Array) -> tuple[Array, Array]:
    """Doubled areas (t,), and (t, 3, 3) rows (a, b, c): a corner's weight is a x + b y + c."""
    area = _cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    start, end = np.roll(flat, -1, axis=1), np.roll(flat, -2, axis=1)
    side = end - start
    offset = side[..., 1] * start[..., 0] - side[..., 0] * start[..., 1]
    edges = np.stack([-side[..., 1], side[..., 0], offset], axis=-1)
    return area, edges / np.where(np.abs(area) > FLAT, area, 1.0)[:, None, None]


def _covered(
    edges: Array, y: NDArray[np.int64], width: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixel and number of pixels whose centres are inside, in the row y."""
    slope, offset = edges[..., 0], edges[..., 1] * (y + 0.5)[:, None] + edges[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -offset / slope
    low = np.where(slope > 0, crossing, -np.inf).max(axis=1)
    high = np.where(slope < 0, crossing, np.inf).min(axis=1)
    beyond = ((slope == 0) & (offset < 0)).any(axis=1)
    first = np.ceil(np.clip(low - 0.5, 0, width)).astype(int)
    last = np.floor(np.clip(high - 0.5, -1, width - 1)).astype(int)
    return first, np.where(beyond, 0, np.maximum(last - first + 1, 0))


def _expanded(
    first: NDArray[np.int64], count: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All (i, first[i] + j) with j < count[i], as two flat arrays."""
    index = np.repeat(np.arange(len(count)), count)
    nth = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
    return index, first[index] + nth


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
