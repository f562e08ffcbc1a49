"""From where a robot is to a grasp: the way there, the straight approach, the closing, in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.closing import Closer, LastPart
from casadi_ik.motion.free_space import dense, free_way, motor_units
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.motion.rates import Rates
from casadi_ik.motion.timing import timed
from casadi_ik.problem.clearance import Surroundings
from casadi_ik.problem.problems import Problems

PARTS = ("going", "coming", "closing")
"""Of a motion: to the pre-grasp, straight to the object, around it."""


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
    NO_WAY = "no way"
    """No way to a pre-grasp was found."""


@dataclass(frozen=True, eq=False)
class Reach:
    """The way to a grasp.

    Attributes:
        status: How it went.
        reason: In words.
        motion: From q0 at rest to the grasp at rest; its note "part" says which of `PARTS` each
            time belongs to. None if there is none.
        q: (n,) the solution of the grasp that it ends with; None likewise.
        clearance: Smallest distance on the way before the hand closes [m]; None without a scene.
        tried: Solutions of the grasp that were looked at.

    Example:
        >>> found = solver.reach(grasp)
        >>> found.success, bool(np.allclose(found.motion.q[-1], found.q))
        (True, True)
    """

    status: ReachStatus
    reason: str
    motion: Motion | None
    q: Array | None
    clearance: float | None
    tried: int

    @property
    def success(self) -> bool:
        """Whether there is a motion."""
        return self.status is ReachStatus.REACHED


@dataclass(frozen=True, eq=False)
class ReachPlan:
    """What a way to a grasp has to keep to.

    Attributes:
        plan: The robot, and the scene.
        problem: The grasp.
        rates: Limits of the motion.
        period: Time between two samples [s].
        opening: Of the hand before it closes [m].
        distance: Of the straight approach [m].
        seed: Of a planner.
    """

    plan: FollowPlan
    problem: Problems
    rates: Rates
    period: float
    opening: float
    distance: float
    seed: int


def reach(asked: ReachPlan, q0: Array, solutions: Sequence[Array]) -> Reach:
    """The way to the first of some solutions to which there is one.

    Args:
        asked: What to keep to.
        q0: (n,) where the robot is.
        solutions: (n,) each, of the grasp, best first.
    """
    if not solutions:
        return Reach(ReachStatus.NOT_SOLVED, "the grasp has no solution", None, None, None, 0)
    closer = Closer(asked.plan)
    holding, open_handed = _surroundings(asked)
    reasons: list[tuple[ReachStatus, str]] = []
    for tried, q in enumerate(solutions, start=1):
        last = closer.find(asked.problem, q, asked.opening, asked.distance)
        blocked = _blocked(asked, last, holding, open_handed)
        if last is None or blocked:
            reasons.append((ReachStatus.NO_APPROACH, blocked))
            continue
        corners, how = free_way(asked.plan.robot, q0, last.coming[0], open_handed, asked.seed)
        if corners is None:
            reasons.append((ReachStatus.NO_WAY, how))
            continue
        motion = _motion(asked, corners, last)
        part = motion.notes["part"]
        before = motion.q[part != PARTS[2]]
        if open_handed is not None and not open_handed.free(before).all():
            reasons.append((ReachStatus.NO_WAY, "the timed motion is not free between its points"))
            continue
        clearance = None
        if open_handed is not None:
            clearance = float(open_handed.check(before).distance.min())
        return Reach(ReachStatus.REACHED, f"way there: {how}", motion, q, clearance, tried)
    # That which came farthest says most.
    status, reason = max(reasons, key=lambda one: one[0] is ReachStatus.NO_WAY)
    return Reach(status, reason, None, None, None, len(solutions))


def _surroundings(asked: ReachPlan) -> tuple[Surroundings | None, Surroundings | None]:
    """What is checked while the hand closes, and before: then fingers touch no object either."""
    check, problem = asked.plan.check, asked.problem
    if check is None:
        return None, None
    one = np.zeros(1, dtype=np.intp)
    untouched = replace(problem, points=np.full_like(problem.points, np.nan))
    return check.around(problem).rows(one), check.around(untouched).rows(one)


def _blocked(
    asked: ReachPlan,
    last: LastPart | None,
    holding: Surroundings | None,
    open_handed: Surroundings | None,
) -> str:
    """Why the last part cannot be gone; "": it can."""
    if last is None:
        return "the arm cannot follow the straight way back"
    units = motor_units(asked.plan.robot)
    for name, postures, around in (
        ("the approach", last.coming, open_handed),
        ("the closing", last.closing, holding),
    ):
        if around is None or len(postures) < 2:
            continue
        looked_at = dense(postures, units)
        found = around.check(looked_at)
        if not found.free.all():
            pair = found.pair(int(np.argmin(found.room)))
            assert pair is not None
            return f"{name} is not free: {pair[0]} and {pair[1]} touch"
    return ""


def _motion(asked: ReachPlan, corners: Array, last: LastPart) -> Motion:
    """All parts in time, at rest between them."""
    robot = asked.plan.robot
    straight = [corners[i : i + 2] for i in range(len(corners) - 1)]
    parts = [(PARTS[0], way) for way in straight] + [(PARTS[1], last.coming)]
    parts.append((PARTS[2], last.closing))
    done = [(name, timed(way, asked.rates, asked.period)) for name, way in parts]
    names, times, end = [PARTS[0]], [np.zeros(1)], 0.0
    for name, one in done:
        times.append(end + one.times[1:])
        end += float(one.times[-1])
        names += [name] * (len(one.times) - 1)
    still = np.zeros_like(corners[:1])
    return Motion(
        robot,
        np.concatenate(times),
        np.clip(np.concatenate([corners[:1], *(one.q[1:] for _, one in done)]), *asked.plan.bounds),
        np.concatenate([still, *(one.velocity[1:] for _, one in done)]),
        np.concatenate([still, *(one.acceleration[1:] for _, one in done)]),
        {"part": np.array(names)},
    )
