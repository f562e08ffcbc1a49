"""Meshes as few simple shapes that hold them: capsules, and boxes for what is flat.

Shapes of links come out as a description has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.remesh import subdivide_to_size

from casadi_ik.collision.solids import spread
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.integrations.importing.surfaces import Surface, clusters
from casadi_ik.model.schema import BoxEntry, CapsuleEntry, ShapeEntry, SphereEntry

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class ShapeFit:
    """How links become capsules and boxes.

    Attributes:
        saving: Part of the volume that another capsule has to save, unless told.
        inside: Points that volumes are counted by.
        rounds: Rounds of random turns by which a capsule's axis is bettered.
        last_rounds: Rounds of the last fit, of the capsules that a link gets.
        turns: Turns of a round.
        corners: Number of directions whose outermost corners determine a capsule; in the end it
            encloses all corners.
        cells: Cells of a grid along the longest edge of a mesh, of each of which one corner is
            among those that determine a capsule.
        triangles: Number of triangles above which splits are decided on a simplified mesh.
        refined: Number of splits, the best by a rough fit, that are fitted again with a search for
            better axes.
        added: Number of corners outside a capsule that take part in its last fit.
        pieces: Triangles are cut until no edge is longer than this part of the mesh.
        box_saving: Part of the volume that another box has to save.
        box_points: Points along an edge of a box's skin.
        grid: What is fitted is rounded up to a tenth of a millimetre.
        large: Links longer than this [m] may have more capsules than `most_of_small`.
        most: Capsules of a large link, unless more are asked for.
        most_of_small: Capsules of a small link, at the most.
        least: What is smaller than this [m] is no shape.
    """

    saving: float = 0.04
    inside: int = 1500
    rounds: int = 4
    last_rounds: int = 10
    turns: int = 12
    corners: int = 160
    cells: int = 36
    triangles: int = 2000
    refined: int = 3
    added: int = 60
    pieces: int = 12
    box_saving: float = 0.12
    box_points: int = 24
    grid: float = 1e4
    large: float = 0.13
    most: int = 4
    most_of_small: int = 2
    least: float = 1e-4


FIT = ShapeFit()

WIDER = np.array([1.0, 1.02, 1.05, 1.1, 1.2, 1.35, 1.5])
"""Radii that are tried, as parts of the least."""


@dataclass(frozen=True, eq=False)
class FittedCapsule:
    """A capsule.

    Attributes:
        first: (3,) end of its segment [m].
        last: (3,) the other.
        radius: [m].
    """

    first: Array
    last: Array
    radius: float

    @property
    def volume(self) -> float:
        """[m^3]."""
        length = float(np.linalg.norm(self.last - self.first))
        return float(np.pi * self.radius**2 * (length + 4 / 3 * self.radius))

    def beyond(self, points: Array) -> Array:
        """(k,) distances of points from the capsule [m], negative inside."""
        along = self.last - self.first
        t = (points - self.first) @ along / max(float(along @ along), 1e-30)
        foot = self.first + np.clip(t, 0, 1)[:, None] * along
        return np.linalg.norm(points - foot, axis=1) - self.radius

    def skin(self) -> Array:
        """(k, 3) points of its surface."""
        along = self.last - self.first
        length = float(np.linalg.norm(along))
        axis = along / length if length > 1e-12 else np.array([0, 0, 1.0])
        ball = spread(400)
        up = ball @ axis
        ends = np.where((up > 0)[:, None], self.last, self.first) + self.radius * ball
        flat = ball - up[:, None] * axis
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        mantle = self.first + ((np.arange(len(ball)) * 0.618) % 1)[:, None] * along
        return np.concatenate([ends, mantle + self.radius * flat])


def fit(
    triangles: Array, most: int = 4, saving: float = FIT.saving
) -> tuple[list[FittedCapsule], float]:
    """Fit capsules that enclose a mesh.

    Where to split the mesh is decided on a simplified copy of it; the capsules are then fitted to
    the mesh itself.

    Args:
        triangles: (t, 3, 3) corners [m].
        most: Maximum number of capsules.
        saving: Fraction of the volume that another capsule has to save.

    Returns:
        The capsules, and the largest distance by which samples of their surface stand out beyond
        the mesh [m].
    """
    mesh = Surface(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    coarse = mesh.simplified(FIT.triangles, FIT.cells)
    pieces = _Pieces(cut(coarse.points[coarse.triangles]))
    parts, capsules = _split(pieces, most, saving)
    if coarse is not mesh:
        pieces = _Pieces(cut(triangles))
        outside = [
            capsule.beyond(pieces.corners)[pieces.numbers].max(axis=1) for capsule in capsules
        ]
        nearest = np.argmin(outside, axis=0)
        parts = [rows for i in range(len(capsules)) if len(rows := np.flatnonzero(nearest == i))]
    capsules = [pieces.enclosing(part, FIT.last_rounds) for part in parts]
    return capsules, excess(capsules, np.concatenate([pieces.corners, pieces.centroids]))


def _split(pieces: _Pieces, most: int, saving: float) -> tuple[list[Rows], list[FittedCapsule]]:
    """Split a mesh into parts, and enclose each in a capsule, as long as that saves volume."""
    parts = [np.arange(len(pieces.numbers))]
    capsules = [pieces.enclosing(parts[0], FIT.rounds)]
    samples = _inside(capsules[0])
    volume = 1.0
    splits: list[list[_Split] | None] = [None]

    def enclosed(i: int, pair: Sequence[FittedCapsule]) -> float:
        """Return the fraction of the samples inside if a pair replaces capsule i."""
        others = [capsule for j, capsule in enumerate(capsules) if j != i]
        distances = np.min([capsule.beyond(samples) for capsule in (*others, *pair)], axis=0)
        return float((distances <= 0).mean())

    while len(parts) < most:
        drafts: list[tuple[float, int, _Split]] = []
        for i, part in enumerate(parts):
            known = splits[i] = splits[i] or pieces.splits(part)
            drafts += [(enclosed(i, split.draft), i, split) for split in known]
        # The capsules of a draft tell which splits are worth the search for better ones.
        drafts.sort(key=lambda draft: draft[0])
        options = [
            (enclosed(i, split.refined(pieces)), i, split) for _, i, split in drafts[: FIT.refined]
        ]
        if not options:
            break
        least, i, split = min(options, key=lambda option: option[0])
        if least > volume - saving:
            break
        volume = least
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
        self.outermost[clusters(self.corners, FIT.cells)[0]] = True

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
        self.best = self.best or [pieces.enclosing(part, FIT.rounds) for part in self.parts]
        return self.best


def around(
    points: Array, candidates: Array, enclosed: Array, rounds: int = FIT.rounds
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
    directions = rng.normal(size=(FIT.corners, 3))
    extreme = (directions @ np.ascontiguousarray(candidates.T)).argmax(axis=1)
    picked = candidates[np.unique(extreme)]
    best, axis = _along(picked, axes)
    spread = 0.3
    for _ in range(rounds):
        tried = axis + spread * rng.normal(size=(FIT.turns, 3))
        capsule, direction = _along(picked, tried / np.linalg.norm(tried, axis=1, keepdims=True))
        if capsule.volume < best.volume:
            best, axis = capsule, direction
        spread *= 0.5
    distance = best.beyond(enclosed)
    if rounds:  # the corners that are outside take part, so that the radius need not cover them
        outside = np.argpartition(-distance, min(FIT.added, len(distance)) - 1)[: FIT.added]
        capsule, _ = _along(np.concatenate([picked, enclosed[outside]]), axis[None])
        widened = capsule.beyond(enclosed)
        if _widened(capsule, widened).volume < _widened(best, distance).volume:
            best, distance = capsule, widened
    return _widened(best, distance)


def _widened(capsule: FittedCapsule, distances: Array) -> FittedCapsule:
    """Return the capsule with a radius that encloses points at some distances (k,) from it."""
    radius = capsule.radius + float(np.maximum(distances, 0).max()) + 1e-9
    return FittedCapsule(capsule.first, capsule.last, radius)


def _along(points: Array, axes: Array) -> tuple[FittedCapsule, Array]:
    """The smallest of some capsules along some axes (a, 3) that hold points, and its axis."""
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
    radii = distance.max(axis=1)[:, None] * WIDER
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


def _inside(capsule: FittedCapsule) -> Array:
    """Points (k, 3) spread evenly in a capsule."""
    rng = np.random.default_rng(0)
    ends = np.stack([capsule.first, capsule.last])
    low, high = ends.min(axis=0) - capsule.radius, ends.max(axis=0) + capsule.radius
    points = rng.uniform(low, high, (3 * FIT.inside, 3))
    return points[capsule.beyond(points) <= 0][: FIT.inside]


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
    reach = float(np.ptp(corners, axis=0).max()) / FIT.pieces
    rows = np.arange(len(corners)).reshape(-1, 3)
    finer = subdivide_to_size(corners, rows, reach, max_iter=50)
    corners, numbers = np.unique(np.asarray(finer[0], dtype=float), axis=0, return_inverse=True)
    return corners, numbers.reshape(-1)[finer[1]]


def excess(shapes: Sequence[FittedCapsule | FittedBox], points: Array) -> float:
    """By how much shapes stand out beyond a mesh of points [m], as far as samples show."""
    skin = np.concatenate([one.skin() for one in shapes])
    inside = np.min([one.beyond(skin) for one in shapes], axis=0) < -1e-6
    return float(KDTree(points).query(skin[~inside])[0].max(initial=0.0))


@dataclass(frozen=True, eq=False)
class FittedBox:
    """A box.

    Attributes:
        rotation: (3, 3) its axes, columns.
        center: (3,) [m].
        size: (3,) its edges [m].
    """

    rotation: Array
    center: Array
    size: Array

    @property
    def volume(self) -> float:
        """[m^3]."""
        return float(np.prod(self.size))

    def beyond(self, points: Array) -> Array:
        """(k,) how far points are outside, negative inside [m]."""
        local = np.abs((points - self.center) @ self.rotation) - self.size / 2
        return local.max(axis=1)

    def skin(self) -> Array:
        """(k, 3) points of its surface."""
        line = np.linspace(-0.5, 0.5, FIT.box_points)
        u, v = (one.ravel() for one in np.meshgrid(line, line))
        faces = []
        for axis in range(3):
            for side in (-0.5, 0.5):
                face = np.empty((len(u), 3))
                face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, u, v
                faces.append(face)
        return self.center + (np.concatenate(faces) * self.size) @ self.rotation.T


def fit_boxes(triangles: Array, most: int = 3) -> list[FittedBox]:
    """Boxes that hold a mesh of triangles (t, 3, 3) [m], no more than `most`."""
    corners, numbers = cut(triangles)
    parts = [corners[numbers]]
    found = [box_around(parts[0].reshape(-1, 3))]
    while len(parts) < most:
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
        if saved < FIT.box_saving * sum(one.volume for one in found):
            break
        parts[i : i + 1], found[i : i + 1] = two, pair
    return found


def box_around(points: Array) -> FittedBox:
    """A small box that holds points (k, 3) [m], along the frame's axes or the points' own."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    found = []
    for rotation in (np.eye(3), axes.T):
        local = points @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        found.append(FittedBox(rotation, rotation @ ((low + high) / 2), high - low))
    # Its own axes only where they save something: plain numbers are better to read.
    return found[1] if found[1].volume < 0.9 * found[0].volume else found[0]


