"""Visual meshes of robots: from their own files, or from packages and repositories.

Built-in robots have no mesh files. The table `models/viewer/visual_meshes.yaml` names the
descriptions of the same robots in other packages and repositories. A package is used if it is
installed, a repository if it was fetched (`casadi-ik meshes --fetch`); nothing is imported from
them, and nothing is fetched without a request. The links of both descriptions are matched by their
joints, and forward kinematics at random configurations decide whether the match is right: a
description whose links move by more than `MAX_DEVIATION` relative to those of the robot is not
used. `CASADI_IK_MESHES=off` in the environment disables all visual meshes.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.app.drawing import MESHES_VARIABLE, palette
from casadi_ik.app.drawing.mesh_table import (
    HullEntry,
    MeshTable,
    PlacedMeshEntry,
    VisualMeshEntry,
    candidates,
    covered_links,
    find_file,
    mesh_table,
    prefixes,
)
from casadi_ik.app.drawing.surfaces import SEGMENTS, convex_hull, decimate, join_surfaces
from casadi_ik.compile import cache_directory
from casadi_ik.errors import CasadiIKError
from casadi_ik.files.arrays import Array
from casadi_ik.files.number_files import READ_ERRORS, read_mesh_parts
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
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

MAX_DEVIATION = 2e-3
"""Largest motion of a matched link relative to the robot's link, `LEVER` from its origin [m]."""

LEVER = 0.2
"""Distance from a link's origin at which a rotation counts as a displacement [m]."""

CONFIGURATION_COUNT = 8
"""Number of random configurations at which two descriptions are compared."""

MAX_LINK_TRIANGLES = 4000
"""Number of triangles to which the meshes of a link are reduced."""

DARKEST = 56
"""Smallest value of the brightest channel of a drawn colour, 0 to 255."""

UPRIGHT = {"x": (0.0, np.pi / 2, 0.0), "y": (np.pi / 2, 0.0, 0.0), "z": (0.0, 0.0, 0.0)}
"""Roll, pitch and yaw [rad] that rotate z to an axis, up to its sign."""

ANGLES = np.linspace(0.0, 2 * np.pi, SEGMENTS, endpoint=False)
UNIT_CIRCLE = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
"""(SEGMENTS, 2) Points of a circle."""

MeshesByLink = Mapping[str, tuple[ColoredMesh, ...]]


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


def visual_meshes(description: RobotDescription) -> VisualMeshes:
    """Return the visual meshes of a robot, reduced for drawing; none if they are disabled.

    They are those of the files that the description refers to, otherwise those of installed
    packages and fetched repositories. Problems with files are logged: a robot can be drawn without
    meshes.
    """
    return (
        VisualMeshes() if os.environ.get(MESHES_VARIABLE) == "off" else _visual_meshes(description)
    )


@lru_cache(maxsize=16)
def _visual_meshes(description: RobotDescription) -> VisualMeshes:
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


def package_meshes(description: RobotDescription, table: MeshTable) -> VisualMeshes:
    """Return the visual meshes of a robot, or of parts of it, that packages contain."""
    by_link: dict[str, tuple[ColoredMesh, ...]] = {}
    covered: set[str] = set()
    origins: list[tuple[str, str]] = []
    for entries in table.robots.values():
        for entry, prefix in candidates(description, entries):
            new_links = covered_links(description, entry, prefix) - covered
            path = find_file(entry.package, table, entry)
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
    for hulls in table.hulls.values():
        for prefix in prefixes(description, list(hulls)):
            links = {prefix + link: entries for link, entries in hulls.items()}
            if not covered & set(links):
                by_link |= {link: tuple(map(hull_mesh, links[link])) for link in links}
                covered |= set(links)
    return VisualMeshes(by_link, frozenset(covered), tuple(dict.fromkeys(origins)))


def hull_mesh(entry: HullEntry) -> ColoredMesh:
    """Return the convex hull of circles."""
    points = [
        frame_matrix(Frame(circle.xyz, UPRIGHT[circle.axis]))
        @ np.array([circle.radius * x, circle.radius * y, 0.0, 1.0])
        for circle in entry.circles
        for x, y in UNIT_CIRCLE
    ]
    return ColoredMesh(convex_hull(np.array(points)[:, :3]), entry.color)


def _entry_meshes(
    description: RobotDescription, entry: VisualMeshEntry, prefix: str, path: Path
) -> MeshesByLink:
    """Return the meshes of a description at the links of the robot; empty if they do not fit."""
    key = _cache_key(description, entry, prefix, path)
    cached = _read_cache(key)
    if cached is not None:
        return cached
    if entry.meshes:
        root = path.parents[len(Path(entry.all_files[0]).parts) - 1]
        meshes = {
            prefix + link: reduced_parts(
                [part for file in files for part in _posed_parts(root, file)]
            )
            for link, files in entry.meshes.items()
        }
        _write_cache(key, meshes)
        return meshes
    tree = read_tree(path)
    joints = {joint.name: joint for joint in description.joints}
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


def _posed_parts(root: Path, entry: PlacedMeshEntry) -> list[ColoredMesh]:
    """Return the meshes of a file in the frame of a link."""
    pose = frame_matrix(Frame(entry.xyz, entry.rpy))
    parts = read_mesh_parts(root / entry.file, str(root / entry.file))
    return [
        ColoredMesh(
            IndexedMesh(part.points, part.triangles), part.color or entry.color
        ).transformed(pose)
        for part in parts
    ]


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
        theirs[file_name.lstrip("-")] = sign * ours.get(prefix + name, 0.0) + entry.zeros.get(
            name, 0.0
        )
    our_poses = link_poses(description.root, description.joints, ours)
    their_poses = link_poses(tree.root, tree.joints, theirs)
    base = next(iter(entry.base.values()))
    to_file = inverse(our_poses[links[base]])
    to_base = frame_matrix(Frame(entry.xyz, entry.rpy)) @ inverse(their_poses[base])
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
        by_color.setdefault(visible_color(part.color), []).append(part.mesh)
    meshes = {color: join_surfaces(surfaces) for color, surfaces in by_color.items()}
    count = sum(len(mesh.triangles) for mesh in meshes.values())
    share = min(1.0, MAX_LINK_TRIANGLES / max(count, 1))
    return tuple(
        ColoredMesh(decimate(mesh, max(int(share * len(mesh.triangles)), 60)), color)
        for color, mesh in meshes.items()
        if len(mesh.triangles)
    )


def visible_color(color: str) -> str:
    """Return a colour bright enough for shading: black has no darker side."""
    if not color:
        return ""
    channels = palette.rgb(color)
    added = max(0, DARKEST - max(channels))
    return "#{:02x}{:02x}{:02x}".format(*(channel + added for channel in channels))


# Cache. Reading and reducing the meshes of a robot takes seconds.


def _cache_key(
    description: RobotDescription, entry: VisualMeshEntry, prefix: str, path: Path
) -> str:
    """Return a hash of everything that the meshes of an entry depend on."""
    folder = path.parents[1] if path.parent.name in ("urdf", "robots") else path.parent
    stamps = sorted(
        (str(file), file.stat().st_size, file.stat().st_mtime_ns)
        for file in folder.rglob("*")
        if file.is_file()
    )
    placements = [joint.placement.tobytes() for joint in description.joints]
    content = (stamps, entry, prefix, description.joints, placements, MAX_LINK_TRIANGLES, DARKEST)
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
