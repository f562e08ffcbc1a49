"""Answers that touch nothing: other arms for the same hand, other hands, and steps away.

What is looked at, until one is free: all branches of the arm over all of its redundancy with the
hand as it is; the hand postures of every round, each with all its arms; of an arm of no family
descents from random arms; and steps about what is nearest, each brought back to the contacts. A
hand that touches something by itself, wherever its unconstrained fingers are put, is discarded
before any of its arms is looked at.

Of a body hands that touch something by themselves are moved by such steps first, side by side, then
by steps of what they touch within its tolerances; then come other trunks for the hands that are
left, other arms there, and so on with the hands of the next round (free_hands.py). At last trunk
and arms move about the nearest of what was found, palms kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import ROUNDING, Clearances, CollisionQuery
from casadi_ik.collision.distances import Table
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.solve.alternatives import AlternativeFinder, side_links
from casadi_ik.solve.arm_search import Preference
from casadi_ik.solve.batches import judge_outcome
from casadi_ik.solve.free_hands import SideHands, UnconstrainedFingers
from casadi_ik.solve.method import Outcome
from casadi_ik.solve.request import CLEARANCE
from casadi_ik.solve.solution import BatchSolution, CollisionReport
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trials import (
    Deduplicator,
    LocalRefinement,
    carry_palms,
    improving_rows,
    largest_per_owner,
    sample_trunks,
    side_palms,
)
from casadi_ik.solve.verdict import SolvedVerdict, judge_single

USUAL = "limits"
"""What is preferred where nothing is said."""

RANKED = ("manipulability", CLEARANCE)
"""Preferences for which an answer that is free already has to compete with all others."""


@dataclass(frozen=True)
class FreeSearchParameters:
    """How far answers that touch nothing are looked for.

    Attributes:
        together: Targets that are worked on at once.
        rounds: Of hand postures.
        alike: Hands all of whose motors differ by less [of their ranges] have the same arms.
        trunks: Trunks of a body that are tried, one lot after the other, and how many ways to
            combine hands of its sides share them. After each lot there is a round of hands.
        starts: Random arms that a target is solved from, where the arm is of no family.
        steps: About what is nearest to being free, one after the other [of motors' ranges].
        tries: Of such a step, in random directions; the best is taken. Of a robot with one hand and
            of a body. Source: `studies/bench.py --part clutter`, a KUKA LWR with a Barrett hand by
            turns with commit 508e6b5, which solves 472 of 650 targets: with 4, 8 and 12 it is 473,
            481 and 490, in 0.95, 1.04 and 1.11 times the time.
        aside: Steps of the motors of a body's hands. Source: of two Pandas with Allegro hands those
            of `steps` leave more to `within`: 1.9 to 2.5 ms a target instead of 1.5 to 1.6.
        within: Steps of contacts [of their tolerances], where those of motors do not help.
        kept: What a contact may be off such a place [of its tolerance].
        near: Answers of a body that are nearest, about which others are looked for at last.
        about: Steps of trunk and arms about these [of motors' ranges], and how far inside something
            they may be [m]. Source: of 300 targets of a G1 with Dex3 that are given hands touching
            nothing 211 got a free answer without these steps, 248 with them; a search of 6,000
            found 16 of those 37 and no other. Of 100 targets with any hands 7 got one, with steps
            of contacts as well 38.
        deep: What is farther inside something [m] is not got out of by such steps.
        left: As much for each of the steps, of an arm in closed form: for all, and for the hand
            inside itself, unless a hand is nearer to the scene. A target all of whose hands are
            farther inside themselves than at first is given up after a round of them. Source: of a
            KUKA LWR with a Barrett hand steps free 48 among 1,778 targets of
            `studies/collision.py` and 41 among 2,000 of `studies/bench.py`. A first step of 0.3
            (a seventh of whose ends meet the contacts) and one of 0.2, with an eighth in all and
            depths of 20, 18, 15, 12, 9, 6, 4 and 2 mm, free 50 and 43 in 1.9 and 1.1 times the
            time.
        hopeful: Hands with most room that are looked at for why there is no answer.
        least_range: What stands for the range of a motor that has none [rad or m].
    """

    together: int = 256
    rounds: int = 3
    alike: float = 0.02
    trunks: tuple[tuple[int, int], ...] = ((4, 1), (12, 2), (48, 4), (192, 8), (768, 16))
    starts: int = 24
    steps: tuple[float, ...] = (0.15, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    tries: tuple[int, int] = (12, 24)
    aside: tuple[float, ...] = (0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05)
    within: tuple[float, ...] = (1, 0.7, 0.5, 0.5, 0.35, 0.35, 0.25, 0.25, 0.18, 0.18, 0.12, 0.12)
    kept: float = 0.5
    near: int = 16
    about: tuple[tuple[float, float], ...] = (
        (0.2, 0.08),
        (0.2, 0.04),
        (0.1, 0.03),
        (0.1, 0.02),
        (0.1, 0.015),
        (0.05, 0.01),
        (0.05, 0.006),
        (0.05, 0.004),
    )
    deep: float = 0.02
    left: tuple[tuple[float, float], ...] = (
        (0.020, 0.006),
        (0.010, 0.003),
        (0.008, 0.002),
        (0.006, 0.001),
        (0.004, 0.001),
        (0.003, 0.001),
        (0.002, 0.001),
    )
    hopeful: int = 4
    least_range: float = 1e-9


PARAMETERS = FreeSearchParameters()


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
    reports: NDArray[np.object_]


def free_answers(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    starts: Array,
    seed: int,
    every: bool = False,
    reasons: bool = True,
) -> FreeAnswers:
    """Free answers of k targets.

    Args:
        finder: Of the robot.
        targets: The targets.
        query: What they are checked against.
        q: (k, n) answers, whether or not they are free.
        starts: (k, n) where the robot is.
        seed: Of random arms.
        every: Whether an answer that is free already competes with the others for being preferred,
            instead of being kept.
        reasons: Whether to find out if those without one would have one without the scene, or if
            the robot could pass through itself.
    """
    home = np.tile(finder.robot.home, (len(q), 1))
    biased = targets.prefer != USUAL or not np.array_equal(starts, home)
    found = _searched(finder, targets, query, q, starts, seed, every, reasons, steps=not biased)
    left = np.flatnonzero(~found.free)
    if not biased or not len(left):
        return found
    # A preference orders answers; whether there is one it does not decide. So steps out of a
    # collision, which lead to any answer, are left to the search without one.
    some, trials = replace(targets.rows(left), prefer=USUAL), finder.trials
    ends = trials.method.run(some, home[left], seed, False).q
    met = trials.solved(some, ends, some.enforce_limits)
    left, some, ends = left[met], some.rows(np.flatnonzero(met)), ends[met]
    asked = query.rows(left), ends, home[left]
    again = _searched(finder, some, *asked, seed, every=False, reasons=False, steps=True)
    taken = left[again.free]
    found.q[taken], found.free[taken], found.reports[taken] = again.q[again.free], True, None
    return found


def _searched(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    starts: Array,
    seed: int,
    every: bool,
    reasons: bool,
    steps: bool,
) -> FreeAnswers:
    """One search, see `free_answers`; with steps out of a collision if asked."""
    if not len(q):
        return FreeAnswers(q, np.zeros(0, dtype=bool), np.zeros(0, dtype=object))
    parts = []
    for first in range(0, len(q), PARAMETERS.together):
        rows = np.arange(first, min(first + PARAMETERS.together, len(q)))
        some = targets.rows(rows), query.rows(rows), starts[rows]
        search = FreeSearch(finder, *some, seed)
        if every:
            search.take(q[rows], np.arange(len(rows)))
        search.run(q[rows], every, steps)
        found = search.found(reasons)
        parts.append((found.q, found.free, found.reports))
    return FreeAnswers(*(np.concatenate(each) for each in zip(*parts, strict=True)))


class FreeSearch:
    """The search for some targets.

    Attributes:
        best: (k, n) the preferred of what is free so far.
        free: (k,) whether there is any.
        room: (k,) most that one of the hands has among its own links [m]; infinite if something
            of the scene is nearer.
    """

    def __init__(
        self,
        finder: AlternativeFinder,
        targets: TargetBatch,
        query: CollisionQuery,
        starts: Array,
        seed: int,
    ) -> None:
        self.finder, self.arm_search = finder, finder.arm_search
        self.targets, self.query = targets, query
        self.starts, self.seed = starts, seed
        self.trials = finder.trials
        self.limits = self.trials.limits(targets)
        count, n = starts.shape
        self.best, self.score = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.nearest, self.surplus = np.full((count, n), np.nan), np.full(count, -np.inf)
        self.free = np.zeros(count, dtype=bool)
        self.room = np.full(count, np.inf if self.arm_search is None else -np.inf)
        self.tried = np.zeros(count, dtype=np.int64)
        self.hands: list[tuple[Array, NDArray[np.intp], Array]] = []
        robot = finder.robot
        self._idle = UnconstrainedFingers(robot, targets)
        self._ranges = np.maximum(robot.upper - robot.lower, PARAMETERS.least_range)
        size = len(finder.hand) + 12 * bool(robot.description.arm_actuators)
        self._known, self._searched = (
            Deduplicator(count, size, PARAMETERS.alike) for _ in range(2)
        )
        self._fresh = np.ones(count, dtype=bool)
        self._near = np.zeros((0, n)), np.zeros(0, dtype=np.intp), np.zeros(0)
        self._sides: SideHands | None = None
        self._tries = PARAMETERS.tries[bool(robot.description.sides)]
        if robot.description.sides:
            own = side_links(robot.description), targets, query
            self._sides = SideHands(self.trials, *own, PARAMETERS.alike)

    @cached_property
    def _descent(self) -> LocalRefinement:
        return LocalRefinement(self.trials, self.targets)

    def run(self, q: Array, every: bool, steps: bool) -> None:
        """Look until all are free; or first, if asked, at the hands of a round whether or not."""
        self.try_hands(q, np.arange(len(q)))
        hands, sides = self.other_hands(every), self._sides
        for count, ways in PARAMETERS.trunks:
            if sides is None:
                break
            self._free_hands(sides)
            self._try_trunks(sides, count, ways)
            self.try_hands(*next(hands, (q[:0], np.zeros(0, np.intp))))
        for found, owner in chain(hands, self._from_anywhere()):
            self.try_hands(found, owner)
            # Of these a hand touches none of its own links, or hardly.
            self._fresh &= self.room > -PARAMETERS.left[0][1]
        if sides is not None:
            self._carry_about(sides)
        blocked = np.flatnonzero(~self.free)
        if len(blocked):
            self._find_nearest(blocked)
            if steps:
                self._escape()

    def take(self, q: Array, owner: NDArray[np.intp]) -> Array:
        """Keep the preferred free ones of configurations (m, n), and the nearest; their room."""
        if not len(q):
            return np.zeros(0)
        surplus = self.query.rows(owner).check(q).surplus
        rows = improving_rows(owner, surplus, self.surplus)
        self.nearest[owner[rows]], self.surplus[owner[rows]] = q[rows], surplus[rows]
        if self._sides is not None:
            every, of, room = self._near
            every, of = np.concatenate([every, q]), np.concatenate([of, owner])
            room = np.concatenate([room, surplus])
            some = largest_per_owner(of, room, PARAMETERS.near)
            self._near = every[some], of[some], room[some]
        kept = np.flatnonzero(surplus >= -ROUNDING)
        if len(kept):
            some, mine = q[kept], owner[kept]
            score = self.finder.score(
                some, self.starts[mine], self.targets.prefer, surplus=surplus[kept]
            )
            rows = improving_rows(mine, score, self.score)
            self.best[mine[rows]], self.score[mine[rows]] = some[rows], score[rows]
            self.free[mine[rows]] = True
        return surplus

    def try_hands(self, q: Array, owner: NDArray[np.intp]) -> None:
        """The preferred free arms of hands (m, n) of targets."""
        if not len(q):
            return
        q = self._idle.aside(q, owner, self.query.held)
        if self.arm_search is None:
            self.take(q, owner)
            if self._sides is not None:
                for side in range(len(self._sides.hands)):
                    self._sides.add(q, owner, side)
            self.hands.append((q, owner, np.zeros(len(q))))
            np.add.at(self.tried, owner, 1)
            self._fresh[owner] = True
            return
        held = self.query.rows(owner).held
        clear = held.check(q)
        surplus = clear.surplus
        # What stands about another hand may avoid.
        itself = np.append(held.table.within, False)[clear.pairs]
        np.maximum.at(self.room, owner, np.where(itself, surplus, np.inf))
        parts = self.finder.hand_parts(q)
        fresh = self._known.add(parts, owner)
        self._fresh[owner[fresh]] = True
        self.hands.append((q[fresh], owner[fresh], surplus[fresh]))
        kept = np.flatnonzero(surplus >= -ROUNDING)
        np.add.at(self.tried, owner[surplus < -ROUNDING], 1)
        kept = kept[self._searched.add(parts[kept], owner[kept])]
        kept = kept[self._in_order(q[kept], owner[kept])]
        found, mine, tried = self._arms(q[kept], owner[kept], surplus[kept], self.query)
        np.add.at(self.tried, owner[kept], tried)
        self.take(found, mine)

    def _in_order(self, q: Array, owner: NDArray[np.intp]) -> NDArray[np.intp]:
        """Hands target by target, the preferred ones first as far as the hand goes."""
        hand = self.finder.hand
        if self.targets.prefer == "q0":
            off = ((q - self.starts[owner]) / self._ranges)[:, hand]
            return np.lexsort((np.square(off).sum(axis=1), owner))
        return np.lexsort((-self.finder.score(q, q, "limits", hand), owner))

    def _arms(
        self,
        q: Array,
        owner: NDArray[np.intp],
        surplus: Array,
        query: CollisionQuery,
        prefer: Preference | None = None,
    ) -> tuple[Array, NDArray[np.intp], NDArray[np.int64]]:
        """Preferred arms of hands, their targets, and how many were tried for each hand."""
        arms = self.arm_search
        assert arms is not None
        asked = prefer or self.targets.prefer
        found = arms.choose(
            q,
            self.starts[owner],
            (self.limits.first.lower, self.limits.first.upper),
            asked,
            query.swung.rows(owner),
            surplus,
            of_one=owner if asked in ("limits", "q0") else None,
        )
        return *self._solved(found.q, owner[found.owner]), found.tried

    def _try_trunks(self, sides: SideHands, count: int, ways: int) -> None:
        """Look at other trunks of a body, and then at other arms there.

        Args:
            sides: The hands of its sides.
            count: Trunks of every target.
            ways: Of its hands, at most, which share them.
        """
        searches = self.finder.side_searches
        q, palms, owner = sides.mixed(np.flatnonzero(~self.free), ways)
        if not len(q):
            return
        first = sum(trunks for trunks, _ in PARAMETERS.trunks if trunks < count)
        each = max(count // int(np.bincount(owner).max()), 1)
        ends, of = sample_trunks(self.trials, self.targets, q, palms, owner, first, each)
        good = self.trials.solved(self.targets.rows(owner[of]), ends, self.targets.enforce_limits)
        ends, of = ends[good], of[good]
        self.take(ends, owner[of])
        left = np.flatnonzero(~self.free[owner[of]])
        if searches and len(left):
            some = ends[left], palms[of[left]], owner[of[left]]
            found = sides.arms(searches, *some, self.starts, self.targets.prefer)
            self.take(*self._solved(*found))

    def other_hands(self, every: bool = False) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Answers with other hands, of the targets that are not free, round by round."""
        method = self.trials.method
        for number in range(min(PARAMETERS.rounds, method.options.rounds, method.rounds)):
            # Where a round has brought no other hand, the next will not either.
            rows = np.flatnonzero((~self.free | (every and not number)) & self._fresh)
            if not len(rows):
                break
            self._fresh[:] = False
            postures = method.postures(self.targets.rows(rows), number)
            first, starts = number * postures.shape[1], self.limits.clip(self.starts)
            owner, *begun = self.trials.hand_rows(self.targets, rows, starts, postures, first)
            ends = self.trials.run(*begun)
            yield self._solved(ends, owner)

    def _from_anywhere(self) -> Iterator[tuple[Array, NDArray[np.intp]]]:
        """Answers with arms that are of no family, of the targets that are not free."""
        rows, robot, hand = np.flatnonzero(~self.free), self.finder.robot, self.finder.hand
        if not len(rows) or self.arm_search is not None:
            return
        count = PARAMETERS.starts
        owner = np.repeat(rows, count)
        numbers = np.array([self.targets.number(int(row)) for row in rows])
        starts = np.concatenate(_shifted(robot, self.seed, numbers, count))
        last = self.hands[0][0]
        starts[::2, hand] = last[owner[::2]][:, hand]
        ends = self._descent.run(owner, self.limits.of(owner).clip(starts))
        yield self._solved(ends, owner)

    def _solved(self, q: Array, owner: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp]]:
        if not len(q):
            return q, owner
        asked = self.targets.rows(owner)
        good = self.trials.solved(asked, q, asked.enforce_limits)
        return q[good], owner[good]

    def _find_nearest(self, rows: NDArray[np.intp]) -> None:
        """The answers with most room, of the hands with most."""
        if self.arm_search is None:
            return
        q, owner, surplus = self._hands_of(rows)
        kept = largest_per_owner(owner, surplus, 1)
        found, mine, _ = self._arms(q[kept], owner[kept], surplus[kept], self.query, CLEARANCE)
        self.take(np.concatenate([found, q[kept]]), np.concatenate([mine, owner[kept]]))

    def _hands_of(self, rows: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp], Array]:
        """All hands of some targets, their owners and their room."""
        q, owner, surplus = (np.concatenate(each) for each in zip(*self.hands, strict=True))
        mine = np.isin(owner, rows)
        return q[mine], owner[mine], surplus[mine]

    def _escape(self) -> None:
        """Move the configurations nearest to being free: random steps of motors and of contacts.

        Steps of motors are brought back to the contacts; steps of contacts stay within their
        tolerances. Source: of 1,000 targets each that free configurations meet at the edge of 5 mm
        and 3 deg among eight posts, without steps of contacts 29 (Panda with Allegro), 20 (KUKA LWR
        with Barrett) and 55 (UR5e with Shadow) got no free answer; with them 13, 5 and 17, in 1.3
        to 1.7 times the time.
        """
        steps = zip(PARAMETERS.steps, PARAMETERS.left, strict=True)
        for number, (part, (deep, of_hand)) in enumerate(steps):
            most = PARAMETERS.deep if self.arm_search is None else deep
            rows = np.flatnonzero(~self.free & (self.surplus > -most))
            if len(rows) and self.arm_search is not None:
                itself = self.query.among(self.query.table.of_robot).held.rows(rows)
                alone = itself.check(self.nearest[rows]).surplus
                rows = rows[(alone > -of_hand) | np.isinf(self.room[rows])]
            if not len(rows):
                return
            self.take(*self._steps_about(self.nearest[rows], rows, slice(None), number, part))
            for step in range(2 * number, min(2 * number + 2, len(PARAMETERS.within))):
                rows = rows[~self.free[rows]]
                if len(rows):
                    self.take(*self._within_tolerances(self.nearest[rows], rows, step))

    def _carry_about(self, sides: SideHands) -> None:
        """Trunk and arms of a body about what is nearest to being free, its palms kept."""
        robot, trials = self.finder.robot, self.trials
        moving = np.setdiff1d(np.arange(len(robot.lower)), self.finder.hand)
        hopeless = (sides.surplus < -ROUNDING).any(axis=0)
        for number, (part, deep) in enumerate(PARAMETERS.about):
            q, owner, room = self._near
            left = np.flatnonzero(~(self.free | hopeless)[owner] & (room > -deep))
            if not len(left):
                return
            rank = left - np.searchsorted(owner, owner[left])
            of = np.repeat(left, self._tries)
            q, owner = q[of], owner[of]
            begun, random = q.copy(), np.random.default_rng([self.seed, number])
            steps = random.standard_normal((PARAMETERS.near, self._tries, len(moving)))
            begun[:, moving] += part * self._ranges[moving] * steps[rank].reshape(-1, len(moving))
            begun, palms = self.limits.of(owner).clip(begun), side_palms(robot, q)
            ends = carry_palms(trials, self.targets, begun, palms, owner, float(Phase.TRUNK))
            self.take(*self._solved(ends, owner))

    def _free_hands(self, sides: SideHands) -> None:
        """Hands of a body's sides that touch something by themselves moved aside."""
        first = len(PARAMETERS.aside)
        for side, motors in enumerate(sides.hands):
            for number in range(first + len(PARAMETERS.within)):
                surplus = np.where(self.free, 0.0, sides.surplus[side])
                rows = np.flatnonzero((surplus < -ROUNDING) & (surplus > -PARAMETERS.deep))
                if not len(rows):
                    break
                nearest = sides.nearest[side][rows]
                if number < first:
                    part = PARAMETERS.aside[number]
                    found = self._steps_about(nearest, rows, motors, number, part)
                else:
                    found = self._within_tolerances(nearest, rows, number - first)
                sides.add(*found, side, best=True)

    def _within_tolerances(
        self, q: Array, rows: NDArray[np.intp], number: int
    ) -> tuple[Array, NDArray[np.intp]]:
        """Answers about answers (k, n) to some targets: steps of contacts, within tolerances."""
        tries, part = self._tries, PARAMETERS.within[number]
        owner, starts = np.repeat(rows, tries), np.repeat(q, tries, axis=0)
        targets, begun = self.targets.rows(owner), self.finder.robot.contacts(starts)
        random, moved = np.random.default_rng([self.seed, number]), []
        asked = (
            (targets.points, targets.position_tolerance),
            (targets.normals, targets.angle_tolerance),
        )
        for at, (wanted, most) in zip(begun, asked, strict=True):
            steps = np.tile(random.standard_normal((tries, *at.shape[1:])), (len(rows), 1, 1))
            off = (at - wanted) / most[:, None] + part * steps
            off /= np.maximum(1.0, np.linalg.norm(off, axis=2, keepdims=True))
            moved.append(wanted + off * most[:, None])
        points, normals = moved[0], moved[1] / np.linalg.norm(moved[1], axis=2, keepdims=True)
        closer = tuple(
            Tolerance(PARAMETERS.kept * each.position, PARAMETERS.kept * each.angle)
            for each in targets.tolerances
        )
        shifted = replace(targets, points=points, normals=normals, tolerance=closer)
        ends = LocalRefinement(self.trials, shifted).run(np.arange(len(owner)), starts)
        return self._solved(ends, owner)

    def _steps_about(
        self, q: Array, rows: NDArray[np.intp], motors: list[int] | slice, number: int, part: float
    ) -> tuple[Array, NDArray[np.intp]]:
        """Answers about answers (k, n) to some targets: steps of some motors, brought back."""
        owner = np.repeat(rows, self._tries)
        ranges = self._ranges[motors]
        random = np.random.default_rng([self.seed, number])
        steps = random.standard_normal((self._tries, len(ranges)))
        starts = np.repeat(q, self._tries, axis=0)
        starts[:, motors] += part * ranges * np.tile(steps, (len(rows), 1))
        ends = self._descent.run(owner, self.limits.of(owner).clip(starts))
        return self._solved(ends, owner)

    def found(self, reasons: bool) -> FreeAnswers:
        """What it came to; whether it would work without the scene or the robot, if asked."""
        q = np.where(self.free[:, None], self.best, self.nearest)
        reports = np.full(len(q), None, dtype=object)
        blocked = np.flatnonzero(~self.free)
        if not len(blocked):
            return FreeAnswers(q, self.free, reports)
        clear = self.query.rows(blocked).check(q[blocked])
        table = self.query.table
        alone = self._possible(blocked, table.of_robot) if reasons else None
        passing = self._possible(blocked, table.of_scene) if reasons else None
        for i, row in enumerate(blocked.tolist()):
            pair = clear.pair(i)
            assert pair is not None
            reports[row] = CollisionReport(
                pair,
                -float(clear.surplus[i]),
                int(self.tried[row]),
                None if alone is None else bool(alone[row]),
                None if passing is None else bool(passing[row]),
            )
        return FreeAnswers(q, self.free, reports)

    def _possible(self, rows: NDArray[np.intp], table: Table) -> NDArray[np.bool_]:
        """(all targets,) whether one of the hands is free of some of the pairs alone."""
        query = self.query.among(table)
        q, owner, surplus = self._hands_of(rows)
        possible = np.zeros(len(self.free), dtype=bool)
        if self.arm_search is None:
            possible[owner[query.rows(owner).free(q)]] = True
            return possible
        kept = np.flatnonzero(query.rows(owner).held.free(q))
        kept = kept[largest_per_owner(owner[kept], surplus[kept], PARAMETERS.hopeful)]
        any_room = np.full(len(kept), np.inf)
        _, mine, _ = self._arms(q[kept], owner[kept], any_room, query, "limits")
        possible[mine] = True
        return possible


