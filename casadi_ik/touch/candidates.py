"""Grasps of a surface: oriented point pairs of hand and object that fit, made exact, and reached.

Geometric hashing of oriented point pairs (Drost et al. 2010) between two opposing fingertips and
two patches of the object gives palm poses; further fingers are looked up in the hand's table. The
palm and the hand are then moved until every fingertip touches; the arm and the scene come last,
through `Solver.solve_palms` and `Solver.solve_batch`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.collision.distances import Table, pose_row
from casadi_ik.grasps.pose import inverse
from casadi_ik.problem.clearance import CollisionQuery, SceneCheck
from casadi_ik.touch.hand_table import HandTable, rigid
from casadi_ik.touch.surface import Surface


@dataclass(frozen=True)
class TouchParameters:
    """How grasps are looked for.

    Attributes:
        facing: Two patches oppose each other if both normals are within this angle of the line
            between them [rad].
        object_pairs: Pairs of patches that are drawn at once.
        first: Pairs of hand and object that are tried at first.
        attempts: Most that are tried at once.
        most: Attempts after which no more are made.
        seldom: Where so many are like others for each new one, no more are made.
        lost: Hands after which no more are tried if the arm has reached none of them.
        lean: Planes lean by at most this angle at first [rad]; balls may more, everywhere.
        near: A further fingertip is at most this far from the surface at first [m].
        clear: Fingertips that do not touch are at least this far from it [m].
        looked: Postures of a further finger that are looked at.
        tries: Of them that are tried against collisions.
        together: Candidates whose further fingers are looked up at once.
        steps: Of damped least squares on palm and hand.
        free_lean: Within this angle a pad leans for nothing [rad].
        slide: Weight of sliding along the surface beside leaving it.
        turn: Metres that count as much as a radian of lean.
        touch: What a fingertip may be off the surface at last [m].
        aside: How far the nearest sample may be aside of a pad at last [m]: where it is farther the
            pad is beyond an edge.
        last_lean: What it may lean at last [rad].
        apart: Two grasps differ if a fingertip or the palm is so far elsewhere [m] ...
        turned: ... or the palm is turned by so much [rad].
    """

    facing: float = float(np.deg2rad(45.0))
    object_pairs: int = 20_000
    first: int = 500
    attempts: int = 60_000
    most: int = 1_000_000
    seldom: int = 1000
    lost: int = 300
    lean: float = float(np.deg2rad(25.0))
    near: float = 8e-3
    clear: float = 8e-3
    looked: int = 192
    tries: int = 12
    together: int = 2000
    steps: int = 6
    free_lean: float = float(np.deg2rad(8.0))
    slide: float = 0.25
    turn: float = 0.02
    touch: float = 1e-3
    aside: float = 4e-3
    last_lean: float = float(np.deg2rad(15.0))
    apart: float = 0.010
    turned: float = float(np.deg2rad(15.0))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Palms and hands, k of them, in the object's frame.

    Attributes:
        palm: (k, 4, 4) pose of the palm in the object's frame.
        hand: (k, m) positions of the fingers' motors [rad or m].
        used: (k, f) which fingers touch.
        tips: (k, f, 3) fingertips [m]; empty where they were not looked up.
    """

    palm: Array
    hand: Array
    used: Bools
    tips: Array = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.hand)

    def rows(self, rows: NDArray) -> Candidates:
        """Some of them."""
        tips = self.tips[rows] if len(self.tips) else self.tips
        return Candidates(self.palm[rows], self.hand[rows], self.used[rows], tips)

    def alike(self, one: int, others: NDArray[np.intp], chosen: TouchParameters) -> Bools:
        """Which of others have palm and fingertips about where one has them."""
        turn = np.einsum("kij,ij->k", self.palm[others, :3, :3], self.palm[one, :3, :3])
        turned = np.arccos(np.clip((turn - 1) / 2, -1, 1)) < chosen.turned
        near = np.linalg.norm(self.palm[others, :3, 3] - self.palm[one, :3, 3], axis=1)
        off = np.linalg.norm(self.tips[others] - self.tips[one], axis=-1)
        off = np.where(self.used[one], off, 0.0).max(axis=1)
        same = (self.used[others] == self.used[one]).all(axis=1)
        return turned & same & (np.maximum(near, off) < chosen.apart)


