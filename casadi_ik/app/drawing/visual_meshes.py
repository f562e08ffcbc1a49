"""Visual meshes of robots: from their own files, or from packages that are installed.

Built-in robots have no mesh files. The table `models/viewer/visual_meshes.yaml` names the
descriptions of the same robots in other packages. A package is used if it is installed; nothing is
imported from it, and nothing is fetched. The links of both descriptions are matched by their
joints, and forward kinematics at random configurations decide whether the match is right: a
description whose links move by more than `MAX_DEVIATION` relative to those of the robot is not
used.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from casadi_ik.app.drawing.surfaces import decimate, join_surfaces
from casadi_ik.compile import cache_directory
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.arrays import Array
from casadi_ik.files.number_files import READ_ERRORS
from casadi_ik.files.reading import read, read_yaml
from casadi_ik.files.shipped import models_folder
from casadi_ik.files.writing import atomic_write
from casadi_ik.integrations.importing.meshes import ColoredMesh, IndexedMesh, link_mesh_parts
from casadi_ik.integrations.importing.robot_import import read_referenced_tree
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import chain_to, link_poses
from casadi_ik.model.parts import HAND_PREFIX
from casadi_ik.model.pose import inverse
from casadi_ik.model.urdf_mjcf import read_tree
from casadi_ik.model.xml_tree import RobotTree

logger = logging.getLogger(__name__)

MAX_DEVIATION = 1e-3
"""Largest motion of a matched link relative to the robot's link, `LEVER` from its origin [m]."""

LEVER = 0.2
"""Distance from a link's origin at which a rotation counts as a displacement [m]."""

CONFIGURATION_COUNT = 8
"""Number of random configurations at which two descriptions are compared."""

MAX_LINK_TRIANGLES = 4000
"""Number of triangles to which the meshes of a link are reduced."""

MeshesByLink = Mapping[str, tuple[ColoredMesh, ...]]


class PackageEntry(Struct, frozen=True):
    """A package that contains descriptions of robots.

    Attributes:
        folder: Folder of the descriptions, relative to the folder of installed packages.
        clones: Further folders that may hold them, such as the cache of `robot_descriptions`; "~"
            is the home folder.
    """

    folder: str
    clones: list[str] = []


class VisualMeshEntry(Struct, frozen=True):
    """The description of a robot in a package.

    Attributes:
        package: Name of the package.
        file: URDF or MJCF, relative to the folder of the package.
        licence: Licence of the meshes.
        base: Link of the file by link of the robot with the same frame. Fixed links of the robot
            that are one link of the file are listed one by one; the last one carries its meshes.
        joints: Joint of the file by joint of the robot. A minus sign before the name reverses the
            direction.
        extra: Links of the file that are drawn as well, with the nearest matched link.
    """

    package: str
    file: str
    licence: str
    base: dict[str, str]
    joints: dict[str, str]
    extra: list[str] = []


class MeshTable(Struct, frozen=True):
    """The content of `models/viewer/visual_meshes.yaml`.

    Attributes:
        packages: Packages by their names on the index.
        robots: Descriptions by robot, the preferred one of a robot first.
    """

    packages: dict[str, PackageEntry]
    robots: dict[str, list[VisualMeshEntry]]


@dataclass(frozen=True, eq=False)
class VisualMeshes:
    """The visual meshes of a robot.

    Attributes:
        by_link: Meshes by link, in its frame.
        covered_links: Links that are drawn by meshes, including those without a mesh.
        origins: Package and licence of each description from which meshes were read.
    """

    by_link: MeshesByLink = field(default_factory=dict)
    covered_links: frozenset[str] = frozenset()
    origins: tuple[tuple[str, str], ...] = ()


@lru_cache(maxsize=16)
def visual_meshes(description: RobotDescription) -> VisualMeshes:
    """Return the visual meshes of a robot, reduced for drawing.

    They are those of the files that the description refers to, otherwise those of installed
    packages. Problems with files are logged: a robot can be drawn without meshes.
    """
    try:
        meshes = {} if description.path is None else file_mesh_parts(description, visual=True)
    except CasadiIKError as error:
        logger.info("no meshes of %s: %s", description.name, error)
        return VisualMeshes()
    if meshes:
        reduced = {link: reduced_parts(parts) for link, parts in meshes.items()}
        is_hand = {joint.child: joint.part == "hand" for joint in description.joints}
        parts_drawn = {is_hand.get(link, False) for link in meshes}
        links = {link for link in description.links if is_hand.get(link, False) in parts_drawn}
        return VisualMeshes(reduced, frozenset(links))
    return package_meshes(description, mesh_table())


