"""Finds out why a grasp cannot be solved: by solving it again with less asked."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.grasps import Tolerance
from casadi_ik.solvers.diagnosis import ArmReach, Diagnosis, Freed, HandFit, NearContact, Reason
from casadi_ik.solvers.hand_first import HandFirstMethod
from casadi_ik.solvers.minimax import MARGIN, Closest, closest
from casadi_ik.solvers.palm_free import palm_free
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.solvers.reliefs import Lift, lifts, relieve
from casadi_ik.solvers.trials import Bounds, Descent, Trials, repeated
from casadi_ik.solvers.verdict import judge

ROUNDS = 2
"""First rounds of hand-first whose hand fits are looked at, and further rounds than it makes."""

RANDOM_STARTS = 24
"""Random configurations the last search starts from, besides those found on the way."""

NEAR = 8.0
"""If the contacts are missed by less than this factor, the search starts from more than what hand-
first came to, whatever hand and reach say."""

CLOSE, CLOSE_STARTS = 2.0, 256
"""If they are missed by less than this, from many more."""

FOLLOWED = 8
"""Local minima that are followed to the end."""

AT_LIMIT = 1e-6
"""How near to a limit counts as at it [rad or m]."""

REAL = 1e-3
"""How far an arm's reach has to be missed to be the reason [m]."""


@dataclass(frozen=True, eq=False)
class _Freeing:
    part: str
    finger: str
    problems: Problems


