"""Primitive shapes (rods, balls, arrows, rings), their triangle meshes, and mesh operations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
from casadi_ik.model.shapes import capsule_mesh

with optional_import("drawing"):
    from trimesh import Trimesh
    from trimesh.creation import revolve, torus
    from trimesh.graph import smooth_shade

SEGMENTS = 32
"""Number of points around an axis of revolution."""


def pose_with_x_axis(point: Array, direction: Array, reference: Array | None = None) -> Array:
    """Return the (4, 4) pose at a point with a given x axis and the least rotation otherwise.

    Args:
        point: (3,) Origin [m].
        direction: (3,) Direction of the x axis, of any length but zero.
        reference: (3, 3) Rotation that the result stays close to; None: the base frame.
    """
    x = direction / np.linalg.norm(direction)
    axes = (np.eye(3) if reference is None else reference).T
    perpendiculars = [axis - x * (x @ axis) for axis in axes[[1, 2, 0]]]
    y = next(side for side in perpendiculars if np.linalg.norm(side) >= 1e-3)
    y /= np.linalg.norm(y)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, y, np.cross(x, y), point])
    return pose


def pose_with_z_axis(point: Array, direction: Array) -> Array:
    """Return the (4, 4) pose at a point whose z axis is a direction (3,)."""
    return pose_with_x_axis(point, direction)[:, [1, 2, 0, 3]]


@dataclass(frozen=True, eq=False)
class Shape:
    """A parametric shape or a triangle mesh.

    Attributes:
        kind: A key of `SHAPE_MESHES`, or "mesh".
        size: Dimensions [m], the arguments of the function in `SHAPE_MESHES`.
        pose: (4, 4) Pose of the shape's frame, whose z axis is the axis of revolution.
        mesh: Triangles in the shape's frame, for the kind "mesh".
    """

    kind: str
    size: tuple[float, ...] = ()
    pose: Array = field(default_factory=lambda: np.eye(4))
    mesh: IndexedMesh | None = None

    @cached_property
    def surface(self) -> IndexedMesh:
        """Triangles with outward winding."""
        surface = SHAPE_MESHES[self.kind](*self.size) if self.mesh is None else self.mesh
        return surface.transformed(self.pose)

    def transformed(self, pose: Array) -> Shape:
        """Return the shape transformed by a (4, 4) pose."""
        return replace(self, pose=pose @ self.pose)


def mesh_shape(surface: IndexedMesh) -> Shape:
    """Return a mesh as a shape."""
    return Shape("mesh", mesh=surface)


def ball(radius: float, center: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
    """Return a ball."""
    pose = np.eye(4)
    pose[:3, 3] = center
    return Shape("capsule", (radius, 0.0), pose)


def rod(start: Array, end: Array, radius: float) -> Shape:
    """Return a tube with round ends between two points."""
    length = float(np.linalg.norm(end - start))
    if length < 1e-9:
        return ball(radius, start)
    return Shape("capsule", (radius, length), pose_with_z_axis((start + end) / 2, end - start))


def drum(center: Array, axis: Array, radius: float, length: float) -> Shape:
    """Return a cylinder with rounded edges, centred at a point."""
    return Shape("drum", (radius, length), pose_with_z_axis(center, axis))


def arrow(start: Array, direction: Array, length: float, width: float) -> Shape:
    """Return an arrow whose shaft is `width` thick."""
    return Shape("arrow", (length, width), pose_with_z_axis(start, direction))


def ring(center: Array, axis: Array, radius: float, width: float) -> Shape:
    """Return a thin ring about an axis through its centre."""
    return Shape("ring", (radius, width), pose_with_z_axis(center, axis))


def _from_trimesh(mesh: Trimesh) -> IndexedMesh:
    return IndexedMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _revolved(profile: ArrayLike) -> IndexedMesh:
    """Revolve a profile (m, 2) of radius and height, ordered by height [m], about z."""
    rows = np.asarray(profile, dtype=float)
    axis = rows[[0, -1]] * [0.0, 1.0]
    return _from_trimesh(revolve(np.vstack([axis[0], rows, axis[1]]), sections=SEGMENTS))


def _drum(radius: float, length: float) -> IndexedMesh:
    edge = 0.12 * min(radius, length)
    bow = edge * np.sin(np.linspace(0, np.pi / 2, 5))
    rise = np.column_stack([radius - edge + bow, -length / 2 + edge - bow[::-1]])
    return _revolved(np.concatenate([rise, rise[::-1] * [1, -1]]))


def _arrow(length: float, width: float) -> IndexedMesh:
    tip = min(0.45 * length, 3.2 * width)
    shaft, head = width / 2, 1.35 * width
    profile = [(shaft, 0), (shaft, length - tip), (head, length - tip), (1e-3 * head, length)]
    return _revolved(profile)


SHAPE_MESHES: dict[str, Callable[..., IndexedMesh]] = {
    "capsule": lambda radius, length: IndexedMesh(*capsule_mesh(radius, length / 2, SEGMENTS)),
    "drum": _drum,
    "arrow": _arrow,
    "ring": lambda radius, width: _from_trimesh(torus(radius, width / 2, 2 * SEGMENTS, 12)),
}
"""Functions that mesh a parametric shape: capsule (radius, length without the caps),
drum (radius, length), arrow (length, width of the shaft), ring (radius, width).
"""


def join_surfaces(surfaces: Sequence[IndexedMesh]) -> IndexedMesh:
    """Concatenate several surfaces."""
    result = merge_meshes(list(surfaces))
    assert result is not None
    return result


def convex_hull(points: Array) -> IndexedMesh:
    """Return the convex hull of points (n, 3)."""
    return _from_trimesh(Trimesh(points).convex_hull)


def split_sharp_edges(surface: IndexedMesh, degrees: float = 35.0) -> IndexedMesh:
    """Duplicate the points at sharp edges, as smooth shading requires.

    Args:
        surface: The surface.
        degrees: Angle between faces above which their common edge is sharp.
    """
    return _from_trimesh(
        smooth_shade(Trimesh(surface.points, surface.triangles), angle=np.deg2rad(degrees))
    )


def decimate(surface: IndexedMesh, max_triangles: int) -> IndexedMesh:
    """Return a surface with at most about `max_triangles` triangles.

    Edges are collapsed in the order of the quadric error, so flat regions keep their outline.
    Without VTK (extra "plots") the surface is returned unchanged.

    Source: M. Garland, P. Heckbert, Surface simplification using quadric error metrics, 1997.
    """
    count = len(surface.triangles)
    if count <= max_triangles or find_spec("pyvista") is None:
        return surface
    import pyvista

    # Triangles of STL files share no points; edges must be shared to be collapsed.
    mesh = Trimesh(surface.points, surface.triangles, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if len(mesh.faces) <= max_triangles:
        return _from_trimesh(mesh)
    faceted = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    reduced = faceted.decimate(1.0 - max_triangles / len(mesh.faces))
    triangles = np.asarray(reduced.regular_faces, dtype=np.int64)
    return IndexedMesh(np.asarray(reduced.points, dtype=np.float64), triangles)
