"""Grasps of a surface: oriented point pairs of hand and object that fit, made exact, and reached.

Geometric hashing of oriented point pairs (Drost et al. 2010) between two opposing fingertips and
two patches of the object gives palm poses; further fingers are looked up in the hand's table. The
palm and the hand are then moved until every fingertip touches; the arm and the scene come last,
through `Solver.solve_palms` and `Solver.solve_batch`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import Table, pose_row
from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.hand_table import (
    BINS,
    HandTable,
    SnapJob,
    TouchJob,
    rigid,
)
from casadi_ik.planning.touch.library import touch_library
from casadi_ik.planning.touch.surface import Grid, Surface


@dataclass(frozen=True)
class TouchParameters:
    """How grasps are looked for.

    Attributes:
        facing: Two patches oppose each other if both normals are within this angle of the line
            between them [rad].
        object_pairs: Pairs of patches that are drawn at once.
        first: Candidates that are looked for at first.
        round: Most that are looked for at once.
        attempts: Pairs of hand and object that are tried for them at most.
        most: Pairs after which no more are tried.
        seldom: Where so many are like others before a new one comes, no more are made.
        lost: Hands after which no more are tried if the arm has reached none of them.
        least_often: The chance of what was never clear beside what was most often.
        deep: Most that counts of how far between two fingertips is from the palm [m].
        object_step: Edge of the cells that tell how far the object is [m], at least ...
        scene_step: ... and how far what stands about it is.
        cells: About how many cells there are at most along either.
        lean: Planes lean by at most this angle at first [rad]; balls may more, everywhere.
        near: A further fingertip is at most this far from the surface at first [m].
        clear: Fingertips that do not touch are at least this far from it [m].
        tries: Postures of a further finger that are tried against collisions.
        steps: Of damped least squares on palm and hand.
        free_lean: Within this angle a pad leans for nothing [rad].
        slide: Weight of sliding along the surface beside leaving it.
        turn: Metres that count as much as a radian of lean.
        touch: What a fingertip may be off the surface at last [m].
        max_spread: Largest angle between the triangles that meet at a contact and their mean, and
            between this and the direction in which the pad meets them [rad]; beyond, it is an edge.
        last_lean: What it may lean at last [rad].
        apart: Two grasps differ if a fingertip or the palm is so far elsewhere [m] ...
        turned: ... or the palm is turned by so much [rad].
    """

    facing: float = float(np.deg2rad(45.0))
    object_pairs: int = 40_000
    first: int = 24
    round: int = 2000
    attempts: int = 100_000
    most: int = 1_000_000
    seldom: int = 3000
    lost: int = 300
    least_often: float = 0.03
    deep: float = 0.2
    object_step: float = 5e-3
    scene_step: float = 25e-3
    cells: int = 36
    lean: float = float(np.deg2rad(25.0))
    near: float = 8e-3
    clear: float = 8e-3
    tries: int = 24
    steps: int = 4
    free_lean: float = float(np.deg2rad(8.0))
    slide: float = 0.25
    turn: float = 0.02
    touch: float = 1e-3
    max_spread: float = float(np.deg2rad(20.0))
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
        contacts: Contacts with the surface; None where they were not looked up.
    """

    palm: Array
    hand: Array
    used: Bools
    tips: Array = field(default_factory=lambda: np.zeros(0))
    contacts: Touching | None = None

    def __len__(self) -> int:
        return len(self.hand)

    def rows(self, rows: NDArray) -> Candidates:
        """Some of them."""
        tips = self.tips[rows] if len(self.tips) else self.tips
        contacts = None if self.contacts is None else self.contacts.rows(rows)
        return Candidates(self.palm[rows], self.hand[rows], self.used[rows], tips, contacts)

    def alike(self, others: Candidates, chosen: TouchParameters) -> Bools:
        """(k, n) which have palm and fingertips about where others have them."""
        turns, theirs = (one.palm[:, :3, :3].reshape(-1, 9) for one in (self, others))
        same = turns @ theirs.T > 1 + 2 * np.cos(chosen.turned)
        same &= (self.used[:, None] == others.used).all(axis=2)
        same &= _apart(self.palm[:, :3, 3], others.palm[:, :3, 3]) < chosen.apart
        for finger in range(self.used.shape[1]):
            off = _apart(self.tips[:, finger], others.tips[:, finger]) < chosen.apart
            same &= off | ~self.used[:, finger, None]
        return same

    def unlike(self, others: Candidates, chosen: TouchParameters) -> NDArray[np.intp]:
        """Rows that are unlike all of others."""
        return np.flatnonzero(~self.alike(others, chosen).any(axis=1))

    def distinct(self, chosen: TouchParameters, together: int = 256) -> NDArray[np.intp]:
        """In their order the first of those that are alike."""
        left, found = np.arange(len(self)), np.zeros(0, dtype=np.intp)
        while len(left):
            rows, left = left[:together], left[together:]
            same = self.rows(rows).alike(self.rows(rows), chosen)
            first = np.ones(len(rows), dtype=bool)
            for i in range(len(rows)):
                first[i + 1 :] &= ~(first[i] & same[i, i + 1 :])
            found = np.append(found, rows[first])
            left = left[self.rows(left).unlike(self.rows(rows[first]), chosen)]
        return found


