"""What may stand in a scene file."""

from __future__ import annotations

import msgspec

from casadi_ik.files.reading import Angles, Point, Struct
from casadi_ik.files.units import Length, Pure
from casadi_ik.robots.schema import TouchingEntry

Quaternion = tuple[Pure, Pure, Pure, Pure]
PoseRow = tuple[Pure, Pure, Pure, Length]


class _Entry(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", kw_only=True
):
    """What every solid of a scene has.

    Attributes:
        xyz: Its origin in the robot's base frame [m].
        rpy: Angles about the base's fixed axes x, y, z [rad]; or how it is turned as
        quaternion_wxyz: a unit quaternion, scalar first, or
        quaternion_xyzw: scalar last (as ROS has it).
        pose: (4, 4) rows of its pose, instead of all these; translation in [m].
        margin: Distance to keep from it [m]; left out: the scene's.
    """

    xyz: Point | None = None
    rpy: Angles | None = None
    quaternion_wxyz: Quaternion | None = None
    quaternion_xyzw: Quaternion | None = None
    pose: tuple[PoseRow, PoseRow, PoseRow, PoseRow] | None = None
    margin: Length | None = None


class BoxEntry(_Entry, frozen=True, tag="box", kw_only=True):
    """A box about its pose's origin.

    Attributes:
        size: Along its own x, y and z [m].
    """

    size: tuple[Length, Length, Length]


class SphereEntry(_Entry, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        radius: [m].
    """

    radius: Length


class CylinderEntry(_Entry, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z.

    Attributes:
        radius: [m].
        length: [m].
    """

    radius: Length
    length: Length


class CapsuleEntry(_Entry, frozen=True, tag="capsule", kw_only=True):
    """A capsule along z.

    Attributes:
        radius: [m].
        length: Of its segment, without the caps [m].
    """

    radius: Length
    length: Length


class HalfSpaceEntry(_Entry, frozen=True, tag="half-space", kw_only=True):
    """All below the plane z = 0 of its pose."""


class MeshEntry(_Entry, frozen=True, tag="mesh", kw_only=True):
    """The convex hull of a mesh, or of several that are one thing.

    Attributes:
        file: A path, counted from the scene's file, or several.
        scale: Factor of its coordinates.
        parts: What hangs together in a mesh is a convex part by itself.
    """

    file: str | list[str]
    scale: float = 1.0
    parts: bool = False


class ConvexEntry(_Entry, frozen=True, tag="convex", kw_only=True):
    """The convex hull of points.

    Attributes:
        points: Some that it is the hull of, in its own frame [m].
    """

    points: list[Point]


class PointCloudEntry(_Entry, frozen=True, tag="point-cloud", kw_only=True):
    """Balls about points, as a camera or a scanner sees them.

    Attributes:
        radius: Of every ball [m].
        file: npy, npz, PLY, PCD or a table of x, y, z; a path, counted from the scene's file.
        points: The points themselves, instead of a file [m].
        voxel: Edge of the cubes of a grid in each of which the points become one [m]; its ball is
            wider by how far they are from it. 0: all are kept.
        scale: Factor of a file's coordinates.
    """

    radius: Length
    file: str = ""
    points: list[Point] = msgspec.field(default_factory=list)
    voxel: Length = 0.0
    scale: float = 1.0


class ObjectEntry(_Entry, frozen=True, tag="object", kw_only=True):
    """An object.

    Attributes:
        object: A shipped object, or the path of an object file or of a mesh.
    """

    object: str


SolidEntry = (
    BoxEntry
    | SphereEntry
    | CylinderEntry
    | CapsuleEntry
    | HalfSpaceEntry
    | MeshEntry
    | ConvexEntry
    | PointCloudEntry
    | ObjectEntry
)


class MarginEntry(Struct, frozen=True):
    """Two of links and solids, and how far they have to be apart whatever else is said.

    Attributes:
        links: Names of links or solids.
        margin: Distance to keep [m].
    """

    links: tuple[str, str]
    margin: Length


class SceneFile(Struct, frozen=True):
    """A scene: ``models/scenes/*.yaml``.

    Attributes:
        solids: What stands there, by name.
        margin: Distance to keep, also between links [m].
        grasped: Name of the solid that is grasped: links with a contact may touch it.
        margins: Distances of two, before the solid's and the scene's.
        touching: Pairs that may touch.
        name: What it is called; left out: as its file.
        description: One sentence.
    """

    solids: dict[str, SolidEntry] = msgspec.field(default_factory=dict)
    margin: Length = 0.0
    grasped: str | None = None
    margins: list[MarginEntry] = msgspec.field(default_factory=list)
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    name: str = ""
    description: str = ""
