"""Search for collision-free solutions of several targets.

The search order is:

1. all branches of the arm at all samples of its redundancy parameter, with the hand of the
   solution;
2. the hand postures of each restart, each with all arms; for an arm without a closed form,
   descents from random arms;
3. random steps around the least-penetrating solutions, each followed by a fit to the contacts.

A hand that is in self-collision for every posture of its unconstrained fingers is discarded before
its arms are checked.

For a multi-arm robot, self-collisions of hands are first resolved by random steps, independently
for each side, and then by steps of the contacts within their tolerances. The resulting hands are
combined with other trunks and arms; each stage of trunks is followed by the hands of the next
restart (`free_hands.py`). Finally trunk and arms move around the least-penetrating solutions while
the palms stay in place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.collision.distances import PairTable
from casadi_ik.files.arrays import Array
from casadi_ik.model.targets import CLEARANCE, TargetBatch
from casadi_ik.solve.alternatives import AlternativeFinder, side_links
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.collision_free_steps import COLLISION_FREE_PARAMETERS, RandomSteps
from casadi_ik.solve.free_hands import SideHands, UnconstrainedFingers
from casadi_ik.solve.row_selection import Deduplicator, improving_rows, largest_per_owner
from casadi_ik.solve.solution import CollisionReport
from casadi_ik.solve.subproblems import sample_trunks


@dataclass(frozen=True, eq=False)
class CollisionFreeResult:
    """Results of the search for k targets.

    Attributes:
        q: (k, n) collision-free solutions; the least-penetrating solution where there is none.
        free: (k,) True where the solution is collision-free.
        reports: (k,) `CollisionReport` of each target without a collision-free solution, else
            None.
    """

    q: Array
    free: NDArray[np.bool_]
    reports: NDArray[np.object_]


class CollisionFreeSearch:
    """Search for collision-free solutions of k targets.

    Attributes:
        best: (k, n) preferred collision-free configurations so far.
        free: (k,) True where `best` has a collision-free configuration.
        self_clearance: (k,) largest clearance between the links of a hand [m]; infinite if the
            scene limits the clearance of a hand.
    """

    def __init__(
        self,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery,
    ) -> None:
        """Prepare a search without candidates, see `find_collision_free`."""
        self.finder, self.arm_search = finder, finder.arm_search
        self.targets, self.query = targets, query
        self.starts = targets.starts(finder.robot.description)
        self.subproblems = finder.subproblems
        self._steps = RandomSteps(self.subproblems, targets)
        self.limits = self.subproblems.limits(targets)
        count, n = self.starts.shape
        self.best, self.score = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.least_penetrating, self.surplus = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.free = np.zeros(count, dtype=bool)
        self.self_clearance = np.full(count, np.inf if self.arm_search is None else -np.inf)
        self.arms_tried = np.zeros(count, dtype=np.int64)
        self.hands: list[tuple[Array, NDArray[np.intp], Array]] = []
        robot = finder.robot
        self._unconstrained = UnconstrainedFingers(robot, targets)
        size = len(finder.hand) + 12 * bool(robot.description.arm_actuators)
        self._known_hands, self._searched_hands = (
            Deduplicator(count, size, COLLISION_FREE_PARAMETERS.min_hand_difference)
            for _ in range(2)
        )
        self._has_new_hands = np.ones(count, dtype=bool)
        # Configurations, target indices and clearances of the least-penetrating solutions.
        self._pool = np.zeros((0, n)), np.zeros(0, dtype=np.intp), np.zeros(0)
        self._sides: SideHands | None = None
        if robot.description.sides:
            self._sides = SideHands(
                self.subproblems,
                side_links(robot.description),
                targets,
                query,
                COLLISION_FREE_PARAMETERS.min_hand_difference,
            )

    def run(self, q: Array, rank_all: bool, escape: bool) -> None:
        """Search until every target has a collision-free configuration or all stages have run.

        Args:
            q: (k, n) solutions whose hands are arms_tried first.
            rank_all: Try the hands of the first restart for all targets.
            escape: Take random steps around the least-penetrating solutions at the end.
        """
        self.try_hands(q, np.arange(len(q)))
        hands, sides = self.restart_hands(rank_all), self._sides
        for trunk_count, max_combinations in COLLISION_FREE_PARAMETERS.trunk_stages:
            if sides is None:
                break
            self._resolve_hand_collisions(sides)
            self._try_trunks(sides, trunk_count, max_combinations)
            self.try_hands(*next(hands, (q[:0], np.zeros(0, np.intp))))
        for candidates, target_index in chain(hands, self._solve_from_random_arms()):
            self.try_hands(candidates, target_index)
            # If every hand has a deep self-collision, further hands rarely help.
            min_clearance = -COLLISION_FREE_PARAMETERS.escape_depths[0][1]
            self._has_new_hands &= self.self_clearance > min_clearance
        if sides is not None:
            self._move_trunk_and_arms(sides)
        blocked = np.flatnonzero(~self.free)
        if len(blocked):
            self._record_clearest_arms(blocked)
            if escape:
                self._escape()

    def record_candidates(self, q: Array, target_index: NDArray[np.intp]) -> Array:
        """Update the best collision-free and the least-penetrating configuration of each target.

        Args:
            q: (m, n) candidate configurations.
            target_index: (m,) index of the target that each candidate solves.

        Returns:
            (m,) clearance beyond the required margin [m]; negative where a candidate collides.
        """
        if not len(q):
            return np.zeros(0)
        surplus = self.query.rows(target_index).check(q).surplus
        rows = improving_rows(target_index, surplus, self.surplus)
        self.least_penetrating[target_index[rows]], self.surplus[target_index[rows]] = (
            q[rows],
            surplus[rows],
        )
        if self._sides is not None:
            pool_q = np.concatenate([self._pool[0], q])
            pool_targets = np.concatenate([self._pool[1], target_index])
            pool_surplus = np.concatenate([self._pool[2], surplus])
            selected = largest_per_owner(
                pool_targets, pool_surplus, COLLISION_FREE_PARAMETERS.pool_size
            )
            self._pool = pool_q[selected], pool_targets[selected], pool_surplus[selected]
        free_rows = np.flatnonzero(surplus >= -DISTANCE_ROUNDING)
        if len(free_rows):
            free_q, free_targets = q[free_rows], target_index[free_rows]
            score = self.finder.score(
                free_q, self.starts[free_targets], self.targets.prefer, surplus=surplus[free_rows]
            )
            rows = improving_rows(free_targets, score, self.score)
            self.best[free_targets[rows]] = free_q[rows]
            self.score[free_targets[rows]] = score[rows]
            self.free[free_targets[rows]] = True
        return surplus

    def try_hands(self, q: Array, target_index: NDArray[np.intp]) -> None:
        """Record the preferred collision-free arm of each hand.

        Args:
            q: (m, n) solutions whose hands and palm poses are used.
            target_index: (m,) index of the target of each solution.
        """
        if not len(q):
            return
        q = self._unconstrained.move_aside(q, target_index, self.query.hand_pairs)
        if self.arm_search is None:
            self.record_candidates(q, target_index)
            if self._sides is not None:
                for side in range(len(self._sides.hand_motors)):
                    self._sides.add_hands(q, target_index, side)
            self.hands.append((q, target_index, np.zeros(len(q))))
            np.add.at(self.arms_tried, target_index, 1)
            self._has_new_hands[target_index] = True
            return
        hand_query = self.query.rows(target_index).hand_pairs
        clearances = hand_query.check(q)
        surplus = clearances.surplus
        # If the scene limits the clearance of a hand, another hand may avoid the scene.
        is_self_pair = np.append(hand_query.table.is_self_pair, False)[clearances.pairs]
        np.maximum.at(self.self_clearance, target_index, np.where(is_self_pair, surplus, np.inf))
        coordinates = self.finder.hand_coordinates(q)
        is_new = self._known_hands.add(coordinates, target_index)
        self._has_new_hands[target_index[is_new]] = True
        self.hands.append((q[is_new], target_index[is_new], surplus[is_new]))
        free_rows = np.flatnonzero(surplus >= -DISTANCE_ROUNDING)
        np.add.at(self.arms_tried, target_index[surplus < -DISTANCE_ROUNDING], 1)
        is_new = self._searched_hands.add(coordinates[free_rows], target_index[free_rows])
        rows = free_rows[is_new]
        rows = rows[self._preference_order(q[rows], target_index[rows])]
        arms, arm_targets, arm_counts = self._search_arms(
            q[rows], target_index[rows], surplus[rows], self.query
        )
        np.add.at(self.arms_tried, target_index[rows], arm_counts)
        self.record_candidates(arms, arm_targets)

    def _preference_order(self, q: Array, target_index: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the order of hands by target, then by the preference evaluated for the hand."""
        hand = self.finder.hand
        if self.targets.prefer == "q0":
            offset = ((q - self.starts[target_index]) / self._steps.ranges)[:, hand]
            return np.lexsort((np.square(offset).sum(axis=1), target_index))
        return np.lexsort((-self.finder.score(q, q, "limits", hand), target_index))

    def _search_arms(
        self,
        q: Array,
        target_index: NDArray[np.intp],
        surplus: Array,
        query: CollisionQuery,
        prefer: Preference | None = None,
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.int64]]:
        """Return the preferred arms of hands.

        Args:
            q: (m, n) hands.
            target_index: (m,) index of the target of each hand.
            surplus: (m,) clearance of each hand beyond the margin [m].
            query: Pairs that must not collide.
            prefer: Preference; None: that of the targets.

        Returns:
            (p, n) configurations, (p,) indices of their targets, (m,) number of arms tried per
            hand.
        """
        arms = self.arm_search
        assert arms is not None
        preference = prefer or self.targets.prefer
        candidates = arms.choose(
            q,
            self.starts[target_index],
            (self.limits.first.lower, self.limits.first.upper),
            preference,
            query.arm_pairs.rows(target_index),
            surplus,
            target_index=target_index if preference in ("limits", "q0") else None,
        )
        solved = self._steps.select_solved(candidates.q, target_index[candidates.hand_index])
        return *solved, candidates.arms_tried

    def _try_trunks(self, sides: SideHands, trunk_count: int, max_combinations: int) -> None:
        """Try new trunk postures of a multi-arm robot, and then other arms at these trunks.

        Args:
            sides: Hands of each side.
            trunk_count: Number of trunks per target.
            max_combinations: Maximum number of combinations of hands, which share the trunks.
        """
        searches = self.finder.side_searches
        q, palms, target_index = sides.combine(np.flatnonzero(~self.free), max_combinations)
        if not len(q):
            return
        stages = COLLISION_FREE_PARAMETERS.trunk_stages
        first = sum(trunks for trunks, _ in stages if trunks < trunk_count)
        per_hand = max(trunk_count // int(np.bincount(target_index).max()), 1)
        configurations, rows = sample_trunks(
            self.subproblems, self.targets, q, palms, target_index, first, per_hand
        )
        solved = self.subproblems.solved(
            self.targets.rows(target_index[rows]), configurations, self.targets.enforce_limits
        )
        configurations, rows = configurations[solved], rows[solved]
        self.record_candidates(configurations, target_index[rows])
        blocked = np.flatnonzero(~self.free[target_index[rows]])
        if searches and len(blocked):
            rows = rows[blocked]
            hands = configurations[blocked], palms[rows], target_index[rows]
            arms = sides.search_arms(searches, *hands, self.starts, self.targets.prefer)
            self.record_candidates(*self._steps.select_solved(*arms))

    def restart_hands(self, rank_all: bool = False) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Yield solutions with the hands of each restart, for targets without a collision-free one.

        Args:
            rank_all: Include all targets in the first restart.
        """
        method = self.subproblems.method
        restarts = min(COLLISION_FREE_PARAMETERS.restarts, method.options.rounds, method.rounds)
        for restart in range(restarts):
            # If a restart yields no new hand for a target, the next restart rarely does.
            rows = np.flatnonzero((~self.free | (rank_all and not restart)) & self._has_new_hands)
            if not len(rows):
                break
            self._has_new_hands[:] = False
            postures = method.postures(self.targets.rows(rows), restart)
            first_palm = restart * postures.shape[1]
            targets = self.targets.starting_at(self.limits.clip(self.starts))
            target_index, *initial = self.subproblems.hand_rows(targets, rows, postures, first_palm)
            yield self._steps.select_solved(self.subproblems.run(*initial), target_index)

    def _solve_from_random_arms(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Yield solutions from random arms for blocked targets, if the arm has no closed form."""
        rows = np.flatnonzero(~self.free)
        if len(rows) and self.arm_search is None:
            first_q, *_ = self.hands[0]
            yield self._steps.sample_arms(first_q, rows)

    def _record_clearest_arms(self, rows: NDArray[np.intp]) -> None:
        """Record the arms with the largest clearance, for the clearest hand of each target."""
        if self.arm_search is None:
            return
        q, target_index, surplus = self._hands_of(rows)
        clearest = largest_per_owner(target_index, surplus, 1)
        q, target_index, surplus = q[clearest], target_index[clearest], surplus[clearest]
        arms, arm_targets, _ = self._search_arms(q, target_index, surplus, self.query, CLEARANCE)
        self.record_candidates(
            np.concatenate([arms, q]), np.concatenate([arm_targets, target_index])
        )

    def _hands_of(self, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp], Array]:
        """Return the hands tried for these targets, with target indices and clearances."""
        q, target_index, surplus = (
            np.concatenate(arrays) for arrays in zip(*self.hands, strict=True)
        )
        selected = np.isin(target_index, rows)
        return q[selected], target_index[selected], surplus[selected]

    def _escape(self) -> None:
        """Take random steps around the least-penetrating solution of each target.

        Steps of motors are projected back onto the contacts; steps of contacts stay within their
        tolerances. Source: of 1,000 targets each that collision-free configurations meet at the
        edge of 5 mm and 3 deg among eight posts, without steps of contacts 29 (Panda with Allegro),
        20 (KUKA LWR with Barrett) and 55 (UR5e with Shadow) got no collision-free solution; with
        them 13, 5 and 17, in 1.3 to 1.7 times the time.
        """
        steps = zip(
            COLLISION_FREE_PARAMETERS.escape_steps,
            COLLISION_FREE_PARAMETERS.escape_depths,
            strict=True,
        )
        for number, (size, (max_depth, max_self_depth)) in enumerate(steps):
            if self.arm_search is None:
                max_depth = COLLISION_FREE_PARAMETERS.max_penetration
            rows = np.flatnonzero(~self.free & (self.surplus > -max_depth))
            if len(rows) and self.arm_search is not None:
                hand_query = self.query.with_table(self.query.table.self_pairs).hand_pairs
                self_surplus = hand_query.rows(rows).check(self.least_penetrating[rows]).surplus
                is_scene_limited = np.isinf(self.self_clearance[rows])
                rows = rows[(self_surplus > -max_self_depth) | is_scene_limited]
            if not len(rows):
                return
            candidates = self._steps.step_motors(
                self.least_penetrating[rows], rows, slice(None), number, size
            )
            self.record_candidates(*candidates)
            contact_steps = len(COLLISION_FREE_PARAMETERS.contact_steps)
            for step in range(2 * number, min(2 * number + 2, contact_steps)):
                rows = rows[~self.free[rows]]
                if len(rows):
                    self.record_candidates(
                        *self._steps.step_contacts(self.least_penetrating[rows], rows, step)
                    )

    def _move_trunk_and_arms(self, sides: SideHands) -> None:
        """Move trunk and arms around the least-penetrating solutions; the palms stay in place."""
        has_hand_collision = (sides.surplus < -DISTANCE_ROUNDING).any(axis=0)
        for number, (size, max_depth) in enumerate(COLLISION_FREE_PARAMETERS.carry_steps):
            q, target_index, surplus = self._pool
            is_blocked = ~(self.free | has_hand_collision)[target_index]
            rows = np.flatnonzero(is_blocked & (surplus > -max_depth))
            if not len(rows):
                return
            rank = rows - np.searchsorted(target_index, target_index[rows])
            self.record_candidates(
                *self._steps.step_trunk_and_arms(q[rows], target_index[rows], rank, number, size)
            )

    def _resolve_hand_collisions(self, sides: SideHands) -> None:
        """Resolve the self-collisions of the hands of each side of a multi-arm robot."""
        motor_steps = COLLISION_FREE_PARAMETERS.hand_steps
        contact_steps = COLLISION_FREE_PARAMETERS.contact_steps
        for side, motors in enumerate(sides.hand_motors):
            for number in range(len(motor_steps) + len(contact_steps)):
                surplus = np.where(self.free, 0.0, sides.surplus[side])
                is_shallow = surplus > -COLLISION_FREE_PARAMETERS.max_penetration
                rows = np.flatnonzero((surplus < -DISTANCE_ROUNDING) & is_shallow)
                if not len(rows):
                    break
                least_penetrating = sides.least_penetrating[side][rows]
                if number < len(motor_steps):
                    candidates = self._steps.step_motors(
                        least_penetrating, rows, motors, number, motor_steps[number]
                    )
                else:
                    candidates = self._steps.step_contacts(
                        least_penetrating, rows, number - len(motor_steps)
                    )
                sides.add_hands(*candidates, side, best_only=True)

    def result(self, diagnose: bool) -> CollisionFreeResult:
        """Return the result, with a report of each remaining collision.

        Args:
            diagnose: Check whether there is a solution without the scene or without
                self-collision.
        """
        q = np.where(self.free[:, None], self.best, self.least_penetrating)
        reports = np.full(len(q), None, dtype=object)
        blocked = np.flatnonzero(~self.free)
        if not len(blocked):
            return CollisionFreeResult(q, self.free, reports)
        clearances = self.query.rows(blocked).check(q[blocked])
        table = self.query.table
        without_scene = self._is_possible(blocked, table.self_pairs) if diagnose else None
        without_self = self._is_possible(blocked, table.scene_pairs) if diagnose else None
        for i, row in enumerate(blocked.tolist()):
            pair = clearances.pair(i)
            assert pair is not None
            reports[row] = CollisionReport(
                pair,
                -float(clearances.surplus[i]),
                int(self.arms_tried[row]),
                None if without_scene is None else bool(without_scene[row]),
                None if without_self is None else bool(without_self[row]),
            )
        return CollisionFreeResult(q, self.free, reports)

    def _is_possible(self, rows: NDArray[np.intp], table: PairTable) -> NDArray[np.bool_]:
        """Return (k,) True for targets with a configuration without collisions of these pairs.

        Args:
            rows: Indices of the targets that are checked.
            table: Pairs that must not collide.
        """
        query = self.query.with_table(table)
        q, target_index, surplus = self._hands_of(rows)
        possible = np.zeros(len(self.free), dtype=bool)
        if self.arm_search is None:
            possible[target_index[query.rows(target_index).free(q)]] = True
            return possible
        free_rows = np.flatnonzero(query.rows(target_index).hand_pairs.free(q))
        clearest = largest_per_owner(
            target_index[free_rows], surplus[free_rows], COLLISION_FREE_PARAMETERS.diagnosed_hands
        )
        rows = free_rows[clearest]
        no_bound = np.full(len(rows), np.inf)
        _, arm_targets, _ = self._search_arms(
            q[rows], target_index[rows], no_bound, query, "limits"
        )
        possible[arm_targets] = True
        return possible
