"""Intersection tests between triangle meshes, for many relative poses at a time."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import optional_import
from casadi_ik.files.arrays import Array

with optional_import("shapes of imported links"):
    from scipy.spatial import ConvexHull, QhullError

Rows = NDArray[np.intp]
Boxes = tuple[Array, Array]
"""Centres and half edges (3, n) of axis-aligned boxes."""

MAX_PAIRS = 4096
"""Maximum number of pairs of boxes in one array operation; more do not fit into a core's cache."""

MAX_HULL_STEPS = 30
"""Maximum number of steps towards the nearest points of two convex hulls."""

MIN_GAP = 1e-9
"""Gap above which two convex hulls are regarded as separate, for rounding errors [m]."""


class CollisionTree:
    """A mesh in a balanced binary tree of axis-aligned boxes, and its convex hull.

    Level k has 2^k boxes; each box of the last level holds one triangle. Triangles are repeated to
    fill the last level. Hull and tree are built when they are needed.
    """

    def __init__(self, triangles: Array) -> None:
        """Store the triangles (t, 3, 3) [m]."""
        self.triangles = triangles

    @cached_property
    def hull(self) -> Array:
        """Return the vertices (v, 3) of the convex hull; all vertices of a flat mesh."""
        points = self.triangles.reshape(-1, 3)
        try:
            return points[ConvexHull(points).vertices]
        except (QhullError, ValueError):  # the points are in a plane, or too few
            return points

    @cached_property
    def leaves(self) -> Array:
        """Return the triangles (n, 3, 3) in the order of the boxes of the last level."""
        depth = max(len(self.triangles) - 1, 0).bit_length()
        order = np.resize(np.arange(len(self.triangles)), 2**depth)[None]
        centroids = self.triangles.mean(axis=1)
        while order.shape[1] > 1:  # halve each box along its longest edge
            points = centroids[order]
            longest = np.ptp(points, axis=1).argmax(axis=1)
            coordinates = np.take_along_axis(points, longest[:, None, None], axis=2)[:, :, 0]
            middle = order.shape[1] // 2
            partition = coordinates.argpartition(middle, axis=1)
            order = np.take_along_axis(order, partition, axis=1)
            order = order.reshape(2 * len(order), -1)
        return self.triangles[order[:, 0]]

    @cached_property
    def corners(self) -> Array:
        """Return the leaves as (3, 3, n): corner, coordinate, triangle."""
        return np.ascontiguousarray(self.leaves.transpose(1, 2, 0))

    @cached_property
    def levels(self) -> list[Boxes]:
        """Return the boxes of each level, from the box of the mesh to those of the triangles."""
        low, high = self.leaves.min(axis=1), self.leaves.max(axis=1)
        levels = [_boxes(low, high)]
        while len(low) > 1:
            low = low.reshape(-1, 2, 3).min(axis=1)
            high = high.reshape(-1, 2, 3).max(axis=1)
            levels.insert(0, _boxes(low, high))
        return levels

    def intersects(
        self, other_tree: CollisionTree, poses: Array, stop_at_first: bool = False
    ) -> NDArray[np.bool_]:
        """Return in which relative poses a triangle of this mesh crosses one of another mesh.

        Triangles in a common plane do not count as crossing.

        Args:
            other_tree: Tree of the other mesh.
            poses: (k, 4, 4) poses of the other mesh's frame in the frame of this one.
            stop_at_first: Whether to return as soon as one pose with an intersection is known.

        Returns:
            (k,) True where the meshes intersect; with `stop_at_first` at least one of these poses.
        """
        crossing = np.zeros(len(poses), bool)
        rows = np.flatnonzero(~hulls_are_separate(self.hull, other_tree.hull, poses))
        if len(rows):  # most meshes that do not intersect are separated by a plane
            crossing[rows] = self._triangles_cross(other_tree, poses[rows], stop_at_first)
        return crossing

    def _triangles_cross(
        self, other_tree: CollisionTree, poses: Array, stop_at_first: bool
    ) -> NDArray[np.bool_]:
        """Return the result of `intersects` by traversal of both trees."""
        crossing = np.zeros(len(poses), bool)
        rotations = np.ascontiguousarray(poses[:, :3, :3].transpose(1, 2, 0))
        translations = np.ascontiguousarray(poses[:, :3, 3].T)
        zeros = np.zeros(len(poses), np.intp)
        stack = [(0, 0, zeros, zeros, np.arange(len(poses)))]
        last = len(self.levels) - 1, len(other_tree.levels) - 1
        while stack:
            level, other_level, rows, columns, pose = stack.pop()
            if len(rows) > MAX_PAIRS:  # depth first: an intersection makes the rest unnecessary
                stack.append(
                    (level, other_level, rows[MAX_PAIRS:], columns[MAX_PAIRS:], pose[MAX_PAIRS:])
                )
                rows, columns, pose = rows[:MAX_PAIRS], columns[:MAX_PAIRS], pose[:MAX_PAIRS]
            pending = ~crossing[pose]
            if not pending.all():
                rows, columns, pose = rows[pending], columns[pending], pose[pending]
            rotation, translation = rotations[:, :, pose], translations[:, pose]
            overlaps = _overlap(
                [part[:, rows] for part in self.levels[level]],
                [part[:, columns] for part in other_tree.levels[other_level]],
                rotation,
                translation,
            )
            rows, columns, pose = rows[overlaps], columns[overlaps], pose[overlaps]
            if not len(rows):
                continue
            if (level, other_level) == last:
                rotation, translation = rotation[:, :, overlaps], translation[:, overlaps]
                corners = [
                    _dot(rotation, corner[:, columns]) + translation
                    for corner in other_tree.corners
                ]
                crossed = _cross(self.corners[:, :, rows], np.stack(corners))
                crossing[pose[crossed]] = True
                if stop_at_first and crossed.any():
                    break
                continue
            # The larger boxes are split first, so that both trees shrink alike.
            if level < last[0]:
                rows = np.concatenate([2 * rows, 2 * rows + 1])
                columns, pose = np.concatenate([columns] * 2), np.concatenate([pose] * 2)
            if other_level < last[1]:
                columns = np.concatenate([2 * columns, 2 * columns + 1])
                rows, pose = np.concatenate([rows] * 2), np.concatenate([pose] * 2)
            stack.append(
                (min(level + 1, last[0]), min(other_level + 1, last[1]), rows, columns, pose)
            )
        return crossing


