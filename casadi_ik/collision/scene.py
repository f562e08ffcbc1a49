"""Scenes: solids with poses and names, margins, what may be touched; and the files they are in."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.solids import (
    Kind,
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
from casadi_ik.errors import DescriptionError, InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import (
    checked_pose,
    checked_quaternion,
    rotations_from_quaternions,
    single_pose,
)
from casadi_ik.files.input_checks.units import warn_of_obstacle
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import finite_points, read_points
from casadi_ik.files.reading import (
    Angles,
    Frame,
    Point,
    Struct,
    frame_matrix,
    read,
    validated,
)
from casadi_ik.files.shipped import resolve_description
from casadi_ik.files.units import Distance, Factor, Length, PureNumber, Size
from casadi_ik.model.link_shapes import Touching
from casadi_ik.model.schema import TouchingEntry
from casadi_ik.model.shapes import load_mesh_shape
from casadi_ik.model.urdf_body import read_body

Part = tuple[Solid, Array]
"""A solid and its (4, 4) pose in the frame of what it is part of."""

Quaternion = tuple[PureNumber, PureNumber, PureNumber, PureNumber]
PoseRow = tuple[PureNumber, PureNumber, PureNumber, Length]


class Entry(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", kw_only=True
):
    """What a file says of every solid of a scene.

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
    margin: Distance | None = None

    def _solid(self) -> Solid:
        """The solid that it is, of a kind that is one by itself."""
        raise NotImplementedError

    def solids(self, where: str, folder: Path) -> list[Part]:
        """The solids it consists of.

        Args:
            where: File and key, for the message.
            folder: What relative paths count from.

        Raises:
            DescriptionError: A file cannot be read, or is no solid's.
        """
        del where, folder
        return [(self._solid(), np.eye(4))]

    def matrix(self, where: str) -> Array:
        """(4, 4) of its pose; how it is turned may be said in one of four ways.

        Raises:
            DescriptionError: It is said in several, or is no pose.
        """
        ways = ("rpy", "quaternion_wxyz", "quaternion_xyzw", "pose")
        turns = [key for key in ways if getattr(self, key) is not None]
        if self.pose is not None and self.xyz is not None:
            turns.append("xyz")
        if len(turns) > 1:
            raise DescriptionError(f"{where}: found {' and '.join(turns)}, expected one of them")
        if self.pose is not None:
            return single_pose(self.pose, f"{where}.pose")
        pose = frame_matrix(Frame(self.xyz or (0.0, 0.0, 0.0), self.rpy or (0.0, 0.0, 0.0)))
        for key, shift in (("quaternion_wxyz", 0), ("quaternion_xyzw", 1)):
            given = getattr(self, key)
            if given is not None:
                unit = checked_quaternion(given, f"{where}.{key}")
                pose[:3, :3] = rotations_from_quaternions(np.roll(unit, shift)[None])[0]
        return pose


class BoxEntry(Entry, frozen=True, tag="box", kw_only=True):
    """A box about its pose's origin.

    Attributes:
        size: Along its own x, y and z [m].
    """

    size: tuple[Size, Size, Size]

    def _solid(self) -> Solid:
        return box(self.size)


