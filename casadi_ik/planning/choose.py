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

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks import single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse, transform_arrays
from casadi_ik.model.targets import TargetBatch
from casadi_ik.planning.candidate_search import (
    CHOOSE_PARAMETERS,
    CandidateSearch,
    CandidateSolutions,
)
from casadi_ik.solve.alternatives import DEFAULT_SEPARATION, check_separation
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.solution import Choice, Ranking, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_builder import TargetBuilder
from casadi_ik.solve.turns import in_nearest_turns

RankingPreference: TypeAlias = str | Callable[[ArmHand, Array], ArrayLike]
"""Name in `PREFERENCES`, or function of a robot and configurations (m, n) to scores (m,)."""


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
                search = CandidateSearch(
                    engine.finder,
                    group.rows(rows),
                    chunk_query,
                    self.start,
                    self.prefer,
                    self.limit,
                )
                yield selected[rows], search.solve(thorough)

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
