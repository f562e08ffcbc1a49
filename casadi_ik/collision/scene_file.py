"""Records of scene files; their docstrings describe the JSON Schema."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from casadi_ik.collision.solids import (
    PosedSolid,
    Solid,
    box,
    capsule,
    cloud_solids,
    cylinder,
    grid_centers,
    half_space,
    hull,
    mesh_hulls,
    object_solids,
)
from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import (
    checked_quaternion,
    rotations_from_quaternions,
    single_pose,
)
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import finite_points, read_points
from casadi_ik.files.reading import Angles, Frame, Point, Struct, frame_matrix
from casadi_ik.files.units import Distance, Factor, Length, PureNumber, Size
from casadi_ik.model.mesh_shape import load_mesh_shape, read_body
from casadi_ik.model.schema import TouchingEntry

Quaternion = tuple[PureNumber, PureNumber, PureNumber, PureNumber]
PoseRow = tuple[PureNumber, PureNumber, PureNumber, Length]


class ObstacleEntry(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", kw_only=True
):
    """The keys that all kinds of obstacles have. The orientation is stated by at most one of them.

    Attributes:
        xyz: Origin in the robot's base frame [m].
        rpy: Angles about the fixed axes x, y, z of the base frame [rad], as in URDF.
        quaternion_wxyz: Orientation as a unit quaternion, scalar first.
        quaternion_xyzw: Orientation as a unit quaternion, scalar last, as in ROS.
        pose: Rows of the (4, 4) pose, translation in [m]; replaces the origin and the orientation.
        margin: Margin of the obstacle [m]; default: that of the scene.
    """

    xyz: Point | None = None
    rpy: Angles | None = None
    quaternion_wxyz: Quaternion | None = None
    quaternion_xyzw: Quaternion | None = None
    pose: tuple[PoseRow, PoseRow, PoseRow, PoseRow] | None = None
    margin: Distance | None = None

    def _solid(self) -> Solid:
        """Return the solid of an obstacle that consists of a single one."""
        raise NotImplementedError

    def solids(self, location: str, folder: Path) -> list[PosedSolid]:
        """Return the solids of the obstacle, with their (4, 4) poses in its frame.

        Args:
            location: File and key for error messages.
            folder: Folder that relative paths start from.

        Raises:
            DescriptionError: A file cannot be read, or its contents have no volume.
        """
        del location, folder
        return [(self._solid(), np.eye(4))]

    def matrix(self, location: str) -> Array:
        """Return the (4, 4) pose of the obstacle in the robot's base frame.

        Args:
            location: File and key for error messages.

        Raises:
            DescriptionError: Several keys state the pose, or its rotation is invalid.
        """
        exclusive = ("rpy", "quaternion_wxyz", "quaternion_xyzw", "pose")
        keys = [key for key in exclusive if getattr(self, key) is not None]
        if self.pose is not None and self.xyz is not None:
            keys.append("xyz")
        if len(keys) > 1:
            raise DescriptionError(f"{location}: found {' and '.join(keys)}, expected one of them")
        if self.pose is not None:
            return single_pose(self.pose, f"{location}.pose")
        frame = Frame(self.xyz or (0.0, 0.0, 0.0), self.rpy or (0.0, 0.0, 0.0))
        pose = frame_matrix(frame, location)
        for key, shift in (("quaternion_wxyz", 0), ("quaternion_xyzw", 1)):
            quaternion = getattr(self, key)
            if quaternion is not None:
                unit = checked_quaternion(quaternion, f"{location}.{key}")
                pose[:3, :3] = rotations_from_quaternions(np.roll(unit, shift)[None])[0]
        return pose


class BoxEntry(ObstacleEntry, frozen=True, tag="box", kw_only=True):
    """A box centred in its frame.

    Attributes:
        size: Edges along x, y and z of its frame [m].
    """

    size: tuple[Size, Size, Size]

    def _solid(self) -> Solid:
        return box(self.size)


class SphereEntry(ObstacleEntry, frozen=True, tag="sphere", kw_only=True):
    """A ball centred in its frame.

    Attributes:
        radius: Radius [m].
    """

    radius: Size

    def _solid(self) -> Solid:
        return capsule(self.radius, 0.0)


class CylinderEntry(ObstacleEntry, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z, centred in its frame.

    Attributes:
        radius: Radius [m].
        length: Length along z of its frame [m].
    """

    radius: Size
    length: Distance

    def _solid(self) -> Solid:
        return cylinder(self.radius, self.length)


class CapsuleEntry(ObstacleEntry, frozen=True, tag="capsule", kw_only=True):
    """A capsule along z, centred in its frame: all points within the radius of a segment.

    Attributes:
        radius: Radius [m].
        length: Length of the segment, without the caps [m].
    """

    radius: Size
    length: Distance

    def _solid(self) -> Solid:
        return capsule(self.radius, self.length / 2)


class HalfSpaceEntry(ObstacleEntry, frozen=True, tag="half-space", kw_only=True):
    """The half-space below the plane z = 0 of its frame."""

    def _solid(self) -> Solid:
        return half_space()


