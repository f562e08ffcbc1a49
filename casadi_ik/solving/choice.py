"""Which of many grasps to take: candidates of all kinds, ranked together."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.pose import inverse, moved, one_pose
from casadi_ik.problem.contacts.arrays import by_kinds
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.preference import preference
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.questions import Questions
from casadi_ik.problem.ranking import Choice, Ranking
from casadi_ik.problem.solution import Solution
from casadi_ik.problem.status import Status
from casadi_ik.solving.alternatives.choosing import Answers, answers_of
from casadi_ik.solving.alternatives.finder import APART, checked_distance
from casadi_ik.solving.alternatives.swings import Preference
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.solved_part import judged

Judgement: TypeAlias = str | Callable[[ArmHand, Array], ArrayLike]
"""One of `PREFERENCES`, or what gives configurations (m, n) of a robot their scores (m,)."""

BLOCK = 64
"""Answers that are judged at once."""


def choose(
    engine: Engine,
    questions: Questions,
    grasps: Sequence[Grasp],
    object_pose: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    limit: int = 10,
    prefer: Judgement | None = None,
    seed: int = 0,
    fixed: Mapping[str, float] | None = None,
    apart: float = APART,
) -> Ranking:
    """Rank answers to many grasps, see `Solver.choose`.

    Raises:
        InputError: See there.
        UnsupportedError: The method is not hand-first.
    """
    begin = time.perf_counter()
    if not isinstance(limit, (int, np.integer)) or limit < 1:
        raise InputError(f"limit: found {limit!r}, expected an integer >= 1")
    apart, start = checked_distance(apart), questions.start(q0)
    word = "own" if callable(prefer) else engine.preference(prefer, q0 is not None)
    usual = preference(None, q0 is not None)
    pose = None if object_pose is None else one_pose(object_pose, "object_pose")
    asked = list(_asked(questions, grasps, pose, fixed, usual))
    wanted: Preference = _own(prefer, engine.robot) if callable(prefer) else word
    for thorough in (False, True):
        found = [
            answers_of(
                engine.kinds_of(some).freer,
                some,
                engine.around(some),
                start,
                wanted,
                seed,
                thorough,
            ).moved(rows)
            for rows, problems in asked
            for rows, some in _of_kinds(rows, problems)
        ]
        if any(len(part.q) for part in found) or engine.check is None:
            break
    reasons = [reason for part in found for reason in part.reasons if reason]
    seconds = (time.perf_counter() - begin) / len(grasps)
    ranked = _Ranked(engine, asked, found, apart, seconds)
    return Ranking(
        entries=tuple(ranked.best(int(limit))),
        candidates=len(grasps),
        answered=len(grasps) - len(reasons),
        failures=dict(Counter(reasons).most_common()),
        prefer=word,
    )


def _own(prefer: Callable[[ArmHand, Array], ArrayLike], robot: ArmHand) -> Callable[[Array], Array]:
    """A preference of one's own, its answers checked."""

    def score(q: Array) -> Array:
        found = np.asarray(prefer(robot, q.copy()), dtype=float)
        if found.shape != (len(q),):
            raise InputError(f"prefer: gave shape {found.shape}, expected ({len(q)},)")
        if np.isnan(found).any():
            raise InputError("prefer: gave NaN, expected numbers")
        return found

    return score


def _asked(
    questions: Questions,
    grasps: Sequence[Grasp],
    pose: Array | None,
    fixed: Mapping[str, float] | None,
    prefer: str,
) -> Iterator[tuple[NDArray[np.intp], Problems]]:
    """Candidates with the same fingers, tolerances and object together, in the base frame."""
    if not len(grasps):
        raise InputError("grasps: found none, expected at least one")
    groups: dict[object, list[int]] = {}
    for number, grasp in enumerate(grasps):
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasps[{number}]: found {type(grasp).__name__}, expected a Grasp")
        own = tuple((name, one.tolerance) for name, one in grasp.contacts.items())
        key = own, grasp.object, grasp.object_pose is None
        groups.setdefault(key, []).append(number)
    for numbers in groups.values():
        some = [grasps[number] for number in numbers]
        problems = questions.of_grasps(some, fixed, prefer)
        yield np.array(numbers, dtype=np.intp), _placed(problems, some, pose)


