"""Shapes of meshes: distance to the triangles as they are, and the pieces that they consist of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import RAISED, limit
from casadi_ik.files.mesh_file import read_mesh
from casadi_ik.grasps.meshes import Mesh

MOST_PIECES = 256
"""Of an object."""

AT_ONCE = 2_000_000
"""Pairs of a point and a triangle that are looked at together."""

ROUNDED = 1e-6
"""How far a distance may be off that says only which triangles are near [m]."""

RAYS = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3, 3)))[0]
"""(3, 3, 3) axes of whose third a ray goes."""

BESIDE = 1e-6
"""A triangle is inside another piece if what is so far before it is [m]."""


@dataclass(frozen=True, eq=False)
class MeshShape:
    """A body bounded by triangles, in pieces that hang together.

    Attributes:
        pieces: Corners (v, 3) [m] and triangles (t, 3) of each.
    """

    pieces: tuple[Mesh, ...]

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside: (k,) for (k, 3), () for (3,)."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[0].reshape(array.shape[:-1])

    def normal(self, points: ArrayLike) -> Array:
        """Unit outward normal at the nearest surface point, same shape as the points."""
        array = np.asarray(points, dtype=float)
        return self._nearest(array.reshape(-1, 3))[1].reshape(array.shape)

    def mesh(self, resolution: int = 32) -> Mesh:
        """Its corners and triangles; the resolution does not matter."""
        del resolution
        starts = np.cumsum([0, *(len(points) for points, _ in self.pieces)])
        triangles = [faces + start for (_, faces), start in zip(self.pieces, starts, strict=False)]
        return np.concatenate([points for points, _ in self.pieces]), np.concatenate(triangles)

    @cached_property
    def _triangles(self) -> Array:
        """(t, 3, 3) corners of all triangles."""
        return np.concatenate([points[faces] for points, faces in self.pieces])

    @cached_property
    def _outside(self) -> Array:
        """(t, 3, 3) corners of the triangles that are not inside another, convex, piece."""
        kept = []
        for i, (points, faces) in enumerate(self.pieces):
            corners = points[faces]
            before = corners.mean(axis=1) + BESIDE * _normals(corners)
            hidden = np.zeros(len(corners), dtype=bool)
            for j, (others, planes) in enumerate(self.pieces):
                if i != j:
                    hidden |= _in_convex(others[planes], before)
            kept.append(corners[~hidden])
        found = np.concatenate(kept)
        return found if len(found) else self._triangles

    def _nearest(self, points: Array) -> tuple[Array, Array]:
        distance, normal = np.empty(len(points)), np.empty((len(points), 3))
        size = max(1, AT_ONCE // len(self._triangles))
        for start in range(0, len(points), size):
            some = slice(start, start + size)
            away, face = _to_triangles(points[some], self._outside)
            length = np.linalg.norm(away, axis=1)
            sign = np.where(_inside(points[some], self._triangles), -1.0, 1.0)
            far = length > 1e-9
            distance[some] = sign * length
            unit = away / np.where(far, length, 1.0)[:, None]
            normal[some] = np.where(far[:, None], sign[:, None] * unit, face)
        return distance, normal


def load_mesh_shape(files: Sequence[Path], scale: float, where: str) -> MeshShape:
    """The body that meshes make together.

    Args:
        files: Of meshes; what hangs together in a file is a piece.
        scale: By what factor it is larger than they say.
        where: File and key that name them, for messages.

    Raises:
        DescriptionError: A file is missing, no mesh, or has too many pieces.
    """
    pieces: list[Mesh] = []
    for file in files:
        points, triangles = read_mesh(file, where)
        pieces += pieces_of(scale * points, triangles)
    if len(pieces) > limit(MOST_PIECES):
        most = f"at most {limit(MOST_PIECES)} {RAISED}"
        raise DescriptionError(f"{where}: found {len(pieces)} pieces, expected {most}")
    return MeshShape(tuple(pieces))


def pieces_of(points: Array, triangles: NDArray[np.int64]) -> list[Mesh]:
    """What of a mesh hangs together at edges.

    Where a file has every triangle by itself (STL), corners are those at the same place. Where
    bodies touch there, those triangles of an edge belong together that come after one another.
    """
    edges, counts = _edges(triangles)
    if (counts < 2).any():
        points, numbers = np.unique(points, axis=0, return_inverse=True)
        triangles = numbers.reshape(-1)[triangles]
        edges, counts = _edges(triangles)
    of_triangle = np.arange(len(edges)) % len(triangles)
    order = np.lexsort((of_triangle, edges))
    of_two = of_triangle[order[counts[edges[order]] % 2 == 0]].reshape(-1, 2)
    labels = np.arange(len(triangles))
    while True:
        least = labels[of_two].min(axis=1)
        new = labels.copy()
        np.minimum.at(new, of_two.ravel(), np.repeat(least, 2))
        new = new[new]
        if (new == labels).all():
            break
        labels = new
    found: list[Mesh] = []
    for label in np.unique(labels):
        kept, numbers = np.unique(triangles[labels == label], return_inverse=True)
        found.append((points[kept], numbers.reshape(-1, 3).astype(np.int64)))
    return found


def _edges(triangles: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Number of each of the edges (3 t), all first ones first, and how many triangles have it."""
    ends = np.sort(np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    _, numbers, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return numbers.reshape(-1), counts


def _normals(corners: Array) -> Array:
    """(t, 3) unit normals of triangles (t, 3, 3), zero of those without area."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.where(length > 0, length, 1.0)


def _in_convex(corners: Array, points: Array) -> Bools:
    """(k,) whether points are behind the planes of all triangles."""
    ways = _normals(corners)
    offsets = np.sum(ways * corners[:, 0], axis=1)
    found = np.zeros(len(points), dtype=bool)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    size = max(1, AT_ONCE // len(corners))
    for start in range(0, len(near), size):
        some = near[start : start + size]
        found[some] = (points[some] @ ways.T < offsets).all(axis=1)
    return found


def _inside(points: Array, corners: Array) -> Bools:
    """(k,) whether points are enclosed by triangles (t, 3, 3).

    Along a ray, triangles that face it and those that face away are counted against each other; of
    three rays in odd directions two decide, so that a small hole does no harm.
    """
    votes = np.zeros(len(points), dtype=int)
    for turn in RAYS:
        flat, rays = corners @ turn, points @ turn
        low, high = flat[:, :, :2].min(axis=1), flat[:, :, :2].max(axis=1)
        crossed = np.ones((len(points), len(corners)), dtype=bool)
        for axis in range(2):
            place = rays[:, axis, None]
            crossed &= (place > low[:, axis]) & (place < high[:, axis])
        here, one = np.nonzero(crossed)
        sides = flat[one, :, :2] - rays[here, None, :2]
        x, y = sides[..., 0], sides[..., 1]
        areas = x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - y[:, [1, 2, 0]] * x[:, [2, 0, 1]]
        through = (areas > 0).all(axis=1) | (areas < 0).all(axis=1)
        whole = areas.sum(axis=1)
        height = (areas * flat[one, :, 2]).sum(axis=1) / np.where(through, whole, 1.0)
        ahead = through & (height > rays[here, 2])
        count = np.bincount(here[ahead], np.sign(whole[ahead]), len(points))
        votes += np.abs(count) > 0.5
    return votes >= 2


def _to_triangles(points: Array, corners: Array) -> tuple[Array, Array]:
    """From the nearest point of triangles (t, 3, 3) to points: (k, 3), and its unit normal."""
    middles = corners.mean(axis=1)
    radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    squares = (points**2).sum(axis=1)[:, None] + (middles**2).sum(axis=1)
    to_middle = np.sqrt(np.maximum(squares - 2 * points @ middles.T, 0.0))
    away, face = np.empty((len(points), 3)), np.empty((len(points), 3))
    for i, point in enumerate(points):
        near = np.flatnonzero(to_middle[i] - radii <= to_middle[i].min() + ROUNDED)
        off = point - _nearest_points(point, corners[near])
        best = int(np.argmin(np.einsum("ti,ti->t", off, off)))
        away[i] = off[best]
        face[i] = _normals(corners[near[best : best + 1]])[0]
    return away, face


def _nearest_points(point: Array, corners: Array) -> Array:
    """(t, 3) nearest to a point on triangles (t, 3, 3): in the plane, or on one of the edges."""
    a = corners[:, 0]
    normal = _normals(corners)
    foot = point - np.sum((point - a) * normal, axis=1, keepdims=True) * normal
    found, least = foot.copy(), np.full(len(corners), np.inf)
    within = np.linalg.norm(normal, axis=1) > 0
    for i in range(3):
        start, along = corners[:, i], corners[:, (i + 1) % 3] - corners[:, i]
        within &= np.sum(np.cross(along, foot - start) * normal, axis=1) >= 0
        length = np.maximum(np.sum(along * along, axis=1), 1e-300)
        share = np.clip(np.sum((point - start) * along, axis=1) / length, 0.0, 1.0)
        on_edge = start + share[:, None] * along
        far = np.sum((point - on_edge) ** 2, axis=1)
        nearer = far < least
        found = np.where(nearer[:, None], on_edge, found)
        least = np.where(nearer, far, least)
    return np.where(within[:, None], foot, found)
