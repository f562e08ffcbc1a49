"""Scenes: solids with poses and names, margins, and what may be touched."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.collision.hulls import hull, hulls, object_solids
from casadi_ik.collision.point_files import finite_points, read_points
from casadi_ik.collision.scene_file import (
    BoxEntry,
    CapsuleEntry,
    ConvexEntry,
    CylinderEntry,
    HalfSpaceEntry,
    MeshEntry,
    ObjectEntry,
    PointCloudEntry,
    SceneFile,
    SolidEntry,
    SphereEntry,
)
from casadi_ik.collision.solids import (
    Solid,
    box,
    capsule,
    cloud,
    cylinder,
    half_space,
    thinned,
)
from casadi_ik.errors import DescriptionError, InputError, UnknownNameError
from casadi_ik.files.mesh_file import read_mesh
from casadi_ik.files.reading import (
    Frame,
    convert,
    frame_matrix,
    read,
    read_yaml,
    refuse_non_finite,
)
from casadi_ik.files.shipped import resolve
from casadi_ik.files.units import in_si
from casadi_ik.grasps.pose import checked_pose, one_pose, rotations_of
from casadi_ik.grasps.shapes import load_mesh_shape
from casadi_ik.robots.collision import Touching

TURNS = ("rpy", "quaternion_wxyz", "quaternion_xyzw", "pose")
"""How a solid may be turned."""

UNIT = 0.01
"""What a quaternion's length may be off one: it is rounded where it is written down."""

MOST_BALLS = 100_000
"""Of a point cloud."""


@dataclass(frozen=True, eq=False)
class Item:
    """Something that stands in a scene.

    Attributes:
        name: Its name.
        parts: Its solids, each with its (4, 4) pose in the item's frame.
        pose: (4, 4) of the item in the robot's base frame.
        margin: Distance to keep from it [m]; None: the scene's.
    """

    name: str
    parts: tuple[tuple[Solid, Array], ...]
    pose: Array
    margin: float | None = None