WHY_NONE = {
    "two fingertips fit": "no pads face two patches of the object well enough",
    "they are clear": "palm or fingers would be in the object",
    "fingertips touch": "the other fingers find nothing to touch, or are in the way; fewer "
    "fingers may do",
    "made exact": "fingertips do not come to rest on the surface inside a face",
    "still clear": "palm or fingers would be in the object",
    "force-closed": "contacts do not oppose each other within friction",
    "hold ": "it is too heavy for that squeeze and friction",
    "arm reaches": "the object is out of the arm's reach, or only from sides that hold nothing",
    "free in the scene": "arm or hand would hit something of the scene, or the object",
}
"""What it means that nothing passes a stage."""


class Luck:
    """How often attempts were clear of all, by a number from 0 to 1 that they have."""

    def __init__(self, bins: int = 20) -> None:
        """Nothing is known yet."""
        self.clear, self.tried = np.ones(bins), np.full(bins, 2.0)

    def often(self, values: Array, rng: np.random.Generator) -> NDArray[np.intp]:
        """Some of the values, the rarer the seldomer they were clear, but some of all."""
        share = self.clear / self.tried
        chance = np.maximum(share / share.max(), LEAST_OFTEN)
        return np.flatnonzero(rng.random(len(values)) < chance[self._bins(values)])

    def learn(self, values: Array, clear: Bools) -> None:
        """Count which of some values were clear."""
        bins = self._bins(values)
        self.tried += np.bincount(bins, minlength=len(self.tried))
        self.clear += np.bincount(bins[clear], minlength=len(self.tried))

    def _bins(self, values: Array) -> NDArray[np.intp]:
        return np.clip((values * len(self.tried)).astype(np.intp), 0, len(self.tried) - 1)


LEAST_OFTEN = 0.03
"""The chance of what was never clear beside what was most often."""

DEEP = 0.2
"""Most that counts of how far between two fingertips is from the palm [m]."""


def pairs_of_fingers(table: HandTable, cells: NDArray[np.intp], palm: Array) -> Candidates:
    """Palms (k, 4, 4) with thumb and another finger as in pairs (k,) of the table."""
    share, other, a, b = table.pairs[cells].T
    used = np.zeros((len(cells), len(table.radii)), dtype=bool)
    some = Candidates(palm, table.q[share, a].copy(), used)
    used[:, table.thumb] = used[np.arange(len(other)), other] = True
    for number in set(other.tolist()):
        rows = np.flatnonzero(other == number)
        table.put(some.hand, rows, table.q[share[rows], b[rows]], number)
    return some


