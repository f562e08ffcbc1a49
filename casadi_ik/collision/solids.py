"""Solids: one row of `ROWS` per kind, and what solids are made of.

A solid lies in its own frame: a half-space is all below z = 0; a box, a cylinder (along z) and a
capsule (along z) are about the origin; a convex body is all that is below its planes; a cloud is
balls about points. The planes of a round body touch it from outside, so the body they bound holds
it: distances are never larger than the true ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.model.objects import load_object
from casadi_ik.model.shapes import (
    BentCapsule,
    Box,
    Cylinder,
    EllipticCylinder,
    Mesh,
    MeshShape,
    Shape,
    Sphere,
    box_mesh,
    capsule_mesh,
    circle,
    prism_mesh,
)

GROUP = 32
"""Points of a cloud that share a bounding ball, as in ``runtime/clearance.c``."""


class Kind(IntEnum):
    """The kinds; drivers know them by these names and numbers."""

    HALF_SPACE = 0
    CAPSULE = 1
    BOX = 2
    CYLINDER = 3
    CONVEX = 4
    CLOUD = 5


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid in its own frame.

    Attributes:
        kind: Its kind.
        size: (3,) [m]: half the edges of a box; radius and half the length of a cylinder; radius
            and half the segment of a capsule; radius of a cloud's balls; else zero.
        reach: Radius of a ball about the origin that holds it [m]; infinite for a half-space.
        planes: (m, 4) outward unit normals and offsets [m] of a convex body. Of a cloud, for each
            `GROUP` of points: centre and radius of a ball that holds them, then the points and 0.
        surface: What it is drawn as, if that is known better than by its numbers.
    """

    kind: Kind
    size: Array
    reach: float
    planes: Array
    surface: Mesh | None = None

    @property
    def points(self) -> Array:
        """(k, 3) points of a cloud; the last of a group may be there several times."""
        return self.planes.reshape(-1, GROUP + 1, 4)[:, 1:, :3].reshape(-1, 3)

    def distance(self, points: Array) -> Array:
        """Signed distances (...) [m] of points (..., 3) in its frame; negative inside."""
        return ROWS[self.kind].distance(self, points)

    def mesh(self) -> Mesh:
        """Its surface: vertices (v, 3) [m] and triangles; of a half-space a plate at the origin."""
        return self.surface or (ROWS[self.kind].mesh or _seen_from_inside)(self)


@dataclass(frozen=True)
class Row:
    """What the package knows of a kind besides its distance in ``runtime/clearance.c``.

    Attributes:
        distance: Signed distance of points (..., 3) from a solid. Exact or less; convex, except
            for a cloud; grows no faster than the point moves.
        mesh: Its surface; None: as seen from its origin, without sharp edges.
        size: What the scene of an exported solver takes as its size, in words; None: it does not
            take the kind. The first kinds are those that it takes.
        factors: (3,) `Solid.size` by what is stated as the size; 0: not stated.
    """

    distance: Callable[[Solid, Array], Array]
    mesh: Callable[[Solid], Mesh] | None = None
    size: str | None = None
    factors: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _from_faces(beyond: Array) -> Array:
    """Distances from faces at right angles, given how far (..., n) a point is beyond each."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return outside + np.minimum(beyond.max(axis=-1), 0.0)


def _from_capsule(solid: Solid, p: Array) -> Array:
    z = p[..., 2] - np.clip(p[..., 2], -solid.size[1], solid.size[1])
    return np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + z * z) - solid.size[0]


def _from_cylinder(solid: Solid, p: Array) -> Array:
    across, along = np.hypot(p[..., 0], p[..., 1]), np.abs(p[..., 2])
    return _from_faces(np.stack([across - solid.size[0], along - solid.size[1]], axis=-1))


def _from_cloud(solid: Solid, p: Array) -> Array:
    apart = np.linalg.norm(p[..., None, :] - solid.points, axis=-1)
    return apart.min(axis=-1) - solid.size[0]


ROWS: dict[Kind, Row] = {
    Kind.HALF_SPACE: Row(
        distance=lambda _, p: p[..., 2],
        mesh=lambda _: box_mesh(np.array([0.7, 0.7, 5e-4]), np.array([0, 0, -5e-4])),
        size="all below z = 0 of its pose",
    ),
    Kind.CAPSULE: Row(
        distance=_from_capsule,
        mesh=lambda s: capsule_mesh(s.size[0], s.size[1]),
        size="along z; size: radius, length without the caps; a ball has length 0",
        factors=(1.0, 0.5, 0.0),
    ),
    Kind.BOX: Row(
        distance=lambda s, p: _from_faces(np.abs(p) - s.size),
        mesh=lambda s: box_mesh(s.size),
        size="size: its edges",
        factors=(0.5, 0.5, 0.5),
    ),
    Kind.CYLINDER: Row(
        distance=_from_cylinder,
        mesh=lambda s: prism_mesh(s.size[0] * circle(48), 2 * s.size[1]),
        size="along z; size: radius, length",
        factors=(1.0, 0.5, 0.0),
    ),
    Kind.CONVEX: Row(
        distance=lambda s, p: (p @ s.planes[:, :3].T - s.planes[:, 3]).max(axis=-1),
    ),
    Kind.CLOUD: Row(distance=_from_cloud, mesh=lambda s: _balls(s.points, s.size[0])),
}
"""The kinds: to add one, see docs/add_a_shape.md."""

C_NAMES = {kind.name: int(kind) for kind in Kind}
"""The kinds as the drivers' macros."""

