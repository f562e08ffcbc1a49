"""Write a robot description as URDF, for viewers and for checking by other libraries."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.model.description import RobotDescription

LINK_RADIUS = {"arm": 0.055, "mount": 0.03, "hand": 0.009}
"""Radius of the drawn cylinders [m] by part; for looks only."""

COLOURS = {"arm": "0.93 0.55 0.20 1", "mount": "0.35 0.35 0.38 1", "hand": "0.35 0.35 0.38 1"}


def to_urdf(robot: RobotDescription) -> str:
    """The robot as URDF text.

    Every link gets simple cylinders from its frame to its children to be seen, its shapes for
    collisions (a capsule as a cylinder and two spheres), and every finger a fixed
    link ``<finger>_contact`` whose frame is the contact frame. A joint that follows an actuator
    or joint linearly becomes a mimic joint; other couplings have no URDF form:
    their joints stay independent (set them from `ArmHand.joints`), with the coupling as a comment.

    Args:
        robot: The description.

    Returns:
        URDF XML, joint limits in rad and m. Unknown velocity limits are written as 10, unknown
        efforts as 0, since URDF demands a number.
    """
    root = ElementTree.Element("robot", name=robot.name)
    mimics = _leaders(robot)
    part = {robot.root: "arm"} | {joint.child: joint.part for joint in robot.joints}
    for link in robot.links:
        element = ElementTree.SubElement(root, "link", name=link)
        _draw(element, link, robot, part)
        _solid(element, link, robot)
    motors = zip(robot.actuator_names, robot.continuous, strict=True)
    continuous = {name for name, unlimited in motors if unlimited}
    for joint in robot.joints:
        kind = "continuous" if joint.name in continuous else joint.type
        element = ElementTree.SubElement(root, "joint", name=joint.name, type=kind)
        _origin(element, joint.placement)
        ElementTree.SubElement(element, "parent", link=joint.parent)
        ElementTree.SubElement(element, "child", link=joint.child)
        if joint.type == "fixed":
            continue
        ElementTree.SubElement(element, "axis", xyz=_numbers(joint.axis))
        if joint.coupling is not None and joint.coupling.slope is None:
            element.append(ElementTree.Comment(f" {joint.coupling} "))
        velocity = joint.velocity if math.isfinite(joint.velocity) else 10.0
        ends = {} if kind == "continuous" else {"lower": joint.lower, "upper": joint.upper}
        ElementTree.SubElement(
            element,
            "limit",
            {name: repr(end) for name, end in ends.items()},
            effort=repr(joint.effort if math.isfinite(joint.effort) else 0.0),
            velocity=repr(velocity),
        )
        if joint.name in mimics:
            leader, ratio, offset = mimics[joint.name]
            ElementTree.SubElement(
                element, "mimic", joint=leader, multiplier=repr(ratio), offset=repr(offset)
            )
    for finger in robot.fingers:
        name = f"{finger.name}_contact"
        ElementTree.SubElement(root, "link", name=name)
        element = ElementTree.SubElement(root, "joint", name=f"{name}_fixed", type="fixed")
        _origin(element, finger.placement)
        ElementTree.SubElement(element, "parent", link=finger.link)
        ElementTree.SubElement(element, "child", link=name)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _leaders(robot: RobotDescription) -> dict[str, tuple[str, float, float]]:
    """Which joint a joint mimics in URDF, with ratio and offset.

    URDF has no motors, so the first joint on a shared motor leads the others; and chains of
    followers are multiplied out, so that no leader follows anything itself.
    """
    joints = {joint.name: joint for joint in robot.movable}
    first: dict[str, tuple[str, float, float]] = {}
    mimics: dict[str, tuple[str, float, float]] = {}
    for joint in robot.movable:
        ratio, offset, source = 1.0, 0.0, joint
        while (coupling := source.coupling) is not None and coupling.slope is not None:
            offset += ratio * coupling.slope[1]
            ratio *= coupling.slope[0]
            if coupling.of not in joints:
                leader, first_ratio, first_offset = first.setdefault(
                    coupling.of, (joint.name, ratio, offset)
                )
                ratio /= first_ratio
                offset -= ratio * first_offset
                source = joints[leader]
                break
            source = joints[coupling.of]
        if source is not joint:
            mimics[joint.name] = (source.name, ratio, offset)
    return mimics


def _draw(
    element: ElementTree.Element, link: str, robot: RobotDescription, part: dict[str, str]
) -> None:
    ends = [joint.placement[:3, 3] for joint in robot.joints if joint.parent == link]
    ends += [finger.placement[:3, 3] for finger in robot.fingers if finger.link == link]
    for end in ends:
        length = float(np.linalg.norm(end))
        if length < 1e-4:
            continue
        visual = ElementTree.SubElement(element, "visual")
        _origin(visual, _along(end))
        geometry = ElementTree.SubElement(visual, "geometry")
        radius = LINK_RADIUS[part[link]]
        ElementTree.SubElement(geometry, "cylinder", radius=repr(radius), length=repr(length))
        material = ElementTree.SubElement(visual, "material", name=part[link])
        ElementTree.SubElement(material, "color", rgba=COLOURS[part[link]])


def _solid(element: ElementTree.Element, link: str, robot: RobotDescription) -> None:
    """The link's shapes for collisions; a capsule is a cylinder and two spheres."""
    for one in robot.shapes.capsules:
        if one.link != link or one.covers >= 0:
            continue
        length = 2 * float(np.linalg.norm(one.half))
        radius = repr(one.radius)
        ends = [one.center] if length == 0 else [one.center - one.half, one.center + one.half]
        for end in ends:
            pose = np.eye(4)
            pose[:3, 3] = end
            _collision(element, pose, "sphere", radius=radius)
        if length:
            pose = _along(2 * one.half)
            pose[:3, 3] = one.center
            _collision(element, pose, "cylinder", radius=radius, length=repr(length))
    for solid in robot.shapes.solids:
        if solid.link == link and solid.kind == "box":
            _collision(element, solid.pose, "box", size=_numbers(solid.size))
        elif solid.link == link:
            sizes = {"radius": repr(float(solid.size[0])), "length": repr(float(solid.size[1]))}
            _collision(element, solid.pose, "cylinder", **sizes)


def _collision(element: ElementTree.Element, pose: Array, kind: str, **sizes: str) -> None:
    collision = ElementTree.SubElement(element, "collision")
    _origin(collision, pose)
    ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), kind, sizes)


def _along(end: Array) -> Array:
    """Pose half way to `end` with z pointing there."""
    z = end / np.linalg.norm(end)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    pose[:3, 3] = end / 2
    return pose


def _origin(element: ElementTree.Element, pose: Array) -> None:
    rpy = roll_pitch_yaw(pose[:3, :3])
    ElementTree.SubElement(element, "origin", xyz=_numbers(pose[:3, 3]), rpy=_numbers(rpy))


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
