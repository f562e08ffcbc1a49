"""Ranking of many candidate grasps by their best collision-free solutions.

Hands, arm branches and redundancies of all candidates are searched in batches.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks import single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse, transform_arrays
from casadi_ik.model.targets import CLEARANCE, TargetBatch
from casadi_ik.solve.alternatives import (
    ALTERNATIVES,
    DEFAULT_SEPARATION,
    AlternativeFinder,
    check_separation,
)
from casadi_ik.solve.arm_search import ArmSearch, Preference
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.collision_free import find_collision_free
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.free_rotations import FreeRotations, RotationSearch
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.row_selection import Deduplicator, largest_per_owner
from casadi_ik.solve.solution import Choice, Ranking, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_builder import TargetBuilder
from casadi_ik.solve.turns import in_nearest_turns, nearest_turns, search_start

RankingPreference: TypeAlias = str | Callable[[ArmHand, Array], ArrayLike]
"""Name in `PREFERENCES`, or function of a robot and configurations (m, n) to scores (m,)."""


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


def choose(
    solver: Any,
    grasps: Iterable[Grasp],
    object_pose: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    limit: int = 10,
    prefer: RankingPreference | None = None,
    seed: int = 0,
    fixed: Mapping[str, float] | None = None,
    apart: float = DEFAULT_SEPARATION,
    per_candidate: int | None = 1,
    best_effort: bool | BestEffort = False,
) -> Ranking:
    """Rank candidate grasps and return the best feasible solutions.

    The search covers all hand postures that meet the contacts of a candidate, every branch of the
    arm and its whole redundancy. With a scene, solutions are collision-free. `q0` and `prefer`
    affect only the ranking, not whether a candidate has a solution.

    Args:
        solver: A `Solver`.
        grasps: The candidates.
        object_pose: (4, 4) pose of the object in the base frame. Candidates without a pose of
            their object are in its frame. None: candidates are in the base frame.
        q0: (n,) initial configuration [rad or m]; None: `robot.home`.
        limit: Maximum number of solutions.
        prefer: Ranking: "q0", "limits", "manipulability", "clearance" as for `solve`, or a
            function from the robot and configurations (m, n) to scores (m,), where higher is
            better and -inf excludes. None: "q0" if q0 is set, else "limits". "limits" ignores
            fixed motors and prescribed hand postures.
        seed: As for `solve`.
        fixed: As for `solve`.
        apart: Minimum difference of two solutions: at least one actuator differs by this fraction
            of its range, 0 to 1. 0: solutions must not be equal.
        per_candidate: Maximum number of solutions per candidate. None: unlimited; the search ends
            after `limit` solutions.
        best_effort: Whether to return nearest configurations, see `solve`, if no candidate has a
            solution; they are ranked by `Solution.error_ratio`, the least first, and the ranking's
            `prefer` is "nearest".

    Returns:
        The solutions, best first, and the number of unsolved candidates by reason.

    Raises:
        InputError: There are no candidates, `object_pose` is not rigid, another argument is
            invalid, or a grasp has fingers that the robot does not have.
        UnsupportedError: The method is not hand-first.

    Example:
        >>> ranked = solver.choose([grasp, ik.load_grasp("apple")], prefer="limits")
        >>> len(ranked), ranked.answered, ranked[0].score >= ranked[1].score
        (2, 2, True)
    """
    begin = time.perf_counter()
    engine: Engine = solver._engine
    builder: TargetBuilder = solver._target_builder
    grasps = _candidates(grasps)
    limit = _positive_count(limit, "limit")
    max_per_candidate = limit
    if per_candidate is not None:
        max_per_candidate = _positive_count(per_candidate, "per_candidate")
    apart, start = check_separation(apart), builder.start(q0)
    name = "own" if callable(prefer) else builder.preference(prefer, q0 is not None)
    pose = None if object_pose is None else single_pose(object_pose, "object_pose")
    preference: Preference = _checked_scores(prefer, engine.robot) if callable(prefer) else name
    groups = list(_target_groups(builder, grasps, pose, fixed, seed))
    search = _Search(engine, groups, start, preference, limit)
    parts = list(search.solve(np.ones(len(grasps), dtype=bool), thorough=False))
    solutions = CandidateSolutions.concatenate(parts, len(grasps))
    best = search.best(solutions, apart, max_per_candidate)
    # Without a limit per candidate, the search ends after `limit` solutions.
    is_complete = per_candidate is None and len(best) >= limit
    solved_count = limit if is_complete else solutions.is_solved.sum()
    if solved_count < min(limit, len(grasps)):
        parts += search.solve(~solutions.is_solved, thorough=True)
        solutions = CandidateSolutions.concatenate(parts, len(grasps))
        best = search.best(solutions, apart, max_per_candidate)
    ranked = [
        (int(solutions.candidate[row]), solution, float(solutions.score[row]))
        for row, solution in best
    ]
    if best_effort and not ranked:
        ranked, name = search.nearest(best_effort), "nearest"
    seconds = (time.perf_counter() - begin) / len(grasps)
    entries = []
    for candidate, solution, score in ranked:
        grasp = grasps[candidate]
        if pose is not None:
            grasp = grasp.in_object_frame().at(pose)
        entries.append(Choice(candidate, replace(solution, time=seconds), score, grasp))
    reasons = [reason for reason in solutions.reasons.tolist() if reason]
    return Ranking(
        entries=tuple(entries),
        candidates=len(grasps),
        answered=len(grasps) - len(reasons),
        failures=dict(Counter(reasons).most_common()),
        prefer=name,
    )


def _candidates(grasps: Iterable[Grasp]) -> Sequence[Grasp]:
    """Return the candidates as a sequence.

    Raises:
        InputError: `grasps` is not a sequence of grasps.
    """
    if isinstance(grasps, (Grasp, str, Mapping)) or not isinstance(grasps, Iterable):
        raise InputError(f"grasps: found {type(grasps).__name__}, expected a sequence of grasps")
    return grasps if isinstance(grasps, Sequence) else list(grasps)


def _positive_count(value: int, name: str) -> int:
    """Return a count as an integer.

    Raises:
        InputError: The value is not an integer >= 1.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name}: found {value!r}, expected an integer >= 1")
    return int(value)


