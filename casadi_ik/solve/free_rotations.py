"""Search over the rotation of the palm that contacts on one axis leave unconstrained.

Two opposed fingertips of a gripper, or the tip of a tool, allow every rotation of the palm about
the line through their contacts. A fit returns one of these rotations; the search samples all of
them with all arms, and refines the best ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.kinematics.palm import base_rotation
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import CLEARANCE, TargetBatch
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.proofs.premises import SLIDING_ARRAYS, required_points
from casadi_ik.solve.row_selection import Deduplicator, first_per_owner
from casadi_ik.solve.subproblems import (
    LocalRefinement,
    SubproblemSolver,
    palm_coordinates,
    residual_norms,
    residual_tolerances,
)


@dataclass(frozen=True)
class RotationSearchParameters:
    """Effort of the search over free rotations.

    Attributes:
        samples: Number of rotations over the full circle.
        local_samples: Number of rotations around each of the best ones in a refinement.
        refinements: Number of refinements; each divides the spacing by half of `local_samples` + 1.
        max_refined: Maximum number of solutions per target that are refined.
        max_compared: Maximum number of solutions per target that are kept in a refinement.
        min_difference: Hands and arms are distinct if a motor differs by more than this [fraction
            of its range].
    """

    samples: int = 24
    local_samples: int = 7
    refinements: int = 4
    max_refined: int = 6
    max_compared: int = 32
    min_difference: float = 0.05


ROTATION_SEARCH = RotationSearchParameters()


@dataclass(frozen=True, eq=False)
class FreeRotations:
    """Axes about which a palm may rotate while its fingers keep their contacts, for k targets.

    Attributes:
        centre: (k, 3) point on the axis [m], base frame.
        axis: (k, 3) unit vector, base frame.
        fingers: Indices of the fingers of the hand.
        is_free: (k,) True if the contacts allow all rotations about the axis.
        base: (3, 3) rotation of the robot's base, relative to which a reference is chosen.
    """

    centre: Array
    axis: Array
    fingers: Sequence[int]
    is_free: Bools
    base: Array

    @classmethod
    def of_targets(
        cls, robot: RobotDescription, targets: TargetBatch, fingers: Sequence[int]
    ) -> FreeRotations:
        """Return the axes of the targets of one hand.

        A rotation moves a contact by at most twice its distance from the axis. Contacts within
        their tolerance of the axis thus can stay within tolerance at every rotation.

        Args:
            robot: Description of the robot.
            targets: k targets.
            fingers: Indices of the fingers of the hand.
        """
        fingers = list(fingers)
        points, normals = (
            required_points(robot, targets)[0][:, fingers],
            targets.normals[:, fingers],
        )
        has_point, has_normal = ~np.isnan(points[..., 0]), ~np.isnan(normals[..., 0])
        count = np.maximum(has_point.sum(axis=1), 1)
        centre = np.nansum(points, axis=1) / count[:, None]
        offsets = np.nan_to_num(points - centre[:, None])
        normals = np.nan_to_num(normals)
        vectors = np.concatenate([offsets / LENGTH, normals], axis=1)
        axis = np.linalg.eigh(np.swapaxes(vectors, 1, 2) @ vectors)[1][:, :, 2]
        distances = np.linalg.norm(np.cross(offsets, axis[:, None]), axis=2)
        sines = np.linalg.norm(np.cross(normals, axis[:, None]), axis=2)
        angle_tolerance = np.minimum(targets.angle_tolerance[fingers], np.pi / 2)
        tolerance = targets.position_tolerance[fingers]
        has_line = (np.linalg.norm(offsets, axis=2) > tolerance).any(axis=1)
        is_free = has_point.any(axis=1) & (has_line | has_normal.any(axis=1))
        is_free &= (distances <= tolerance).all(axis=1)
        is_free &= (~has_normal | (sines <= np.sin(angle_tolerance))).all(axis=1)
        for name in (SLIDING_ARRAYS | {"tangents"}) & targets.extra_vectors.keys():
            is_free &= np.isnan(targets.extra_vectors[name][:, fingers, 0]).all(axis=1)
        is_free &= targets.palms is None
        return cls(centre, axis, fingers, is_free, base_rotation(robot))

    def rotate(self, palms: Array, owner: NDArray[np.intp], angles: Array) -> Array:
        """Return palm poses (m, 4, 4) rotated by angles (m,) [rad] about the axes of targets (m,).

        Palms of targets without a free rotation are not moved.
        """
        axis, centre = self.axis[owner], self.centre[owner]
        sine, cosine = (
            np.where(self.is_free[owner], values, fixed)[:, None, None]
            for values, fixed in ((np.sin(angles), 0.0), (np.cos(angles), 1.0))
        )
        cross = np.cross(axis[:, None], -np.eye(3))
        rotation = cosine * np.eye(3) + sine * cross
        rotation += (1 - cosine) * axis[:, :, None] * axis[:, None, :]
        rotated = palms.copy()
        rotated[:, :3, :3] = rotation @ palms[:, :3, :3]
        rotated[:, :3, 3] = centre + np.einsum("kij,kj->ki", rotation, palms[:, :3, 3] - centre)
        return rotated

    def in_palm(self, palms: Array, owner: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return axes (m, 3) and centres (m, 3) [m] in the frames of palms (m, 4, 4)."""
        rotation = palms[:, :3, :3]
        offset = self.centre[owner] - palms[:, :3, 3]
        return (
            np.einsum("kij,ki->kj", rotation, self.axis[owner]),
            np.einsum("kij,ki->kj", rotation, offset),
        )

    def to_reference(self, palms: Array, owner: NDArray[np.intp]) -> Array:
        """Return palms (m, 4, 4) rotated to angles that do not depend on the given rotation."""
        axis = self.axis[owner]
        axis_in_palm, _ = self.in_palm(palms, owner)
        side = np.einsum("kij,kj->ki", palms[:, :3, :3], _perpendicular(axis_in_palm))
        reference = _perpendicular(axis @ self.base) @ self.base.T
        sine = (axis * np.cross(side, reference)).sum(axis=1)
        return self.rotate(palms, owner, np.arctan2(sine, (side * reference).sum(axis=1)))


