"""Search for the solutions of candidate grasps that are solved together.

All hand postures that meet the contacts of a candidate are combined with every branch of the arm
and its redundancy, and with the rotations of the palm that the contacts leave free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.model.targets import CLEARANCE, TargetBatch
from casadi_ik.solve.alternatives import ALTERNATIVES, AlternativeFinder
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.collision_free import find_collision_free
from casadi_ik.solve.row_selection import Deduplicator, largest_per_owner
from casadi_ik.solve.status import Status
from casadi_ik.solve.turns import nearest_turns, search_start


@dataclass(frozen=True)
class ChooseParameters:
    """Effort of the ranking of candidates.

    Attributes:
        chunk_size: Number of candidates that are searched together.
        max_restarts: Maximum number of restarts per candidate. A solve of a single grasp permits
            more, but among many candidates most are out of reach.
        refined_factor: Number of arm configurations that are refined, as a multiple of the number
            of solutions to return.
    """

    chunk_size: int = 1024
    max_restarts: int = 51
    refined_factor: int = 8


CHOOSE_PARAMETERS = ChooseParameters()


@dataclass(frozen=True, eq=False)
class CandidateSolutions:
    """Solutions of k candidates.

    Attributes:
        q: (m, n) configurations; collision-free if the solver has a scene.
        candidate: (m,) index of the candidate of each.
        score: (m,) score by which they are ranked; higher is better.
        margin: (m,) limit margin of the arm, which ranks equal scores.
        reasons: (k,) reason why a candidate has no solution; "" if it has one.
    """

    q: Array
    candidate: NDArray[np.intp]
    score: Array
    margin: Array
    reasons: NDArray[np.object_]

    @property
    def is_solved(self) -> Bools:
        """True for the candidates with a solution, (k,)."""
        return np.asarray(self.reasons == "", dtype=bool)

    @classmethod
    def concatenate(
        cls, parts: list[tuple[NDArray[np.intp], CandidateSolutions]], count: int
    ) -> CandidateSolutions:
        """Concatenate the solutions of parts of the candidates.

        Args:
            parts: Indices of candidates, and their solutions. The last reason of a candidate is
                kept.
            count: Number of all candidates.
        """
        reasons = np.full(count, "", dtype=object)
        for indices, part in parts:
            reasons[indices] = part.reasons
        return cls(
            np.concatenate([part.q for _, part in parts]),
            np.concatenate([indices[part.candidate] for indices, part in parts]),
            np.concatenate([part.score for _, part in parts]),
            np.concatenate([part.margin for _, part in parts]),
            reasons,
        )


class CandidateSearch:
    """Search for the solutions of candidates with equal fingers and contact kinds."""

    def __init__(
        self,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery | None,
        start: Array,
        prefer: Preference,
        limit: int,
    ) -> None:
        """Prepare the search.

        Args:
            finder: Finder of the arms of a hand.
            targets: The candidates.
            query: Pairs that must not collide; None: no check.
            start: (n,) initial configuration, the reference of the preference "q0".
            prefer: The preference.
            limit: Number of solutions of all candidates to return.
        """
        self.finder, self.targets, self.query = finder, targets, query
        self.prefer, self.subproblems = prefer, finder.subproblems
        self.max_refined = CHOOSE_PARAMETERS.refined_factor * limit
        starts = finder.robot.home, search_start(finder.robot.description, start)
        self.home, self.starts = (np.tile(q, (len(targets), 1)) for q in starts)
        self.limits = self.subproblems.limits(targets)
        fixed = np.full(len(start), np.nan) if targets.fixed is None else targets.fixed
        # Motors that are fixed in all targets are excluded from the limit margin.
        self.columns = np.flatnonzero(np.isnan(np.atleast_2d(fixed)).any(axis=0)).tolist()

    def solve(self, thorough: bool) -> CandidateSolutions:
        """Return the solutions.

        Args:
            thorough: True for up to `ChooseParameters.max_restarts` restarts, False for a single
                restart.
        """
        method = self.subproblems.method
        restarts = CHOOSE_PARAMETERS.max_restarts if thorough else 1
        outcome = method.run(self.targets, rounds=restarts)
        solved = self.subproblems.solved(self.targets, outcome.q, self.targets.enforce_limits)
        reasons = np.array([Status(int(code)).name for code in outcome.status], dtype=object)
        # A method's SOLVED that fails the check becomes STALLED.
        reasons[~solved & (outcome.status == Status.SOLVED)] = Status.STALLED.name
        rows = np.flatnonzero(solved)
        q, pairs = outcome.q[rows], dict[int, tuple[str, str]]()
        if thorough and self.query is not None:
            q, rows, pairs = self._resolve_collisions(q, rows, self.query)
        q, candidate, further_pairs = self._solutions(*self._hands(q, rows))
        for row, pair in (pairs | further_pairs).items():
            reasons[row] = f"{Status.COLLISION.name}: {pair[0]} and {pair[1]}"
        reasons[candidate] = ""
        q = self._in_nearest_turns(q, candidate)
        score, margin = self._score(q, candidate), self.finder.arm_margins(q)
        return CandidateSolutions(q, candidate, score, margin, reasons)

    def _in_nearest_turns(self, q: Array, candidate: NDArray[np.intp]) -> Array:
        """Return solutions in the turns nearest to the start, see `nearest_turns`."""
        bounds = self.limits.first.lower, self.limits.first.upper
        prefers_start = self.prefer == "q0"
        robot, starts = self.finder.robot.description, self.starts[candidate]
        return nearest_turns(robot, q, starts, bounds, prefers_start)

    def _resolve_collisions(
        self, q: Array, rows: NDArray[np.intp], query: CollisionQuery
    ) -> tuple[Array, NDArray[np.intp], dict[int, tuple[str, str]]]:
        """Search for collision-free solutions as for a single grasp.

        Returns:
            Collision-free solutions, their candidates, and the colliding pair of each candidate
            without one.
        """
        result = find_collision_free(
            self.finder,
            self.targets.rows(rows),
            query.rows(rows),
            q,
            diagnose=False,
        )
        reports = zip(rows.tolist(), result.reports, strict=True)
        pairs = {row: report.pair for row, report in reports if report is not None}
        return result.q[result.free], rows[result.free], pairs

    def _hands(self, q: Array, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Return distinct hand postures that meet the contacts, each with an arm configuration.

        Args:
            q: (m, n) first solutions.
            rows: (m,) indices of their candidates.

        Returns:
            (p, n) configurations and (p,) indices of their candidates.
        """
        if not len(rows) or self.targets.palms is not None:
            return q, rows  # A target with a palm pose has a single hand posture.
        postures = self.subproblems.method.postures(self.targets.rows(rows), 0)
        targets = self.targets.starting_at(self.limits.clip(self.home))
        candidate, *initial = self.subproblems.hand_rows(targets, rows, postures)
        refined_q, targets = self.subproblems.run(*initial), self.targets.rows(candidate)
        refined_q[~self.subproblems.solved(targets, refined_q, targets.enforce_limits)] = np.nan
        solutions = np.concatenate(
            [q[:, None], refined_q.reshape(len(rows), -1, q.shape[1])], axis=1
        )
        is_solved: Bools = np.all(np.isfinite(solutions), axis=2)
        row, posture = np.nonzero(is_solved)
        hands, candidate = solutions[row, posture], rows[row]
        coordinates = self.finder.hand_coordinates(hands)
        distinct = Deduplicator(len(rows), coordinates.shape[1], ALTERNATIVES.min_difference)
        is_new = distinct.add(coordinates, row)
        return hands[is_new], candidate[is_new]

    def _solutions(
        self, q: Array, candidate: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.intp], dict[int, tuple[str, str]]]:
        """Return the preferred collision-free arm configuration of every branch, by hand posture.

        Returns:
            Configurations, their candidates, and the colliding pairs of candidates without one.
        """
        arms, query = self.finder.arm_search, self.query
        surplus = np.full(len(q), np.inf)
        if not len(q):
            return q, candidate, {}
        if query is not None:
            hand_query = query.rows(candidate)
            if arms is not None:
                hand_query = hand_query.hand_pairs
            surplus = hand_query.check(q).surplus
        free_rows = np.flatnonzero(surplus >= -DISTANCE_ROUNDING)
        solutions, solution_candidate = q[free_rows], candidate[free_rows]
        if arms is not None:
            solutions, hand = self._arms(solutions, solution_candidate, surplus[free_rows])
            solution_candidate = solution_candidate[hand]
        solutions, solution_candidate = self.finder.with_free_rotations(
            self.targets,
            (q, candidate),
            (solutions, solution_candidate),
            (self.starts, self.prefer, query),
            self.max_refined,
        )
        if query is None:
            return solutions, solution_candidate, {}
        failed = np.flatnonzero(~np.isin(candidate, solution_candidate))
        # The hand with the largest clearance names the colliding pair.
        failed = failed[largest_per_owner(candidate[failed], surplus[failed], 1)]
        clearances = query.rows(candidate[failed]).check(q[failed])
        pairs = ((row, clearances.pair(i)) for i, row in enumerate(candidate[failed].tolist()))
        return solutions, solution_candidate, {row: p for row, p in pairs if p is not None}

    def _arms(
        self, q: Array, candidate: NDArray[np.intp], surplus: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return collision-free arms and their hands; the best hands are refined."""
        arms, hand = self._search_arms(q, candidate, surplus, False)
        score = self._score(arms, candidate[hand])
        best = np.argsort(-score, kind="stable")[: self.max_refined]
        best_hands = np.unique(hand[best])
        refined, refined_hand = self._search_arms(
            q[best_hands], candidate[best_hands], surplus[best_hands], True
        )
        is_other = ~np.isin(hand, best_hands)
        return (
            np.concatenate([arms[is_other], refined]),
            np.concatenate([hand[is_other], best_hands[refined_hand]]),
        )

    def _search_arms(
        self, q: Array, candidate: NDArray[np.intp], surplus: Array, refine: bool
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return the preferred collision-free arm of every branch of hands, and its hand."""
        search = self.finder.arm_search
        assert search is not None
        query = None if self.query is None else self.query.arm_pairs.rows(candidate)
        bounds = self.limits.first.lower, self.limits.first.upper
        starts = self.starts[candidate]
        arms = search.choose(q, starts, bounds, self.prefer, query, surplus, True, refine)
        if query is None or self.prefer != CLEARANCE:
            return arms.q, arms.hand_index
        assert self.query is not None
        is_free = self.query.rows(candidate[arms.hand_index]).free(arms.q)
        return arms.q[is_free], arms.hand_index[is_free]

    def _score(self, q: Array, candidate: NDArray[np.intp]) -> Array:
        if not len(q):
            return np.zeros(0)
        surplus = np.zeros(len(q))
        if self.prefer == CLEARANCE and self.query is not None:
            surplus = self.query.rows(candidate).check(q).surplus
        return self.finder.score(q, self.starts[candidate], self.prefer, self.columns, surplus)
