"""Meshes as few capsules that hold them.

A capsule is convex: one that holds a triangle's corners holds the triangle. A mesh is cut where
that saves most volume, triangle by triangle, and each part gets the smallest capsule that is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from casadi_ik.arrays import Array

LEAST_SAVING = 0.04
"""Part of the volume that another capsule has to save, unless told."""

INSIDE = 1500
"""Points that volumes are counted by."""

TURNS = 5
"""Rounds of random turns by which a capsule's axis is bettered."""

TOGETHER = 12
"""Turns of a round."""

WIDER = np.array([1.0, 1.02, 1.05, 1.1, 1.2, 1.35, 1.5])
"""Radii that are tried, as parts of the least."""

CORNERS = 160
"""Corners of a part that directions pick, to look for a capsule; all of them are held at last."""

PIECES = 12
"""Triangles are cut until no edge is longer than this part of the mesh."""


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
        count = 400
        z = 1 - (2 * np.arange(count) + 1) / count
        turn = np.pi * (3 - 5**0.5) * np.arange(count)
        ball = np.column_stack(
            [np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        )
        up = ball @ axis
        ends = np.where((up > 0)[:, None], self.last, self.first) + self.radius * ball
        flat = ball - up[:, None] * axis
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        mantle = self.first + ((np.arange(count) * 0.618) % 1)[:, None] * along
        return np.concatenate([ends, mantle + self.radius * flat])


def fit(
    triangles: Array, most: int = 4, saving: float = LEAST_SAVING
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
    parts = [pieces]
    found = [around(pieces.reshape(-1, 3))]
    inside = _inside(found[0])
    volume = 1.0
    cuts: list[list[tuple[tuple[Array, Array], list[FittedCapsule]]] | None] = [None]
    while len(parts) < most:
        options: list[tuple[float, int, tuple[Array, Array], list[FittedCapsule]]] = []
        for i in range(len(parts)):
            rest = [one for j, one in enumerate(found) if j != i]
            if cuts[i] is None:
                halved = halves(parts[i])
                cuts[i] = [(two, [around(one.reshape(-1, 3)) for one in two]) for two in halved]
            for two, pair in cuts[i] or ():
                held = np.min([one.beyond(inside) for one in (*rest, *pair)], axis=0) <= 0
                options.append((float(held.mean()), i, two, pair))
        if not options:
            break
        least, i, two, pair = min(options, key=lambda option: option[0])
        if least > volume - saving:
            break
        volume = least
        parts[i : i + 1], found[i : i + 1], cuts[i : i + 1] = two, pair, [None, None]
    corners = pieces.reshape(-1, 3)
    return found, excess(found, np.concatenate([corners, pieces.mean(axis=1)]))


def around(points: Array) -> FittedCapsule:
    """A small capsule that holds points (k, 3) [m]."""
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(CORNERS, 3))
    picked = points[np.unique((points @ ways.T).argmax(axis=0))]
    best, axis = _along(picked, axes)
    spread = 0.3
    for _ in range(TURNS):
        tried = axis + spread * rng.normal(size=(TOGETHER, 3))
        one, way = _along(picked, tried / np.linalg.norm(tried, axis=1, keepdims=True))
        if one.volume < best.volume:
            best, axis = one, way
        spread *= 0.5
    held = best.radius + float(np.maximum(best.beyond(points), 0).max()) + 1e-9
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
    points = rng.uniform(low, high, (3 * INSIDE, 3))
    return points[capsule.beyond(points) <= 0][:INSIDE]


def halves(part: Array) -> list[tuple[Array, Array]]:
    """Ways to cut triangles (t, 3, 3) in two."""
    middles = part.mean(axis=1)
    _, _, axes = np.linalg.svd(middles - middles.mean(axis=0), full_matrices=False)
    found = []
    for axis in axes:
        place = middles @ axis
        for share in (0.3, 0.5, 0.7):
            below = place < place.min() + share * np.ptp(place)
            if 4 <= below.sum() <= len(part) - 4:
                found.append((part[below], part[~below]))
    return found


def cut(triangles: Array) -> Array:
    """The same surface in triangles without long edges."""
    reach = float(np.ptp(triangles.reshape(-1, 3), axis=0).max()) / PIECES
    done: list[Array] = []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        long = edges.max(axis=1) > reach
        done.append(triangles[~long])
        which = edges[long].argmax(axis=1)
        rows = np.arange(len(which))
        rest = triangles[long]
        a, b, c = (rest[rows, (which + i) % 3] for i in range(3))
        half = (a + b) / 2
        triangles = np.concatenate([np.stack([a, half, c], 1), np.stack([half, b, c], 1)])
    return np.concatenate(done)


class Holder(Protocol):
    """A shape that holds part of a mesh."""

    def skin(self) -> Array:
        """(k, 3) points of its surface."""
        ...

    def beyond(self, points: Array) -> Array:
        """(k,) positive for points (k, 3) outside."""
        ...


def excess(shapes: Sequence[Holder], points: Array) -> float:
    """By how much shapes stand out beyond a mesh of points [m], as far as samples show."""
    skin = np.concatenate([one.skin() for one in shapes])
    inside = np.min([one.beyond(skin) for one in shapes], axis=0) < -1e-6
    skin = skin[~inside]
    worst = 0.0
    squares = (points**2).sum(axis=1)
    for i in range(0, len(skin), 64):
        block = skin[i : i + 64]
        apart = (block**2).sum(axis=1)[:, None] - 2 * block @ points.T + squares
        worst = max(worst, float(np.sqrt(np.maximum(apart.min(axis=1), 0).max())))
    return worst
