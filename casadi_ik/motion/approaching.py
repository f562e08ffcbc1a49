"""The last part of the way to a grasp: a pre-grasp with open fingers, straight on, closing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.clear_between import least_clearance
from casadi_ik.motion.closing import Closer, LastPart
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.problems import Problems

SHORT = 5e-3
"""A palm that is nearer to its grasp before it [m] does not say from where it comes."""


class ReachStatus(Enum):
    """How it went.

    Example:
        >>> solver.reach(grasp).status is ik.ReachStatus.REACHED
        True
    """

    REACHED = "reached"
    """There is a motion, and what was to be checked is free all the way."""
    NOT_SOLVED = "not solved"
    """The grasp has no solution (`Solver.solve` says why)."""
    NO_APPROACH = "no approach"
    """From no solution the open hand can go straight back without touching anything."""
    NO_RETREAT = "no retreat"
    """With what it holds the hand cannot be lifted, or go back, as it was asked."""
    NO_WAY = "no way"
    """No way to a pre-grasp, or to a posture, was found."""


@dataclass(frozen=True, eq=False)
class Approach:
    """The last part of the way to a grasp.

    Attributes:
        status: REACHED, NO_APPROACH or NOT_SOLVED.
        reason: In words; "" if there is one.
        q: (n,) the solution of the grasp that it ends with; None if there is none.
        coming: (k, n) postures from the pre-grasp straight to where the hand closes, fingers open;
            None likewise.
        closing: (k, n) postures from there to the grasp; None likewise.
        clearance: Smallest distance before the hand closes [m]; None without a scene.
        tried: Solutions of the grasp that were looked at.

    Example:
        >>> found = solver.approach(grasp, distance=0.1)
        >>> found.success, bool(np.allclose(found.closing[-1], found.q))
        (True, True)
    """

    status: ReachStatus
    reason: str
    q: Array | None
    coming: Array | None
    closing: Array | None
    clearance: float | None
    tried: int

    @property
    def success(self) -> bool:
        """Whether there is one."""
        return self.status is ReachStatus.REACHED

    @property
    def pregrasp(self) -> Array | None:
        """(n,) where it begins."""
        return None if self.coming is None else self.coming[0]


@dataclass(frozen=True, eq=False)
class ApproachPlan:
    """What the last part of a way has to keep to.

    Attributes:
        plan: The robot, and the scene.
        problem: The grasp.
        opening: Of the hand before it closes [m].
        distance: Of the straight approach [m].
        direction: (3,) the way the hand comes, base frame; None: as the grasp has it.
        pregrasp: (3,) where the grasp has the palm before it, base frame [m]; None: not said.
    """

    plan: FollowPlan
    problem: Problems
    opening: float
    distance: float
    direction: Array | None = None
    pregrasp: Array | None = None

    def along(self, q: Array) -> Array | None:
        """(3,) the way the hand comes to a solution (n,); None: from the palm to the contacts."""
        if self.direction is not None or self.pregrasp is None:
            return self.direction
        way = self.plan.robot.palm(q)[:3, 3] - self.pregrasp
        return way if np.linalg.norm(way) > SHORT else None


@dataclass(frozen=True, eq=False)
class Tried:
    """What became of one solution of a grasp.

    Attributes:
        closer: Finds straight ways.
        number: Of the solution, from 1.
        q: (n,) the solution.
        last: The last part of the way; None if it cannot be gone.
        reason: Why not, "" if it can.
        open_handed: What is not to be touched before the hand closes; None: nothing is checked.
        holding: What is not to be touched while it closes; likewise.
    """

    closer: Closer
    number: int
    q: Array
    last: LastPart | None
    reason: str
    open_handed: Surroundings | None
    holding: Surroundings | None


def approaches(asked: ApproachPlan, solutions: Sequence[Array]) -> Iterator[Tried]:
    """What becomes of solutions (n,) of a grasp, in order."""
    closer = Closer(asked.plan)
    holding, open_handed = _surroundings(asked)
    for number, q in enumerate(solutions, start=1):
        last = closer.find(asked.problem, q, asked.opening, asked.distance, asked.along(q))
        reason = _blocked(last, holding, open_handed)
        yield Tried(closer, number, q, None if reason else last, reason, open_handed, holding)


def approach(asked: ApproachPlan, solutions: Sequence[Array], why: str) -> Approach:
    """The last part of the way to the first of some solutions for which there is one.

    Args:
        asked: What to keep to.
        solutions: (n,) each, of the grasp, best first.
        why: Why there are none.
    """
    if not solutions:
        return Approach(ReachStatus.NOT_SOLVED, why, None, None, None, None, 0)
    reason = ""
    for one in approaches(asked, solutions):
        if one.last is None:
            reason = reason or one.reason
            continue
        clearance = None
        if one.open_handed is not None:
            clearance, _ = least_clearance(one.open_handed, one.last.coming)
        return Approach(
            ReachStatus.REACHED, "", one.q, one.last.coming, one.last.closing, clearance, one.number
        )
    count = len(solutions)
    return Approach(ReachStatus.NO_APPROACH, reason, None, None, None, None, count)


def _surroundings(asked: ApproachPlan) -> tuple[Surroundings | None, Surroundings | None]:
    """What is checked while the hand closes, and before: then fingers touch no object either."""
    check, problem = asked.plan.check, asked.problem
    if check is None:
        return None, None
    one = np.zeros(1, dtype=np.intp)
    untouched = replace(problem, points=np.full_like(problem.points, np.nan))
    return check.around(problem).rows(one), check.around(untouched).rows(one)


def _blocked(
    last: LastPart | None,
    holding: Surroundings | None,
    open_handed: Surroundings | None,
) -> str:
    """Why the last part cannot be gone; "": it can."""
    if last is None:
        return "the arm cannot follow the straight way back"
    for name, postures, around in (
        ("the approach", last.coming, open_handed),
        ("the closing", last.closing, holding),
    ):
        if around is None or len(postures) < 2:
            continue
        _, touching = least_clearance(around, postures)
        if touching:
            return f"{name} is not free: {touching}"
    return ""