class MeshEntry(ObstacleEntry, frozen=True, tag="mesh", kw_only=True):
    """The convex hull of a mesh, or the convex hulls of several meshes.

    Attributes:
        file: Path of the mesh, relative to the scene file, or a list of paths.
        scale: Factor of the coordinates.
        parts: Use a convex hull for each connected component of a mesh.
    """

    file: str | list[str]
    scale: Factor = 1.0
    parts: bool = False

    def solids(self, location: str, folder: Path) -> list[PosedSolid]:
        """Return the convex hulls of the meshes, with their (4, 4) poses."""
        key = f"{location}.file"
        files = [folder / Path(name).expanduser() for name in self._names]
        if not files:
            raise DescriptionError(f"{key}: the list is empty; expected at least one file")
        if self.parts:
            return mesh_hulls(load_mesh_shape(files, self.scale, key), key)
        meshes = [self.scale * read_body(file, key)[0] for file in files]
        return [_centred_hull(points, key) for points in meshes]

    @property
    def _names(self) -> list[str]:
        return [self.file] if isinstance(self.file, str) else self.file


class ConvexEntry(ObstacleEntry, frozen=True, tag="convex", kw_only=True):
    """The convex hull of points.

    Attributes:
        points: Points in the frame of the obstacle [m].
    """

    points: list[Point]

    def solids(self, location: str, folder: Path) -> list[PosedSolid]:  # noqa: ARG002
        """Return the convex hull, with its (4, 4) pose."""
        points = np.array(self.points, dtype=float).reshape(-1, 3)
        return [_centred_hull(points, f"{location}.points")]


def _centred_hull(points: Array, location: str) -> PosedSolid:
    """Return the convex hull of points (k, 3) in a frame at their mean, with its (4, 4) pose."""
    pose = np.eye(4)
    if points.ndim == 2 and len(points):
        pose[:3, 3] = points.mean(axis=0)
    return hull(points - pose[:3, 3], location), pose


class PointCloudEntry(ObstacleEntry, frozen=True, tag="point-cloud", kw_only=True):
    """Balls around the points of a camera or scanner.

    Attributes:
        radius: Radius of the balls [m].
        file: Path relative to the scene file: npy, npz, PLY, PCD or a table of x, y, z.
        points: Points in the frame of the obstacle [m]; excludes ``file``.
        voxel: Edge of the cells of a grid in which the points of a cell are replaced by their
            centre, with a ball that is enlarged to contain theirs [m]; 0: all points are used.
        scale: Factor of the coordinates of a file.
    """

    radius: Size
    file: str = ""
    points: list[Point] = msgspec.field(default_factory=list)
    voxel: Distance = 0.0
    scale: Factor = 1.0

    def solids(self, location: str, folder: Path) -> list[PosedSolid]:
        """Return compact clouds of balls, with their (4, 4) poses."""
        if (len(self.points) > 0) == bool(self.file):
            problem = "both 'file' and 'points' are given" if self.file else "has no points"
            raise DescriptionError(f"{location}: {problem}; expected either 'file' or 'points'")
        if self.file:
            path = folder / Path(self.file).expanduser()
            points = self.scale * read_points(path, f"{location}.file")
        else:
            points = finite_points(np.asarray(self.points), f"{location}.points")
        points, enlargement = grid_centers(points, self.voxel) if self.voxel > 0 else (points, 0.0)
        if len(points) > LIMITS.cloud_balls:
            raise DescriptionError(
                f"{location}: found {len(points)} points, expected at most {LIMITS.cloud_balls} "
                "(see 'voxel')"
            )
        return cloud_solids(points, self.radius + enlargement)


class ObjectEntry(ObstacleEntry, frozen=True, tag="object", kw_only=True):
    """An object.

    Attributes:
        object: Name of a shipped object, or the path of an object file or mesh.
    """

    object: str

    def solids(self, location: str, folder: Path) -> list[PosedSolid]:  # noqa: ARG002
        """Return the solids of the object, with their (4, 4) poses."""
        try:
            return object_solids(self.object)
        except (UnknownNameError, DescriptionError) as error:
            raise DescriptionError(f"{location}.object: {error}") from error


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
    """The margin between two links or obstacles, which overrides all other margins.

    Attributes:
        links: Names of links or obstacles.
        margin: Margin [m].
    """

    links: tuple[str, str]
    margin: Distance


class SceneFile(Struct, frozen=True):
    """A scene: ``models/scenes/*.yaml``.

    Attributes:
        solids: Obstacles by name.
        margin: Margin, also between links [m].
        grasped: Name of the grasped obstacle, which links with a contact may touch.
        margins: Margins of pairs, which override those of obstacles and scene.
        enveloping: Largest penetration between the shapes of the fingers' links and the grasped
            obstacle [m]; 0: only fingertips may touch it.
        touching: Pairs that may touch.
        name: Name of the scene; default: that of its file.
        description: Description in one sentence.
    """

    solids: dict[str, SolidEntry] = msgspec.field(default_factory=dict)
    margin: Distance = 0.0
    grasped: str | None = None
    margins: list[MarginEntry] = msgspec.field(default_factory=list)
    enveloping: Distance = 0.0
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    name: str = ""
    description: str = ""