class SphereEntry(Entry, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        radius: [m].
    """

    radius: Size

    def _solid(self) -> Solid:
        return capsule(self.radius, 0.0)


class CylinderEntry(Entry, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z.

    Attributes:
        radius: [m].
        length: [m].
    """

    radius: Size
    length: Distance

    def _solid(self) -> Solid:
        return cylinder(self.radius, self.length)


class CapsuleEntry(Entry, frozen=True, tag="capsule", kw_only=True):
    """A capsule along z.

    Attributes:
        radius: [m].
        length: Of its segment, without the caps [m].
    """

    radius: Size
    length: Distance

    def _solid(self) -> Solid:
        return capsule(self.radius, self.length / 2)


class HalfSpaceEntry(Entry, frozen=True, tag="half-space", kw_only=True):
    """All below the plane z = 0 of its pose."""

    def _solid(self) -> Solid:
        return half_space()


class MeshEntry(Entry, frozen=True, tag="mesh", kw_only=True):
    """The convex hull of a mesh, or of several that are one thing.

    Attributes:
        file: A path, counted from the scene's file, or several.
        scale: Factor of its coordinates.
        parts: What hangs together in a mesh is a convex part by itself.
    """

    file: str | list[str]
    scale: Factor = 1.0
    parts: bool = False

    def solids(self, where: str, folder: Path) -> list[Part]:
        """The hulls of its meshes."""
        files = [folder / Path(name).expanduser() for name in self._names]
        if not files:
            raise DescriptionError(f"{where}.file: found none, expected at least one")
        if self.parts:
            return mesh_hulls(load_mesh_shape(files, self.scale, f"{where}.file"), f"{where}.file")
        meshes = [self.scale * read_body(file, f"{where}.file")[0] for file in files]
        return [_centred(points, f"{where}.file") for points in meshes]

    @property
    def _names(self) -> list[str]:
        return [self.file] if isinstance(self.file, str) else self.file


class ConvexEntry(Entry, frozen=True, tag="convex", kw_only=True):
    """The convex hull of points.

    Attributes:
        points: Some that it is the hull of, in its own frame [m].
    """

    points: list[Point]

    def solids(self, where: str, folder: Path) -> list[Part]:  # noqa: ARG002
        """The hull."""
        return [_centred(np.array(self.points, dtype=float).reshape(-1, 3), f"{where}.points")]


def _centred(points: Array, where: str) -> Part:
    """The convex hull of points (k, 3), about their mean."""
    pose = np.eye(4)
    if points.ndim == 2 and len(points):
        pose[:3, 3] = points.mean(axis=0)
    return hull(points - pose[:3, 3], where), pose


class PointCloudEntry(Entry, frozen=True, tag="point-cloud", kw_only=True):
    """Balls about points, as a camera or a scanner sees them.

    Attributes:
        radius: Of every ball [m].
        file: npy, npz, PLY, PCD or a table of x, y, z; a path, counted from the scene's file.
        points: The points themselves, instead of a file [m].
        voxel: Edge of the cubes of a grid in each of which the points become one [m]; its ball is
            wider by how far they are from it. 0: all are kept.
        scale: Factor of a file's coordinates.
    """

    radius: Size
    file: str = ""
    points: list[Point] = msgspec.field(default_factory=list)
    voxel: Distance = 0.0
    scale: Factor = 1.0

    def solids(self, where: str, folder: Path) -> list[Part]:
        """Balls, in parts that lie together."""
        if (len(self.points) > 0) == bool(self.file):
            raise DescriptionError(f"{where}: expected a point cloud's file or its points")
        if self.file:
            path = folder / Path(self.file).expanduser()
            found = self.scale * read_points(path, f"{where}.file")
        else:
            found = finite_points(np.asarray(self.points), f"{where}.points")
        found, wider = grid_centers(found, self.voxel) if self.voxel > 0 else (found, 0.0)
        if len(found) > LIMITS.cloud_balls:
            raise DescriptionError(
                f"{where}: found {len(found)} points, expected at most {LIMITS.cloud_balls} "
                "(see 'voxel')"
            )
        return cloud_solids(found, self.radius + wider)


class ObjectEntry(Entry, frozen=True, tag="object", kw_only=True):
    """An object.

    Attributes:
        object: A shipped object, or the path of an object file or of a mesh.
    """

    object: str

    def solids(self, where: str, folder: Path) -> list[Part]:  # noqa: ARG002
        """Those that the object consists of."""
        try:
            return object_solids(self.object)
        except (UnknownNameError, DescriptionError) as error:
            raise DescriptionError(f"{where}.object: {error}") from error


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
    margin: Distance


class SceneFile(Struct, frozen=True):
    """A scene: ``models/scenes/*.yaml``.

    Attributes:
        solids: What stands there, by name.
        margin: Distance to keep, also between links [m].
        grasped: Name of the solid that is grasped: links with a contact may touch it.
        margins: Distances of two, before the solid's and the scene's.
        enveloping: Fingers may touch what is grasped with all their links, whose shapes may be so
            deep in it [m]; 0: with fingertips alone.
        touching: Pairs that may touch.
        name: What it is called; left out: as its file.
        description: One sentence.
    """

    solids: dict[str, SolidEntry] = msgspec.field(default_factory=dict)
    margin: Distance = 0.0
    grasped: str | None = None
    margins: list[MarginEntry] = msgspec.field(default_factory=list)
    enveloping: Distance = 0.0
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    name: str = ""
    description: str = ""


@dataclass(frozen=True, eq=False)
class Item:
    """Something that stands in a scene.

    Attributes:
        name: Its name.
        parts: Its solids, each with its (4, 4) pose in the item's frame.
        pose: (4, 4) of the item in the robot's base frame.
        margin: Distance to keep from it [m]; None: the scene's.
        entry: What a scene file says of it, with whole paths.
    """

    name: str
    parts: tuple[tuple[Solid, Array], ...]
    pose: Array
    margin: float | None = None
    entry: SolidEntry | None = None


class Scene:
    """Obstacles around a robot, in its base frame.

    Attributes:
        items: What stands there, by name.
        margin: Distance to keep, also between links [m].
        grasped: Name of the item that is grasped: links with a contact may touch it.
        margins: By pair of links or items the distance to keep instead of the scene's or item's
            [m].
        enveloping: How deep shapes of all links of fingers may be in what is grasped [m].
        touching: Links that may touch an item or each other, and why.
        name: What it is called.

    Example:
        >>> post = {"kind": "cylinder", "radius": 0.02, "length": 1, "xyz": [0.5, 0.4, 0.5]}
        >>> scene = ik.Scene({"post": post}, margin=0.001)
        >>> ik.Solver(robot, scene=scene).solve(grasp).status.name
        'SOLVED'
    """

    def __init__(
        self,
        solids: Mapping[str, Any] | None = None,
        margin: float = 0.0,
        grasped: str | None = None,
        touching: Sequence[Mapping[str, Any]] = (),
        margins: Sequence[Mapping[str, Any]] = (),
        enveloping: float = 0.0,
        name: str = "scene",
    ) -> None:
        """Make a scene; without solids the robot is checked against itself.

        Args:
            solids: By name what stands there, as in a scene file: ``{"table": {"kind": "box",
                "size": [1, 1, 0.04], "xyz": [0.6, 0, -0.02]}}``.
            margin: Distance to keep [m].
            grasped: Name of the solid that is grasped.
            touching: ``{"links": [LINK, SOLID], "reason": TEXT}`` each.
            margins: ``{"links": [LINK, SOLID], "margin": 0.01}`` each, of links or solids [m].
            enveloping: Fingers may touch what is grasped with all their links, whose shapes may be
                so deep in it [m]; 0: with fingertips alone.
            name: What to call it.

        Raises:
            DescriptionError: One line that names the key, what was found and what was expected.
        """
        # Arrays of very many numbers, some of them NaN, are read as arrays.
        clouds = {
            key: value["points"]
            for key, value in (solids or {}).items()
            if isinstance(value, Mapping)
            and value.get("kind") == "point-cloud"
            and isinstance(value.get("points"), np.ndarray)
        }
        data = {
            "solids": {
                key: _plain({**value, "points": []} if key in clouds else value)
                for key, value in (solids or {}).items()
            },
            "margin": margin,
            "grasped": grasped,
            "touching": [_plain(one) for one in touching],
            "margins": [_plain(one) for one in margins],
            "enveloping": enveloping,
        }
        where = Path(name)
        entry, _ = validated(data, SceneFile, where)
        for key, points in clouds.items():
            entry.solids[key] = msgspec.structs.replace(entry.solids[key], points=points)
        self._take(entry, where)
        self.name = name

    @classmethod
    def _of_file(cls, path: Path) -> Scene:
        entry, _ = read(path, SceneFile)
        scene = cls.__new__(cls)
        scene._take(entry, path)
        scene.name = entry.name or path.stem
        return scene

    def _take(self, entry: SceneFile, path: Path) -> None:
        self.margin = entry.margin
        self.items: dict[str, Item] = {}
        for name, solid in entry.solids.items():
            where = f"{path}: solids.{name}"
            parts = tuple(solid.solids(where, path.parent))
            entry_there = _located(solid, path.parent)
            item = Item(name, parts, solid.matrix(where), solid.margin, entry_there)
            warn_of_obstacle(*_away_and_size(item), where)
            self.items[name] = item
        self.grasped, self.enveloping = entry.grasped, entry.enveloping
        if entry.grasped is not None and entry.grasped not in self.items:
            known = ", ".join(self.items) or "none"
            raise DescriptionError(
                f"{path}: grasped: unknown solid {entry.grasped!r}; the scene's: {known}"
            )
        self.touching = tuple(Touching(one.links, one.reason) for one in entry.touching)
        self.margins = {frozenset(pair.links): pair.margin for pair in entry.margins}

    def __repr__(self) -> str:
        return f"<Scene {self.name}: {', '.join(self.items) or 'empty'}, margin {self.margin:g} m>"

    def moved(self, name: str, pose: ArrayLike) -> Scene:
        """The scene with an item at another (4, 4) pose.

        Raises:
            UnknownNameError: There is no such item.
            InputError: No pose.

        Example:
            >>> pose = np.eye(4)
            >>> pose[2, 3] = -0.5
            >>> print(ik.load_scene("table").moved("table", pose).items["table"].pose[2, 3])
            -0.5
        """
        if name not in self.items:
            known = ", ".join(self.items) or "none"
            raise UnknownNameError(
                f"scene {self.name!r} has no solid {name!r}; its solids: {known}"
            )
        return self._with(replace(self.items[name], pose=checked_pose(pose, f"pose of {name!r}")))

    def holding(self, name: str, pose: ArrayLike) -> Scene:
        """The scene with an object that is grasped at a (4, 4) pose.

        Args:
            name: Of an item of the scene, of a shipped object, or the path of an object's file or
                mesh, as in ``Grasp.object``.
            pose: Of its frame in the base frame.

        Raises:
            UnknownNameError: Neither.
            InputError: No pose.

        Example:
            >>> scene = ik.load_scene("table").holding("cup", np.eye(4))
            >>> scene.grasped
            'cup'
        """
        place = checked_pose(pose, f"pose of {name!r}")
        known = self.items.get(name)
        parts = known.parts if known else tuple(object_solids(name))
        margin, said = (known.margin, known.entry) if known else (None, ObjectEntry(object=name))
        scene = self._with(Item(name, parts, place, margin, said))
        scene.grasped = name
        return scene

    def text(self) -> str:
        """The scene as a file that `load_scene` reads, everything where it is now.

        Example:
            >>> print(ik.load_scene("table").text().splitlines()[0])
            name: "table"
        """
        lines = [f"name: {json.dumps(self.name)}", f"margin: {self.margin:.9g}"]
        if self.grasped is not None:
            lines.append(f"grasped: {json.dumps(self.grasped)}")
        if self.enveloping:
            lines.append(f"enveloping: {self.enveloping:.9g}")
        for key, rows in (("touching", self.touching), ("margins", self.margins.items())):
            lines += [f"{key}:"] if rows else []
            for row in rows:
                links, value = (row.links, row.reason) if isinstance(row, Touching) else row
                said = {"links": sorted(links), "reason" if key == "touching" else "margin": value}
                lines.append(f"  - {json.dumps(said)}")
        lines += ["solids:"] if self.items else ["solids: {}"]
        for name, item in self.items.items():
            assert item.entry is not None
            there = ("xyz", "rpy", "quaternion_wxyz", "quaternion_xyzw", "pose")
            plain = msgspec.to_builtins(item.entry, enc_hook=_plain)
            kept = {k: v for k, v in plain.items() if k not in there and v is not None}
            said = json.dumps(kept | {"pose": item.pose.tolist()}, ensure_ascii=False)
            lines.append(f"  {json.dumps(name)}: {said}")
        return "\n".join(lines) + "\n"

    def _with(self, item: Item) -> Scene:
        warn_of_obstacle(*_away_and_size(item), f"pose of {item.name!r}")
        scene = Scene.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        scene.items = self.items | {item.name: item}
        return scene


def _away_and_size(item: Item) -> tuple[float, float]:
    """Return the largest distance of an item's solids from the base and their largest size [m]."""
    away = size = 0.0
    for solid, pose in item.parts:
        placed = (item.pose @ pose)[..., :3, :]
        if solid.kind is Kind.HALF_SPACE:  # it has no size, and only its surface is somewhere
            distance = abs(np.sum(placed[..., 2] * placed[..., 3], axis=-1))
            away = max(away, float(np.max(distance)))
            continue
        away = max(away, float(np.linalg.norm(placed[..., 3], axis=-1).max()))
        edges = 2 * solid.size.max() if solid.kind in (Kind.BOX, Kind.CYLINDER) else None
        size = max(size, float(2 * solid.reach if edges is None else edges))
    return away, size


def _located(entry: SolidEntry, folder: Path) -> SolidEntry:
    """The same with whole paths."""
    names = getattr(entry, "file", None)
    if not names:
        return entry
    many = names if isinstance(names, list) else [names]
    whole = [str((folder / Path(name).expanduser()).resolve()) for name in many]
    return msgspec.structs.replace(entry, file=whole if isinstance(names, list) else whole[0])


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a scene.

    Args:
        name_or_path: A shipped name (`shipped_names("scenes")`) or the path of a YAML file.

    Raises:
        UnknownNameError: No shipped scene has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.

    Example:
        >>> ik.load_scene("table")
        <Scene table: table, margin 0 m>
    """
    return Scene._of_file(resolve_description(name_or_path, "scenes"))


def grasped_in(scene: Scene | None) -> str:
    """Name of what is grasped in a scene.

    Raises:
        InputError: There is no scene, or it does not say.
    """
    if scene is None or scene.grasped is None:
        raise InputError("object_pose: found one, expected a scene that says what is 'grasped'")
    return scene.grasped


def _plain(value: Any) -> Any:
    """Nested data with arrays as lists, so that it is read like a file."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
