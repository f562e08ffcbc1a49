"""Closed surfaces to draw: solids of revolution and rounded prisms, as triangle meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.grasps.meshes import circle, tube

Array = NDArray[np.float64]

AROUND = 28
"""Points around an axis."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed surface of one colour.

    Attributes:
        vertices: (v, 3) [m], base frame.
        faces: (t, 3) vertex indices, outward by the right-hand rule.
        color: Any matplotlib colour.
    """

    vertices: Array
    faces: NDArray[np.int64]
    color: str


def revolved(
    profile: Sequence[tuple[float, float]], origin: ArrayLike, axis: ArrayLike, color: str
) -> Solid:
    """A profile turned about an axis.

    Args:
        profile: (height along the axis, radius) from one end to the other [m]; the ends are
            closed by flat lids.
        origin: (3,) where the height is zero.
        axis: (3,) direction of the axis, any length but zero.
        color: Colour.
    """
    heights, radii = np.array(profile, dtype=float).T
    rings = circle(AROUND)[None] * radii[:, None, None]
    rings[..., 2] = heights[:, None]
    vertices, faces = tube(rings, np.array([0, 0, heights[0]]), np.array([0, 0, heights[-1]]))
    return Solid(np.asarray(origin, dtype=float) + vertices @ _frame(axis).T, faces, color)


def capsule(start: ArrayLike, end: ArrayLike, radius: float, color: str) -> Solid:
    """A tube with round ends between two points."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(b - a))
    turn = np.linspace(0, np.pi / 2, 8)
    low = [(-radius * float(np.cos(t)), radius * float(np.sin(t))) for t in turn]
    high = [(length + radius * float(np.sin(t)), radius * float(np.cos(t))) for t in turn]
    return revolved(low + high, a, b - a if length > 1e-9 else (0, 0, 1), color)


def ball(center: ArrayLike, radius: float, color: str) -> Solid:
    """A sphere."""
    return capsule(center, center, radius, color)


def drum(center: ArrayLike, axis: ArrayLike, radius: float, length: float, color: str) -> Solid:
    """A cylinder with bevelled edges about a point."""
    bevel = min(0.12 * radius, 0.25 * length)
    profile = [
        (-length / 2, radius - bevel),
        (bevel - length / 2, radius),
        (length / 2 - bevel, radius),
        (length / 2, radius - bevel),
    ]
    return revolved(profile, center, axis, color)


def arrow(start: ArrayLike, direction: ArrayLike, length: float, width: float, color: str) -> Solid:
    """An arrow whose shaft is `width` thick."""
    head = min(0.45 * length, 3.2 * width)
    profile = [
        (0.0, width / 2),
        (length - head, width / 2),
        (length - head, 1.35 * width),
        (length, 0.02 * width),
    ]
    return revolved(profile, start, direction, color)


def rounded_prism(
    corners: ArrayLike, pose: Array, low: float, high: float, radius: float, color: str
) -> Solid:
    """An upright prism around discs, with bevelled edges.

    Args:
        corners: (k, 2) centres of the discs in the x-y plane of the pose.
        pose: (4, 4) frame of the prism.
        low: Where it begins along z.
        high: Where it ends along z.
        radius: Of the discs.
        color: Colour.
    """
    points = np.asarray(corners, dtype=float)
    directions = circle(2 * AROUND)
    # The furthest disc in every direction traces the hull of the discs.
    hull = points[np.argmax(directions[:, :2] @ points.T, axis=1)]
    bevel = min(0.25 * radius, 0.2 * (high - low))
    rings = []
    for height, inset in ((low, bevel), (low + bevel, 0), (high - bevel, 0), (high, bevel)):
        ring = directions * (radius - inset)
        ring[:, :2] += hull
        ring[:, 2] = height
        rings.append(ring)
    center = points.mean(axis=0)
    vertices, faces = tube(np.stack(rings), np.array([*center, low]), np.array([*center, high]))
    return Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, color)


def _frame(axis: ArrayLike) -> Array:
    """(3, 3) rotation whose z is along an axis."""
    z = np.asarray(axis, dtype=float)
    z = z / np.linalg.norm(z)
    frame = np.empty((3, 3))
    frame[:, 2] = z
    frame[:, 0] = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    frame[:, 0] /= np.linalg.norm(frame[:, 0])
    frame[:, 1] = np.cross(z, frame[:, 0])
    return frame
