"""Solids of scenes, with one entry of `KIND_PROPERTIES` per kind, and their construction.

A solid is defined in a local frame. A half-space is the volume below z = 0. A box, a cylinder
(along z) and a capsule (along z) are centered at the origin. A convex body is the volume below its
planes. A cloud is a set of balls around points. The planes of a round body are tangent to it:
they bound a larger body, and distances are never larger than the true ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.model.mesh_shape import MeshShape
from casadi_ik.model.objects import load_object
from casadi_ik.model.shapes import (
    BentCapsule,
    Box,
    Cylinder,
    EllipticCylinder,
    Mesh,
    Shape,
    Sphere,
    box_mesh,
    capsule_mesh,
    circle,
    prism_mesh,
)

CLOUD_GROUP = 32
"""Number of points of a cloud per bounding ball, as in ``compile/runtime/clearance.c``."""


class Kind(IntEnum):
    """Kinds of solids, with the names and numbers of the drivers' macros."""

    HALF_SPACE = 0
    CAPSULE = 1
    BOX = 2
    CYLINDER = 3
    CONVEX = 4
    CLOUD = 5


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid in a local frame.

    Attributes:
        kind: The kind.
        size: (3,) [m] half edges of a box; radius and half length of a cylinder; radius and half
            length of the segment of a capsule; radius of the balls of a cloud; else zero.
        reach: Radius of a bounding ball around the origin [m]; infinite for a half-space.
        planes: (m, 4) outward unit normals and offsets [m] of a convex body. For a cloud, center
            and radius of a bounding ball for each `CLOUD_GROUP` points, followed by rows of a point
            and 0.
        surface: Mesh for drawing; None: derived from the numbers.
    """

    kind: Kind
    size: Array
    reach: float
    planes: Array
    surface: Mesh | None = None

    @property
    def points(self) -> Array:
        """Points of a cloud, (k, 3); the last point of a group may be repeated."""
        return self.planes.reshape(-1, CLOUD_GROUP + 1, 4)[:, 1:, :3].reshape(-1, 3)

    def distance(self, points: Array) -> Array:
        """Return signed distances (...) [m] of points (..., 3) in its frame; negative inside."""
        return KIND_PROPERTIES[self.kind].distance(self, points)

    def mesh(self) -> Mesh:
        """Return the surface as vertices (v, 3) [m] and triangles; a plate for a half-space."""
        return self.surface or (KIND_PROPERTIES[self.kind].mesh or _radial_mesh)(self)


PosedSolid = tuple[Solid, Array]
"""A solid and its (4, 4) pose in the frame of the obstacle or object that it belongs to."""


@dataclass(frozen=True)
class KindProperties:
    """The properties of a kind of solid besides its distance in ``compile/runtime/clearance.c``.

    Attributes:
        distance: Signed distance of points (..., 3) from a solid. It is at most the true distance,
            convex except for a cloud, and has Lipschitz constant 1.
        mesh: Surface of a solid; None: by rays from its origin, without sharp edges.
        size: Description of the size argument in exported solvers; None: the kind is not exported.
            Exported kinds come first.
        factors: (3,) ratio of `Solid.size` and the size argument; 0: not an argument.
    """

    distance: Callable[[Solid, Array], Array]
    mesh: Callable[[Solid], Mesh] | None = None
    size: str | None = None
    factors: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _face_distance(distances: Array) -> Array:
    """Return distances from orthogonal faces, given the distances (..., n) from each."""
    outside = np.linalg.norm(np.maximum(distances, 0.0), axis=-1)
    return outside + np.minimum(distances.max(axis=-1), 0.0)


def _capsule_distance(solid: Solid, p: Array) -> Array:
    z = p[..., 2] - np.clip(p[..., 2], -solid.size[1], solid.size[1])
    return np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + z * z) - solid.size[0]


def _cylinder_distance(solid: Solid, p: Array) -> Array:
    radial, axial = np.hypot(p[..., 0], p[..., 1]), np.abs(p[..., 2])
    return _face_distance(np.stack([radial - solid.size[0], axial - solid.size[1]], axis=-1))


def _cloud_distance(solid: Solid, p: Array) -> Array:
    distances = np.linalg.norm(p[..., None, :] - solid.points, axis=-1)
    return distances.min(axis=-1) - solid.size[0]


KIND_PROPERTIES: dict[Kind, KindProperties] = {
    Kind.HALF_SPACE: KindProperties(
        distance=lambda _, p: p[..., 2],
        mesh=lambda _: box_mesh(np.array([0.7, 0.7, 5e-4]), np.array([0, 0, -5e-4])),
        size="the half-space below z = 0 of its pose",
    ),
    Kind.CAPSULE: KindProperties(
        distance=_capsule_distance,
        mesh=lambda s: capsule_mesh(s.size[0], s.size[1]),
        size="along z; size: radius, length without the caps; a ball has length 0",
        factors=(1.0, 0.5, 0.0),
    ),
    Kind.BOX: KindProperties(
        distance=lambda s, p: _face_distance(np.abs(p) - s.size),
        mesh=lambda s: box_mesh(s.size),
        size="size: its edges",
        factors=(0.5, 0.5, 0.5),
    ),
    Kind.CYLINDER: KindProperties(
        distance=_cylinder_distance,
        mesh=lambda s: prism_mesh(s.size[0] * circle(48), 2 * s.size[1]),
        size="along z; size: radius, length",
        factors=(1.0, 0.5, 0.0),
    ),
    Kind.CONVEX: KindProperties(
        distance=lambda s, p: (p @ s.planes[:, :3].T - s.planes[:, 3]).max(axis=-1),
    ),
    Kind.CLOUD: KindProperties(
        distance=_cloud_distance, mesh=lambda s: _ball_mesh(s.points, s.size[0])
    ),
}
"""Properties of all kinds; docs/add_a_shape.md describes how to add one."""

C_NAMES = {kind.name: int(kind) for kind in Kind}
"""Macros of the kinds for the drivers."""

EXPORTED_KINDS = {kind: row for kind, row in KIND_PROPERTIES.items() if row.size is not None}
"""Kinds that the scene of an exported solver accepts."""


def solid_to_dict(solid: Solid, pose: Array) -> dict[str, Any]:
    """Return a solid at a (4, 4) pose as arguments of an exported solver."""
    factors = np.array(KIND_PROPERTIES[solid.kind].factors)
    size = np.divide(solid.size, factors, out=np.zeros(3), where=factors > 0)
    return {
        "kind": int(solid.kind),
        "size": size.tolist(),
        "pose": [*pose[:3, :3].ravel().tolist(), *pose[:3, 3].tolist()],
    }


# Primitive solids.


def half_space() -> Solid:
    """Return the half-space below z = 0."""
    return _solid(Kind.HALF_SPACE, (), math.inf)


def capsule(radius: float, half_length: float) -> Solid:
    """Return a capsule along z; a ball if the half length of its segment [m] is 0."""
    return _solid(Kind.CAPSULE, (radius, half_length), radius + half_length)


def box(size: tuple[float, float, float]) -> Solid:
    """Return a box with the given edges [m]."""
    return _solid(Kind.BOX, tuple(edge / 2 for edge in size), math.hypot(*size) / 2)


def cylinder(radius: float, length: float) -> Solid:
    """Return a cylinder along z [m]."""
    return _solid(Kind.CYLINDER, (radius, length / 2), math.hypot(radius, length / 2))


def _solid(kind: Kind, size: tuple[float, ...], reach: float) -> Solid:
    return Solid(kind, np.array([*size, *[0.0] * (3 - len(size))]), reach, np.zeros((0, 4)))


def convex(points: Array, normals: Array, surface: Mesh | None = None) -> Solid:
    """Return the convex hull of points (k, 3) with face normals (m, 3)."""
    planes = _planes(normals, lambda directions: (directions @ points.T).max(axis=1))
    reach = float(np.linalg.norm(points, axis=1).max())
    return Solid(Kind.CONVEX, np.zeros(3), reach, planes, surface)


def _planes(normals: Array, support: Callable[[Array], Array], spread_count: int = 512) -> Array:
    """Return tangent planes (m, 4): evenly spread ones, then planes of the faces.

    A corner between 512 spread planes protrudes by at most 2 % of its distance. The driver checks
    the first few planes before all, so a stride through the spiral spreads any first planes evenly.

    Args:
        normals: (k, 3) normals of the faces.
        support: Support function, from directions (m, 3) to largest coordinates along them (m,).
        spread_count: Number of evenly spread planes.
    """
    order = (np.arange(spread_count) * 197) % spread_count
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit, 6), axis=0, return_index=True)
    directions = np.concatenate([sphere_directions(spread_count)[order], unit[np.sort(first)]])
    return np.column_stack([directions, support(directions)])


def sphere_directions(count: int) -> Array:
    """Return (count, 3) unit vectors spread evenly along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def cloud_solids(points: Array, radius: float, max_points: int = 1024) -> list[PosedSolid]:
    """Return balls around points as clouds of limited size.

    Args:
        points: (k, 3) points [m].
        radius: Radius of the balls [m].
        max_points: Maximum number of points per cloud.

    Returns:
        Clouds with their (4, 4) poses.
    """
    solids = []
    for part in _split_points(points, max_points):
        pose = np.eye(4)
        pose[:3, 3] = (part.min(axis=0) + part.max(axis=0)) / 2
        local, rows = part - pose[:3, 3], []
        for group in _split_points(local, CLOUD_GROUP):
            center = (group.min(axis=0) + group.max(axis=0)) / 2
            # Slightly enlarged, so that rounding excludes no point.
            ball = float(np.linalg.norm(group - center, axis=1).max()) * (1 + 1e-9) + 1e-12
            padding = np.repeat(group[-1:], CLOUD_GROUP - len(group), axis=0)
            padded = np.concatenate([group, padding])
            rows += [[*center, ball], *np.column_stack([padded, np.zeros(CLOUD_GROUP)])]
        reach = float(np.linalg.norm(local, axis=1).max()) + radius
        size = np.array([radius, 0.0, 0.0])
        solids.append((Solid(Kind.CLOUD, size, reach, np.array(rows)), pose))
    return solids


