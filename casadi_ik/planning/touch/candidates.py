"""Candidate grasps of a surface: hands whose fingertips touch it, before the arm is solved.

Geometric hashing of oriented point pairs (Drost et al. 2010) matches two opposing fingertips with
two patches of the object, which determines the palm pose. The postures of further fingers are
looked up in the table of the hand. Palm and hand are then refined until every fingertip touches.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import PairTable, pose_row
from casadi_ik.compile.cancellation import SLICE, run_cancellable
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.pose import inverse
from casadi_ik.planning.touch.hand_table import (
    BINS,
    HandTable,
    SnapJob,
    TouchJob,
    rigid_transforms,
)
from casadi_ik.planning.touch.hands import (
    HandCandidates,
    TipContacts,
    TouchParameters,
    touch_library,
)
from casadi_ik.planning.touch.surface import Grid, Surface


class HandCheck:
    """Collision check of hands with the object, the scene and themselves, without the arm.

    The arm stays at home and the obstacles are moved relative to the palm, so that the collision
    kernel of the solver is usable before the arm is solved.
    """

    def __init__(
        self, table: HandTable, check: SceneCheck, pose: Array, tables: dict[bytes, Any]
    ) -> None:
        """Initialise the check from the scene of a solver.

        Args:
            table: Table of the hand.
            check: Check of the scene in which the object is grasped.
            pose: (4, 4) pose of the object in the base frame.
            tables: Cache of grids and pair tables, shared between poses of the same object.
        """
        self.table, self.check, self.pose, self._tables = table, check, pose, tables
        self._all_pairs = check.table(check.scene, frozenset()).hand_pairs
        rows = self._all_pairs.poses(check.scene.items)
        self._items = rigid_transforms(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
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
            solids = scene.items[str(scene.grasped)].parts
            step = max(parameters.object_cell, size / parameters.max_cells)
            margin = max(float(self.standoffs(of_object=True).max(initial=0.0)), 0.0) + 2 * step
            self._tables[OBJECT_GRID] = Grid.from_solids(solids, low - margin, high + margin, step)
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
        return self._tables[OBJECT_GRID], Grid.from_solids(
            obstacles, low - reach, high + reach, step
        )

    def standoffs(self, of_object: bool) -> Array:
        """Return the minimum distances (c,) between capsule axes of the hand and solids [m].

        Args:
            of_object: True for distances from the object, False for distances from the scene.
        """
        pairs, shapes = self._all_pairs, self.shapes
        first = len(pairs.radii) + pairs.n_robot_solids
        is_grasped = np.array(
            [name == self.check.scene.grasped for name in pairs.items], dtype=bool
        )
        is_selected = pairs.pairs[:, 1] >= first
        solids = pairs.pairs[is_selected, 1] - first
        is_selected[is_selected] = is_grasped[solids] == of_object
        min_distance = np.full(len(pairs.radii), -np.inf)
        np.maximum.at(min_distance, pairs.pairs[is_selected, 0], pairs.offsets[is_selected])
        return (min_distance + pairs.radii + self.check.scene.margin)[shapes.numbers]

    def __call__(self, hands: HandCandidates) -> Bools:
        """Return (k,) True for hands that are free of collision."""
        q = self.table.configuration(hands.hand)
        world = self.table.palm @ inverse(self.pose @ hands.palm)
        is_free = np.zeros(len(hands), dtype=bool)
        code = hands.touches @ (1 << np.arange(hands.touches.shape[1]))
        for value in set(code.tolist()):
            rows = np.flatnonzero(code == value)
            table = self._pairs_for(hands.touches[rows[0]])
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

    def _pairs_for(self, touches: Bools) -> PairTable:
        """Return the pairs to check: the fingertips in `touches` (f,) may touch the object."""
        key = touches.tobytes()
        if key not in self._tables:
            names = zip(self.table.robot.fingers, touches, strict=True)
            pads = [self.check.finger_bodies[name] for name, may_touch in names if may_touch]
            touching_links, grasped = frozenset[str]().union(*pads), self.check.scene.grasped
            checked = [
                not (pair[1] == grasped and pair[0] in touching_links)
                for pair in self._all_pairs.names
            ]
            self._tables[key] = self._all_pairs.select(np.array(checked, dtype=bool))
        return self._tables[key]


OBJECT_GRID = b"object"
"""Key of the object's grid in the cache of a `HandCheck`."""


