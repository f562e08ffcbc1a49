"""Whether straight ways from posture to posture touch nothing, all along and not at samples alone.

How far two shapes are apart changes by no more than they move. So between two postures they keep at
least half of what they have at both ends together, less half of what they move on the way; where
that is not enough, the middle is looked at, and both halves. What moves by less than `RESOLUTION`
between two postures that are free is taken as free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.problem.clearance import ROUNDING, Surroundings

RESOLUTION = 1e-4
"""Motion [m] that is not looked into: by half of it things may be nearer than their margin."""

TOGETHER = 4096
"""Postures that are checked at once."""


@dataclass(frozen=True, eq=False)
class Between:
    """What was found on k - 1 straight ways.

    Attributes:
        free: (k - 1,) whether they touch nothing.
        worst: (k - 1, n) the posture with least room that was looked at on each.
        room: (k - 1,) its room [m]; no posture on a free way has less by more than what it moves
            to the next that was looked at.
        distance: (k - 1,) its clearance, see `Clearances` [m].
        pairs: (k - 1,) number of its pair, see `Clearances`.
    """

    free: Bools
    worst: Array
    room: Array
    distance: Array
    pairs: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Postures:
    """Postures, and all that is known of them.

    Attributes:
        q: (m, n).
        poses: (m, s, 12) of the solids.
        places: (m, p) where shapes are, see `ClearanceKernel.placed`.
        found: (m, 3) room, clearance and number of its pair.
    """

    q: Array
    poses: Array
    places: Array
    found: Array

    @property
    def room(self) -> Array:
        return self.found[:, 0]

    def rows(self, rows: NDArray[np.intp] | slice) -> _Postures:
        return _Postures(self.q[rows], self.poses[rows], self.places[rows], self.found[rows])

    @classmethod
    def joined(cls, one: _Postures, other: _Postures) -> _Postures:
        pairs = (
            (one.q, other.q),
            (one.poses, other.poses),
            (one.places, other.places),
            (one.found, other.found),
        )
        return cls(*(np.concatenate(pair) for pair in pairs))


class _Looking:
    """What is looked at, in surroundings whose solids may move with the postures."""

    def __init__(self, around: Surroundings) -> None:
        self._around, table = around, around.table
        reach = np.array([solid.reach for solid in table.solids])
        # What is unbounded (a half-space) may move, too, but no scene turns it under a robot.
        self._own = np.where(np.isfinite(reach), reach, 0.0)[: table.own]
        self._reach = np.where(np.isfinite(reach), reach, 0.0)[table.own :]
        self._capsules = len(table.radii)

    def at(self, q: Array, poses: Array) -> _Postures:
        """Postures (m, n) with solids at (m, s, 12)."""
        parts = [slice(i, i + TOGETHER) for i in range(0, len(q), TOGETHER)]
        around, found, places = self._around, list[Array](), list[Array]()
        for part in parts:
            here = Surroundings(around.kernel, around.table, poses[part], around.margin)
            seen = here.check(q[part])
            found.append(np.stack([seen.room, seen.distance, seen.pairs.astype(float)], axis=1))
            places.append(around.kernel.placed(q[part])[0])
        return _Postures(q, poses, np.concatenate(places), np.concatenate(found))

    def motion(self, one: _Postures, other: _Postures) -> Array:
        """(m,) how much nearer two shapes may come on the way [m], twice the largest motion."""
        split = 6 * self._capsules
        both = (other.places - one.places)[:, :split].reshape(len(one.q), -1, 2, 3)
        ends = np.stack([both[:, :, 0] + both[:, :, 1], both[:, :, 0] - both[:, :, 1]])
        moved = np.linalg.norm(ends, axis=-1).max(axis=(0, 2), initial=0.0)
        for change, reach in (
            ((other.places - one.places)[:, split:].reshape(len(one.q), -1, 12), self._own),
            (other.poses - one.poses, self._reach),
        ):
            if change.shape[1]:
                turned = np.linalg.norm(change[..., :9], axis=-1) * reach
                solids = np.linalg.norm(change[..., 9:], axis=-1) + turned
                moved = np.maximum(moved, solids.max(axis=1))
        # Joints that turn move things on arcs: how far these are off the straight line at most.
        far = np.linalg.norm(one.places[:, :split].reshape(len(one.q), -1, 3), axis=-1).max(
            axis=1, initial=0.0
        )
        turn = np.abs(other.q - one.q).sum(axis=1)
        return 2 * (moved + far * turn**2 / 4)

    def middle(self, one: _Postures, other: _Postures) -> _Postures:
        """The postures half way; what is carried turns half way, too."""
        return self.at((one.q + other.q) / 2, _half_way(one.poses, other.poses))


def between(around: Surroundings, q: Array, least: bool = False) -> Between:
    """What is on the straight ways from each of k postures to the next.

    Args:
        around: What must not be touched, the same for all, or at each posture.
        q: (k, n).
        least: Whether the least room of all is looked for, too: where all is free it is nowhere
            less than the smallest of `Between.room` by more than `RESOLUTION`.
    """
    count, n = max(len(q) - 1, 0), q.shape[1]
    poses = around.poses
    if poses.ndim == 2 or len(poses) != len(q):
        poses = np.broadcast_to(
            poses.reshape(-1, *poses.shape[-2:])[:1], (len(q), *poses.shape[-2:])
        )
    looking = _Looking(around)
    free, found = np.ones(count, dtype=bool), np.full((count, 3), np.inf)
    found[:, 2] = -1
    room, worst = found[:, 0], np.empty((count, n))
    every = looking.at(q, np.ascontiguousarray(poses))
    way = np.arange(count)
    one, other = every.rows(slice(0, count)), every.rows(slice(1, count + 1))

    def seen(some: _Postures, whose: NDArray[np.intp]) -> None:
        order = np.argsort(-some.room, kind="stable")
        less = order[some.room[order] < room[whose[order]]]
        # Behind each other the least comes last, and is what stays.
        found[whose[less]], worst[whose[less]] = some.found[less], some.q[less]
        free[whose[~(some.room >= -ROUNDING)]] = False

    seen(one, way)
    seen(other, way)
    while len(way):
        motion = looking.motion(one, other)
        floor = max(float(room.min()) - RESOLUTION, 0.0) if least else 0.0
        near = one.room + other.room < motion + 2 * floor
        kept = near & (motion > 2 * RESOLUTION) & free[way]
        rows = np.flatnonzero(kept)
        if not len(rows):
            break
        one, other, way = one.rows(rows), other.rows(rows), way[rows]
        middle = looking.middle(one, other)
        seen(middle, way)
        one, other = _Postures.joined(one, middle), _Postures.joined(middle, other)
        way = np.concatenate([way, way])
    return Between(free, worst, room, found[:, 1], found[:, 2].astype(np.int64))


def least_clearance(around: Surroundings, q: Array) -> tuple[float, str]:
    """The least clearance on the straight ways from each of k postures to the next.

    Args:
        around: As for `between`.
        q: (k, n).

    Returns:
        The clearance [m]: it is nowhere less by more than `RESOLUTION`, if all is free; and what
        touches, "": nothing does.
    """
    if len(q) < 2:
        q = np.concatenate([q, q])
    ways = between(around, q, least=True)
    clearance = float(ways.distance.min())
    if ways.free.all():
        return clearance, ""
    pair = around.table.names[ways.pairs[int(ways.room.argmin())]]
    return clearance, f"{pair[0]} and {pair[1]} touch"


def _half_way(one: Array, other: Array) -> Array:
    """(m, s, 12) poses half way: origins and rotations."""
    mean = (one + other) / 2
    turned = np.flatnonzero((one[..., :9] != other[..., :9]).any(axis=(1, 2)))
    if len(turned):
        u, _, v = np.linalg.svd(mean[turned, :, :9].reshape(len(turned), -1, 3, 3))
        mean[turned, :, :9] = (u @ v).reshape(len(turned), -1, 9)
    return mean
