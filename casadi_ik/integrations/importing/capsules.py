"""Fits of capsules and boxes that enclose the meshes of links, as entries of a description."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.solids import sphere_directions
from casadi_ik.errors import optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.integrations.importing.meshes import IndexedMesh, cluster_points
from casadi_ik.model.schema import LinkBoxEntry, LinkCapsuleEntry, LinkSphereEntry, ShapeEntry

with optional_import("shapes of imported links"):
    from scipy.spatial import KDTree
    from trimesh.remesh import subdivide_to_size

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class ShapeFitSettings:
    """Settings of the fit of capsules and boxes to links.

    Attributes:
        min_saving: Default fraction of the volume that another capsule has to save.
        samples: Number of points by which volumes are estimated.
        rounds: Rounds of the random search for a better axis.
        last_rounds: Rounds of the search in the final fit.
        axes_per_round: Random axes per round.
        corner_directions: Number of directions whose outermost corners determine a capsule; in the
            end it encloses all corners.
        cells: Grid cells along the longest edge of a mesh; one corner of each cell may determine a
            capsule.
        triangles: Number of triangles above which splits are decided on a simplified mesh.
        refined_splits: Number of best splits by a rough fit that are refined.
        extra_corners: Number of corners outside a capsule that take part in its last fit.
        pieces_per_length: Number of pieces into which the longest edge of a mesh is subdivided.
        box_saving: Fraction of the volume that another box has to save.
        box_points: Number of sample points along an edge of a box.
        grid: Resolution to which results are rounded up [1/m].
        large_link: Length above which a link may have `max_capsules` capsules [m].
        max_capsules: Default maximum number of capsules of a large link.
        max_capsules_of_small: Maximum number of capsules of a small link.
        min_size: Extent below which a mesh is ignored [m].
    """

    min_saving: float = 0.04
    samples: int = 1500
    rounds: int = 4
    last_rounds: int = 10
    axes_per_round: int = 12
    corner_directions: int = 160
    cells: int = 36
    triangles: int = 2000
    refined_splits: int = 3
    extra_corners: int = 60
    pieces_per_length: int = 12
    box_saving: float = 0.12
    box_points: int = 24
    grid: float = 1e4
    large_link: float = 0.13
    max_capsules: int = 4
    max_capsules_of_small: int = 2
    min_size: float = 1e-4


SHAPE_FIT = ShapeFitSettings()

SAME_POINT = 1e-7
"""Distance up to which points of two meshes are equal [m]; entries are rounded up by far more."""

RADIUS_FACTORS = np.array([1.0, 1.02, 1.05, 1.1, 1.2, 1.35, 1.5])
"""Radii that are tried, relative to the smallest one."""


@dataclass(frozen=True, eq=False)
class FittedCapsule:
    """A capsule around a segment.

    Attributes:
        first: (3,) first end of the segment [m].
        last: (3,) other end of the segment [m].
        radius: Radius [m].
    """

    first: Array
    last: Array
    radius: float

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        length = float(np.linalg.norm(self.last - self.first))
        return float(np.pi * self.radius**2 * (length + 4 / 3 * self.radius))

    def distances_to(self, points: Array) -> Array:
        """Return the distances (k,) of points from the capsule [m], negative inside."""
        segment = self.last - self.first
        t = (points - self.first) @ segment / max(float(segment @ segment), 1e-30)
        nearest = self.first + np.clip(t, 0, 1)[:, None] * segment
        return np.linalg.norm(points - nearest, axis=1) - self.radius

    def surface_points(self) -> Array:
        """Return sample points (k, 3) of the surface [m]."""
        segment = self.last - self.first
        length = float(np.linalg.norm(segment))
        axis = segment / length if length > 1e-12 else np.array([0, 0, 1.0])
        directions = sphere_directions(400)
        axial = directions @ axis
        cap_centers = np.where((axial > 0)[:, None], self.last, self.first)
        caps = cap_centers + self.radius * directions
        radial = directions - axial[:, None] * axis
        radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-12)
        axis_points = self.first + ((np.arange(len(directions)) * 0.618) % 1)[:, None] * segment
        return np.concatenate([caps, axis_points + self.radius * radial])


def fit_capsules(
    triangles: Array, max_capsules: int = 4, min_saving: float = SHAPE_FIT.min_saving
) -> tuple[list[FittedCapsule], float]:
    """Fit capsules that enclose a mesh.

    Where to split the mesh is decided on a simplified copy of it; the capsules are then fitted to
    the mesh itself.

    Args:
        triangles: (t, 3, 3) corners [m].
        max_capsules: Maximum number of capsules.
        min_saving: Fraction of the volume that another capsule has to save.

    Returns:
        The capsules, and the largest distance by which samples of their surface stand out beyond
        the mesh [m].
    """
    mesh = IndexedMesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    coarse = mesh.simplified(SHAPE_FIT.triangles, SHAPE_FIT.cells)
    pieces = _Pieces(subdivide(coarse.points[coarse.triangles]))
    parts, capsules = _split(pieces, max_capsules, min_saving)
    if coarse is not mesh:
        pieces = _Pieces(subdivide(triangles))
        outside = [
            capsule.distances_to(pieces.corners)[pieces.numbers].max(axis=1) for capsule in capsules
        ]
        nearest = np.argmin(outside, axis=0)
        parts = [rows for i in range(len(capsules)) if len(rows := np.flatnonzero(nearest == i))]
    capsules = [pieces.enclosing(part, SHAPE_FIT.last_rounds) for part in parts]
    return capsules, excess(capsules, np.concatenate([pieces.corners, pieces.centroids]))


def _split(
    pieces: _Pieces, max_capsules: int, min_saving: float
) -> tuple[list[Rows], list[FittedCapsule]]:
    """Split a mesh into parts, and enclose each in a capsule, as long as that saves volume."""
    parts = [np.arange(len(pieces.numbers))]
    capsules = [pieces.enclosing(parts[0], SHAPE_FIT.rounds)]
    samples = _points_inside(capsules[0])
    volume = 1.0
    splits: list[list[_Split] | None] = [None]

    def enclosed(i: int, pair: Sequence[FittedCapsule]) -> float:
        """Return the fraction of the samples inside the capsules if a pair replaces capsule i."""
        replaced = [*(capsule for j, capsule in enumerate(capsules) if j != i), *pair]
        distances = np.min([capsule.distances_to(samples) for capsule in replaced], axis=0)
        return float((distances <= 0).mean())

    while len(parts) < max_capsules:
        drafts: list[tuple[float, int, _Split]] = []
        for i, part in enumerate(parts):
            part_splits = splits[i] = splits[i] or pieces.splits(part)
            drafts += [(enclosed(i, split.draft), i, split) for split in part_splits]
        # The search for better axes is limited to the splits with the best draft capsules.
        drafts.sort(key=lambda draft: draft[0])
        options = [
            (enclosed(i, split.refined(pieces)), i, split)
            for _, i, split in drafts[: SHAPE_FIT.refined_splits]
        ]
        if not options:
            break
        new_volume, i, split = min(options, key=lambda option: option[0])
        if new_volume > volume - min_saving:
            break
        volume = new_volume
        parts[i : i + 1], capsules[i : i + 1] = split.parts, split.refined(pieces)
        splits[i : i + 1] = [None, None]
    return parts, capsules


class _Pieces:
    """The triangles of a mesh without long edges, prepared for fits of parts of them.

    Attributes:
        corners: (c, 3) corners [m].
        numbers: (t, 3) rows of the corners of each triangle.
        centroids: (t, 3) centroids of the triangles [m].
        outermost: (c,) True for corners that are the outermost of their grid cell.
    """

    def __init__(self, mesh: tuple[Array, Rows]) -> None:
        """Prepare a mesh of corners (c, 3) [m] and triangles (t, 3)."""
        self.corners, self.numbers = mesh
        self.centroids = self.corners[self.numbers].mean(axis=1)
        self.outermost = np.zeros(len(self.corners), bool)
        self.outermost[cluster_points(self.corners, SHAPE_FIT.cells)[0]] = True

    def enclosing(self, rows: Rows, rounds: int) -> FittedCapsule:
        """Return a small capsule that encloses the triangles of some rows.

        Args:
            rows: Rows of `numbers`.
            rounds: Number of rounds of the search for a better axis.
        """
        member = np.zeros(len(self.corners), bool)
        member[self.numbers[rows]] = True
        outermost = self.corners[member & self.outermost]
        corners = self.corners[member]
        return enclosing_capsule(
            self.centroids[rows], outermost if len(outermost) else corners, corners, rounds
        )

    def splits(self, rows: Rows) -> list[_Split]:
        """Return candidate splits of the triangles of some rows into two parts."""
        candidates = []
        for below in candidate_splits(self.centroids[rows]):
            parts = rows[below], rows[~below]
            candidates.append(_Split(parts, [self.enclosing(part, 0) for part in parts]))
        return candidates


@dataclass(eq=False)
class _Split:
    """A split of a part of a mesh into two parts.

    Attributes:
        parts: Rows of the triangles of each part.
        draft: Capsule of each part along a principal axis.
        best: Capsule of each part after the search for better axes; empty before it.
    """

    parts: tuple[Rows, Rows]
    draft: list[FittedCapsule]
    best: list[FittedCapsule] = field(default_factory=list)

    def refined(self, pieces: _Pieces) -> list[FittedCapsule]:
        """Return a small capsule for each part."""
        self.best = self.best or [pieces.enclosing(part, SHAPE_FIT.rounds) for part in self.parts]
        return self.best


def enclosing_capsule(
    centroids: Array, candidates: Array, corners: Array, rounds: int = SHAPE_FIT.rounds
) -> FittedCapsule:
    """Return a small capsule that encloses points.

    Args:
        centroids: (k, 3) centroids of triangles, whose principal axes start the search [m].
        candidates: (c, 3) corners; the outermost ones determine the capsule [m].
        corners: (m, 3) corners that the capsule encloses [m].
        rounds: Number of rounds of the search for a better axis.
    """
    axes = _principal_axes(centroids)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(SHAPE_FIT.corner_directions, 3))
    extreme = (directions @ np.ascontiguousarray(candidates.T)).argmax(axis=1)
    outermost = candidates[np.unique(extreme)]
    best, axis = _smallest_along(outermost, axes)
    perturbation = 0.3
    for _ in range(rounds):
        directions = axis + perturbation * rng.normal(size=(SHAPE_FIT.axes_per_round, 3))
        capsule, direction = _smallest_along(
            outermost, directions / np.linalg.norm(directions, axis=1, keepdims=True)
        )
        if capsule.volume < best.volume:
            best, axis = capsule, direction
        perturbation *= 0.5
    distance = best.distances_to(corners)
    if rounds:  # corners outside the capsule take part in a last fit, to keep its radius small
        outside = np.argpartition(-distance, min(SHAPE_FIT.extra_corners, len(distance)) - 1)[
            : SHAPE_FIT.extra_corners
        ]
        capsule, _ = _smallest_along(np.concatenate([outermost, corners[outside]]), axis[None])
        widened = capsule.distances_to(corners)
        if _with_radius_for(capsule, widened).volume < _with_radius_for(best, distance).volume:
            best, distance = capsule, widened
    return _with_radius_for(best, distance)


def _with_radius_for(capsule: FittedCapsule, distances: Array) -> FittedCapsule:
    """Return the capsule with a radius that encloses points at some distances (k,) from it."""
    radius = capsule.radius + float(np.maximum(distances, 0).max()) + 1e-9
    return FittedCapsule(capsule.first, capsule.last, radius)


def _smallest_along(points: Array, axes: Array) -> tuple[FittedCapsule, Array]:
    """Return the smallest enclosing capsule along given axes (a, 3), and its axis."""
    side = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    frames = np.stack([side, np.cross(axes, side), axes], axis=2)
    local = points @ frames
    xy, z = local[:, :, :2], local[:, :, 2]
    rows = np.arange(len(axes))
    center = (xy.min(axis=1) + xy.max(axis=1)) / 2
    for i in range(16):  # towards the centre of the smallest circle
        offsets = xy - center[:, None]
        farthest = (offsets**2).sum(axis=2).argmax(axis=1)
        center = center + offsets[rows, farthest] / (i + 2)
    distance = np.linalg.norm(xy - center[:, None], axis=2)
    radii = distance.max(axis=1)[:, None] * RADIUS_FACTORS
    cap_height = np.sqrt(np.maximum(radii[:, :, None] ** 2 - distance[:, None] ** 2, 0))
    low, high = (z[:, None] + cap_height).min(axis=2), (z[:, None] - cap_height).max(axis=2)
    middle = (z.min(axis=1) + z.max(axis=1))[:, None] / 2
    sphere_radius = np.hypot(distance, z - middle).max(axis=1)[:, None]
    is_sphere = high < low
    low, high = np.where(is_sphere, middle, low), np.where(is_sphere, middle, high)
    radii = np.where(is_sphere, sphere_radius, radii)
    volumes = radii**2 * (high - low + 4 / 3 * radii)
    a, r = np.unravel_index(int(volumes.argmin()), volumes.shape)
    first, last = (frames[a] @ np.array([*center[a], height[a, r]]) for height in (low, high))
    return FittedCapsule(first, last, float(radii[a, r])), axes[a]


def _points_inside(capsule: FittedCapsule) -> Array:
    """Return uniform sample points (k, 3) inside a capsule."""
    rng = np.random.default_rng(0)
    segment = np.stack([capsule.first, capsule.last])
    low, high = segment.min(axis=0) - capsule.radius, segment.max(axis=0) + capsule.radius
    points = rng.uniform(low, high, (3 * SHAPE_FIT.samples, 3))
    return points[capsule.distances_to(points) <= 0][: SHAPE_FIT.samples]


def candidate_splits(centroids: Array) -> list[NDArray[np.bool_]]:
    """Return masks (t,) of one of two parts of triangles, split across their principal axes.

    Args:
        centroids: (t, 3) centroids of the triangles [m].
    """
    masks = []
    for axis in _principal_axes(centroids):
        coordinate = centroids @ axis
        for fraction in (0.3, 0.5, 0.7):
            below = coordinate < coordinate.min() + fraction * np.ptp(coordinate)
            if 4 <= below.sum() <= len(centroids) - 4:
                masks.append(below)
    return masks


def _principal_axes(points: Array) -> Array:
    """Return the principal axes (3, 3) of points in rows, the longest first."""
    offsets = points - points.mean(axis=0)
    return np.linalg.eigh(offsets.T @ offsets)[1].T[::-1]


def subdivide(triangles: Array) -> tuple[Array, Rows]:
    """Subdivide triangles (t, 3, 3) with long edges; return corners (c, 3) and triangles (t, 3)."""
    corners = triangles.reshape(-1, 3)
    max_edge = float(np.ptp(corners, axis=0).max()) / SHAPE_FIT.pieces_per_length
    rows = np.arange(len(corners)).reshape(-1, 3)
    finer = subdivide_to_size(corners, rows, max_edge, max_iter=50)
    corners, numbers = np.unique(np.asarray(finer[0], dtype=float), axis=0, return_inverse=True)
    return corners, numbers.reshape(-1)[finer[1]]


def excess(shapes: Sequence[FittedCapsule | FittedBox], points: Array) -> float:
    """Return the largest distance of shape surfaces from the points of a mesh [m], by samples."""
    samples = np.concatenate([shape.surface_points() for shape in shapes])
    is_inside = np.min([shape.distances_to(samples) for shape in shapes], axis=0) < -1e-6
    return float(KDTree(points).query(samples[~is_inside])[0].max(initial=0.0))


@dataclass(frozen=True, eq=False)
class FittedBox:
    """An oriented box.

    Attributes:
        rotation: (3, 3) axes of the box in columns.
        center: (3,) centre [m].
        size: (3,) edge lengths [m].
    """

    rotation: Array
    center: Array
    size: Array

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        return float(np.prod(self.size))

    def distances_to(self, points: Array) -> Array:
        """Return the distances (k,) of points from the faces [m], negative inside."""
        local = np.abs((points - self.center) @ self.rotation) - self.size / 2
        return local.max(axis=1)

    def surface_points(self) -> Array:
        """Return sample points (k, 3) of the surface [m]."""
        line = np.linspace(-0.5, 0.5, SHAPE_FIT.box_points)
        u, v = (grid.ravel() for grid in np.meshgrid(line, line))
        faces = []
        for axis in range(3):
            for side in (-0.5, 0.5):
                face = np.empty((len(u), 3))
                face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
                faces.append(face)
        return self.center + (np.concatenate(faces) * self.size) @ self.rotation.T


def fit_boxes(triangles: Array, max_boxes: int = 3) -> list[FittedBox]:
    """Fit at most `max_boxes` boxes that enclose triangles (t, 3, 3) [m]."""
    corners, numbers = subdivide(triangles)
    parts = [corners[numbers]]
    boxes = [enclosing_box(parts[0].reshape(-1, 3))]
    while len(parts) < max_boxes:
        options = []
        for i, part in enumerate(parts):
            for below in candidate_splits(part.mean(axis=1)):
                halves = part[below], part[~below]
                pair = [enclosing_box(corners.reshape(-1, 3)) for corners in halves]
                saved = boxes[i].volume - pair[0].volume - pair[1].volume
                options.append((saved, i, halves, pair))
        if not options:
            break
        saved, i, halves, pair = max(options, key=lambda option: option[0])
        if saved < SHAPE_FIT.box_saving * sum(box.volume for box in boxes):
            break
        parts[i : i + 1], boxes[i : i + 1] = halves, pair
    return boxes


def enclosing_box(points: Array) -> FittedBox:
    """Return a small box around points (k, 3) [m], along the frame or the principal axes."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    boxes = []
    for rotation in (np.eye(3), axes.T):
        local = points @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        boxes.append(FittedBox(rotation, rotation @ ((low + high) / 2), high - low))
    # The axes of the frame are preferred, because they give simpler numbers.
    return boxes[1] if boxes[1].volume < 0.9 * boxes[0].volume else boxes[0]


