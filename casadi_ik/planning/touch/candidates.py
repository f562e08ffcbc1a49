"""Candidate grasps of a surface: hands whose fingertips touch it, before the arm is solved.

Geometric hashing of oriented point pairs (Drost et al. 2010) between two opposing fingertips and
two patches of the object gives palm poses; postures of further fingers are looked up in the table
of the hand. Palm and hand are then refined until every fingertip touches.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import PairTable, pose_row
from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.lazy_import import RecordReprMixin
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
    """Parameters of the search for grasps.

    Attributes:
        max_facing_angle: Two patches oppose each other if both normals are within this angle of the
            line between them [rad].
        pairs_per_draw: Pairs of patches that are drawn at once.
        first_batch: Candidates generated in the first batch.
        max_batch: Maximum number of candidates generated in one batch.
        max_attempts_per_batch: Maximum number of pairs of hand and object tried for one batch.
        max_attempts: Maximum number of pairs of hand and object tried in all.
        max_consecutive_duplicates: Stop generating after this many duplicates in a row.
        max_unreachable_hands: Give up if the arm has reached none of this many hand poses.
        min_trial_probability: Probability of trying a palm depth or direction that was never free
            of collision, relative to the one that was so most often.
        max_pinch_depth: Saturation of the depth score: distance of the pinch midpoint from the
            palm [m].
        object_cell: Minimum edge of the cells of the object's distance grid [m].
        scene_cell: Minimum edge of the cells of the scene's distance grid [m].
        max_cells: Approximate maximum number of cells along an edge of either grid.
        max_initial_lean: Largest lean of a plane pad before refinement [rad]; balls lean more.
        max_initial_height: Largest distance of a further fingertip from the surface before
            refinement [m].
        idle_clearance: Least distance from the surface of fingertips that do not touch [m].
        max_posture_trials: Postures of a further finger that are checked for collisions.
        refinement_steps: Steps of damped least squares on palm and hand.
        free_lean: Lean of a plane pad that has no cost in the refinement [rad].
        sliding_weight: Weight of sliding along the surface, relative to distance from it.
        lean_length: Length that costs as much as a radian of lean [m].
        max_height: Largest distance of a pad from the surface in a grasp [m].
        max_spread: Largest angle between the triangles that meet at a contact and their mean
            normal, and between this and the direction in which the pad meets them [rad]; beyond, it
            is an edge.
        max_lean: Largest lean of a plane pad in a grasp [rad].
        min_separation: Grasps are distinct if a fingertip or the palm differs by more than
            this [m].
        min_rotation: Grasps are distinct if the palm is rotated by more than this [rad].
    """

    max_facing_angle: float = float(np.deg2rad(45.0))
    pairs_per_draw: int = 40_000
    first_batch: int = 24
    max_batch: int = 2000
    max_attempts_per_batch: int = 100_000
    max_attempts: int = 1_000_000
    max_consecutive_duplicates: int = 3000
    max_unreachable_hands: int = 300
    min_trial_probability: float = 0.03
    max_pinch_depth: float = 0.2
    object_cell: float = 5e-3
    scene_cell: float = 25e-3
    max_cells: int = 36
    max_initial_lean: float = float(np.deg2rad(25.0))
    max_initial_height: float = 8e-3
    idle_clearance: float = 8e-3
    max_posture_trials: int = 24
    refinement_steps: int = 4
    free_lean: float = float(np.deg2rad(8.0))
    sliding_weight: float = 0.25
    lean_length: float = 0.02
    max_height: float = 1e-3
    max_spread: float = float(np.deg2rad(20.0))
    max_lean: float = float(np.deg2rad(15.0))
    min_separation: float = 0.010
    min_rotation: float = float(np.deg2rad(15.0))


@dataclass(frozen=True, eq=False, repr=False)
class Candidates(RecordReprMixin):
    """Palm poses and hand postures of k candidates, in the object's frame.

    Attributes:
        palm: (k, 4, 4) poses of the palm.
        hand: (k, m) positions of the fingers' motors [rad or m].
        used: (k, f) True for fingers that touch.
        tips: (k, f, 3) fingertips [m]; empty if they were not computed.
        contacts: Contacts with the surface; None if they were not computed.
    """

    palm: Array
    hand: Array
    used: Bools
    tips: Array = field(default_factory=lambda: np.zeros(0))
    contacts: TipContacts | None = None

    def __len__(self) -> int:
        return len(self.hand)

    def rows(self, rows: NDArray) -> Candidates:
        """Return the candidates with the given row numbers."""
        tips = self.tips[rows] if len(self.tips) else self.tips
        contacts = None if self.contacts is None else self.contacts.rows(rows)
        return Candidates(self.palm[rows], self.hand[rows], self.used[rows], tips, contacts)

    def duplicates(self, others: Candidates, parameters: TouchParameters) -> Bools:
        """Return (k, n) True where palm and fingertips are near those of another candidate."""
        rotations, other_rotations = (
            hands.palm[:, :3, :3].reshape(-1, 9) for hands in (self, others)
        )
        same = rotations @ other_rotations.T > 1 + 2 * np.cos(parameters.min_rotation)
        same &= (self.used[:, None] == others.used).all(axis=2)
        limit = parameters.min_separation
        same &= _distances(self.palm[:, :3, 3], others.palm[:, :3, 3]) < limit
        for finger in range(self.used.shape[1]):
            near = _distances(self.tips[:, finger], others.tips[:, finger]) < limit
            same &= near | ~self.used[:, finger, None]
        return same

    def new_rows(self, others: Candidates, parameters: TouchParameters) -> NDArray[np.intp]:
        """Return the rows of candidates that duplicate none of the others."""
        return np.flatnonzero(~self.duplicates(others, parameters).any(axis=1))

    def distinct_rows(self, parameters: TouchParameters, block: int = 256) -> NDArray[np.intp]:
        """Return the rows of candidates that do not duplicate an earlier one.

        Args:
            parameters: Thresholds of a duplicate.
            block: Candidates that are compared pairwise at once.
        """
        remaining, distinct = np.arange(len(self)), np.zeros(0, dtype=np.intp)
        while len(remaining):
            rows, remaining = remaining[:block], remaining[block:]
            same = self.rows(rows).duplicates(self.rows(rows), parameters)
            is_first = np.ones(len(rows), dtype=bool)
            for i in range(len(rows)):
                is_first[i + 1 :] &= ~(is_first[i] & same[i, i + 1 :])
            distinct = np.append(distinct, rows[is_first])
            compared = self.rows(rows[is_first])
            remaining = remaining[self.rows(remaining).new_rows(compared, parameters)]
        return distinct


def _distances(points: Array, others: Array) -> Array:
    """Return the distances (k, n) between points (k, 3) and (n, 3)."""
    return np.sqrt(((points[:, None] - others) ** 2).sum(axis=2))


WHY_NONE = {
    "two fingertips fit": "no pads face two patches of the object well enough",
    "they are clear": "palm or fingers would be in the object",
    "fingertips touch": "the other fingers find nothing to touch, or are in the way; fewer "
    "fingers may do",
    "made exact": "fingertips do not come to rest on the surface inside a face",
    "still clear": "palm or fingers would be in the object",
    "force-closed": "contacts do not oppose each other within friction",
    "hold ": "the object is too heavy for that squeeze, friction and the motors' torques",
    "arm reaches": "the object is out of the arm's reach, or only from sides that hold nothing",
    "contacts as claimed": "contacts are off, lean, or are not closed once the arm is solved",
    "free in the scene": "arm or hand would hit something of the scene, or the object",
}
"""Likely cause if no candidate passes a stage, by a part of the stage's name."""