def _apart(points: Array, others: Array) -> Array:
    """(k, n) distances of points (k, 3) and (n, 3)."""
    return np.sqrt(((points[:, None] - others) ** 2).sum(axis=2))


WHY_NONE = {
    "two fingertips fit": "no pads face two patches of the object well enough",
    "they are clear": "palm or fingers would be in the object",
    "fingertips touch": "the other fingers find nothing to touch, or are in the way; fewer "
    "fingers may do",
    "made exact": "fingertips do not come to rest on the surface inside a face",
    "still clear": "palm or fingers would be in the object",
    "force-closed": "contacts do not oppose each other within friction",
    "hold ": "it is too heavy for that squeeze, friction and the motors' torques",
    "arm reaches": "the object is out of the arm's reach, or only from sides that hold nothing",
    "contacts as claimed": "contacts are off, lean, or are not closed once the arm is solved",
    "free in the scene": "arm or hand would hit something of the scene, or the object",
}
"""What it means that nothing passes a stage."""


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
        self._entry = touch_library()["casadi_ik_touch"]
        self._pairs = np.zeros((0, 4), dtype=np.int64)
        self._job, self._kept = self._made(int(self.rng.integers(2**62)))
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
        self._pairs = np.ascontiguousarray(np.concatenate([self._pairs, pairs]))

    @property
    def fits(self) -> bool:
        """Whether any two opposing patches have the distance and angles of two fingertips."""
        return len(self._pairs) > 0

    def counted(self, stage: str, number: int) -> None:
        """Count what passed a stage."""
        self.counts[stage] = self.counts.get(stage, 0) + int(number)

    def candidates(self, count: int) -> Candidates:
        """Of so many palms and hands those whose fingertips touch, clear of all but the arm."""
        table, surface, chosen = self.table, self.surface, self.parameters
        some = self.draw(count)
        if len(some):
            some = snapped(table, surface, some, chosen)
            tips = pads_of(table, some).points
            contacts = touching(table, surface, some)
            # Whether an edge of the surface is near is known for samples.
            feet = np.where(some.used[..., None], contacts.foot, tips)
            fits = surface.inside[surface.foot(feet)[1]]
            ok = contacts.accepted(chosen, table.roll) & fits
            rows = np.flatnonzero((ok | ~some.used).all(axis=1))
            some = replace(some, tips=tips, contacts=contacts).rows(rows)
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
        """So many, if they are found: two fingertips fit, the others find something to touch."""
        job, table = self._job, self.table
        f = len(table.radii)
        palms, shared = np.empty((count, 12)), np.empty(count, dtype=np.int64)
        postured, used = np.empty((2, count, f), dtype=np.int64)
        job.palms, job.shared = palms.ctypes.data, shared.ctypes.data
        job.postured, job.used = postured.ctypes.data, used.ctypes.data
        job.patches, job.n_patches = self._pairs.ctypes.data, len(self._pairs)
        job.wanted, job.found, job.most = count, 0, job.attempts + self.parameters.attempts
        run_cancellable("touch", self._entry, job)
        found = job.found
        hand = table.q[shared[:found], postured[:found, table.thumb]].copy()
        for finger in range(f):
            posture = table.q[shared[:found], postured[:found, finger]]
            table.put(hand, np.arange(found), posture, finger)
        self.counts |= {
            "attempts": job.attempts,
            "two fingertips fit": job.fit,
            "they are clear": job.free,
        }
        self.counted(f"{self.fingers} fingertips touch, all clear", found)
        palm = rigid(palms[:found, :9].reshape(-1, 3, 3), palms[:found, 9:])
        return Candidates(palm, hand, used[:found].astype(bool))

    def _made(self, seed: int) -> tuple[Any, tuple[Any, ...]]:
        """What the driver works on, but for what follows from a round; what has to live as long."""
        table, surface, chosen, shapes = (
            self.table,
            self.surface,
            self.parameters,
            self.clear.shapes,
        )
        low, high = surface.points.min(axis=0), surface.points.max(axis=0)
        thing, around = self.clear.grids(low, high, chosen)
        arrays: dict[str, Any] = {
            "points": table.points,
            "normals": table.normals,
            "off_object": self.clear.off(True),
            "off_scene": self.clear.off(False),
            "radii": table.radii,
            "cos_lean": np.cos(chosen.lean + table.roll),
            "pairs": table.pairs.astype(np.int64),
            "depths": table.depths / chosen.deep,
            "samples": surface.points,
            "outward": surface.normals,
            "inside": surface.inside.astype(np.int64),
            "near_height": surface.grid.value,
            "near_sample": surface.grid.sample,
            "object_value": thing.value,
            "scene_value": around.value,
        }
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        job = TouchJob(
            **shapes.job,
            **{name: array.ctypes.data for name, array in arrays.items()},
            thumb=table.thumb,
            near=chosen.near,
            clear=chosen.clear,
            least_often=chosen.least_often,
            fingers=self.fingers,
            tries=chosen.tries,
            seed=seed,
        )
        for name, grid in (("near", surface.grid), ("object", thing), ("scene", around)):
            getattr(job, f"{name}_low")[:] = grid.low.tolist()
            getattr(job, f"{name}_count")[:] = grid.counts.tolist()
        job.up[:] = self.clear.pose[2, :3].tolist()
        for name in ("depth", "way"):
            getattr(job, f"{name}_clear")[:] = [1.0] * BINS
            getattr(job, f"{name}_tried")[:] = [2.0] * BINS
        return job, (arrays, shapes)