EXPORTED = {kind: row for kind, row in ROWS.items() if row.size is not None}
"""The kinds that the scene of an exported solver takes."""


def stated(solid: Solid, pose: Array) -> dict[str, Any]:
    """A solid at a (4, 4) pose as an exported solver takes it: kind, size and 12 numbers."""
    factors = np.array(ROWS[solid.kind].factors)
    size = np.divide(solid.size, factors, out=np.zeros(3), where=factors > 0)
    return {
        "kind": int(solid.kind),
        "size": size.tolist(),
        "pose": [*pose[:3, :3].ravel().tolist(), *pose[:3, 3].tolist()],
    }


# Solids by their numbers.


def half_space() -> Solid:
    """All below z = 0."""
    return _solid(Kind.HALF_SPACE, (), math.inf)


def capsule(radius: float, half: float) -> Solid:
    """All within a radius of a segment along z of twice that half; a ball if it is zero."""
    return _solid(Kind.CAPSULE, (radius, half), radius + half)


def box(size: tuple[float, float, float]) -> Solid:
    """A box of these edges."""
    return _solid(Kind.BOX, tuple(edge / 2 for edge in size), math.hypot(*size) / 2)


def cylinder(radius: float, length: float) -> Solid:
    """A cylinder along z."""
    return _solid(Kind.CYLINDER, (radius, length / 2), math.hypot(radius, length / 2))


def _solid(kind: Kind, size: tuple[float, ...], reach: float) -> Solid:
    return Solid(kind, np.array([*size, *[0.0] * (3 - len(size))]), reach, np.zeros((0, 4)))


def convex(points: Array, normals: Array, surface: Mesh | None = None) -> Solid:
    """The convex hull of points (k, 3) whose faces have these normals (m, 3)."""
    planes = _planes(normals, lambda ways: (ways @ points.T).max(axis=1))
    reach = float(np.linalg.norm(points, axis=1).max())
    return Solid(Kind.CONVEX, np.zeros(3), reach, planes, surface)


def _planes(normals: Array, support: Callable[[Array], Array], spread_out: int = 512) -> Array:
    """(m, 4) planes that touch a body from outside: evenly spread ones, then its own faces.

    Between two of 512 spread planes a corner stands out by at most 2 % of its distance. The driver
    looks at the first few before all: a stride through their spiral spreads any first ones, too.
    """
    order = (np.arange(spread_out) * 197) % spread_out
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit, 6), axis=0, return_index=True)
    ways = np.concatenate([spread(spread_out)[order], unit[np.sort(first)]])
    return np.column_stack([ways, support(ways)])


