"""Answers that touch nothing: other arms for the same hand, other hands, and a way out.

What is looked at, until one is free: all branches of the arm over the whole swivel with the hand as
it is; the hand postures of every round, each with all its arms; descents from random arms; and
steps away from what is nearest, each brought back to the contacts. A hand that touches something by
itself, wherever its idle fingers are put, is done with before any of its arms is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.solution import CollisionReport
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import ROUNDING, Surroundings
from casadi_ik.problem.palm_targets import free_palms
from casadi_ik.problem.preference import CLEARANCE
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.alternatives.finder import AlternativeFinder
from casadi_ik.solving.alternatives.idle_fingers import IdleFingers
from casadi_ik.solving.alternatives.of_each import Different, best_of_each, first_of_each
from casadi_ik.solving.alternatives.swings import ArmSwings, Preference
from casadi_ik.solving.trials import Descent
from casadi_ik.symbolic.even_spread import even_steps

STARTS = 24
"""Random arms that a target is solved from, where the arm has no closed form."""

HANDS = 8
"""As many where it has: then it is other hands that are looked for."""

ALIKE = 0.02
"""Hands all of whose motors differ by less [of their ranges] have the same arms."""

ROUNDS = 3
"""Rounds of hand postures."""

LEAST_RANGE = 1e-9
"""What stands for the range of a motor that has none [rad or m]."""

ESCAPES = 4
"""Steps away from what is nearest."""

STEPS = (0.1, 0.02)
"""Lengths of such a step, of which the best is taken; motions as parts of motors' ranges."""

NUDGE = 1e-5
"""Difference [of a motor's range] from which it is taken which way there is more room."""

DEEP = 0.02
"""What is farther inside something [m] than this is not got out of by such steps."""

GAIN = 0.1
"""What a step away has to gain at least, of what there is to gain."""

HOPEFUL = 4
"""Hands with most room that are looked at for why there is no answer."""


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

    def with_free(self, rows: NDArray[np.intp], others: FreeAnswers) -> FreeAnswers:
        """With the free answers that others are to some of the targets."""
        taken = rows[others.free]
        q, free, reports = self.q.copy(), self.free.copy(), list(self.reports)
        q[taken], free[taken] = others.q[others.free], True
        for row in taken.tolist():
            reports[row] = None
        return FreeAnswers(q, free, tuple(reports))