def _checked_scores(
    prefer: Callable[[ArmHand, Array], ArrayLike], robot: ArmHand
) -> Callable[[Array], Array]:
    """Return a user-defined preference with a check of its scores."""

    def score(q: Array) -> Array:
        try:
            scores = np.asarray(prefer(robot, q.copy()), dtype=float)
        except Exception as error:  # a user-defined function may raise any exception
            problem = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise InputError(
                f"prefer: the function raised {problem}; expected scores ({len(q)},)"
            ) from error
        if scores.shape != (len(q),):
            raise InputError(f"prefer: scores have shape {scores.shape}; expected ({len(q)},)")
        if np.isnan(scores).any():
            raise InputError("prefer: scores are NaN; expected numbers")
        return scores

    return score


def _target_groups(
    builder: TargetBuilder,
    grasps: Sequence[Grasp],
    pose: Array | None,
    fixed: Mapping[str, float] | None,
    seed: int,
) -> Iterator[tuple[NDArray[np.intp], TargetBatch]]:
    """Yield groups of candidates with equal fingers, tolerances, contact kinds and object.

    Yields:
        Indices of candidates, and their targets in the base frame.

    Raises:
        InputError: There are no candidates, or a candidate is not a `Grasp`.
    """
    if not len(grasps):
        raise InputError("grasps: the sequence is empty; expected at least one grasp")
    groups: dict[object, list[int]] = {}
    for number, grasp in enumerate(grasps):
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasps[{number}]: found {type(grasp).__name__}, expected a Grasp")
        fingers = tuple((name, contact.tolerance) for name, contact in grasp.contacts.items())
        key = fingers, grasp.object, grasp.known_pose is None, grasp.palm is None
        groups.setdefault(key, []).append(number)
    for numbers in groups.values():
        group = [grasps[number] for number in numbers]
        indices = np.array(numbers, dtype=np.intp)
        targets = _with_object_pose(builder.from_grasps(group, fixed=fixed, seed=seed), group, pose)
        for _, kind_rows, kind_targets in group_by_kinds(targets):
            yield indices[kind_rows], kind_targets


