"""What may stand under `collision:` in a description."""

from __future__ import annotations

import msgspec

from casadi_ik.files.reading import Angles, Point, Struct
from casadi_ik.files.units import Length


class _Shape(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A shape.

    Attributes:
        excess: By how much it is larger than the mesh it holds, at most [m].
    """


class SphereEntry(_Shape, frozen=True, tag="sphere", kw_only=True):
    """A ball about a point of the link.

    Attributes:
        radius: [m].
        center: In the link's frame [m].
    """

    radius: Length
    center: Point = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class CapsuleEntry(_Shape, frozen=True, tag="capsule", kw_only=True):
    """All within the radius of the segment between two points of the link.

    Attributes:
        ends: Two points of the link's frame [m].
        radius: [m].
    """

    ends: tuple[Point, Point]
    radius: Length
    excess: Length = 0.0


class BoxEntry(_Shape, frozen=True, tag="box", kw_only=True):
    """A box about its own frame's origin.

    Attributes:
        size: Along its own x, y and z [m].
        xyz: Its middle in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    size: tuple[Length, Length, Length]
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class CylinderEntry(_Shape, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z about its own frame's origin.

    Attributes:
        radius: [m].
        length: Along its own z [m].
        xyz: Its middle in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    radius: Length
    length: Length
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


ShapeEntry = SphereEntry | CapsuleEntry | BoxEntry | CylinderEntry


class TouchingEntry(Struct, frozen=True):
    """Two links that may touch, and why.

    Attributes:
        links: Their names; in a scene a solid's too.
        reason: Why, in words.
        depth: How far their shapes may overlap [m]; left out: any.
    """

    links: tuple[str, str]
    reason: str
    depth: Length | None = None


class CollisionEntry(Struct, frozen=True):
    """The key ``collision`` of a description.

    Attributes:
        links: Shapes by link.
        touching: Pairs of links that are not checked, or less strictly.
        source: Tags of `sources` that the shapes are from.
        srdf: A file with more pairs that may touch.
    """

    links: dict[str, list[ShapeEntry]] = msgspec.field(default_factory=dict)
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    source: str = ""
    srdf: str | None = None
