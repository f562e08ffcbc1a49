"""Robot files as trees of links, joints and simple shapes, and checked access to XML."""

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
from casadi_ik.model.joints import chain_to, links_of, require_name
from casadi_ik.model.schema import (
    LinkBoxEntry,
    LinkCapsuleEntry,
    LinkCylinderEntry,
    LinkSphereEntry,
    ShapeEntry,
)

Element = ElementTree.Element


class _ForbiddenError(ValueError):
    pass


def read_robot_file(path: Path) -> str:
    """Return the text of a robot file.

    Raises:
        DescriptionError: The file cannot be read, or is too large.
    """
    return read_text(path, scaled_limit(LIMITS.robot_bytes), RAISE_HINT, "utf-8-sig")


def parse_xml(text: str, path: Path) -> Element:
    """Parse XML that declares no entities, which could expand exponentially.

    Args:
        text: The text.
        path: File of the text.

    Raises:
        DescriptionError: The text is not XML, has a document type, or is nested too deeply.
    """
    try:
        _check_structure(text)
        return ElementTree.fromstring(text)
    except _ForbiddenError as error:
        raise DescriptionError(f"{path}: {error}") from error
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise DescriptionError(f"{path}: not valid XML: {error}") from error


def _check_structure(text: str) -> None:
    """Check the events of a text before elements are built."""
    parser = expat.ParserCreate("utf-8")  # overrides an encoding that the text declares
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
        raise _ForbiddenError("has a document type (<!DOCTYPE ...>); expected plain elements")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse
    parser.Parse(text.encode("utf-8"), True)


def required_attribute(element: Element | None, name: str, location: str) -> str:
    """Return an attribute of an element.

    Raises:
        DescriptionError: The attribute is missing.
    """
    value = None if element is None else element.get(name)
    if not value:
        raise DescriptionError(f"{location}: {name}: missing")
    return value


def check_size(links: int, moving: int, path: Path) -> None:
    """Refuse a robot with too many links or joints.

    Raises:
        DescriptionError: A limit is exceeded.
    """
    counts = ("links", links, LIMITS.links), ("moving joints", moving, LIMITS.moving_joints)
    for noun, count, max_count in counts:
        if count > scaled_limit(max_count):
            raise DescriptionError(
                f"{path}: found {count} {noun}, expected at most {scaled_limit(max_count)} "
                f"{RAISE_HINT}"
            )


def finite_number(
    element: Element | None, name: str, location: str, max_value: float = LIMITS.robot_number
) -> float | None:
    """Return a number of an element; None if it is missing.

    Args:
        element: The element; None if it is missing.
        name: Name of the attribute.
        location: File and key, for the message.
        max_value: Largest absolute value.

    Raises:
        DescriptionError: The attribute is not a number, or too large.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and abs(value) <= max_value):
        raise DescriptionError(
            f"{location}: {name}: found {text!r}, expected a finite number{_range_text(max_value)}"
        )
    return value


def _range_text(max_value: float) -> str:
    return f" up to {max_value:g}" if math.isfinite(max_value) else ""


def check_vector(element: Element | None, name: str, location: str) -> None:
    """Refuse an attribute that is not three finite numbers; it may be missing.

    Raises:
        DescriptionError: The attribute is not three finite numbers.
    """
    text = None if element is None else element.get(name)
    if text is None:
        return
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    max_value = LIMITS.robot_number
    if len(values) != 3 or not all(abs(value) <= max_value for value in values):
        raise DescriptionError(
            f"{location}: {name}: found {text!r}, expected three finite numbers"
            f"{_range_text(max_value)}"
        )


@dataclass(frozen=True, eq=False)
class FileShapes:
    """The collision shapes in a robot file.

    Attributes:
        entries: Shapes by link, in its frame, of links that have only simple shapes.
        meshes: Links with a mesh or an unsupported shape.
    """

    entries: Mapping[str, Sequence[ShapeEntry]]
    meshes: frozenset[str]


NO_FILE_SHAPES = FileShapes({}, frozenset())


def urdf_shapes(element: Element) -> FileShapes:
    """Return the shapes of the ``collision`` elements of a URDF."""
    entries: dict[str, list[ShapeEntry]] = {}
    meshes: set[str] = set()
    for link in element.findall("link"):
        name = link.get("name", "")
        for collision in link.findall("collision"):
            shape = _collision_entry(collision)
            if shape is None:
                meshes.add(name)
            else:
                entries.setdefault(name, []).append(shape)
    return _file_shapes(entries, meshes)


def mjcf_shapes(mujoco: Any, model: Any, names: Sequence[str]) -> FileShapes:
    """Return the shapes of the geoms of an MJCF that can collide, without planes.

    Args:
        mujoco: The module.
        model: MuJoCo's model.
        names: Names of the links by body.
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
    return _file_shapes(entries, meshes)


def collides(model: Any, geom: int) -> bool:
    """Return True if a geom of an MJCF takes part in collisions."""
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def simple_geom(mujoco: Any, model: Any, geom: int) -> tuple[str, list[float]] | None:
    """Return kind and sizes [m] of a geom of an MJCF; None if it is not simple."""
    types, (x, y, z) = mujoco.mjtGeom, model.geom_size[geom].tolist()
    return {
        int(types.mjGEOM_BOX): ("box", [2 * x, 2 * y, 2 * z]),
        int(types.mjGEOM_SPHERE): ("sphere", [x]),
        int(types.mjGEOM_CAPSULE): ("capsule", [x, 2 * y]),
        int(types.mjGEOM_CYLINDER): ("cylinder", [x, 2 * y]),
    }.get(int(model.geom_type[geom]))


