"""Objects that a URDF describes: its meshes and simple shapes as one body."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import MESH_FORMATS, read_mesh
from casadi_ik.model.sandbox import package_folders
from casadi_ik.model.xml_tree import origin_pose, parse_numbers, parse_xml, read_robot_file

BODY_FORMATS = (*MESH_FORMATS, ".urdf")
"""File name extensions of bodies bounded by triangles."""

Triangles = tuple[Array, NDArray[np.int64]]


def read_body(path: Path, location: str) -> Triangles:
    """Return the vertices (k, 3) and triangles (t, 3) of a mesh file or a URDF.

    Args:
        path: A mesh, or a URDF whose visual geometry is read, or its collision geometry if it has
            no visual one. Movable joints are at zero; the frame is that of the root link.
        location: File and key that name it, for messages.

    Raises:
        DescriptionError: The file does not exist, is damaged, or has no geometry.
    """
    if path.suffix.lower() != ".urdf":
        return read_mesh(path, location)
    if not path.is_file():
        raise DescriptionError(f"{location}: no such file {str(path)!r}")
    root = parse_xml(read_robot_file(path), path)
    if root.tag != "robot":
        raise DescriptionError(f"{path}: found <{root.tag}>, expected a URDF with <robot>")
    poses = _link_poses(root, path)
    for kind in ("visual", "collision"):
        parts = [
            _transformed(_geometry(element, path), poses[name] @ _pose(element, path))
            for name, link in _links(root).items()
            for element in link.findall(kind)
        ]
        if parts:
            break
    else:
        raise DescriptionError(f"{path}: found no <visual> or <collision>, expected geometry")
    counts = np.cumsum([0, *(len(points) for points, _ in parts)])
    points = np.concatenate([points for points, _ in parts])
    return points, np.concatenate([t + n for (_, t), n in zip(parts, counts[:-1], strict=True)])


def _links(root: Element) -> dict[str, Element]:
    return {link.get("name", ""): link for link in root.findall("link")}


def _link_poses(root: Element, path: Path) -> dict[str, Array]:
    """Return the poses (4, 4) of all links in the root frame, with movable joints at zero."""
    parents: dict[str, tuple[str, Array]] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", ""), _pose(joint, path)
    poses: dict[str, Array] = {}
    for link in _links(root):
        pose, name, count = np.eye(4), link, 0
        while name in parents and count <= len(parents):
            name, offset = parents[name]
            pose, count = offset @ pose, count + 1
        if count > len(parents):
            raise DescriptionError(f"{path}: {link}: its joints form a loop, expected a tree")
        poses[link] = pose
    return poses


def _pose(element: Element, path: Path) -> Array:
    pose = origin_pose(element)
    if pose is None:
        raise DescriptionError(f"{path}: <{element.tag}>: its origin is not six finite numbers")
    return pose


def _geometry(element: Element, path: Path) -> Triangles:
    geometry = element.find("geometry")
    shape = None if geometry is None or len(geometry) != 1 else geometry[0]
    if shape is None:
        raise DescriptionError(f"{path}: <{element.tag}>: expected one geometry")
    if shape.tag != "mesh":
        return _simple(shape, path)
    name = shape.get("filename", "")
    file = _mesh_file(name, path)
    if file is None:
        raise DescriptionError(f"{path}: no such mesh {name!r}; expected it next to the URDF")
    scale = parse_numbers(shape.get("scale", "1 1 1"))
    sizes = sorted(map(abs, scale)) or [0.0]
    if len(scale) != 3 or not 0 < sizes[0] <= sizes[-1] <= LIMITS.mesh_coordinate:
        raise DescriptionError(f"{path}: {name}: scale: expected three numbers that are not zero")
    points, triangles = read_mesh(file, str(path))
    if np.prod(scale) < 0:
        triangles = triangles[:, ::-1]  # a mirrored mesh faces inwards otherwise
    return points * scale, triangles


def _simple(shape: Element, path: Path) -> Triangles:
    with optional_import("meshes"):
        import trimesh

    create = trimesh.creation
    keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}
    size = [value for key in keys.get(shape.tag, ()) for value in parse_numbers(shape.get(key, ""))]
    expected = {"box": 3, "sphere": 1, "cylinder": 2}.get(shape.tag)
    if len(size) != expected or not min(size) > 0:
        raise DescriptionError(
            f"{path}: <{shape.tag}>: expected a mesh, or a box, sphere or cylinder with its size"
        )
    if shape.tag == "box":
        mesh = create.box(size)
    elif shape.tag == "sphere":
        mesh = create.icosphere(4, size[0])
    else:
        mesh = create.cylinder(size[0], size[1], sections=96)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def _mesh_file(name: str, path: Path) -> Path | None:
    """Return the file of a mesh, relative to the URDF or in a ROS package; None if missing."""
    scheme, _, inside = name.partition("://")
    paths = [path.parent / name.removeprefix("file://")]
    if scheme in ("package", "model"):
        package, _, mesh = inside.partition("/")
        folders = [folder for group in package_folders(package, path) for folder in group]
        paths = [folder / mesh for folder in folders]
        paths += [path.parent / mesh, path.parent / Path(mesh).name]
    return next((candidate for candidate in paths if candidate.is_file()), None)


def _transformed(mesh: Triangles, pose: Array) -> Triangles:
    points, triangles = mesh
    return points @ pose[:3, :3].T + pose[:3, 3], triangles
