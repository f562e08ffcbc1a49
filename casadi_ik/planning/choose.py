"""Which of many grasps to take: candidates of all kinds, ranked together.

For candidates of which one answer is enough every hand, branch and value of the redundancy is
looked at, for many at once.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.collision.clearance import ROUNDING, CollisionQuery
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array, Bools
from casadi_ik.files.input_checks.poses import single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse, transform_arrays
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.alternatives import APART, SEEKING, AlternativeFinder, checked_distance
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.collision_free import free_answers
from casadi_ik.solve.engine import Engine
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.request import CLEARANCE, Request
from casadi_ik.solve.solution import Choice, Ranking, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.trials import Deduplicator, largest_per_owner
from casadi_ik.solve.turns import in_nearest_turns, nearest_turns, search_start

Judgement: TypeAlias = str | Callable[[ArmHand, Array], ArrayLike]
"""One of `PREFERENCES`, or what gives configurations (m, n) of a robot their scores (m,)."""


@dataclass(frozen=True)
class ChooseParameters:
    """How many candidates are looked at, and how far.

    Attributes:
        together: Candidates that are worked on at once.
        rounds: Of hands that a candidate gets at most: hands of many motors go on much longer for a
            single grasp, and most of many candidates are out of reach.
        closer: So many times as many answers as are wanted are looked at closer.
    """

    together: int = 1024
    rounds: int = 51
    closer: int = 8


PARAMETERS = ChooseParameters()


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers to some of k candidates.

    Attributes:
        q: (m, n) configurations, free of collision where that was asked for.
        owner: (m,) candidate of each.
        score: (m,) what they are ranked by, higher is better.
        margin: (m,) smallest distance of the arm from its limits: where scores are equal.
        reasons: Why there is none, by candidate; "" where there is one.
    """

    q: Array
    owner: NDArray[np.intp]
    score: Array
    margin: Array
    reasons: NDArray[np.object_]

    @property
    def answered(self) -> Bools:
        """(k,) which candidates have one."""
        return np.asarray(self.reasons == "", dtype=bool)

    @classmethod
    def joined(cls, parts: list[tuple[NDArray[np.intp], Answers]], count: int) -> Answers:
        """Those of all candidates; of one that is there twice the last reason holds.

        Args:
            parts: Numbers of some candidates, and their answers.
            count: How many candidates there are.
        """
        reasons = np.full(count, "", dtype=object)
        for numbers, part in parts:
            reasons[numbers] = part.reasons
        return cls(
            np.concatenate([part.q for _, part in parts]),
            np.concatenate([numbers[part.owner] for numbers, part in parts]),
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
    prefer: Judgement | None = None,
    seed: int = 0,
    fixed: Mapping[str, float] | None = None,
    apart: float = APART,
    per_candidate: int | None = 1,
) -> Ranking:
    """Of many grasps find those that are best to take, and how.

    Of every candidate the different hands that meet its contacts are looked at, with every
    branch of the arm all around its swivel; free of collision where the solver has a scene.
    Which candidates have an answer depends neither on `q0` nor on `prefer`: they order.

    Args:
        solver: A `Solver`.
        grasps: The candidates.
        object_pose: (4, 4) where the object is in the base frame; candidates that do not say
            where theirs is are in its frame. None: they are in the base frame.
        q0: (n,) where the robot is [rad or m]; None is `robot.home`.
        limit: How many answers at most.
        prefer: What comes first: "q0", "limits", "manipulability", "clearance" as for `solve`,
            or a function of the robot and configurations (m, n) that gives their scores (m,),
            higher is better, -inf for never. None: "q0" if q0 is given, else "limits". What is
            given (a palm's hand, `fixed`) is no part of "limits".
        seed: As for `solve`.
        fixed: As for `solve`.
        apart: How different answers are, of one candidate or several: of any two at least one
            actuator differs by this part of its range, 0 to 1. 0: all that are not the same.
        per_candidate: How many answers of one candidate at most; None: any number, and once there
            are `limit` of them no candidate is looked at further.

    Returns:
        The answers, best first, and why candidates have none.

    Raises:
        InputError: No candidates, no rigid object_pose, bad q0, limit, preference or distance,
            or a grasp the robot cannot take.
        UnsupportedError: The method is not hand-first.

    Example:
        >>> ranked = solver.choose([grasp, ik.load_grasp("apple")], prefer="limits")
        >>> len(ranked), ranked.answered, ranked[0].score >= ranked[1].score
        (2, 2, True)
    """
    begin = time.perf_counter()
    engine: Engine = solver._engine
    request: Request = solver._request
    grasps = _candidates(grasps)
    limit = _count(limit, "limit")
    most = None if per_candidate is None else _count(per_candidate, "per_candidate")
    apart, start = checked_distance(apart), request.start(q0)
    word = "own" if callable(prefer) else engine.resolve_preference(prefer, q0 is not None)
    pose = None if object_pose is None else single_pose(object_pose, "object_pose")
    wanted: Preference = _own(prefer, engine.robot) if callable(prefer) else word
    asked = list(_asked(request, grasps, pose, fixed))
    search = _Search(engine, asked, start, wanted, limit, seed)
    parts = list(search.look(np.ones(len(grasps), dtype=bool), thorough=False))
    answers = Answers.joined(parts, len(grasps))
    found = search.best(answers, apart, most)
    # Where several answers of one candidate will do, they may be enough.
    enough = limit if most is None and len(found) >= limit else answers.answered.sum()
    if enough < min(limit, len(grasps)):
        parts += search.look(~answers.answered, thorough=True)
        answers = Answers.joined(parts, len(grasps))
        found = search.best(answers, apart, most)
    seconds = (time.perf_counter() - begin) / len(grasps)
    entries = []
    for row, solution in found:
        owner = int(answers.owner[row])
        grasp = grasps[owner] if pose is None else grasps[owner].in_object_frame().at(pose)
        timed = replace(solution, time=seconds)
        entries.append(Choice(owner, timed, float(answers.score[row]), grasp))
    reasons = [reason for reason in answers.reasons.tolist() if reason]
    return Ranking(
        entries=tuple(entries),
        candidates=len(grasps),
        answered=len(grasps) - len(reasons),
        failures=dict(Counter(reasons).most_common()),
        prefer=word,
    )