def spread(count: int) -> Array:
    """(count, 3) unit vectors spread evenly, along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - z * z)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def cloud(points: Array, radius: float, most: int = 1024) -> list[tuple[Solid, Array]]:
    """Balls of a radius about points (k, 3): solids of at most so many, with (4, 4) poses."""
    found = []
    for part in _gathered(points, most):
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
    """One point for all in each cube of a grid, and how far one of them is from it at most.

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


# Solids of meshes and objects.


def hull(points: Array, where: str) -> Solid:
    """The convex hull of points (k, 3) [m].

    Args:
        points: The points.
        where: File and key, for the message.

    Raises:
        DescriptionError: The points are too few, not finite, or in a plane.
    """
    if points.ndim != 2 or len(points) < 4:
        raise DescriptionError(f"{where}: found {len(points)} points, expected at least 4")
    if not np.isfinite(points).all():
        raise DescriptionError(f"{where}: holds NaN or infinity, expected finite numbers")
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-9) < 3:
        raise DescriptionError(f"{where}: all points are in a plane, expected a body")
    from scipy.spatial import ConvexHull, QhullError

    try:
        faces = ConvexHull(points)
    except QhullError as error:
        raise DescriptionError(f"{where}: encloses no volume, expected a body") from error
    if faces.volume < 1e-9 / 6:  # [m^3]
        raise DescriptionError(f"{where}: encloses no volume, expected a body")
    ways = faces.equations[:, :3]
    a, b, c = (points[faces.simplices[:, i]] for i in range(3))
    inwards = (np.cross(b - a, c - a) * ways).sum(axis=1) < 0
    triangles = np.where(inwards[:, None], faces.simplices[:, ::-1], faces.simplices)
    # Triangles of one face have one normal.
    normals, of_triangle = np.unique(np.round(ways, 9), axis=0, return_inverse=True)
    if len(normals) > MAX_FACES:
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        weights = np.bincount(of_triangle.reshape(-1), weights=areas)
        normals = _distinct_directions(normals[np.argsort(-weights, kind="stable")], MAX_FACES)
    return convex(points, normals, (points, triangles.astype(np.int64)))


MAX_FACES = 1024
"""Faces of a convex hull; similar faces of a finer one are replaced by the largest of them.

The hull grows by that: where its radius of curvature is r, by less than 0.4 % of r.
"""

FIRST_ANGLE = float(np.deg2rad(2.0))
"""Faces whose normals differ by less are similar; more where there are too many faces [rad]."""


def _distinct_directions(directions: Array, count: int) -> Array:
    """Return at most `count` of unit vectors (k, 3), such that every other is near to one of them.

    Earlier vectors are preferred.
    """
    from scipy.spatial import cKDTree

    tree, angle = cKDTree(directions), FIRST_ANGLE
    while True:
        covered, kept = np.zeros(len(directions), dtype=bool), list[int]()
        for i in range(len(directions)):
            if covered[i]:
                continue
            kept.append(i)
            if len(kept) > count:
                break
            covered[tree.query_ball_point(directions[i], 2 * np.sin(angle / 2))] = True
        else:
            return directions[kept]
        angle *= 1.25


SPECK = 5e-3
"""Size of what is left out of a mesh if it is flat [m]."""


THIN = 1e-3
"""Thickness that a flat piece of a mesh gets [m]."""


def hulls(shape: MeshShape, where: str) -> list[tuple[Solid, Array]]:
    """The convex hulls of the pieces of a mesh, each with its (4, 4) pose in the mesh's frame.

    Specks that scanners leave, flat and smaller than `SPECK`, are no pieces; other flat pieces of
    several, a label that stands off, are `THIN`.

    Raises:
        DescriptionError: The only piece is flat.
    """
    found: list[tuple[Solid, Array]] = []
    for number, (points, _) in enumerate(shape.pieces):
        flat = len(points) < 4 or np.linalg.matrix_rank(points - points[0], tol=1e-9) < 3
        if flat and len(shape.pieces) > 1:
            if np.ptp(points, axis=0).max() < SPECK:
                continue
            across = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][-1]
            points = np.concatenate([points - THIN / 2 * across, points + THIN / 2 * across])
        pose = np.eye(4)
        pose[:3, 3] = points.mean(axis=0)
        named = f"{where}: piece {number} of {len(shape.pieces)}"
        found.append((hull(points - pose[:3, 3], named), pose))
    return found


