"""Shapes bounded by triangles: reading from meshes and URDF files, signed distance, pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import DescriptionError, optional_import
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks import warn_of_large_mesh
from casadi_ik.files.limits import LIMITS, raise_hint, scaled_limit
from casadi_ik.files.number_files import MESH_FORMATS, read_mesh
from casadi_ik.model.sandbox import package_folders
from casadi_ik.model.shapes import BaseShape, Mesh
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
    """Return the scaled triangles of the geometry of a link element."""
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
    """Return the triangles of a box, sphere or cylinder."""
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
    scheme, _, path_in_package = name.partition("://")
    paths = [path.parent / name.removeprefix("file://")]
    if scheme in ("package", "model"):
        package, _, mesh = path_in_package.partition("/")
        folders = [folder for group in package_folders(package, path) for folder in group]
        paths = [folder / mesh for folder in folders]
        paths += [path.parent / mesh, path.parent / Path(mesh).name]
    return next((candidate for candidate in paths if candidate.is_file()), None)


def _transformed(mesh: Triangles, pose: Array) -> Triangles:
    points, triangles = mesh
    return points @ pose[:3, :3].T + pose[:3, 3], triangles


@dataclass(frozen=True)
class MeshDistanceParameters:
    """Parameters of the distance from meshes.

    Attributes:
        chunk_size: Number of pairs of a point and a triangle that are evaluated together.
        rounding: Error of the distances from centroids by which nearby triangles are selected [m].
        probe_offset: Distance of a probe point in front of a triangle [m]; the triangle is inside
            another piece if the probe point is.
    """

    chunk_size: int = 2_000_000
    rounding: float = 1e-6
    probe_offset: float = 1e-6


MESH_DISTANCE_PARAMETERS = MeshDistanceParameters()

RAY_FRAMES = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]
"""(3, 3, 3) rotations; the third axis of each is the direction of a ray."""


@dataclass(frozen=True, eq=False)
class MeshShape(BaseShape):
    """A solid bounded by triangles, in connected pieces.

    Attributes:
        pieces: Vertices (v, 3) [m] and triangles (t, 3) of each piece.
        notes: Defects of the files, and how they were repaired.
    """

    pieces: tuple[Mesh, ...]
    notes: tuple[str, ...] = ()

    def mesh(self, resolution: int = 32) -> Mesh:
        """Return the vertices and triangles of all pieces; the resolution is ignored."""
        del resolution
        starts = np.cumsum([0, *(len(points) for points, _ in self.pieces)])
        triangles = [faces + start for (_, faces), start in zip(self.pieces, starts, strict=False)]
        return np.concatenate([points for points, _ in self.pieces]), np.concatenate(triangles)

    @cached_property
    def _triangles(self) -> Array:
        """Corners (t, 3, 3) of all triangles."""
        return np.concatenate([points[faces] for points, faces in self.pieces])

    @cached_property
    def _outer_triangles(self) -> Array:
        """Corners (t, 3, 3) of the triangles that are not inside another, convex, piece."""
        offset = MESH_DISTANCE_PARAMETERS.probe_offset
        outer_triangles = []
        for i, (points, faces) in enumerate(self.pieces):
            corners = points[faces]
            probes = corners.mean(axis=1) + offset * _normals(corners)
            is_hidden = np.zeros(len(corners), dtype=bool)
            for j, (other_points, other_faces) in enumerate(self.pieces):
                if i != j:
                    is_hidden |= _in_convex(other_points[other_faces], probes)
            outer_triangles.append(corners[~is_hidden])
        triangles = np.concatenate(outer_triangles)
        return triangles if len(triangles) else self._triangles

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        size = max(1, MESH_DISTANCE_PARAMETERS.chunk_size // len(self._triangles))
        for start in range(0, len(points), size):
            rows = slice(start, start + size)
            offset, face_normal = _offset_from_triangles(points[rows], self._outer_triangles)
            length = np.linalg.norm(offset, axis=1)
            sign = np.where(_is_inside(points[rows], self._triangles), -1.0, 1.0)
            is_off_surface = length > 1e-9
            distance[rows] = sign * length
            unit = offset / np.where(is_off_surface, length, 1.0)[:, None]
            normal[rows] = np.where(is_off_surface[:, None], sign[:, None] * unit, face_normal)
        return distance, normal


def load_mesh_shape(files: Sequence[Path], scale: float, location: str) -> MeshShape:
    """Load a shape from mesh files.

    Args:
        files: Mesh files; each connected component of a file is a piece.
        scale: Factor of the coordinates.
        location: File and key for error messages.

    Raises:
        DescriptionError: A file is missing, is not a mesh, or has too many pieces.
    """
    pieces, notes = list[Mesh](), list[str]()
    for file in files:
        points, triangles = read_body(file, location)
        points = scale * points
        warn_of_large_mesh(
            points, location if str(file) in location else f"{location}: {file.name}"
        )
        points, single = single_sided(points, triangles)
        if len(single) < len(triangles):
            notes.append(f"{len(triangles) - len(single):,} duplicate triangles are removed")
        pieces += pieces_of(points, single)
    if len(pieces) > scaled_limit(LIMITS.object_pieces):
        hint = raise_hint(len(pieces), LIMITS.object_pieces)
        expected = f"at most {scaled_limit(LIMITS.object_pieces)} {hint}"
        raise DescriptionError(f"{location}: found {len(pieces)} pieces, expected {expected}")
    return MeshShape(tuple(pieces), tuple(notes))


MIN_DUPLICATE_SHARE = 0.5
"""Share of triangles with a duplicate above which a mesh counts as double-sided.

