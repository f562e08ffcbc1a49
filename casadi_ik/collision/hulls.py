"""Convex hulls of meshes, by coal, which comes with pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.solids import Solid, convex, of_object
from casadi_ik.errors import DescriptionError, MissingExtraError
from casadi_ik.grasps.objects import load_object
from casadi_ik.grasps.shapes import MeshShape

THIN = 1e-9
"""A hull of less volume [m^3] than this is none."""


def hull(points: Array, where: str) -> Solid:
    """The convex hull of points (k, 3) [m].

    Args:
        points: The points.
        where: File and key, for the message.

    Raises:
        DescriptionError: The points are too few, not finite, or in a plane.
        MissingExtraError: coal is not installed.
    """
    if points.ndim != 2 or len(points) < 4:
        raise DescriptionError(f"{where}: found {len(points)} points, expected at least 4")
    if not np.isfinite(points).all():
        raise DescriptionError(f"{where}: holds NaN or infinity, expected finite numbers")
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-9) < 3:
        raise DescriptionError(f"{where}: all points are in a plane, expected a body")
    coal = _coal(where)
    model: Any = coal.BVHModelOBBRSS()
    model.beginModel(0, len(points))
    model.addVertices(points)
    model.endModel()
    model.buildConvexHull(True, "Qt")
    shape = model.convex
    corners = np.array([shape.point(i) for i in range(shape.num_points)])
    faces = [shape.polygons(i) for i in range(shape.num_polygons)]
    triangles = np.array([[face[0], face[1], face[2]] for face in faces])
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    kept = areas > 1e-12
    normals, middles = normals[kept], ((a + b + c) / 3)[kept]
    # Whichever way a triangle winds, outward is away from the hull's middle.
    outward = np.sum(normals * (middles - corners.mean(axis=0)), axis=1)
    normals *= np.where(outward < 0, -1.0, 1.0)[:, None]
    if float(np.abs(outward).sum()) < THIN:
        raise DescriptionError(f"{where}: encloses no volume, expected a body")
    return convex(points, normals)


def hulls(shape: MeshShape, where: str) -> list[tuple[Solid, Array]]:
    """The convex hulls of the pieces of a mesh, each with its (4, 4) pose in the mesh's frame.

    Raises:
        DescriptionError: A piece is flat.
        MissingExtraError: coal is not installed.
    """
    found: list[tuple[Solid, Array]] = []
    for number, (points, _) in enumerate(shape.pieces):
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
        MissingExtraError: It is a mesh, and coal is not installed.
    """
    shape = load_object(name).shape
    return hulls(shape, name) if isinstance(shape, MeshShape) else of_object(shape)


def _coal(where: str) -> Any:
    try:
        import coal
    except ImportError as error:
        raise MissingExtraError(f"{where}: convex hulls need coal: pip install pin") from error
    return coal