def fit_links(
    meshes: Mapping[str, IndexedMesh],
    flat: Collection[str],
    simple_shapes: Mapping[str, Sequence[ShapeEntry]] | None = None,
    max_capsules: int = SHAPE_FIT.max_capsules,
    min_saving: float = SHAPE_FIT.min_saving,
    report: Callable[[int], object] | None = None,
) -> dict[str, list[ShapeEntry]]:
    """Return the shapes that enclose links, by link.

    Args:
        meshes: Meshes by link, in the frame of the link.
        flat: Links that boxes may enclose, such as palms, to which fingers come close.
        simple_shapes: Boxes, cylinders and so on by link, which are returned unchanged.
        max_capsules: Maximum number of capsules of a large link.
        min_saving: Fraction of the volume that another capsule has to save.
        report: Function called with the number of links that have been enclosed since.
    """
    shapes: dict[str, list[ShapeEntry]] = {}
    fitted: list[str] = []
    for link, mesh in meshes.items():
        extent = float(np.ptp(mesh.points, axis=0).max())
        if simple_shapes and link in simple_shapes:
            shapes[link] = list(simple_shapes[link])
        elif len(mesh.triangles) and extent > SHAPE_FIT.min_size:
            count = (
                max_capsules if extent > SHAPE_FIT.large_link else SHAPE_FIT.max_capsules_of_small
            )
            # The fingers of a hand often have the same phalanges, each in a separate file.
            twin = next(
                (
                    candidate
                    for candidate in fitted
                    if (candidate in flat) == (link in flat) and is_same(mesh, meshes[candidate])
                ),
                None,
            )
            if twin is not None:
                shapes[link] = list(shapes[twin])
            else:
                triangles = mesh.points[mesh.triangles]
                shapes[link] = _enclosing_shapes(triangles, count, link in flat, min_saving)
                fitted.append(link)
        if report is not None:
            report(1)
    return shapes


