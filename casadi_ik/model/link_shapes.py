"""Collision shapes of links, and pairs of links that may touch."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.model.joints import require_name
from casadi_ik.model.schema import (
    CollisionEntry,
    LinkBoxEntry,
    LinkCapsuleEntry,
    LinkCylinderEntry,
    LinkSphereEntry,
    ShapeEntry,
)
from casadi_ik.model.xml_tree import parse_xml, read_robot_file, required_attribute


def srdf_pairs(path: Path) -> list[tuple[tuple[str, str], str]]:
    """Return the pairs of ``disable_collisions``, each with the reason that the file states.

    Raises:
        DescriptionError: The file cannot be read, is not an SRDF, or a pair lacks a link.
    """
    element = parse_xml(read_robot_file(path), path)
    if element.tag != "robot":
        raise DescriptionError(f"{path}: found <{element.tag}>, expected <robot> of an SRDF")
    pairs: list[tuple[tuple[str, str], str]] = []
    for i, pair in enumerate(element.iter("disable_collisions")):
        location = f"{path}: disable_collisions[{i}]"
        links = (
            required_attribute(pair, "link1", location),
            required_attribute(pair, "link2", location),
        )
        pairs.append((links, f"{path.name}: {pair.get('reason', 'no reason given')}"))
    return pairs


MAX_CAPSULES_ACROSS = 4
"""Largest number of capsules across a side of a box or a cylinder."""


@dataclass(frozen=True, eq=False)
class LinkCapsule:
    """A capsule or sphere of the robot.

    Attributes:
        link: Link that carries the capsule.
        center: (3,) centre of the segment in the link's frame [m].
        half_axis: (3,) vector from the centre to the end of the segment [m]; zero for a sphere.
        radius: Radius [m].
        covers: Index of the solid of the robot that this capsule helps to enclose; -1: the
            capsule is a shape itself.
    """

    link: str
    center: Array
    half_axis: Array
    radius: float
    covers: int = -1


@dataclass(frozen=True, eq=False)
class LinkSolid:
    """A box or a cylinder of the robot.

    Attributes:
        link: Link that carries it.
        kind: "box" or "cylinder".
        size: (3,) edges, or radius, length and 0 [m].
        pose: (4, 4) pose in the link's frame.
    """

    link: str
    kind: str
    size: Array
    pose: Array


@dataclass(frozen=True)
class Touching:
    """Two links whose shapes may touch.

    Attributes:
        links: Names of the links.
        reason: Reason in words.
        depth: Largest allowed penetration [m].
    """

    links: tuple[str, str]
    reason: str
    depth: float = math.inf


@dataclass(frozen=True, eq=False)
class Shapes:
    """The collision shapes of an arm, a hand or a robot.

    Attributes:
        capsules: Capsules and spheres.
        solids: Boxes and cylinders.
        touching: Pairs of links that may touch.
    """

    capsules: tuple[LinkCapsule, ...] = ()
    solids: tuple[LinkSolid, ...] = ()
    touching: tuple[Touching, ...] = ()

    def renamed(self, names: Mapping[str, str]) -> Shapes:
        """Return the shapes with other names of links."""
        return Shapes(
            tuple(replace(item, link=names.get(item.link, item.link)) for item in self.capsules),
            tuple(replace(item, link=names.get(item.link, item.link)) for item in self.solids),
            tuple(
                replace(pair, links=tuple(names.get(link, link) for link in pair.links))
                for pair in self.touching
            ),
        )

    def mirrored(self) -> Shapes:
        """Return the shapes of the mirror image, in which the y axis of every link is inverted."""
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        signs = np.diagonal(mirror)[:3]
        return Shapes(
            tuple(
                replace(
                    capsule,
                    center=read_only(capsule.center * signs),
                    half_axis=read_only(capsule.half_axis * signs),
                )
                for capsule in self.capsules
            ),
            tuple(
                replace(solid, pose=read_only(mirror @ solid.pose @ mirror))
                for solid in self.solids
            ),
            self.touching,
        )

    def remove_links(self, links: Collection[str]) -> Shapes:
        """Return the shapes without those of some links."""
        remaining = [i for i, solid in enumerate(self.solids) if solid.link not in links]
        new_index = {old: new for new, old in enumerate(remaining)} | {-1: -1}
        return Shapes(
            tuple(
                replace(capsule, covers=new_index[capsule.covers])
                for capsule in self.capsules
                if capsule.link not in links
            ),
            tuple(self.solids[i] for i in remaining),
            self.touching,
        )

    def __add__(self, added: Shapes) -> Shapes:
        shift = len(self.solids)
        shifted = tuple(
            replace(item, covers=item.covers + shift) if item.covers >= 0 else item
            for item in added.capsules
        )
        return Shapes(
            self.capsules + shifted, self.solids + added.solids, self.touching + added.touching
        )


NO_SHAPES = Shapes()


def link_shapes(entry: CollisionEntry | None, links: Iterable[str], path: Path) -> Shapes:
    """Return the checked shapes of a description.

    Args:
        entry: Entry of the description; None for no shapes.
        links: Links of the description.
        path: File of the description, to which the path of an SRDF is relative.

    Raises:
        DescriptionError: The entry is malformed; the message names file, key and expected value.
    """
    if entry is None:
        return NO_SHAPES
    names, location = list(links), str(path)
    capsules: list[LinkCapsule] = []
    solids: list[LinkSolid] = []
    for link, shapes in entry.links.items():
        require_name(link, names, "link", f"{location}: collision.links.{link}")
        for shape in shapes:
            covers = -1
            if isinstance(shape, LinkBoxEntry | LinkCylinderEntry):
                covers = len(solids)
                solids.append(_solid(link, shape))
            capsules += [LinkCapsule(link, *capsule, covers) for capsule in capsules_of(shape)]
    touching: list[Touching] = []
    for i, pair in enumerate(entry.touching):
        key = f"{location}: collision.touching[{i}]"
        for link in pair.links:
            require_name(link, names, "link", f"{key}.links")
        if not pair.reason.strip():
            raise DescriptionError(f"{key}.reason: is empty; expected why the links may touch")
        touching.append(Touching(pair.links, pair.reason, pair.depth or math.inf))
    if entry.srdf is not None:
        file = Path(entry.srdf).expanduser()
        file = file if file.is_absolute() else path.parent / file
        # The file may name links that this robot does not use.
        pairs = [pair for pair in srdf_pairs(file) if set(pair[0]) <= set(names)]
        touching += [Touching(*pair) for pair in pairs]
    return Shapes(tuple(capsules), tuple(solids), tuple(touching))


def _solid(link: str, shape: LinkBoxEntry | LinkCylinderEntry) -> LinkSolid:
    pose = read_only(frame_matrix(Frame(shape.xyz, shape.rpy)))
    if isinstance(shape, LinkBoxEntry):
        return LinkSolid(link, "box", read_only(shape.size), pose)
    return LinkSolid(link, "cylinder", read_only((shape.radius, shape.length, 0.0)), pose)


def capsules_of(shape: ShapeEntry) -> list[tuple[Array, Array, float]]:
    """Return centres, half segments and radii of capsules that enclose a shape.

    Spheres and capsules are returned unchanged. A box is cut across its two shorter sides into up
    to `MAX_CAPSULES_ACROSS` bars, as square as possible; the capsule of a bar contains its corners.
    A cylinder longer than wide is enclosed by one capsule, a flat one is treated as its bounding
    box.
    """
    if isinstance(shape, LinkSphereEntry):
        return [(read_only(shape.center), read_only(np.zeros(3)), shape.radius)]
    if isinstance(shape, LinkCapsuleEntry):
        start, end = np.array(shape.ends[0]), np.array(shape.ends[1])
        return [(read_only((start + end) / 2), read_only((end - start) / 2), shape.radius)]
    pose = frame_matrix(Frame(shape.xyz, shape.rpy))
    if isinstance(shape, LinkCylinderEntry):
        if shape.length < 2 * shape.radius:
            size = np.array([2 * shape.radius, 2 * shape.radius, shape.length])
            return _box_capsules(size, pose)
        axis = np.array([0, 0, 1.0])
        return [_bar_capsule(np.zeros(3), axis, shape.length / 2, shape.radius, pose)]
    return _box_capsules(np.array(shape.size), pose)


def _box_capsules(size: Array, pose: Array) -> list[tuple[Array, Array, float]]:
    """Return capsules (centre, half axis, radius) that cover a box, along its longest edge."""
    order = np.argsort(size, kind="stable")
    shortest, middle, longest = (int(i) for i in order)
    # Bars are about as wide as the box is thick, unless the box is a thin plate.
    ratio = size[middle] / max(size[shortest], 1e-9)
    count = min(MAX_CAPSULES_ACROSS, max(1, math.ceil(ratio - 1e-9)))
    width = size[middle] / count
    axis = np.eye(3)[longest]
    capsules = []
    for i in range(count):
        center = np.zeros(3)
        center[middle] = (i + 0.5) * width - size[middle] / 2
        corner_radius = math.hypot(width, size[shortest]) / 2
        capsules.append(_bar_capsule(center, axis, size[longest] / 2, corner_radius, pose))
    return capsules


def _bar_capsule(
    center: Array, axis: Array, half_length: float, corner_radius: float, pose: Array
) -> tuple[Array, Array, float]:
    """Return the capsule of smallest volume, of 26 radii, that encloses a bar.

    Args:
        center: (3,) centre of the bar.
        axis: (3,) unit vector along the bar.
        half_length: Half length of the bar [m].
        corner_radius: Distance of the corners from the axis [m].
        pose: (4, 4) frame of centre and axis in the link.
    """
    best = (math.inf, half_length, corner_radius)
    for trial in np.linspace(1.0, 1.5, 26) * corner_radius:
        # The wider the capsule, the earlier its segment may end.
        shortening = math.sqrt(max(trial * trial - corner_radius * corner_radius, 0.0))
        segment = max(half_length - shortening, 0.0)
        radius = math.hypot(half_length, corner_radius) if segment == 0.0 else float(trial)
        volume = math.pi * radius * radius * (2 * segment + 4 / 3 * radius)
        best = min(best, (volume, segment, radius))
    _, segment, radius = best
    rotation = pose[:3, :3]
    return read_only(rotation @ center + pose[:3, 3]), read_only(rotation @ axis * segment), radius
