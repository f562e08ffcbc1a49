"""Solids of a scene as numbers: what the distance kernel knows of a shape that stands about.

A solid lies in its own frame. A half-space is all below z = 0; a box, a cylinder (along z) and a
capsule (along z) are about the origin; a convex body is all that is below its planes. Of what is
round but no ball nor cylinder the planes touch it from outside, so that the body of the planes
holds it: distances are never larger than the true ones. A cloud is balls about points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.grasps.shapes import BentCapsule, Box, Cylinder, EllipticCylinder, Shape, Sphere

DIRECTIONS = 512
"""Planes that round a convex body off, besides those of its faces: between two of them a corner
stands out by at most 2 % of the distance from it."""

STRIDE = 197
"""Places along their spiral from one of them to the next; has no factor in common with them."""

GROUP = 32
"""Points of a cloud that are looked at together; as in the driver."""

PART = 1024
"""Points of a cloud that are one solid: far ones are passed over by one look each."""

LINKS = 5
"""Capsules that a bent one is made of."""


class Kind(IntEnum):
    """Which shape; the numbers are those of the driver."""

    HALF_SPACE = 0
    CAPSULE = 1
    BOX = 2
    CYLINDER = 3
    CONVEX = 4
    CLOUD = 5


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape in its own frame.

    Attributes:
        kind: Which.
        size: (3,) [m]: of a box half its edges; of a cylinder radius and half its length; of a
            capsule radius and half its segment; of a cloud the radius of its balls; else nothing.
        reach: Radius of the ball about the origin that holds it [m]; infinite for a half-space.
        planes: (m, 4) outward unit normals and offsets [m] of a convex body; of a cloud, for every
            group of its points, middle and radius of what holds them, then the points and 0 [m].
    """

    kind: Kind
    size: Array
    reach: float
    planes: Array

    @property
    def points(self) -> Array:
        """(k, 3) points of a cloud; the last ones of a group may be there several times."""
        return self.planes.reshape(-1, GROUP + 1, 4)[:, 1:, :3].reshape(-1, 3)


NO_PLANES = np.zeros((0, 4))


def half_space() -> Solid:
    """All below z = 0."""
    return Solid(Kind.HALF_SPACE, np.zeros(3), math.inf, NO_PLANES)


def capsule(radius: float, half: float) -> Solid:
    """All within a radius of a segment along z of twice that half; a ball if it is zero."""
    return Solid(Kind.CAPSULE, np.array([radius, half, 0.0]), radius + half, NO_PLANES)


def box(size: tuple[float, float, float]) -> Solid:
    """A box of these edges."""
    half = np.array(size) / 2
    return Solid(Kind.BOX, half, float(np.linalg.norm(half)), NO_PLANES)


def cylinder(radius: float, length: float) -> Solid:
    """A cylinder along z."""
    half = length / 2
    return Solid(Kind.CYLINDER, np.array([radius, half, 0.0]), math.hypot(radius, half), NO_PLANES)


def convex(points: Array, normals: Array) -> Solid:
    """The convex hull of points (k, 3) whose faces have these normals (m, 3)."""
    planes = _planes(normals, lambda ways: (ways @ points.T).max(axis=1))
    return Solid(Kind.CONVEX, np.zeros(3), float(np.linalg.norm(points, axis=1).max()), planes)


def cloud(points: Array, radius: float) -> list[tuple[Solid, Array]]:
    """Balls of a radius about points (k, 3), as solids of some of them with their (4, 4) poses."""
    found = []
    for part in _gathered(points, PART):
        pose = np.eye(4)
        pose[:3, 3] = (part.min(axis=0) + part.max(axis=0)) / 2
        about, rows = part - pose[:3, 3], []
        for group in _gathered(about, GROUP):
            middle = (group.min(axis=0) + group.max(axis=0)) / 2
            # A hair more than it is, so that rounding leaves none of its points out.
            around = float(np.linalg.norm(group - middle, axis=1).max()) * (1 + 1e-9) + 1e-12
            filled = np.concatenate([group, np.repeat(group[-1:], GROUP - len(group), axis=0)])
            rows += [[*middle, around], *np.column_stack([filled, np.zeros(GROUP)])]
        reach = float(np.linalg.norm(about, axis=1).max()) + radius
        size = np.array([radius, 0.0, 0.0])
        found.append((Solid(Kind.CLOUD, size, reach, np.array(rows)), pose))
    return found


