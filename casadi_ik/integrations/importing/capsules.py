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
        along = self.last - self.first
        t = (points - self.first) @ along / max(float(along @ along), 1e-30)
        foot = self.first + np.clip(t, 0, 1)[:, None] * along
        return np.linalg.norm(points - foot, axis=1) - self.radius

    def surface_points(self) -> Array:
        """Return sample points (k, 3) of the surface [m]."""
        along = self.last - self.first
        length = float(np.linalg.norm(along))
        axis = along / length if length > 1e-12 else np.array([0, 0, 1.0])
        ball = sphere_directions(400)
        up = ball @ axis
        ends = np.where((up > 0)[:, None], self.last, self.first) + self.radius * ball
        flat = ball - up[:, None] * axis
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        mantle = self.first + ((np.arange(len(ball)) * 0.618) % 1)[:, None] * along
        return np.concatenate([ends, mantle + self.radius * flat])


def fit(
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
    pieces = _Pieces(cut(coarse.points[coarse.triangles]))
    parts, capsules = _split(pieces, max_capsules, min_saving)
    if coarse is not mesh:
        pieces = _Pieces(cut(triangles))
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
        """Return the fraction of the samples inside if a pair replaces capsule i."""
        others = [capsule for j, capsule in enumerate(capsules) if j != i]
        distances = np.min([capsule.distances_to(samples) for capsule in (*others, *pair)], axis=0)
        return float((distances <= 0).mean())

    while len(parts) < max_capsules:
        drafts: list[tuple[float, int, _Split]] = []
        for i, part in enumerate(parts):
            known = splits[i] = splits[i] or pieces.splits(part)
            drafts += [(enclosed(i, split.draft), i, split) for split in known]
        # The capsules of a draft tell which splits are worth the search for better ones.
        drafts.sort(key=lambda draft: draft[0])
        options = [
            (enclosed(i, split.refined(pieces)), i, split)
            for _, i, split in drafts[: SHAPE_FIT.refined_splits]
        ]
        if not options:
            break
        min_size, i, split = min(options, key=lambda option: option[0])
        if min_size > volume - min_saving:
            break
        volume = min_size
        parts[i : i + 1], capsules[i : i + 1] = split.parts, split.refined(pieces)
        splits[i : i + 1] = [None, None]
    return parts, capsules


class _Pieces:
    """The triangles of a mesh without long edges, prepared for fits of parts of them.

    Attributes:
        corners: (c, 3) corners [m].
        numbers: (t, 3) rows of the corners of each triangle.
        centroids: (t, 3) centroids of the triangles [m].
        outermost: (c,) whether a corner is the outermost one in its cell of a grid.
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
        enclosed = self.corners[member]
        return around(
            self.centroids[rows], outermost if len(outermost) else enclosed, enclosed, rounds
        )

    def splits(self, rows: Rows) -> list[_Split]:
        """Return the ways to split the triangles of some rows in two."""
        candidates = []
        for below in halves(self.centroids[rows]):
            parts = rows[below], rows[~below]
            candidates.append(_Split(parts, [self.enclosing(part, 0) for part in parts]))
        return candidates


@dataclass(eq=False)
class _Split:
    """Two parts of a mesh.

    Attributes:
        parts: Rows of the triangles of each.
        draft: A capsule for each, along the first directions.
        best: The smallest ones that the search for better axes yields, once it is made.
    """

    parts: tuple[Rows, Rows]
    draft: list[FittedCapsule]
    best: list[FittedCapsule] = field(default_factory=list)

    def refined(self, pieces: _Pieces) -> list[FittedCapsule]:
        """Return a small capsule for each part."""
        self.best = self.best or [pieces.enclosing(part, SHAPE_FIT.rounds) for part in self.parts]
        return self.best


def around(
    points: Array, candidates: Array, enclosed: Array, rounds: int = SHAPE_FIT.rounds
) -> FittedCapsule:
    """Return a small capsule that encloses points.

    Args:
        points: (k, 3) centroids of triangles [m]: their spread tells which axes are tried.
        candidates: (c, 3) corners of which the outermost determine the capsule.
        enclosed: (m, 3) corners that the capsule encloses.
        rounds: Number of rounds of the search for a better axis.
    """
    offsets = points - points.mean(axis=0)
    axes = np.linalg.eigh(offsets.T @ offsets)[1].T[::-1]
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(SHAPE_FIT.corner_directions, 3))
    extreme = (directions @ np.ascontiguousarray(candidates.T)).argmax(axis=1)
    picked = candidates[np.unique(extreme)]
    best, axis = _smallest_along(picked, axes)
    spread = 0.3
    for _ in range(rounds):
        tried = axis + spread * rng.normal(size=(SHAPE_FIT.axes_per_round, 3))
        capsule, direction = _smallest_along(
            picked, tried / np.linalg.norm(tried, axis=1, keepdims=True)
        )
        if capsule.volume < best.volume:
            best, axis = capsule, direction
        spread *= 0.5
    distance = best.distances_to(enclosed)
    if rounds:  # the corners that are outside take part, so that the radius need not cover them
        outside = np.argpartition(-distance, min(SHAPE_FIT.extra_corners, len(distance)) - 1)[
            : SHAPE_FIT.extra_corners
        ]
        capsule, _ = _smallest_along(np.concatenate([picked, enclosed[outside]]), axis[None])
        widened = capsule.distances_to(enclosed)
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
    flat = points @ frames
    across, z = flat[:, :, :2], flat[:, :, 2]
    rows = np.arange(len(axes))
    center = (across.min(axis=1) + across.max(axis=1)) / 2
    for i in range(16):  # towards the centre of the smallest circle
        off = across - center[:, None]
        far = (off**2).sum(axis=2).argmax(axis=1)
        center = center + off[rows, far] / (i + 2)
    distance = np.linalg.norm(across - center[:, None], axis=2)
    radii = distance.max(axis=1)[:, None] * RADIUS_FACTORS
    room = np.sqrt(np.maximum(radii[:, :, None] ** 2 - distance[:, None] ** 2, 0))
    low, high = (z[:, None] + room).min(axis=2), (z[:, None] - room).max(axis=2)
    middle = (z.min(axis=1) + z.max(axis=1))[:, None] / 2
    ball = np.hypot(distance, z - middle).max(axis=1)[:, None]
    short = high < low
    low, high = np.where(short, middle, low), np.where(short, middle, high)
    radii = np.where(short, ball, radii)
    volumes = radii**2 * (high - low + 4 / 3 * radii)
    a, r = np.unravel_index(int(volumes.argmin()), volumes.shape)
    ends = [frames[a] @ np.array([*center[a], one[a, r]]) for one in (low, high)]
    return FittedCapsule(ends[0], ends[1], float(radii[a, r])), axes[a]


def _points_inside(capsule: FittedCapsule) -> Array:
    """Return uniform sample points (k, 3) inside a capsule."""
    rng = np.random.default_rng(0)
    ends = np.stack([capsule.first, capsule.last])
    low, high = ends.min(axis=0) - capsule.radius, ends.max(axis=0) + capsule.radius
    points = rng.uniform(low, high, (3 * SHAPE_FIT.samples, 3))
    return points[capsule.distances_to(points) <= 0][: SHAPE_FIT.samples]


def halves(centroids: Array) -> list[NDArray[np.bool_]]:
    """Return ways to split triangles with centroids (t, 3) in two: masks (t,) of one part."""
    offsets = centroids - centroids.mean(axis=0)
    axes = np.linalg.eigh(offsets.T @ offsets)[1].T[::-1]
    masks = []
    for axis in axes:
        place = centroids @ axis
        for share in (0.3, 0.5, 0.7):
            below = place < place.min() + share * np.ptp(place)
            if 4 <= below.sum() <= len(centroids) - 4:
                masks.append(below)
    return masks


def cut(triangles: Array) -> tuple[Array, Rows]:
    """Subdivide triangles (t, 3, 3) with long edges; return corners (c, 3) and triangles (t, 3)."""
    corners = triangles.reshape(-1, 3)
    reach = float(np.ptp(corners, axis=0).max()) / SHAPE_FIT.pieces_per_length
    rows = np.arange(len(corners)).reshape(-1, 3)
    finer = subdivide_to_size(corners, rows, reach, max_iter=50)
    corners, numbers = np.unique(np.asarray(finer[0], dtype=float), axis=0, return_inverse=True)
    return corners, numbers.reshape(-1)[finer[1]]


def excess(shapes: Sequence[FittedCapsule | FittedBox], points: Array) -> float:
    """Return the largest distance of shape surfaces from the points of a mesh [m], by samples."""
    surface_points = np.concatenate([one.surface_points() for one in shapes])
    samples = np.min([one.distances_to(surface_points) for one in shapes], axis=0) < -1e-6
    return float(KDTree(points).query(surface_points[~samples])[0].max(initial=0.0))


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
        u, v = (one.ravel() for one in np.meshgrid(line, line))
        faces = []
        for axis in range(3):
            for side in (-0.5, 0.5):
                face = np.empty((len(u), 3))
                face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
                faces.append(face)
        return self.center + (np.concatenate(faces) * self.size) @ self.rotation.T


def fit_boxes(triangles: Array, max_capsules: int = 3) -> list[FittedBox]:
    """Fit at most `max_capsules` boxes that enclose triangles (t, 3, 3) [m]."""
    corners, numbers = cut(triangles)
    parts = [corners[numbers]]
    found = [box_around(parts[0].reshape(-1, 3))]
    while len(parts) < max_capsules:
        options = []
        for i, part in enumerate(parts):
            for below in halves(part.mean(axis=1)):
                two = part[below], part[~below]
                pair = [box_around(one.reshape(-1, 3)) for one in two]
                saved = found[i].volume - pair[0].volume - pair[1].volume
                options.append((saved, i, two, pair))
        if not options:
            break
        saved, i, two, pair = max(options, key=lambda option: option[0])
        if saved < SHAPE_FIT.box_saving * sum(one.volume for one in found):
            break
        parts[i : i + 1], found[i : i + 1] = two, pair
    return found


def box_around(points: Array) -> FittedBox:
    """Return a small box around points (k, 3) [m], along the frame or the principal axes."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    found = []
    for rotation in (np.eye(3), axes.T):
        local = points @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        found.append(FittedBox(rotation, rotation @ ((low + high) / 2), high - low))
    # Principal axes only if they save volume: axes of the frame give simpler numbers.
    return found[1] if found[1].volume < 0.9 * found[0].volume else found[0]


def fit_links(
    surfaces: Mapping[str, IndexedMesh],
    flat: Collection[str],
    known: Mapping[str, Sequence[ShapeEntry]] | None = None,
    max_capsules: int = SHAPE_FIT.max_capsules,
    min_saving: float = SHAPE_FIT.min_saving,
    report: Callable[[int], object] | None = None,
) -> dict[str, list[ShapeEntry]]:
    """Return the shapes that enclose links, by link.

    Args:
        surfaces: Surfaces by link, in the link's frame.
        flat: Links that boxes may enclose: a palm, which fingers come near.
        known: Shapes by link that are simple already, and are not changed.
        max_capsules: Maximum number of capsules of a large link.
        min_saving: Fraction of the volume that another capsule has to save.
        report: Function called with the number of links that have been enclosed since.
    """
    shapes: dict[str, list[ShapeEntry]] = {}
    for link, surface in surfaces.items():
        extent = float(np.ptp(surface.points, axis=0).max())
        if known and link in known:
            shapes[link] = list(known[link])
        elif len(surface.triangles) and extent > SHAPE_FIT.min_size:
            count = (
                max_capsules if extent > SHAPE_FIT.large_link else SHAPE_FIT.max_capsules_of_small
            )
            triangles = surface.points[surface.triangles]
            shapes[link] = _enclosing_shapes(triangles, count, link in flat, min_saving)
        if report is not None:
            report(1)
    return shapes


def _enclosing_shapes(
    triangles: Array, max_capsules: int, flat: bool, min_saving: float
) -> list[ShapeEntry]:
    """Return enclosing capsules of a mesh, or boxes if they are allowed and closer."""
    capsules, distances_to = fit(triangles, max_capsules, min_saving)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles)[0])
        if closer < distances_to:
            return [_box(one, _ceil(closer, 1e3)) for one in boxes]
    return [_capsule(one, _ceil(distances_to, 1e3)) for one in capsules]


