"""From where a robot is to a grasp, or a posture, in time: the way there, the approach, closing.

The last part of the way is found backwards (`casadi_ik.motion.approach`). What
the hand holds afterwards moves with the palm, and must not touch either (`Carried`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import gaps
from casadi_ik.grasps.pose import inverse
from casadi_ik.motion.approach import (
    ApproachPlan,
    LastPart,
    ReachStatus,
    Tried,
    approaches,
    hands_used,
)
from casadi_ik.motion.clear import free_way, least_clearance
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.timing import Rates, shares, timed
from casadi_ik.problem.clearance import CollisionQuery, SceneCheck
from casadi_ik.problem.targets import TargetBatch


class Carried:
    """A robot with what its hand holds; nothing where the scene does not know the object.

    Attributes:
        step: Motion of the palm [m] between two places where the object is compared with the scene.
        turn: Way of the motors together between two postures that are compared [rad].
        giving: By how much it may come nearer to what it stands on, or touches, while it is taken
            away [m].
    """

    step = 1e-3
    turn = 0.03
    giving = 1e-3

    def __init__(self, check: SceneCheck, problem: TargetBatch, q: Array) -> None:
        """Take the object.

        Args:
            check: The scene.
            problem: The grasp.
            q: (n,) the posture in which it is held first.
        """
        self._check, self._problem, self._robot = check, problem, check.robot
        self._name = problem.object or check.scene.grasped or ""
        pose = None if problem.object_pose is None else problem.object_pose[0]
        if pose is None and self._name in check.scene.items:
            pose = check.scene.items[self._name].pose
        # In the hands of several sides it goes with that of the first.
        used = hands_used(check.robot, problem)[:, 0] > 0
        hands = check.robot.hands
        holds = [side for side, hand in hands.items() if used[list(hand)].any()]
        self._side = (holds or list(hands))[0]
        self._in_palm = None if pose is None else inverse(self._palm(q)) @ pose
        if pose is not None:
            self._held = check.scene.holding(self._name, np.eye(4)).items[self._name]

    def _palm(self, q: Array) -> Array:
        return self._robot.palm(q, self._side)

    def blocked(self, q: Array) -> str:
        """What is in the way from each of k postures (k, n) straight to the next; "": nothing."""
        # Between postures what is held goes straight, and the palm on an arc: steps are small.
        fine = _finely(q, q, self.turn)
        return least_clearance(self._query_at(fine), fine)[1] or self._comes_near(q)

    def in_the_way(self, q: Array) -> str:
        """What touches in one posture (1, n); "": nothing."""
        found = self._query_at(q).check(q)
        if not found.free[0]:
            return f"{' and '.join(found.pair(0) or ())} touch"
        return self._comes_near(q, self.giving)

    def _query_at(self, q: Array) -> CollisionQuery:
        every = self._problem.rows(np.zeros(len(q), dtype=np.intp))
        if self._in_palm is None:
            return self._check.collision_query(every).rows(np.zeros(1, dtype=np.intp))
        poses = self._palm(q) @ self._in_palm
        held = replace(every, object=self._name, object_pose=poses)
        return self._check.collision_query(held, carried=True)

    def _comes_near(self, q: Array, before: float | None = None) -> str:
        """What in the scene the object comes too near to, as far as it is not there already.

        Args:
            q: (k, n) postures.
            before: How near it may have been before [m]; None: as in the first posture.
        """
        scene = self._check.scene
        if self._in_palm is None:
            return ""
        poses = self._palm(_finely(q, self._palm(q)[:, :3, 3], self.step)) @ self._in_palm
        allowed = {frozenset(one.links) for one in scene.touching}
        for name, item in scene.items.items():
            pair = frozenset((name, self._name))
            if name == self._name or pair in allowed:
                continue
            usual = scene.margin if item.margin is None else item.margin
            apart = gaps(self._held, [item], poses)
            there = float(apart[0]) if before is None else before
            if apart.min() < min(scene.margins.get(pair, usual), there - self.giving):
                return f"{self._name} and {name} touch"
        return ""


def _finely(q: Array, places: Array, step: float) -> Array:
    """Postures (m, n) on the straight ways from each of some (k, n) to the next.

    Args:
        q: (k, n).
        places: (k, d) where something is there.
        step: How far apart two of them are at most.
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    counts = np.maximum(np.ceil(steps / step), 1).astype(int)
    at = [i + np.arange(count) / count for i, count in enumerate(counts)]
    along = np.append(np.concatenate([np.zeros(0), *at]), len(q) - 1)
    return np.array([np.interp(along, np.arange(len(q)), column) for column in q.T]).T


PARTS = ("going", "coming", "closing", "lifting", "retreating")
"""Of a motion: to the pre-grasp, straight to the object, around it, up and back with it."""

GOING, COMING, CLOSING, LIFTING, RETREATING = PARTS

