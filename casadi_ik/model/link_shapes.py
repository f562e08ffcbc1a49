"""Shapes of links for collisions, and the pairs of links that are checked."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.model.linkage import require_name
from casadi_ik.model.schema import (
    BoxEntry,
    CapsuleEntry,
    CollisionEntry,
    CylinderEntry,
    ShapeEntry,
    SphereEntry,
)
from casadi_ik.model.xml_tree import parse_xml, read_robot_file, required_attribute


def srdf_pairs(path: Path) -> list[tuple[tuple[str, str], str]]:
    """The pairs of ``disable_collisions``, each with the file's reason.

    Raises:
        DescriptionError: The file cannot be read, is no SRDF, or a pair lacks a link.
    """
    element = parse_xml(read_robot_file(path), path)
    if element.tag != "robot":
        raise DescriptionError(f"{path}: found <{element.tag}>, expected <robot> of an SRDF")
    found: list[tuple[tuple[str, str], str]] = []
    for i, pair in enumerate(element.iter("disable_collisions")):
        where = f"{path}: disable_collisions[{i}]"
        links = required_attribute(pair, "link1", where), required_attribute(pair, "link2", where)
        found.append((links, f"{path.name}: {pair.get('reason', 'no reason given')}"))
    return found


MOST_AROUND = 4
"""Capsules across a side of a box or a cylinder, at the most."""


@dataclass(frozen=True, eq=False)
class LinkCapsule:
    """A shape of the robot.

    Attributes:
        link: The link it moves with.
        center: (3,) middle of its segment in the link's frame [m].
        half: (3,) from there to the segment's end [m]; zero for a sphere.
        radius: [m].
        covers: Number of the solid of the robot that it helps to hold; -1: it is a shape itself.
    """

    link: str
    center: Array
    half: Array
    radius: float
    covers: int = -1


@dataclass(frozen=True, eq=False)
class LinkSolid:
    """A box or a cylinder of the robot.

    Attributes:
        link: The link it moves with.
        kind: "box" or "cylinder".
        size: (3,) [m]: edges; or radius, length and nothing.
        pose: (4, 4) in the link's frame.
    """

    link: str
    kind: str
    size: Array
    pose: Array


@dataclass(frozen=True)
class Touching:
    """Two links whose shapes may touch.

    Attributes:
        links: Their names.
        reason: Why.
        depth: By how much they may overlap [m].
    """

    links: tuple[str, str]
    reason: str
    depth: float = math.inf


@dataclass(frozen=True, eq=False)
class Shapes:
    """The shapes of an arm, a hand or a robot."""

    capsules: tuple[LinkCapsule, ...] = ()
    solids: tuple[LinkSolid, ...] = ()
    touching: tuple[Touching, ...] = ()

    def renamed(self, names: Mapping[str, str]) -> Shapes:
        """The same, of links with other names."""
        return Shapes(
            tuple(replace(one, link=names.get(one.link, one.link)) for one in self.capsules),
            tuple(replace(one, link=names.get(one.link, one.link)) for one in self.solids),
            tuple(
                replace(one, links=tuple(names.get(link, link) for link in one.links))
                for one in self.touching
            ),
        )

    def mirrored(self) -> Shapes:
        """Those of the mirror image, in which every link's y is turned round."""
        mirror = np.diag([1.0, -1.0, 1.0, 1.0])
        across = np.diagonal(mirror)[:3]
        return Shapes(
            tuple(
                replace(
                    one, center=read_only(one.center * across), half=read_only(one.half * across)
                )
                for one in self.capsules
            ),
            tuple(replace(one, pose=read_only(mirror @ one.pose @ mirror)) for one in self.solids),
            self.touching,
        )

    def without(self, links: Collection[str]) -> Shapes:
        """The same without those of some links."""
        kept = [i for i, one in enumerate(self.solids) if one.link not in links]
        place = {old: new for new, old in enumerate(kept)} | {-1: -1}
        return Shapes(
            tuple(
                replace(one, covers=place[one.covers])
                for one in self.capsules
                if one.link not in links
            ),
            tuple(self.solids[i] for i in kept),
            self.touching,
        )

    def __add__(self, other: Shapes) -> Shapes:
        shift = len(self.solids)
        theirs = tuple(
            replace(one, covers=one.covers + shift) if one.covers >= 0 else one
            for one in other.capsules
        )
        return Shapes(
            self.capsules + theirs, self.solids + other.solids, self.touching + other.touching
        )


NO_SHAPES = Shapes()


