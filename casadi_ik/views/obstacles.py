"""What stands about a robot, and the two shapes of it that are nearest to touching, in red."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import surface_points as surface
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Kind
from casadi_ik.collision.solids import Solid as CollisionSolid
from casadi_ik.grasps import Grasp
from casadi_ik.problem.clearance import closest_points
from casadi_ik.problem.clearance import scene_solids as solids_of
from casadi_ik.views.captions import NEAREST_COLOR
from casadi_ik.views.shapes import Solid, capsule, with_edges

SCENE_COLOR = palette.SCENE

PLATE = 0.6
"""Half the edge of what is drawn of a half-space, about the robot [m]."""

ROD = 0.003
"""Radius of the rod between the nearest points, and half that of the balls at them [m]."""

SKIN = 0.001
"""By which shapes in red stand out beyond themselves, to be seen [m]."""


def in_scene(scene: Scene, grasp: Grasp | None) -> Scene:
    """The scene with what a grasp names as its object where it has it."""
    if grasp is not None and grasp.object and grasp.object_pose is not None:
        return scene.holding(grasp.object, grasp.object_pose)
    return scene


def scene_solids(scene: Scene, about: Array, without: str) -> list[Solid]:
    """Everything of a scene but one item, which is drawn already.

    Args:
        scene: The scene.
        about: (3,) where the robot stands: of half-spaces what is near is drawn [m].
        without: Name of the item that is left out.
    """
    return [
        (_mesh(solid, pose, about), SCENE_COLOR)
        for name, solid, pose in solids_of(scene)
        if name != without
    ]


def nearest_pair(
    robot: ArmHand, q: ArrayLike, scene: Scene, pair: tuple[str, str]
) -> tuple[list[Solid], list[Solid]]:
    """A rod between the nearest points of a pair, and the two shapes that they are on.

    Args:
        robot: With shapes.
        q: (n,) actuator positions [rad or m].
        scene: With what is grasped.
        pair: Two links, or a link and an item of the scene.
    """
    found = closest_points(robot, np.asarray(q, dtype=float), scene, pair)
    if found is None:
        return [], []
    start, end = found.ends
    shapes = [
        _mesh(solid, pose, end) for solid, pose in found.shapes if solid.kind is not Kind.HALF_SPACE
    ]
    marks = [capsule(start, end, ROD), *(capsule(p, p, 2 * ROD) for p in (start, end))]
    rod, held = ([(mesh, NEAREST_COLOR) for mesh in some] for some in (marks, shapes))
    return rod, held


def _mesh(solid: CollisionSolid, pose: Array, about: Array) -> pv.PolyData:
    """A solid as a surface in the base frame."""
    x, y, z = solid.size.tolist()
    match solid.kind:
        case Kind.BOX:
            mesh = with_edges(pv.Cube(x_length=2 * x, y_length=2 * y, z_length=2 * z))
        case Kind.CYLINDER:
            tube = pv.Cylinder(direction=(0, 0, 1), radius=x, height=2 * y, resolution=64)
            mesh = with_edges(_triangles(tube))
        case Kind.CAPSULE:
            mesh = capsule(np.array([0, 0, -y]), np.array([0, 0, y]), x)
        case Kind.HALF_SPACE:
            local = pose[:3, :3].T @ (about - pose[:3, 3])
            center = (local[0], local[1], -SKIN)
            mesh = pv.Cube(center, 2 * PLATE, 2 * PLATE, 2 * SKIN)
        case Kind.CLOUD:
            ball = pv.Sphere(radius=x, theta_resolution=8, phi_resolution=6)
            balls = pv.PolyData(solid.points).glyph(scale=False, orient=False, geom=ball)
            assert isinstance(balls, pv.PolyData)
            mesh = _triangles(balls)
        case Kind.CONVEX:
            hull = pv.PolyData(surface(solid)).delaunay_3d().extract_surface(algorithm=None)
            mesh = with_edges(_triangles(hull))
    mesh.transform(pose, inplace=True)
    return mesh


def _triangles(mesh: pv.PolyData) -> pv.PolyData:
    found = mesh.triangulate()
    assert isinstance(found, pv.PolyData)
    return found
