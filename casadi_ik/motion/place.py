"""From where a hand holds an object to where it stands somewhere else, and the hand has left it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.motion.approach import ApproachPlan, ReachStatus, Tried, approaches
from casadi_ik.motion.clear import free_way, least_clearance
from casadi_ik.motion.reach import UP, Carried, Pace, Reach, failed, in_time, reached

PARTS = ("carrying", "lowering", "opening", "leaving")
"""Of a motion that places: over the place, straight down, off the object, straight back."""

CARRYING, LOWERING, OPENING, LEAVING = PARTS


@dataclass(frozen=True, eq=False)
class PlacePlan:
    """What a way on which an object is placed has to keep to.

    Attributes:
        approach: The grasp where the object is to stand, and how the hand leaves it: as it would
            come.
        carried: The robot with what it holds; None: nothing is checked.
        lower: From how far above the object comes straight down [m].
        pace: Its speed.
        seed: Of a planner.
    """

    approach: ApproachPlan
    carried: Carried | None
    lower: float
    pace: Pace
    seed: int


def place(asked: PlacePlan, q0: Array, solutions: Sequence[Array], why: str) -> Reach:
    """The way to the first of some postures over which the object can be placed.

    Args:
        asked: What to keep to.
        q0: (n,) where the robot is, holding the object.
        solutions: (n,) each, in which the hand has the object where it is to stand.
        why: Why there are none.
    """
    if not solutions:
        return failed(ReachStatus.NOT_SOLVED, why)
    reasons: list[tuple[ReachStatus, str]] = []
    for one in approaches(asked.approach, solutions):
        found = _placed(asked, q0, one)
        if found.success:
            return found
        reasons.append((found.status, found.reason))
    order = list(ReachStatus)
    status, reason = max(reasons, key=lambda one: order.index(one[0]))
    return failed(status, reason, len(solutions))


def _placed(asked: PlacePlan, q0: Array, one: Tried) -> Reach:
    """The way over one posture."""
    robot, carried, last = asked.approach.plan.robot, asked.carried, one.last
    if last is None:
        return failed(ReachStatus.NO_RETREAT, one.reason.replace("approach", "way back"))
    up = one.closer.straight(one.q, asked.lower * UP)
    if up is None:
        return failed(ReachStatus.NO_APPROACH, "the arm cannot follow the straight way down")
    down = up[::-1]
    if carried is not None and (reason := carried.blocked(down)):
        return failed(ReachStatus.NO_APPROACH, f"the way down is not free: {reason}")
    corners, how = free_way(robot, q0, down[0], carried, asked.seed)
    if corners is None:
        return failed(ReachStatus.NO_WAY, how)
    carrying = [(CARRYING, np.stack(pair)) for pair in pairwise(corners)]
    back = [(OPENING, last.closing[::-1]), (LEAVING, last.coming[::-1])]
    motion = in_time(robot, [*carrying, (LOWERING, down), *back], asked.pace)
    number = np.array([PARTS.index(part) for part in motion.notes["part"]])
    # Each begins where the one before ends.
    stands, free = (int((number <= PARTS.index(part)).sum()) for part in (LOWERING, OPENING))
    clearance, reason = None, ""
    if carried is not None and one.holding is not None and one.coming is not None:
        reason = carried.blocked(motion.q[:stands])
        reason = reason or least_clearance(one.holding, motion.q[stands - 1 : free])[1]
        clearance, why = least_clearance(one.coming, motion.q[free - 1 :])
        reason = reason or why
    if reason:
        return failed(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    return reached(f"way there: {how}", motion, one.q, clearance, one.number, asked.pace)
