"""Which of many grasps to take: candidates of all kinds, ranked together."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.answers.solution import Choice, Ranking, Solution
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.grasps.pose import inverse, moved, one_pose
from casadi_ik.problem.contacts.arrays import by_kinds
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.questions import Questions
from casadi_ik.problem.status import Status
from casadi_ik.solving.alternatives.choosing import Answers, Look, answers_of
from casadi_ik.solving.alternatives.distinct import checked_distance
from casadi_ik.solving.alternatives.finder import APART
from casadi_ik.solving.alternatives.swings import Preference
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.solved_part import judged

Judgement: TypeAlias = str | Callable[[ArmHand, Array], ArrayLike]
"""One of `PREFERENCES`, or what gives configurations (m, n) of a robot their scores (m,)."""


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
    per_candidate: int | None = 1,
) -> Ranking:
    """Rank answers to many grasps, see `Solver.choose`.

    Raises:
        InputError: See there.
        UnsupportedError: The method is not hand-first.
    """
    begin = time.perf_counter()
    limit = _count(limit, "limit")
    most = None if per_candidate is None else _count(per_candidate, "per_candidate")
    apart, start = checked_distance(apart), questions.start(q0)
    word = "own" if callable(prefer) else engine.preference(prefer, q0 is not None)
    pose = None if object_pose is None else one_pose(object_pose, "object_pose")

    def placed(number: int) -> Grasp:
        grasp = grasps[number]
        return grasp if pose is None else grasp.in_object_frame().at(pose)

    asked = list(_asked(questions, grasps, pose, fixed))
    wanted: Preference = _own(prefer, engine.robot) if callable(prefer) else word
    parts: list[tuple[NDArray[np.intp], Answers]] = []

    def look(candidates: NDArray[np.bool_], which: Look, near: bool = False) -> Answers:
        """What all looks so far have come to, after one more at some candidates."""
        for rows, some in asked:
            left = rows[candidates[rows]]
            if not len(left):
                continue
            mine = some.rows(np.searchsorted(rows, left))
            mine = replace(mine, picked=left, prefer="q0" if near else "limits")
            found = answers_of(
                engine.kinds_of(mine).freer,
                mine,
                engine.around(mine),
                start if near else engine.robot.home,
                start,
                wanted,
                limit,
                seed,
                which,
            )
            if near:
                found = replace(found, reasons=np.full(len(left), "", dtype=object))
            parts.append((left, found))
        return Answers.joined(parts, len(grasps))

    # Neither what is preferred nor where the robot is decides which candidates have an answer.
    answers = look(np.ones(len(grasps), dtype=bool), Look.QUICK)
    if answers.answered.sum() < min(limit, len(grasps)):
        answers = look(~answers.answered, Look.THOROUGH)
    if q0 is not None:
        answers = look(answers.answered, Look.OWN, near=True)
    entries = _Ranked(engine, asked, answers, apart, placed).best(limit, most)
    seconds = (time.perf_counter() - begin) / len(grasps)
    reasons = [reason for reason in answers.reasons.tolist() if reason]
    return Ranking(
        entries=tuple(
            replace(one, solution=replace(one.solution, time=seconds)) for one in entries
        ),
        candidates=len(grasps),
        answered=len(grasps) - len(reasons),
        failures=dict(Counter(reasons).most_common()),
        prefer=word,
    )


def _count(value: int, name: str) -> int:
    """A number of answers.

    Raises:
        InputError: It is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{name}: found {value!r}, expected an integer >= 1")
    return int(value)


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
) -> Iterator[tuple[NDArray[np.intp], Problems]]:
    """Candidates with the same fingers, tolerances, kinds and object, in the base frame."""
    if not len(grasps):
        raise InputError("grasps: found none, expected at least one")
    groups: dict[object, list[int]] = {}
    for number, grasp in enumerate(grasps):
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasps[{number}]: found {type(grasp).__name__}, expected a Grasp")
        own = tuple((name, one.tolerance) for name, one in grasp.contacts.items())
        key = own, grasp.object, grasp.object_pose is None, grasp.palm is None
        groups.setdefault(key, []).append(number)
    for numbers in groups.values():
        some = [grasps[number] for number in numbers]
        rows = np.array(numbers, dtype=np.intp)
        problems = _placed(questions.of_grasps(some, fixed), some, pose)
        for _, of_kinds, alike in by_kinds(problems):
            yield (rows if of_kinds is None else rows[of_kinds]), alike