LIKELY_CAUSES = {
    "two fingertips matched": "no two pads are aligned with two patches of the object",
    "matched fingers collision-free": "palm or fingers penetrate the object",
    "fingertips touch": "further fingers do not reach the surface or collide; try fewer fingers",
    "refined onto the surface": "refined fingertips are off the surface or on an edge",
    "refined hand collision-free": "palm or fingers penetrate the object",
    "force-closed": "contacts do not oppose each other within the friction cones",
    "hold ": "the object is too heavy for this squeeze, friction and the motors' torques",
    "arm reaches": "the object is out of the arm's reach, or within reach only for open grasps",
    "contacts confirmed": "contacts exceed distance or lean, or lose closure, after the arm solve",
    "collision-free in the scene": "arm or hand collides with the scene or the object",
}
"""Likely cause if no candidate passes a stage, by a substring of the stage's name."""


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
        arm_queries: Number of hand poses for which the arm was solved.
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
        """Sample pairs of opposing patches and keep those that match a pair of fingertips."""
        surface, parameters = self.surface, self.parameters
        eligible = np.flatnonzero(surface.fits_pad)
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
        """Add `number` to the count of candidates that passed a stage."""
        self.counts[stage] = self.counts.get(stage, 0) + int(number)

    def candidates(self, count: int) -> HandCandidates:
        """Generate collision-free hands whose fingertips touch; the arm is not checked.

        Args:
            count: Number of hands before refinement.
        """
        table, surface, parameters = self.table, self.surface, self.parameters
        hands = self.draw(count)
        if len(hands):
            hands = refine_hands(table, surface, hands, parameters)
            tips = fingertip_pads(table, hands).points
            contacts = tip_contacts(table, surface, hands)
            # Edges are marked at the samples.
            feet = np.where(hands.touches[..., None], contacts.foot, tips)
            on_face = surface.fits_pad[surface.foot(feet)[1]]
            ok = contacts.accepted(parameters, table.roll) & on_face
            rows = np.flatnonzero((ok | ~hands.touches).all(axis=1))
            hands = replace(hands, tips=tips, contacts=contacts).rows(rows)
        self.count("refined onto the surface", len(hands))
        hands = hands.rows(np.flatnonzero(self.hand_check(hands)))
        self.count("refined hand collision-free", len(hands))
        return hands

    def failure_reason(self) -> str:
        """Return the stage that no candidate passed, and the likely cause."""
        if not self.has_pairs:
            return (
                "no two patches of the object have a distance and angles that the thumb and "
                "another fingertip can match"
            )
        stage = next((name for name, number in self.counts.items() if not number), "")
        cause = next((text for key, text in LIKELY_CAUSES.items() if key in stage), "")
        reason = f"{self.counts['attempts']:,} attempts, no candidate passed: {stage}"
        return f"{reason} ({cause})" if cause else reason

    def draw(self, count: int) -> HandCandidates:
        """Sample up to `count` hands: two matched fingertips, further fingers from the table."""
        job, table = self._job, self.table
        f = len(table.radii)
        palms, shared = np.empty((count, 12)), np.empty(count, dtype=np.int64)
        postures, touches = np.empty((2, count, f), dtype=np.int64)
        job.palms, job.hand_shares = palms.ctypes.data, shared.ctypes.data
        job.hand_postures, job.touches = postures.ctypes.data, touches.ctypes.data
        job.patches, job.n_patches = self._pairs.ctypes.data, len(self._pairs)
        job.n_requested, job.n_hands = count, 0
        job.max_attempts = job.attempts + self.parameters.max_attempts_per_batch
        run_cancellable("touch", self._entry, job)
        n = job.n_hands
        hand = table.q[shared[:n], postures[:n, table.thumb]].copy()
        for finger in range(f):
            posture = table.q[shared[:n], postures[:n, finger]]
            table.copy_finger(hand, np.arange(n), posture, finger)
        self.counts |= {
            "attempts": job.attempts,
            "two fingertips matched": job.n_matched,
            "matched fingers collision-free": job.n_free,
        }
        self.count(f"{self.fingers} fingertips touch, hand collision-free", n)
        palm = rigid_transforms(palms[:n, :9].reshape(-1, 3, 3), palms[:n, 9:])
        return HandCandidates(palm, hand, touches[:n].astype(bool))

    def _new_job(self, seed: int) -> tuple[Any, tuple[Any, ...]]:
        """Return the job of the compiled driver, and the objects that own its memory."""
        table, surface, parameters = self.table, self.surface, self.parameters
        check, shapes = self.hand_check, self.hand_check.shapes
        low, high = surface.points.min(axis=0), surface.points.max(axis=0)
        object_grid, scene_grid = check.grids(low, high, parameters)
        arrays: dict[str, Any] = {
            "points": table.points,
            "normals": table.normals,
            "object_standoffs": check.standoffs(of_object=True),
            "scene_standoffs": check.standoffs(of_object=False),
            "radii": table.radii,
            "cos_lean": np.cos(parameters.max_initial_lean + table.roll),
            "pairs": table.pairs.astype(np.int64),
            "depths": table.depths / parameters.max_pinch_depth,
            "samples": surface.points,
            "outward": surface.normals,
            "fits_pad": surface.fits_pad.astype(np.int64),
            "surface_height": surface.grid.value,
            "surface_sample": surface.grid.sample,
            "object_value": object_grid.value,
            "scene_value": scene_grid.value,
        }
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        job = TouchJob(
            **shapes.job,
            **{name: array.ctypes.data for name, array in arrays.items()},
            thumb=table.thumb,
            max_height=parameters.max_initial_height,
            idle_clearance=parameters.idle_clearance,
            min_trial_probability=parameters.min_trial_probability,
            n_touching=self.fingers,
            max_posture_trials=parameters.max_posture_trials,
            seed=seed,
        )
        grids = {"surface": surface.grid, "object": object_grid, "scene": scene_grid}
        for name, grid in grids.items():
            getattr(job, f"{name}_low")[:] = grid.low.tolist()
            getattr(job, f"{name}_count")[:] = grid.counts.tolist()
        job.up[:] = check.pose[2, :3].tolist()
        for name in ("depth", "direction"):
            getattr(job, f"{name}_free")[:] = [1.0] * BINS
            getattr(job, f"{name}_trials")[:] = [2.0] * BINS
        return job, (arrays, shapes)


