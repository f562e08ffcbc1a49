"""Answers that touch nothing, for batches of targets and at once for one."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.problems import Problems
from casadi_ik.solving.alternatives.finder import AlternativeFinder
from casadi_ik.solving.alternatives.free_search import FreeAnswers, FreeSearch, score_of
from casadi_ik.solving.alternatives.swings import ArmSwings, Preference

TOGETHER = 128
"""Targets that are worked on at once."""

USUAL = "limits"
"""What is preferred where nothing is said."""


class FreeFinder:
    """Finds answers that touch nothing, on one robot.

    Attributes:
        robot: The robot.
        trials: The loop of hand-first.
        hand_parts: What tells hands apart, see `AlternativeFinder`.
    """

    def __init__(self, finder: AlternativeFinder, compiled: bool = True) -> None:
        """Take what enumerates solutions."""
        self._finder = finder
        self.robot, self.trials = finder.robot, finder.trials
        self.hand_parts = finder.hand_parts
        self._compiled = compiled

    @cached_property
    def swings(self) -> ArmSwings | None:
        """All arms of hands; None for an arm without a closed form, and without an arm."""
        arm = self.trials.method.step.arm
        if arm is None:
            return None
        return ArmSwings(self.robot, arm, lambda: self._finder.manipulability, self._compiled)

    def find(
        self,
        problems: Problems,
        around: Surroundings,
        q: Array,
        starts: Array,
        seed: int,
        every: bool = False,
        reasons: bool = True,
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
            reasons: Whether to find out if those without one would have one without the scene, or
                if the robot could pass through itself.
        """
        found = self._look(problems, around, q, starts, seed, every, reasons)
        home = np.tile(self.robot.home, (len(q), 1))
        biased = problems.prefer != USUAL or not np.array_equal(starts, home)
        left = np.flatnonzero(~found.free)
        if not biased or not len(left):
            return found
        # A preference orders answers; whether there is one it does not decide.
        some = replace(problems.rows(left), prefer=USUAL)
        ends = self.trials.method.run(some, home[left], seed, False).q
        met = self.trials.solved(some, ends, some.enforce_limits)
        left, some, ends = left[met], some.rows(np.flatnonzero(met)), ends[met]
        again = self._look(some, around.rows(left), ends, home[left], seed)
        return found.with_free(left, again)

    def _look(
        self,
        problems: Problems,
        around: Surroundings,
        q: Array,
        starts: Array,
        seed: int,
        every: bool = False,
        reasons: bool = False,
    ) -> FreeAnswers:
        """One search, see `find`."""
        if not len(q):
            return FreeAnswers(q, np.zeros(0, dtype=bool), ())
        parts = []
        for first in range(0, len(q), TOGETHER):
            rows = np.arange(first, min(first + TOGETHER, len(q)))
            search = FreeSearch(
                self._finder,
                self.swings,
                problems.rows(rows),
                around.rows(rows),
                starts[rows],
                seed,
            )
            if every:
                search.take(q[rows], np.arange(len(rows)))
            search.run(q[rows], every)
            parts.append(search.found(reasons))
        reports = tuple(report for part in parts for report in part.reports)
        return FreeAnswers(
            np.concatenate([part.q for part in parts]),
            np.concatenate([part.free for part in parts]),
            reports,
        )

    def beside(
        self,
        problems: Problems,
        around: Surroundings,
        q: Array,
        starts: Array,
        others: bool = False,
    ) -> Array | None:
        """The first that `find` looks at for one target: another arm (n,) for the same hand.

        Args:
            problems: One target.
            around: What it is checked against.
            q: (1, n) an answer that is not free.
            starts: (1, n) where the robot is.
            others: Whether to look at what comes next, too: the hands of further rounds.
        """
        search = FreeSearch(self._finder, self.swings, problems, around, starts, 0)
        search.swing(q, np.zeros(1, dtype=np.intp))
        if others:
            for hands, owner in search.of_rounds():
                search.swing(hands, owner)
        return search.best[0] if search.free[0] else None

    def arm_margins(self, q: Array) -> Array:
        """(m,) smallest distance of the arm from its limits, as a part of half its range."""
        return self._finder.arm_margins(q)

    def score(
        self,
        q: Array,
        starts: Array,
        prefer: Preference,
        room: Array,
        columns: list[int] | None = None,
    ) -> Array:
        """(m,) what is preferred, higher is better.

        Args:
            q: (m, n) configurations.
            starts: (m, n) where the robot is.
            prefer: What is preferred.
            room: (m,) for "clearance".
            columns: Motors whose distance from the limits counts; None: all.
        """
        return score_of(self._finder, q, starts, prefer, room, columns)