class Scene:
    """What stands about a robot, in its base frame.

    Attributes:
        items: What stands there, by name.
        margin: Distance to keep, also between links [m].
        grasped: Name of the item that is grasped: links with a contact may touch it.
        margins: By pair of links or items the distance to keep instead of the scene's or item's
            [m].
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
            name: What to call it.

        Raises:
            DescriptionError: One line that names the key, what was found and what was expected.
        """
        clouds: dict[str, np.ndarray] = {}
        plain: dict[str, Any] = {}
        for key, value in (solids or {}).items():
            plain[key] = value
            if isinstance(value, Mapping) and value.get("kind") == "point-cloud":
                # Arrays of so many numbers, some of them NaN, are looked at as arrays.
                points = value.get("points")
                if isinstance(points, np.ndarray):
                    clouds[key] = points
                    plain[key] = {**value, "points": []}
        data = {
            "solids": {key: _plain(value) for key, value in plain.items()},
            "margin": margin,
            "grasped": grasped,
            "touching": [_plain(one) for one in touching],
            "margins": [_plain(one) for one in margins],
        }
        where = Path(name)
        raw = in_si(data)
        refuse_non_finite(raw, where)
        self._take(convert(raw, SceneFile, where), where, clouds)
        self.name = name

    @classmethod
    def _of_file(cls, path: Path) -> Scene:
        refuse_non_finite(read_yaml(path), path)
        entry, _ = read(path, SceneFile)
        scene = cls.__new__(cls)
        scene._take(entry, path)
        scene.name = entry.name or path.stem
        return scene

    def _take(
        self, entry: SceneFile, path: Path, clouds: Mapping[str, np.ndarray] = MappingProxyType({})
    ) -> None:
        if not entry.margin >= 0:
            raise DescriptionError(f"{path}: margin: found {entry.margin:g}, expected >= 0 m")
        self.margin = entry.margin
        self.items: dict[str, Item] = {}
        for name, solid in entry.solids.items():
            where = f"{path}: solids.{name}"
            if solid.margin is not None and not solid.margin >= 0:
                raise DescriptionError(f"{where}.margin: found {solid.margin:g}, expected >= 0 m")
            parts = tuple(_parts(solid, where, path, clouds.get(name)))
            self.items[name] = Item(name, parts, _pose(solid, where), solid.margin)
        self.grasped = entry.grasped
        if entry.grasped is not None and entry.grasped not in self.items:
            known = ", ".join(self.items) or "none"
            raise DescriptionError(
                f"{path}: grasped: unknown solid {entry.grasped!r}; the scene's: {known}"
            )
        self.touching = tuple(Touching(one.links, one.reason) for one in entry.touching)
        self.margins: dict[frozenset[str], float] = {}
        for i, pair in enumerate(entry.margins):
            if not 0 <= pair.margin < math.inf:
                raise DescriptionError(
                    f"{path}: margins[{i}].margin: found {pair.margin:g}, expected >= 0 m"
                )
            self.margins[frozenset(pair.links)] = pair.margin

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
        scene = self._with(Item(name, parts, place, known.margin if known else None))
        scene.grasped = name
        return scene

    def _with(self, item: Item) -> Scene:
        scene = Scene.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        scene.items = self.items | {item.name: item}
        return scene


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a scene.

    Args:
        name_or_path: A shipped name (`shipped_names("scenes")`) or the path of a YAML file.

    Raises:
        UnknownNameError: No shipped scene has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.
        MissingExtraError: It has a mesh, and what builds hulls is not installed.

    Example:
        >>> ik.load_scene("table")
        <Scene table: table, margin 0 m>
    """
    return Scene._of_file(resolve(name_or_path, "scenes"))


def grasped_in(scene: Scene | None) -> str:
    """Name of what is grasped in a scene.

    Raises:
        InputError: There is no scene, or it does not say.
    """
    if scene is None or scene.grasped is None:
        raise InputError("object_pose: found one, expected a scene that says what is 'grasped'")
    return scene.grasped


def _pose(entry: SolidEntry, where: str) -> Array:
    """(4, 4) of a solid; how it is turned may be said in one of four ways."""
    turns = [key for key in TURNS if getattr(entry, key) is not None]
    if entry.pose is not None and entry.xyz is not None:
        turns.append("xyz")
    if len(turns) > 1:
        raise DescriptionError(f"{where}: found {' and '.join(turns)}, expected one of them")
    if entry.pose is not None:
        try:
            return one_pose(entry.pose, f"{where}.pose")
        except InputError as error:
            raise DescriptionError(str(error)) from error
    pose = frame_matrix(Frame(entry.xyz or (0.0, 0.0, 0.0), entry.rpy or (0.0, 0.0, 0.0)))
    for key, shift in (("quaternion_wxyz", 0), ("quaternion_xyzw", 1)):
        given = getattr(entry, key)
        if given is not None:
            length = math.hypot(*given)
            if abs(length - 1) > UNIT:
                raise DescriptionError(f"{where}.{key}: found length {length:g}, expected 1")
            pose[:3, :3] = rotations_of(np.roll(given, shift)[None])[0]
    return pose


def _parts(
    entry: SolidEntry, where: str, path: Path, points: np.ndarray | None
) -> list[tuple[Solid, Array]]:
    here = np.eye(4)
    for key in ("size", "radius", "length", "scale"):
        value = getattr(entry, key, 1.0)
        least = min(value) if isinstance(value, tuple) else value
        if not 0 < least < math.inf and not (isinstance(entry, CapsuleEntry) and key == "length"):
            raise DescriptionError(f"{where}.{key}: found {value}, expected > 0")
    match entry:
        case BoxEntry():
            return [(box(entry.size), here)]
        case SphereEntry():
            return [(capsule(entry.radius, 0.0), here)]
        case CylinderEntry():
            return [(cylinder(entry.radius, entry.length), here)]
        case CapsuleEntry():
            if not entry.length >= 0:
                raise DescriptionError(f"{where}.length: found {entry.length}, expected >= 0")
            return [(capsule(entry.radius, entry.length / 2), here)]
        case HalfSpaceEntry():
            return [(half_space(), here)]
        case ConvexEntry():
            return [(hull(np.array(entry.points, dtype=float), f"{where}.points"), here)]
        case MeshEntry():
            return _meshes(entry, f"{where}.file", path)
        case PointCloudEntry():
            return _cloud(entry, where, path, points)
        case ObjectEntry():
            try:
                return object_solids(entry.object)
            except (UnknownNameError, DescriptionError) as error:
                raise DescriptionError(f"{where}.object: {error}") from error


def _meshes(entry: MeshEntry, where: str, path: Path) -> list[tuple[Solid, Array]]:
    names = [entry.file] if isinstance(entry.file, str) else entry.file
    if not names:
        raise DescriptionError(f"{where}: found none, expected at least one")
    files = [_beside(path, name) for name in names]
    if entry.parts:
        return hulls(load_mesh_shape(files, entry.scale, where), where)
    return [(hull(entry.scale * read_mesh(file, where)[0], where), np.eye(4)) for file in files]


def _beside(path: Path, file: str) -> Path:
    found = Path(file).expanduser()
    return found if found.is_absolute() else path.parent / found


def _cloud(
    entry: PointCloudEntry, where: str, path: Path, points: np.ndarray | None
) -> list[tuple[Solid, Array]]:
    given = points is not None or bool(entry.points)
    if given == bool(entry.file):
        raise DescriptionError(f"{where}: expected a point cloud's file or its points")
    if entry.file:
        found = entry.scale * read_points(_beside(path, entry.file), f"{where}.file")
    else:
        array = np.array(entry.points, dtype=float) if points is None else points
        found = finite_points(array, f"{where}.points")
    if not 0 <= entry.voxel < math.inf:
        raise DescriptionError(f"{where}.voxel: found {entry.voxel:g}, expected >= 0 m")
    wider = 0.0
    if entry.voxel > 0:
        found, wider = thinned(found, entry.voxel)
    if len(found) > MOST_BALLS:
        raise DescriptionError(
            f"{where}: found {len(found)} points, expected at most {MOST_BALLS} (see 'voxel')"
        )
    return cloud(found, entry.radius + wider)


def _plain(value: Any) -> Any:
    """Nested data with arrays as lists, so that it is read like a file."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
