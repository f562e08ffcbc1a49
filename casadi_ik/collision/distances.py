"""Distances of capsules in numpy, with where and which way they are nearest.

The same as the compiled driver gives: for machines without a compiler, and for gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.collision.solids import GROUP, Kind, Solid
from casadi_ik.collision.table import Table

CUTS = 40
"""Cuts of the interval in which a segment is nearest to a solid."""

CLOSE = 1e-7
"""Where tangents and function agree to this [m], the least is found."""

TINY = 1e-30

AT_ONCE = 256
"""Segments that are held against a cloud together."""


@dataclass(frozen=True, eq=False)
class Nearest:
    """Distances of k configurations' pairs (p).

    Attributes:
        distance: (k, p) [m], the pairs' offsets taken off.
        first: (k, p) where on the first segment, -1 to 1 from its middle.
        second: (k, p) where on the second, likewise; 0 on a solid.
        way: (k, p, 3) how the distance grows with the place of the first's nearest point.
    """

    distance: Array
    first: Array
    second: Array
    way: Array


def nearest(where: Array, poses: Array, table: Table) -> Nearest:
    """Distances of all pairs of a table.

    Args:
        where: (k, ...) where the robot's shapes are, as `collision.model.placed` gives it.
        poses: (k, n, 12) or (n, 12) of a scene's solids.
        table: The pairs.
    """
    k, p, s = len(where), len(table.pairs), len(table.radii)
    placed = where[:, : 6 * s].reshape(k, s, 6)
    theirs = np.broadcast_to(poses, (k, *poses.shape[-2:]))
    own = where[:, 6 * s : 6 * s + 12 * table.own].reshape(k, table.own, 12)
    places = np.concatenate([own, theirs], axis=1)
    one, other = table.pairs[:, 0], table.pairs[:, 1]
    radius = table.radii[one] + table.offsets
    found = Nearest(np.empty((k, p)), np.zeros((k, p)), np.zeros((k, p)), np.zeros((k, p, 3)))
    robot = np.flatnonzero(other < s)
    if len(robot):
        i, j = one[robot], other[robot]
        parts = _segments(placed[:, i], placed[:, j])
        _put(found, robot, parts, radius[robot] + table.radii[j])
    for number, solid in enumerate(table.solids):
        rows = np.flatnonzero(other == s + number)
        if len(rows):
            parts = _from_solid(solid, placed[:, one[rows]], places[:, number])
            wide = solid.size[0] if solid.kind in (Kind.CAPSULE, Kind.CLOUD) else 0.0
            _put(found, rows, parts, radius[rows] + wide)
    return found


def _put(
    found: Nearest, rows: NDArray[np.intp], parts: tuple[Array, Array, Array, Array], less: Array
) -> None:
    found.distance[:, rows] = parts[0] - less
    found.first[:, rows], found.second[:, rows], found.way[:, rows] = parts[1:]


def segment_distances(a: Array, b: Array) -> Array:
    """Least distances (...) [m] of segments (..., 6), middles and halves."""
    return _segments(a, b)[0]


def _segments(a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """Least distances of segments (..., 6)."""
    r, g, h = a[..., :3] - b[..., :3], a[..., 3:], b[..., 3:]

    def dot(x: Array, y: Array) -> Array:
        return np.einsum("...i,...i->...", x, y)

    aa, bb, both, d, f = dot(g, g), dot(h, h), dot(g, h), dot(g, r), dot(h, r)
    over_a = np.where(aa > TINY, 1 / np.maximum(aa, TINY), 0.0)
    over_b = np.where(bb > TINY, 1 / np.maximum(bb, TINY), 0.0)
    t = np.clip((both * f - bb * d) / np.maximum(aa * bb - both * both, TINY), -1, 1)
    s = np.clip((both * t + f) * over_b, -1, 1)
    t = np.clip((both * s - d) * over_a, -1, 1)
    apart = r + t[..., None] * g - s[..., None] * h
    length = np.linalg.norm(apart, axis=-1)
    return length, t, s, apart / np.maximum(length, TINY)[..., None]


def _from_solid(solid: Solid, a: Array, pose: Array) -> tuple[Array, Array, Array, Array]:
    """Least signed distances of segments (k, p, 6) from a solid at poses (k, 12)."""
    rotation, origin = pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
    if solid.kind is Kind.CAPSULE:
        axis = rotation[:, :, 2] * solid.size[1]
        both = np.concatenate([origin, axis], axis=1)[:, None]
        return _segments(a, np.broadcast_to(both, a.shape))
    c = np.einsum("kji,kpj->kpi", rotation, a[..., :3] - origin[:, None])
    h = np.einsum("kji,kpj->kpi", rotation, a[..., 3:])
    t, value, way = (_from_points if solid.kind is Kind.CLOUD else _lowest)(solid, c, h)
    turned = np.einsum("kij,kpj->kpi", rotation, way)
    return value, t, np.zeros_like(t), turned


def _from_points(solid: Solid, c: Array, h: Array) -> tuple[Array, Array, Array]:
    """Where on segments a cloud's points are nearest, how far that is, and the way out."""
    groups = solid.planes.reshape(-1, GROUP + 1, 4)
    middles, wide = groups[:, 0, :3], groups[:, 0, 3]
    parts = _parts_of(c.reshape(-1, 3)), _parts_of(h.reshape(-1, 3))
    found = [_nearest_points(groups, middles, wide, a, b) for a, b in zip(*parts, strict=True)]
    t, length, way = (np.concatenate(some) for some in zip(*found, strict=True))
    shape = c.shape[:-1]
    return t.reshape(shape), length.reshape(shape), way.reshape(*shape, 3)


