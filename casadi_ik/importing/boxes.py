"""Meshes as few boxes that hold them: what is flat is held badly by capsules."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.capsules import cut, halves

LEAST_SAVING = 0.12
"""Part of the volume that another box has to save."""

SPREAD = 24
"""Points along an edge of a box's skin."""


@dataclass(frozen=True, eq=False)
class FittedBox:
    """A box.

    Attributes:
        rotation: (3, 3) its axes, columns.
        center: (3,) [m].
        size: (3,) its edges [m].
    """

    rotation: Array
    center: Array
    size: Array

    @property
    def volume(self) -> float:
        """[m^3]."""
        return float(np.prod(self.size))

    def beyond(self, points: Array) -> Array:
        """(k,) how far points are outside, negative inside [m]."""
        local = np.abs((points - self.center) @ self.rotation) - self.size / 2
        return local.max(axis=1)

    def skin(self) -> Array:
        """(k, 3) points of its surface."""
        line = np.linspace(-0.5, 0.5, SPREAD)
        u, v = (one.ravel() for one in np.meshgrid(line, line))
        faces = []
        for axis in range(3):
            for side in (-0.5, 0.5):
                face = np.empty((len(u), 3))
                face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
                faces.append(face)
        return self.center + (np.concatenate(faces) * self.size) @ self.rotation.T


def fit_boxes(triangles: Array, most: int = 3) -> list[FittedBox]:
    """Boxes that hold a mesh of triangles (t, 3, 3) [m], no more than `most`."""
    parts = [cut(triangles)]
    found = [box_around(parts[0].reshape(-1, 3))]
    while len(parts) < most:
        options = []
        for i, part in enumerate(parts):
            for below in halves(part):
                two = part[below], part[~below]
                pair = [box_around(one.reshape(-1, 3)) for one in two]
                saved = found[i].volume - pair[0].volume - pair[1].volume
                options.append((saved, i, two, pair))
        if not options:
            break
        saved, i, two, pair = max(options, key=lambda option: option[0])
        if saved < LEAST_SAVING * sum(one.volume for one in found):
            break
        parts[i : i + 1], found[i : i + 1] = two, pair
    return found


def box_around(points: Array) -> FittedBox:
    """A small box that holds points (k, 3) [m], along the frame's axes or the points' own."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    found = []
    for rotation in (np.eye(3), axes.T):
        local = points @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        found.append(FittedBox(rotation, rotation @ ((low + high) / 2), high - low))
    # Its own axes only where they save something: plain numbers are better to read.
    return found[1] if found[1].volume < 0.9 * found[0].volume else found[0]