@dataclass(frozen=True)
class Pads:
    """Fingertip pads in the object's frame.

    Attributes:
        points: (k, f, 3) centres of ball pads, contact points of plane pads [m].
        normals: (k, f, 3) outward pad normals.
    """

    points: Array
    normals: Array


def fingertip_pads(table: HandTable, hands: HandCandidates) -> Pads:
    """Return the fingertip pads of hands in the object's frame."""
    points, normals, _, _ = table.pads(hands.hand)
    rotation, origin = hands.palm[:, None, :3, :3], hands.palm[:, None, :3, 3]
    rotation = np.broadcast_to(rotation, (*points.shape, 3))
    points = np.einsum("kfij,kfj->kfi", rotation, points) + origin
    return Pads(points, np.einsum("kfij,kfj->kfi", rotation, normals))


def tip_contacts(table: HandTable, surface: Surface, hands: HandCandidates) -> TipContacts:
    """Return the exact contacts of fingertips with the triangles of a surface.

    All values of fingers without contact are NaN.
    """
    pads = fingertip_pads(table, hands)
    row, finger = np.nonzero(hands.touches)
    points, normals, radii = (
        pads.points[row, finger],
        pads.normals[row, finger],
        table.radii[finger],
    )
    nearest = surface.nearest(points)
    offset = points - nearest.point
    side = (offset * nearest.normal).sum(axis=1)
    distance = np.copysign(np.linalg.norm(offset, axis=1), side)
    # The direction is ill-defined for a centre on the surface.
    is_defined = (radii > 0) & (np.abs(distance) > 1e-6)
    divisor = np.where(is_defined, distance, 1.0)[:, None]
    direction = np.where(is_defined[:, None], -offset / divisor, -nearest.normal)
    lean = (
        np.arccos(np.clip(-(normals * nearest.normal).sum(axis=1), -1, 1)) + nearest.normal_spread
    )
    inward, height = -nearest.normal, distance - radii

    def by_hand_and_finger(values: Array) -> Array:
        columns = np.full((*hands.touches.shape, *values.shape[1:]), np.nan)
        columns[row, finger] = values
        return columns

    columns = nearest.point, inward, nearest.normal_spread, direction, height, lean
    return TipContacts(*(by_hand_and_finger(values) for values in columns))


def refine_hands(
    table: HandTable, surface: Surface, hands: HandCandidates, parameters: TouchParameters
) -> HandCandidates:
    """Move palms and hands until every fingertip touches.

    The method is damped least squares within the limits of the motors.
    """
    _, start = surface.foot(fingertip_pads(table, hands).points)
    palms, q = pose_row(hands.palm), table.configuration(hands.hand)
    robot, motors = table.robot, table.motors
    arrays: dict[str, Any] = {
        "palms": palms,
        "q": q,
        "touches": hands.touches.astype(np.int64),
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
        sliding_weight=parameters.sliding_weight,
        lean_length=parameters.lean_length,
        steps=parameters.refinement_steps,
        count=len(q),
        slice=SLICE,
    )
    run_cancellable("snap", table.kernel.library["casadi_ik_snap"], job)
    palm = rigid_transforms(arrays["palms"][:, :9].reshape(-1, 3, 3), arrays["palms"][:, 9:])
    return HandCandidates(palm, arrays["q"][:, motors], hands.touches)