def _shifted(robot: ArmHand, seed: int, numbers: NDArray[np.intp], count: int) -> Array:
    """(k, count, n) configurations, spread over the limits for each target in its own way.

    A random cloud, for each target shifted around in the limits, by its number alone: whichever
    others are looked at with it.
    """
    cloud = np.random.default_rng(seed).random((count, len(robot.lower)))
    shift = numbers[:, None] * spread_steps(len(robot.lower))
    part = (cloud + shift[:, None]) % 1.0
    return robot.lower + part * (robot.upper - robot.lower)


def resolve_collisions(
    finder_of: Callable[[TargetBatch], AlternativeFinder],
    targets: TargetBatch,
    query: CollisionQuery,
    starts: Array,
    seed: int,
    outcome: Outcome,
    batch: BatchSolution,
    reasons: bool = True,
) -> BatchSolution:
    """The verdicts on a batch after other answers were looked for where they touch something.

    Args:
        finder_of: By targets of one kind the finder for them.
        targets: k targets.
        query: What they are checked against.
        starts: (k, n) where the robot is.
        seed: Of all random numbers.
        outcome: What the method came to.
        batch: The verdicts on it.
        reasons: Whether the reports say what else would do, see `free_answers`.
    """
    every = targets.prefer in RANKED
    touching = batch.status == Status.COLLISION
    rows = np.flatnonzero(touching | batch.success if every else touching)
    if not len(rows):
        return batch
    begin, q = time.perf_counter(), batch.q.copy()
    reports = np.array(batch.collisions, dtype=object)
    numbers = np.array([targets.number(row) for row in rows.tolist()], dtype=np.intp)
    # A target's random numbers are its own, whichever others are looked at with it.
    asked = replace(targets.rows(rows), picked=numbers)
    robot = finder_of(asked.rows(slice(0, 1))).robot
    for _, of_kinds, some in group_by_kinds(asked):
        chosen = rows[of_kinds]
        nearby, begun = query.rows(chosen), (q[chosen], starts[chosen])
        found = free_answers(finder_of(some), some, nearby, *begun, seed, every, reasons)
        q[chosen] = found.q
        reports[chosen] = found.reports
    seconds = batch.time.copy()
    seconds[rows] += (time.perf_counter() - begin) / len(rows)
    status = np.where(touching, int(Status.SOLVED), outcome.status)
    ended = replace(outcome, q=q, time=seconds, status=status)
    return replace(
        judge_outcome(robot, batch.method, targets, ended, query),
        collisions=tuple(reports.tolist()),
    )


def resolve_at_once(
    finder: AlternativeFinder,
    targets: TargetBatch,
    query: CollisionQuery,
    q: Array,
    start: Array,
    others: bool = False,
) -> tuple[Array, SolvedVerdict, Clearances] | None:
    """Another arm for the hand of one answer that touches something, judged; None: look further.

    What it gives is what `resolve_collisions` gives, which looks there first.

    Args:
        finder: For the target's kinds.
        targets: One target.
        query: What it is checked against.
        q: (n,) the answer.
        start: (n,) where the robot is.
        others: Whether to look at the hands of further rounds, too, as an exported solver does.
    """
    search = FreeSearch(finder, targets, query, start[None], 0)
    search.try_hands(q[None], np.zeros(1, dtype=np.intp))
    if others:
        for hands, owner in search.other_hands():
            search.try_hands(hands, owner)
    if not search.free[0]:
        return None
    found = search.best[0]
    verdict = judge_single(finder.robot, targets, found)
    if verdict is None:
        return None
    clear = query.check(found[None])
    return (found, verdict, clear) if clear.free[0] else None
