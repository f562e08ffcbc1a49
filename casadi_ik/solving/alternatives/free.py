"""Answers that touch nothing: other arms for the same hand, other hands, and a way out.

What is looked at, until one is free: all branches of the arm over the whole swivel with the hand as
it is; the hand postures of every round, each with all its arms; descents from random arms; and
steps away from what is nearest, each brought back to the contacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.collision_report import CollisionReport
from casadi_ik.problem.preference import CLEARANCE
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.alternatives.finder import AlternativeFinder
from casadi_ik.solving.alternatives.swings import ArmSwings, Swung
from casadi_ik.solving.trials import Descent

TOGETHER = 128
"""Targets that are worked on at once."""

STARTS = 24
"""Random arms that a target is solved from."""

ROUNDS = 3
"""Rounds of hand postures."""

ESCAPES = 4
"""Steps away from what is nearest."""

STEPS = (0.3, 0.1, 0.03, 0.01)
"""Lengths of such a step, of which the best is taken; motions as parts of motors' ranges."""


@dataclass(frozen=True, eq=False)
class FreeAnswers:
    """What was found for k targets.

    Attributes:
        q: (k, n) a free answer; where there is none, the one that is nearest to it.
        free: (k,) whether it is.
        reports: Why there is none; None where there is.
    """

    q: Array
    free: NDArray[np.bool_]
    reports: tuple[CollisionReport | None, ...]


class FreeFinder:
    """Finds answers that touch nothing, on one robot.

    Attributes:
        robot: The robot.
        trials: The loop of hand-first.
        hand: Positions in q of the hand's actuators.
    """

    def __init__(self, finder: AlternativeFinder, compiled: bool = True) -> None:
        """Take what enumerates solutions."""
        self._finder = finder
        self.robot, self.trials, self.hand = finder.robot, finder.trials, finder.hand
        self._compiled = compiled

    @cached_property
    def _swings(self) -> ArmSwings | None:
        arm = self.trials.method.step.arm
        return None if arm is None else ArmSwings(self.robot, arm, self._compiled)

    def find(
        self,
        problems: Problems,
        around: Surroundings,
        q: Array,
        starts: Array,
        seed: int,
        every: bool = False,
    ) -> FreeAnswers:
        """Free answers of k targets.

        Args:
            problems: The targets.
            around: What they are checked against.
            q: (k, n) answers, whether or not they are free.
            starts: (k, n) where the robot is.
            seed: Of random arms.
            every: Whether an answer that is free already competes with the others for being
                preferred, instead of being kept.
        """
        parts = []
        for first in range(0, len(q), TOGETHER):
            rows = np.arange(first, min(first + TOGETHER, len(q)))
            search = _Search(self, problems.rows(rows), around.rows(rows), starts[rows], seed)
            search.look(q[rows], np.arange(len(rows)))
            if every:
                search.take(q[rows], np.arange(len(rows)))
            search.run(q[rows])
            parts.append(search.found())
        reports = tuple(report for part in parts for report in part.reports)
        return FreeAnswers(
            np.concatenate([part.q for part in parts]),
            np.concatenate([part.free for part in parts]),
            reports,
        )

    def swung(self, q: Array, lower: Array, upper: Array) -> Swung | None:
        """All arms of hands; None for an arm without a closed form, and without an arm."""
        if self._swings is None:
            return None
        return self._swings.all_around(q, lower, upper)

    def closer(self, q: Array, swung: Swung, lower: Array, upper: Array) -> Swung:
        """Arms near some of `swung`."""
        assert self._swings is not None
        return self._swings.around(q, swung, lower, upper)

    def score(self, q: Array, starts: Array, prefer: str, room: Array) -> Array:
        """(m,) what is preferred, higher is better."""
        if prefer == CLEARANCE:
            return room
        return self._finder.score(q, starts, prefer)


