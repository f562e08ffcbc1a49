"""Answers to many grasps of which one is enough: every hand, branch and swivel of each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Bools
from casadi_ik.problem.clearance import ROUNDING, Surroundings
from casadi_ik.problem.palm_targets import free_palms
from casadi_ik.problem.preference import CLEARANCE
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Status
from casadi_ik.solving.alternatives.finder import DISTINCT
from casadi_ik.solving.alternatives.free import FreeFinder
from casadi_ik.solving.alternatives.swings import Preference

TOGETHER = 1024
"""Candidates that are worked on at once."""

ROUNDS = 51
"""Of hands that a candidate gets at most: hands of many motors go on much longer for a single
grasp, and most of many candidates are out of reach."""

CLOSER = 8
"""So many times as many answers as are wanted are looked at closer."""


class Look(Enum):
    """Which hands of a candidate are looked at.

    Attributes:
        QUICK: Those that one round leads to.
        THOROUGH: All that a single grasp would get, after `ROUNDS` of rounds.
        OWN: The one that a solve comes to.
    """

    QUICK = auto()
    THOROUGH = auto()
    OWN = auto()


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


def answers_of(
    finder: FreeFinder,
    problems: Problems,
    around: Surroundings | None,
    begin: Array,
    start: Array,
    prefer: Preference,
    limit: int,
    seed: int,
    look: Look,
) -> Answers:
    """Answers to k candidates.

    Args:
        finder: Of the robot, for the kinds of their contacts.
        problems: The candidates.
        around: What answers must not touch; None: nothing is checked.
        begin: (n,) where hands are looked for from.
        start: (n,) where the robot is; with `prefer` it says which arms are better.
        prefer: What is preferred.
        limit: How many answers are wanted.
        seed: Of random arms.
        look: Which hands are looked at.
    """
    parts = []
    for first in range(0, len(problems), TOGETHER):
        rows = np.arange(first, min(first + TOGETHER, len(problems)))
        nearby = None if around is None else around.rows(rows)
        part = _Part(finder, problems.rows(rows), nearby, begin, start, prefer, limit)
        parts.append((rows, part.run(seed, look)))
    return Answers.joined(parts, len(problems))


class _Part:
    """Some candidates."""

    def __init__(
        self,
        finder: FreeFinder,
        problems: Problems,
        around: Surroundings | None,
        begin: Array,
        start: Array,
        prefer: Preference,
        limit: int,
    ) -> None:
        self.finder, self.problems, self.around = finder, problems, around
        self.prefer, self.limit, self.trials = prefer, limit, finder.trials
        self.begin, self.starts = (np.tile(q, (len(problems), 1)) for q in (begin, start))
        self.limits = self.trials.limits(problems)
        fixed = np.full(len(begin), np.nan) if problems.fixed is None else problems.fixed
        # What is given has no part in what is better.
        self.columns = np.flatnonzero(np.isnan(np.atleast_2d(fixed)).any(axis=0)).tolist()

    def run(self, seed: int, look: Look) -> Answers:
        """Their answers."""
        method = self.trials.method
        rounds = ROUNDS if look is Look.THOROUGH else 1
        outcome = method.run(self.problems, self.begin, seed, False, rounds)
        good = self.trials.solved(self.problems, outcome.q, self.problems.enforce_limits)
        rows = np.flatnonzero(good)
        hands = outcome.q[rows], rows
        q, owner, pairs = self._answers(*(hands if look is Look.OWN else self._hands(*hands)))
        if look is Look.THOROUGH and self.around is not None:
            left = rows[~np.isin(rows, owner)]
            more, whose = self._further(outcome.q, left, seed)
            q, owner = np.concatenate([q, more]), np.concatenate([owner, whose])
        reasons = np.array([Status(int(code)).name for code in outcome.status], dtype=object)
        # A method that is content with what the verdict refuses has come to a standstill.
        reasons[~good & (outcome.status == Status.SOLVED)] = Status.STALLED.name
        for row, pair in pairs.items():
            reasons[row] = f"{Status.COLLISION.name}: {pair[0]} and {pair[1]}"
        reasons[owner] = ""
        return Answers(q, owner, self._score(q, owner), self.finder.arm_margins(q), reasons)

    def _hands(self, q: Array, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        """Different hands that meet the contacts of candidates, with an arm for each.

        Args:
            q: (m, n) first answers.
            rows: (m,) the candidates that have them.
        """
        if not len(rows) or self.problems.palms is not None:
            return q, rows  # a hand that is given has no other posture
        some = self.problems.rows(rows)
        postures = self.trials.method.postures(some, 0)
        count, n = postures.shape[1], q.shape[1]
        owner = np.repeat(rows, count)
        asked = self.problems.rows(owner)
        starts = self.limits.of(owner).clip(self.begin[owner])
        flat = postures.reshape(len(owner), postures.shape[2])
        turns = np.tile(np.arange(count), len(rows))
        ends = self.trials.run(*self.trials.posture_rows(asked, starts, flat, turns))
        ends[~self.trials.solved(asked, ends, asked.enforce_limits)] = np.nan
        every = np.concatenate([q[:, None], ends.reshape(len(rows), count, n)], axis=1)
        kept: Bools = np.all(np.isfinite(every), axis=2)
        free = np.repeat(free_palms(self.finder.robot, some), count + 1)
        parts = self.finder.hand_parts(np.nan_to_num(every).reshape(-1, n), free)
        parts = parts.reshape(len(rows), count + 1, -1)
        for i in range(1, count + 1):
            apart = np.abs(parts[:, i, None] - parts[:, :i]).max(axis=2, initial=0) >= DISTINCT
            kept[:, i] &= (apart | ~kept[:, :i]).all(axis=1)
        place, which = np.nonzero(kept)
        return every[place, which], rows[place]

    def _answers(
        self, q: Array, owner: NDArray[np.intp]
    ) -> tuple[Array, NDArray[np.intp], dict[int, tuple[str, str]]]:
        """The preferred free arm of every branch of hands; and what is in the way of the others."""
        swings, around = self.finder.swings, self.around
        room = np.full(len(q), np.inf)
        if not len(q):
            return q, owner, {}
        if around is not None:
            nearby = around.rows(owner)
            room = (nearby if swings is None else nearby.held).check(q).room
        kept = np.flatnonzero(room >= -ROUNDING)
        found, targets = q[kept], owner[kept]
        if swings is not None:
            found, hand = self._arms(found, targets, room[kept])
            targets = targets[hand]
        if around is None:
            return found, targets, {}
        left = np.flatnonzero(~np.isin(owner, targets))
        # The last word has the hand with most room.
        left = left[np.argsort(room[left], kind="stable")]
        clear = around.rows(owner[left]).check(q[left])
        named = ((row, clear.pair(i)) for i, row in enumerate(owner[left].tolist()))
        return found, targets, {row: pair for row, pair in named if pair is not None}

    def _arms(
        self, q: Array, owner: NDArray[np.intp], room: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Free arms of hands, and whose hand it is; closer where the best of them are."""
        found, hand = self._swung(q, owner, room, False)
        score = self._score(found, owner[hand])
        best = np.argsort(-score, kind="stable")[: CLOSER * self.limit]
        again = np.unique(hand[best])
        more, mine = self._swung(q[again], owner[again], room[again], True)
        others = ~np.isin(hand, again)
        return np.concatenate([found[others], more]), np.concatenate([hand[others], again[mine]])

    def _swung(
        self, q: Array, owner: NDArray[np.intp], room: Array, closer: bool
    ) -> tuple[Array, NDArray[np.intp]]:
        swings = self.finder.swings
        assert swings is not None
        around = None if self.around is None else self.around.rows(owner)
        bounds = self.limits.first.lower, self.limits.first.upper
        starts = self.starts[owner]
        swung = swings.choose(q, starts, bounds, self.prefer, around, room, True, closer)
        if around is None or self.prefer != CLEARANCE:
            return swung.q, swung.owner
        free = around.rows(swung.owner).free(swung.q)
        return swung.q[free], swung.owner[free]

    def _further(
        self, q: Array, rows: NDArray[np.intp], seed: int
    ) -> tuple[Array, NDArray[np.intp]]:
        """What a single grasp would get."""
        assert self.around is not None
        if not len(rows):
            return q[rows], rows
        around = self.around.rows(rows)
        some = self.problems.rows(rows)
        found = self.finder.find(some, around, q[rows], self.begin[rows], seed)
        return found.q[found.free], rows[found.free]

    def _score(self, q: Array, owner: NDArray[np.intp]) -> Array:
        if not len(q):
            return np.zeros(0)
        room = np.zeros(len(q))
        if self.prefer == CLEARANCE and self.around is not None:
            room = self.around.rows(owner).check(q).room
        return self.finder.score(q, self.starts[owner], self.prefer, room, self.columns)
