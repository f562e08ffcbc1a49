"""What a file says of a robot: links, joints and simple shapes, before anything is chosen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.files.reading import Frame, frame_matrix, read_text, roll_pitch_yaw
from casadi_ik.model.couplings import Coupling
from casadi_ik.model.linkage import chain_to, links_of, require_name
from casadi_ik.model.schema import BoxEntry, CapsuleEntry, CylinderEntry, ShapeEntry, SphereEntry

Element = ElementTree.Element


class _ForbiddenError(ValueError):
    pass


def read_robot_file(path: Path) -> str:
    """The text of a file.

    Raises:
        DescriptionError: It cannot be read, or is larger than any robot.
    """
    return read_text(path, scaled_limit(LIMITS.robot_bytes), RAISE_HINT, "utf-8-sig")


def parse_xml(text: str, path: Path) -> Element:
    """Parse XML that declares no entities: a few lines of them can grow without end.

    Args:
        text: The text.
        path: The file it is from.

    Raises:
        DescriptionError: Not XML, a document type, or nested without end.
    """
    try:
        _look_through(text)
        return ElementTree.fromstring(text)
    except _ForbiddenError as error:
        raise DescriptionError(f"{path}: {error}") from error
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise DescriptionError(f"{path}: not valid XML: {error}") from error


def _look_through(text: str) -> None:
    """One event at a time, before anything is built."""
    parser = expat.ParserCreate("utf-8")  # what the text is, whatever it says of itself
    depth = 0

    def start(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > LIMITS.xml_depth:
            raise _ForbiddenError(f"elements nested more than {LIMITS.xml_depth} deep")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: object) -> None:
        raise _ForbiddenError("has a document type (<!DOCTYPE ...>), expected plain elements")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text.encode("utf-8"), True)


def required_attribute(element: Element | None, name: str, where: str) -> str:
    """An attribute of an element.

    Raises:
        DescriptionError: There is none.
    """
    value = None if element is None else element.get(name)
    if not value:
        raise DescriptionError(f"{where}: {name}: missing")
    return value


def check_size(links: int, moving: int, path: Path) -> None:
    """Refuse what is larger than any robot, before anything is looked for in it.

    Raises:
        DescriptionError: It has too many links or joints that move.
    """
    counts = ("links", links, LIMITS.links), ("moving joints", moving, LIMITS.moving_joints)
    for noun, count, most in counts:
        if count > scaled_limit(most):
            raise DescriptionError(
                f"{path}: found {count} {noun}, expected at most {scaled_limit(most)} {RAISE_HINT}"
            )


def finite_number(
    element: Element | None, name: str, where: str, most: float = LIMITS.robot_number
) -> float | None:
    """A number of an element; None if it is not there.

    Raises:
        DescriptionError: Something that is no number, or a larger one than `most`.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and abs(value) <= most):
        raise DescriptionError(
            f"{where}: {name}: found {text!r}, expected a finite number{_to(most)}"
        )
    return value


def _to(most: float) -> str:
    return f" up to {most:g}" if math.isfinite(most) else ""


def check_vector(element: Element | None, name: str, where: str) -> None:
    """Refuse an attribute that is not three finite numbers, if it is there.

    Raises:
        DescriptionError: It is not.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    most = LIMITS.robot_number
    if len(values) != 3 or not all(abs(one) <= most for one in values):
        raise DescriptionError(
            f"{where}: {name}: found {text!r}, expected three finite numbers{_to(most)}"
        )


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
        if not collides(model, geom) or kind in (types.mjGEOM_PLANE, types.mjGEOM_HFIELD):
            continue
        shape = simple_geom(mujoco, model, geom)
        if shape is None:
            meshes.add(name)
        else:
            pose = mjcf_pose(mujoco, model.geom_pos[geom], model.geom_quat[geom])
            entries.setdefault(name, []).append(shape_entry(*shape, pose))
    return _told(entries, meshes)


def collides(model: Any, geom: int) -> bool:
    """Whether a geom of an MJCF is there to be collided with, not only to be seen."""
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def simple_geom(mujoco: Any, model: Any, geom: int) -> tuple[str, list[float]] | None:
    """Kind and sizes [m] of a geom of an MJCF, for `shape_entry`; None for a mesh or the like."""
    types, (x, y, z) = mujoco.mjtGeom, model.geom_size[geom].tolist()
    return {
        int(types.mjGEOM_BOX): ("box", [2 * x, 2 * y, 2 * z]),
        int(types.mjGEOM_SPHERE): ("sphere", [x]),
        int(types.mjGEOM_CAPSULE): ("capsule", [x, 2 * y]),
        int(types.mjGEOM_CYLINDER): ("cylinder", [x, 2 * y]),
    }.get(int(model.geom_type[geom]))


def mjcf_pose(mujoco: Any, position: Array, quaternion: Array) -> Array:
    """(4, 4) of a position (3,) [m] and a quaternion (4,), scalar first."""
    pose, flat = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quaternion, dtype=float))
    pose[:3, :3], pose[:3, 3] = flat.reshape(3, 3), position
    return pose


def shape_entry(kind: str, size: Sequence[float], pose: Array) -> ShapeEntry:
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
    shape, pose = simple_shape(collision), origin_pose(collision)
    return None if shape is None or pose is None else shape_entry(*shape, pose)


def simple_shape(element: Element) -> tuple[str, list[float]] | None:
    """Kind and sizes [m] of an element ``collision`` or ``visual``; None: a mesh, or nonsense."""
    geometry = element.find("geometry")
    if geometry is None or len(geometry) != 1:
        return None
    (shape,) = geometry
    keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
    size = [v for key in keys.get(shape.tag, ()) for v in parse_numbers(shape.get(key, ""))]
    expected = {"box": 3, "sphere": 1, "cylinder": 2}.get(shape.tag, 0)
    sound = expected and len(size) == expected and min(size) > 0
    return (shape.tag, size) if sound else None


def origin_pose(element: Element) -> Array | None:
    """(4, 4) of the element's origin; None if that is nonsense."""
    origin = element.find("origin")
    xyz, rpy = (
        parse_numbers("0 0 0" if origin is None else origin.get(key, "0 0 0"))
        for key in ("xyz", "rpy")
    )
    if [len(xyz), len(rpy)] != [3, 3]:
        return None
    return frame_matrix(Frame((xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2])))


