"""What pictures are made of: closed surfaces [m] with point normals."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pyvista as pv

from casadi_ik.arrays import Array

Solid = tuple[pv.PolyData, str]
"""A surface and its colour."""

AROUND = 48
"""Points around an axis."""


def capsule(start: Array, end: Array, radius: float) -> pv.PolyData:
    """A tube with round ends between two points."""
    length = float(np.linalg.norm(end - start))
    if length < 1e-9:
        return pv.Sphere(radius=radius, center=start)
    return pv.Capsule(
        center=(start + end) / 2,
        direction=end - start,
        radius=radius,
        cylinder_length=length,
        resolution=AROUND,
    )


def drum(center: Array, axis: Array, radius: float, length: float) -> pv.PolyData:
    """A cylinder with rounded edges about a point."""
    strips = pv.Superquadric(
        scale=(radius, radius, length / 2),
        size=1.0,
        phi_roundness=0.15,
        theta_resolution=AROUND,
        phi_resolution=AROUND,
    ).triangulate()
    mesh = cast("pv.PolyData", strips)
    mesh.clean(inplace=True)
    # The axis of a superquadric is its y.
    y = axis / np.linalg.norm(axis)
    x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, y, np.cross(x, y), center])
    mesh.transform(pose, inplace=True)
    return mesh


def stretched(convex: pv.PolyData, offsets: Array) -> pv.PolyData:
    """The convex hull of copies of a convex surface, moved by offsets (k, 3)."""
    hull = convex.copy()
    hull.points += offsets[np.argmax(hull.point_data["Normals"] @ offsets.T, axis=1)]
    return hull


def arrow(start: Array, direction: Array, length: float, width: float) -> pv.PolyData:
    """An arrow whose shaft is `width` thick."""
    mesh = pv.Arrow(
        start=start,
        direction=direction,
        tip_length=min(0.45, 3.2 * width / length),
        tip_radius=1.35 * width / length,
        tip_resolution=AROUND,
        shaft_radius=0.5 * width / length,
        shaft_resolution=AROUND,
        scale=length,
    )
    return with_edges(mesh)


def ring(center: Array, axis: Array, radius: float, width: float) -> pv.PolyData:
    """A thin ring about an axis through its centre."""
    torus: Any = pv.ParametricTorus(ringradius=radius, crosssectionradius=width / 2)
    mesh: pv.PolyData = torus.triangulate()
    z = axis / np.linalg.norm(axis)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, np.cross(z, x), z, center])
    mesh.transform(pose, inplace=True)
    return mesh


def with_edges(mesh: pv.PolyData) -> pv.PolyData:
    """The given surface, now smooth but where its faces meet at a sharp angle."""
    mesh.compute_normals(split_vertices=True, feature_angle=35.0, inplace=True)
    return mesh