def _parts_of(rows: Array) -> list[Array]:
    return [rows[i : i + AT_ONCE] for i in range(0, max(len(rows), 1), AT_ONCE)]


def _nearest_points(
    groups: Array, middles: Array, wide: Array, c: Array, h: Array
) -> tuple[Array, Array, Array]:
    def apart(points: Array, c: Array, h: Array) -> tuple[Array, Array]:
        away, along = points - c, np.maximum((h * h).sum(axis=-1), TINY)
        t = np.clip((away * h).sum(axis=-1) / along, -1, 1)
        return t, t[..., None] * h - away

    far = np.linalg.norm(apart(middles, c[:, None], h[:, None])[1], axis=-1)
    near = far - wide <= (far + wide).min(axis=1)[:, None] + CLOSE
    row, group = np.nonzero(near)
    t, way = apart(groups[group, 1:, :3], c[row, None], h[row, None])
    length = np.linalg.norm(way, axis=-1)
    best = length.argmin(axis=1)
    each = np.arange(len(row))
    t, length, way = t[each, best], length[each, best], way[each, best]
    # Rows ascend; of each the first of its groups in order of distance.
    order = np.lexsort((length, row))
    first = order[np.append(True, np.diff(row[order]) > 0)]
    return t[first], length[first], way[first] / np.maximum(length[first], TINY)[:, None]


def _lowest(solid: Solid, c: Array, h: Array) -> tuple[Array, Array, Array]:
    """Where on segments a solid is nearest, a lower bound of that distance, and the way out."""

    def look(t: Array) -> tuple[Array, Array, Array]:
        value, way = signed(solid, c + t[..., None] * h)
        return value, np.einsum("...i,...i->...", way, h), way

    low, high = np.full(c.shape[:-1], -1.0), np.ones(c.shape[:-1])
    left, right = look(low), look(high)
    inner = (left[1] < 0) & (right[1] > 0)
    first = right[0] < left[0]
    t, best = np.where(first, high, low), np.where(first, right[0], left[0])
    way = np.where(first[..., None], right[2], left[2])
    bound = best
    (lv, ls, lw), (rv, rs, rw) = left, right
    for cut in range(CUTS + 1):
        steep = np.where(inner, ls - rs, -1.0)
        meet = (rv - lv + ls * low - rs * high) / steep
        bound = np.where(inner, np.minimum(lv + ls * (meet - low), best), best)
        if not (best - bound >= CLOSE).any():
            break
        here = (low + high) / 2 if cut % 3 == 2 else np.clip(meet, low, high)
        value, slope, way_here = look(here)
        nearer = (value < best) & inner
        t, best = np.where(nearer, here, t), np.where(nearer, value, best)
        way = np.where(nearer[..., None], way_here, way)
        falls = slope < 0
        side = (falls & inner)[..., None], (~falls & inner)[..., None]
        lw, rw = np.where(side[0], way_here, lw), np.where(side[1], way_here, rw)
        low, lv, ls = (np.where(falls, x, y) for x, y in ((here, low), (value, lv), (slope, ls)))
        high, rv, rs = (np.where(falls, y, x) for x, y in ((here, high), (value, rv), (slope, rs)))
    # Where two faces meet the nearest point stays on their edge: both pull, balanced.
    share = (rs / np.where(inner, rs - ls, 1.0))[..., None]
    return t, bound, np.where(inner[..., None], share * lw + (1 - share) * rw, way)


def signed(solid: Solid, p: Array) -> tuple[Array, Array]:
    """Signed distances of points (..., 3) from a solid in its frame, and their gradients."""
    if solid.kind is Kind.CAPSULE:
        foot = np.zeros_like(p)
        foot[..., 2] = np.clip(p[..., 2], -solid.size[1], solid.size[1])
        off = np.linalg.norm(p - foot, axis=-1)
        return off - solid.size[0], (p - foot) / np.maximum(off, TINY)[..., None]
    if solid.kind is Kind.CLOUD:
        _, off, way = _from_points(solid, p, np.zeros_like(p))
        return off - solid.size[0], way
    if solid.kind is Kind.HALF_SPACE:
        return p[..., 2], np.broadcast_to([0.0, 0.0, 1.0], p.shape)
    if solid.kind is Kind.CONVEX:
        values = p @ solid.planes[:, :3].T - solid.planes[:, 3]
        which = values.argmax(axis=-1)
        value = np.take_along_axis(values, which[..., None], axis=-1)[..., 0]
        return value, solid.planes[which, :3]
    if solid.kind is Kind.CYLINDER:
        from_axis = np.linalg.norm(p[..., :2], axis=-1)
        excess = np.stack([from_axis - solid.size[0], np.abs(p[..., 2]) - solid.size[1]], axis=-1)
        around = p[..., :2] / np.maximum(from_axis, TINY)[..., None]
        ways = np.zeros((*p.shape[:-1], 2, 3))
        ways[..., 0, :2] = around
        ways[..., 1, 2] = np.where(p[..., 2] < 0, -1.0, 1.0)
    else:
        excess = np.abs(p) - solid.size
        ways = np.where(p < 0, -1.0, 1.0)[..., None] * np.eye(3)
    out = np.maximum(excess, 0.0)
    length = np.linalg.norm(out, axis=-1)
    outside = length > 0
    deep = np.take_along_axis(ways, excess.argmax(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    outer = np.einsum("...i,...ij->...j", out, ways) / np.maximum(length, TINY)[..., None]
    value = np.where(outside, length, excess.max(axis=-1))
    return value, np.where(outside[..., None], outer, deep)