def parse_numbers(text: str) -> list[float]:
    """The numbers of an attribute; none if one is not finite, or larger than any robot's."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return []
    return values if all(abs(one) <= LIMITS.robot_number for one in values) else []


def _told(entries: dict[str, list[ShapeEntry]], meshes: set[str]) -> FileShapes:
    simple = {link: tuple(found) for link, found in entries.items() if link not in meshes}
    return FileShapes(simple, frozenset(meshes))


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """A joint as its file has it.

    Attributes:
        name: Its name.
        parent: Link it hangs on.
        child: Link it carries.
        type: "revolute", "continuous", "prismatic" or "fixed"; or a kind of several axes.
        placement: (4, 4) pose of the child in the parent at zero.
        axis: (3,) unit axis in the child's frame.
        limits: Lower and upper [rad or m]; None if the file states none.
        velocity: Velocity limit [rad/s or m/s], inf if the file states none (or zero).
        coupling: What it follows; None if nothing.
        effort: Largest torque or force [N m or N], inf if the file states none (or zero).
    """

    name: str
    parent: str
    child: str
    type: str
    placement: Array
    axis: Array
    limits: tuple[float, float] | None
    velocity: float
    coupling: Coupling | None
    effort: float = math.inf


@dataclass(frozen=True, eq=False)
class RobotTree:
    """The joints of a file.

    Attributes:
        path: The file.
        root: Its base link.
        joints: All joints, parents before children.
        motors: Lower and upper end of motors that are no joints (a tendon's), by name.
        shapes: Those of its links for collisions.
        element: Of a URDF what it was read from, its macros expanded.
        model: Of an MJCF the module and its model.
        notes: What of the file was ignored or left out, a sentence each.
    """

    path: Path
    root: str
    joints: tuple[TreeJoint, ...]
    motors: dict[str, tuple[float, float]] = field(default_factory=dict)
    shapes: FileShapes = NO_FILE_SHAPES
    element: Element | None = None
    model: tuple[Any, Any] | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return links_of(self)

    @cached_property
    def by_name(self) -> dict[str, TreeJoint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    def chain(self, root: str, link: str, where: str) -> tuple[TreeJoint, ...]:
        """The joints from one link down to another.

        Args:
            root: The upper link.
            link: The lower link.
            where: File and key, for the message.

        Raises:
            DescriptionError: The one is not below the other.
        """
        chain = chain_to(self, link, root)
        if (chain[0].parent if chain else link) != root:
            raise DescriptionError(f"{where}: link {link!r} does not hang on link {root!r}")
        return tuple(chain)

    def known_link(self, link: str, where: str) -> str:
        """The link, if there is one of that name.

        Raises:
            DescriptionError: There is none; the message lists the links.
        """
        return require_name(link, self.links, "link", where)

    def known_joint(self, joint: str, where: str) -> str:
        """The joint, if there is one of that name.

        Raises:
            DescriptionError: There is none; the message lists those that move.
        """
        moving = [one.name for one in self.joints if one.type != "fixed"]
        if joint in self.by_name:
            return joint
        return require_name(joint, moving, "joint", where)


def fixed_tree_joint(name: str, parent: str, child: str, placement: Array) -> TreeJoint:
    """A joint that does not move."""
    axis = np.array([0.0, 0.0, 1.0])
    return TreeJoint(name, parent, child, "fixed", placement, axis, None, math.inf, None)
