"""Meshes as few simple shapes that hold them: capsules, and boxes for what is flat.

Shapes of links come out as a description has them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from trimesh.remesh import subdivide_to_size

from casadi_ik.collision.solids import spread
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.integrations.importing.surfaces import Surface
from casadi_ik.model.schema import BoxEntry, CapsuleEntry, ShapeEntry, SphereEntry

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class ShapeFit:
    """How links become capsules and boxes.

    Attributes:
        saving: Part of the volume that another capsule has to save, unless told.
        inside: Points that volumes are counted by.
        rounds: Rounds of random turns by which a capsule's axis is bettered.
        turns: Turns of a round.
        corners: Corners of a part that directions pick, to look for a capsule; all of them are held
            at last.
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
    rounds: int = 5
    turns: int = 12
    corners: int = 160
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
    """Capsules that hold a mesh.

    Args:
        triangles: (t, 3, 3) corners [m].
        most: How many at most.
        saving: Part of the volume that another capsule has to save.

    Returns:
        The capsules, and by how much they stand out beyond the mesh at most [m], as far as samples
        show.
    """
    pieces = cut(triangles)
    # A corner is one of some six triangles; what is asked of corners takes so much less.
    corners, numbers = np.unique(pieces.reshape(-1, 3), axis=0, return_inverse=True)
    numbers = numbers.reshape(-1, 3)
    parts = [np.arange(len(pieces))]

    def held(rows: NDArray[np.intp]) -> FittedCapsule:
        apart = np.zeros(len(corners), bool)
        apart[numbers[rows]] = True
        return around(pieces[rows].reshape(-1, 3), corners[apart])

    found = [held(parts[0])]
    inside = _inside(found[0])
    volume = 1.0
    cuts: list[list[tuple[tuple[Rows, Rows], list[FittedCapsule]]] | None] = [None]
    while len(parts) < most:
        options: list[tuple[float, int, tuple[Rows, Rows], list[FittedCapsule]]] = []
        for i in range(len(parts)):
            rest = [one for j, one in enumerate(found) if j != i]
            if cuts[i] is None:
                halved = [(parts[i][below], parts[i][~below]) for below in halves(pieces[parts[i]])]
                cuts[i] = [(two, [held(one) for one in two]) for two in halved]
            for two, pair in cuts[i] or ():
                within = np.min([one.beyond(inside) for one in (*rest, *pair)], axis=0) <= 0
                options.append((float(within.mean()), i, two, pair))
        if not options:
            break
        least, i, two, pair = min(options, key=lambda option: option[0])
        if least > volume - saving:
            break
        volume = least
        parts[i : i + 1], found[i : i + 1], cuts[i : i + 1] = two, pair, [None, None]
    return found, excess(found, np.concatenate([corners, pieces.mean(axis=1)]))


def around(points: Array, apart: Array) -> FittedCapsule:
    """A small capsule that holds points.

    Args:
        points: (k, 3) corners of triangles [m], as often as they have them: how they are spread
            says which axes are tried.
        apart: (m, 3) the same, each once.
    """
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(FIT.corners, 3))
    picked = apart[np.unique((ways @ np.ascontiguousarray(apart.T)).argmax(axis=1))]
    best, axis = _along(picked, axes)
    spread = 0.3
    for _ in range(FIT.rounds):
        tried = axis + spread * rng.normal(size=(FIT.turns, 3))
        one, way = _along(picked, tried / np.linalg.norm(tried, axis=1, keepdims=True))
        if one.volume < best.volume:
            best, axis = one, way
        spread *= 0.5
    held = best.radius + float(np.maximum(best.beyond(apart), 0).max()) + 1e-9
    return FittedCapsule(best.first, best.last, held)


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


def halves(part: Array) -> list[NDArray[np.bool_]]:
    """Ways to cut triangles (t, 3, 3) in two: which are on one side."""
    middles = part.mean(axis=1)
    _, _, axes = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)
    found = []
    for axis in axes:
        place = middles @ axis
        for share in (0.3, 0.5, 0.7):
            below = place < place.min() + share * np.ptp(place)
            if 4 <= below.sum() <= len(part) - 4:
                found.append(below)
    return found


def cut(triangles: Array) -> Array:
    """The same surface in triangles without long edges."""
    corners = triangles.reshape(-1, 3)
    reach = float(np.ptp(corners, axis=0).max()) / FIT.pieces
    rows = np.arange(len(corners)).reshape(-1, 3)
    finer = subdivide_to_size(corners, rows, reach, max_iter=50)
    return np.asarray(finer[0][finer[1]], dtype=float)


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
    parts = [cut(triangles)]
    found = [box_around(parts[0].reshape(-1, 3))]
    while len(parts) < most:
        options = []
        for i, part in enumerate(parts):
            for below in halves(part):
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
) -> dict[str, list[ShapeEntry]]:
    """Shapes that hold links.

    Args:
        surfaces: By link what is to be held, in the link's frame.
        flat: Links that may be held by boxes: a palm, which fingers come near.
        known: By link shapes that are simple already; they stay what they are.
        most: Capsules of a large link, at the most.
        saving: Part of the volume that another one has to save.
    """
    found: dict[str, list[ShapeEntry]] = {}
    for link, surface in surfaces.items():
        if known and link in known:
            found[link] = list(known[link])
        elif len(surface.triangles) and float(np.ptp(surface.points, axis=0).max()) > FIT.least:
            large = float(np.ptp(surface.points, axis=0).max()) > FIT.large
            triangles = surface.points[surface.triangles]
            found[link] = _held(
                triangles, most if large else FIT.most_of_small, link in flat, saving
            )
    return found


def _held(triangles: Array, most: int, flat: bool, saving: float) -> list[ShapeEntry]:
    """Capsules that hold a mesh, or boxes where it may be flat and they hold it closer."""
    capsules, beyond = fit(triangles, most, saving)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles).reshape(-1, 3))
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