def _split_points(points: Array, max_points: int) -> Iterator[Array]:
    """Yield compact parts of points by recursive halving along the longest extent."""
    if len(points) <= max_points:
        yield points
        return
    # All parts but the last one are full.
    middle = max_points * (math.ceil(len(points) / max_points) // 2)
    order = np.argpartition(points[:, np.ptp(points, axis=0).argmax()], middle)
    yield from _split_points(points[order[:middle]], max_points)
    yield from _split_points(points[order[middle:]], max_points)


def grid_centers(points: Array, edge: float) -> tuple[Array, float]:
    """Downsample points to one per cell of a grid.

    Args:
        points: (k, 3) points [m].
        edge: Edge of a cell [m].

    Returns:
        (m, 3) centers of the points of each cell, and the largest distance of a point from its
        center [m].
    """
    cells = np.floor((points - points.min(axis=0)) / edge)
    order = np.lexsort(cells.T)
    ordered, cells = points[order], cells[order]
    first = np.flatnonzero(np.append(True, (np.diff(cells, axis=0) != 0).any(axis=1)))
    centers = (np.minimum.reduceat(ordered, first) + np.maximum.reduceat(ordered, first)) / 2
    cell_of = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(points))))
    return centers, float(np.linalg.norm(ordered - centers[cell_of], axis=1).max())