def hulls_are_separate(points: Array, other_points: Array, poses: Array) -> NDArray[np.bool_]:
    """Return in which relative poses a plane between two convex hulls is found (k,).

    The method of Frank and Wolfe moves a point of the difference of the hulls towards the origin.
    The hulls are separate if the whole difference is on the far side of a plane through the origin
    that is perpendicular to the vector to this point. Hulls that nearly touch may not be decided.

    Args:
        points: (v, 3) vertices of the first hull.
        other_points: (w, 3) vertices of the second hull, in its frame.
        poses: (k, 4, 4) poses of the second frame in the first one.

    Source: E. G. Gilbert, An iterative procedure for computing the minimum of a quadratic form on a
    convex set, 1966.
    """
    rotations, origins = poses[:, :3, :3], poses[:, :3, 3]
    is_separate = np.zeros(len(poses), bool)
    difference = points.mean(axis=0) - (rotations @ other_points.mean(axis=0) + origins)
    rows = np.arange(len(poses))
    for _ in range(MAX_HULL_STEPS):
        rotation, vector = rotations[rows], difference[rows]
        nearest = points[(vector @ points.T).argmin(axis=1)]
        local_vector = np.einsum("kij,ki->kj", rotation, vector)
        other_nearest = other_points[(local_vector @ other_points.T).argmax(axis=1)]
        other_nearest = np.einsum("kij,kj->ki", rotation, other_nearest) + origins[rows]
        extreme = nearest - other_nearest
        gap = np.einsum("ki,ki->k", extreme, vector)
        is_separate[rows] = gap > MIN_GAP * np.linalg.norm(vector, axis=1)
        step = extreme - vector
        squared_length = np.maximum(np.einsum("ki,ki->k", step, step), 1e-30)  # [m^2]
        fraction = np.clip(-np.einsum("ki,ki->k", vector, step) / squared_length, 0, 1)
        difference[rows] += fraction[:, None] * step
        rows = rows[~is_separate[rows]]
        if not len(rows):
            break
    return is_separate


def _boxes(low: Array, high: Array) -> Boxes:
    return (
        np.ascontiguousarray((low + high).T) / 2,
        np.ascontiguousarray((high - low).T) / 2,
    )


def _dot(rotation: Array, vectors: Array) -> Array:
    """Return the products (3, m) of matrices (3, 3, m) and vectors (3, m)."""
    return np.stack(
        [row[0] * vectors[0] + row[1] * vectors[1] + row[2] * vectors[2] for row in rotation]
    )


def _overlap(
    box: list[Array], other_box: list[Array], rotation: Array, translation: Array
) -> NDArray[np.bool_]:
    """Return which pairs of boxes overlap along the axes of both frames (m,)."""
    absolute = np.abs(rotation)
    offset = _dot(rotation, other_box[0]) + translation - box[0]
    reach = box[1] + _dot(absolute, other_box[1])
    overlaps = (np.abs(offset) <= reach).all(axis=0)
    inverse, absolute = rotation.transpose(1, 0, 2), absolute.transpose(1, 0, 2)
    reach = other_box[1] + _dot(absolute, box[1])
    separated = (np.abs(_dot(inverse, offset)) > reach).any(axis=0)
    return np.logical_and(overlaps, ~separated)


def _vector_product(a: Array, b: Array) -> Array:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _inner(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _spans_plane(triangle: Array, other_triangle: Array) -> NDArray[np.bool_]:
    """Return for which pairs (3, 3, m) the second triangle crosses the plane of the first (m,)."""
    origin = triangle[0]
    normal = _vector_product(triangle[1] - origin, triangle[2] - origin)
    heights = np.stack([_inner(corner - origin, normal) for corner in other_triangle])
    return (heights.min(axis=0) <= 0) & (heights.max(axis=0) >= 0)


def _cross(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return which pairs of triangles (3, 3, m) cross: an edge of one passes through the other.

    Source: T. Moeller, B. Trumbore, Fast, minimum storage ray-triangle intersection, 1997.
    """
    crossed = np.zeros(first.shape[2], bool)
    candidates = np.flatnonzero(_spans_plane(first, second))
    candidates = candidates[_spans_plane(second[:, :, candidates], first[:, :, candidates])]
    if not len(candidates):
        return crossed
    first, second = first[:, :, candidates], second[:, :, candidates]
    through = np.zeros(len(candidates), bool)
    for edges, faces in ((first, second), (second, first)):
        corner = faces[0]
        side, edge = faces[1] - corner, faces[2] - corner
        for i in range(3):
            direction, start = edges[(i + 1) % 3] - edges[i], edges[i] - corner
            p, q = _vector_product(direction, edge), _vector_product(start, side)
            determinant = _inner(side, p)
            with np.errstate(all="ignore"):
                u = _inner(start, p) / determinant
                v = _inner(direction, q) / determinant
                t = _inner(edge, q) / determinant
                through |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
    crossed[candidates[through]] = True
    return crossed