def file_mesh_parts(
    description: RobotDescription, visual: bool = False
) -> dict[str, list[ColoredMesh]]:
    """Return the meshes of the files that a description refers to.

    Args:
        description: Description that was read from a file.
        visual: Read the visual meshes instead of the collision meshes.

    Returns:
        Meshes by link, in the frame of the link; links without a mesh are omitted.

    Raises:
        CasadiIKError: A file cannot be read.
    """
    path = description.path
    assert path is not None
    raw, links = read_yaml(path), set(description.links)
    meshes: dict[str, list[ColoredMesh]] = {}
    for key in ("arm", "hand", "robot"):
        entry = raw.get(key)
        if not isinstance(entry, dict) or "file" not in entry:
            continue
        prefix = HAND_PREFIX if key == "hand" else ""
        # The hand's links are prefixed where arm and hand have a name in common.
        link_names = {link.removeprefix(prefix) if prefix else link: link for link in links}
        link_names |= {link: link for link in links if f"{prefix}{link}" not in links or not prefix}
        parts_by_link, _ = link_mesh_parts(
            read_referenced_tree(path, entry), list(link_names), visual
        )
        for link, parts in parts_by_link.items():
            meshes.setdefault(link_names[link], parts)
    return {
        link: parts for link, parts in meshes.items() if any(len(p.mesh.triangles) for p in parts)
    }


def mesh_table() -> MeshTable:
    """Return the table of descriptions in other packages."""
    return read(models_folder() / "viewer" / "visual_meshes.yaml", MeshTable)[0]


def package_meshes(description: RobotDescription, table: MeshTable) -> VisualMeshes:
    """Return the visual meshes of a robot, or of parts of it, that installed packages contain."""
    by_link: dict[str, tuple[ColoredMesh, ...]] = {}
    covered: set[str] = set()
    origins: list[tuple[str, str]] = []
    for entries in table.robots.values():
        for entry, prefix in _candidates(description, entries):
            new_links = _covered_links(description, entry, prefix) - covered
            path = find_file(table.packages[entry.package], entry)
            if path is None or not new_links:
                continue
            try:
                meshes = _entry_meshes(description, entry, prefix, path)
            except CasadiIKError as error:
                logger.info("meshes of %s are not used: %s", path, error)
                continue
            if meshes:
                by_link |= {link: parts for link, parts in meshes.items() if link in new_links}
                covered |= new_links
                origins.append((entry.package, entry.licence))
    return VisualMeshes(by_link, frozenset(covered), tuple(dict.fromkeys(origins)))


def find_file(package: PackageEntry, entry: VisualMeshEntry) -> Path | None:
    """Return the description of a robot in a package; None if it is not installed."""
    folders = [Path(clone).expanduser() for clone in package.clones]
    with suppress(metadata.PackageNotFoundError):
        distribution = metadata.distribution(entry.package)
        folders.insert(0, Path(str(distribution.locate_file(package.folder))))
    files = (folder / entry.file for folder in folders)
    return next((file for file in files if file.is_file()), None)


def _candidates(
    description: RobotDescription, entries: list[VisualMeshEntry]
) -> Iterator[tuple[VisualMeshEntry, str]]:
    """Return the entries whose joints the robot has, with the prefix of the robot's names."""
    for entry in entries:
        first = next(iter(entry.joints))
        names = [name for name in description.joint_names if name.endswith(first)]
        for prefix in [name.removesuffix(first) for name in names]:
            has_joints = {prefix + name for name in entry.joints} <= set(description.joint_names)
            if has_joints and {prefix + link for link in entry.base} <= set(description.links):
                yield entry, prefix


def _covered_links(description: RobotDescription, entry: VisualMeshEntry, prefix: str) -> set[str]:
    """Return the links of the robot that an entry draws."""
    names = {prefix + name for name in entry.joints}
    children = {joint.child for joint in description.movable if joint.name in names}
    return children | {prefix + link for link in entry.base}


def _entry_meshes(
    description: RobotDescription, entry: VisualMeshEntry, prefix: str, path: Path
) -> MeshesByLink:
    """Return the meshes of a description at the links of the robot; empty if they do not fit."""
    key = _cache_key(description, entry, prefix, path)
    cached = _read_cache(key)
    if cached is not None:
        return cached
    tree = read_tree(path)
    joints = {joint.name: joint for joint in description.movable}
    matches = {prefix + ours: theirs.lstrip("-") for ours, theirs in entry.joints.items()}
    links = {theirs: prefix + ours for ours, theirs in entry.base.items()} | {
        tree.by_name[tree.require_joint(theirs, str(path))].child: joints[ours].child
        for ours, theirs in matches.items()
    }
    offsets, deviation = _compare(description, tree, entry, prefix, links)
    if deviation > MAX_DEVIATION:
        logger.info("meshes of %s are not used: links differ by %.1f mm", path, 1e3 * deviation)
        return {}
    carriers = _carriers(tree, entry, links)
    files_parts, messages = link_mesh_parts(tree, list(carriers), visual=True)
    for message in messages:
        logger.info("%s", message)
    parts_by_link: dict[str, list[ColoredMesh]] = {}
    for link, parts in files_parts.items():
        carrier, pose = carriers[link]
        placed = [part.transformed(offsets[carrier] @ pose) for part in parts]
        parts_by_link.setdefault(links[carrier], []).extend(placed)
    meshes = {link: reduced_parts(parts) for link, parts in parts_by_link.items()}
    _write_cache(key, meshes)
    return meshes