def _placed(problems: Problems, grasps: Sequence[Grasp], pose: Array | None) -> Problems:
    """Targets moved as a whole with the object they are on, see `Grasp.at`."""
    if pose is None:
        return problems
    places = [grasp.object_pose for grasp in grasps if grasp.object_pose is not None]
    motions = [pose @ inverse(place) for place in places] if places else [pose] * len(grasps)
    motion = np.stack(motions)
    arrays = {"points": problems.points, "normals": problems.normals, **problems.more}
    if not places:
        arrays = moved(arrays, pose)
    else:
        turn = motion[:, :3, :3].transpose(0, 2, 1)
        arrays = {name: array @ turn for name, array in arrays.items()}
        arrays["points"] = arrays["points"] + motion[:, None, :3, 3]
    points, normals = arrays.pop("points"), arrays.pop("normals")
    named = grasps[0].object
    at = np.broadcast_to(pose, (len(grasps), 4, 4)) if named or places else None
    return replace(problems, points=points, normals=normals, more=arrays, object_pose=at)


def _of_kinds(
    rows: NDArray[np.intp], problems: Problems
) -> Iterator[tuple[NDArray[np.intp], Problems]]:
    for _, of_kinds, some in by_kinds(problems):
        yield (rows if of_kinds is None else rows[of_kinds]), some


class _Ranked:
    """All answers to all candidates, best first."""

    def __init__(
        self,
        engine: Engine,
        asked: Sequence[tuple[NDArray[np.intp], Problems]],
        found: Sequence[Answers],
        apart: float,
        seconds: float,
    ) -> None:
        self.engine, self.asked, self.apart, self.seconds = engine, asked, apart, seconds
        self.q = np.concatenate([part.q for part in found])
        self.owner = np.concatenate([part.owner for part in found])
        self.score = np.concatenate([part.score for part in found])

    def best(self, limit: int) -> Iterator[Choice]:
        """The best that differ from each other."""
        robot = self.engine.robot
        # Of equals the first candidate.
        order = np.lexsort((self.owner, -self.score))
        ranges = robot.upper - robot.lower
        kept: list[Array] = []
        for first in range(0, len(order), BLOCK):
            rows = order[first : first + BLOCK]
            solutions = self._judged(rows)
            for row in rows.tolist():
                solution = solutions[row]
                part = self.q[row] / ranges
                alike = any(np.abs(part - other).max() < self.apart for other in kept)
                same = any(np.array_equal(part, other) for other in kept)
                if not solution.success or alike or same:
                    continue
                kept.append(part)
                yield Choice(int(self.owner[row]), solution, float(self.score[row]))
                if len(kept) == limit:
                    return

    def _judged(self, rows: NDArray[np.intp]) -> dict[int, Solution]:
        """Answers with the verdict on them, which has the last word."""
        found: dict[int, Solution] = {}
        for numbers, problems in self.asked:
            mine = rows[np.isin(self.owner[rows], numbers)]
            if not len(mine):
                continue
            places = np.searchsorted(numbers, self.owner[mine])
            for _, of_kinds, some in by_kinds(problems.rows(places)):
                here = mine if of_kinds is None else mine[of_kinds]
                none = np.zeros(len(here), dtype=np.int64)
                outcome = Outcome(
                    self.q[here],
                    np.full(len(here), int(Status.SOLVED), dtype=np.int64),
                    none,
                    none,
                    np.full(len(here), self.seconds),
                    {},
                )
                around = self.engine.around(some)
                method = self.engine.method.name
                batch = judged(self.engine.robot, method, some, outcome, around)
                found |= {int(row): batch.solution(i) for i, row in enumerate(here.tolist())}
        return found
