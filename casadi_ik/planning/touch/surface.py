"""Surfaces of objects as oriented samples: where a fingertip may touch, and how far points are."""

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
from casadi_ik.errors import InputError, os_errors
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks.numbers import checked_integer, checked_number
from casadi_ik.files.writing import written_whole
from casadi_ik.model.objects import GraspObject, load_object
from casadi_ik.model.shapes import MeshShape
from casadi_ik.planning.touch.nearest import NearestPoints, TriangleTree


@dataclass(frozen=True)
class SurfaceParameters:
    """How finely a surface is looked at (lengths of Drost et al. 2010, scaled to fingertips).

    Attributes:
        samples: Maximum number of points on the surface.
        density: Maximum mean number of them in a cube with edges of `patch`.
        smoothing: Normals are means over this radius [m], about that of a fingertip's pad.
        patch: A point is inside a face if all samples of this radius about it [m] ...
        bend: ... have normals within this angle of its own [rad].
        step: Edge of a cell of the distance grid [m].
        around: How far beyond the object the grid reaches [m].
        cells: Most cells along an edge of the grid; large objects get larger cells.
    """

    samples: int = 6000
    density: int = 100
    smoothing: float = 4e-3
    patch: float = 5e-3
    bend: float = float(np.deg2rad(25.0))
    step: float = 3e-3
    around: float = 30e-3
    cells: int = 96