class _Search:
    """The search for some targets."""

    def __init__(
        self,
        finder: FreeFinder,
        problems: Problems,
        around: Surroundings,
        starts: Array,
        seed: int,
    ) -> None:
        self.finder, self.problems, self.around = finder, problems, around
        self.starts, self.seed = starts, seed
        self.trials = finder.trials
        self.limits = self.trials.limits(problems)
        count, n = starts.shape
        self.best, self.score = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.nearest, self.room = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.free = np.zeros(count, dtype=bool)
        self.seen: list[tuple[Array, NDArray[np.intp]]] = []

    def run(self, q: Array) -> None:
        """Look until all are free."""
        self.swing(q, np.arange(len(q)))
        for hands, owner in self._others():
            self.look(hands, owner)
            self.swing(hands, owner)
        self._escape()

    def look(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Note configurations (m, n) of targets; (m,) their room."""
        if not len(q):
            return np.zeros(0)
        room = self.around.rows(owner).check(q).room
        self.seen.append((q, owner))
        order = np.lexsort((room, owner))
        last = order[np.append(owner[order][1:] != owner[order][:-1], True)]
        better = last[room[last] > self.room[owner[last]]]
        self.nearest[owner[better]], self.room[owner[better]] = q[better], room[better]
        return room

    def take(self, q: Array, owner: NDArray[np.intp], room: Array | None = None) -> None:
        """Keep the preferred of those that are free."""
        if not len(q):
            return
        around = self.around.rows(owner)
        room = around.check(q).room if room is None else room
        kept = np.flatnonzero(room >= 0)
        if not len(kept):
            return
        q, owner, room = q[kept], owner[kept], room[kept]
        score = self.finder.score(q, self.starts[owner], self.problems.prefer, room)
        order = np.lexsort((score, owner))
        last = order[np.append(owner[order][1:] != owner[order][:-1], True)]
        better = last[score[last] > self.score[owner[last]]]
        self.best[owner[better]], self.score[owner[better]] = q[better], score[better]
        self.free[owner[better]] = True

    def swing(self, q: Array, owner: NDArray[np.intp]) -> None:
        """All arms of hands (m, n); the preferred free one of each target, then those near it."""
        lower, upper = self.limits.lower, self.limits.upper
        swung = self.finder.swung(q, lower, upper)
        if swung is None or not len(swung.q):
            self.take(q, owner)
            return
        targets = owner[swung.owner]
        good = self.trials.solved(
            self.problems.rows(targets), swung.q, self.problems.enforce_limits
        )
        swung, targets = swung.rows(good), targets[good]
        room = self.look(swung.q, targets)
        self.take(swung.q, targets, room)
        free = np.flatnonzero(room >= 0)
        if not len(free):
            return
        score = self.finder.score(
            swung.q[free], self.starts[targets[free]], self.problems.prefer, room[free]
        )
        order = np.lexsort((score, targets[free]))
        sorted_targets = targets[free][order]
        last = free[order[np.append(sorted_targets[1:] != sorted_targets[:-1], True)]]
        chosen = swung.rows(last)
        near = self.finder.closer(q[chosen.owner], chosen, lower, upper)
        self.take(*self._solved(near.q, targets[last][near.owner]))

    def _others(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Answers with other hands and arms, of the targets that are not free."""
        method, hand = self.trials.method, self.finder.hand
        for number in range(min(ROUNDS, method.options.rounds)):
            rows = np.flatnonzero(~self.free)
            if not len(rows):
                return
            some = self.problems.rows(rows)
            postures = method.postures(some, number)
            count = postures.shape[1]
            owner = np.repeat(rows, count)
            starts = self.limits.clip(self.starts[owner])
            flat = postures.reshape(-1, postures.shape[2])
            asked = self.problems.rows(owner)
            ends = self.trials.run(*self.trials.posture_rows(asked, starts, flat))
            yield self._solved(ends, owner)
        rows = np.flatnonzero(~self.free)
        if not len(rows):
            return
        robot = self.finder.robot
        owner = np.repeat(rows, STARTS)
        # Row by row, so that a target's starts do not depend on the others of a batch.
        starts = np.concatenate(
            [
                robot.random(np.random.default_rng([self.seed, int(row)]), STARTS)
                for row in (self.problems.number(int(r)) for r in rows)
            ]
        )
        starts[::2, hand] = self.nearest[owner[::2]][:, hand]
        ends = Descent(self.trials, self.problems).run(owner, self.limits.clip(starts))
        yield self._solved(ends, owner)

    def _solved(self, q: Array, owner: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        asked = self.problems.rows(owner)
        good = self.trials.solved(asked, q, asked.enforce_limits)
        return q[good], owner[good]

    def _escape(self) -> None:
        """Steps away from what is nearest, brought back to the contacts."""
        robot = self.finder.robot
        ranges = np.maximum(robot.upper - robot.lower, 1e-9)
        for _ in range(ESCAPES):
            rows = np.flatnonzero(~self.free & np.isfinite(self.nearest).all(axis=1))
            if not len(rows):
                return
            before = self.room[rows].copy()
            _, slope = self.around.rows(rows).gradient(self.nearest[rows])
            way = slope * ranges
            way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
            owner = np.repeat(rows, len(STEPS))
            steps = np.tile(STEPS, len(rows))[:, None]
            there = self.nearest[owner] + steps * (way * ranges).repeat(len(STEPS), axis=0)
            ends = Descent(self.trials, self.problems).run(owner, self.limits.clip(there))
            q, owner = self._solved(ends, owner)
            room = self.look(q, owner)
            self.take(q, owner, room)
            if (self.room[rows] <= before + 1e-6).all():
                return

    def found(self) -> FreeAnswers:
        """What it came to."""
        q = np.where(self.free[:, None], self.best, self.nearest)
        reports: list[CollisionReport | None] = [None] * len(q)
        blocked = np.flatnonzero(~self.free)
        if not len(blocked):
            return FreeAnswers(q, self.free, tuple(reports))
        every = np.concatenate([some for some, _ in self.seen])
        owner = np.concatenate([rows for _, rows in self.seen])
        table = self.around.table
        own = table.pairs[:, 1] < len(table.radii)
        for row in blocked.tolist():
            mine = np.flatnonzero(owner == row)
            around = self.around.rows(np.full(len(mine), row))
            clear = self.around.rows(np.array([row])).check(q[row : row + 1])
            pair = clear.pair(0)
            assert pair is not None
            alone, passing = (
                bool(around.only(kept).free(every[mine]).any()) for kept in (own, ~own)
            )
            reports[row] = CollisionReport(pair, -float(clear.room[0]), len(mine), alone, passing)
        return FreeAnswers(q, self.free, tuple(reports))
