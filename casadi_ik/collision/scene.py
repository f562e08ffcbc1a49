"""Scenes: the obstacles around a robot, with margins and pairs that may touch."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.scene_file import ObjectEntry, SceneFile, SolidEntry
from casadi_ik.collision.solids import Kind, PosedSolid, object_solids
from casadi_ik.errors import DescriptionError, InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_mapping, single_pose, warn_of_obstacle
from casadi_ik.files.reading import read, validated
from casadi_ik.files.shipped import resolve_description
from casadi_ik.model.link_shapes import Touching


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An obstacle of a scene, or the object that is grasped in it.

    Attributes:
        name: Name in the scene.
        parts: Solids with their (4, 4) poses in the frame of the obstacle.
        pose: (4, 4) pose in the robot's base frame.
        margin: Margin [m]; None: that of the scene.
        entry: Entry of a scene file, with absolute paths.
    """

    name: str
    parts: tuple[PosedSolid, ...]
    pose: Array
    margin: float | None = None
    entry: SolidEntry | None = None


class Scene:
    """Obstacles around a robot, in its base frame.

    Attributes:
        items: Obstacles by name.
        margin: Margin, also between links [m].
        grasped: Name of the grasped obstacle, which links with a contact may touch.
        margins: Margins by pair of links or obstacles, which override those of obstacles and scene
            [m].
        enveloping: Largest penetration between the shapes of the fingers' links and the grasped
            obstacle [m].
        touching: Links that may touch an obstacle or each other, with the reason.
        name: Name of the scene.

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
        """Create a scene; without obstacles only self-collisions are checked.

        Args:
            solids: Obstacles by name, as in a scene file: ``{"table": {"kind": "box",
                "size": [1, 1, 0.04], "xyz": [0.6, 0, -0.02]}}``.
            margin: Margin, also between links [m].
            grasped: Name of the grasped obstacle.
            touching: Pairs that may touch: ``{"links": [LINK, OBSTACLE], "reason": TEXT}``.
            margins: Margins of pairs [m]: ``{"links": [LINK, OBSTACLE], "margin": 0.01}``.
            enveloping: Largest penetration between the shapes of the fingers' links and the grasped
                obstacle [m]; 0: only fingertips may touch it.
            name: Name of the scene.

        Raises:
            DescriptionError: A value is invalid; the message names its key.
        """
        solids = checked_mapping({} if solids is None else solids, "solids", "from names to solids")
        if not isinstance(name, str):
            raise InputError(f"name: found {name!r}, expected text")
        # Large arrays of points, which may contain NaN, bypass the validation of nested lists.
        clouds = {
            key: value["points"]
            for key, value in solids.items()
            if isinstance(value, Mapping)
            and value.get("kind") == "point-cloud"
            and isinstance(value.get("points"), np.ndarray)
        }
        data = {
            "solids": {
                key: _with_lists({**value, "points": []} if key in clouds else value)
                for key, value in solids.items()
            },
            "margin": margin,
            "grasped": grasped,
            "touching": [_with_lists(pair) for pair in touching],
            "margins": [_with_lists(pair) for pair in margins],
            "enveloping": enveloping,
        }
        path = Path(name)
        file, _ = validated(data, SceneFile, path)
        for key, points in clouds.items():
            file.solids[key] = msgspec.structs.replace(file.solids[key], points=points)
        self._set_contents(file, path)
        self.name = name

    @classmethod
    def _from_path(cls, path: Path) -> Scene:
        file, _ = read(path, SceneFile)
        scene = cls.__new__(cls)
        scene._set_contents(file, path)
        scene.name = file.name or path.stem
        return scene

    def _set_contents(self, file: SceneFile, path: Path) -> None:
        self.margin = file.margin
        self.items: dict[str, Obstacle] = {}
        for name, entry in file.solids.items():
            location = f"{path}: solids.{name}"
            parts = tuple(entry.solids(location, path.parent))
            absolute_entry = _with_absolute_paths(entry, path.parent)
            pose = entry.matrix(location)
            obstacle = Obstacle(name, parts, pose, entry.margin, absolute_entry)
            warn_of_obstacle(*_distance_and_size(obstacle), location)
            self.items[name] = obstacle
        self.grasped, self.enveloping = file.grasped, file.enveloping
        if file.grasped is not None and file.grasped not in self.items:
            raise DescriptionError(
                f"{path}: grasped: obstacle {file.grasped!r} is unknown; "
                f"expected one of: {_name_list(self.items)}"
            )
        self.touching = tuple(Touching(pair.links, pair.reason) for pair in file.touching)
        self.margins = {frozenset(pair.links): pair.margin for pair in file.margins}

    def __repr__(self) -> str:
        return f"<Scene {self.name}: {', '.join(self.items) or 'empty'}, margin {self.margin:g} m>"

    def moved(self, name: str, pose: ArrayLike) -> Scene:
        """Return the scene with an obstacle at another (4, 4) pose.

        Raises:
            UnknownNameError: The scene has no obstacle of this name.
            InputError: The pose is invalid.

        Example:
            >>> pose = np.eye(4)
            >>> pose[2, 3] = -0.5
            >>> print(ik.load_scene("table").moved("table", pose).items["table"].pose[2, 3])
            -0.5
        """
        if name not in self.items:
            raise UnknownNameError(
                f"scene {self.name!r} has no obstacle {name!r}; "
                f"expected one of: {_name_list(self.items)}"
            )
        pose = single_pose(pose, f"pose of {name!r}")
        return self._with_obstacle(replace(self.items[name], pose=pose))

    def holding(self, name: str, pose: ArrayLike) -> Scene:
        """Return the scene with a grasped object at a (4, 4) pose.

        Args:
            name: Name of an obstacle of the scene or of a shipped object, or the path of an object
                file or mesh, as in ``Grasp.object``.
            pose: (4, 4) pose of the object in the base frame.

        Raises:
            UnknownNameError: Neither an obstacle nor a shipped object has this name.
            InputError: The pose is invalid.

        Example:
            >>> scene = ik.load_scene("table").holding("cup", np.eye(4))
            >>> scene.grasped
            'cup'
        """
        pose = single_pose(pose, f"pose of {name!r}")
        if name in self.items:
            obstacle = replace(self.items[name], pose=pose)
        else:
            obstacle = Obstacle(
                name, tuple(object_solids(name)), pose, entry=ObjectEntry(object=name)
            )
        scene = self._with_obstacle(obstacle)
        scene.grasped = name
        return scene

    def text(self) -> str:
        """Return the scene as the text of a scene file, with the current poses.

        Example:
            >>> print(ik.load_scene("table").text().splitlines()[0])
            name: "table"
        """
        lines = [f"name: {json.dumps(self.name)}", f"margin: {self.margin:.9g}"]
        if self.grasped is not None:
            lines.append(f"grasped: {json.dumps(self.grasped)}")
        if self.enveloping:
            lines.append(f"enveloping: {self.enveloping:.9g}")
        touching = [{"links": sorted(pair.links), "reason": pair.reason} for pair in self.touching]
        margins = [{"links": sorted(links), "margin": m} for links, m in self.margins.items()]
        for key, rows in (("touching", touching), ("margins", margins)):
            lines += [f"{key}:"] if rows else []
            lines += [f"  - {json.dumps(row)}" for row in rows]
        lines += ["solids:"] if self.items else ["solids: {}"]
        pose_keys = ("xyz", "rpy", "quaternion_wxyz", "quaternion_xyzw", "pose")
        for name, obstacle in self.items.items():
            assert obstacle.entry is not None
            values = msgspec.to_builtins(obstacle.entry, enc_hook=_with_lists)
            values = {k: v for k, v in values.items() if k not in pose_keys and v is not None}
            values["pose"] = obstacle.pose.tolist()
            lines.append(f"  {json.dumps(name)}: {json.dumps(values, ensure_ascii=False)}")
        return "\n".join(lines) + "\n"

    def _with_obstacle(self, obstacle: Obstacle) -> Scene:
        warn_of_obstacle(*_distance_and_size(obstacle), f"pose of {obstacle.name!r}")
        scene = Scene.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        scene.items = self.items | {obstacle.name: obstacle}
        return scene


def _name_list(names: Iterable[str]) -> str:
    """Return names as a list for messages."""
    return ", ".join(names) or "none"


def _distance_and_size(obstacle: Obstacle) -> tuple[float, float]:
    """Return the largest distance of the solids from the base and their largest size [m]."""
    distance = size = 0.0
    for solid, pose in obstacle.parts:
        base_pose = (obstacle.pose @ pose)[..., :3, :]
        if solid.kind is Kind.HALF_SPACE:  # only the distance of its surface is finite
            depth = abs(np.sum(base_pose[..., 2] * base_pose[..., 3], axis=-1))
            distance = max(distance, float(np.max(depth)))
            continue
        distance = max(distance, float(np.linalg.norm(base_pose[..., 3], axis=-1).max()))
        edges = 2 * solid.size.max() if solid.kind in (Kind.BOX, Kind.CYLINDER) else None
        size = max(size, float(2 * solid.reach if edges is None else edges))
    return distance, size


def _with_absolute_paths(entry: SolidEntry, folder: Path) -> SolidEntry:
    """Return an entry whose relative paths start from a folder with absolute paths."""
    file = getattr(entry, "file", None)
    if not file:
        return entry
    names = file if isinstance(file, list) else [file]
    paths = [str((folder / Path(name).expanduser()).resolve()) for name in names]
    return msgspec.structs.replace(entry, file=paths if isinstance(file, list) else paths[0])


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
    return Scene._from_path(resolve_description(name_or_path, "scenes"))


def grasped_in(scene: Scene | None) -> str:
    """Return the name of the grasped obstacle of a scene.

    Raises:
        InputError: There is no scene, or nothing is grasped in it.
    """
    if scene is None or scene.grasped is None:
        raise InputError("object_pose: no object is grasped; expected a scene with 'grasped'")
    return scene.grasped


def _with_lists(value: Any) -> Any:
    """Return nested data with lists instead of arrays, as a file would contain it."""
    if isinstance(value, Mapping):
        return {str(key): _with_lists(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_with_lists(item) for item in value]
    return str(value) if isinstance(value, Path) else value
