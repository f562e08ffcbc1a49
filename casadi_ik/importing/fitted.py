"""Shapes of links as a description has them: simple ones as they are, meshes held by few."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.importing.boxes import FittedBox, fit_boxes
from casadi_ik.importing.capsules import LEAST_SAVING, FittedCapsule, cut, excess, fit
from casadi_ik.importing.surfaces import Surface
from casadi_ik.robots.collision_entries import BoxEntry, CapsuleEntry, ShapeEntry, SphereEntry

GRID = 1e4
"""What is fitted is rounded up to a tenth of a millimetre."""

LARGE = 0.13
"""Links longer than this [m] may have more capsules than `SMALL`."""

MOST = 4
"""Capsules of a large link, unless more are asked for."""

SMALL = 2
"""Capsules of a small link, at the most."""

LEAST = 1e-4
"""What is smaller than this [m] is no shape."""


def fitted(
    surfaces: Mapping[str, Surface],
    flat: Collection[str],
    known: Mapping[str, Sequence[ShapeEntry]] | None = None,
    most: int = MOST,
    saving: float = LEAST_SAVING,
) -> dict[str, list[ShapeEntry]]:
    """Shapes that hold links.

    Args:
        surfaces: By link what is to be held, in the link's frame.
        flat: Links that may be held by boxes: a palm, which fingers come near.
        known: By link shapes that are simple already; they stay what they are.
        most: Capsules of a large link, at the most.
        saving: Part of the volume that another one has to save.
    """
    found: dict[str, list[ShapeEntry]] = {}
    for link, surface in surfaces.items():
        if known and link in known:
            found[link] = list(known[link])
        elif len(surface.triangles) and float(np.ptp(surface.points, axis=0).max()) > LEAST:
            large = float(np.ptp(surface.points, axis=0).max()) > LARGE
            triangles = surface.points[surface.triangles]
            found[link] = _held(triangles, most if large else SMALL, link in flat, saving)
    return found


def _held(triangles: Array, most: int, flat: bool, saving: float) -> list[ShapeEntry]:
    """Capsules that hold a mesh, or boxes where it may be flat and they hold it closer."""
    capsules, beyond = fit(triangles, most, saving)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles).reshape(-1, 3))
        if closer < beyond:
            return [_box(one, _up(closer, 1e3)) for one in boxes]
    return [_capsule(one, _up(beyond, 1e3)) for one in capsules]


def _capsule(one: FittedCapsule, beyond: float) -> ShapeEntry:
    first, last = (_rounded(end) for end in (one.first, one.last))
    radius = math.ceil(one.radius * GRID + 0.9) / GRID
    if first == last:
        return SphereEntry(radius=radius, center=first, excess=beyond)
    return CapsuleEntry(ends=(first, last), radius=radius, excess=beyond)


def _box(one: FittedBox, beyond: float) -> ShapeEntry:
    size = np.ceil(one.size * GRID + 1.1) / GRID
    rpy = np.round(roll_pitch_yaw(one.rotation), 4)
    if np.any(rpy):  # what rounding may turn it by
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * GRID) / GRID
    x, y, z = size.tolist()
    roll, pitch, yaw = (rpy + 0.0).tolist()
    return BoxEntry(size=(x, y, z), xyz=_rounded(one.center), rpy=(roll, pitch, yaw), excess=beyond)


def _rounded(point: Array) -> tuple[float, float, float]:
    x, y, z = (np.round(point * GRID) / GRID + 0.0).tolist()
    return x, y, z


def _up(value: float, grid: float) -> float:
    return math.ceil(grid * value) / grid


def worst(shapes: Mapping[str, Sequence[ShapeEntry]]) -> float:
    """By how much shapes stand out beyond what they hold, at most [m]."""
    return max((one.excess for found in shapes.values() for one in found), default=0.0)
