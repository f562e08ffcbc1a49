"""Collision-free hands: independent hands of a multi-arm robot, and unconstrained fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.files.arrays import Array, Bools, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.row_selection import Deduplicator, improving_rows
from casadi_ik.solve.subproblems import SubproblemSolver, carry_palms, palm_coordinates, side_palms


class SideHands:
    """Hands of a multi-arm robot without self-collision, by side.

    The posture and palm pose of a side's hand do not depend on the other sides, so hands are
    collected by side and combined afterwards.

    Attributes:
        hand_motors: Positions in q of the hand motors, by side.
        least_penetrating: (s, k, n) solutions with the least-penetrating hand of each side and
            target.
        surplus: (s, k) clearances of these hands beyond the margin [m].
    """

    def __init__(
        self,
        subproblems: SubproblemSolver,
        links: Sequence[tuple[frozenset[str], frozenset[str]]],
        targets: TargetBatch,
        query: CollisionQuery,
        min_difference: float,
    ) -> None:
        """Split the collision pairs by the hand or arm that decides their distance.

        Args:
            subproblems: Solver of subproblems.
            links: By side, the links of its arm and those that move with its palm.
            targets: k targets.
            query: Pairs that must not collide.
            min_difference: Hands that differ by less are duplicates [fraction of motor ranges].
        """
        self._subproblems, self._targets, self._query = subproblems, targets, query
        self._robot = description = subproblems.robot.description
        self._arm_links = [arm for arm, _ in links]
        movable_links = description.links_moved(range(len(description.actuators)))
        # Pairs whose distance only this hand changes: self-collision, and fixed objects.
        self._hand_queries = [query.split_by_links(movable_links - hand)[1] for _, hand in links]
        self.hand_motors = [list(hand) for _, hand in description.side_actuators]
        count, n, sides = len(targets), len(description.actuators), len(links)
        self.least_penetrating = np.full((sides, count, n), np.nan)
        self.surplus = np.full((sides, count), -np.inf)
        empty = np.zeros((0, n)), np.zeros((0, sides, 4, 4)), np.zeros(0, np.intp)
        # By side: configurations, poses of all palms, target indices.
        self._free_hands = [empty for _ in links]
        self._known_hands = [
            Deduplicator(count, len(motors) + 12, min_difference) for motors in self.hand_motors
        ]

    def add_hands(
        self, q: Array, target_index: NDArray[np.intp], side: int, best_only: bool = False
    ) -> None:
        """Record the hands of a side that are free of self-collision.

        Args:
            q: (m, n) solutions.
            target_index: (m,) index of the target of each solution.
            side: Number of the side.
            best_only: Record at most one hand per target: the one with the largest clearance, if it
                exceeds that of all previous hands.
        """
        surplus = self._hand_queries[side].rows(target_index).check(q).surplus
        rows = improving_rows(target_index, surplus, self.surplus[side])
        self.least_penetrating[side, target_index[rows]] = q[rows]
        self.surplus[side, target_index[rows]] = surplus[rows]
        rows = rows if best_only else np.arange(len(q))
        rows = rows[surplus[rows] >= -DISTANCE_ROUNDING]
        q, target_index = q[rows], target_index[rows]
        palms, ranges = (
            side_palms(self._subproblems.robot, q),
            self._robot.upper - self._robot.lower,
        )
        coordinates = [(q / ranges)[:, self.hand_motors[side]], palm_coordinates(palms[:, side])]
        is_new = self._known_hands[side].add(np.concatenate(coordinates, axis=1), target_index)
        added = q[is_new], palms[is_new], target_index[is_new]
        known_q, known_palms, known_targets = self._free_hands[side]
        self._free_hands[side] = (
            np.concatenate([known_q, added[0]]),
            np.concatenate([known_palms, added[1]]),
            np.concatenate([known_targets, added[2]]),
        )

    def combine(
        self, rows: NDArray[np.intp], max_combinations: int
    ) -> tuple[Array, Array, NDArray[np.intp]]:
        """Combine the hands of all sides.

        Args:
            rows: Indices of the targets.
            max_combinations: Maximum number of combinations per target. Their number is that of the
                side with most hands; sides with fewer hands repeat their hands.

        Returns:
            (m, n) configurations, (m, s, 4, 4) palm poses, (m,) index of the target of each.
        """
        sorted_hands = []
        for q, palms, target_index in self._free_hands:
            order = np.argsort(target_index, kind="stable")
            first = np.searchsorted(target_index[order], rows)
            count = np.searchsorted(target_index[order], rows, side="right") - first
            sorted_hands.append((q[order], palms[order], first, count))
        counts = np.stack([count for *_, count in sorted_hands])
        max_counts = np.minimum(counts.max(axis=0), max_combinations)
        combinations = np.where(counts.min(axis=0) > 0, max_counts, 0)
        row = np.repeat(np.arange(len(rows)), combinations)
        first_of_row = np.repeat(np.cumsum(combinations) - combinations, combinations)
        number = np.arange(len(row)) - first_of_row
        combined_q, combined_palms = None, []
        for side, (q, palms, first, count) in enumerate(sorted_hands):
            hand = first[row] + number % np.maximum(count[row], 1)
            combined_q = q[hand] if combined_q is None else combined_q
            motors = self.hand_motors[side]
            combined_q[:, motors] = q[hand][:, motors]
            combined_palms.append(palms[hand, side])
        assert combined_q is not None
        return combined_q, np.stack(combined_palms, axis=1), rows[row]

    def search_arms(
        self,
        searches: Sequence[ArmSearch],
        q: Array,
        palms: Array,
        target_index: NDArray[np.intp],
        starts: Array,
        prefer: Preference,
    ) -> tuple[Array, NDArray[np.intp]]:
        """Search for collision-free arms at palm poses, successively for each side.

        Every side but the last returns the preferred collision-free arm of every branch.

        Args:
            searches: Arm search of each side.
            q: (m, n) configurations.
            palms: (m, s, 4, 4) palm poses.
            target_index: (m,) index of the target of each configuration.
            starts: (k, n) initial configurations of all targets.
            prefer: Preference among arms.

        Returns:
            (p, n) configurations and (p,) indices of their targets.
        """
        preference = prefer if prefer in ("limits", "q0") else "limits"
        limits, query = self._subproblems.limits(self._targets).first, self._query
        all_arms = frozenset[str]().union(*self._arm_links)
        is_free = query.split_by_links(all_arms)[1].rows(target_index).free(q)
        rows = np.flatnonzero(is_free)
        q = q[rows]
        for side, search in enumerate(searches):
            later_arms = frozenset[str]().union(*self._arm_links[side + 1 :])
            earlier_pairs = query.split_by_links(later_arms)[1]
            pairs, _ = earlier_pairs.split_by_links(self._arm_links[side])
            is_last = side + 1 == len(searches)
            candidates = search.choose(
                q,
                starts[target_index[rows]],
                (limits.lower, limits.upper),
                preference,
                pairs.rows(target_index[rows]),
                np.full(len(q), np.inf),
                all_branches=not is_last,
                refine=False,
                target_index=target_index[rows] if is_last else None,
            )
            q, rows = candidates.q, rows[candidates.hand_index]
        if len(q) and not all(search.is_exact for search in searches):
            q = carry_palms(
                self._subproblems, self._targets, q, palms[rows], target_index[rows], False
            )
        return q, target_index[rows]


@dataclass(frozen=True)
class UnconstrainedFingerParameters:
    """Sampling of the postures of fingers without a contact.

    Attributes:
        postures: Number of postures, evenly spread over the limits.
        local_postures: Number of postures around the best one in each refinement.
        local_radii: Radii of the refinements [fraction of the motors' ranges].
        max_gain: Clearance [m] that a refinement can gain; hands with a larger penetration are not
            refined.
    """

    postures: int = 48
    local_postures: int = 24
    local_radii: tuple[float, ...] = (0.5, 0.25, 0.12)
    max_gain: float = 0.02


UNCONSTRAINED_FINGER_PARAMETERS = UnconstrainedFingerParameters()


class UnconstrainedFingers:
    """Hand motors of k targets that move no finger with a contact."""

    def __init__(self, robot: ArmHand, targets: TargetBatch) -> None:
        """Find the free motors of each target and sample their postures."""
        parameters = UNCONSTRAINED_FINGER_PARAMETERS
        self._description = description = robot.description
        is_unconstrained = np.isnan(targets.points[..., 0]) & np.isnan(targets.normals[..., 0])
        for vectors in targets.extra_vectors.values():
            is_unconstrained &= np.isnan(vectors[..., 0])
        moves_finger = np.zeros((len(description.finger_names), len(robot.lower)), dtype=bool)
        for finger, name in enumerate(description.finger_names):
            moves_finger[finger, list(description.finger_actuators(name))] = True
        hand = np.zeros(len(robot.lower), dtype=bool)
        hand[list(description.hand_actuators)] = True
        is_constrained = (~is_unconstrained[:, :, None] & moves_finger).any(axis=1)
        self._free_motors: Bools = hand & ~is_constrained
        if targets.fixed is not None:
            self._free_motors &= np.isnan(targets.fixed)
        steps = np.arange(parameters.postures)[:, None] * spread_steps(len(robot.lower))
        fractions = (0.5 + steps) % 1.0
        ranges = robot.upper - robot.lower
        self._limits = robot.lower, robot.upper
        self._postures = robot.lower + fractions * ranges
        offsets = (fractions[: parameters.local_postures] - 0.5) * ranges
        # None: postures over the full range; then offsets around the best posture.
        self._levels = (None, *(radius * offsets for radius in parameters.local_radii))

    def move_aside(self, q: Array, target_index: NDArray[np.intp], query: CollisionQuery) -> Array:
        """Move unconstrained fingers to the posture with the largest clearance, if in collision.

        Args:
            q: (m, n) configurations.
            target_index: (m,) indices of their targets.
            query: Pairs whose distances the hand decides.

        Returns:
            (m, n) configurations; only those in self-collision are changed.
        """
        rows = np.flatnonzero(self._free_motors[target_index].any(axis=1))
        if not len(rows):
            return q
        free_finger_pairs, other_pairs = query.split_by_links(self._free_links)
        # Unconstrained fingers cannot resolve a collision of other links.
        rows = rows[other_pairs.rows(target_index[rows]).free(q[rows])]
        surplus = free_finger_pairs.rows(target_index[rows]).check(q[rows]).surplus
        collides = surplus < -DISTANCE_ROUNDING
        rows, surplus = rows[collides], surplus[collides]
        if not len(rows):
            return q
        result = q.copy()
        for offsets in self._levels:
            is_free = self._free_motors[target_index[rows]]
            center = result[rows][:, None]
            samples = self._postures if offsets is None else center + offsets
            candidates = np.where(is_free[:, None], np.clip(samples, *self._limits), center)
            count = candidates.shape[1]
            candidate_query = free_finger_pairs.rows(np.repeat(target_index[rows], count))
            clearances = candidate_query.check(candidates.reshape(-1, q.shape[1])).surplus
            clearances = clearances.reshape(-1, count)
            best = clearances.argmax(axis=1)
            numbers = np.arange(len(rows))
            best_surplus = clearances[numbers, best]
            is_better = best_surplus > surplus
            result[rows[is_better]] = candidates[numbers, best][is_better]
            surplus = np.maximum(surplus, best_surplus)
            can_improve = (surplus < -DISTANCE_ROUNDING) & (
                surplus > -UNCONSTRAINED_FINGER_PARAMETERS.max_gain
            )
            rows, surplus = rows[can_improve], surplus[can_improve]
            if not len(rows):
                break
        return result

    @cached_property
    def _free_links(self) -> frozenset[str]:
        """Names of the links moved by a motor that is free in at least one target."""
        motors = np.flatnonzero(self._free_motors.any(axis=0)).tolist()
        return self._description.links_moved(motors)