class FreeSearch:
    """The search for some targets.

    Attributes:
        best: (k, n) the preferred of what is free so far.
        free: (k,) whether there is any.
    """

    def __init__(
        self,
        finder: AlternativeFinder,
        swings: ArmSwings | None,
        problems: Problems,
        around: Surroundings,
        starts: Array,
        seed: int,
    ) -> None:
        self.finder, self.swings = finder, swings
        self.problems, self.around = problems, around
        self.starts, self.seed = starts, seed
        self.trials = finder.trials
        self.limits = self.trials.limits(problems)
        count, n = starts.shape
        self.best, self.score = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.nearest, self.room = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.free = np.zeros(count, dtype=bool)
        self.tried = np.zeros(count, dtype=np.int64)
        self.hands: list[tuple[Array, NDArray[np.intp], Array]] = []
        robot, hand = finder.robot, finder.hand
        self._idle = IdleFingers(robot, problems)
        self._ranges = np.maximum(robot.upper - robot.lower, LEAST_RANGE)
        self._palms = free_palms(robot, problems)
        size = len(hand) + 12 * bool(self._palms.any())
        self._known, self._swung = (Different(count, size, ALIKE) for _ in range(2))
        self._fresh = np.ones(count, dtype=bool)

    @cached_property
    def _descent(self) -> Descent:
        return Descent(self.trials, self.problems)

    def run(self, q: Array, every: bool = False) -> None:
        """Look until all are free; or first, if asked, at the hands of a round whether or not."""
        self.swing(q, np.arange(len(q)))
        for hands, owner in chain(self.of_rounds(every), self._from_anywhere()):
            self.swing(hands, owner)
        blocked = np.flatnonzero(~self.free)
        if len(blocked):
            self._find_nearest(blocked)
            self._escape()

    def take(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Keep the preferred free ones of configurations (m, n), and the nearest; their room."""
        if not len(q):
            return np.zeros(0)
        room = self.around.rows(owner).check(q).room
        rows = best_of_each(owner, room, self.room)
        self.nearest[owner[rows]], self.room[owner[rows]] = q[rows], room[rows]
        kept = np.flatnonzero(room >= -ROUNDING)
        if len(kept):
            some, mine = q[kept], owner[kept]
            score = score_of(self.finder, some, self.starts[mine], self.problems.prefer, room[kept])
            rows = best_of_each(mine, score, self.score)
            self.best[mine[rows]], self.score[mine[rows]] = some[rows], score[rows]
            self.free[mine[rows]] = True
        return room

    def swing(self, q: Array, owner: NDArray[np.intp]) -> None:
        """The preferred free arms of hands (m, n) of targets."""
        if not len(q):
            return
        q = self._idle.aside(q, owner, self.around.held)
        if self.swings is None:
            self.take(q, owner)
            self.hands.append((q, owner, np.zeros(len(q))))
            np.add.at(self.tried, owner, 1)
            self._fresh[owner] = True
            return
        room = self.around.rows(owner).held.check(q).room
        parts = self.finder.hand_parts(q, self._palms[owner])
        fresh = self._known.add(parts, owner)
        self._fresh[owner[fresh]] = True
        self.hands.append((q[fresh], owner[fresh], room[fresh]))
        kept = np.flatnonzero(room >= -ROUNDING)
        np.add.at(self.tried, owner[room < -ROUNDING], 1)
        kept = kept[self._swung.add(parts[kept], owner[kept])]
        kept = kept[self._in_order(q[kept], owner[kept])]
        found, mine, tried = self._arms(q[kept], owner[kept], room[kept], self.around)
        np.add.at(self.tried, owner[kept], tried)
        self.take(found, mine)

    def _in_order(self, q: Array, owner: NDArray[np.intp]) -> NDArray[np.intp]:
        """Hands target by target, the preferred ones first as far as the hand goes."""
        hand = self.finder.hand
        if self.problems.prefer == "q0":
            off = ((q - self.starts[owner]) / self._ranges)[:, hand]
            return np.lexsort((np.square(off).sum(axis=1), owner))
        return np.lexsort((-self.finder.score(q, q, "limits", hand), owner))

    def _arms(
        self,
        q: Array,
        owner: NDArray[np.intp],
        room: Array,
        around: Surroundings,
        prefer: Preference | None = None,
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.int64]]:
        """Preferred arms of hands, their targets, and how many were tried for each hand."""
        swings = self.swings
        assert swings is not None
        asked = prefer or self.problems.prefer
        swung = swings.choose(
            q,
            self.starts[owner],
            (self.limits.first.lower, self.limits.first.upper),
            asked,
            around.rows(owner),
            room,
            of_one=owner if asked in ("limits", "q0") else None,
        )
        return *self._solved(swung.q, owner[swung.owner]), swung.tried

    def of_rounds(self, every: bool = False) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Answers with other hands, of the targets that are not free, round by round."""
        method = self.trials.method
        for number in range(min(ROUNDS, method.options.rounds, method.rounds)):
            # Where a round has brought no other hand, the next will not either.
            rows = np.flatnonzero((~self.free | (every and not number)) & self._fresh)
            if not len(rows):
                break
            self._fresh[:] = False
            some = self.problems.rows(rows)
            postures = method.postures(some, number)
            count = postures.shape[1]
            owner = np.repeat(rows, count)
            starts = self.limits.of(owner).clip(self.starts[owner])
            flat = postures.reshape(len(owner), postures.shape[2])
            asked = self.problems.rows(owner)
            turns = number * count + np.tile(np.arange(count), len(rows))
            ends = self.trials.run(*self.trials.posture_rows(asked, starts, flat, turns))
            yield self._solved(ends, owner)

    def _from_anywhere(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Answers with other hands and arms, of the targets that are not free."""
        rows, robot, hand = np.flatnonzero(~self.free), self.finder.robot, self.finder.hand
        if not len(rows):
            return
        count = STARTS if self.swings is None else HANDS
        owner = np.repeat(rows, count)
        numbers = np.array([self.problems.number(int(row)) for row in rows])
        starts = np.concatenate(_shifted(robot, self.seed, numbers, count))
        last = self.hands[0][0]
        starts[::2, hand] = last[owner[::2]][:, hand]
        ends = self._descent.run(owner, self.limits.of(owner).clip(starts))
        yield self._solved(ends, owner)

    def _solved(self, q: Array, owner: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        if not len(q):
            return q, owner
        asked = self.problems.rows(owner)
        good = self.trials.solved(asked, q, asked.enforce_limits)
        return q[good], owner[good]

    def _find_nearest(self, rows: NDArray[np.intp]) -> None:
        """The answers with most room, of the hands with most."""
        q, owner, room = self._hands_of(rows)
        if self.swings is None:
            return
        kept = first_of_each(owner, np.lexsort((-room, owner)), 1)
        found, mine, _ = self._arms(q[kept], owner[kept], room[kept], self.around, CLEARANCE)
        self.take(np.concatenate([found, q[kept]]), np.concatenate([mine, owner[kept]]))

    def _hands_of(self, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp], Array]:
        """All hands of some targets, their owners and their room."""
        q, owner, room = (np.concatenate(each) for each in zip(*self.hands, strict=True))
        mine = np.isin(owner, rows)
        return q[mine], owner[mine], room[mine]

    def _escape(self) -> None:
        """Steps away from what is nearest, brought back to the contacts."""
        ranges, n = self._ranges, len(self._ranges)
        rows = np.flatnonzero(~self.free & (self.room > -DEEP))
        for _ in range(ESCAPES):
            if not len(rows):
                return
            before = self.room[rows].copy()
            nudged = self.nearest[rows][:, None] + np.diag(NUDGE * ranges)
            around = self.around.rows(np.repeat(rows, n))
            room = around.check(nudged.reshape(-1, n)).room.reshape(-1, n)
            way = (room - before[:, None]) / NUDGE
            way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
            owner = np.repeat(rows, len(STEPS))
            steps = np.tile(STEPS, len(rows))[:, None]
            there = self.nearest[owner] + steps * (way * ranges).repeat(len(STEPS), axis=0)
            ends = self._descent.run(owner, self.limits.of(owner).clip(there))
            self.take(*self._solved(ends, owner))
            rows = rows[~self.free[rows] & (self.room[rows] > (1 - GAIN) * before)]

    def found(self, reasons: bool) -> FreeAnswers:
        """What it came to; whether it would work without the scene or the robot, if asked."""
        q = np.where(self.free[:, None], self.best, self.nearest)
        reports: list[CollisionReport | None] = [None] * len(q)
        blocked = np.flatnonzero(~self.free)
        if not len(blocked):
            return FreeAnswers(q, self.free, tuple(reports))
        clear = self.around.rows(blocked).check(q[blocked])
        alone = self._possible(blocked, self.around.robot_alone) if reasons else None
        passing = self._possible(blocked, self.around.scene_alone) if reasons else None
        for i, row in enumerate(blocked.tolist()):
            pair = clear.pair(i)
            assert pair is not None
            reports[row] = CollisionReport(
                pair,
                -float(clear.room[i]),
                int(self.tried[row]),
                None if alone is None else bool(alone[row]),
                None if passing is None else bool(passing[row]),
            )
        return FreeAnswers(q, self.free, tuple(reports))

    def _possible(self, rows: NDArray[np.intp], around: Surroundings) -> NDArray[np.bool_]:
        """(all targets,) whether one of the hands is free of some of the pairs alone."""
        q, owner, room = self._hands_of(rows)
        possible = np.zeros(len(self.free), dtype=bool)
        if self.swings is None:
            possible[owner[around.rows(owner).free(q)]] = True
            return possible
        kept = np.flatnonzero(around.rows(owner).held.free(q))
        kept = kept[first_of_each(owner[kept], np.lexsort((-room[kept], owner[kept])), HOPEFUL)]
        any_room = np.full(len(kept), np.inf)
        _, mine, _ = self._arms(q[kept], owner[kept], any_room, around, "limits")
        possible[mine] = True
        return possible


def _shifted(robot: ArmHand, seed: int, numbers: NDArray[np.intp], count: int) -> Array:
    """(k, count, n) configurations, spread over the limits for each target in its own way.

    A random cloud, for each target shifted around in the limits, by its number alone: whichever
    others are looked at with it.
    """
    cloud = np.random.default_rng(seed).random((count, len(robot.lower)))
    shift = numbers[:, None] * even_steps(len(robot.lower))
    part = (cloud + shift[:, None]) % 1.0
    return robot.lower + part * (robot.upper - robot.lower)


def score_of(
    finder: AlternativeFinder,
    q: Array,
    starts: Array,
    prefer: Preference,
    room: Array,
    columns: list[int] | None = None,
) -> Array:
    """(m,) what is preferred of configurations, see `FreeFinder.score`."""
    if callable(prefer):
        return np.asarray(prefer(q), dtype=float)
    if prefer == CLEARANCE:
        return room
    return finder.score(q, starts, prefer, columns)
