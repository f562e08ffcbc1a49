"""Answers that touch something, exchanged for ones that do not."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Protocol

import numpy as np

from casadi_ik.answers.solution import BatchSolution
from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Clearances, Surroundings
from casadi_ik.problem.contacts.arrays import by_kinds
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.preference import CLEARANCE
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status
from casadi_ik.problem.verdict import SolvedVerdict, judge_one
from casadi_ik.solving.alternatives.free import FreeFinder
from casadi_ik.solving.solved_part import judged

RANKED = ("manipulability", CLEARANCE)
"""Preferences for which an answer that is free already has to compete with all others."""


class Freeing(Protocol):
    """An engine that has a finder of free answers."""

    @cached_property
    def freer(self) -> FreeFinder:
        """Finds them."""
        ...


def freed(
    engine: Callable[[Problems], Freeing],
    problems: Problems,
    around: Surroundings,
    starts: Array,
    seed: int,
    outcome: Outcome,
    batch: BatchSolution,
    reasons: bool = True,
) -> BatchSolution:
    """The verdicts on a batch after other answers were looked for where they touch something.

    Args:
        engine: By targets of one kind the engine for them.
        problems: k targets.
        around: What they are checked against.
        starts: (k, n) where the robot is.
        seed: Of all random numbers.
        outcome: What the method came to.
        batch: The verdicts on it.
        reasons: Whether the reports say what else would do, see `FreeFinder.find`.
    """
    every = problems.prefer in RANKED
    touching = batch.status == Status.COLLISION
    rows = np.flatnonzero(touching | batch.success if every else touching)
    if not len(rows):
        return batch
    begin, q = time.perf_counter(), batch.q.copy()
    reports = list(batch.collisions)
    numbers = np.array([problems.number(row) for row in rows.tolist()], dtype=np.intp)
    # A target's random numbers are its own, whichever others are looked at with it.
    asked = replace(problems.rows(rows), picked=numbers)
    robot = engine(asked.rows(slice(0, 1))).freer.robot
    for _, of_kinds, some in by_kinds(asked):
        chosen = rows if of_kinds is None else rows[of_kinds]
        found = engine(some).freer.find(
            some, around.rows(chosen), q[chosen], starts[chosen], seed, every, reasons
        )
        q[chosen] = found.q
        for row, report in zip(chosen.tolist(), found.reports, strict=True):
            reports[row] = report
    seconds = batch.time.copy()
    seconds[rows] += (time.perf_counter() - begin) / len(rows)
    status = np.where(touching, int(Status.SOLVED), outcome.status)
    ended = replace(outcome, q=q, time=seconds, status=status)
    return replace(
        judged(robot, batch.method, problems, ended, around),
        collisions=tuple(reports),
    )


def freed_at_once(
    engine: Freeing,
    problems: Problems,
    around: Surroundings,
    q: Array,
    start: Array,
    others: bool = False,
) -> tuple[Array, SolvedVerdict, Clearances] | None:
    """Another arm for the hand of one answer that touches something, judged; None: look further.

    What it gives is what `freed` gives, which looks there first.

    Args:
        engine: The engine for the target.
        problems: One target.
        around: What it is checked against.
        q: (n,) the answer.
        start: (n,) where the robot is.
        others: Whether to look at the hands of further rounds, too, as an exported solver does.
    """
    finder = engine.freer
    found = finder.beside(problems, around, q[None], start[None], others)
    verdict = None if found is None else judge_one(finder.robot, problems, found)
    if found is None or verdict is None:
        return None
    clear = around.check(found[None])
    return (found, verdict, clear) if clear.free[0] else None