def fitted(
    surfaces: Mapping[str, Surface],
    flat: Collection[str],
    known: Mapping[str, Sequence[ShapeEntry]] | None = None,
    most: int = FIT.most,
    saving: float = FIT.saving,
    report: Callable[[int], object] | None = None,
) -> dict[str, list[ShapeEntry]]:
    """Return the shapes that enclose links, by link.

    Args:
        surfaces: Surfaces by link, in the link's frame.
        flat: Links that boxes may enclose: a palm, which fingers come near.
        known: Shapes by link that are simple already, and are not changed.
        most: Maximum number of capsules of a large link.
        saving: Fraction of the volume that another capsule has to save.
        report: Function called with the number of links that have been enclosed since.
    """
    shapes: dict[str, list[ShapeEntry]] = {}
    for link, surface in surfaces.items():
        extent = float(np.ptp(surface.points, axis=0).max())
        if known and link in known:
            shapes[link] = list(known[link])
        elif len(surface.triangles) and extent > FIT.least:
            count = most if extent > FIT.large else FIT.most_of_small
            triangles = surface.points[surface.triangles]
            shapes[link] = _held(triangles, count, link in flat, saving)
        if report is not None:
            report(1)
    return shapes


def _held(triangles: Array, most: int, flat: bool, saving: float) -> list[ShapeEntry]:
    """Capsules that hold a mesh, or boxes where it may be flat and they hold it closer."""
    capsules, beyond = fit(triangles, most, saving)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles)[0])
        if closer < beyond:
            return [_box(one, _up(closer, 1e3)) for one in boxes]
    return [_capsule(one, _up(beyond, 1e3)) for one in capsules]


