"""Where the two shapes of a pair are nearest to each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import from_solid, pose_row
from casadi_ik.collision.scene import Scene
from casadi_ik.collision.solids import Solid, capsule


@dataclass(frozen=True, eq=False)
class Closest:
    """What is nearest.

    Attributes:
        ends: (2, 3) the nearest points of the first and of the second shape, base frame [m]; where
            the shapes overlap, as far beyond each other as they do.
        distance: Between them [m], negative where shapes overlap.
        shapes: The two, each with its (4, 4) pose in the base frame.
    """

    ends: Array
    distance: float
    shapes: tuple[tuple[Solid, Array], tuple[Solid, Array]]


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
    best: Closest | None = None
    others = link_capsules(robot, q, pair[1]) or [
        (solid, pose) for name, solid, pose in scene_solids(scene) if name == pair[1]
    ]
    for one, pose in link_capsules(robot, q, pair[0]):
        radius, half = one.size[:2]
        segment = np.append(pose[:3, 3], half * pose[:3, 2])
        for solid, place in others:
            found = from_solid(solid, segment[None, None], pose_row(place)[None])
            apart, along = found[0].item() - radius, found[1].item()
            if best is None or apart < best.distance:
                nearest = segment[:3] + along * segment[3:]
                way = _outward(solid, place, nearest)
                start = nearest - radius * way
                ends = np.stack([start, start - apart * way])
                best = Closest(ends, apart, ((one, pose), (solid, place)))
    return best


def _outward(solid: Solid, pose: Array, point: Array) -> Array:
    """(3,) the way in which the distance of a solid at a pose grows, at a point."""
    steps = 1e-6 * np.concatenate([np.eye(3), -np.eye(3)])
    local = (point + steps - pose[:3, 3]) @ pose[:3, :3]
    ahead, behind = solid.distance(local).reshape(2, 3)
    way = ahead - behind
    return way / max(float(np.linalg.norm(way)), 1e-30)


def scene_solids(scene: Scene) -> Iterator[tuple[str, Solid, Array]]:
    """Every solid of a scene: the name of its item, itself, and its (4, 4) pose."""
    for name, item in scene.items.items():
        for solid, place in item.parts:
            yield name, solid, item.pose @ place


def link_capsules(robot: ArmHand, q: Array, link: str) -> list[tuple[Solid, Array]]:
    """The capsules of a link, each along z at its (4, 4) pose in the base frame."""
    found = []
    for one in robot.description.shapes.capsules:
        if one.link == link:
            half = float(np.linalg.norm(one.half))
            place = np.eye(4)
            if half > 0:
                z = one.half / half
                x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
                x /= np.linalg.norm(x)
                place[:3, :3] = np.column_stack([x, np.cross(z, x), z])
            place[:3, 3] = one.center
            found.append((capsule(one.radius, half), robot.links(q)[link] @ place))
    return found