# Solids of meshes and objects.


def hull(points: Array, location: str) -> Solid:
    """Return the convex hull of points (k, 3) [m].

    Args:
        points: The points.
        location: File and key for error messages.

    Raises:
        DescriptionError: The points are too few, not finite, or in a plane.
    """
    if points.ndim != 2 or len(points) < 4:
        raise DescriptionError(f"{location}: found {len(points)} points, expected at least 4")
    if not np.isfinite(points).all():
        raise DescriptionError(f"{location}: points are not finite; expected finite numbers")
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-9) < 3:
        raise DescriptionError(f"{location}: points are coplanar; expected a body")
    with optional_import("convex hulls"):
        from scipy.spatial import ConvexHull, QhullError

    try:
        faces = ConvexHull(points)
    except QhullError as error:
        raise DescriptionError(f"{location}: hull has no volume; expected a body") from error
    if faces.volume < 1e-9 / 6:  # [m^3]
        raise DescriptionError(f"{location}: hull has no volume; expected a body")
    directions = faces.equations[:, :3]
    a, b, c = (points[faces.simplices[:, i]] for i in range(3))
    is_inward = (np.cross(b - a, c - a) * directions).sum(axis=1) < 0
    triangles = np.where(is_inward[:, None], faces.simplices[:, ::-1], faces.simplices)
    # Triangles of a face share a normal.
    normals, of_triangle = np.unique(np.round(directions, 9), axis=0, return_inverse=True)
    if len(normals) > MAX_FACES:
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        weights = np.bincount(of_triangle.reshape(-1), weights=areas)
        normals = _distinct_directions(normals[np.argsort(-weights, kind="stable")], MAX_FACES)
    return convex(points, normals, (points, triangles.astype(np.int64)))