def object_solids(name: str) -> list[tuple[Solid, Array]]:
    """The solids that an object consists of, each with its (4, 4) pose in its frame.

    Args:
        name: As `load_object` takes it.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: Its file is missing or malformed.
    """
    shape = load_object(name).shape
    return hulls(shape, name) if isinstance(shape, MeshShape) else of_object(shape)


def of_object(shape: Shape) -> list[tuple[Solid, Array]]:
    """The solids that a primitive object consists of, each with its (4, 4) pose in its frame."""
    here = np.eye(4)
    match shape:
        case Sphere():
            return [(capsule(shape.diameter / 2, 0.0), here)]
        case Cylinder():
            return [(cylinder(shape.diameter / 2, shape.height), here)]
        case Box():
            return [(box(shape.size), here)]
        case EllipticCylinder():
            return [(_elliptic(shape), here)]
        case BentCapsule():
            return _bent(shape)


def _elliptic(shape: EllipticCylinder) -> Solid:
    half = np.array([shape.width, shape.depth, shape.height]) / 2
    faces = np.concatenate([circle(64), [[0, 0, 1.0], [0, 0, -1.0]]])

    def support(ways: Array) -> Array:
        return np.hypot(ways[:, 0] * half[0], ways[:, 1] * half[1]) + np.abs(ways[:, 2]) * half[2]

    reach = math.hypot(max(half[0], half[1]), half[2])
    return Solid(Kind.CONVEX, np.zeros(3), reach, _planes(faces, support), shape.mesh(48))


def _bent(shape: BentCapsule, links: int = 5) -> list[tuple[Solid, Array]]:
    """Straight capsules along the arc, each wider by how far its arc leaves its chord."""
    points = shape.centreline(np.linspace(-shape.half_angle, shape.half_angle, links + 1))
    sagitta = shape.radius * (1 - math.cos(shape.half_angle / links))
    found = []
    for one, other in pairwise(points):
        along = (other - one) / np.linalg.norm(other - one)
        side = np.array([0.0, 0.0, 1.0])
        pose = np.eye(4)
        pose[:3] = np.column_stack([side, np.cross(along, side), along, (one + other) / 2])
        half = float(np.linalg.norm(other - one)) / 2
        found.append((capsule(shape.diameter / 2 + sagitta, half), pose))
    return found


# Surfaces.


def _seen_from_inside(solid: Solid) -> Mesh:
    """The surface of a body about the origin, along the rays to the vertices of a ball."""
    ways, triangles = capsule_mesh(1.0, 0.0, 48)
    return along_rays(solid, ways), triangles


def along_rays(solid: Solid, ways: Array) -> Array:
    """(k, 3) where rays (k, 3) from inside a solid come out of it."""
    low, high = np.zeros(len(ways)), np.full(len(ways), 1.01 * solid.reach)
    for _ in range(50):
        middle = (low + high) / 2
        inside = solid.distance(middle[:, None] * ways) < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return high[:, None] * ways


def _balls(points: Array, radius: float, most: int = 10_000) -> Mesh:
    """Octahedra for the balls of a cloud, of no more than so many."""
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    kept = points[:: 1 + len(points) // most]
    above = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2)], dtype=np.int64)
    faces = np.concatenate([above, above[:, [1, 0, 2]] + np.array([0, 0, 3])])
    first = 6 * np.arange(len(kept))[:, None, None]
    return (kept[:, None] + corners).reshape(-1, 3), (first + faces).reshape(-1, 3)
