"""Export of a robot description as URDF, for viewers and for checks by other libraries."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.model.description import RobotDescription

LINK_RADIUS = {"arm": 0.055, "mount": 0.03, "hand": 0.009}
"""Radius of the visual cylinders by part [m]; appearance only."""

COLOURS = {"arm": "0.93 0.55 0.20 1", "mount": "0.35 0.35 0.38 1", "hand": "0.35 0.35 0.38 1"}


def to_urdf(robot: RobotDescription) -> str:
    """Return the robot as URDF text.

    Each link has cylinders from its frame to its children as visual geometry, and its collision
    shapes (a capsule is a cylinder and two spheres). Each finger has a fixed link
    ``<finger>_contact`` whose frame is the contact frame. A linear coupling becomes a mimic joint.
    Other couplings have no URDF
    equivalent: their joints stay independent (take their positions from `ArmHand.joints`), with the
    coupling as a comment.

    Args:
        robot: The description.

    Returns:
        URDF XML, joint limits in rad and m. Unknown velocity limits are written as 10, unknown
        efforts as 0, because URDF requires a number.
    """
    root = ElementTree.Element("robot", name=robot.name)
    mimics = _leaders(robot)
    part = {robot.root: "arm"} | {joint.child: joint.part for joint in robot.joints}
    for link in robot.links:
        element = ElementTree.SubElement(root, "link", name=link)
        _add_visuals(element, link, robot, part)
        _add_collisions(element, link, robot)
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
        limits = {} if kind == "continuous" else {"lower": joint.lower, "upper": joint.upper}
        ElementTree.SubElement(
            element,
            "limit",
            {name: repr(value) for name, value in limits.items()},
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
    """Return the joint that each joint mimics in URDF, with ratio and offset.

    URDF has no motors, so the first joint of a shared motor leads the others. Chains of followers
    are multiplied out, so that no leader follows another joint.
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


def _add_visuals(
    element: ElementTree.Element, link: str, robot: RobotDescription, part: dict[str, str]
) -> None:
    """Add cylinders from a link to its child joints and fingertips."""
    endpoints = [joint.placement[:3, 3] for joint in robot.joints if joint.parent == link]
    endpoints += [finger.placement[:3, 3] for finger in robot.fingers if finger.link == link]
    for end in endpoints:
        length = float(np.linalg.norm(end))
        if length < 1e-4:
            continue
        visual = ElementTree.SubElement(element, "visual")
        _origin(visual, _pose_along(end))
        geometry = ElementTree.SubElement(visual, "geometry")
        radius = LINK_RADIUS[part[link]]
        ElementTree.SubElement(geometry, "cylinder", radius=repr(radius), length=repr(length))
        material = ElementTree.SubElement(visual, "material", name=part[link])
        ElementTree.SubElement(material, "color", rgba=COLOURS[part[link]])


def _add_collisions(element: ElementTree.Element, link: str, robot: RobotDescription) -> None:
    """Add the link's collision shapes; a capsule is a cylinder and two spheres."""
    for capsule in robot.shapes.capsules:
        if capsule.link != link or capsule.covers >= 0:
            continue
        length = 2 * float(np.linalg.norm(capsule.half_axis))
        radius = repr(capsule.radius)
        center, half_axis = capsule.center, capsule.half_axis
        for end in [center] if length == 0 else [center - half_axis, center + half_axis]:
            pose = np.eye(4)
            pose[:3, 3] = end
            _collision(element, pose, "sphere", radius=radius)
        if length:
            pose = _pose_along(2 * half_axis)
            pose[:3, 3] = center
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


def _pose_along(end: Array) -> Array:
    """Return the pose at half of a vector with z along it."""
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