@dataclass(frozen=True)
class Pads:
    """Fingertip pads in the object's frame.

    Attributes:
        points: (k, f, 3) centres of balls, contact points of planes [m].
        normals: (k, f, 3) outward pad normals.
    """

    points: Array
    normals: Array


def pads_of(table: HandTable, hands: Candidates) -> Pads:
    """Return the fingertip pads of hands in the object's frame."""
    points, normals, _, _ = table.at(hands.hand)
    rotation, origin = hands.palm[:, None, :3, :3], hands.palm[:, None, :3, 3]
    turn = np.broadcast_to(rotation, (*points.shape, 3))
    points = np.einsum("kfij,kfj->kfi", turn, points) + origin
    return Pads(points, np.einsum("kfij,kfj->kfi", turn, normals))


@dataclass(frozen=True)
class Touching:
    """Contacts of fingertips with the triangles of a surface, object frame.

    Attributes:
        foot: (k, f, 3) nearest points of the surface [m].
        inward: (k, f, 3) unit normals into the object; means where several triangles meet.
        spread: (k, f) largest angle between such a mean and the normals of its triangles [rad].
        toward: (k, f, 3) unit directions in which pads that are balls meet the surface.
        height: (k, f) distances of pads from the surface [m], negative inside.
        lean: (k, f) largest angle between a pad normal and the inward normals [rad].
    """

    foot: Array
    inward: Array
    spread: Array
    toward: Array
    height: Array
    lean: Array

    def rows(self, rows: NDArray) -> Touching:
        """Return the contacts of some of the hands."""
        return Touching(*(getattr(self, part.name)[rows] for part in fields(self)))

    def accepted(self, parameters: TouchParameters, roll: Array) -> Bools:
        """Return which pads (k, f) touch the surface as grasps promise.

        Args:
            parameters: The limits of distance and lean.
            roll: (f,) additional lean that pads may have [rad].
        """
        aside = np.arccos(np.clip((self.toward * self.inward).sum(axis=-1), -1, 1))
        touches: Bools = np.abs(self.height) < parameters.touch
        touches &= self.lean < parameters.last_lean + roll
        return touches & (np.maximum(self.spread, aside) < parameters.max_spread)


