"""How far solids are from each other, by points of their surfaces: where an object may stand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import signed
from casadi_ik.collision.scene import Item
from casadi_ik.collision.solids import Kind, Solid, spread
from casadi_ik.grasps.pose import inverse

POINTS = 256
"""Of a surface, besides its edges."""

EDGE = 12
"""Points along an edge of a box; of a cylinder's rim four times as many."""

HALVINGS = 50
"""By which a surface is found along a ray."""


def gaps(item: Item, others: Sequence[Item], poses: Array) -> Array:
    """Distances (k,) [m] of a thing at poses (k, 4, 4) from others; negative: they overlap.

    Points of either's surface against the other: exact to a few millimetres.

    Args:
        item: What is moved.
        others: The rest.
        poses: Of the item, base frame.
    """
    least = np.full(len(poses), np.inf)
    for solid, part in item.parts:
        mine, wide = _skin(solid)
        for other, place in _placed(others):
            theirs, thick = _skin(other)
            points = mine[: 0 if other.kind is Kind.CLOUD else None]  # its own points tell all
            for row, pose in enumerate(poses @ part):
                seen = inverse(place) @ pose
                here = _apart(points, seen, other) - wide
                least[row] = min(least[row], here, _apart(theirs, inverse(seen), solid) - thick)
    return least


def _skin(solid: Solid) -> tuple[Array, float]:
    """(k, 3) points that tell where a solid is, in its frame; how far it reaches beyond them."""
    if solid.kind is Kind.CLOUD:
        return solid.points, float(solid.size[0])
    return surface(solid), 0.0


def surface(solid: Solid) -> Array:
    """(k, 3) points of a solid's surface in its frame; of a half-space none.

    Those of a convex body are seen from the middle of its frame, if that is inside.
    """
    if solid.kind is Kind.HALF_SPACE or (signed(solid, np.zeros((1, 3)))[0] >= 0).any():
        return np.zeros((0, 3))
    ways = spread(POINTS)
    low, high = np.zeros(len(ways)), np.full(len(ways), 1.01 * solid.reach)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        inside = signed(solid, middle[:, None] * ways)[0] < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.concatenate([high[:, None] * ways, _edges(solid)])


def _edges(solid: Solid) -> Array:
    if solid.kind is Kind.BOX:
        line = np.linspace(-1, 1, EDGE)
        corners = np.array([(a, b) for a in (-1, 1) for b in (-1, 1)])
        found = []
        for axis in range(3):
            edge = np.empty((4, EDGE, 3))
            edge[..., axis] = line
            edge[..., (axis + 1) % 3], edge[..., (axis + 2) % 3] = corners.T[:, :, None]
            found.append(edge.reshape(-1, 3))
        return np.concatenate(found) * solid.size
    if solid.kind is Kind.CYLINDER:
        turns = np.linspace(0, 2 * np.pi, 4 * EDGE, endpoint=False)
        half = solid.size[1]
        rim = solid.size[0] * np.column_stack([np.cos(turns), np.sin(turns)])
        ends = [np.column_stack([rim, np.full(len(rim), z)]) for z in (-half, half)]
        return np.concatenate(ends)
    return np.zeros((0, 3))


def _placed(items: Iterable[Item]) -> Iterator[tuple[Solid, Array]]:
    for item in items:
        for solid, place in item.parts:
            yield solid, item.pose @ place


def _apart(points: Array, pose: Array, solid: Solid) -> float:
    """Least distance of points (m, 3), which are at a pose in the frame of a solid, from it."""
    if not len(points):
        return np.inf
    return float(signed(solid, points @ pose[:3, :3].T + pose[:3, 3])[0].min())