def _perpendicular(vectors: Array) -> Array:
    """Return unit vectors (m, 3) perpendicular to unit vectors, nearest to a coordinate axis.

    Components are rounded, so that rounding errors do not choose between equal components.
    """
    helper = np.eye(3)[np.abs(vectors).round(6).argmin(axis=1)]
    perpendicular = helper - (helper * vectors).sum(axis=1, keepdims=True) * vectors
    return perpendicular / np.linalg.norm(perpendicular, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class RotationSearch:
    """Search for the preferred rotations and arms of one hand, for k targets.

    Attributes:
        subproblems: Solver of subproblems.
        arms: Arm search of the hand.
        side: Name of the side of a multi-arm robot; None for a robot with one arm.
        hand: Positions in q of the hand motors.
        rotations: Free rotations of the targets.
        targets: The targets.
        starts: (k, n) initial configurations [rad or m].
        prefer: Preference among arms.
        query: Pairs that must not collide; None: no check.
    """

    subproblems: SubproblemSolver
    arms: ArmSearch
    side: str | None
    hand: Sequence[int]
    rotations: FreeRotations
    targets: TargetBatch
    starts: Array
    prefer: Preference
    query: CollisionQuery | None

    def run(
        self, q: Array, owner: NDArray[np.intp], max_refined: int
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return collision-free solutions with the preferred rotations and arms.

        Args:
            q: (m, n) solutions, whose hands are rotated; best first. Of hands that differ only by
                a rotation, the one that meets the contacts best represents the others.
            owner: (m,) indices of their targets.
            max_refined: Maximum number of solutions of all targets that are refined.

        Returns:
            (p, n) configurations, and (p,) indices of their targets.
        """
        parameters = ROTATION_SEARCH
        palms = self._palms(q)
        order = np.argsort(self._misses(q, owner), kind="stable")
        rows = order[self._distinct_hands(q[order], palms[order], owner[order])]
        q, owner = self._with_exact_contacts(q[rows], owner[rows]), owner[rows]
        palms = self.rotations.to_reference(self._palms(q), owner)
        results, score = (q[:0], owner[:0]), np.zeros(0)
        spacing = 2 * np.pi / parameters.samples
        local_steps = np.linspace(-1.0, 1.0, parameters.local_samples + 2)[1:-1].astype(float)
        angles: Array = spacing * np.arange(parameters.samples, dtype=float)
        for number in range(parameters.refinements + 1):
            if not len(q):
                break
            rotated = self._rotated_arms(q, palms, owner, angles, number > 0)
            score = np.concatenate([score, self._scores(*rotated)])
            q, owner = (
                np.concatenate([results[0], rotated[0]]),
                np.concatenate([results[1], rotated[1]]),
            )
            rows = self._best_distinct(q, owner, score)
            results, score = (q[rows], owner[rows]), score[rows]
            rows = first_per_owner(owner[rows], np.arange(len(rows)), parameters.max_refined)
            rows = rows[np.argsort(-score[rows], kind="stable")][:max_refined]
            q, owner = results[0][rows], results[1][rows]
            palms = self._palms(q)
            angles = spacing * local_steps
            spacing *= 2 / (parameters.local_samples + 1)
        return results

    def _misses(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Return the largest error of the hand's contacts, rounded to percent of tolerances."""
        targets, fingers = self.targets.rows(owner), list(self.rotations.fingers)
        tolerances = residual_tolerances(targets)
        misses = residual_norms(self.subproblems.robot, targets, q) / np.maximum(tolerances, 1e-12)
        return misses[:, fingers].max(axis=(1, 2), initial=0.0).round(2)

    def _with_exact_contacts(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Return solutions that are moved to the minimum of the contact errors, where it solves.

        A fit ends anywhere within tolerance, which would depend on its start.
        """
        rows = np.flatnonzero(self._misses(q, owner) > 0)
        if not len(rows):
            return q
        weights = np.ones((len(rows), self.targets.points.shape[1], 2))
        refinement = LocalRefinement(self.subproblems, self.targets)
        refined = refinement.run(owner[rows], q[rows], weights=weights)
        is_solution = self.subproblems.solved(
            self.targets.rows(owner[rows]), refined, self.targets.enforce_limits
        )
        q = q.copy()
        q[rows[is_solution]] = refined[is_solution]
        return q

    def _palms(self, q: Array) -> Array:
        return self.subproblems.robot.palm(q, self.side)

    def _distinct_hands(self, q: Array, palms: Array, owner: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the rows with hands that differ by more than a free rotation."""
        axis, centre = self.rotations.in_palm(palms, owner)
        invariants = np.concatenate([axis, centre / LENGTH, np.zeros((len(q), 6))], axis=1)
        is_free = self.rotations.is_free[owner, None]
        fractions = q[:, self.hand] / self._ranges[self.hand]
        coordinates = np.concatenate(
            [fractions, np.where(is_free, invariants, palm_coordinates(palms))], axis=1
        )
        distinct = Deduplicator(
            len(self.targets), coordinates.shape[1], ROTATION_SEARCH.min_difference
        )
        return np.flatnonzero(distinct.add(coordinates, owner))

    def _rotated_arms(
        self, q: Array, palms: Array, owner: NDArray[np.intp], angles: Array, refine: bool
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return the preferred collision-free arms of every branch at all rotations of palms."""
        counts = np.where(self.rotations.is_free[owner], len(angles), 1)
        rows = np.repeat(np.arange(len(q)), counts)
        number = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        owners = owner[rows]
        limits = self.subproblems.limits(self.targets).first
        candidates = self.arms.choose(
            q[rows],
            self.starts[owners],
            (limits.lower, limits.upper),
            self.prefer,
            None if self.query is None else self.query.rows(owners),
            np.full(len(rows), np.inf),
            all_branches=True,
            refine=refine,
            palms=self.rotations.rotate(palms[rows], owners, angles[number]),
        )
        arms, owners = candidates.q, owners[candidates.hand_index]
        is_solution = self.subproblems.solved(
            self.targets.rows(owners), arms, self.targets.enforce_limits
        )
        if self.query is not None and self.prefer == CLEARANCE:
            is_solution &= self.query.rows(owners).free(arms)
        return arms[is_solution], owners[is_solution]

    def _scores(self, q: Array, owner: NDArray[np.intp]) -> Array:
        if self.prefer == CLEARANCE and self.query is not None:
            return self.query.rows(owner).check(q).surplus
        return self.arms.scores(q, self.starts[owner], self.prefer)

    def _best_distinct(self, q: Array, owner: NDArray[np.intp], score: Array) -> NDArray[np.intp]:
        """Return the rows with the best distinct configurations of each target."""
        order = np.lexsort((-score, owner))
        order = first_per_owner(owner, order, ROTATION_SEARCH.max_compared)
        fractions = q[order] / self._ranges
        distinct = Deduplicator(len(self.targets), q.shape[1], ROTATION_SEARCH.min_difference)
        return order[distinct.add(fractions, owner[order])]

    @property
    def _ranges(self) -> Array:
        robot = self.subproblems.robot
        return robot.upper - robot.lower