def _placed(problems: Problems, grasps: Sequence[Grasp], pose: Array | None) -> Problems:
    """Targets moved as a whole with the object they are on, see `Grasp.at`."""
    if pose is None:
        return problems
    places = [grasp.object_pose for grasp in grasps if grasp.object_pose is not None]
    arrays = {"points": problems.points, "normals": problems.normals, **problems.more}
    for name, array in arrays.items() if places else ():
        # Seen from the object first.
        stack = np.stack(places)
        shift = stack[:, None, :3, 3] if name == "points" else 0.0
        arrays[name] = (array - shift) @ stack[:, :3, :3]
    arrays = moved(arrays, pose)
    points, normals = arrays.pop("points"), arrays.pop("normals")
    named = grasps[0].object
    at = np.broadcast_to(pose, (len(grasps), 4, 4)) if named or places else None
    palms = problems.palms
    if palms is not None:
        palms = pose @ (np.stack([inverse(place) for place in places]) @ palms if places else palms)
    return replace(
        problems, points=points, normals=normals, more=arrays, object_pose=at, palms=palms
    )


class _Ranked:
    """All answers to all candidates, best first."""

    def __init__(
        self,
        engine: Engine,
        asked: Sequence[tuple[NDArray[np.intp], Problems]],
        answers: Answers,
        apart: float,
        placed: Callable[[int], Grasp],
    ) -> None:
        self.engine, self.asked, self.answers, self.apart = engine, asked, answers, apart
        self.placed = placed

    def best(self, limit: int, most: int | None) -> list[Choice]:
        """The best that differ from each other, at most so many of a candidate."""
        answers, robot = self.answers, self.engine.robot
        # Of equals that whose arm is farther from its limits, then the first candidate.
        left = np.lexsort((answers.owner, -answers.margin, -answers.score))
        parts = answers.q / (robot.upper - robot.lower)
        places = np.full(len(answers.reasons), limit if most is None else most)
        found: list[Choice] = []

        def others(rows: NDArray[np.intp], row: int, places: NDArray[np.intp]) -> NDArray[np.intp]:
            off = np.abs(parts[rows] - parts[row]).max(axis=1)
            room = places[answers.owner[rows]] > 0
            return rows[(off >= self.apart) & (off > 0) & room]

        while len(left) and len(found) < limit:
            chosen, rest, free = list[int](), left, places.copy()
            while len(rest) and len(found) + len(chosen) < limit:
                row = int(rest[0])
                chosen.append(row)
                free[answers.owner[row]] -= 1
                rest = others(rest, row, free)
            solutions = self._judged(np.array(chosen))
            left = left[~np.isin(left, chosen)]
            for row in chosen:
                if solutions[row].success:
                    owner = int(answers.owner[row])
                    score, grasp = float(answers.score[row]), self.placed(owner)
                    found.append(Choice(owner, solutions[row], score, grasp))
                    places[owner] -= 1
                    left = others(left, row, places)
        return found

    def _judged(self, rows: NDArray[np.intp]) -> dict[int, Solution]:
        """Answers with the verdict on them, which has the last word."""
        found: dict[int, Solution] = {}
        owner = self.answers.owner[rows]
        for numbers, problems in self.asked:
            mine = rows[np.isin(owner, numbers)]
            if not len(mine):
                continue
            some = problems.rows(np.searchsorted(numbers, self.answers.owner[mine]))
            none = np.zeros(len(mine), dtype=np.int64)
            status = np.full(len(mine), int(Status.SOLVED), dtype=np.int64)
            q = self.answers.q[mine]
            outcome = Outcome(q, status, none, none, np.zeros(len(mine)), {})
            around, method = self.engine.around(some), self.engine.method.name
            batch = judged(self.engine.robot, method, some, outcome, around)
            found |= {int(row): batch.solution(i) for i, row in enumerate(mine.tolist())}
        return found
