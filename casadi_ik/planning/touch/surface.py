"""Surfaces of objects: oriented samples, distance grids and exact nearest points."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.solids import Kind, Solid
from casadi_ik.compile.cache import trusted_cache, user_temp_dir
from casadi_ik.errors import InputError, optional_import, os_errors
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks import checked_integer, checked_number
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.files.writing import atomic_write
from casadi_ik.model.mesh_shape import MeshShape
from casadi_ik.model.objects import GraspObject, load_object
from casadi_ik.planning.touch.nearest import NearestPoints, TriangleTree


@dataclass(frozen=True)
class SurfaceParameters:
    """Resolution of a surface. Source: lengths of Drost et al. 2010, scaled to fingertips.

    Attributes:
        samples: Maximum number of points on the surface.
        density: Maximum mean number of points in a cube with edges of length `patch`.
        smoothing: Radius over which normals are averaged [m]: about that of a fingertip pad.
        patch: Radius without an edge around a point where a pad fits [m].
        bend: Minimum angle between normals within `patch` that indicates an edge [rad].
        step: Edge of a cell of the distance grid [m].
        grid_margin: Distance between the object and the border of the grid [m].
        cells: Maximum number of cells along an edge of the grid; large objects have larger cells.
    """

    samples: int = 6000
    density: int = 100
    smoothing: float = 4e-3
    patch: float = 5e-3
    bend: float = float(np.deg2rad(25.0))
    step: float = 3e-3
    grid_margin: float = 30e-3
    cells: int = 96


@dataclass(frozen=True, eq=False)
class Grid:
    """Distances at the centres of the cells of a grid.

    Attributes:
        low: (4,) lower corner, and edge of a cell [m].
        counts: (3,) number of cells along each axis.
        value: (cells,) distances [m].
        sample: (cells,) nearest sample of the surface; empty if it was not computed.
    """

    low: Array
    counts: NDArray[np.int64]
    value: Array
    sample: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @classmethod
    def from_solids(
        cls, solids: Iterable[tuple[Solid, Array]], low: Array, high: Array, step: float
    ) -> Grid:
        """Return the grid of the minimum distance to solids; infinite if there are no solids.

        Args:
            solids: Solids with their poses (4, 4).
            low: (3,) lower corner of the grid [m].
            high: (3,) upper corner [m].
            step: Edge of a cell [m].
        """
        low, counts, centers = cells(low, high, step)
        value = np.full(len(centers), np.inf)
        posed_solids = list(solids)
        # A solid is not the nearest if its bounding ball is farther away than the centre of
        # another.
        bound = np.full(len(centers), np.inf)
        for solid, pose in posed_solids:
            if np.isfinite(solid.reach) and solid.kind is not Kind.CLOUD:
                np.minimum(bound, np.linalg.norm(centers - pose[:3, 3], axis=1), out=bound)
        for solid, pose in posed_solids:
            ball_distance = np.linalg.norm(centers - pose[:3, 3], axis=1) - solid.reach
            rows = np.flatnonzero(ball_distance <= bound)
            chunk = max(1, MAX_DISTANCES // max(len(solid.planes), 1))
            for start in range(0, len(rows), chunk):
                block = rows[start : start + chunk]
                local = (centers[block] - pose[:3, 3]) @ pose[:3, :3]
                if solid.kind is Kind.CLOUD:
                    distance = _tree(solid.points).query(local)[0] - solid.size[0]
                else:
                    distance = solid.distance(local)
                value[block] = np.minimum(value[block], distance)
        return cls(low, counts, value)


MAX_DISTANCES = 4_000_000
"""Maximum number of distances evaluated together, which bounds the memory."""

NEIGHBOURS = 12
"""Number of neighbours of each sample, for the search of the sample nearest to a point."""


def cells(low: Array, high: Array, step: float) -> tuple[Array, NDArray[np.int64], Array]:
    """Divide a box into cells.

    Args:
        low: (3,) lower corner [m].
        high: (3,) upper corner [m].
        step: Edge of a cell [m].

    Returns:
        (4,) lower corner and edge, (3,) numbers of cells along the axes, and (cells, 3) centres
        [m].
    """
    counts = np.ceil((high - low) / step).astype(np.int64)
    axes = [low[i] + step * (np.arange(counts[i]) + 0.5) for i in range(3)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.append(low, step), counts, centers.reshape(-1, 3)


@dataclass(frozen=True, eq=False, repr=False)
class Surface(RecordReprMixin):
    """Surface of an object.

    Attributes:
        name: Name of the object and its scale, in the format of `load_object`.
        object: The object.
        points: (m, 3) samples [m], object frame.
        normals: (m, 3) unit outward normals, smoothed.
        faces: (m, 3) unit outward normals of the triangles at the samples.
        fits_pad: (m,) True for samples where a fingertip pad fits: without an edge nearby.
        corners: (t, 3, 3) corners of the triangles [m], outward by the right-hand rule.
        parameters: Resolution.
        notes: Defects of the mesh and their repairs.

    Example:
        >>> surface = ik.load_surface("tomato_soup_can")
        >>> height, _ = surface.foot(np.array([0.0, 0.0, 1.0]))
        >>> bool(height > 0.9)
        True
    """

    name: str
    object: GraspObject
    points: Array
    normals: Array
    faces: Array
    fits_pad: Bools
    corners: Array
    parameters: SurfaceParameters
    notes: tuple[str, ...] = ()

    @property
    def inside(self) -> Bools:
        """Deprecated name of `fits_pad`."""
        warn_renamed("Surface.inside", "Surface.fits_pad")
        return self.fits_pad

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def middle(self) -> Array:
        """(3,) mean of the samples [m], an estimate of the centre of mass."""
        return self.points.mean(axis=0)

    @cached_property
    def tree(self):
        """Search tree of the samples."""
        return _tree(self.points)

    @cached_property
    def triangle_tree(self) -> TriangleTree:
        """Tree of the triangles, for exact nearest points."""
        return TriangleTree(self.corners)

    def nearest(self, points: Array) -> NearestPoints:
        """Return the exact nearest points to points (..., 3), with their normals.

        Raises:
            UnsupportedError: There is no C compiler.
        """
        return self.triangle_tree.nearest(points)

    @cached_property
    def grid(self) -> Grid:
        """Grid of signed distances and nearest samples around the surface."""
        parameters = self.parameters
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        extent = float((high - low).max()) + 2 * parameters.grid_margin
        step = max(parameters.step, extent / parameters.cells)
        low, counts, centers = cells(
            low - parameters.grid_margin, high + parameters.grid_margin, step
        )
        height, sample = self.foot(centers)
        distance = np.linalg.norm(centers - self.points[sample], axis=1)
        return Grid(low, counts, np.copysign(distance, height), sample.astype(np.int64))

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """(m, NEIGHBOURS) indices of the nearest samples of each sample."""
        return self.tree.query(self.points, NEIGHBOURS)[1].astype(np.int64)

    def foot(self, points: Array) -> tuple[Array, NDArray[np.intp]]:
        """Return the heights over the nearest samples, and the indices of these samples.

        Args:
            points: (..., 3) points [m].

        Returns:
            (...) heights [m], negative inside the object, and (...) indices.
        """
        _, sample = self.tree.query(points)
        height = ((points - self.points[sample]) * self.faces[sample]).sum(axis=-1)
        return height, sample


def _tree(points: Array) -> Any:
    with optional_import("grasp synthesis"):
        return import_module("scipy.spatial").cKDTree(points)


class TriangleMesh(Protocol):
    """Mesh with vertices (v, 3) [m] and faces (t, 3), such as a trimesh object."""

    @property
    def vertices(self) -> Any: ...  # noqa: D102

    @property
    def faces(self) -> Any: ...  # noqa: D102


SurfaceSource = str | Path | tuple[ArrayLike, ArrayLike] | TriangleMesh
"""Source of a surface: name, path, vertices and triangles, or mesh object."""

EXPECTED_SOURCE = (
    "expected a name or path, a pair (vertices (v, 3), triangles (t, 3)), or a trimesh object"
)


def load_surface(
    name_or_path: SurfaceSource,
    scale: float = 1.0,
    seed: int = 0,
    parameters: SurfaceParameters | None = None,
) -> Surface:
    """Sample the surface of an object.

    A mesh from memory is stored in the cache of the package under a name that depends only on its
    contents, so that its grasps can be saved and loaded like those of a file.

    Args:
        name_or_path: Name of a shipped object, path of an object's file or of a mesh in metres
            (STL, OBJ, PLY, ...), a pair of vertices (v, 3) [m] and triangles (t, 3), or an object
            with attributes `vertices` and `faces`, such as a trimesh object.
        scale: Factor that converts the coordinates of a mesh to metres (0.001 for millimetres).
        seed: Seed of the random samples.
        parameters: Resolution; None: `SurfaceParameters()`.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: The file is missing or malformed.
        InputError: An argument has the wrong type or value, the object with a scale is not a mesh,
            or the mesh does not bound a solid: without area, flat, too large or small for a hand,
            or with triangles in inconsistent orientation.

    Example:
        >>> surface = ik.load_surface("tomato_soup_can")
        >>> surface.points.shape
        (6000, 3)
        >>> corners = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])
        >>> tetrahedron = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
        >>> ik.load_surface((corners, tetrahedron)).points.shape
        (6000, 3)
    """
    parameters = SurfaceParameters() if parameters is None else parameters
    if not isinstance(parameters, SurfaceParameters):
        raise InputError(f"parameters: found {parameters!r}, expected SurfaceParameters or None")
    seed = checked_integer(seed, "seed", 0)
    smallest = float(np.finfo(float).tiny)
    scale = checked_number(scale, "scale", "a number > 0 (0.001 for millimetres)", smallest)
    path = name_or_path if isinstance(name_or_path, str | Path) else _store_mesh(name_or_path)
    factor = f"{scale:g}" if float(f"{scale:g}") == scale else repr(scale)
    name = str(path) if scale == 1.0 else f"{path}@{factor}"
    loaded = load_object(name)
    vertices, triangles = loaded.mesh(resolution=96)
    vertices, triangles, notes = _oriented_mesh(name, vertices, triangles)
    notes = (*(loaded.shape.notes if isinstance(loaded.shape, MeshShape) else ()), *notes)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    rng = np.random.default_rng(seed)
    face = rng.choice(len(triangles), parameters.samples, p=area / area.sum())
    u, v = np.sqrt(rng.random(parameters.samples)), rng.random(parameters.samples)
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points = (corners[face] * weights[..., None]).sum(axis=1)
    faces = normals[face] / area[face, None]
    # Fewer samples suffice for a small object, which also bounds the number of neighbours.
    occupied = len(np.unique(np.floor(points / parameters.patch), axis=0))
    count = min(parameters.samples, max(MIN_SAMPLES, parameters.density * occupied))
    points, faces = points[:count], faces[:count]
    return replace(
        _smoothed_surface(name, loaded, points, faces, corners[area > 0], parameters), notes=notes
    )


def _store_mesh(source: Any) -> Path:
    """Write a mesh into the cache if it is new, and return its path.

    Raises:
        InputError: The source is not a mesh.
    """
    if hasattr(source, "vertices") and hasattr(source, "faces"):
        pair = source.vertices, source.faces
    elif isinstance(source, tuple | list) and len(source) == 2:
        pair = source
    else:
        shape = f" of shape {source.shape}" if isinstance(source, np.ndarray) else ""
        raise InputError(
            f"surface: found an object of type {type(source).__name__}{shape}, {EXPECTED_SOURCE}"
        )
    try:
        vertices, triangles = np.asarray(pair[0], dtype=float), np.asarray(pair[1])
    except (TypeError, ValueError) as error:
        raise InputError(
            f"surface: found arrays that are not numbers, {EXPECTED_SOURCE}"
        ) from error
    shapes = [array.shape for array in (vertices, triangles)]
    if not all(len(shape) == 2 and shape[0] > 0 and shape[1] == 3 for shape in shapes):
        raise InputError(f"surface: found shapes {shapes[0]} and {shapes[1]}, {EXPECTED_SOURCE}")
    if triangles.dtype.kind not in "iu" or not np.isfinite(vertices).all():
        raise InputError(
            "surface: found vertices that are not finite or triangles that are not integers, "
            f"{EXPECTED_SOURCE}"
        )
    if not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise InputError(
            f"surface: found vertex indices from {triangles.min()} to {triangles.max()}, "
            f"expected 0 to {len(vertices) - 1}"
        )
    lines = [f"OFF\n{len(vertices)} {len(triangles)} 0"]
    lines += [" ".join(map(repr, row)) for row in vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in triangles.tolist()]
    text = "\n".join(lines) + "\n"
    folder = (trusted_cache() or user_temp_dir()) / "meshes"
    path = folder / f"mesh_{hashlib.sha256(text.encode()).hexdigest()[:16]}.off"
    with os_errors(f"{path}: a mesh cannot be stored", InputError):
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as temporary:
                temporary.write_text(text, encoding="ascii")
    return path


MIN_SAMPLES = 500
"""Minimum number of samples of a small object."""

SIZE_RANGE = (5e-3, 2.0)
"""Range of the largest edge of the bounding box of an object [m]."""

MIN_THICKNESS = 1e-4
"""Minimum thickness of a solid; a thinner mesh is a flat sheet [m]."""

MAX_INCONSISTENT_EDGES = 0.05
"""Maximum fraction of edges between triangles of inconsistent orientation, as in scans."""


def _oriented_mesh(
    name: str, vertices: Array, triangles: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64], tuple[str, ...]]:
    """Return the mesh with outward triangles, and notes on its defects.

    Raises:
        InputError: The mesh does not bound a solid, see `load_surface`.
    """
    corners = vertices[triangles]
    area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not np.linalg.norm(area_vectors, axis=1).sum() > 0:
        raise InputError(f"{name}: found a surface without area, expected the mesh of a solid")
    largest = np.ptp(vertices, axis=0).max()
    if not SIZE_RANGE[0] <= largest <= SIZE_RANGE[1]:
        raise InputError(
            f"{name}: found a size of {largest:.3g} m, expected metres, from {SIZE_RANGE[0]:g} to "
            f"{SIZE_RANGE[1]:g} m; scale=0.001 is for millimetres"
        )
    center = vertices.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((vertices - center).T))
    thickness = np.ptp(vertices @ axes[:, 0])
    if thickness < MIN_THICKNESS:
        raise InputError(
            f"{name}: found a flat sheet ({1e3 * thickness:.2g} mm), expected the mesh of a solid"
        )
    notes: list[str] = []
    _, numbers = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    merged = numbers.reshape(-1)[triangles]
    edges = merged[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    forward = edges[:, 0] < edges[:, 1]
    key = np.sort(edges, axis=1) @ np.array([len(vertices), 1])
    _, edge, users = np.unique(key, return_inverse=True, return_counts=True)
    n_forward = np.bincount(edge, weights=forward)
    n_inconsistent = int(((users == 2) & (n_forward != 1)).sum())
    if n_inconsistent > MAX_INCONSISTENT_EDGES * len(users):
        raise InputError(
            f"{name}: found triangles of inconsistent orientation at {n_inconsistent:,} of "
            f"{len(users):,} edges, expected outward normals; trimesh.repair.fix_normals may help"
        )
    border = int((users == 1).sum())
    if border:
        notes.append(f"the mesh is open: {border:,} edges have a single triangle")
    volume = ((corners[:, 0] - center) * area_vectors).sum() / 6
    if volume < 0:
        notes.append("the triangles of the mesh faced inward and were reversed")
        triangles = triangles[:, ::-1]
    return vertices, triangles, tuple(notes)


def _smoothed_surface(
    name: str,
    source: GraspObject,
    points: Array,
    faces: Array,
    corners: Array,
    parameters: SurfaceParameters,
) -> Surface:
    """Return the surface with normals averaged over neighbouring samples."""
    tree = _tree(points)

    def neighbours(radius: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        pairs = tree.query_pairs(radius, output_type="ndarray")
        indices = np.arange(len(points))
        return (
            np.concatenate([pairs[:, 0], pairs[:, 1], indices]),
            np.concatenate([pairs[:, 1], pairs[:, 0], indices]),
        )

    # Samples on the two sides of a thin wall are not averaged.
    i, j = neighbours(parameters.smoothing)
    same_side = (faces[i] * faces[j]).sum(axis=1) > 0
    normals = np.zeros_like(points)
    np.add.at(normals, i[same_side], faces[j[same_side]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    i, j = neighbours(parameters.patch)
    is_edge = (normals[i] * faces[j]).sum(axis=1) < np.cos(parameters.bend)
    fits_pad = np.ones(len(points), dtype=bool)
    fits_pad[i[is_edge]] = False
    return Surface(name, source, points, normals, faces, fits_pad, corners, parameters)