def touching(table: HandTable, surface: Surface, hands: Candidates) -> Touching:
    """Return the exact contacts of fingertips with the triangles of a surface.

    Of fingers that do not touch all numbers are NaN.
    """
    pads = pads_of(table, hands)
    row, finger = np.nonzero(hands.used)
    points, normals, radii = (
        pads.points[row, finger],
        pads.normals[row, finger],
        table.radii[finger],
    )
    nearest = surface.nearest(points)
    away = points - nearest.point
    side = (away * nearest.normal).sum(axis=1)
    distance = np.copysign(np.linalg.norm(away, axis=1), side)
    far = (radii > 0) & (np.abs(distance) > 1e-6)
    toward = np.where(far[:, None], -away / np.where(far, distance, 1.0)[:, None], -nearest.normal)
    lean = np.arccos(np.clip(-(normals * nearest.normal).sum(axis=1), -1, 1)) + nearest.spread

    def spread_out(values: Array) -> Array:
        whole = np.full((*hands.used.shape, *values.shape[1:]), np.nan)
        whole[row, finger] = values
        return whole

    parts = nearest.point, -nearest.normal, nearest.spread, toward, distance - radii, lean
    return Touching(*(spread_out(part) for part in parts))


def snapped(
    table: HandTable, surface: Surface, some: Candidates, chosen: TouchParameters
) -> Candidates:
    """Palms and hands moved until every fingertip touches: damped least squares, limits kept."""
    _, start = surface.foot(pads_of(table, some).points)
    palms, q = pose_row(some.palm), table.configuration(some.hand)
    robot, motors = table.robot, table.motors
    arrays: dict[str, Any] = {
        "palms": palms,
        "q": q,
        "used": some.used.astype(np.int64),
        "motors": motors.astype(np.int64),
        "lower": robot.lower[motors],
        "upper": robot.upper[motors],
        "radii": table.radii,
        "free_lean": chosen.free_lean + table.roll,
        "samples": surface.points,
        "normals": surface.normals,
        "faces": surface.faces,
        "neighbours": surface.neighbours,
        "start": start.astype(np.int64),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    job = SnapJob(
        **{name: array.ctypes.data for name, array in arrays.items()},
        slide=chosen.slide,
        turn=chosen.turn,
        steps=chosen.steps,
        count=len(q),
        slice=SLICE,
    )
    run_cancellable("snap", table.kernel.library["casadi_ik_snap"], job)
    palm = rigid(arrays["palms"][:, :9].reshape(-1, 3, 3), arrays["palms"][:, 9:])
    return Candidates(palm, arrays["q"][:, motors], some.used)


class HandCheck:
    """Whether palms and hands hit the object, what stands about it, or themselves; arms aside.

    The arm stays at home and the world is moved instead, so that the collision kernel of solves
    serves before there is an arm.
    """

    def __init__(
        self, table: HandTable, check: SceneCheck, pose: Array, tables: dict[bytes, Any]
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
        self.shapes = table.shape(check)

    def grids(self, low: Array, high: Array, chosen: TouchParameters) -> tuple[Grid, Grid]:
        """Distances of the object, and of what stands about it, in the object's frame.

        Args:
            low: (3,) lower corner of the object [m].
            high: (3,) upper corner.
            chosen: How finely.
        """
        scene, size = self.check.scene, float((high - low).max())
        if OBJECT not in self._tables:
            parts = scene.items[str(scene.grasped)].parts
            step = max(chosen.object_step, size / chosen.cells)
            grown = max(float(self.off(True).max(initial=0.0)), 0.0) + 2 * step
            self._tables[OBJECT] = Grid.of(parts, low - grown, high + grown, step)
        reach = sum(
            float(np.abs(part[..., :3]).max(initial=0.0))
            for part in (self.shapes.capsules, self.shapes.fixed)
        )
        others = [
            (solid, inverse(self.pose) @ item.pose @ at)
            for item in scene.items.values()
            if item.name != scene.grasped
            for solid, at in item.parts
        ]
        step = max(chosen.scene_step, (size + 2 * reach) / chosen.cells)
        return self._tables[OBJECT], Grid.of(others, low - reach, high + reach, step)

    def off(self, object_: bool) -> Array:
        """(c,) what the middles of the hand's capsules keep off the object, or what is about it."""
        every, shapes = self._every, self.shapes
        first = len(every.radii) + every.own
        grasped = np.array([name == self.check.scene.grasped for name in every.items], dtype=bool)
        with_ = every.pairs[:, 1] >= first
        with_[with_] = grasped[every.pairs[with_, 1] - first] == object_
        least = np.full(len(every.radii), -np.inf)
        np.maximum.at(least, every.pairs[with_, 0], every.offsets[with_])
        return (least + every.radii + self.check.scene.margin)[shapes.numbers]

    def __call__(self, some: Candidates) -> Bools:
        """(k,) which are clear."""
        q = self.table.configuration(some.hand)
        world = self.table.palm @ inverse(self.pose @ some.palm)
        ok = np.zeros(len(some), dtype=bool)
        code = some.used @ (1 << np.arange(some.used.shape[1]))
        for value in set(code.tolist()):
            rows = np.flatnonzero(code == value)
            table = self._table(some.used[rows[0]])
            poses = pose_row(world[rows, None] @ self._items)
            around = CollisionQuery(self.check.kernel, table, poses, self.check.scene.margin)
            ok[rows] = around.free(q[rows])
        return ok

    def arm_clear(self, q: Array) -> Bools:
        """(k,) whether arms of configurations (k, n) are clear of all; hands aside."""
        check = self.check
        table = check.table(check.scene, frozenset()).swung
        around = CollisionQuery(
            check.kernel, table, table.poses(check.scene.items), check.scene.margin
        )
        return around.free(q)

    def _table(self, used: Bools) -> Table:
        """The pairs that count: fingertips that are used may touch the object."""
        key = used.tobytes()
        if key not in self._tables:
            names = zip(self.table.robot.fingers, used, strict=True)
            pads = [self.check.bodies_of_fingers[name] for name, on in names if on]
            touched, grasped = frozenset[str]().union(*pads), self.check.scene.grasped
            kept = [not (pair[1] == grasped and pair[0] in touched) for pair in self._every.names]
            self._tables[key] = self._every.only(np.array(kept, dtype=bool))
        return self._tables[key]


OBJECT = b"object"
"""Under which the grid of an object is kept."""
