"""Triangle meshes of links, read from robot files and from the mesh files that they name."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import warn_of_large_mesh
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import hex_color, read_mesh_parts
from casadi_ik.model.sandbox import package_folders
from casadi_ik.model.shapes import box_mesh, capsule_mesh, circle, prism_mesh
from casadi_ik.model.xml_tree import (
    Element,
    RobotTree,
    collides,
    mjcf_pose,
    origin_pose,
    parse_numbers,
    simple_geom,
    simple_shape,
)

CIRCLE_POINTS = 24
"""Number of points around the axis of a cylinder, capsule or sphere."""

PACKAGE_SCHEMES = ("package", "model")
"""URL schemes of mesh files that are named by their package."""

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class IndexedMesh:
    """A triangle mesh.

    Attributes:
        points: (k, 3) vertices [m].
        triangles: (t, 3) rows of `points`.
    """

    points: Array
    triangles: IntArray

    def transformed(self, pose: Array) -> IndexedMesh:
        """Return the mesh in a frame in which the frame of the mesh has a (4, 4) pose."""
        return IndexedMesh(self.points @ pose[:3, :3].T + pose[:3, 3], self.triangles)

    def simplified(self, max_triangles: int, cells: int) -> IndexedMesh:
        """Return the mesh with fewer triangles if it has more than `max_triangles`.

        The points in each cell of a grid are merged, so that a point moves by no more than the
        diagonal of a cell.

        Args:
            max_triangles: Number of triangles up to which the mesh is returned unchanged.
            cells: Number of cells along the longest edge of the bounding box.
        """
        if len(self.triangles) <= max_triangles:
            return self
        rows, numbers = cluster_points(self.points, cells)
        a, b, c = numbers[self.triangles].T
        triangles = np.stack([a, b, c], axis=1)[(a != b) & (b != c) & (c != a)]
        return IndexedMesh(self.points[rows], triangles)

    def centroid(self) -> Array:
        """Return the (3,) centroid of the surface."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        centroids = (a + b + c) / 3
        total = float(areas.sum())
        return areas @ centroids / total if total > 0 else self.points.mean(axis=0)

    def mean_normal(self, point: Array, radius: float, normal: Array) -> Array:
        """Return the (3,) unit mean normal of the triangles around a point.

        Args:
            point: (3,) centre of the averaged region [m].
            radius: Radius of the region [m].
            normal: (3,) approximate normal; triangles that are nearly parallel to it are ignored.
        """
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        area_vectors = np.cross(b - a, c - a) / 2
        is_close = np.linalg.norm((a + b + c) / 3 - point, axis=1) <= radius
        area_vectors = area_vectors[is_close]
        cosines = area_vectors @ normal / np.maximum(np.linalg.norm(area_vectors, axis=1), 1e-30)
        # The winding of the triangles is unknown, so each normal gets the sign of its cosine.
        total = (
            area_vectors[np.abs(cosines) > 0.3] * np.sign(cosines[np.abs(cosines) > 0.3])[:, None]
        ).sum(axis=0)
        length = float(np.linalg.norm(total))
        return total / length if length > 0 else normal

    def first_hit(self, start: Array, direction: Array) -> Array | None:
        """Return the first intersection (3,) of a ray with the mesh; None if there is none.

        Source: T. Moeller, B. Trumbore, Fast, minimum storage ray-triangle intersection, 1997.
        """
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        ab, ac = b - a, c - a
        p = np.cross(direction, ac)
        determinant = np.einsum("ij,ij->i", ab, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = start - a
            u = np.einsum("ij,ij->i", offset, p) / determinant
            q = np.cross(offset, ab)
            v = q @ direction / determinant
            distance = np.einsum("ij,ij->i", q, ac) / determinant
            is_hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 0)
        hits = distance[is_hit & np.isfinite(distance)]
        return start + float(hits.min()) * direction if len(hits) else None


def cluster_points(points: Array, cells: int) -> tuple[IntArray, IntArray]:
    """Group points by the cells of a grid.

    Args:
        points: (k, 3) points [m].
        cells: Number of cells along the longest edge of their bounding box.

    Returns:
        (c,) row of the outermost point of each occupied cell, and (k,) the number of the cell that
        contains each point.
    """
    low = points.min(axis=0)
    cell = max(float(np.ptp(points, axis=0).max()) / cells, 1e-12)
    key = ((points - low) / cell).astype(np.int64) @ np.array([1, 2 * cells, 4 * cells**2])
    inward = -((points - points.mean(axis=0)) ** 2).sum(axis=1)
    order = np.lexsort((inward, key))
    starts = np.ones(len(order), bool)
    starts[1:] = np.diff(key[order]) != 0
    numbers = np.empty(len(points), np.int64)
    numbers[order] = np.cumsum(starts) - 1
    return order[starts], numbers