@dataclass
class Generator:
    """Generator of candidates for one surface and one hand.

    Attributes:
        table: Table of the hand.
        surface: Surface of the object.
        fingers: Number of fingertips that touch.
        parameters: Parameters of the search.
        rng: Random number generator.
        hand_check: Collision check of hands without the arm.
        counts: Number of candidates that passed each stage.
        arm_queries: Number of hand poses that the arm was asked to reach.
        duplicates: Number of duplicates in the last batch.
    """

    table: HandTable
    surface: Surface
    fingers: int
    parameters: TouchParameters
    rng: np.random.Generator
    hand_check: HandCheck
    counts: dict[str, int] = field(default_factory=dict)
    arm_queries: int = 0
    duplicates: int = 0

    def __post_init__(self) -> None:
        self._entry = touch_library()["casadi_ik_touch"]
        self._pairs = np.zeros((0, 4), dtype=np.int64)
        self._job, self._buffers = self._new_job(int(self.rng.integers(2**62)))
        self.draw_pairs()

    def draw_pairs(self) -> None:
        """Draw more pairs of opposing patches and keep those that two fingertips may fit."""
        surface, parameters = self.surface, self.parameters
        eligible = np.flatnonzero(surface.inside)
        if len(eligible) < 2:
            return
        i, j = eligible[self.rng.integers(len(eligible), size=(2, parameters.pairs_per_draw))]
        line = surface.points[j] - surface.points[i]
        length = np.linalg.norm(line, axis=1)
        first = -np.einsum("ki,ki->k", line, surface.normals[i])
        second = np.einsum("ki,ki->k", line, surface.normals[j])
        oppose = np.minimum(first, second) > np.cos(parameters.max_facing_angle) * length
        rows = np.flatnonzero(oppose & (length > 5e-3))
        i, j, line = i[rows], j[rows], line[rows]
        angles = np.arccos(np.clip(np.stack([first, second])[:, rows] / length[rows], -1, 1))
        # The centre of a ball is a radius above the patch, and its pad normal may lean.
        table = self.table
        is_finger = np.arange(len(table.radii)) != table.thumb
        radii, roll = (
            np.array([values[table.thumb], values[is_finger].mean()])
            for values in (table.radii, table.roll)
        )
        line = line + radii[1] * surface.normals[j] - radii[0] * surface.normals[i]
        angles = np.abs(angles + roll[:, None] * self.rng.uniform(-1, 1, angles.shape))
        first_pair, count = table.cells(table.key(np.linalg.norm(line, axis=1), *np.cos(angles)))
        pairs = np.stack([i, j, first_pair, count], axis=1)[count > 0]
        self._pairs = np.ascontiguousarray(np.concatenate([self._pairs, pairs]))

    @property
    def has_pairs(self) -> bool:
        """True if two opposing patches have the distance and angles of two fingertips."""
        return len(self._pairs) > 0

    def count(self, stage: str, number: int) -> None:
        """Add to the number of candidates that passed a stage."""
        self.counts[stage] = self.counts.get(stage, 0) + int(number)

    def candidates(self, count: int) -> Candidates:
        """Generate hands whose fingertips touch, free of collision apart from the arm.

        Args:
            count: Number of hands before refinement.
        """
        table, surface, parameters = self.table, self.surface, self.parameters
        hands = self.draw(count)
        if len(hands):
            hands = refined(table, surface, hands, parameters)
            tips = pads_of(table, hands).points
            contacts = touching(table, surface, hands)
            # Edges of the surface are known at samples.
            feet = np.where(hands.used[..., None], contacts.foot, tips)
            on_face = surface.inside[surface.foot(feet)[1]]
            ok = contacts.accepted(parameters, table.roll) & on_face
            rows = np.flatnonzero((ok | ~hands.used).all(axis=1))
            hands = replace(hands, tips=tips, contacts=contacts).rows(rows)
        self.count("made exact", len(hands))
        hands = hands.rows(np.flatnonzero(self.hand_check(hands)))
        self.count("still clear", len(hands))
        return hands

    def failure_reason(self) -> str:
        """Return the stage that no candidate passed, and the likely cause."""
        if not self.has_pairs:
            return (
                "no two patches of the object are as far apart, and face each other as well, as "
                "the thumb and another fingertip can"
            )
        stage = next((name for name, number in self.counts.items() if not number), "")
        why = next((f" ({why})" for key, why in WHY_NONE.items() if key in stage), "")
        return f"of {self.counts['attempts']:,} attempts none came to: {stage}{why}"

    def draw(self, count: int) -> Candidates:
        """Draw up to `count` hands: two fingertips fit, the others find something to touch."""
        job, table = self._job, self.table
        f = len(table.radii)
        palms, shared = np.empty((count, 12)), np.empty(count, dtype=np.int64)
        postures, used = np.empty((2, count, f), dtype=np.int64)
        job.palms, job.shared = palms.ctypes.data, shared.ctypes.data
        job.postured, job.used = postures.ctypes.data, used.ctypes.data
        job.patches, job.n_patches = self._pairs.ctypes.data, len(self._pairs)
        job.wanted, job.found = count, 0
        job.most = job.attempts + self.parameters.max_attempts_per_batch
        run_cancellable("touch", self._entry, job)
        n = job.found
        hand = table.q[shared[:n], postures[:n, table.thumb]].copy()
        for finger in range(f):
            table.put(hand, np.arange(n), table.q[shared[:n], postures[:n, finger]], finger)
        self.counts |= {
            "attempts": job.attempts,
            "two fingertips fit": job.fit,
            "they are clear": job.free,
        }
        self.count(f"{self.fingers} fingertips touch, all clear", n)
        palm = rigid(palms[:n, :9].reshape(-1, 3, 3), palms[:n, 9:])
        return Candidates(palm, hand, used[:n].astype(bool))

    def _new_job(self, seed: int) -> tuple[Any, tuple[Any, ...]]:
        """Return the job of the driver, and the objects that own its memory."""
        table, surface, parameters = self.table, self.surface, self.parameters
        check, shapes = self.hand_check, self.hand_check.shapes
        low, high = surface.points.min(axis=0), surface.points.max(axis=0)
        object_grid, scene_grid = check.grids(low, high, parameters)
        arrays: dict[str, Any] = {
            "points": table.points,
            "normals": table.normals,
            "off_object": check.standoffs(of_object=True),
            "off_scene": check.standoffs(of_object=False),
            "radii": table.radii,
            "cos_lean": np.cos(parameters.max_initial_lean + table.roll),
            "pairs": table.pairs.astype(np.int64),
            "depths": table.depths / parameters.max_pinch_depth,
            "samples": surface.points,
            "outward": surface.normals,
            "inside": surface.inside.astype(np.int64),
            "near_height": surface.grid.value,
            "near_sample": surface.grid.sample,
            "object_value": object_grid.value,
            "scene_value": scene_grid.value,
        }
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        job = TouchJob(
            **shapes.job,
            **{name: array.ctypes.data for name, array in arrays.items()},
            thumb=table.thumb,
            near=parameters.max_initial_height,
            clear=parameters.idle_clearance,
            least_often=parameters.min_trial_probability,
            fingers=self.fingers,
            tries=parameters.max_posture_trials,
            seed=seed,
        )
        grids = {"near": surface.grid, "object": object_grid, "scene": scene_grid}
        for name, grid in grids.items():
            getattr(job, f"{name}_low")[:] = grid.low.tolist()
            getattr(job, f"{name}_count")[:] = grid.counts.tolist()
        job.up[:] = check.pose[2, :3].tolist()
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
class TipContacts:
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

    def rows(self, rows: NDArray) -> TipContacts:
        """Return the contacts of some of the hands."""
        return TipContacts(*(getattr(self, part.name)[rows] for part in fields(self)))

    def accepted(self, parameters: TouchParameters, roll: Array) -> Bools:
        """Return which pads (k, f) touch the surface as grasps promise.

        Args:
            parameters: The limits of distance and lean.
            roll: (f,) additional lean that pads may have [rad].
        """
        aside = np.arccos(np.clip((self.toward * self.inward).sum(axis=-1), -1, 1))
        touches: Bools = np.abs(self.height) < parameters.max_height
        touches &= self.lean < parameters.max_lean + roll
        return touches & (np.maximum(self.spread, aside) < parameters.max_spread)