def link_shapes(entry: CollisionEntry | None, links: Iterable[str], path: Path) -> Shapes:
    """The shapes of a description, checked.

    Args:
        entry: What it says; None: nothing.
        links: Its links.
        path: Its file, from whose folder that of an SRDF counts.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    if entry is None:
        return NO_SHAPES
    names, where = list(links), str(path)
    capsules: list[LinkCapsule] = []
    solids: list[LinkSolid] = []
    for link, shapes in entry.links.items():
        require_name(link, names, "link", f"{where}: collision.links.{link}")
        for shape in shapes:
            covers = -1
            if isinstance(shape, BoxEntry | CylinderEntry):
                covers = len(solids)
                solids.append(_solid(link, shape))
            capsules += [LinkCapsule(link, *one, covers) for one in capsules_of(shape)]
    touching: list[Touching] = []
    for i, pair in enumerate(entry.touching):
        key = f"{where}: collision.touching[{i}]"
        for link in pair.links:
            require_name(link, names, "link", f"{key}.links")
        if not pair.reason.strip():
            raise DescriptionError(f"{key}.reason: is empty, expected why they may touch")
        touching.append(Touching(pair.links, pair.reason, pair.depth or math.inf))
    if entry.srdf is not None:
        place = Path(entry.srdf).expanduser()
        place = place if place.is_absolute() else path.parent / place
        pairs = srdf_pairs(place)
        # Such a file may speak of more than this robot has.
        touching += [Touching(*one) for one in pairs if set(one[0]) <= set(names)]
    return Shapes(tuple(capsules), tuple(solids), tuple(touching))


def _solid(link: str, shape: BoxEntry | CylinderEntry) -> LinkSolid:
    pose = read_only(frame_matrix(Frame(shape.xyz, shape.rpy)))
    if isinstance(shape, BoxEntry):
        return LinkSolid(link, "box", read_only(shape.size), pose)
    return LinkSolid(link, "cylinder", read_only((shape.radius, shape.length, 0.0)), pose)


def capsules_of(shape: ShapeEntry) -> list[tuple[Array, Array, float]]:
    """Middles, halves and radii of capsules that hold a shape, in the link's frame.

    Spheres and capsules are themselves. A box is cut across its two shorter sides into up to
    `MOST_AROUND` bars each, as square as may be; each bar's capsule goes through its corners. A
    cylinder longer than wide becomes one capsule that holds its rims, a flat one is taken as its
    box.
    """
    if isinstance(shape, SphereEntry):
        return [(read_only(shape.center), read_only(np.zeros(3)), shape.radius)]
    if isinstance(shape, CapsuleEntry):
        one, other = np.array(shape.ends[0]), np.array(shape.ends[1])
        return [(read_only((one + other) / 2), read_only((other - one) / 2), shape.radius)]
    pose = frame_matrix(Frame(shape.xyz, shape.rpy))
    if isinstance(shape, CylinderEntry):
        if shape.length < 2 * shape.radius:
            size = np.array([2 * shape.radius, 2 * shape.radius, shape.length])
            return _bars(size, pose)
        return [_bar(np.zeros(3), np.array([0, 0, 1.0]), shape.length / 2, shape.radius, pose)]
    return _bars(np.array(shape.size), pose)


def _bars(size: Array, pose: Array) -> list[tuple[Array, Array, float]]:
    order = np.argsort(size, kind="stable")
    thin, middle, long = (int(i) for i in order)
    # Bars about as wide as the box is thick; where it is a plate, as many as there may be.
    count = min(MOST_AROUND, max(1, math.ceil(size[middle] / max(size[thin], 1e-9) - 1e-9)))
    width = size[middle] / count
    axis = np.eye(3)[long]
    found = []
    for i in range(count):
        center = np.zeros(3)
        center[middle] = (i + 0.5) * width - size[middle] / 2
        reach = math.hypot(width, size[thin]) / 2
        found.append(_bar(center, axis, size[long] / 2, reach, pose))
    return found


def _bar(
    center: Array, axis: Array, half: float, reach: float, pose: Array
) -> tuple[Array, Array, float]:
    """The capsule through the ends of a bar whose corners are `reach` from its axis.

    A wider capsule ends earlier: of all that hold the bar, the one of the least volume among some.
    """
    best = (math.inf, half, reach)
    for grown in np.linspace(1.0, 1.5, 26) * reach:
        inside = max(half - math.sqrt(max(grown * grown - reach * reach, 0.0)), 0.0)
        radius = math.hypot(half, reach) if inside == 0.0 else float(grown)
        volume = math.pi * radius * radius * (2 * inside + 4 / 3 * radius)
        best = min(best, (volume, inside, radius))
    _, inside, radius = best
    rotation = pose[:3, :3]
    return read_only(rotation @ center + pose[:3, 3]), read_only(rotation @ axis * inside), radius
