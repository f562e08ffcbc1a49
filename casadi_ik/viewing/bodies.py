"""Shapes as triangles whose edges look sharp and whose round sides look round."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.collision.solids import Kind, Solid
from casadi_ik.importing.surfaces import Surface, box_shape, round_shape, together
from casadi_ik.viewing.frames import facing

PLATE = 0.75
"""Half the edge of what is drawn of a half-space, about the robot [m]."""

MOST_SEEN = 3000
"""Triangles of a mesh that are drawn: finer ones would be slow to send and to turn."""

MOST_POINTS = 10_000
"""Of a point cloud that are drawn."""

OCTAHEDRON = np.array(
    [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
)
"""Triangles between the ends of x, y, z, -x, -y, -z."""

SHARP = np.cos(np.deg2rad(35.0))
"""Faces that meet at a larger angle meet at an edge."""


def tube(start: Array, end: Array, radius: float) -> Surface:
    """A capsule between two points."""
    way = end - start
    length = float(np.linalg.norm(way))
    body = round_shape(radius, length / 2, "Capsule")
    if length < 1e-9:
        return body.moved(_at(start))
    return body.moved(_upright((start + end) / 2, way))


def arrow(length: float, width: float) -> Surface:
    """An arrow along x from the origin, whose shaft is `width` thick."""
    tip = min(0.45 * length, 3.2 * width)
    shaft = round_shape(width / 2, (length - tip) / 2, "Cylinder")
    head = round_shape(1.35 * width, tip / 2, "Cylinder")
    # The far lid of a cylinder, drawn together, makes a cone.
    points = head.points.copy()
    points[points[:, 2] > 0, :2] = 0.0
    along = np.array([1.0, 0.0, 0.0])
    parts = [
        shaft.moved(_upright(along * (length - tip) / 2, along)),
        Surface(points, head.triangles).moved(_upright(along * (length - tip / 2), along)),
    ]
    whole = together([sharp(part) for part in parts])
    assert whole is not None
    return whole


def ball(radius: float) -> Surface:
    """A ball about the origin."""
    return round_shape(radius, 0.0, "Sphere")


def body_of(solid: Solid, about: Array) -> Surface:
    """A solid of a scene in its own frame.

    Args:
        solid: The solid.
        about: (3,) of a half-space, what is near this is drawn, in its frame [m].
    """
    x, y, _ = solid.size.tolist()
    match solid.kind:
        case Kind.BOX:
            return sharp(box_shape(solid.size))
        case Kind.CYLINDER:
            return sharp(round_shape(x, y, "Cylinder"))
        case Kind.CAPSULE:
            return round_shape(x, y, "Capsule")
        case Kind.HALF_SPACE:
            plate = box_shape(np.array([PLATE, PLATE, 0.001]))
            return sharp(
                Surface(plate.points + np.array([about[0], about[1], -0.001]), plate.triangles)
            )
        case Kind.CLOUD:
            points = solid.points[:: 1 + len(solid.points) // MOST_POINTS]
            corners = (points[:, None] + x * np.concatenate([np.eye(3), -np.eye(3)])).reshape(-1, 3)
            first = 6 * np.arange(len(points))[:, None, None]
            return Surface(corners, (first + OCTAHEDRON).reshape(-1, 3))
        case Kind.CONVEX:
            ways = round_shape(1.0, 0.0, "Sphere")
            slopes = ways.points @ solid.planes[:, :3].T
            far = np.where(slopes > 1e-9, solid.planes[:, 3] / np.maximum(slopes, 1e-9), np.inf)
            return sharp(Surface(ways.points * far.min(axis=1)[:, None], ways.triangles))


def sharp(body: Surface) -> Surface:
    """The same with points doubled where faces meet at an edge, as smooth shading needs it."""
    corners = body.points[body.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    kept = areas > 1e-12
    corners, normals = corners[kept], normals[kept] / areas[kept, None]
    _, same = np.unique(np.round(corners.reshape(-1, 3), 7), axis=0, return_inverse=True)
    owners: dict[tuple[int, int], int] = {}
    groups: dict[int, list[Array]] = {}
    points: list[Array] = []
    triangles = np.empty((len(corners), 3), dtype=np.int64)
    for i, (corner, place) in enumerate(
        zip(corners.reshape(-1, 3), same.reshape(-1).tolist(), strict=True)
    ):
        normal = normals[i // 3]
        known = groups.setdefault(place, [])
        group = next((k for k, other in enumerate(known) if other @ normal > SHARP), len(known))
        if group == len(known):
            known.append(normal)
            owners[place, group] = len(points)
            points.append(corner)
        triangles[i // 3, i % 3] = owners[place, group]
    return Surface(np.array(points), triangles)


def _at(point: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = point
    return pose


def _upright(middle: Array, axis: Array) -> Array:
    """A pose whose z axis is an axis."""
    turned = facing(middle, axis)
    return turned @ np.array([[0, 0, 1.0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def coarser(body: Surface, most: int = MOST_SEEN) -> Surface:
    """A surface with no more than about so many triangles: points of a cell become one."""
    size = float(np.ptp(body.points, axis=0).max()) / 256 if len(body.points) else 0.0
    while len(body.triangles) > most:
        cells = np.round(body.points / size).astype(np.int64)
        _, first, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        triangles = of.reshape(-1)[body.triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (a != c)]
        body = Surface(body.points[first], np.unique(triangles, axis=0))
        size *= 1.4
    return body