def _capsule(one: FittedCapsule, beyond: float) -> ShapeEntry:
    first, last = (_rounded(end) for end in (one.first, one.last))
    radius = math.ceil(one.radius * FIT.grid + 0.9) / FIT.grid
    if first == last:
        return SphereEntry(radius=radius, center=first, excess=beyond)
    return CapsuleEntry(ends=(first, last), radius=radius, excess=beyond)


def _box(one: FittedBox, beyond: float) -> ShapeEntry:
    size = np.ceil(one.size * FIT.grid + 1.1) / FIT.grid
    rpy = np.round(roll_pitch_yaw(one.rotation), 4)
    if np.any(rpy):  # what rounding may turn it by
        size = np.ceil((size + 1e-4 * np.linalg.norm(size)) * FIT.grid) / FIT.grid
    x, y, z = size.tolist()
    roll, pitch, yaw = (rpy + 0.0).tolist()
    return BoxEntry(size=(x, y, z), xyz=_rounded(one.center), rpy=(roll, pitch, yaw), excess=beyond)


def _rounded(point: Array) -> tuple[float, float, float]:
    x, y, z = (np.round(point * FIT.grid) / FIT.grid + 0.0).tolist()
    return x, y, z


def _up(value: float, grid: float) -> float:
    return math.ceil(grid * value) / grid


def worst(shapes: Mapping[str, Sequence[ShapeEntry]]) -> float:
    """By how much shapes stand out beyond what they hold, at most [m]."""
    return max((one.excess for found in shapes.values() for one in found), default=0.0)