@dataclass(frozen=True, eq=False)
class Grid:
    """Distances in the middles of cells.

    Attributes:
        low: (4,) lower corner, and edge of a cell [m].
        counts: (3,) how many cells there are along each axis.
        value: (cells,) distances [m].
        sample: (cells,) what is there; empty where that is not known.
    """

    low: Array
    counts: NDArray[np.int64]
    value: Array
    sample: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @classmethod
    def of(
        cls, solids: Iterable[tuple[Solid, Array]], low: Array, high: Array, step: float
    ) -> Grid:
        """Return the grid of the least distance to solids, infinite where there is none.

        Args:
            solids: Solids with their poses (4, 4).
            low: (3,) lower corner of the grid [m].
            high: (3,) upper corner [m].
            step: Edge of a cell [m].
        """
        low, counts, middles = cells(low, high, step)
        value = np.full(len(middles), np.inf)
        placed = list(solids)
        # A solid is not the nearest where even the ball about it is farther than another's centre.
        bound = np.full(len(middles), np.inf)
        for solid, pose in placed:
            if np.isfinite(solid.reach) and solid.kind is not Kind.CLOUD:
                np.minimum(bound, np.linalg.norm(middles - pose[:3, 3], axis=1), out=bound)
        for solid, pose in placed:
            near = np.linalg.norm(middles - pose[:3, 3], axis=1) - solid.reach <= bound
            rows = np.flatnonzero(near)
            chunk = max(1, MOST_NUMBERS // max(len(solid.planes), 1))
            for start in range(0, len(rows), chunk):
                some = rows[start : start + chunk]
                local = (middles[some] - pose[:3, 3]) @ pose[:3, :3]
                if solid.kind is Kind.CLOUD:
                    distance = _tree(solid.points).query(local)[0] - solid.size[0]
                else:
                    distance = solid.distance(local)
                value[some] = np.minimum(value[some], distance)
        return cls(low, counts, value)


MOST_NUMBERS = 4_000_000
"""Distances of cells from planes that are evaluated together; bounds the memory."""

NEIGHBOURS = 12
"""Samples about each: by them the nearest of a point is found from one that is near."""


def cells(low: Array, high: Array, step: float) -> tuple[Array, NDArray[np.int64], Array]:
    """Lower corner and edge (4,), numbers (3,) and middles (cells, 3) of the cells of a box [m]."""
    counts = np.ceil((high - low) / step).astype(np.int64)
    axes = [low[i] + step * (np.arange(counts[i]) + 0.5) for i in range(3)]
    middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.append(low, step), counts, middles.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Surface:
    """An object's surface.

    Attributes:
        name: As `load_object` takes it, with its scale.
        object: The object.
        points: (m, 3) samples [m], object frame.
        normals: (m, 3) unit outward normals, smoothed.
        faces: (m, 3) unit outward normals of the triangles themselves.
        inside: (m,) whether a fingertip's pad fits: no edge of the surface is near.
        corners: (t, 3, 3) corners of the triangles [m], outward by the right-hand rule.
        parameters: How it was sampled.
        notes: What is odd about the mesh, and what was made of it; empty for a closed one.

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
    inside: Bools
    corners: Array
    parameters: SurfaceParameters
    notes: tuple[str, ...] = ()

    @cached_property
    def size(self) -> float:
        """Diagonal of the box around it [m]."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def middle(self) -> Array:
        """(3,) mean of the samples [m]: about where the centre of mass is."""
        return self.points.mean(axis=0)

    @cached_property
    def tree(self):
        """Nearest samples of points."""
        return _tree(self.points)

    @cached_property
    def triangle_tree(self) -> TriangleTree:
        """Tree of the triangles, for exact nearest points."""
        return TriangleTree(self.corners)

    def nearest(self, points: Array) -> NearestPoints:
        """Return the exact nearest points to points (..., 3), with the normals there.

        Raises:
            UnsupportedError: There is no C compiler.
        """
        return self.triangle_tree.nearest(points)

    @cached_property
    def grid(self) -> Grid:
        """Heights about the surface, and its samples there."""
        chosen = self.parameters
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        step = max(chosen.step, (float((high - low).max()) + 2 * chosen.around) / chosen.cells)
        low, counts, middles = cells(low - chosen.around, high + chosen.around, step)
        height, sample = self.foot(middles)
        apart = np.linalg.norm(middles - self.points[sample], axis=1)
        return Grid(low, counts, np.copysign(apart, height), sample.astype(np.int64))

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """(m, NEIGHBOURS) the samples that are nearest to each."""
        return self.tree.query(self.points, NEIGHBOURS)[1].astype(np.int64)

    def foot(self, points: Array) -> tuple[Array, NDArray[np.intp]]:
        """Nearest points of the surface: heights (...) [m], negative inside, and samples (...)."""
        _, sample = self.tree.query(points)
        height = ((points - self.points[sample]) * self.faces[sample]).sum(axis=-1)
        return height, sample


def _tree(points: Array) -> Any:
    return import_module("scipy.spatial").cKDTree(points)


class TriangleMesh(Protocol):
    """A mesh with vertices (v, 3) [m] and faces (t, 3), as a trimesh object is."""

    @property
    def vertices(self) -> Any: ...  # noqa: D102

    @property
    def faces(self) -> Any: ...  # noqa: D102


SurfaceSource = str | Path | tuple[ArrayLike, ArrayLike] | TriangleMesh
"""What a surface is made from, see `load_surface`."""

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

    A mesh that is not a file is stored in the cache of the package, under a name that depends on
    its contents alone, so that its grasps can be saved and used like others.

    Args:
        name_or_path: Name of a shipped object, path of an object's file or of a mesh in metres
            (STL, OBJ, PLY, ...), a pair of vertices (v, 3) [m] and triangles (t, 3), or an object
            that has these as `vertices` and `faces`, such as that of trimesh.
        scale: Factor that converts the coordinates of a mesh to metres (0.001 for millimetres).
        seed: Seed of the samples.
        parameters: Density of the samples; None: `SurfaceParameters()`.

    Raises:
        UnknownNameError: No shipped object has that name.
        DescriptionError: The file is missing or malformed.
        InputError: An argument has the wrong type or value, the object with a scale is not a mesh,
            or the surface is not that of a body: without area, flat, too large or small for a hand,
            or with triangles that face opposite ways.

    Example:
        >>> surface = ik.load_surface("tomato_soup_can")
        >>> surface.points.shape
        (6000, 3)
        >>> corners = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])
        >>> tetrahedron = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
        >>> ik.load_surface((corners, tetrahedron)).points.shape
        (6000, 3)
    """
    chosen = SurfaceParameters() if parameters is None else parameters
    if not isinstance(chosen, SurfaceParameters):
        raise InputError(f"parameters: found {chosen!r}, expected SurfaceParameters or None")
    seed = checked_integer(seed, "seed", 0)
    smallest = float(np.finfo(float).tiny)
    scale = checked_number(scale, "scale", "a number > 0 (0.001 for millimetres)", smallest)
    path = name_or_path if isinstance(name_or_path, str | Path) else _stored(name_or_path)
    factor = f"{scale:g}" if float(f"{scale:g}") == scale else repr(scale)
    name = str(path) if scale == 1.0 else f"{path}@{factor}"
    thing = load_object(name)
    vertices, triangles = thing.mesh(resolution=96)
    vertices, triangles, notes = _body(name, vertices, triangles)
    notes = (*(thing.shape.notes if isinstance(thing.shape, MeshShape) else ()), *notes)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    rng = np.random.default_rng(seed)
    face = rng.choice(len(triangles), chosen.samples, p=doubled / doubled.sum())
    u, v = np.sqrt(rng.random(chosen.samples)), rng.random(chosen.samples)
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points = (corners[face] * weights[..., None]).sum(axis=1)
    faces = normals[face] / doubled[face, None]
    # Of a small object fewer samples are as dense; without bound all are neighbours of all.
    occupied = len(np.unique(np.floor(points / chosen.patch), axis=0))
    count = min(chosen.samples, max(LEAST_SAMPLES, chosen.density * occupied))
    points, faces = points[:count], faces[:count]
    return replace(_smoothed(name, thing, points, faces, corners[doubled > 0], chosen), notes=notes)


def _stored(source: Any) -> Path:
    """Write a mesh into the cache, unless it is there, and return its path.

    Raises:
        InputError: The source is not a mesh.
    """
    if hasattr(source, "vertices") and hasattr(source, "faces"):
        pair = source.vertices, source.faces
    elif isinstance(source, tuple | list) and len(source) == 2:
        pair = source
    else:
        shape = f" of shape {source.shape}" if isinstance(source, np.ndarray) else ""
        found = f"{type(source).__name__}{shape}"
        raise InputError(f"surface: found an object of type {found}, {EXPECTED_SOURCE}")
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
            f"surface: found vertex numbers from {triangles.min()} to {triangles.max()}, "
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
            with written_whole(path) as part:
                part.write_text(text, encoding="ascii")
    return path


LEAST_SAMPLES = 500
"""Minimum number of samples of a small object."""

SIZES = (5e-3, 2.0)
"""Least and largest edge of the box around an object that a hand may grasp [m]."""

FLAT = 1e-4
"""What is thinner has no two sides for a hand [m]."""

DISAGREE = 0.05
"""Share of edges whose two triangles may face opposite ways: scans have some."""


def _body(
    name: str, vertices: Array, triangles: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64], tuple[str, ...]]:
    """A mesh whose triangles face outwards, and what was odd about it.

    Raises:
        InputError: It is no body's, see `load_surface`.
    """
    corners = vertices[triangles]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not np.linalg.norm(crossed, axis=1).sum() > 0:
        raise InputError(f"{name}: found a surface without area, expected a mesh of a body")
    largest = np.ptp(vertices, axis=0).max()
    if not SIZES[0] <= largest <= SIZES[1]:
        raise InputError(
            f"{name}: found a size of {largest:.3g} m, expected metres, from {SIZES[0]:g} to "
            f"{SIZES[1]:g} m; scale=0.001 is for millimetres"
        )
    middle = vertices.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((vertices - middle).T))
    thin = np.ptp(vertices @ axes[:, 0])
    if thin < FLAT:
        raise InputError(
            f"{name}: found a flat sheet ({1e3 * thin:.2g} mm), expected a mesh of a body"
        )
    notes: list[str] = []
    _, same = np.unique(np.round(vertices, 7), axis=0, return_inverse=True)
    merged = same.reshape(-1)[triangles]
    edges = merged[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    forward = edges[:, 0] < edges[:, 1]
    key = np.sort(edges, axis=1) @ np.array([len(vertices), 1])
    _, edge, users = np.unique(key, return_inverse=True, return_counts=True)
    ways = np.bincount(edge, weights=forward)
    wrong = int(((users == 2) & (ways != 1)).sum())
    if wrong > DISAGREE * len(users):
        raise InputError(
            f"{name}: found triangles that face opposite ways at {wrong:,} of {len(users):,} "
            "edges, expected outward normals; trimesh.repair.fix_normals mends such a mesh"
        )
    border = int((users == 1).sum())
    if border:
        notes.append(f"the mesh is open: {border:,} edges have one triangle only")
    volume = ((corners[:, 0] - middle) * crossed).sum() / 6
    if volume < 0:
        notes.append("the mesh was inside out: its triangles are turned")
        triangles = triangles[:, ::-1]
    return vertices, triangles, tuple(notes)


def _smoothed(
    name: str,
    thing: GraspObject,
    points: Array,
    faces: Array,
    corners: Array,
    chosen: SurfaceParameters,
) -> Surface:
    """The surface of samples whose normals are averaged over their neighbours."""
    tree = _tree(points)

    def links(radius: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        pairs = tree.query_pairs(radius, output_type="ndarray")
        every = np.arange(len(points))
        return (
            np.concatenate([pairs[:, 0], pairs[:, 1], every]),
            np.concatenate([pairs[:, 1], pairs[:, 0], every]),
        )

    # Sides of a thin wall that face away from each other are no neighbours.
    one, other = links(chosen.smoothing)
    alike = (faces[one] * faces[other]).sum(axis=1) > 0
    normals = np.zeros_like(points)
    np.add.at(normals, one[alike], faces[other[alike]])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    one, other = links(chosen.patch)
    bent = (normals[one] * faces[other]).sum(axis=1) < np.cos(chosen.bend)
    inside = np.ones(len(points), dtype=bool)
    inside[one[bent]] = False
    return Surface(name, thing, points, normals, faces, inside, corners, chosen)
