"""Exact nearest points on a triangle mesh, with the mean normals of adjacent triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.compile.codegen import c_struct
from casadi_ik.files.arrays import Array
from casadi_ik.planning.touch.hands import touch_library

COINCIDENT = 2.5e-4
"""Triangles within this distance of a nearest point count as adjacent to it [m].

The nearest point of a pad and the point of its contact differ by up to 1 mm along the normal, and
may have different nearest triangles close to an edge.
"""

LEAF_SIZE = 4
"""Number of triangles in a leaf of the tree (runtime/nearest.c)."""

MORTON_BITS = 20
"""Number of bits of a coordinate in the Morton order of the triangles."""


@dataclass(frozen=True)
class NearestPoints:
    """Nearest points on a mesh.

    Attributes:
        point: (..., 3) nearest points [m].
        normal: (..., 3) unit outward normals: means over the adjacent triangles.
        normal_spread: (...) maximum angle between this normal and those of the triangles [rad].
    """

    point: Array
    normal: Array
    normal_spread: Array


NearestJob = c_struct("nearest_job", driver="nearest")


class TriangleTree:
    """Tree of bounding boxes for nearest points on a triangle mesh."""

    def __init__(self, corners: Array) -> None:
        """Build the tree.

        Args:
            corners: (t, 3, 3) corners of triangles with an area above 0 [m].
        """
        corners = np.ascontiguousarray(corners[_morton_order(corners.mean(axis=1))])
        area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = area_vectors / np.linalg.norm(area_vectors, axis=1, keepdims=True)
        leaves = 1 << max(0, int(np.ceil(np.log2(-(-len(corners) // LEAF_SIZE)))))
        # Boxes with lower corners above their upper corners are empty.
        boxes = np.tile([np.inf] * 3 + [-np.inf] * 3, (leaves * LEAF_SIZE, 1))
        boxes[: len(corners), :3] = corners.min(axis=1)
        boxes[: len(corners), 3:] = corners.max(axis=1)
        levels, group = [], LEAF_SIZE
        while len(boxes) > 1 or not levels:
            grouped = boxes.reshape(-1, group, 6)
            boxes = np.concatenate(
                [grouped[..., :3].min(axis=1), grouped[..., 3:].max(axis=1)], axis=1
            )
            levels.append(boxes)
            group = 2
        self._leaves = leaves
        self._arrays = {
            "corners": corners,
            "normals": np.ascontiguousarray(normals),
            "boxes": np.ascontiguousarray(np.concatenate(levels[::-1])),
        }

    def nearest(self, points: Array) -> NearestPoints:
        """Return the nearest points on the mesh to points (..., 3).

        Raises:
            UnsupportedError: There is no C compiler.
        """
        shape = points.shape[:-1]
        count = int(np.prod(shape))
        results = {
            "feet": np.empty((*shape, 3)),
            "mean_normals": np.empty((*shape, 3)),
            "min_cosines": np.empty(shape),
        }
        arrays: dict[str, Any] = {
            **self._arrays,
            **results,
            "queries": np.ascontiguousarray(points),
        }
        job = NearestJob(
            **{name: array.ctypes.data for name, array in arrays.items()},
            coincident=COINCIDENT,
            n_triangles=len(self._arrays["corners"]),
            leaves=self._leaves,
            count=count,
            slice=SLICE,
        )
        run_cancellable("nearest", touch_library()["casadi_ik_nearest"], job)
        cosine = results["min_cosines"]
        normal_spread = np.where(cosine > 1 - 1e-12, 0.0, np.arccos(np.clip(cosine, -1, 1)))
        return NearestPoints(results["feet"], results["mean_normals"], normal_spread)


def _morton_order(points: Array) -> NDArray[np.intp]:
    """Return the order of points (k, 3) along a Morton curve, which keeps neighbours close."""
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    cells = ((points - low) / size * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(points), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