def _capsule(one: FittedCapsule, distances_to: float) -> ShapeEntry:
    first, last = (_rounded(end) for end in (one.first, one.last))
    radius = math.ceil(one.radius * SHAPE_FIT.grid + 0.9) / SHAPE_FIT.grid
    if first == last:
        return LinkSphereEntry(radius=radius, center=first, excess=distances_to)
    return LinkCapsuleEntry(ends=(first, last), radius=radius, excess=distances_to)


def _box(one: FittedBox, distances_to: float) -> ShapeEntry:
    size = np.ceil(one.size * SHAPE_FIT.grid + 1.1) / SHAPE_FIT.grid
    rpy = np.round(roll_pitch_yaw(one.rotation), 4)
    if np.any(rpy):  # the largest effect of rounding the angles
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * SHAPE_FIT.grid) / SHAPE_FIT.grid
    x, y, z = size.tolist()
    roll, pitch, yaw = (rpy + 0.0).tolist()
    return LinkBoxEntry(
        size=(x, y, z), xyz=_rounded(one.center), rpy=(roll, pitch, yaw), excess=distances_to
    )


def _rounded(point: Array) -> tuple[float, float, float]:
    x, y, z = (np.round(point * SHAPE_FIT.grid) / SHAPE_FIT.grid + 0.0).tolist()
    return x, y, z


def _ceil(value: float, grid: float) -> float:
    return math.ceil(grid * value) / grid


def largest_excess(shapes: Mapping[str, Sequence[ShapeEntry]]) -> float:
    """Return the largest excess of shapes beyond the meshes that they enclose [m]."""
    return max((one.excess for found in shapes.values() for one in found), default=0.0)