Adjacent solids share few triangles: two cubes with a common face share 4 of 24.
"""


def single_sided(points: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Remove the duplicate triangles of a double-sided mesh and orient the others outward.

    Exporters write both sides of the triangles for viewers that draw only front faces. A
    single-sided mesh is returned unchanged.

    Args:
        points: (v, 3) vertices [m].
        triangles: (t, 3) triangles.
    """
    _, numbers = np.unique(points, axis=0, return_inverse=True)
    merged = numbers.reshape(-1)[triangles]
    _, first, copies = np.unique(
        np.sort(merged, axis=1), axis=0, return_index=True, return_counts=True
    )
    if copies[copies > 1].sum() <= MIN_DUPLICATE_SHARE * len(triangles):
        return points, triangles
    first = np.sort(first)
    return points, _oriented(points, triangles[first], merged[first])


def _oriented(
    points: Array, triangles: NDArray[np.int64], merged: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Orient triangles consistently within each component, and each component outward.

    Args:
        points: (v, 3) vertices [m].
        triangles: (t, 3) triangles.
        merged: (t, 3) triangles in terms of vertices with distinct positions.
    """
    with optional_import("meshes"):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

    t = len(triangles)
    tails, heads = merged[:, [0, 1, 2]].T.ravel(), merged[:, [1, 2, 0]].T.ravel()
    keys = np.stack([np.minimum(tails, heads), np.maximum(tails, heads)], axis=1)
    _, edges, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    edges = edges.reshape(-1)
    order = np.argsort(edges, kind="stable")
    pairs = order[counts[edges[order]] == 2].reshape(-1, 2)
    # Neighbours are consistent if they traverse their common edge in opposite directions.
    first, second = pairs.T
    consistent = (tails[first] < heads[first]) != (tails[second] < heads[second])
    triangle_a, triangle_b = (pairs % t).T
    # Each triangle has two nodes, unchanged and flipped; edges connect consistent nodes.
    flip = np.where(consistent, 0, t)
    rows = np.concatenate([triangle_a, triangle_a + t])
    columns = np.concatenate([triangle_b + flip, triangle_b + t - flip])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * t, 2 * t))
    sides = connected_components(graph, directed=False)[1][:t]
    graph = coo_array((np.ones(len(pairs)), (triangle_a, triangle_b)), shape=(t, t))
    count, labels = connected_components(graph, directed=False)
    roots = np.unique(labels, return_index=True)[1]
    is_flipped = sides != sides[roots[labels]]
    corners = points[triangles]
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    is_inward = np.bincount(labels, np.where(is_flipped, -volumes, volumes), count) < 0
    return np.where((is_flipped ^ is_inward[labels])[:, None], triangles[:, ::-1], triangles)


def pieces_of(points: Array, triangles: NDArray[np.int64]) -> list[Mesh]:
    """Split a mesh into components that are connected by edges.

    Vertices with equal positions are merged if a triangle has unshared edges, as in an STL file.
    Where solids touch at such an edge, consecutive triangles of the edge are connected.
    """
    edges, counts = _edges(triangles)
    if (counts < 2).any():
        points, numbers = np.unique(points, axis=0, return_inverse=True)
        triangles = numbers.reshape(-1)[triangles]
        edges, counts = _edges(triangles)
    of_triangle = np.arange(len(edges)) % len(triangles)
    order = np.lexsort((of_triangle, edges))
    neighbours = of_triangle[order[counts[edges[order]] % 2 == 0]].reshape(-1, 2)
    with optional_import("meshes"):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

    size = len(triangles)
    adjacency = coo_array((np.ones(len(neighbours)), neighbours.T), shape=(size, size))
    _, labels = connected_components(adjacency, directed=False)
    order = np.argsort(labels, kind="stable")
    pieces: list[Mesh] = []
    for members in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        vertices, numbers = np.unique(triangles[members], return_inverse=True)
        pieces.append((points[vertices], numbers.reshape(-1, 3).astype(np.int64)))
    return pieces


def _edges(triangles: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the numbers of the edges (3 t), first edges first, and triangle counts by number."""
    vertices = np.sort(np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    _, numbers, counts = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    return numbers.reshape(-1), counts


def _normals(corners: Array) -> Array:
    """Return unit normals (t, 3) of triangles (t, 3, 3); zero for triangles without area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def _in_convex(corners: Array, points: Array) -> Bools:
    """Return whether points are behind the planes of all triangles, (k,)."""
    normals = _normals(corners)
    plane_offsets = np.sum(normals * corners[:, 0], axis=1)
    is_inside = np.zeros(len(points), dtype=bool)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    in_bounds = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    size = max(1, MESH_DISTANCE_PARAMETERS.chunk_size // len(corners))
    for start in range(0, len(in_bounds), size):
        rows = in_bounds[start : start + size]
        is_inside[rows] = (points[rows] @ normals.T < plane_offsets).all(axis=1)
    return is_inside


def _is_inside(points: Array, corners: Array) -> Bools:
    """Return whether points are enclosed by triangles (t, 3, 3), (k,).

    Along a ray, front faces and back faces are counted with opposite signs. At least two of three
    rays in generic directions have to agree, so that small holes have no effect.
    """
    votes = np.zeros(len(points), dtype=int)
    for rotation in RAY_FRAMES:
        triangles, origins = corners @ rotation, points @ rotation
        low, high = triangles[:, :, :2].min(axis=1), triangles[:, :, :2].max(axis=1)
        in_bounds = np.ones((len(points), len(corners)), dtype=bool)
        for axis in range(2):
            coordinate = origins[:, axis, None]
            in_bounds &= (coordinate > low[:, axis]) & (coordinate < high[:, axis])
        point, triangle = np.nonzero(in_bounds)
        offsets = triangles[triangle, :, :2] - origins[point, None, :2]
        x, y = offsets[..., 0], offsets[..., 1]
        areas = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - y[:, [1, 2, 0]] * x[:, [2, 0, 1]]
        is_hit = (areas > 0).all(axis=1) | (areas < 0).all(axis=1)
        total_area = areas.sum(axis=1)
        weighted_height = (areas * triangles[triangle, :, 2]).sum(axis=1)
        height = weighted_height / np.where(is_hit, total_area, 1.0)
        is_ahead = is_hit & (height > origins[point, 2])
        count = np.bincount(point[is_ahead], np.sign(total_area[is_ahead]), len(points))
        votes += np.abs(count) > 0.5
    return votes >= 2


def _offset_from_triangles(points: Array, corners: Array) -> tuple[Array, Array]:
    """Return offsets of points (k, 3) from the nearest points of triangles, and unit normals.

    Args:
        points: (k, 3) points [m].
        corners: (t, 3, 3) corners of the triangles [m].

    Returns:
        (k, 3) offsets [m], and (k, 3) unit normals of the nearest triangles.
    """
    centroids = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centroids[:, None], axis=2).max(axis=1)
    squares = (points**2).sum(axis=1)[:, None] + (centroids**2).sum(axis=1)
    centroid_distances = np.sqrt(np.maximum(squares - 2 * points @ centroids.T, 0.0))
    offsets, face_normals = np.empty((len(points), 3)), np.empty((len(points), 3))
    with optional_import("meshes"):
        from trimesh.triangles import closest_point

    for i, point in enumerate(points):
        distances = centroid_distances[i]
        bound = distances.min() + MESH_DISTANCE_PARAMETERS.rounding
        candidates = np.flatnonzero(distances - radii <= bound)
        nearest_points = closest_point(corners[candidates], np.tile(point, (len(candidates), 1)))
        candidate_offsets = point - nearest_points
        best = int(np.argmin(np.einsum("ti,ti->t", candidate_offsets, candidate_offsets)))
        offsets[i] = candidate_offsets[best]
        face_normals[i] = _normals(corners[candidates[best : best + 1]])[0]
    return offsets, face_normals