MAX_FACES = 1024
"""Maximum number of faces of a convex hull; groups of similar faces are replaced by the largest.

The replacement enlarges the hull by less than 0.4 % of its radius of curvature.
"""

FIRST_ANGLE = float(np.deg2rad(2.0))
"""Initial angle between the normals of similar faces [rad]; it grows until few faces remain."""


def _distinct_directions(directions: Array, count: int) -> Array:
    """Select at most `count` unit vectors that cover all directions (k, 3).

    Every direction is close to a selected one. Earlier directions are preferred.
    """
    with optional_import("convex hulls"):
        from scipy.spatial import KDTree

    tree, angle = KDTree(directions), FIRST_ANGLE
    while True:
        covered, selected = np.zeros(len(directions), dtype=bool), list[int]()
        for i in range(len(directions)):
            if covered[i]:
                continue
            selected.append(i)
            if len(selected) > count:
                break
            covered[tree.query_ball_point(directions[i], 2 * np.sin(angle / 2))] = True
        else:
            return directions[selected]
        angle *= 1.25


MAX_SPECK_SIZE = 5e-3
"""Maximum size of flat pieces of a mesh that are ignored [m]."""

FLAT_THICKNESS = 1e-3
"""Thickness that is given to a flat piece of a mesh [m]."""


def mesh_hulls(shape: MeshShape, location: str) -> list[PosedSolid]:
    """Return the convex hulls of the pieces of a mesh, with their (4, 4) poses in its frame.

    Flat pieces smaller than `MAX_SPECK_SIZE`, which scanners produce, are ignored. Other flat
    pieces, such as a label that stands off, are thickened to `FLAT_THICKNESS`.

    Raises:
        DescriptionError: The only piece is flat.
    """
    solids: list[PosedSolid] = []
    for number, (points, _) in enumerate(shape.pieces):
        is_flat = len(points) < 4 or np.linalg.matrix_rank(points - points[0], tol=1e-9) < 3
        if is_flat and len(shape.pieces) > 1:
            if np.ptp(points, axis=0).max() < MAX_SPECK_SIZE:
                continue
            normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][-1]
            offset = FLAT_THICKNESS / 2 * normal
            points = np.concatenate([points - offset, points + offset])
        pose = np.eye(4)
        pose[:3, 3] = points.mean(axis=0)
        piece = f"{location}: piece {number} of {len(shape.pieces)}"
        solids.append((hull(points - pose[:3, 3], piece), pose))
    return solids