def _gathered(points: Array, most: int) -> Iterator[Array]:
    """Points in parts that lie together, halved across where they reach farthest."""
    if len(points) <= most:
        yield points
        return
    # All parts but the last one are full.
    half = most * (math.ceil(len(points) / most) // 2)
    order = np.argpartition(points[:, np.ptp(points, axis=0).argmax()], half)
    yield from _gathered(points[order[:half]], most)
    yield from _gathered(points[order[half:]], most)


def thinned(points: Array, edge: float) -> tuple[Array, float]:
    """One point for those in each cube of a grid, and how far one of them is from it at most.

    Args:
        points: (k, 3) [m].
        edge: Of a cube [m].

    Returns:
        (m, 3) the middle of what lies in each cube, and [m].
    """
    cells = np.floor((points - points.min(axis=0)) / edge)
    order = np.lexsort(cells.T)
    ordered, cells = points[order], cells[order]
    first = np.flatnonzero(np.append(True, (np.diff(cells, axis=0) != 0).any(axis=1)))
    middles = (np.minimum.reduceat(ordered, first) + np.maximum.reduceat(ordered, first)) / 2
    of = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(points))))
    return middles, float(np.linalg.norm(ordered - middles[of], axis=1).max())


def of_object(shape: Shape) -> list[tuple[Solid, Array]]:
    """The solids that an object's shape consists of, each with its (4, 4) pose in its frame."""
    here = np.eye(4)
    if isinstance(shape, Sphere):
        return [(capsule(shape.diameter / 2, 0.0), here)]
    if isinstance(shape, Cylinder):
        return [(cylinder(shape.diameter / 2, shape.height), here)]
    if isinstance(shape, Box):
        return [(box(shape.size), here)]
    if isinstance(shape, EllipticCylinder):
        return [(_elliptic(shape), here)]
    return _bent(shape)


def _elliptic(shape: EllipticCylinder) -> Solid:
    half = np.array([shape.width, shape.depth, shape.height]) / 2
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    around = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(64)])
    faces = np.concatenate([around, [[0, 0, 1.0], [0, 0, -1.0]]])

    def support(ways: Array) -> Array:
        return np.hypot(ways[:, 0] * half[0], ways[:, 1] * half[1]) + np.abs(ways[:, 2]) * half[2]

    reach = math.hypot(max(half[0], half[1]), half[2])
    return Solid(Kind.CONVEX, np.zeros(3), reach, _planes(faces, support))


def _bent(shape: BentCapsule) -> list[tuple[Solid, Array]]:
    """Straight capsules along the arc, each wider by how far its arc leaves its chord."""
    angles = np.linspace(-shape.half_angle, shape.half_angle, LINKS + 1)
    points = shape.centreline(angles)
    sagitta = shape.radius * (1 - math.cos(shape.half_angle / LINKS))
    found = []
    for one, other in pairwise(points):
        along = (other - one) / np.linalg.norm(other - one)
        side = np.array([0.0, 0.0, 1.0])
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([side, np.cross(along, side), along])
        pose[:3, 3] = (one + other) / 2
        half = float(np.linalg.norm(other - one)) / 2
        found.append((capsule(shape.diameter / 2 + sagitta, half), pose))
    return found


def _planes(normals: Array, support: Callable[[Array], Array]) -> Array:
    """(m, 4) planes that touch a body, with evenly spread normals and with these.

    Of the spread ones any that come first are spread, too: the driver looks at some before all.
    """
    order = (np.arange(DIRECTIONS) * STRIDE) % DIRECTIONS
    ways = np.concatenate([spread(DIRECTIONS)[order], _distinct(normals)])
    return np.column_stack([ways, support(ways)])


def _distinct(normals: Array) -> Array:
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit, 6), axis=0, return_index=True)
    return unit[np.sort(first)]


def spread(count: int) -> Array:
    """(count, 3) unit vectors spread evenly, along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - z * z)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