@dataclass
class Generator:
    """Candidates of one surface and one hand.

    Attributes:
        table: The hand's.
        surface: The object's.
        fingers: How many fingertips touch.
        parameters: How they are looked for.
        rng: Random numbers.
        counts: How many passed each stage.
        asked: How many of them the arm was asked to reach.
        alike: How many of the last round were like others.
    """

    table: HandTable
    surface: Surface
    fingers: int
    parameters: TouchParameters
    rng: np.random.Generator
    clear: HandCheck
    counts: dict[str, int] = field(default_factory=dict)
    asked: int = 0
    alike: int = 0

    def __post_init__(self) -> None:
        self._pairs = np.zeros((0, 4), dtype=np.intp)
        self.depths, self.ways = Luck(), Luck()
        self.clear.sift()
        self.look()

    def look(self) -> None:
        """Draw more pairs of patches; those are kept that two fingertips may fit."""
        surface, chosen = self.surface, self.parameters
        good = np.flatnonzero(surface.inside)
        if len(good) < 2:
            return
        i, j = good[self.rng.integers(len(good), size=(2, chosen.object_pairs))]
        way = surface.points[j] - surface.points[i]
        length = np.linalg.norm(way, axis=1)
        first = -np.einsum("ki,ki->k", way, surface.normals[i])
        second = np.einsum("ki,ki->k", way, surface.normals[j])
        facing = np.minimum(first, second) > np.cos(chosen.facing) * length
        kept = np.flatnonzero(facing & (length > 5e-3))
        i, j, way = i[kept], j[kept], way[kept]
        turns = np.arccos(np.clip(np.stack([first, second])[:, kept] / length[kept], -1, 1))
        # Balls touch where they are so far from the middle, and may lean.
        table = self.table
        others = np.arange(len(table.radii)) != table.thumb
        radii, roll = (
            np.array([own[table.thumb], own[others].mean()]) for own in (table.radii, table.roll)
        )
        way = way + radii[1] * surface.normals[j] - radii[0] * surface.normals[i]
        turns = np.abs(turns + roll[:, None] * self.rng.uniform(-1, 1, turns.shape))
        found = table.cells(table.key(np.linalg.norm(way, axis=1), *np.cos(turns)))
        pairs = np.stack([i, j, *found], axis=1)[found[1] > 0]
        self._pairs = np.concatenate([self._pairs, pairs])

    @property
    def fits(self) -> bool:
        """Whether any two opposing patches have the distance and angles of two fingertips."""
        return len(self._pairs) > 0

    def counted(self, stage: str, number: int) -> None:
        """Count what passed a stage."""
        self.counts[stage] = self.counts.get(stage, 0) + int(number)

    def candidates(self, attempts: int) -> Candidates:
        """Palms and hands whose fingertips touch, clear of all but the arm."""
        table, surface, chosen = self.table, self.surface, self.parameters
        some = self.draw(attempts)
        if len(some):
            some = snapped(table, surface, some, chosen)
            here, _, _ = touching(table, surface, some)
            ok = np.abs(here.height) < chosen.touch
            ok &= (here.lean < chosen.last_lean + table.roll) & surface.inside[here.sample]
            off = ((here.points - surface.points[here.sample]) ** 2).sum(axis=-1)
            ok &= off - (here.height + table.radii) ** 2 < chosen.aside**2
            rows = np.flatnonzero((ok | ~some.used).all(axis=1))
            some = replace(some, tips=here.points).rows(rows)
        self.counted("made exact", len(some))
        some = some.rows(np.flatnonzero(self.clear(some)))
        self.counted("still clear", len(some))
        return some

    def why_none(self) -> str:
        """What no candidate passed."""
        if not self.fits:
            return (
                "no two patches of the object are as far apart, and face each other as well, as "
                "the thumb and another fingertip can"
            )
        stage = next((name for name, number in self.counts.items() if not number), "")
        why = next((f" ({why})" for key, why in WHY_NONE.items() if key in stage), "")
        return f"of {self.counts['attempts']:,} attempts none came to: {stage}{why}"

    def draw(self, count: int) -> Candidates:
        """Candidates of some attempts: two fingertips fit, the others find something to touch."""
        table, surface, chosen, rng = self.table, self.surface, self.parameters, self.rng
        row = rng.integers(len(self._pairs), size=count)
        i, j, start, number = self._pairs[row].T
        cell = start + (rng.random(count) * number).astype(np.intp)
        lucky = self.depths.often(table.depths[cell] / DEEP, rng)
        i, j, cell = (column[lucky] for column in (i, j, cell))
        share, other, a, b = table.pairs[cell].T
        thumb = table.thumb
        self.counted("attempts", len(cell))
        hand_points = np.stack([table.points[share, a, thumb], table.points[share, b, other]], 1)
        hand_normals = np.stack([table.normals[share, a, thumb], table.normals[share, b, other]], 1)
        samples = np.stack([i, j], axis=1)
        which = np.stack([np.full(len(cell), thumb), other], axis=1)
        outward = surface.normals[samples]
        middles = surface.points[samples] + table.radii[which, None] * outward
        palm, lean = _matched(hand_points, hand_normals, middles, -outward)
        fit = np.flatnonzero((lean < chosen.lean + table.roll[which]).all(axis=1))
        # Where the palm's z points, up or down.
        up = 0.5 + 0.5 * palm[fit, :3, 2] @ self.clear.pose[2, :3]
        lucky = self.ways.often(up, rng)
        kept, up = fit[lucky], up[lucky]
        cell, share, a = cell[kept], share[kept], a[kept]
        self.counted("two fingertips fit", len(kept))
        some = pairs_of_fingers(table, cell, palm[kept])
        ok = self.clear(some, some.used)
        self.depths.learn(table.depths[cell] / DEEP, ok)
        self.ways.learn(up, ok)
        kept = np.flatnonzero(ok)
        self.counted("they are clear", len(kept))
        some, share = some.rows(kept), share[kept]
        own, names = table.normals[share, a[kept], thumb], table.robot.fingers
        pads = np.einsum("kij,kj->ki", some.palm[:, :3, :3], own)
        placed = some.used.copy()
        for rest, number in zip(range(len(names))[::-1], rng.permutation(len(names)), strict=True):
            for start in range(0, len(share), chosen.together):
                rows = np.arange(start, min(start + chosen.together, len(share)))
                rows = rows[placed[rows].any(axis=1) & ~placed[rows, number]]
                if len(rows):
                    short = some.used[rows].sum(axis=1) + rest < self.fingers
                    self._place(some, placed, share, rows, number, pads, short)
        kept = np.flatnonzero(placed.all(axis=1) & (some.used.sum(axis=1) == self.fingers))
        self.counted(f"{self.fingers} fingertips touch, all clear", len(kept))
        return some.rows(kept)

    def _place(
        self,
        some: Candidates,
        placed: Bools,
        share: NDArray[np.intp],
        rows: NDArray[np.intp],
        number: int,
        thumb: Array,
        short: Bools,
    ) -> None:
        """Give a finger a posture that touches, where more are wanted, else one that is clear.

        It has to touch in rows that are short of fingers: those that follow are too few. A row for
        which none is found is given up: none of its fingers counts as placed.
        """
        chosen = self.parameters
        every = self.table.q.shape[1]
        postures = self.rng.choice(every, min(chosen.looked, every), replace=False)
        height, touch, against = self._looked_up(
            some.palm[rows], thumb[rows], share[rows], number, postures
        )
        wanted = some.used[rows].sum(axis=1) < self.fingers
        # Of postures that touch rather one that pushes against the thumb.
        chance = self.rng.random(touch.shape)
        idle = np.where((height > chosen.clear) & ~short[:, None], chance, -1.0)
        rank = np.where(touch & wanted[:, None], 4.0 + chance + 2.0 * against, idle)
        left = np.arange(len(rows))
        for _ in range(chosen.tries):
            best = rank[left].argmax(axis=1)
            value = rank[left, best]
            left, best, value = left[value >= 0], best[value >= 0], value[value >= 0]
            if not len(left):
                break
            here = rows[left]
            trial = some.rows(here)
            posture = self.table.q[share[here], postures[best]]
            self.table.put(trial.hand, np.arange(len(here)), posture, number)
            trial.used[:, number] = value > 1.0
            present = placed[here].copy()
            present[:, number] = True
            ok = self.clear(trial, present)
            some.hand[here[ok]], some.used[here[ok]] = trial.hand[ok], trial.used[ok]
            placed[here[ok], number] = True
            rank[left, best] = -1.0
            left = left[~ok]
        placed[rows[~placed[rows, number]]] = False

    def _looked_up(
        self,
        palm: Array,
        thumb: Array,
        share: NDArray[np.intp],
        number: int,
        postures: NDArray[np.intp],
    ) -> tuple[Array, Bools, Array]:
        """Of postures of a finger at palms, (k, n) each.

        Returns:
            Heights of the tip over the surface [m], which ones touch, and minus the cosine of their
            pads' normals with the thumb's axis: what they do against it.
        """
        table, surface, chosen = self.table, self.surface, self.parameters
        points = table.points[share[:, None], postures, number]
        normals = table.normals[share[:, None], postures, number]
        rotation, origin = palm[:, :3, :3], palm[:, :3, 3]
        tips = points @ rotation.swapaxes(1, 2) + origin[:, None]
        height, sample = surface.roughly(tips)
        height = height - table.radii[number]
        ok = np.abs(height) < chosen.near + surface.step
        row, posture = np.nonzero(ok)
        chosen_samples = sample[row, posture]
        normal = surface.normals[chosen_samples]
        exact = ((tips[row, posture] - surface.points[chosen_samples]) * normal).sum(axis=-1)
        exact -= table.radii[number]
        pads = np.einsum("kij,kj->ki", rotation[row], normals[row, posture])
        ok[row, posture] = (
            (np.abs(exact) < chosen.near)
            & surface.inside[chosen_samples]
            & (-(pads * normal).sum(axis=-1) > np.cos(chosen.lean + table.roll[number]))
        )
        against = np.zeros(ok.shape)
        against[row, posture] = -np.einsum("ki,ki->k", pads, thumb[row])
        return height, ok, against