def object_solids(name: str) -> list[PosedSolid]:
    """Return the solids of an object, with their (4, 4) poses in its frame.

    Args:
        name: Name or path, as for `load_object`.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: Its file is missing or malformed.
    """
    shape = load_object(name).shape
    return mesh_hulls(shape, name) if isinstance(shape, MeshShape) else primitive_solids(shape)


def primitive_solids(shape: Shape) -> list[PosedSolid]:
    """Return the solids of a primitive object, with their (4, 4) poses in its frame."""
    origin = np.eye(4)
    match shape:
        case Sphere():
            return [(capsule(shape.diameter / 2, 0.0), origin)]
        case Cylinder():
            return [(cylinder(shape.diameter / 2, shape.height), origin)]
        case Box():
            return [(box(shape.size), origin)]
        case EllipticCylinder():
            return [(_elliptic_solid(shape), origin)]
        case BentCapsule():
            return _bent_solids(shape)


def _elliptic_solid(shape: EllipticCylinder) -> Solid:
    a, b, c = np.array([shape.width, shape.depth, shape.height]) / 2
    faces = np.concatenate([circle(64), [[0, 0, 1.0], [0, 0, -1.0]]])

    def support(directions: Array) -> Array:
        return np.hypot(directions[:, 0] * a, directions[:, 1] * b) + np.abs(directions[:, 2]) * c

    reach = math.hypot(max(a, b), c)
    return Solid(Kind.CONVEX, np.zeros(3), reach, _planes(faces, support), shape.mesh(48))


def _bent_solids(shape: BentCapsule, links: int = 5) -> list[PosedSolid]:
    """Return straight capsules along the arc, each enlarged by the sagitta of its chord."""
    points = shape.centreline(np.linspace(-shape.half_angle, shape.half_angle, links + 1))
    sagitta = shape.radius * (1 - math.cos(shape.half_angle / links))
    solids = []
    for start, end in pairwise(points):
        axis = (end - start) / np.linalg.norm(end - start)
        normal = np.array([0.0, 0.0, 1.0])
        pose = np.eye(4)
        pose[:3] = np.column_stack([normal, np.cross(axis, normal), axis, (start + end) / 2])
        half_length = float(np.linalg.norm(end - start)) / 2
        solids.append((capsule(shape.diameter / 2 + sagitta, half_length), pose))
    return solids


# Surfaces.


def _radial_mesh(solid: Solid) -> Mesh:
    """Return the surface of a solid around the origin, by rays to the vertices of a ball."""
    directions, triangles = capsule_mesh(1.0, 0.0, 48)
    return ray_points(solid, directions), triangles


def ray_points(solid: Solid, directions: Array) -> Array:
    """Return the points (k, 3) where rays (k, 3) from the origin leave a solid."""
    low, high = np.zeros(len(directions)), np.full(len(directions), 1.01 * solid.reach)
    for _ in range(50):
        middle = (low + high) / 2
        is_inside = solid.distance(middle[:, None] * directions) < 0
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    return high[:, None] * directions


def _ball_mesh(points: Array, radius: float, max_balls: int = 10_000) -> Mesh:
    """Return octahedra for at most `max_balls` balls of a cloud."""
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    centers = points[:: 1 + len(points) // max_balls]
    upper = np.array([(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2)], dtype=np.int64)
    faces = np.concatenate([upper, upper[:, [1, 0, 2]] + np.array([0, 0, 3])])
    first = 6 * np.arange(len(centers))[:, None, None]
    return (centers[:, None] + corners).reshape(-1, 3), (first + faces).reshape(-1, 3)