def _candidates(grasps: Iterable[Grasp]) -> Sequence[Grasp]:
    """Return the candidates as a sequence.

    Raises:
        InputError: They are not several grasps.
    """
    if isinstance(grasps, (Grasp, str, Mapping)) or not isinstance(grasps, Iterable):
        raise InputError(f"grasps: found {type(grasps).__name__}, expected a sequence of grasps")
    return grasps if isinstance(grasps, Sequence) else list(grasps)


def _count(value: int, name: str) -> int:
    """A number of answers.

    Raises:
        InputError: It is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name}: found {value!r}, expected an integer >= 1")
    return int(value)


def _own(prefer: Callable[[ArmHand, Array], ArrayLike], robot: ArmHand) -> Callable[[Array], Array]:
    """Return a caller's preference with its scores checked."""

    def score(q: Array) -> Array:
        try:
            scores = np.asarray(prefer(robot, q.copy()), dtype=float)
        except Exception as error:  # the caller's function may raise anything
            problem = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise InputError(
                f"prefer: the function raised {problem}; expected scores ({len(q)},)"
            ) from error
        if scores.shape != (len(q),):
            raise InputError(f"prefer: gave shape {scores.shape}, expected ({len(q)},)")
        if np.isnan(scores).any():
            raise InputError("prefer: gave NaN, expected numbers")
        return scores

    return score


