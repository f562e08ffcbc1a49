"""From where a robot is to a grasp, or a posture, in time: the way there, the approach, closing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.motion.approaching import ApproachPlan, ReachStatus, Tried, approaches
from casadi_ik.motion.carrying import Carried
from casadi_ik.motion.clear_between import least_clearance
from casadi_ik.motion.closing import LastPart
from casadi_ik.motion.free_space import free_way
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.rates import Rates, shares
from casadi_ik.motion.timing import timed
from casadi_ik.problem.clearance import Surroundings

PARTS = ("going", "coming", "closing", "lifting", "retreating")
"""Of a motion: to the pre-grasp, straight to the object, around it, up and back with it."""

GOING, COMING, CLOSING, LIFTING, RETREATING = PARTS

UP = np.array([0.0, 0.0, 1.0])
"""Of the base frame."""


@dataclass(frozen=True, eq=False)
class Reach:
    """The way to a grasp, or to a posture.

    Attributes:
        status: How it went.
        reason: In words.
        motion: From q0 at rest to the grasp at rest, and on if it was asked for; its note "part"
            says which of `PARTS` each time belongs to. None if there is none.
        q: (n,) the solution of the grasp where the hand has closed, or the posture that was asked
            for; None likewise.
        clearance: Smallest distance on the way before the hand closes [m], as `Clearances` counts
            it, between samples too: it is nowhere less by more than 0.1 mm. None without a scene.
        tried: Solutions of the grasp that were looked at.
        velocity_share: Largest part of a motor's velocity limit that the samples take, by their
            first differences; 0 without a motion.
        acceleration_share: Likewise of the acceleration, by second differences.

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
    velocity_share: float = 0.0
    acceleration_share: float = 0.0

    @property
    def success(self) -> bool:
        """Whether there is a motion."""
        return self.status is ReachStatus.REACHED


@dataclass(frozen=True, eq=False)
class Pace:
    """How fast a motion is.

    Attributes:
        rates: Its limits.
        period: Time between two samples [s].
    """

    rates: Rates
    period: float


@dataclass(frozen=True, eq=False)
class ReachPlan:
    """What a way to a grasp has to keep to.

    Attributes:
        approach: What its last part has to keep to.
        pace: Its speed.
        seed: Of a planner.
        lift: How far the hand goes straight up after it closed [m].
        retreat: How far it goes back then, against the way it came [m].
    """

    approach: ApproachPlan
    pace: Pace
    seed: int
    lift: float = 0.0
    retreat: float = 0.0


def reach(asked: ReachPlan, q0: Array, solutions: Sequence[Array], why: str) -> Reach:
    """The way to the first of some solutions to which there is one.

    Args:
        asked: What to keep to.
        q0: (n,) where the robot is.
        solutions: (n,) each, of the grasp, best first.
        why: Why there are none.
    """
    if not solutions:
        return _none(ReachStatus.NOT_SOLVED, why)
    reasons: list[tuple[ReachStatus, str]] = []
    for one in approaches(asked.approach, solutions):
        if one.last is None:
            reasons.append((ReachStatus.NO_APPROACH, one.reason))
            continue
        found = _whole(asked, q0, one, one.last)
        if found.success:
            return found
        reasons.append((found.status, found.reason))
    # That which came farthest says most.
    order = list(ReachStatus)
    status, reason = max(reasons, key=lambda one: order.index(one[0]))
    return _none(status, reason, len(solutions))


def move(
    robot: ArmHand, ends: tuple[Array, Array], around: Surroundings | None, pace: Pace, seed: int
) -> Reach:
    """The way from one posture (n,) to another.

    Args:
        robot: The robot.
        ends: Where it is, and where it is to be.
        around: What must not be touched; None: nothing is checked.
        pace: How fast it is.
        seed: Of a planner.
    """
    corners, how = free_way(robot, *ends, around, seed)
    if corners is None:
        return _none(ReachStatus.NO_WAY, how)
    motion = _in_time(robot, [(GOING, np.stack(pair)) for pair in pairwise(corners)], pace)
    clearance, reason = (None, "") if around is None else least_clearance(around, motion.q)
    if reason:
        return _none(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    return _reached(how, motion, ends[1], clearance, 1, pace)


def _whole(asked: ReachPlan, q0: Array, one: Tried, last: LastPart) -> Reach:
    """The way to a solution whose last part is known, and on from it."""
    plan = asked.approach.plan
    check, robot = plan.check, plan.robot
    carried = None if check is None else Carried(check, asked.approach.problem, one.q)
    after = _after(asked, one, last, carried)
    if isinstance(after, str):
        return _none(ReachStatus.NO_RETREAT, after)
    corners, how = free_way(robot, q0, last.coming[0], one.open_handed, asked.seed)
    if corners is None:
        return _none(ReachStatus.NO_WAY, how)
    going = [(GOING, np.stack(pair)) for pair in pairwise(corners)]
    parts = [*going, (COMING, last.coming), (CLOSING, last.closing), *after]
    motion = _in_time(robot, parts, asked.pace)
    number = np.array([PARTS.index(part) for part in motion.notes["part"]])
    # Each begins where the one before ends.
    shut, held = (int((number <= PARTS.index(part)).sum()) for part in (COMING, CLOSING))
    clearance, reason = None, ""
    if one.open_handed is not None and one.holding is not None and carried is not None:
        clearance, reason = least_clearance(one.open_handed, motion.q[:shut])
        reason = reason or least_clearance(one.holding, motion.q[shut - 1 : held])[1]
        reason = reason or carried.blocked(motion.q[held - 1 :])
    if reason:
        return _none(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    return _reached(f"way there: {how}", motion, one.q, clearance, one.number, asked.pace)


def _after(
    asked: ReachPlan, one: Tried, last: LastPart, carried: Carried | None
) -> list[tuple[str, Array]] | str:
    """Ways with what the hand holds; or why there are none."""
    found: list[tuple[str, Array]] = []
    back = asked.approach.plan.robot.palm(last.coming[[0, -1]])[:, :3, 3]
    back = (back[0] - back[1]) / max(float(np.linalg.norm(back[0] - back[1])), 1e-9)
    q = one.q
    for name, shift in ((LIFTING, asked.lift * UP), (RETREATING, asked.retreat * back)):
        if not shift.any():
            continue
        way = one.closer.straight(q, shift)
        if way is None:
            return f"the arm cannot follow the straight way of {name}"
        reason = "" if carried is None else carried.blocked(way)
        if reason:
            return f"{name} is not free: {reason}"
        found.append((name, way))
        q = way[-1]
    return found


def _none(status: ReachStatus, reason: str, tried: int = 0) -> Reach:
    return Reach(status, reason, None, None, None, tried)


def _reached(
    reason: str, motion: Motion, q: Array, clearance: float | None, tried: int, pace: Pace
) -> Reach:
    taken = shares(motion.q, pace.period, pace.rates)
    return Reach(ReachStatus.REACHED, reason, motion, q, clearance, tried, *taken)


def _in_time(robot: ArmHand, ways: Sequence[tuple[str, Array]], pace: Pace) -> Motion:
    """Ways (k, n), each from where the last one ends, in time, at rest between them."""
    q, names = [ways[0][1][:1]], [ways[0][0]]
    for name, way in ways:
        samples = timed(way, pace.rates, pace.period)[1:]
        q.append(samples)
        names += [name] * len(samples)
    every = np.concatenate(q)
    return Motion.of_samples(robot, pace.period, every, {"part": np.array(names)})
