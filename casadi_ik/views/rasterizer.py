"""Triangles to pixels: a z-buffer without a loop over triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FRAGMENTS = 3_000_000
"""How many pixels of triangles are worked on at a time, which bounds the memory."""


def rasterize(
    corners: Array, pixels: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64], Array]:
    """Which triangle is nearest at every pixel.

    Args:
        corners: (t, 3, 3) triangles as pixel coordinates and depth.
        pixels: Width and height of the image.

    Returns:
        Index of the triangle (h, w), -1 where there is none; weights of its corners (h, w, 3);
        depth (h, w), infinite where there is none.
    """
    width, height = pixels
    face = np.full(width * height, -1)
    weights = np.zeros((width * height, 3))
    depth = np.full(width * height, np.inf)
    flat = corners[..., :2]
    area = _cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    edges = _edges(flat, area)
    top = np.clip(np.ceil(flat[..., 1].min(axis=1) - 0.5), 0, height).astype(int)
    bottom = np.clip(np.ceil(flat[..., 1].max(axis=1) - 0.5), 0, height).astype(int)
    rows = np.where(np.abs(area) > 1e-9, bottom - top, 0)

    # A line is one triangle in one row of pixels, a fragment one of its pixels.
    owner, y = _expanded(top, rows)
    first, count = _covered(edges[owner], y + 0.5, width)
    parts = np.searchsorted(np.cumsum(count), np.arange(0, count.sum(), FRAGMENTS)[1:])
    for lines in np.split(np.arange(len(owner)), parts):
        line, x = _expanded(first[lines], count[lines])
        line = lines[line]
        triangle = owner[line]
        here = np.stack([x + 0.5, y[line] + 0.5, np.ones(len(x))], axis=1)
        share = np.einsum("pcx,px->pc", edges[triangle], here)
        distance = np.einsum("pc,pc->p", share, corners[triangle, :, 2])
        pixel = y[line] * width + x
        np.minimum.at(depth, pixel, distance)
        won = np.flatnonzero(distance <= depth[pixel])
        face[pixel[won]] = triangle[won]
        weights[pixel[won]] = share[won]
    shape = (height, width)
    return face.reshape(shape), weights.reshape(*shape, 3), depth.reshape(shape)


def _edges(flat: Array, area: Array) -> Array:
    """(t, 3, 3) rows (a, b, c): the weight of a corner is a x + b y + c, 0 on the edge opposite."""
    start, end = np.roll(flat, -1, axis=1), np.roll(flat, -2, axis=1)
    side = end - start
    offset = side[..., 1] * start[..., 0] - side[..., 0] * start[..., 1]
    edges = np.stack([-side[..., 1], side[..., 0], offset], axis=-1)
    return edges / np.where(np.abs(area) > 1e-9, area, 1.0)[:, None, None]


def _covered(edges: Array, y: Array, width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First pixel and number of pixels whose centres are inside, on the line at height y."""
    slope, offset = edges[..., 0], edges[..., 1] * y[:, None] + edges[..., 2]
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
