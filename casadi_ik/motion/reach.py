"""From where a robot is to a grasp, or a posture, in time: the way there, the approach, closing.

The last part of the way is found backwards (`casadi_ik.motion.approach`). What
the hand holds afterwards moves with the palm, and must not touch either (`Carried`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import gaps
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.pose import inverse
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.approach import (
    ApproachPlan,
    ReachStatus,
    Tried,
    approaches,
    hands_used,
)
from casadi_ik.motion.clear import free_way, least_clearance
from casadi_ik.motion.motion import Motion, Rates, shares, timed


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

CARRYING, LOWERING, OPENING, LEAVING = "carrying", "lowering", "opening", "leaving"
"""Of a motion that places: over the place, straight down, off the object, straight back."""

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
class WayPlan:
    """What a whole way has to keep to.

    Attributes:
        approach: What its part at the object has to keep to.
        pace: Its speed.
        seed: Of a planner.
        q0: (n,) where the robot is.
    """

    approach: ApproachPlan
    pace: Pace
    seed: int
    q0: Array

    @property
    def robot(self) -> ArmHand:
        """The robot."""
        return self.approach.plan.robot


Way = tuple[str, Array]
"""Name of a part, and postures (k, n) on it."""


@dataclass(frozen=True, eq=False)
class _Stage:
    """Ways that are checked against the same.

    Attributes:
        ways: The ways.
        query: What must not be touched on them; None: nothing is checked.
        counts: Whether their clearance is that of the motion.
    """

    ways: Sequence[Way]
    query: CollisionQuery | Carried | None
    counts: bool = True


def reach(
    asked: WayPlan, solutions: Sequence[Array], why: str, lift: float, retreat: float
) -> Reach:
    """The way to the first of some solutions to which there is one.

    Args:
        asked: What to keep to.
        solutions: (n,) each, of the grasp, best first.
        why: Why there are none.
        lift: How far the hand goes straight up after it closed [m].
        retreat: How far it goes back then, against the way it came [m].
    """
    check, problem, robot = asked.approach.plan.check, asked.approach.problem, asked.robot

    def whole(one: Tried) -> Reach:
        last = one.last
        if last is None:
            return failed(ReachStatus.NO_APPROACH, one.reason)
        carried = None if check is None else Carried(check, problem, one.q)
        ends, _ = robot.contacts(last.coming[[0, -1]])
        back = ends[0] - ends[1]
        back /= np.maximum(np.linalg.norm(back, axis=1, keepdims=True), 1e-9)
        q, used, after = one.q, hands_used(robot, problem), list[Way]()
        for name, shift in ((LIFTING, lift * UP), (RETREATING, retreat * back)):
            if not shift.any():
                continue
            way = one.closer.straight(q, shift * used)
            if way is None:
                reason = f"the arm cannot follow the straight way of {name}"
                return failed(ReachStatus.NO_RETREAT, reason)
            if carried is not None and (reason := carried.blocked(way)):
                return failed(ReachStatus.NO_RETREAT, f"{name} is not free: {reason}")
            after.append((name, way))
            q = way[-1]
        going, how = _going(asked, GOING, last.coming[0], one.open_handed)
        stages = (
            _Stage(going, one.open_handed),
            _Stage([(COMING, last.coming)], one.coming),
            _Stage([(CLOSING, last.closing)], one.holding, counts=False),
            _Stage(after, carried, counts=False),
        )
        return _in_time(robot, stages, asked.pace, how, one.q, one.number)

    return _first(asked, solutions, why, whole)


def place(
    asked: WayPlan, solutions: Sequence[Array], why: str, carried: Carried | None, lower: float
) -> Reach:
    """The way to the first of some postures over which an object that is held can be placed.

    Args:
        asked: What to keep to; the hand leaves the object as it would come to it.
        solutions: (n,) each, in which the hand has the object where it is to stand.
        why: Why there are none.
        carried: The robot with what it holds; None: nothing is checked.
        lower: From how far above the object comes straight down [m].
    """

    def whole(one: Tried) -> Reach:
        last = one.last
        if last is None:
            return failed(ReachStatus.NO_RETREAT, one.reason.replace("approach", "way back"))
        up = one.closer.straight(one.q, lower * UP)
        if up is None:
            return failed(ReachStatus.NO_APPROACH, "the arm cannot follow the straight way down")
        down = up[::-1]
        if carried is not None and (reason := carried.blocked(down)):
            return failed(ReachStatus.NO_APPROACH, f"the way down is not free: {reason}")
        carrying, how = _going(asked, CARRYING, down[0], carried)
        stages = (
            _Stage([*carrying, (LOWERING, down)] if carrying else [], carried, counts=False),
            _Stage([(OPENING, last.closing[::-1])], one.holding, counts=False),
            _Stage([(LEAVING, last.coming[::-1])], one.coming),
        )
        return _in_time(asked.robot, stages, asked.pace, how, one.q, one.number)

    return _first(asked, solutions, why, whole)


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
    stages = [_Stage(_between(GOING, corners), query)]
    return _in_time(robot, stages, pace, how, ends[1], 1)


def _first(
    asked: WayPlan, solutions: Sequence[Array], why: str, whole: Callable[[Tried], Reach]
) -> Reach:
    """The first whole way that there is; of those that there are not the reason that says most."""
    if not solutions:
        return failed(ReachStatus.NOT_SOLVED, why)
    tried: list[Reach] = []
    for one in approaches(asked.approach, solutions):
        tried.append(whole(one))
        if tried[-1].success:
            return tried[-1]
    # That which came farthest says most.
    order = list(ReachStatus)
    most = max(tried, key=lambda one: order.index(one.status))
    return failed(most.status, most.reason, len(solutions))


def _going(
    asked: WayPlan, name: str, end: Array, query: CollisionQuery | Carried | None
) -> tuple[list[Way], str]:
    """The free way from where the robot is, none if there is none; and how it was found, or why."""
    corners, how = free_way(asked.robot, asked.q0, end, query, asked.seed)
    return _between(name, corners), how if corners is None else f"way there: {how}"


def _between(name: str, corners: Array | None) -> list[Way]:
    return [] if corners is None else [(name, np.stack(pair)) for pair in pairwise(corners)]


def failed(status: ReachStatus, reason: str, tried: int = 0) -> Reach:
    """A motion that there is not, and why."""
    return Reach(status, reason, None, None, None, tried)


def _in_time(
    robot: ArmHand, stages: Sequence[_Stage], pace: Pace, how: str, q: Array, tried: int
) -> Reach:
    """Stages, each from where the last one ends, in time, at rest between their ways, and checked.

    Args:
        robot: The robot.
        stages: The stages; without a way in the first there is none.
        pace: How fast they are.
        how: How the way was found, or why there is none.
        q: (n,) where the hand holds something, or the end.
        tried: Solutions that were looked at.
    """
    if not stages[0].ways:
        return failed(ReachStatus.NO_WAY, how)
    ways = [way for stage in stages for way in stage.ways]
    samples, names = [ways[0][1][:1]], [ways[0][0]]
    for name, way in ways:
        samples.append(timed(way, pace.rates, pace.period)[1:])
        names += [name] * len(samples[-1])
    parts = np.array(names)
    motion = Motion.of_samples(robot, pace.period, np.concatenate(samples), {"part": parts})
    clearance, reason, first = None, "", 0
    for stage in stages:
        last = first + int(np.isin(parts, [name for name, _ in stage.ways]).sum())
        # Each begins where the one before ends.
        postures, first = motion.q[max(first - 1, 0) : last], last
        if isinstance(stage.query, Carried):
            reason = stage.query.blocked(postures)
        elif stage.query is not None:
            here, reason = least_clearance(stage.query, postures)
            if stage.counts:
                clearance = here if clearance is None else min(clearance, here)
        if reason:
            return failed(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    taken = shares(motion.q, pace.period, pace.rates)
    return Reach(ReachStatus.REACHED, how, motion, q, clearance, tried, *taken)