def _matched(
    hand: Array, hand_normals: Array, object_: Array, object_normals: Array
) -> tuple[Array, Array]:
    """Palms (k, 4, 4) that bring two points (k, 2, 3) onto two others, and how pads lean (k, 2)."""
    frames = []
    for points, normals in ((hand, hand_normals), (object_, object_normals)):
        line = points[:, 1] - points[:, 0]
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        # The turn about the line brings the sums of both normals' parts across it together.
        across = normals - (normals * line[:, None]).sum(axis=-1, keepdims=True) * line[:, None]
        frames.append((line, across))
    (line, across), (goal, wanted) = frames
    least = np.eye(3)[np.abs(line).argmin(axis=1)]
    x = np.cross(line, least)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    from_ = np.stack([x, np.cross(line, x), line], axis=-1)
    least = np.eye(3)[np.abs(goal).argmin(axis=1)]
    u = np.cross(goal, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(goal, u)
    to = np.stack([u, v, goal], axis=-1)
    flat = np.einsum("kji,kcj->kci", from_, across)[..., :2]
    aim = np.einsum("kji,kcj->kci", to, wanted)[..., :2]
    cosine = (flat * aim).sum(axis=(1, 2))
    sine = (flat[..., 0] * aim[..., 1] - flat[..., 1] * aim[..., 0]).sum(axis=1)
    turn = np.arctan2(sine, cosine)
    spin = np.zeros((len(turn), 3, 3))
    spin[:, 0, 0] = spin[:, 1, 1] = np.cos(turn)
    spin[:, 1, 0], spin[:, 0, 1], spin[:, 2, 2] = np.sin(turn), -np.sin(turn), 1.0
    rotation = to @ spin @ from_.swapaxes(1, 2)
    middle = object_.mean(axis=1) - np.einsum("kij,kj->ki", rotation, hand.mean(axis=1))
    turned = np.einsum("kij,kcj->kci", rotation, hand_normals)
    lean = np.arccos(np.clip((turned * object_normals).sum(axis=-1), -1, 1))
    return rigid(rotation, middle), lean


@dataclass(frozen=True)
class Touching:
    """Where fingertips are on a surface.

    Attributes:
        points: (k, f, 3) middles of pads' balls, of planes contact points [m], object frame.
        normals: (k, f, 3) pad normals.
        height: (k, f) distance of pads from the surface [m].
        sample: (k, f) nearest samples.
        lean: (k, f) between pad normals and the surface's [rad].
    """

    points: Array
    normals: Array
    height: Array
    sample: NDArray[np.intp]
    lean: Array


def touching(table: HandTable, surface: Surface, some: Candidates) -> tuple[Touching, Array, Array]:
    """Where fingertips are, and their Jacobians (k, f, 3, m) in the object's frame."""
    points, normals, linear, angular = table.at(some.hand)
    rotation, origin = some.palm[:, None, :3, :3], some.palm[:, None, :3, 3]
    turn = np.broadcast_to(rotation, (*points.shape, 3))
    points = np.einsum("kfij,kfj->kfi", turn, points) + origin
    normals = np.einsum("kfij,kfj->kfi", turn, normals)
    height, sample = surface.foot(points)
    lean = np.arccos(np.clip(-(normals * surface.normals[sample]).sum(axis=-1), -1, 1))
    here = Touching(points, normals, height - table.radii, sample, lean)
    return here, turn @ linear, turn @ angular


def snapped(
    table: HandTable, surface: Surface, some: Candidates, chosen: TouchParameters
) -> Candidates:
    """Palms and hands moved until every fingertip touches: damped least squares, limits kept.

    Rows of a fingertip: its height over the surface, sliding along it (nearly free), and the part
    of its lean that is beyond what a pad does for nothing.
    """
    k, m = some.hand.shape
    lower, upper = table.robot.lower[table.motors], table.robot.upper[table.motors]
    for _ in range(chosen.steps):
        here, linear, angular = touching(table, surface, some)
        about = some.palm[:, None, :3, 3]
        normal = surface.normals[here.sample]
        f = normal.shape[1]
        # Of a twist of the palm (v, w): a point moves by v + w x r, a normal by w x n.
        arms = here.points - about
        to_points = np.concatenate(
            [np.broadcast_to(np.eye(3), (k, f, 3, 3)), -_cross(arms), linear], -1
        )
        to_turns = np.concatenate(
            [np.zeros((k, f, 3, 3)), np.broadcast_to(np.eye(3), (k, f, 3, 3)), angular], -1
        )
        excess = np.maximum(here.lean - chosen.free_lean - table.roll, 0.0)
        axis = np.cross(here.normals, -normal)
        axis *= (excess / np.maximum(np.linalg.norm(axis, axis=-1), 1e-9))[..., None]
        rows = [
            np.einsum("kfi,kfij->kfj", normal, to_points)[:, :, None],
            chosen.slide * to_points,
            chosen.turn * to_turns,
        ]
        goal = [
            -here.height[..., None],
            np.zeros_like(normal),
            chosen.turn * axis,
        ]
        weight = some.used[..., None, None]
        matrix = (np.concatenate(rows, axis=2) * weight).reshape(k, -1, 6 + m)
        right = (np.concatenate(goal, axis=2) * weight[..., 0]).reshape(k, -1)
        step = _bounded_step(matrix, right, some.hand, lower, upper)
        hand = np.clip(some.hand + np.clip(step[:, 6:], -0.3, 0.3), lower, upper)
        twist = step[:, :6]
        turn = _rotation(np.clip(twist[:, 3:], -0.5, 0.5))
        shift = np.clip(twist[:, :3], -0.02, 0.02)
        palm = rigid(turn @ some.palm[:, :3, :3], some.palm[:, :3, 3] + shift)
        some = Candidates(palm, hand, some.used)
    return some


def _bounded_step(matrix: Array, right: Array, hand: Array, lower: Array, upper: Array) -> Array:
    """Damped least-squares steps (k, 6 + m); motors that would leave their range stay."""
    k, m = hand.shape
    free, damping = np.ones((k, 6 + m), dtype=bool), _damping(m)
    step: Array = np.zeros((k, 6 + m))
    for _ in range(2):
        kept = matrix * free[:, None]
        square = kept.swapaxes(1, 2) @ kept
        square[:, range(6 + m), range(6 + m)] += np.where(free, damping, 1.0)
        step[:] = np.linalg.solve(square, kept.swapaxes(1, 2) @ right[..., None])[..., 0]
        after = hand + step[:, 6:]
        free[:, 6:] &= (after >= lower) & (after <= upper)
    return step


def _damping(m: int) -> Array:
    """(6 + m,) of metres, radians of the palm and motors."""
    return np.concatenate([np.full(3, 1e-4), np.full(3, 1e-6), np.full(m, 1e-6)])


def _cross(vectors: Array) -> Array:
    """(..., 3, 3) matrices of the cross product."""
    zero = np.zeros(vectors.shape[:-1])
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*zero.shape, 3, 3)