def is_same(mesh: IndexedMesh, other_mesh: IndexedMesh) -> bool:
    """Return whether two meshes have the same triangles in any order, except for rounding."""
    if mesh.triangles.shape != other_mesh.triangles.shape:
        return False
    corners, other_corners = (m.points[m.triangles] for m in (mesh, other_mesh))
    for end in (np.min, np.max):
        if np.abs(end(corners, axis=(0, 1)) - end(other_corners, axis=(0, 1))).max() > SAME_POINT:
            return False
    tree = KDTree(other_corners.mean(axis=1))
    distances, _ = tree.query(corners.mean(axis=1), distance_upper_bound=2 * SAME_POINT)
    return bool(distances.max() <= SAME_POINT)


def _enclosing_shapes(
    triangles: Array, max_capsules: int, is_flat: bool, min_saving: float
) -> list[ShapeEntry]:
    """Return enclosing capsules of a mesh, or boxes if they are allowed and closer."""
    capsules, capsule_excess = fit_capsules(triangles, max_capsules, min_saving)
    boxes = fit_boxes(triangles) if is_flat else []
    if boxes:
        box_excess = excess(boxes, subdivide(triangles)[0])
        if box_excess < capsule_excess:
            return [_box_entry(box, _ceil(box_excess, 1e3)) for box in boxes]
    return [_capsule_entry(capsule, _ceil(capsule_excess, 1e3)) for capsule in capsules]