class Diagnostician:
    """Diagnoses grasps on one robot, whichever method failed.

    Attributes:
        robot: The robot.
        method: Hand-first on that robot.
    """

    def __init__(self, robot: ArmHand, method: HandFirstMethod) -> None:
        """Keep robot and method; nothing is built before the first diagnosis."""
        self.robot = robot
        self.method = method
        self._trials = Trials(robot, method)

    def diagnose(self, problems: Problems, q0: Array, nearest: Array | None) -> Diagnosis:
        """Diagnose one grasp.

        Args:
            problems: One target.
            q0: (n,) start.
            nearest: (n,) what hand-first came to; None if another method was asked.
        """
        self.method.prepare()
        begin = time.perf_counter()
        if nearest is not None:
            return self._why(problems, q0, nearest, begin)
        found = self.method.run(problems, q0[None], 0, trace=False).q[0]
        if self._solves(problems, found):
            return self._reachable(problems, found, begin)
        return self._why(problems, q0, found, begin)

    def _why(self, problems: Problems, q0: Array, nearest: Array, begin: float) -> Diagnosis:
        hand, reach, ends = self._hand(problems, q0)
        limits = self._trials.limits(problems)
        pool = np.concatenate([nearest[None], ends])
        best = closest(self._trials, problems, pool, limits, FOLLOWED)
        relaxed, freed, relieved = self._relaxations(problems, q0, best, limits, hand)
        # Where neither the hand nor the reach says no, only searching can.
        if best.ratio < NEAR or _reason(hand, reach, False) is Reason.NOT_FOUND:
            pool = np.concatenate([pool, relieved])
            pool = self._search(problems, limits, pool, RANDOM_STARTS)
            best = closest(self._trials, problems, pool, limits, FOLLOWED)
        if best.ratio < CLOSE and not self._solves(problems, best.fair):
            pool = np.concatenate([pool, best.fair[None]])
            pool = self._search(problems, limits, pool, CLOSE_STARTS)
            best = closest(self._trials, problems, pool, limits, 4 * FOLLOWED)
        if self._solves(problems, best.fair):
            return self._reachable(problems, best.fair, begin)
        reliefs = tuple(relieve(self._trials, problems, limits, relaxed, best.q))
        reason = _reason(hand, reach, bool(reliefs))
        verdict = judge(self.robot, problems, best.fair[None])
        largest = problems.largest_tolerance
        return Diagnosis(
            reason=reason,
            established=reason is not Reason.NOT_FOUND and best.ratio >= MARGIN,
            hand=hand,
            reach=reach,
            active=self._active(best.q) if problems.enforce_limits else (),
            reliefs=reliefs,
            freed=freed,
            enough=Tolerance(
                max(float(np.nanmax(verdict.position_error)), largest.position),
                max(_largest(verdict.angle_error), largest.angle),
            ),
            nearest=self._contacts(problems, best.q),
            q=best.q,
            time=time.perf_counter() - begin,
        )

    def _solves(self, problems: Problems, q: Array) -> bool:
        return bool(self._trials.solved(problems, q[None], problems.enforce_limits)[0])

    def _hand(self, problems: Problems, q0: Array) -> tuple[HandFit | None, ArmReach | None, Array]:
        """The hand alone, the arm where the hand fits, and the configurations that came up."""
        if not self.robot.description.arm_actuators:
            return None, None, np.zeros((0, len(q0)))
        made = self.method.options.rounds
        numbers = [*range(min(ROUNDS, made)), *range(made, made + ROUNDS)]
        postures, ends = self._trials.rounds(problems, q0, self._trials.limits(problems), numbers)
        fits = palm_free(self.robot, problems, postures)
        hand, arm = fits.fit(self.robot, problems), self.method.step.arm
        if arm is None or not hand.fits:
            return hand, None, ends
        return hand, fits.reach(arm, problems.enforce_limits), ends

    def _relaxations(
        self, problems: Problems, q0: Array, best: Closest, limits: Bounds, hand: HandFit | None
    ) -> tuple[list[tuple[Lift, Array]], tuple[Freed, ...], Array]:
        """Solve with limits lifted or something left free, all together.

        Limits that nothing presses against in the nearest configurations would not help; where
        little is missing they are lifted all the same, as further starts.

        Returns:
            The lifts that solve it with their solutions, what may be left free, and all
            configurations that came up.
        """
        hand_only = hand is not None and not hand.fits
        movable = limits.lower < limits.upper
        pressed = movable.copy()
        if best.ratio > CLOSE:
            pressed &= self._at_limit(best.q) | self._at_limit(best.fair)
        tried = lifts(self.robot, movable, pressed, hand_only) if problems.enforce_limits else []
        freeings = self._freeings(problems)
        parts = [problems] * len(tried) + [item.problems for item in freeings]
        if not parts:
            return [], (), np.zeros((0, len(q0)))
        asked = replace(
            problems,
            points=np.concatenate([part.points for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
        )
        bounds = limits.tiled(len(parts))
        for i, lift in enumerate(tried):
            lift.widen(self.robot, bounds, i)
        q = Descent(self._trials, asked).run(np.tile(best.q, (len(parts), 1)), bounds)
        ok = self._trials.solved(asked, q, limits=False)
        rest = np.flatnonzero(~ok)
        if len(rest):
            left = Bounds(bounds.lower[rest], bounds.upper[rest])
            q[rest] = self._trials.search(asked.rows(rest), q0, left)
            ok[rest] = self._trials.solved(asked.rows(rest), q[rest], limits=False)
        ok &= (bounds.beyond(q) == 0).all(axis=1)
        relaxed = [(lift, q[i]) for i, lift in enumerate(tried) if ok[i]]
        free = [
            Freed(item.part, item.finger, q[i])
            for i, item in enumerate(freeings, start=len(tried))
            if ok[i]
        ]
        return relaxed, tuple(free), q

    def _freeings(self, problems: Problems) -> list[_Freeing]:
        """The target with a finger, a normal or all normals left free."""
        found = []
        known = ~np.isnan(problems.points[0, :, 0])
        faced = ~np.isnan(problems.normals[0, :, 0])
        for i, name in enumerate(self.robot.fingers):
            points, normals = problems.points.copy(), problems.normals.copy()
            normals[0, i] = np.nan
            if faced[i]:
                found.append(_Freeing("normal", name, replace(problems, normals=normals)))
            if known[i] and known.sum() > 1:
                points[0, i] = np.nan
                freed = replace(problems, points=points, normals=normals)
                found.append(_Freeing("finger", name, freed))
        if faced.sum() > 1:
            none = np.full_like(problems.normals, np.nan)
            found.append(_Freeing("normal", "all", replace(problems, normals=none)))
        return found

    def _search(self, problems: Problems, limits: Bounds, pool: Array, count: int) -> Array:
        """The problem itself again, from all that came up and from random configurations."""
        random = self.robot.random(np.random.default_rng(count), count)
        starts = np.concatenate([pool, random])
        descent = Descent(self._trials, repeated(problems, len(starts)))
        return descent.run(descent.run(starts, limits), limits)

    def _at_limit(self, q: Array) -> NDArray[np.bool_]:
        return (q - self.robot.lower <= AT_LIMIT) | (self.robot.upper - q <= AT_LIMIT)

    def _active(self, q: Array) -> tuple[str, ...]:
        pairs = zip(self.robot.actuators, self._at_limit(q), strict=True)
        return tuple(name for name, held in pairs if held)

    def _contacts(self, problems: Problems, q: Array) -> dict[str, NearContact]:
        points, normals = self.robot.contacts(q)
        verdict = judge(self.robot, problems, q[None])
        return {
            name: NearContact(
                _triple(points[i]),
                _triple(normals[i]),
                float(verdict.position_error[0, i]),
                float(verdict.angle_error[0, i]),
            )
            for i, name in enumerate(self.robot.fingers)
        }

    def _reachable(self, problems: Problems, q: Array, begin: float) -> Diagnosis:
        return Diagnosis(
            reason=Reason.REACHABLE,
            established=False,
            hand=None,
            reach=None,
            active=(),
            reliefs=(),
            freed=(),
            enough=problems.largest_tolerance,
            nearest=self._contacts(problems, q),
            q=q,
            time=time.perf_counter() - begin,
        )


def _reason(hand: HandFit | None, reach: ArmReach | None, relieved: bool) -> Reason:
    if hand is not None and not hand.fits:
        return Reason.HAND
    if reach is not None and abs(reach.excess) > REAL:
        return Reason.REACH
    return Reason.LIMITS if relieved else Reason.NOT_FOUND


def _largest(errors: Array) -> float:
    return 0.0 if np.isnan(errors).all() else float(np.nanmax(errors))


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
