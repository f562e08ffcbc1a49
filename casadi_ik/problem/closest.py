"""Where the two shapes of a pair are nearest to each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import nearest
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Solid
from casadi_ik.collision.table import Table
from casadi_ik.robots.collision import LinkCapsule


@dataclass(frozen=True, eq=False)
class Tube:
    """A capsule of a link where it is.

    Attributes:
        segment: (6,) middle and half of its segment in the base frame [m].
        radius: [m].
    """

    segment: Array
    radius: float


@dataclass(frozen=True, eq=False)
class Closest:
    """What is nearest.

    Attributes:
        ends: (2, 3) the nearest points of the first and of the second shape, base frame [m]; where
            the shapes overlap, as far beyond each other as they do.
        distance: Between them [m], negative where shapes overlap.
        first: The first shape.
        second: The second: of the robot, or a solid of the scene and its (4, 4) pose.
    """

    ends: Array
    distance: float
    first: Tube
    second: Tube | tuple[Solid, Array]


def closest_points(robot: ArmHand, q: Array, scene: Scene, pair: tuple[str, str]) -> Closest | None:
    """The nearest points of a pair.

    Args:
        robot: With shapes.
        q: (n,) actuator positions [rad or m].
        scene: With what is grasped.
        pair: Two links, or a link and an item of the scene.

    Returns:
        None if one of them has no shape.
    """
    links = robot.links(q)
    mine, theirs = _capsules(robot, pair[0]), _capsules(robot, pair[1])
    solids = [one for one in scene_solids(scene) if one[0] == pair[1]]
    capsules = [*mine, *theirs]
    others = range(len(mine), len(capsules) + (0 if theirs else len(solids)))
    pairs = np.array([(i, j) for i in range(len(mine)) for j in others], dtype=np.int32)
    if not len(pairs):
        return None
    where = np.concatenate([_segment(one, links[one.link]) for one in capsules])
    table = Table(
        np.array([one.radius for one in capsules]),
        np.array([float(np.linalg.norm(one.half)) for one in capsules]),
        pairs,
        np.zeros(len(pairs)),
        0,
        tuple(solid for _, solid, _ in solids),
        (),
        (),
        (pair,) * len(pairs),
    )
    poses = [np.append(pose[:3, :3].ravel(), pose[:3, 3]) for _, _, pose in solids]
    found = nearest(where[None], np.array(poses).reshape(-1, 12), table)
    which = int(found.distance[0].argmin())
    i, j = pairs[which].tolist()
    one, way = where[6 * i : 6 * i + 6], found.way[0, which]
    distance = float(found.distance[0, which])
    start = one[:3] + found.first[0, which] * one[3:] - table.radii[i] * way
    end = start - distance * way
    if j < len(capsules):
        second = Tube(where[6 * j : 6 * j + 6], float(table.radii[j]))
    else:
        _, solid, pose = solids[j - len(capsules)]
        second = solid, pose
    return Closest(np.stack([start, end]), distance, Tube(one, float(table.radii[i])), second)


def scene_solids(scene: Scene) -> Iterator[tuple[str, Solid, Array]]:
    """Every solid of a scene: the name of its item, itself, and its (4, 4) pose."""
    for name, item in scene.items.items():
        for solid, place in item.parts:
            yield name, solid, item.pose @ place


def _capsules(robot: ArmHand, link: str) -> list[LinkCapsule]:
    return [one for one in robot.description.shapes.capsules if one.link == link]


def _segment(one: LinkCapsule, pose: Array) -> Array:
    """(6,) its middle and half in the base frame."""
    return np.append(pose[:3, :3] @ one.center + pose[:3, 3], pose[:3, :3] @ one.half)