def _capsule_entry(capsule: FittedCapsule, capsule_excess: float) -> ShapeEntry:
    """Return a capsule, or a sphere, whose rounded numbers enclose the fitted capsule."""
    first, last = (_rounded(end) for end in (capsule.first, capsule.last))
    radius = math.ceil(capsule.radius * SHAPE_FIT.grid + 0.9) / SHAPE_FIT.grid
    if first == last:
        return LinkSphereEntry(radius=radius, center=first, excess=capsule_excess)
    return LinkCapsuleEntry(ends=(first, last), radius=radius, excess=capsule_excess)


def _box_entry(box: FittedBox, box_excess: float) -> ShapeEntry:
    """Return a box whose rounded numbers enclose the fitted box."""
    size = np.ceil(box.size * SHAPE_FIT.grid + 1.1) / SHAPE_FIT.grid
    rpy = np.round(roll_pitch_yaw(box.rotation), 4)
    if np.any(rpy):  # enlarge the box by the largest effect of rounding the angles
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * SHAPE_FIT.grid) / SHAPE_FIT.grid
    x, y, z = size.tolist()
    roll, pitch, yaw = (rpy + 0.0).tolist()
    return LinkBoxEntry(
        size=(x, y, z), xyz=_rounded(box.center), rpy=(roll, pitch, yaw), excess=box_excess
    )


def _rounded(point: Array) -> tuple[float, float, float]:
    """Return a point on the grid of `SHAPE_FIT`."""
    x, y, z = (np.round(point * SHAPE_FIT.grid) / SHAPE_FIT.grid + 0.0).tolist()
    return x, y, z


def _ceil(value: float, grid: float) -> float:
    return math.ceil(grid * value) / grid


def largest_excess(shapes: Mapping[str, Sequence[ShapeEntry]]) -> float:
    """Return the largest excess of shapes beyond the meshes that they enclose [m]."""
    return max((shape.excess for entries in shapes.values() for shape in entries), default=0.0)
