"""Search for collision-free solutions of targets whose first solution is in collision.

The search order is:

1. all branches of the arm at all sampled values of its redundancy, with the given hand;
2. the hand postures of each restart, each with all arms; for an arm without a closed form,
   descents from random arms;
3. random steps around the least-penetrating solutions, each projected back onto the contacts.

A hand in self-collision for every posture of its unconstrained fingers is discarded before any arm
is checked.

For a multi-arm robot, hands in self-collision are first moved by such steps, independently for
each side, and then by steps of their contacts within the tolerances. The remaining hands are
combined with other trunks and other arms, and each stage of trunks is followed by the hands of the
next restart (free_hands.py). Finally trunk and arms move around the least-penetrating solutions
while the palms stay in place.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import ROUNDING, Clearances, CollisionQuery
from casadi_ik.collision.distances import PairTable
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.solve.alternatives import AlternativeFinder, side_links
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.free_hands import SideHands, UnconstrainedFingers
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.request import CLEARANCE
from casadi_ik.solve.row_selection import Deduplicator, improving_rows, largest_per_owner
from casadi_ik.solve.solution import BatchSolution, CollisionReport
from casadi_ik.solve.status import Status
from casadi_ik.solve.subproblems import LocalRefinement, carry_palms, sample_trunks, side_palms
from casadi_ik.solve.verdict import SolvedVerdict, judge_single

DEFAULT_PREFERENCE = "limits"
"""Preference of targets that name none."""

RANKING_PREFERENCES = ("manipulability", CLEARANCE)
"""Preferences for which a collision-free solution still competes with all other solutions."""


@dataclass(frozen=True)
class CollisionFreeParameters:
    """Effort of the search for collision-free solutions.

    Attributes:
        chunk_size: Number of targets that are searched together.
        restarts: Maximum number of restarts whose hand postures are tried.
        min_hand_difference: Hands are duplicates if every motor differs by less than this
            [fraction of its range]; duplicates have the same arms.
        trunk_stages: For a multi-arm robot, the number of trunks per target in each stage, and the
            maximum number of combinations of its hands that share them. Each stage is followed by
            the hands of one restart.
        random_arms: Number of random starts per target for an arm without a closed form.
        escape_steps: Standard deviations of successive random steps around the least-penetrating
            solution [fraction of the motors' ranges].
        step_samples: Number of random directions per step, of which the best is kept: for a robot
            with one arm and for a multi-arm robot.
            Source: `studies/bench.py --part clutter`, a KUKA LWR with a Barrett hand, alternating
            with commit 508e6b5, which solves 472 of 650 targets: with 4, 8 and 12 directions it is
            473, 481 and 490, in 0.95, 1.04 and 1.11 times the time.
        hand_steps: Steps of the hand motors of a multi-arm robot [fraction of their ranges].
            Source: for two Pandas with Allegro hands, `escape_steps` here leave more work to
            `contact_steps`: 1.9 to 2.5 ms a target instead of 1.5 to 1.6.
        contact_steps: Steps of contacts [fraction of their tolerances], tried where steps of the
            motors do not help.
        contact_tolerance: Tolerance of the displaced contacts [fraction of the original one].
        pool_size: For a multi-arm robot, number of least-penetrating solutions of a target around
            which trunk and arms move at the end.
        carry_steps: Steps of trunk and arms around these solutions [fraction of the motors'
            ranges], each with the maximum penetration for which it is tried [m].
            Source: of 300 targets of a G1 with Dex3 hands that are given hands without
            self-collision, 211 got a collision-free solution without these steps and 248 with
            them; a search of 6,000 solutions found 16 of those 37 and no other. Of 100 targets
            with arbitrary hands 7 got one, and 38 with `contact_steps` as well.
        max_penetration: Maximum penetration [m] for which steps of hands, and of arms without a
            closed form, are tried.
        escape_depths: For an arm with a closed form, the maximum penetration [m] for which each of
            `escape_steps` is tried: of the robot, and of the hand in self-collision unless a hand
            is limited by the scene. A target all of whose hands exceed the first self-penetration
            is given up after one restart.
            Source: of a KUKA LWR with a Barrett hand these steps free 48 of 1,778 targets of
            `studies/collision.py` and 41 of 2,000 of `studies/bench.py`. A first step of 0.3 (of
            whose results one in seven meets the contacts), and one of 0.2 with eight steps and
            depths of 20, 18, 15, 12, 9, 6, 4 and 2 mm, free 50 and 43 in 1.9 and 1.1 times the
            time.
        diagnosed_hands: Number of hands with the largest clearance that are checked for the reason
            of a collision.
        min_range: Substitute for the range of a motor without a range [rad or m].
    """

    chunk_size: int = 256
    restarts: int = 3
    min_hand_difference: float = 0.02
    trunk_stages: tuple[tuple[int, int], ...] = ((4, 1), (12, 2), (48, 4), (192, 8), (768, 16))
    random_arms: int = 24
    escape_steps: tuple[float, ...] = (0.15, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    step_samples: tuple[int, int] = (12, 24)
    hand_steps: tuple[float, ...] = (0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    contact_steps: tuple[float, ...] = (
        *(1, 0.7, 0.5, 0.5, 0.35, 0.35),
        *(0.25, 0.25, 0.18, 0.18, 0.12, 0.12),
    )
    contact_tolerance: float = 0.5
    pool_size: int = 16
    carry_steps: tuple[tuple[float, float], ...] = (
        (0.2, 0.08),
        (0.2, 0.04),
        (0.1, 0.03),
        (0.1, 0.02),
        (0.1, 0.015),
        (0.05, 0.01),
        (0.05, 0.006),
        (0.05, 0.004),
    )
    max_penetration: float = 0.02
    escape_depths: tuple[tuple[float, float], ...] = (
        (0.020, 0.006),
        (0.010, 0.003),
        (0.008, 0.002),
        (0.006, 0.001),
        (0.004, 0.001),
        (0.003, 0.001),
        (0.002, 0.001),
    )
    diagnosed_hands: int = 4
    min_range: float = 1e-9


COLLISION_FREE_PARAMETERS = CollisionFreeParameters()


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


def find_collision_free(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    starts: Array,
    seed: int,
    rank_all: bool = False,
    diagnose: bool = True,
) -> CollisionFreeResult:
    """Search collision-free solutions of k targets.

    Args:
        finder: Source of arms and hands of the robot.
        targets: k targets.
        query: Pairs that must not collide.
        q: (k, n) solutions, which may collide.
        starts: (k, n) initial configurations.
        seed: Seed of the random steps and arms.
        rank_all: Compare a solution that is collision-free already with all others under the
            preference, instead of keeping it.
        diagnose: Check whether targets without a result would have one without the scene, or
            without self-collision.
    """
    home = np.tile(finder.robot.home, (len(q), 1))
    is_biased = targets.prefer != DEFAULT_PREFERENCE or not np.array_equal(starts, home)
    result = _search_in_chunks(
        finder, targets, query, q, starts, seed, rank_all, diagnose, escape=not is_biased
    )
    blocked = np.flatnonzero(~result.free)
    if not is_biased or not len(blocked):
        return result
    # A preference ranks solutions and must not decide whether there is one. Escape steps lead to
    # arbitrary solutions, so they are taken by a second search without preference from home.
    retry, subproblems = (
        replace(targets.rows(blocked), prefer=DEFAULT_PREFERENCE),
        finder.subproblems,
    )
    ends = subproblems.method.run(retry, home[blocked], seed, False).q
    solved = subproblems.solved(retry, ends, retry.enforce_limits)
    blocked, retry, ends = blocked[solved], retry.rows(np.flatnonzero(solved)), ends[solved]
    arguments = query.rows(blocked), ends, home[blocked]
    second = _search_in_chunks(
        finder, retry, *arguments, seed, rank_all=False, diagnose=False, escape=True
    )
    freed = blocked[second.free]
    result.q[freed], result.free[freed], result.reports[freed] = second.q[second.free], True, None
    return result


def _search_in_chunks(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    starts: Array,
    seed: int,
    rank_all: bool,
    diagnose: bool,
    escape: bool,
) -> CollisionFreeResult:
    """Search chunk by chunk, see `find_collision_free`; take escape steps if `escape`."""
    if not len(q):
        return CollisionFreeResult(q, np.zeros(0, dtype=bool), np.zeros(0, dtype=object))
    parts = []
    for first in range(0, len(q), COLLISION_FREE_PARAMETERS.chunk_size):
        rows = np.arange(first, min(first + COLLISION_FREE_PARAMETERS.chunk_size, len(q)))
        chunk = targets.rows(rows), query.rows(rows), starts[rows]
        search = CollisionFreeSearch(finder, *chunk, seed)
        if rank_all:
            search.record_candidates(q[rows], np.arange(len(rows)))
        search.run(q[rows], rank_all, escape)
        result = search.result(diagnose)
        parts.append((result.q, result.free, result.reports))
    return CollisionFreeResult(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class CollisionFreeSearch:
    """The state of a search for k targets.

    Attributes:
        best: (k, n) preferred collision-free configurations so far.
        free: (k,) True where `best` holds a configuration.
        self_clearance: (k,) largest clearance of a hand from its own links [m]; infinite if a hand
            is limited by the scene.
    """

    def __init__(
        self,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery,
        starts: Array,
        seed: int,
    ) -> None:
        self.finder, self.arm_search = finder, finder.arm_search
        self.targets, self.query = targets, query
        self.starts, self.seed = starts, seed
        self.subproblems = finder.subproblems
        self.limits = self.subproblems.limits(targets)
        count, n = starts.shape
        self.best, self.score = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.nearest, self.surplus = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.free = np.zeros(count, dtype=bool)
        self.self_clearance = np.full(count, np.inf if self.arm_search is None else -np.inf)
        self.arms_tried = np.zeros(count, dtype=np.int64)
        self.hands: list[tuple[Array, NDArray[np.intp], Array]] = []
        robot = finder.robot
        self._unconstrained = UnconstrainedFingers(robot, targets)
        self._ranges = np.maximum(robot.upper - robot.lower, COLLISION_FREE_PARAMETERS.min_range)
        size = len(finder.hand) + 12 * bool(robot.description.arm_actuators)
        self._known_hands, self._searched_hands = (
            Deduplicator(count, size, COLLISION_FREE_PARAMETERS.min_hand_difference)
            for _ in range(2)
        )
        self._has_new_hands = np.ones(count, dtype=bool)
        # Configurations, target indices and clearances of the least-penetrating solutions.
        self._pool = np.zeros((0, n)), np.zeros(0, dtype=np.intp), np.zeros(0)
        self._sides: SideHands | None = None
        is_multi_arm = bool(robot.description.sides)
        self._step_samples = COLLISION_FREE_PARAMETERS.step_samples[is_multi_arm]
        if is_multi_arm:
            self._sides = SideHands(
                self.subproblems,
                side_links(robot.description),
                targets,
                query,
                COLLISION_FREE_PARAMETERS.min_hand_difference,
            )

    @cached_property
    def _descent(self) -> LocalRefinement:
        return LocalRefinement(self.subproblems, self.targets)

    def run(self, q: Array, rank_all: bool, escape: bool) -> None:
        """Search until all targets have a collision-free configuration.

        Args:
            q: (k, n) solutions whose hands are tried first.
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
            # Without a hand that is (almost) free of self-collision further hands rarely help.
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
        self.nearest[target_index[rows]], self.surplus[target_index[rows]] = q[rows], surplus[rows]
        if self._sides is not None:
            pool_q = np.concatenate([self._pool[0], q])
            pool_targets = np.concatenate([self._pool[1], target_index])
            pool_surplus = np.concatenate([self._pool[2], surplus])
            kept = largest_per_owner(
                pool_targets, pool_surplus, COLLISION_FREE_PARAMETERS.pool_size
            )
            self._pool = pool_q[kept], pool_targets[kept], pool_surplus[kept]
        free_rows = np.flatnonzero(surplus >= -ROUNDING)
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
        # A hand limited by the scene is no reason to give up: another hand may avoid the scene.
        is_self_pair = np.append(hand_query.table.is_self_pair, False)[clearances.pairs]
        np.maximum.at(self.self_clearance, target_index, np.where(is_self_pair, surplus, np.inf))
        coordinates = self.finder.hand_coordinates(q)
        is_new = self._known_hands.add(coordinates, target_index)
        self._has_new_hands[target_index[is_new]] = True
        self.hands.append((q[is_new], target_index[is_new], surplus[is_new]))
        free_rows = np.flatnonzero(surplus >= -ROUNDING)
        np.add.at(self.arms_tried, target_index[surplus < -ROUNDING], 1)
        is_new = self._searched_hands.add(coordinates[free_rows], target_index[free_rows])
        rows = free_rows[is_new]
        rows = rows[self._preference_order(q[rows], target_index[rows])]
        arms, arm_targets, tried = self._search_arms(
            q[rows], target_index[rows], surplus[rows], self.query
        )
        np.add.at(self.arms_tried, target_index[rows], tried)
        self.record_candidates(arms, arm_targets)

    def _preference_order(self, q: Array, target_index: NDArray[np.intp]) -> NDArray[np.intp]:
        """Sort hands by target, then by the preference as far as it depends on the hand."""
        hand = self.finder.hand
        if self.targets.prefer == "q0":
            offset = ((q - self.starts[target_index]) / self._ranges)[:, hand]
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
            (p, n) configurations, (p,) indices of their targets, (m,) number of arms tried.
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
        solved = self._solved(candidates.q, target_index[candidates.hand_index])
        return *solved, candidates.arms_tried

    def _try_trunks(self, sides: SideHands, trunk_count: int, max_combinations: int) -> None:
        """Try other trunks of a multi-arm robot, and then other arms at these trunks.

        Args:
            sides: Hands of its sides.
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
        ends, rows = sample_trunks(
            self.subproblems, self.targets, q, palms, target_index, first, per_hand
        )
        solved = self.subproblems.solved(
            self.targets.rows(target_index[rows]), ends, self.targets.enforce_limits
        )
        ends, rows = ends[solved], rows[solved]
        self.record_candidates(ends, target_index[rows])
        blocked = np.flatnonzero(~self.free[target_index[rows]])
        if searches and len(blocked):
            rows = rows[blocked]
            hands = ends[blocked], palms[rows], target_index[rows]
            arms = sides.search_arms(searches, *hands, self.starts, self.targets.prefer)
            self.record_candidates(*self._solved(*arms))

    def restart_hands(self, rank_all: bool = False) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Yield solutions with other hands, restart by restart, for targets that are not free.

        Args:
            rank_all: Include all targets in the first restart.
        """
        method = self.subproblems.method
        restarts = min(COLLISION_FREE_PARAMETERS.restarts, method.options.rounds, method.rounds)
        for restart in range(restarts):
            # A target whose last restart brought no new hand is unlikely to get one from the next.
            rows = np.flatnonzero((~self.free | (rank_all and not restart)) & self._has_new_hands)
            if not len(rows):
                break
            self._has_new_hands[:] = False
            postures = method.postures(self.targets.rows(rows), restart)
            first, starts = restart * postures.shape[1], self.limits.clip(self.starts)
            target_index, *initial = self.subproblems.hand_rows(
                self.targets, rows, starts, postures, first
            )
            yield self._solved(self.subproblems.run(*initial), target_index)

    def _solve_from_random_arms(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Yield solutions from random arms for targets that are not free; no closed form."""
        rows, robot, hand = np.flatnonzero(~self.free), self.finder.robot, self.finder.hand
        if not len(rows) or self.arm_search is not None:
            return
        count = COLLISION_FREE_PARAMETERS.random_arms
        target_index = np.repeat(rows, count)
        numbers = np.array([self.targets.row_number(int(row)) for row in rows])
        starts = np.concatenate(_shifted_samples(robot, self.seed, numbers, count))
        given = self.hands[0][0]
        starts[::2, hand] = given[target_index[::2]][:, hand]
        ends = self._descent.run(target_index, self.limits.select_rows(target_index).clip(starts))
        yield self._solved(ends, target_index)

    def _solved(self, q: Array, target_index: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Select the configurations that meet their targets."""
        if not len(q):
            return q, target_index
        targets = self.targets.rows(target_index)
        solved = self.subproblems.solved(targets, q, targets.enforce_limits)
        return q[solved], target_index[solved]

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
        """Return all hands of some targets, the indices of their targets and their clearances."""
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
                self_surplus = hand_query.rows(rows).check(self.nearest[rows]).surplus
                is_scene_limited = np.isinf(self.self_clearance[rows])
                rows = rows[(self_surplus > -max_self_depth) | is_scene_limited]
            if not len(rows):
                return
            ends = self._step_motors(self.nearest[rows], rows, slice(None), number, size)
            self.record_candidates(*ends)
            contact_steps = len(COLLISION_FREE_PARAMETERS.contact_steps)
            for step in range(2 * number, min(2 * number + 2, contact_steps)):
                rows = rows[~self.free[rows]]
                if len(rows):
                    self.record_candidates(*self._step_contacts(self.nearest[rows], rows, step))

    def _move_trunk_and_arms(self, sides: SideHands) -> None:
        """Move trunk and arms around the least-penetrating solutions; the palms stay in place."""
        robot, subproblems = self.finder.robot, self.subproblems
        moving = np.setdiff1d(np.arange(len(robot.lower)), self.finder.hand)
        has_hand_collision = (sides.surplus < -ROUNDING).any(axis=0)
        for number, (size, max_depth) in enumerate(COLLISION_FREE_PARAMETERS.carry_steps):
            q, target_index, surplus = self._pool
            is_open = ~(self.free | has_hand_collision)[target_index]
            rows = np.flatnonzero(is_open & (surplus > -max_depth))
            if not len(rows):
                return
            rank = rows - np.searchsorted(target_index, target_index[rows])
            repeated_rows = np.repeat(rows, self._step_samples)
            q, target_index = q[repeated_rows], target_index[repeated_rows]
            starts, random = q.copy(), np.random.default_rng([self.seed, number])
            steps = random.standard_normal(
                (COLLISION_FREE_PARAMETERS.pool_size, self._step_samples, len(moving))
            )
            starts[:, moving] += size * self._ranges[moving] * steps[rank].reshape(-1, len(moving))
            starts, palms = self.limits.select_rows(target_index).clip(starts), side_palms(robot, q)
            ends = carry_palms(subproblems, self.targets, starts, palms, target_index, False)
            self.record_candidates(*self._solved(ends, target_index))

    def _resolve_hand_collisions(self, sides: SideHands) -> None:
        """Move hands in self-collision aside, side by side of a multi-arm robot."""
        motor_steps = COLLISION_FREE_PARAMETERS.hand_steps
        contact_steps = COLLISION_FREE_PARAMETERS.contact_steps
        for side, motors in enumerate(sides.hand_motors):
            for number in range(len(motor_steps) + len(contact_steps)):
                surplus = np.where(self.free, 0.0, sides.surplus[side])
                is_shallow = surplus > -COLLISION_FREE_PARAMETERS.max_penetration
                rows = np.flatnonzero((surplus < -ROUNDING) & is_shallow)
                if not len(rows):
                    break
                nearest = sides.nearest[side][rows]
                if number < len(motor_steps):
                    ends = self._step_motors(nearest, rows, motors, number, motor_steps[number])
                else:
                    ends = self._step_contacts(nearest, rows, number - len(motor_steps))
                sides.add_hands(*ends, side, best_only=True)

    def _step_contacts(
        self, q: Array, rows: NDArray[np.intp], number: int
    ) -> tuple[Array, NDArray[np.intp]]:
        """Displace the contacts of solutions at random within their tolerances, and solve again.

        Args:
            q: (k, n) solutions.
            rows: (k,) indices of their targets.
            number: Index into `contact_steps`.
        """
        samples, size = self._step_samples, COLLISION_FREE_PARAMETERS.contact_steps[number]
        target_index, starts = np.repeat(rows, samples), np.repeat(q, samples, axis=0)
        targets, contacts = self.targets.rows(target_index), self.finder.robot.contacts(starts)
        random, displaced = np.random.default_rng([self.seed, number]), []
        goals = (
            (targets.points, targets.position_tolerance),
            (targets.normals, targets.angle_tolerance),
        )
        for actual, (goal, tolerance) in zip(contacts, goals, strict=True):
            steps = np.tile(random.standard_normal((samples, *actual.shape[1:])), (len(rows), 1, 1))
            offset = (actual - goal) / tolerance[:, None] + size * steps
            offset /= np.maximum(1.0, np.linalg.norm(offset, axis=2, keepdims=True))
            displaced.append(goal + offset * tolerance[:, None])
        points = displaced[0]
        normals = displaced[1] / np.linalg.norm(displaced[1], axis=2, keepdims=True)
        factor = COLLISION_FREE_PARAMETERS.contact_tolerance
        tolerances = tuple(
            Tolerance(factor * tolerance.position, factor * tolerance.angle)
            for tolerance in targets.tolerances
        )
        shifted = replace(targets, points=points, normals=normals, tolerance=tolerances)
        ends = LocalRefinement(self.subproblems, shifted).run(np.arange(len(target_index)), starts)
        return self._solved(ends, target_index)

    def _step_motors(
        self, q: Array, rows: NDArray[np.intp], motors: list[int] | slice, number: int, size: float
    ) -> tuple[Array, NDArray[np.intp]]:
        """Displace motors of solutions at random, and project back onto the contacts.

        Args:
            q: (k, n) solutions.
            rows: (k,) indices of their targets.
            motors: Motors that are displaced.
            number: Number of the step, which selects its random directions.
            size: Standard deviation [fraction of the motors' ranges].
        """
        target_index = np.repeat(rows, self._step_samples)
        ranges = self._ranges[motors]
        random = np.random.default_rng([self.seed, number])
        steps = random.standard_normal((self._step_samples, len(ranges)))
        starts = np.repeat(q, self._step_samples, axis=0)
        starts[:, motors] += size * ranges * np.tile(steps, (len(rows), 1))
        ends = self._descent.run(target_index, self.limits.select_rows(target_index).clip(starts))
        return self._solved(ends, target_index)

    def result(self, diagnose: bool) -> CollisionFreeResult:
        """Return the result, and the reason of each remaining collision.

        Args:
            diagnose: Check whether there is a solution without the scene or without
                self-collision.
        """
        q = np.where(self.free[:, None], self.best, self.nearest)
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
        """Return for all targets whether a hand is free of the pairs of `table` alone.

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


def _shifted_samples(robot: ArmHand, seed: int, numbers: NDArray[np.intp], count: int) -> Array:
    """Sample configurations within the limits, independently of the other targets of a batch.

    One random set of samples is shifted cyclically within the limits by the number of the target.

    Args:
        robot: The robot.
        seed: Seed of the samples.
        numbers: (k,) numbers of the targets.
        count: Number of samples per target.

    Returns:
        (k, count, n) configurations.
    """
    samples = np.random.default_rng(seed).random((count, len(robot.lower)))
    shift = numbers[:, None] * spread_steps(len(robot.lower))
    fraction = (samples + shift[:, None]) % 1.0
    return robot.lower + fraction * (robot.upper - robot.lower)


def resolve_collisions(
    finder_of: Callable[[TargetBatch], AlternativeFinder],
    targets: TargetBatch,
    query: CollisionQuery,
    starts: Array,
    seed: int,
    outcome: Outcome,
    batch: BatchSolution,
    diagnose: bool = True,
) -> BatchSolution:
    """Replace solutions in collision by collision-free ones where possible.

    Args:
        finder_of: Returns the finder for targets of one combination of contact kinds.
        targets: k targets.
        query: Pairs that must not collide.
        starts: (k, n) initial configurations.
        seed: Seed of all random numbers.
        outcome: Outcome of the method.
        batch: Verdicts on the outcome.
        diagnose: Determine the reasons of collisions, see `find_collision_free`.

    Returns:
        The verdicts after the search.
    """
    rank_all = targets.prefer in RANKING_PREFERENCES
    collides = batch.status == Status.COLLISION
    rows = np.flatnonzero(collides | batch.success if rank_all else collides)
    if not len(rows):
        return batch
    begin, q = time.perf_counter(), batch.q.copy()
    reports = np.array(batch.collisions, dtype=object)
    numbers = np.array([targets.row_number(row) for row in rows.tolist()], dtype=np.intp)
    # The number of a target seeds its random numbers: a result does not depend on the batch.
    selected = replace(targets.rows(rows), row_numbers=numbers)
    robot = finder_of(selected.rows(slice(0, 1))).robot
    for _, kind_rows, kind_targets in group_by_kinds(selected):
        chosen = rows[kind_rows]
        result = find_collision_free(
            finder_of(kind_targets),
            kind_targets,
            query.rows(chosen),
            q[chosen],
            starts[chosen],
            seed,
            rank_all,
            diagnose,
        )
        q[chosen] = result.q
        reports[chosen] = result.reports
    seconds = batch.time.copy()
    seconds[rows] += (time.perf_counter() - begin) / len(rows)
    status = np.where(collides, int(Status.SOLVED), outcome.status)
    updated = replace(outcome, q=q, time=seconds, status=status)
    return replace(
        judge_outcome(robot, batch.method, targets, updated, query),
        collisions=tuple(reports.tolist()),
    )


def resolve_single(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    start: Array,
    try_other_hands: bool = False,
) -> tuple[Array, SolvedVerdict, Clearances] | None:
    """Find a collision-free arm for the hand of a single solution.

    The result equals that of `resolve_collisions`, which tries the given hand first.

    Args:
        finder: Finder for the target's contact kinds.
        targets: One target.
        query: Pairs that must not collide.
        q: (n,) solution in collision.
        start: (n,) initial configuration.
        try_other_hands: Try the hands of restarts as well, as an exported solver does.

    Returns:
        The configuration, its verdict and its clearance; None if a full search is needed.
    """
    search = CollisionFreeSearch(finder, targets, query, start[None], 0)
    search.try_hands(q[None], np.zeros(1, dtype=np.intp))
    if try_other_hands:
        for hands, target_index in search.restart_hands():
            search.try_hands(hands, target_index)
    if not search.free[0]:
        return None
    solution = search.best[0]
    verdict = judge_single(finder.robot, targets, solution)
    if verdict is None:
        return None
    clearances = query.check(solution[None])
    return (solution, verdict, clearances) if clearances.free[0] else None
