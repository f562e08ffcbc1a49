"""What there is to see of a robot, link by link.

The shapes that collisions are checked with, the meshes of its files, or, where nothing is
described, tubes from joint to joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casadi_ik import palette
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.importing.surfaces import Surface, box_shape, round_shape, together
from casadi_ik.robots.collision import LinkSolid
from casadi_ik.robots.description import RobotDescription
from casadi_ik.viewing.bodies import coarser, sharp, tube

ARM_RADIUS, FINGER_RADIUS = 0.045, 0.009
"""Of the tubes of links without shapes [m]."""

SHORTEST = 2e-3
"""Links shorter than this have no tube [m]."""


@dataclass(frozen=True, eq=False)
class LinkPart:
    """A link as it is seen.

    Attributes:
        link: Its name.
        surface: In the link's frame.
        color: Its colour.
    """

    link: str
    surface: Surface
    color: str


def robot_parts(
    robot: ArmHand, meshes: Mapping[str, Surface] | None = None
) -> tuple[LinkPart, ...]:
    """Everything of a robot that is drawn.

    Args:
        robot: The robot.
        meshes: By link what its files show; a link that has none is drawn by its shape.
    """
    description = robot.description
    sides, found = _sides(description), _shapes(description)
    described = {sides[link] for link in found}
    for link, surface in _tubes(robot, sides).items():
        if sides[link] not in described:
            found[link] = surface
    found |= {
        link: sharp(coarser(one)) for link, one in (meshes or {}).items() if len(one.triangles)
    }
    return tuple(
        LinkPart(link, found[link], _color(description, link, sides[link]))
        for link in description.links
        if link in found
    )


def _sides(description: RobotDescription) -> dict[str, str]:
    """By link "arm" or "hand"."""
    first = "arm" if description.arm_actuators else "hand"
    return {description.root: first} | {
        joint.child: "hand" if joint.part == "hand" else "arm" for joint in description.joints
    }


def _color(description: RobotDescription, link: str, side: str) -> str:
    if side == "arm":
        return palette.ARM if description.links.index(link) % 2 else palette.ARM_JOINT
    return palette.PALM if link == description.palm_link else palette.HAND


def _shapes(description: RobotDescription) -> dict[str, Surface]:
    by_link: dict[str, list[Surface]] = {}
    for one in description.shapes.capsules:
        if one.covers < 0:
            body = tube(one.center - one.half, one.center + one.half, one.radius)
            by_link.setdefault(one.link, []).append(body)
    for solid in description.shapes.solids:
        by_link.setdefault(solid.link, []).append(_solid(solid))
    found = {link: together(parts) for link, parts in by_link.items()}
    return {link: surface for link, surface in found.items() if surface is not None}


def _solid(solid: LinkSolid) -> Surface:
    if solid.kind == "box":
        return sharp(box_shape(solid.size / 2)).moved(solid.pose)
    return sharp(round_shape(solid.size[0], solid.size[1] / 2, "Cylinder")).moved(solid.pose)


def _tubes(robot: ArmHand, sides: Mapping[str, str]) -> dict[str, Surface]:
    """A tube from each link's origin to those of the links it carries, and to its pad."""
    links = robot.links(robot.home)
    by_link: dict[str, list[Surface]] = {}

    def reach(link: str, end: Array, radius: float) -> None:
        if np.linalg.norm(end) > SHORTEST:
            by_link.setdefault(link, []).append(tube(np.zeros(3), end, radius))

    for joint in robot.description.joints:
        parent = links[joint.parent]
        end = parent[:3, :3].T @ (links[joint.child][:3, 3] - parent[:3, 3])
        thick = ARM_RADIUS if sides[joint.child] == "arm" else FINGER_RADIUS
        reach(joint.parent, end, thick)
    for finger in robot.description.fingers:
        pad = finger.placement[:3, 3] - FINGER_RADIUS * finger.placement[:3, :3] @ finger.normal
        reach(finger.link, pad, FINGER_RADIUS)
    found = {link: together(parts) for link, parts in by_link.items()}
    return {link: surface for link, surface in found.items() if surface is not None}