def touching(table: HandTable, surface: Surface, hands: Candidates) -> TipContacts:
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
    return TipContacts(*(spread_out(part) for part in parts))


def refined(
    table: HandTable, surface: Surface, hands: Candidates, parameters: TouchParameters
) -> Candidates:
    """Move palms and hands until every fingertip touches: damped least squares within limits."""
    _, start = surface.foot(pads_of(table, hands).points)
    palms, q = pose_row(hands.palm), table.configuration(hands.hand)
    robot, motors = table.robot, table.motors
    arrays: dict[str, Any] = {
        "palms": palms,
        "q": q,
        "used": hands.used.astype(np.int64),
        "motors": motors.astype(np.int64),
        "lower": robot.lower[motors],
        "upper": robot.upper[motors],
        "radii": table.radii,
        "free_lean": parameters.free_lean + table.roll,
        "samples": surface.points,
        "normals": surface.normals,
        "faces": surface.faces,
        "neighbours": surface.neighbours,
        "start": start.astype(np.int64),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    job = SnapJob(
        **{name: array.ctypes.data for name, array in arrays.items()},
        slide=parameters.sliding_weight,
        turn=parameters.lean_length,
        steps=parameters.refinement_steps,
        count=len(q),
        slice=SLICE,
    )
    run_cancellable("snap", table.kernel.library["casadi_ik_snap"], job)
    palm = rigid(arrays["palms"][:, :9].reshape(-1, 3, 3), arrays["palms"][:, 9:])
    return Candidates(palm, arrays["q"][:, motors], hands.used)


class HandCheck:
    """Collision check of hands with the object, the scene and themselves, without the arm.

    The arm stays at home and the world is moved instead, so that the collision kernel of the solver
    can be used before the arm is solved.
    """

    def __init__(
        self, table: HandTable, check: SceneCheck, pose: Array, tables: dict[bytes, Any]
    ) -> None:
        """Use the scene of a solver.

        Args:
            table: Table of the hand.
            check: Check of the scene in which the object is grasped.
            pose: (4, 4) pose of the object in the base frame.
            tables: Cache of the same hand and object, shared between poses of the object.
        """
        self.table, self.check, self.pose, self._tables = table, check, pose, tables
        self._all_pairs = check.table(check.scene, frozenset()).hand_pairs
        rows = self._all_pairs.poses(check.scene.items)
        self._items = rigid(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
        self.shapes = table.shape(check)

    def grids(self, low: Array, high: Array, parameters: TouchParameters) -> tuple[Grid, Grid]:
        """Return the distance grids of the object and of the scene, in the object's frame.

        Args:
            low: (3,) lower corner of the object [m].
            high: (3,) upper corner of the object [m].
            parameters: Sizes of the cells.
        """
        scene, size = self.check.scene, float((high - low).max())
        if OBJECT_GRID not in self._tables:
            parts = scene.items[str(scene.grasped)].parts
            step = max(parameters.object_cell, size / parameters.max_cells)
            margin = max(float(self.standoffs(of_object=True).max(initial=0.0)), 0.0) + 2 * step
            self._tables[OBJECT_GRID] = Grid.of(parts, low - margin, high + margin, step)
        reach = sum(
            float(np.abs(segments[..., :3]).max(initial=0.0))
            for segments in (self.shapes.capsules, self.shapes.fixed)
        )
        obstacles = [
            (solid, inverse(self.pose) @ item.pose @ pose)
            for item in scene.items.values()
            if item.name != scene.grasped
            for solid, pose in item.parts
        ]
        step = max(parameters.scene_cell, (size + 2 * reach) / parameters.max_cells)
        return self._tables[OBJECT_GRID], Grid.of(obstacles, low - reach, high + reach, step)

    def standoffs(self, of_object: bool) -> Array:
        """Return the least distances (c,) of the axes of the hand's capsules from solids [m].

        Args:
            of_object: From the object; else from the rest of the scene.
        """
        pairs, shapes = self._all_pairs, self.shapes
        first = len(pairs.radii) + pairs.own
        is_grasped = np.array(
            [name == self.check.scene.grasped for name in pairs.items], dtype=bool
        )
        counts = pairs.pairs[:, 1] >= first
        counts[counts] = is_grasped[pairs.pairs[counts, 1] - first] == of_object
        least = np.full(len(pairs.radii), -np.inf)
        np.maximum.at(least, pairs.pairs[counts, 0], pairs.offsets[counts])
        return (least + pairs.radii + self.check.scene.margin)[shapes.numbers]

    def __call__(self, hands: Candidates) -> Bools:
        """Return (k,) True for hands that are free of collision."""
        q = self.table.configuration(hands.hand)
        world = self.table.palm @ inverse(self.pose @ hands.palm)
        is_free = np.zeros(len(hands), dtype=bool)
        code = hands.used @ (1 << np.arange(hands.used.shape[1]))
        for value in set(code.tolist()):
            rows = np.flatnonzero(code == value)
            table = self._pairs_for(hands.used[rows[0]])
            poses = pose_row(world[rows, None] @ self._items)
            query = CollisionQuery(self.check.kernel, table, poses, self.check.scene.margin)
            is_free[rows] = query.free(q[rows])
        return is_free

    def arm_is_free(self, q: Array) -> Bools:
        """Return (k,) True for configurations (k, n) whose arm is free of collision."""
        check = self.check
        table = check.table(check.scene, frozenset()).arm_pairs
        query = CollisionQuery(
            check.kernel, table, table.poses(check.scene.items), check.scene.margin
        )
        return query.free(q)

    def _pairs_for(self, used: Bools) -> PairTable:
        """Return the pairs to check: fingertips that are used may touch the object."""
        key = used.tobytes()
        if key not in self._tables:
            names = zip(self.table.robot.fingers, used, strict=True)
            pads = [self.check.finger_bodies[name] for name, is_used in names if is_used]
            touching_links, grasped = frozenset[str]().union(*pads), self.check.scene.grasped
            checked = [
                not (pair[1] == grasped and pair[0] in touching_links)
                for pair in self._all_pairs.names
            ]
            self._tables[key] = self._all_pairs.select(np.array(checked, dtype=bool))
        return self._tables[key]


OBJECT_GRID = b"object"
"""Key of the object's grid in the cache of a `HandCheck`."""