def _asked(
    request: Request,
    grasps: Sequence[Grasp],
    pose: Array | None,
    fixed: Mapping[str, float] | None,
) -> Iterator[tuple[NDArray[np.intp], TargetBatch]]:
    """Candidates with the same fingers, tolerances, kinds and object, in the base frame."""
    if not len(grasps):
        raise InputError("grasps: found none, expected at least one")
    groups: dict[object, list[int]] = {}
    for number, grasp in enumerate(grasps):
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasps[{number}]: found {type(grasp).__name__}, expected a Grasp")
        own = tuple((name, one.tolerance) for name, one in grasp.contacts.items())
        key = own, grasp.object, grasp.known_pose is None, grasp.palm is None
        groups.setdefault(key, []).append(number)
    for numbers in groups.values():
        some = [grasps[number] for number in numbers]
        rows = np.array(numbers, dtype=np.intp)
        targets = _placed(request.of_grasps(some, fixed), some, pose)
        for _, of_kinds, alike in group_by_kinds(targets):
            yield rows[of_kinds], alike


def _placed(targets: TargetBatch, grasps: Sequence[Grasp], pose: Array | None) -> TargetBatch:
    """Targets moved as a whole with the object they are on, see `Grasp.at`."""
    if pose is None:
        return targets
    places = [grasp.known_pose for grasp in grasps if grasp.known_pose is not None]
    arrays = {"points": targets.points, "normals": targets.normals, **targets.more}
    for name, array in arrays.items() if places else ():
        # Seen from the object first.
        stack = np.stack(places)
        shift = stack[:, None, :3, 3] if name == "points" else 0.0
        arrays[name] = (array - shift) @ stack[:, :3, :3]
    arrays = transform_arrays(arrays, pose)
    points, normals = arrays.pop("points"), arrays.pop("normals")
    named = grasps[0].object
    at = np.broadcast_to(pose, (len(grasps), 4, 4)) if named or places else None
    palms = targets.palms
    if palms is not None:
        palms = pose @ (np.stack([inverse(place) for place in places]) @ palms if places else palms)
    return replace(
        targets, points=points, normals=normals, more=arrays, object_pose=at, palms=palms
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for answers to all candidates.

    Attributes:
        engine: Solves.
        asked: Candidates that are alike, as numbers and targets.
        start: (n,) where the robot is; with `prefer` it says which arms are better.
        prefer: What is preferred.
        limit: How many answers are wanted.
        seed: Of random arms.
    """

    engine: Engine
    asked: Sequence[tuple[NDArray[np.intp], TargetBatch]]
    start: Array
    prefer: Preference
    limit: int
    seed: int

    def look(self, candidates: Bools, thorough: bool) -> Iterator[tuple[NDArray[np.intp], Answers]]:
        """Answers to some candidates (k,), part by part, with the numbers of these.

        Neither what is preferred nor where the robot is decides which candidates have one.

        Args:
            candidates: (k,) which.
            thorough: Whether to look at all hands that a single grasp would get, after
                `ChooseParameters.rounds` of rounds, instead of those that one round leads to.
        """
        for numbers, targets in self.asked:
            left = numbers[candidates[numbers]]
            if not len(left):
                continue
            some = targets.rows(np.searchsorted(numbers, left))
            some = replace(some, picked=left, prefer="limits")
            engine, query = self.engine.engine_for(some), self.engine.collision_query(some)
            for first in range(0, len(left), PARAMETERS.together):
                rows = np.arange(first, min(first + PARAMETERS.together, len(left)))
                nearby = None if query is None else query.rows(rows)
                part = _Part(self, engine.finder, some.rows(rows), nearby)
                yield left[rows], part.run(thorough)

    def best(self, answers: Answers, apart: float, most: int | None) -> list[tuple[int, Solution]]:
        """Rows of the best that differ from each other, at most so many of a candidate."""
        robot, limit = self.engine.robot, self.limit
        # Of equals that whose arm is farther from its limits, then the first candidate.
        left = np.lexsort((answers.owner, -answers.margin, -answers.score))
        parts = answers.q / (robot.upper - robot.lower)
        solutions: dict[int, Solution] = {}
        while True:
            chosen, rest = list[int](), left
            places = np.full(len(answers.reasons), limit if most is None else most)
            while len(rest) and len(chosen) < limit:
                row = int(rest[0])
                chosen.append(row)
                places[answers.owner[row]] -= 1
                off = np.abs(parts[rest] - parts[row]).max(axis=1)
                rest = rest[(off >= apart) & (off > 0) & (places[answers.owner[rest]] > 0)]
            solutions |= self._judged(answers, np.setdiff1d(chosen, [*solutions]).astype(np.intp))
            failed = [row for row in chosen if not solutions[row].success]
            if not failed:
                return [(row, solutions[row]) for row in chosen]
            left = left[~np.isin(left, failed)]

    def _judged(self, answers: Answers, rows: NDArray[np.intp]) -> dict[int, Solution]:
        """Answers with the verdict on them, which has the last word."""
        found: dict[int, Solution] = {}
        for numbers, targets in self.asked:
            mine = rows[np.isin(answers.owner[rows], numbers)]
            if not len(mine):
                continue
            some = targets.rows(np.searchsorted(numbers, answers.owner[mine]))
            none = np.zeros(len(mine), dtype=np.int64)
            status = np.full(len(mine), int(Status.SOLVED), dtype=np.int64)
            robot = self.engine.robot.description
            near = replace(some, prefer="q0" if self.prefer == "q0" else "limits")
            q = in_nearest_turns(robot, near, answers.q[mine], self.start)
            outcome = Outcome(q, status, none, none, np.zeros(len(mine)), {})
            query, method = self.engine.collision_query(some), self.engine.method.name
            batch = judge_outcome(self.engine.robot, method, some, outcome, query)
            found |= {int(row): batch.solution(i) for i, row in enumerate(mine.tolist())}
        return found


class _Part:
    """Some candidates that are alike."""

    def __init__(
        self,
        search: _Search,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery | None,
    ) -> None:
        self.search, self.finder, self.targets, self.query = search, finder, targets, query
        self.prefer, self.trials = search.prefer, finder.trials
        ends = finder.robot.home, search_start(finder.robot.description, search.start)
        self.home, self.starts = (np.tile(q, (len(targets), 1)) for q in ends)
        self.limits = self.trials.limits(targets)
        fixed = np.full(len(search.start), np.nan) if targets.fixed is None else targets.fixed
        # What is given has no part in what is better.
        self.columns = np.flatnonzero(np.isnan(np.atleast_2d(fixed)).any(axis=0)).tolist()

    def run(self, thorough: bool) -> Answers:
        """Their answers."""
        method = self.trials.method
        rounds = PARAMETERS.rounds if thorough else 1
        outcome = method.run(self.targets, self.home, self.search.seed, False, rounds)
        good = self.trials.solved(self.targets, outcome.q, self.targets.enforce_limits)
        reasons = np.array([Status(int(code)).name for code in outcome.status], dtype=object)
        # A method that is content with what the verdict refuses has come to a standstill.
        reasons[~good & (outcome.status == Status.SOLVED)] = Status.STALLED.name
        rows = np.flatnonzero(good)
        q, pairs = outcome.q[rows], dict[int, tuple[str, str]]()
        if thorough and self.query is not None:
            q, rows, pairs = self._freed(q, rows, self.query)
        q, owner, more = self._answers(*self._hands(q, rows))
        for row, pair in (pairs | more).items():
            reasons[row] = f"{Status.COLLISION.name}: {pair[0]} and {pair[1]}"
        reasons[owner] = ""
        q = self._in_nearest_turns(q, owner)
        return Answers(q, owner, self._score(q, owner), self.finder.arm_margins(q), reasons)

    def _in_nearest_turns(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Return answers in the turns nearest to the start, see `nearest_turns`."""
        bounds = self.limits.first.lower, self.limits.first.upper
        near = self.prefer == "q0"
        return nearest_turns(self.finder.robot.description, q, self.starts[owner], bounds, near)

    def _freed(
        self, q: Array, rows: NDArray[np.intp], query: CollisionQuery
    ) -> tuple[Array, NDArray[np.intp], dict[int, tuple[str, str]]]:
        """What a single grasp would get: free answers; and what is in the way of the others."""
        some, nearby, home = self.targets.rows(rows), query.rows(rows), self.home[rows]
        seed = self.search.seed
        found = free_answers(self.finder, some, nearby, q, home, seed, reasons=False)
        reports = zip(rows.tolist(), found.reports, strict=True)
        pairs = {row: report.pair for row, report in reports if report is not None}
        return found.q[found.free], rows[found.free], pairs

    def _hands(self, q: Array, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Different hands that meet the contacts of candidates, with an arm for each.

        Args:
            q: (m, n) first answers.
            rows: (m,) the candidates that have them.
        """
        if not len(rows) or self.targets.palms is not None:
            return q, rows  # a hand that is given has no other posture
        some = self.targets.rows(rows)
        postures = self.trials.method.postures(some, 0)
        starts = self.limits.clip(self.home)
        owner, *begun = self.trials.hand_rows(self.targets, rows, starts, postures)
        ends, asked = self.trials.run(*begun), self.targets.rows(owner)
        ends[~self.trials.solved(asked, ends, asked.enforce_limits)] = np.nan
        every = np.concatenate([q[:, None], ends.reshape(len(rows), -1, q.shape[1])], axis=1)
        kept: Bools = np.all(np.isfinite(every), axis=2)
        place, which = np.nonzero(kept)
        found, owner = every[place, which], rows[place]
        parts = self.finder.hand_parts(found)
        fresh = Deduplicator(len(rows), parts.shape[1], SEEKING.distinct).add(parts, place)
        return found[fresh], owner[fresh]

    def _answers(
        self, q: Array, owner: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.intp], dict[int, tuple[str, str]]]:
        """The preferred free arm of every branch of hands; and what is in the way of the others."""
        arms, query = self.finder.arm_search, self.query
        surplus = np.full(len(q), np.inf)
        if not len(q):
            return q, owner, {}
        if query is not None:
            nearby = query.rows(owner)
            surplus = (nearby if arms is None else nearby.held).check(q).surplus
        kept = np.flatnonzero(surplus >= -ROUNDING)
        found, whose = q[kept], owner[kept]
        if arms is not None:
            found, hand = self._arms(found, whose, surplus[kept])
            whose = whose[hand]
        if query is None:
            return found, whose, {}
        left = np.flatnonzero(~np.isin(owner, whose))
        # The last word has the hand with most room.
        left = left[largest_per_owner(owner[left], surplus[left], 1)]
        clear = query.rows(owner[left]).check(q[left])
        named = ((row, clear.pair(i)) for i, row in enumerate(owner[left].tolist()))
        return found, whose, {row: pair for row, pair in named if pair is not None}

    def _arms(
        self, q: Array, owner: NDArray[np.intp], surplus: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Free arms of hands, and whose hand it is; closer where the best of them are."""
        found, hand = self._preferred(q, owner, surplus, False)
        score = self._score(found, owner[hand])
        best = np.argsort(-score, kind="stable")[: PARAMETERS.closer * self.search.limit]
        again = np.unique(hand[best])
        more, mine = self._preferred(q[again], owner[again], surplus[again], True)
        others = ~np.isin(hand, again)
        return np.concatenate([found[others], more]), np.concatenate([hand[others], again[mine]])

    def _preferred(
        self, q: Array, owner: NDArray[np.intp], surplus: Array, closer: bool
    ) -> tuple[Array, NDArray[np.intp]]:
        arms = self.finder.arm_search
        assert arms is not None
        query = None if self.query is None else self.query.swung.rows(owner)
        bounds = self.limits.first.lower, self.limits.first.upper
        starts = self.starts[owner]
        found = arms.choose(q, starts, bounds, self.prefer, query, surplus, True, closer)
        if query is None or self.prefer != CLEARANCE:
            return found.q, found.owner
        assert self.query is not None
        free = self.query.rows(owner[found.owner]).free(found.q)
        return found.q[free], found.owner[free]

    def _score(self, q: Array, owner: NDArray[np.intp]) -> Array:
        if not len(q):
            return np.zeros(0)
        surplus = np.zeros(len(q))
        if self.prefer == CLEARANCE and self.query is not None:
            surplus = self.query.rows(owner).check(q).surplus
        return self.finder.score(q, self.starts[owner], self.prefer, self.columns, surplus)
