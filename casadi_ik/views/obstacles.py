"""What stands about a robot, and the two shapes of it that are nearest to touching, in red."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import nearest
from casadi_ik.collision.gaps import surface
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Kind
from casadi_ik.collision.solids import Solid as CollisionSolid
from casadi_ik.collision.table import Table
from casadi_ik.grasps import Grasp
from casadi_ik.robots.collision import LinkCapsule
from casadi_ik.views.captions import NEAREST_COLOR
from casadi_ik.views.shapes import Solid, capsule, with_edges

SCENE_COLOR = "#b9c0c7"

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
        for name, solid, pose in _solids(scene)
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
    links = robot.links(np.asarray(q, dtype=float))
    first, second = pair
    mine = _capsules(robot, first)
    if not mine:
        return [], []
    theirs, solids = _capsules(robot, second), [one for one in _solids(scene) if one[0] == second]
    capsules = [*mine, *theirs]
    where = np.concatenate([_segment(one, links[one.link]) for one in capsules])
    others = range(len(mine), len(capsules) + (0 if theirs else len(solids)))
    pairs = np.array([(i, j) for i in range(len(mine)) for j in others], dtype=np.int32)
    table = Table(
        np.array([one.radius for one in capsules]),
        np.array([float(np.linalg.norm(one.half)) for one in capsules]),
        pairs.reshape(-1, 2),
        np.zeros(len(pairs)),
        0,
        tuple(solid for _, solid, _ in solids),
        (),
        (),
        (pair,) * len(pairs),
    )
    poses = [np.append(pose[:3, :3].ravel(), pose[:3, 3]) for _, _, pose in solids]
    found = nearest(where[None], np.array(poses).reshape(-1, 12), table)
    if not len(pairs):
        return [], []
    which = int(found.distance[0].argmin())
    i, j = pairs[which].tolist()
    one, way = where[6 * i : 6 * i + 6], found.way[0, which]
    start = one[:3] + found.first[0, which] * one[3:] - table.radii[i] * way
    end = start - float(found.distance[0, which]) * way
    shapes = [_tube(one, float(table.radii[i]))]
    if j < len(capsules):
        shapes.append(_tube(where[6 * j : 6 * j + 6], float(table.radii[j])))
    else:
        _, solid, pose = solids[j - len(capsules)]
        if solid.kind is not Kind.HALF_SPACE:
            shapes.append(_mesh(solid, pose, end))
    marks = [capsule(start, end, ROD), *(capsule(p, p, 2 * ROD) for p in (start, end))]
    rod, held = ([(mesh, NEAREST_COLOR) for mesh in some] for some in (marks, shapes))
    return rod, held


def _solids(scene: Scene) -> Iterator[tuple[str, CollisionSolid, Array]]:
    for name, item in scene.items.items():
        for solid, place in item.parts:
            yield name, solid, item.pose @ place


def _capsules(robot: ArmHand, link: str) -> list[LinkCapsule]:
    return [one for one in robot.description.shapes.capsules if one.link == link]


def _segment(one: LinkCapsule, pose: Array) -> Array:
    """(6,) its middle and half in the base frame."""
    return np.append(pose[:3, :3] @ one.center + pose[:3, 3], pose[:3, :3] @ one.half)


def _tube(segment: Array, radius: float) -> pv.PolyData:
    return capsule(segment[:3] - segment[3:], segment[:3] + segment[3:], radius + SKIN)


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
        case Kind.CONVEX:
            hull = pv.PolyData(surface(solid)).delaunay_3d().extract_surface(algorithm=None)
            mesh = with_edges(_triangles(hull))
    mesh.transform(pose, inplace=True)
    return mesh


def _triangles(mesh: pv.PolyData) -> pv.PolyData:
    found = mesh.triangulate()
    assert isinstance(found, pv.PolyData)
    return found