def _compare(
    description: RobotDescription,
    tree: RobotTree,
    entry: VisualMeshEntry,
    prefix: str,
    links: Mapping[str, str],
) -> tuple[dict[str, Array], float]:
    """Return the poses of links of a file in links of the robot, and their largest change [m]."""
    rng = np.random.default_rng(0)
    ours, theirs = {}, {}
    for joint in description.movable:
        low, high = max(joint.lower, -np.pi), min(joint.upper, np.pi)
        ours[joint.name] = np.concatenate([[0.0], rng.uniform(low, high, CONFIGURATION_COUNT)])
    for name, file_name in entry.joints.items():
        sign = -1.0 if file_name.startswith("-") else 1.0
        theirs[file_name.lstrip("-")] = sign * ours[prefix + name]
    our_poses = link_poses(description.root, description.joints, ours)
    their_poses = link_poses(tree.root, tree.joints, theirs)
    base = next(iter(entry.base.values()))
    to_file, to_base = inverse(our_poses[links[base]]), inverse(their_poses[base])
    offsets, deviation = {}, 0.0
    for link, our_link in links.items():
        relative = inverse(to_file @ our_poses[our_link]) @ to_base @ their_poses[link]
        relative = np.broadcast_to(relative, (CONFIGURATION_COUNT + 1, 4, 4))
        change = np.linalg.norm(relative - relative[0], axis=1)
        deviation = max(deviation, float((change * [LEVER, LEVER, LEVER, 1.0]).max()))
        offsets[link] = relative[0]
    return offsets, deviation


def _carriers(
    tree: RobotTree, entry: VisualMeshEntry, links: Mapping[str, str]
) -> dict[str, tuple[str, Array]]:
    """Return the matched link that carries each link drawn, and its (4, 4) pose in that link."""
    poses, base = link_poses(tree.root, tree.joints, {}), next(iter(entry.base.values()))
    carriers: dict[str, tuple[str, Array]] = {link: (link, np.eye(4)) for link in links}
    for link in entry.extra:
        tree.require_link(link, str(tree.path))
        ancestors = [joint.parent for joint in chain_to(tree, link)]
        carrier = next((name for name in reversed(ancestors) if name in links), base)
        carriers[link] = carrier, inverse(poses[carrier]) @ poses[link]
    return carriers


def reduced_parts(parts: list[ColoredMesh]) -> tuple[ColoredMesh, ...]:
    """Return the meshes of a link, one per colour, with about `MAX_LINK_TRIANGLES` in total."""
    by_color: dict[str, list[IndexedMesh]] = {}
    for part in parts:
        by_color.setdefault(part.color, []).append(part.mesh)
    meshes = {color: join_surfaces(surfaces) for color, surfaces in by_color.items()}
    count = sum(len(mesh.triangles) for mesh in meshes.values())
    share = min(1.0, MAX_LINK_TRIANGLES / max(count, 1))
    return tuple(
        ColoredMesh(decimate(mesh, max(int(share * len(mesh.triangles)), 60)), color)
        for color, mesh in meshes.items()
        if len(mesh.triangles)
    )


# Cache. Reading and reducing the meshes of a robot takes seconds.


def _cache_key(
    description: RobotDescription, entry: VisualMeshEntry, prefix: str, path: Path
) -> str:
    """Return a hash of everything that the meshes of an entry depend on."""
    stamps = sorted(
        (str(file), file.stat().st_size, file.stat().st_mtime_ns)
        for file in path.parents[1].rglob("*")
        if file.is_file()
    )
    placements = [joint.placement.tobytes() for joint in description.joints]
    content = (stamps, entry, prefix, description.joints, placements, MAX_LINK_TRIANGLES)
    return hashlib.sha256(repr(content).encode()).hexdigest()


def _read_cache(key: str) -> MeshesByLink | None:
    """Return the meshes of a key; None if they are not in the cache."""
    meshes: dict[str, list[ColoredMesh]] = {}
    try:
        with np.load(_cache_file(key), allow_pickle=False) as archive:
            for link, color, number in zip(
                archive["links"], archive["colors"], range(len(archive["links"])), strict=True
            ):
                mesh = IndexedMesh(archive[f"points_{number}"], archive[f"triangles_{number}"])
                meshes.setdefault(str(link), []).append(ColoredMesh(mesh, str(color)))
    except (OSError, KeyError, *READ_ERRORS):
        return None
    return {link: tuple(parts) for link, parts in meshes.items()}


def _write_cache(key: str, meshes: MeshesByLink) -> None:
    """Store meshes, if the cache folder can be written."""
    rows = [(link, part) for link, parts in meshes.items() for part in parts]
    arrays: dict[str, Any] = {"links": np.array([link for link, _ in rows])}
    arrays["colors"] = np.array([part.color for _, part in rows])
    for number, (_, part) in enumerate(rows):
        arrays[f"points_{number}"] = part.mesh.points.astype(np.float32)
        arrays[f"triangles_{number}"] = part.mesh.triangles.astype(np.int32)
    with suppress(OSError):
        file = _cache_file(key)
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, **arrays)


def _cache_file(key: str) -> Path:
    return cache_directory() / "meshes" / f"{key[:32]}.npz"
