"""Shapes for collisions in somebody's file: simple ones as a description has them, meshes by link.

Capsules that hold a mesh take seconds to find: they are fitted once, when a robot is imported, and
stand in its description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix, roll_pitch_yaw
from casadi_ik.robots.collision_entries import (
    BoxEntry,
    CapsuleEntry,
    CylinderEntry,
    ShapeEntry,
    SphereEntry,
)
from casadi_ik.robots.robot_files.xml_text import LARGEST, Element


@dataclass(frozen=True, eq=False)
class FileShapes:
    """What a file says of the shapes of its links.

    Attributes:
        entries: By link its shapes, in its frame, if all of them are simple.
        meshes: Links with a mesh, or with what has no form here.
    """

    entries: Mapping[str, Sequence[ShapeEntry]]
    meshes: frozenset[str]


NO_FILE_SHAPES = FileShapes({}, frozenset())


def urdf_shapes(element: Element) -> FileShapes:
    """Those of the elements ``collision`` of a URDF."""
    entries: dict[str, list[ShapeEntry]] = {}
    meshes: set[str] = set()
    for link in element.findall("link"):
        name = link.get("name", "")
        for one in link.findall("collision"):
            shape = _of_element(one)
            if shape is None:
                meshes.add(name)
            else:
                entries.setdefault(name, []).append(shape)
    return _told(entries, meshes)


def mjcf_shapes(mujoco: Any, model: Any, names: Sequence[str]) -> FileShapes:
    """Those of the geoms of an MJCF that can collide; planes are no part of a robot.

    Args:
        mujoco: The module.
        model: Its model.
        names: Of the bodies' links.
    """
    entries: dict[str, list[ShapeEntry]] = {}
    meshes: set[str] = set()
    types = mujoco.mjtGeom
    for geom in range(model.ngeom):
        kind, name = int(model.geom_type[geom]), names[int(model.geom_bodyid[geom])]
        solid = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        if not solid or kind in (types.mjGEOM_PLANE, types.mjGEOM_HFIELD):
            continue
        pose, flat = np.eye(4), np.empty(9)
        mujoco.mju_quat2Mat(flat, model.geom_quat[geom])
        pose[:3, :3], pose[:3, 3] = flat.reshape(3, 3), model.geom_pos[geom]
        x, y, z = (float(value) for value in model.geom_size[geom])
        match kind:
            case types.mjGEOM_BOX:
                shape = entry_of("box", (2 * x, 2 * y, 2 * z), pose)
            case types.mjGEOM_SPHERE:
                shape = entry_of("sphere", (x,), pose)
            case types.mjGEOM_CAPSULE:
                shape = entry_of("capsule", (x, 2 * y), pose)
            case types.mjGEOM_CYLINDER:
                shape = entry_of("cylinder", (x, 2 * y), pose)
            case _:
                meshes.add(name)
                continue
        entries.setdefault(name, []).append(shape)
    return _told(entries, meshes)


def entry_of(kind: str, size: Sequence[float], pose: Array) -> ShapeEntry:
    """A simple shape as a description has it.

    Args:
        kind: "box", "sphere", "capsule" or "cylinder".
        size: Its edges; its radius; its radius and length, a capsule's without its caps [m].
        pose: (4, 4) in the link; capsules and cylinders lie along z.
    """
    x, y, z = (float(value) for value in pose[:3, 3])
    roll, pitch, yaw = (float(value) for value in roll_pitch_yaw(pose[:3, :3]))
    if kind == "box":
        return BoxEntry(size=(size[0], size[1], size[2]), xyz=(x, y, z), rpy=(roll, pitch, yaw))
    if kind == "sphere":
        return SphereEntry(radius=size[0], center=(x, y, z))
    if kind == "cylinder":
        return CylinderEntry(radius=size[0], length=size[1], xyz=(x, y, z), rpy=(roll, pitch, yaw))
    half = pose[:3, 2] * size[1] / 2
    first, last = (tuple((pose[:3, 3] + sign * half).tolist()) for sign in (-1, 1))
    return CapsuleEntry(ends=(first, last), radius=size[0])


def _of_element(collision: Element) -> ShapeEntry | None:
    """A shape of a URDF; None if it is a mesh, or not what URDF knows."""
    shape, pose = simple_shape(collision), pose_of(collision)
    return None if shape is None or pose is None else entry_of(*shape, pose)


def simple_shape(element: Element) -> tuple[str, list[float]] | None:
    """Kind and sizes [m] of an element ``collision`` or ``visual``; None: a mesh, or nonsense."""
    geometry = element.find("geometry")
    if geometry is None or len(geometry) != 1:
        return None
    (shape,) = geometry
    keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
    size = [v for key in keys.get(shape.tag, ()) for v in values_of(shape.get(key, ""))]
    expected = {"box": 3, "sphere": 1, "cylinder": 2}.get(shape.tag, 0)
    sound = expected and len(size) == expected and min(size) > 0
    return (shape.tag, size) if sound else None


def pose_of(element: Element) -> Array | None:
    """(4, 4) of the element's origin; None if that is nonsense."""
    origin = element.find("origin")
    xyz, rpy = (
        values_of("0 0 0" if origin is None else origin.get(key, "0 0 0")) for key in ("xyz", "rpy")
    )
    if [len(xyz), len(rpy)] != [3, 3]:
        return None
    return frame_matrix(Frame((xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2])))


def values_of(text: str) -> list[float]:
    """The numbers of an attribute; none if one is not finite, or larger than any robot's."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return []
    return values if all(abs(one) <= LARGEST for one in values) else []


def _told(entries: dict[str, list[ShapeEntry]], meshes: set[str]) -> FileShapes:
    simple = {link: tuple(found) for link, found in entries.items() if link not in meshes}
    return FileShapes(simple, frozenset(meshes))