UP = np.array([0.0, 0.0, 1.0])
"""Of the base frame."""


@dataclass(frozen=True, eq=False)
class Reach:
    """A timed motion to a grasp or to a posture.

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
        return failed(ReachStatus.NOT_SOLVED, why)
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
    return failed(status, reason, len(solutions))


def move(
    robot: ArmHand, ends: tuple[Array, Array], query: CollisionQuery | None, pace: Pace, seed: int
) -> Reach:
    """The way from one posture (n,) to another.

    Args:
        robot: The robot.
        ends: Where it is, and where it is to be.
        query: What must not be touched; None: nothing is checked.
        pace: How fast it is.
        seed: Of a planner.
    """
    corners, how = free_way(robot, *ends, query, seed)
    if corners is None:
        return failed(ReachStatus.NO_WAY, how)
    motion = in_time(robot, [(GOING, np.stack(pair)) for pair in pairwise(corners)], pace)
    clearance, reason = (None, "") if query is None else least_clearance(query, motion.q)
    if reason:
        return failed(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    return reached(how, motion, ends[1], clearance, 1, pace)


def _whole(asked: ReachPlan, q0: Array, one: Tried, last: LastPart) -> Reach:
    """The way to a solution whose last part is known, and on from it."""
    plan = asked.approach.plan
    check, robot = plan.check, plan.robot
    carried = None if check is None else Carried(check, asked.approach.problem, one.q)
    after = _after(asked, one, last, carried)
    if isinstance(after, str):
        return failed(ReachStatus.NO_RETREAT, after)
    corners, how = free_way(robot, q0, last.coming[0], one.open_handed, asked.seed)
    if corners is None:
        return failed(ReachStatus.NO_WAY, how)
    going = [(GOING, np.stack(pair)) for pair in pairwise(corners)]
    parts = [*going, (COMING, last.coming), (CLOSING, last.closing), *after]
    motion = in_time(robot, parts, asked.pace)
    number = np.array([PARTS.index(part) for part in motion.notes["part"]])
    # Each begins where the one before ends.
    shut, held = (int((number <= PARTS.index(part)).sum()) for part in (COMING, CLOSING))
    clearance, reason = None, ""
    if one.open_handed is not None and one.holding is not None and carried is not None:
        went = int((number <= PARTS.index(GOING)).sum())
        clearance, reason = least_clearance(one.open_handed, motion.q[:went])
        if one.coming is not None and went < shut:
            here, why = least_clearance(one.coming, motion.q[max(went - 1, 0) : shut])
            clearance, reason = min(clearance, here), reason or why
        reason = reason or least_clearance(one.holding, motion.q[shut - 1 : held])[1]
        reason = reason or carried.blocked(motion.q[held - 1 :])
    if reason:
        return failed(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    return reached(f"way there: {how}", motion, one.q, clearance, one.number, asked.pace)


def _after(
    asked: ReachPlan, one: Tried, last: LastPart, carried: Carried | None
) -> list[tuple[str, Array]] | str:
    """Ways with what the hand holds; or why there are none."""
    found: list[tuple[str, Array]] = []
    ends, _ = asked.approach.plan.robot.contacts(last.coming[[0, -1]])
    back = ends[0] - ends[1]
    back /= np.maximum(np.linalg.norm(back, axis=1, keepdims=True), 1e-9)
    q, used = one.q, hands_used(asked.approach.plan.robot, asked.approach.problem)
    for name, shift in ((LIFTING, asked.lift * UP), (RETREATING, asked.retreat * back)):
        if not shift.any():
            continue
        shift = shift * used
        way = one.closer.straight(q, shift)
        if way is None:
            return f"the arm cannot follow the straight way of {name}"
        reason = "" if carried is None else carried.blocked(way)
        if reason:
            return f"{name} is not free: {reason}"
        found.append((name, way))
        q = way[-1]
    return found


def failed(status: ReachStatus, reason: str, tried: int = 0) -> Reach:
    """A motion that there is not, and why."""
    return Reach(status, reason, None, None, None, tried)


def reached(
    reason: str, motion: Motion, q: Array, clearance: float | None, tried: int, pace: Pace
) -> Reach:
    """A motion that ends in a posture (n,)."""
    taken = shares(motion.q, pace.period, pace.rates)
    return Reach(ReachStatus.REACHED, reason, motion, q, clearance, tried, *taken)


def in_time(robot: ArmHand, ways: Sequence[tuple[str, Array]], pace: Pace) -> Motion:
    """Ways (k, n), each from where the last one ends, in time, at rest between them."""
    q, names = [ways[0][1][:1]], [ways[0][0]]
    for name, way in ways:
        samples = timed(way, pace.rates, pace.period)[1:]
        q.append(samples)
        names += [name] * len(samples)
    every = np.concatenate(q)
    return Motion.of_samples(robot, pace.period, every, {"part": np.array(names)})