def merge_meshes(meshes: list[IndexedMesh]) -> IndexedMesh | None:
    """Return the union of meshes as one mesh; None if the list is empty."""
    if not meshes:
        return None
    offsets = np.cumsum([0, *(len(mesh.points) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    return IndexedMesh(np.concatenate([mesh.points for mesh in meshes]), np.concatenate(triangles))


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """A triangle mesh with a colour "#rrggbb"; "" if its file states none."""

    mesh: IndexedMesh
    color: str = ""

    def transformed(self, pose: Array) -> ColoredMesh:
        """Return the mesh in a frame in which the frame of the mesh has a (4, 4) pose."""
        return replace(self, mesh=self.mesh.transformed(pose))


def link_meshes(
    tree: RobotTree, links: Collection[str], visual: bool = False
) -> tuple[dict[str, IndexedMesh], list[str]]:
    """Return a mesh for each link, and a message about each file that cannot be read.

    The arguments are those of `link_mesh_parts`.
    """
    parts_by_link, messages = link_mesh_parts(tree, links, visual)
    meshes: dict[str, IndexedMesh] = {}
    for link, parts in parts_by_link.items():
        merged = merge_meshes([part.mesh for part in parts])
        if merged is not None:
            meshes[link] = merged
    return meshes, messages


def link_mesh_parts(
    tree: RobotTree, links: Collection[str], visual: bool = False
) -> tuple[dict[str, list[ColoredMesh]], list[str]]:
    """Return the coloured meshes of links, and a message about each file that cannot be read.

    Args:
        tree: The robot file.
        links: Names of the links; reading a fine mesh takes a second.
        visual: Whether visual meshes are preferred to collision meshes.

    Returns:
        Meshes by link, in the frame of the link; links without a shape are omitted. Messages, one
        line each.
    """
    if tree.model is not None:
        mjcf_meshes = _mjcf_meshes(*tree.model, visual)
        return {link: mjcf_meshes[link] for link in links if link in mjcf_meshes}, []
    assert tree.element is not None
    problems = MeshProblems(tree.path)
    meshes: dict[str, list[ColoredMesh]] = {}
    for kind in ("visual", "collision") if visual else ("collision", "visual"):
        links_without_mesh = [link for link in links if link not in meshes]
        meshes |= _urdf_meshes(tree.element, kind, links_without_mesh, problems)
    return meshes, problems.messages()


class MeshProblems:
    """A record of the mesh files that are missing or cannot be read."""

    def __init__(self, path: Path) -> None:
        """Start an empty record for a robot file."""
        self.path = path
        self._missing_in_package: dict[str, list[str]] = {}
        self._missing_files: list[str] = []
        self._read_errors: list[str] = []

    def add_missing(self, name: str) -> None:
        """Record a mesh file that does not exist."""
        scheme, _, package_path = name.partition("://")
        package = package_path.partition("/")[0] if scheme in PACKAGE_SCHEMES else ""
        if package and not any(package_folders(package, self.path)):
            self._missing_in_package.setdefault(package, []).append(name)
        else:
            self._missing_files.append(name)

    def add_error(self, reason: str) -> None:
        """Record a mesh file that cannot be read."""
        self._read_errors.append(reason)

    def messages(self) -> list[str]:
        """Return a line for each package, one for all other missing files, one for each error."""
        lines = [
            f"{self.path.name}: package {name!r} is not found ({_count_meshes(meshes)}): name the "
            "folder that holds it in the environment, ROS_PACKAGE_PATH=FOLDER casadi-ik import ..."
            for name, meshes in self._missing_in_package.items()
        ]
        if self._missing_files:
            count = _count_meshes(self._missing_files)
            lines.append(f"{self.path.name}: there is no such file ({count})")
        return lines + list(dict.fromkeys(self._read_errors))


def _count_meshes(names: list[str]) -> str:
    """Return the number of different meshes and the name of the first one."""
    distinct = list(dict.fromkeys(names))
    if len(distinct) == 1:
        return f"mesh {distinct[0]!r}"
    return f"{len(distinct)} meshes, for example {distinct[0]!r}"


def _urdf_meshes(
    element: Element, kind: str, links: Collection[str], problems: MeshProblems
) -> dict[str, list[ColoredMesh]]:
    """Return the meshes of links by name; `kind` is "visual" or "collision"."""
    materials = {
        material.get("name", ""): _material_color(material)
        for material in element.findall("material")
    }
    meshes: dict[str, list[ColoredMesh]] = {}
    for link in element.findall("link"):
        name = link.get("name", "")
        if name in links:
            shapes = link.findall(kind)
            parts = [part for shape in shapes for part in _shape_parts(shape, materials, problems)]
            if parts:
                meshes[name] = parts
    return meshes


def _material_color(material: Element | None) -> str:
    """Return the colour of an element ``material``; "" if it states none."""
    color = None if material is None else material.find("color")
    channels = parse_numbers("" if color is None else color.get("rgba", ""))
    return hex_color(channels) if len(channels) == 4 else ""


def _shape_parts(
    shape: Element, materials: dict[str, str], problems: MeshProblems
) -> list[ColoredMesh]:
    """Return the meshes of an element ``collision`` or ``visual`` in the frame of its link.

    The colours of a mesh file take precedence over the material of the element.
    """
    element, simple, pose = shape.find("geometry/mesh"), simple_shape(shape), origin_pose(shape)
    parts = []
    if element is not None:
        parts = _file_parts(element, problems)
    elif simple is not None:
        parts = [ColoredMesh(simple_mesh(simple[0], np.array(simple[1])))]
    if pose is None:
        return []
    material = shape.find("material")
    color = _material_color(material)
    if not color and material is not None:
        color = materials.get(material.get("name", ""), "")
    return [replace(part.transformed(pose), color=part.color or color) for part in parts]


def _file_parts(element: Element, problems: MeshProblems) -> list[ColoredMesh]:
    """Return the meshes of the file that an element ``mesh`` names."""
    name = element.get("filename", "")
    file = find_mesh_file(name, problems.path)
    if file is None:
        problems.add_missing(name)
        return []
    scale = parse_numbers(element.get("scale", "1 1 1"))
    try:
        parts = read_mesh_parts(file, problems.path.name)
    except DescriptionError as error:
        problems.add_error(str(error))
        return []
    location = f"{problems.path.name}: mesh {name!r}"
    if len(scale) != 3 or max(map(abs, scale)) > LIMITS.mesh_coordinate:
        problems.add_error(f"{location}: scale: expected three finite numbers")
        return []
    warn_of_large_mesh(np.concatenate([part.points for part in parts]) * scale, location)
    is_too_fine = sum(len(part.triangles) for part in parts) > LIMITS.link_triangles
    return [
        ColoredMesh(
            IndexedMesh(part.points * scale, part.triangles[: 0 if is_too_fine else None]),
            part.color,
        )
        for part in parts
    ]


def find_mesh_file(name: str, path: Path) -> Path | None:
    """Return the mesh file that a URDF names; None if there is none.

    Args:
        name: File name or URL in the URDF.
        path: The URDF; packages are searched for in its parent folders.
    """
    scheme, _, package_path = name.partition("://")
    if scheme not in PACKAGE_SCHEMES:
        candidates = [path.parent / name.removeprefix("file://")]
    else:
        package, _, file_path = package_path.partition("/")
        candidates = [
            folder / file_path for folders in package_folders(package, path) for folder in folders
        ]
    return next((file for file in candidates if file.is_file()), None)


def simple_mesh(kind: str, size: Array) -> IndexedMesh:
    """Return the mesh of a box, sphere, capsule or cylinder.

    Args:
        kind: "box", "sphere", "capsule" or "cylinder".
        size: Edges of the box, radius of the sphere, or radius and length along z [m].
    """
    if kind == "box":
        return IndexedMesh(*box_mesh(size / 2))
    if kind == "cylinder":
        return IndexedMesh(*prism_mesh(size[0] * circle(CIRCLE_POINTS), size[1]))
    half_length = size[1] / 2 if kind == "capsule" else 0.0
    return IndexedMesh(*capsule_mesh(size[0], half_length, CIRCLE_POINTS))


def _mjcf_meshes(mujoco: Any, model: Any, visual: bool) -> dict[str, list[ColoredMesh]]:
    """Return the visual or collision meshes by body; all meshes of a body that has no such."""
    parts_by_body: dict[int, list[tuple[bool, ColoredMesh]]] = {}
    for geom in range(model.ngeom):
        mesh = _geom_mesh(mujoco, model, geom)
        if mesh is None:
            continue
        pose = mjcf_pose(mujoco, model.geom_pos[geom], model.geom_quat[geom])
        material = int(model.geom_matid[geom])
        channels = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        part = ColoredMesh(mesh.transformed(pose), hex_color(channels))
        parts = parts_by_body.setdefault(int(model.geom_bodyid[geom]), [])
        parts.append((collides(model, geom), part))
    meshes: dict[str, list[ColoredMesh]] = {}
    for body, parts in parts_by_body.items():
        preferred = [part for is_solid, part in parts if is_solid != visual]
        name = model.body(body).name or f"body_{body}"
        meshes[name] = preferred or [part for _, part in parts]
    return meshes


def _geom_mesh(mujoco: Any, model: Any, geom: int) -> IndexedMesh | None:
    """Return the mesh of a geom in its own frame; None if the geom has no surface to show."""
    kind, simple = int(model.geom_type[geom]), simple_geom(mujoco, model, geom)
    if simple is not None:
        return simple_mesh(simple[0], np.array(simple[1]))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        sphere = simple_mesh("sphere", np.ones(1))
        return IndexedMesh(sphere.points * model.geom_size[geom], sphere.triangles)
    if kind != mujoco.mjtGeom.mjGEOM_MESH:
        return None
    mesh = int(model.geom_dataid[geom])
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    points = np.array(model.mesh_vert[start : start + count], dtype=float)
    return IndexedMesh(points, np.array(model.mesh_face[first : first + faces], dtype=np.int64))