def _with_object_pose(
    targets: TargetBatch, grasps: Sequence[Grasp], pose: Array | None
) -> TargetBatch:
    """Move targets rigidly with their object, see `Grasp.at`."""
    if pose is None:
        return targets
    known_poses = [grasp.known_pose for grasp in grasps if grasp.known_pose is not None]
    vectors = {"points": targets.points, "normals": targets.normals, **targets.extra_vectors}
    for name, array in vectors.items() if known_poses else ():
        # Transform base-frame vectors into the object frame.
        stack = np.stack(known_poses)
        shift = stack[:, None, :3, 3] if name == "points" else 0.0
        vectors[name] = (array - shift) @ stack[:, :3, :3]
    vectors = transform_arrays(vectors, pose)
    points, normals = vectors.pop("points"), vectors.pop("normals")
    has_object = bool(grasps[0].object or known_poses)
    object_poses = np.broadcast_to(pose, (len(grasps), 4, 4)) if has_object else None
    palms = targets.palms
    if palms is not None:
        if known_poses:
            palms = np.stack([inverse(known_pose) for known_pose in known_poses]) @ palms
        palms = pose @ palms
    return replace(
        targets,
        points=points,
        normals=normals,
        extra_vectors=vectors,
        object_pose=object_poses,
        palms=palms,
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for solutions of all candidates.

    Attributes:
        engine: The engine.
        groups: Indices and targets of candidates with equal fingers and contact kinds.
        start: (n,) initial configuration, the reference of the preference "q0".
        prefer: The preference.
        limit: Number of solutions to return.
    """

    engine: Engine
    groups: Sequence[tuple[NDArray[np.intp], TargetBatch]]
    start: Array
    prefer: Preference
    limit: int

    def solve(
        self, is_selected: Bools, thorough: bool
    ) -> Iterator[tuple[NDArray[np.intp], CandidateSolutions]]:
        """Yield the solutions of selected candidates in chunks, with their indices.

        Whether a candidate has a solution does not depend on the preference or the start.

        Args:
            is_selected: (k,) True for the candidates to solve.
            thorough: True for up to `ChooseParameters.max_restarts` restarts, False for a single
                restart.
        """
        for indices, targets in self.groups:
            selected = indices[is_selected[indices]]
            if not len(selected):
                continue
            group = targets.rows(np.searchsorted(indices, selected))
            group = replace(group, row_numbers=selected, prefer="limits")
            engine, query = self.engine.engine_for(group), self.engine.collision_query(group)
            for first in range(0, len(selected), CHOOSE_PARAMETERS.chunk_size):
                last = min(first + CHOOSE_PARAMETERS.chunk_size, len(selected))
                rows = np.arange(first, last)
                chunk_query = None if query is None else query.rows(rows)
                chunk = _CandidateChunk(self, engine.finder, group.rows(rows), chunk_query)
                yield selected[rows], chunk.solve(thorough)

    def best(
        self, solutions: CandidateSolutions, min_difference: float, max_per_candidate: int
    ) -> list[tuple[int, Solution]]:
        """Return the best distinct solutions and their rows.

        Args:
            solutions: The solutions.
            min_difference: Minimum difference of two solutions, see `apart` of `choose`.
            max_per_candidate: Maximum number of solutions per candidate.
        """
        robot, limit = self.engine.robot, self.limit
        # Equal scores are ranked by the limit margin of the arm, then by the candidate.
        order = np.lexsort((solutions.candidate, -solutions.margin, -solutions.score))
        fractions = solutions.q / (robot.upper - robot.lower)
        verified: dict[int, Solution] = {}
        while True:
            best_rows, remaining = list[int](), order
            quota = np.full(len(solutions.reasons), max_per_candidate)
            while len(remaining) and len(best_rows) < limit:
                row = int(remaining[0])
                best_rows.append(row)
                quota[solutions.candidate[row]] -= 1
                difference = np.abs(fractions[remaining] - fractions[row]).max(axis=1)
                is_distinct = (difference >= min_difference) & (difference > 0)
                remaining = remaining[is_distinct & (quota[solutions.candidate[remaining]] > 0)]
            new_rows = np.setdiff1d(best_rows, [*verified]).astype(np.intp)
            verified |= self._verify(solutions, new_rows)
            failed = [row for row in best_rows if not verified[row].success]
            if not failed:
                return [(row, verified[row]) for row in best_rows]
            order = order[~np.isin(order, failed)]

    def nearest(self, best_effort: bool | BestEffort) -> list[tuple[int, Solution, float]]:
        """Return the candidates with the least error ratios, their nearest solutions and scores.

        The score is the negative error ratio.
        """
        nearest = []
        for indices, targets in self.groups:
            group = targets.starting_at(self.start)
            batch = self.engine.solve(group, SolveOptions(best_effort=best_effort))
            rows = np.flatnonzero(batch.status == Status.NEAREST).tolist()
            ratios = batch.error_ratio
            nearest += [(int(indices[i]), batch.solution(i), -float(ratios[i])) for i in rows]
        return sorted(nearest, key=lambda entry: (-entry[2], entry[0]))[: self.limit]

    def _verify(self, solutions: CandidateSolutions, rows: NDArray[np.intp]) -> dict[int, Solution]:
        """Return the checked solutions by row."""
        verified: dict[int, Solution] = {}
        for indices, targets in self.groups:
            group_rows = rows[np.isin(solutions.candidate[rows], indices)]
            if not len(group_rows):
                continue
            candidates = solutions.candidate[group_rows]
            group = targets.rows(np.searchsorted(indices, candidates))
            zeros = np.zeros(len(group_rows), dtype=np.int64)
            status = np.full(len(group_rows), int(Status.SOLVED), dtype=np.int64)
            robot = self.engine.robot.description
            with_preference = replace(group, prefer="q0" if self.prefer == "q0" else "limits")
            with_preference = with_preference.starting_at(self.start)
            q = in_nearest_turns(robot, with_preference, solutions.q[group_rows])
            outcome = Outcome(q, status, zeros, zeros, np.zeros(len(group_rows)), {})
            query, method = self.engine.collision_query(group), self.engine.method.name
            batch = judge_outcome(self.engine.robot, method, group, outcome, query)
            verified |= {int(row): batch.solution(i) for i, row in enumerate(group_rows.tolist())}
        return verified


class _CandidateChunk:
    """Candidates with equal fingers and contact kinds that are solved together."""

    def __init__(
        self,
        search: _Search,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery | None,
    ) -> None:
        self.search, self.finder, self.targets, self.query = search, finder, targets, query
        self.prefer, self.subproblems = search.prefer, finder.subproblems
        starts = finder.robot.home, search_start(finder.robot.description, search.start)
        self.home, self.starts = (np.tile(q, (len(targets), 1)) for q in starts)
        self.limits = self.subproblems.limits(targets)
        fixed = np.full(len(search.start), np.nan) if targets.fixed is None else targets.fixed
        # Motors that are fixed in all targets are excluded from the limit margin.
        self.columns = np.flatnonzero(np.isnan(np.atleast_2d(fixed)).any(axis=0)).tolist()

    def solve(self, thorough: bool) -> CandidateSolutions:
        """Return the solutions, see `_Search.solve`."""
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
        solutions, solution_candidate = self._with_free_rotations(
            (q, candidate), (solutions, solution_candidate)
        )
        if query is None:
            return solutions, solution_candidate, {}
        failed = np.flatnonzero(~np.isin(candidate, solution_candidate))
        # The hand with the largest clearance names the colliding pair.
        failed = failed[largest_per_owner(candidate[failed], surplus[failed], 1)]
        clearances = query.rows(candidate[failed]).check(q[failed])
        pairs = ((row, clearances.pair(i)) for i, row in enumerate(candidate[failed].tolist()))
        return solutions, solution_candidate, {row: p for row, p in pairs if p is not None}

    def _with_free_rotations(
        self, hands: tuple[Array, NDArray[np.intp]], solutions: tuple[Array, NDArray[np.intp]]
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return solutions and those with the preferred rotations of palms, where they are free.

        For a multi-arm robot the arms of all sides are searched successively.

        Args:
            hands: (m, n) configurations with all distinct hands, and indices of their candidates.
            solutions: (p, n) collision-free solutions, and indices of their candidates.
        """
        robot, finder = self.finder.robot, self.finder
        count = CHOOSE_PARAMETERS.refined_factor * self.search.limit
        if finder.arm_search is not None:
            fingers = list(range(len(robot.fingers)))
            search = self._rotation_search(finder.arm_search, None, finder.hand, fingers)
            q, candidate = hands
            rows = np.flatnonzero(search.rotations.is_free[candidate])
            return _concatenate(solutions, search.run(q[rows], candidate[rows], count))
        sides = zip(robot.description.sides, robot.description.side_actuators, strict=True)
        for arms, (side, (_, hand)) in zip(finder.side_searches, sides, strict=False):
            fingers = [robot.fingers.index(name) for name in side.fingers]
            search = self._rotation_search(arms, side.name, list(hand), fingers)
            q, candidate = solutions
            order = np.argsort(-self._score(q, candidate), kind="stable")
            solutions = _concatenate(solutions, search.run(q[order], candidate[order], count))
        return solutions

    def _rotation_search(
        self, arms: ArmSearch, side: str | None, hand: list[int], fingers: list[int]
    ) -> RotationSearch:
        """Return the search over the rotations of one hand."""
        return RotationSearch(
            self.subproblems,
            arms,
            side,
            hand,
            fingers,
            FreeRotations.of_targets(self.finder.robot.description, self.targets, fingers),
            self.targets,
            self.starts,
            self.prefer,
            self.query,
        )

    def _arms(
        self, q: Array, candidate: NDArray[np.intp], surplus: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return collision-free arms and their hands; the best hands are refined."""
        arms, hand = self._search_arms(q, candidate, surplus, False)
        score = self._score(arms, candidate[hand])
        count = CHOOSE_PARAMETERS.refined_factor * self.search.limit
        best = np.argsort(-score, kind="stable")[:count]
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


def _concatenate(
    a: tuple[Array, NDArray[np.intp]], b: tuple[Array, NDArray[np.intp]]
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations and indices of their candidates of both."""
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