def _rotation(vectors: Array) -> Array:
    """(k, 3, 3) of rotation vectors."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


class HandCheck:
    """Whether palms and hands hit the object, what stands about it, or themselves; arms aside.

    The arm stays at home and the world is moved instead, so that the collision kernel of solves
    serves before there is an arm.
    """

    def __init__(
        self, table: HandTable, check: SceneCheck, pose: Array, tables: dict[bytes, Table]
    ) -> None:
        """Take over the scene of a solver.

        Args:
            table: The hand's.
            check: Of the scene in which the object is grasped.
            pose: (4, 4) of the object in the base frame.
            tables: Of the same hand and object wherever it was before: pairs that count.
        """
        self.table, self.check, self.pose, self._tables = table, check, pose, tables
        self._every = check.table(check.scene, frozenset()).held
        at = self._every.poses(check.scene.items)
        self._items = rigid(at[:, :9].reshape(-1, 3, 3), at[:, 9:])

    def sift(self) -> None:
        """Leave out the table's pairs of fingers that hit the hand or each other; once."""
        table = self.table
        if not table.sifted:
            every = np.arange(len(table.pairs))
            some = pairs_of_fingers(table, every, np.broadcast_to(np.eye(4), (len(every), 4, 4)))
            table.keep(self(some, some.used, alone=True))

    def __call__(
        self, some: Candidates, present: Bools | None = None, alone: bool = False
    ) -> Bools:
        """(k,) which are clear; of fingers that are not present nothing counts.

        Args:
            some: Palms and hands.
            present: (k, f) fingers; None: all.
            alone: Whether there is nothing but the hand.
        """
        q = self.table.configuration(some.hand)
        world = self.table.palm @ inverse(self.pose @ some.palm)
        if present is None:
            present = np.ones_like(some.used)
        ok = np.zeros(len(some), dtype=bool)
        both = np.concatenate([some.used, present], axis=1)
        code = both @ (1 << np.arange(both.shape[1]))
        for value in set(code.tolist()):
            rows = np.flatnonzero(code == value)
            table = self._table(some.used[rows[0]], present[rows[0]], alone)
            poses = pose_row(world[rows, None] @ self._items)
            around = CollisionQuery(self.check.kernel, table, poses, self.check.scene.margin)
            ok[rows] = around.free(q[rows])
        return ok

    def _table(self, used: Bools, present: Bools, alone: bool) -> Table:
        """The pairs that count: fingertips that are used may touch the object."""
        key = np.concatenate([used, present, [alone]]).tobytes()
        if key not in self._tables:
            robot, motors = self.table.robot, self.table.of_finger
            names = list(zip(robot.fingers, used, present, strict=True))
            pads = [self.check.bodies_of_fingers[name] for name, on, _ in names if on]
            touched, grasped = frozenset[str]().union(*pads), self.check.scene.grasped
            there = {i for name, _, on in names if on for i in motors[name]}
            absent = {i for own in motors.values() for i in own} - there
            moved = robot.description.links_moved
            links = moved(absent) - moved(there)
            kept = [
                links.isdisjoint(pair)
                and not (pair[1] == grasped and pair[0] in touched)
                and not (alone and pair[1] in self.check.scene.items)
                for pair in self._every.names
            ]
            self._tables[key] = self._every.only(np.array(kept, dtype=bool))
        return self._tables[key]
