"""Triangle meshes swept from rings of points; for drawing, not for contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array

Mesh = tuple[Array, NDArray[np.int64]]
"""Vertices (v, 3) [m] and triangles (t, 3) of vertex indices, outward by the right-hand rule."""


def circle(count: int) -> Array:
    """(count, 3) points of the unit circle in the plane z = 0, counter-clockwise."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def tube(rings: Array, first: Array, last: Array) -> Mesh:
    """A closed tube.

    Args:
        rings: (r, n, 3) rings of n points, counter-clockwise seen from the end.
        first: (3,) the point that closes the start.
        last: (3,) the point that closes the end.
    """
    count, size = rings.shape[:2]
    here = np.arange(size)
    ahead = (here + 1) % size
    faces = []
    for ring in range(count - 1):
        a, b, c, d = (ring * size + here, ring * size + ahead, here, ahead)
        c, d = c + (ring + 1) * size, d + (ring + 1) * size
        faces += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    start, end, top = count * size, count * size + 1, (count - 1) * size
    faces.append(np.stack([np.full(size, start), ahead, here], axis=1))
    faces.append(np.stack([np.full(size, end), top + here, top + ahead], axis=1))
    vertices = np.concatenate([rings.reshape(-1, 3), [first, last]])
    return vertices.astype(float), np.concatenate(faces).astype(np.int64)


def prism(ring: Array, height: float) -> Mesh:
    """A prism along z over a (n, 3) ring in the plane z = 0, counter-clockwise, with two lids."""
    up = np.array([0.0, 0.0, height / 2])
    return tube(np.stack([ring - up, ring + up]), -up, up)