def mjcf_pose(mujoco: Any, position: Array, quaternion: Array) -> Array:
    """Return the pose (4, 4) of a position (3,) [m] and a quaternion (4,), w x y z."""
    pose, rotation = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quaternion, dtype=float))
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def shape_entry(kind: str, size: Sequence[float], pose: Array) -> ShapeEntry:
    """Return a simple shape as a record of a description.

    Args:
        kind: "box", "sphere", "capsule" or "cylinder".
        size: Edges, radius, or radius and length, of a capsule without its caps [m].
        pose: (4, 4) pose in the link; capsules and cylinders are along z.
    """
    x, y, z = (float(value) for value in pose[:3, 3])
    roll, pitch, yaw = (float(value) for value in roll_pitch_yaw(pose[:3, :3]))
    if kind == "box":
        return LinkBoxEntry(size=(size[0], size[1], size[2]), xyz=(x, y, z), rpy=(roll, pitch, yaw))
    if kind == "sphere":
        return LinkSphereEntry(radius=size[0], center=(x, y, z))
    if kind == "cylinder":
        return LinkCylinderEntry(
            radius=size[0], length=size[1], xyz=(x, y, z), rpy=(roll, pitch, yaw)
        )
    half_axis = pose[:3, 2] * size[1] / 2
    first, last = (tuple((pose[:3, 3] + sign * half_axis).tolist()) for sign in (-1, 1))
    return LinkCapsuleEntry(ends=(first, last), radius=size[0])


def _collision_entry(collision: Element) -> ShapeEntry | None:
    """Return the shape of a ``collision`` element; None for a mesh or an invalid element."""
    shape, pose = simple_shape(collision), origin_pose(collision)
    return None if shape is None or pose is None else shape_entry(*shape, pose)


def simple_shape(element: Element) -> tuple[str, list[float]] | None:
    """Return kind and sizes [m] of a shape element of a URDF; None if it is not simple."""
    geometry = element.find("geometry")
    if geometry is None or len(geometry) != 1:
        return None
    (shape,) = geometry
    keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
    size = [v for key in keys.get(shape.tag, ()) for v in parse_numbers(shape.get(key, ""))]
    expected = {"box": 3, "sphere": 1, "cylinder": 2}.get(shape.tag, 0)
    is_valid = expected and len(size) == expected and min(size) > 0
    return (shape.tag, size) if is_valid else None


def origin_pose(element: Element) -> Array | None:
    """Return the pose (4, 4) of the element's origin; None if it is invalid."""
    origin = element.find("origin")
    xyz, rpy = (
        parse_numbers("0 0 0" if origin is None else origin.get(key, "0 0 0"))
        for key in ("xyz", "rpy")
    )
    if [len(xyz), len(rpy)] != [3, 3]:
        return None
    return frame_matrix(Frame((xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2])))


def parse_numbers(text: str) -> list[float]:
    """Return the numbers of an attribute; an empty list if one is invalid or too large."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return []
    return values if all(abs(value) <= LIMITS.robot_number for value in values) else []


def _file_shapes(entries: dict[str, list[ShapeEntry]], meshes: set[str]) -> FileShapes:
    simple = {link: tuple(shapes) for link, shapes in entries.items() if link not in meshes}
    return FileShapes(simple, frozenset(meshes))


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """A joint of a robot file.

    Attributes:
        name: Name.
        parent: Parent link.
        child: Child link.
        type: "revolute", "continuous", "prismatic", "fixed", or a type with several axes.
        placement: (4, 4) pose of the child in the parent at position zero.
        axis: (3,) unit axis in the child's frame.
        limits: Lower and upper limit [rad or m]; None if the file has none.
        velocity: Velocity limit [rad/s or m/s], inf if the file has none (or zero).
        coupling: Coupling to another joint or motor; None if there is none.
        effort: Largest torque or force [N m or N], inf if the file has none (or zero).
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
    """The joints and shapes of a robot file.

    Attributes:
        path: The file.
        root: Root link.
        joints: All joints, parents before children.
        motors: Lower and upper limit by name of motors that are not joints (tendons).
        shapes: Collision shapes of the links.
        element: Root element of a URDF, with macros expanded.
        model: The module mujoco and the model of an MJCF.
        notes: Parts of the file that were ignored, a sentence each.
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
        """Names of the links; the root is first."""
        return links_of(self)

    @cached_property
    def by_name(self) -> dict[str, TreeJoint]:
        """Joints by name."""
        return {joint.name: joint for joint in self.joints}

    def chain(self, root: str, link: str, location: str) -> tuple[TreeJoint, ...]:
        """Return the joints between two links.

        Args:
            root: The upper link.
            link: The lower link.
            location: File and key, for the message.

        Raises:
            DescriptionError: The lower link is not below the upper one.
        """
        chain = chain_to(self, link, root)
        if (chain[0].parent if chain else link) != root:
            raise DescriptionError(f"{location}: link {link!r} is not below link {root!r}")
        return tuple(chain)

    def require_link(self, link: str, location: str) -> str:
        """Return a link if it exists.

        Raises:
            DescriptionError: The link does not exist; the message lists the links.
        """
        return require_name(link, self.links, "link", location)

    def require_joint(self, joint: str, location: str) -> str:
        """Return a joint if it exists.

        Raises:
            DescriptionError: The joint does not exist; the message lists the movable joints.
        """
        movable = [tree_joint.name for tree_joint in self.joints if tree_joint.type != "fixed"]
        if joint in self.by_name:
            return joint
        return require_name(joint, movable, "joint", location)


def fixed_tree_joint(name: str, parent: str, child: str, placement: Array) -> TreeJoint:
    """Return a fixed joint."""
    axis = np.array([0.0, 0.0, 1.0])
    return TreeJoint(name, parent, child, "fixed", placement, axis, None, math.inf, None)
