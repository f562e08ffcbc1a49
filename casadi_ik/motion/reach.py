"""From where a robot is to a grasp, or a posture, in time: the way there, the approach, closing.

The last part of the way is found backwards: the hand opens, and goes straight back (`Closer`). What
the hand holds afterwards moves with the palm, and must not touch either (`Carried`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.collision.distances import gaps
from casadi_ik.grasps.pose import inverse
from casadi_ik.motion.clear import free_way, least_clearance
from casadi_ik.motion.inputs import ANY, FollowerInputs, FollowPlan
from casadi_ik.motion.motion import Motion
from casadi_ik.motion.timing import Rates, shares, timed
from casadi_ik.problem.clearance import CollisionQuery, SceneCheck
from casadi_ik.problem.contacts import usual
from casadi_ik.problem.targets import TargetBatch


@dataclass(frozen=True, eq=False)
class LastPart:
    """Postures on the way to a grasp.

    Attributes:
        coming: (k, n) the open hand comes straight to where it will close.
        closing: (k, n) it closes, the last posture is the grasp.
    """

    coming: Array
    closing: Array


class Closer:
    """Finds the last part of the way on one robot, backwards: the hand opens, and goes.

    Attributes:
        postures: Of each of both parts.
        cycles: Cycles that each posture is given.
        stray: How far the palm may be from its straight way [m].
    """

    postures = 40
    cycles = 3
    stray = 2e-3

    def __init__(self, plan: FollowPlan) -> None:
        """Compile what is not compiled yet; the plan has no limits of velocity."""
        self._robot = plan.robot
        self._asked = FollowerInputs(plan, usual(len(plan.robot.fingers)), 0)

    def find(
        self,
        problem: TargetBatch,
        q: Array,
        opening: float,
        distance: float,
        direction: Array | None = None,
    ) -> LastPart | None:
        """The last part of the way to a solution; None if there is none.

        Args:
            problem: The grasp.
            q: (n,) its solution.
            opening: How far the fingertips are from their contacts while the hand is open [m].
            distance: How far it comes straight [m].
            direction: (3,) the way it comes, base frame; None: from the palm to the contacts.
        """
        robot = self._robot
        palm, (points, normals) = robot.palm(q), robot.contacts(q)
        given = ~np.isnan(problem.points[0, :, 0])
        share = np.linspace(0.0, 1.0, self.postures)[:, None, None]
        opened = points - opening * share * normals
        opening_way = self._walk(q, opened, np.repeat(palm[None], self.postures, axis=0), given)
        there = opening_way[-1]
        if not self._asked.cycle.palm:
            return LastPart(there[None], opening_way[::-1])
        here: Array = robot.contacts(there)[0][given].mean(axis=0) - palm[:3, 3]
        way = here if direction is None else direction
        back = -distance * way / max(float(np.linalg.norm(way)), 1e-9)
        coming = self.straight(there, back)
        return None if coming is None else LastPart(coming[::-1], opening_way[::-1])

    def straight(self, q: Array, shift: Array) -> Array | None:
        """(k, n) postures from q on with palm and fingertips moved by (3,) [m]; None: it strays."""
        robot, share = self._robot, np.linspace(0.0, 1.0, self.postures)[:, None]
        tips = robot.contacts(q)[0]
        palms = np.repeat(robot.palm(q)[None], self.postures, axis=0)
        palms[:, :3, 3] += share * shift
        every = np.ones(len(tips), dtype=bool)
        found = self._walk(q, tips + share[:, None] * shift, palms, every)
        off = np.linalg.norm(robot.palm(found)[:, :3, 3] - palms[:, :3, 3], axis=1)
        return None if off.max() > self.stray else found

    def _walk(self, q: Array, tips: Array, palms: Array, given: Array) -> Array:
        """(k, n) postures from q on with fingertips (k, f, 3) and palm (k, 4, 4) there."""
        asked, count = self._asked, len(tips)
        layout = asked.cycle.parameters
        every = np.repeat(asked.run.parameters[None], count, axis=0)
        f = len(given)
        values = {
            "points": tips,
            "normals": np.tile(ANY, (count, f, 1)),
            "weights": np.tile(np.stack([given, 0 * given], axis=1), (count, 1, 1)),
            "position_tolerance": np.ones((count, f)),
            "angle_tolerance": np.ones((count, f)),
        }
        if asked.cycle.palm:
            values |= {
                "palm_point": palms[:, :3, 3],
                "palm_axes": palms[:, :3, :3],
                "palm_weight": np.ones((count, 2)),
            }
        for name, array in values.items():
            every[:, layout.slice(name)] = array.reshape(count, -1)
        rows = np.repeat(every, self.cycles, axis=0)
        states, _ = asked.run.run(asked.state_at(q), rows)
        found = states[self.cycles - 1 :: self.cycles, : len(q)]
        found[0] = q
        return found


class ReachStatus(Enum):
    """Result of planning a motion.

    Example:
        >>> solver.reach(grasp).status is ik.motion.ReachStatus.REACHED
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
    """The last part of a motion to a grasp.

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
    problem: TargetBatch
    opening: float
    distance: float
    direction: Array | None = None
    pregrasp: Array | None = None

    def along(self, q: Array) -> Array | None:
        """(3,) the way the hand comes to a solution (n,); None: from the palm to the contacts."""
        if self.direction is not None or self.pregrasp is None:
            return self.direction
        way = self.plan.robot.palm(q)[:3, 3] - self.pregrasp
        # A palm that is nearer to its grasp before it does not say from where it comes.
        return way if np.linalg.norm(way) > 5e-3 else None


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
    open_handed: CollisionQuery | None
    holding: CollisionQuery | None


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


def _surroundings(asked: ApproachPlan) -> tuple[CollisionQuery | None, CollisionQuery | None]:
    """What is checked while the hand closes, and before: then fingers touch no object either."""
    check, problem = asked.plan.check, asked.problem
    if check is None:
        return None, None
    one = np.zeros(1, dtype=np.intp)
    untouched = replace(problem, points=np.full_like(problem.points, np.nan))
    return check.collision_query(problem).rows(one), check.collision_query(untouched).rows(one)


def _blocked(
    last: LastPart | None,
    holding: CollisionQuery | None,
    open_handed: CollisionQuery | None,
) -> str:
    """Why the last part cannot be gone; "": it can."""
    if last is None:
        return "the arm cannot follow the straight way back"
    for name, postures, query in (
        ("the approach", last.coming, open_handed),
        ("the closing", last.closing, holding),
    ):
        if query is None or len(postures) < 2:
            continue
        _, touching = least_clearance(query, postures)
        if touching:
            return f"{name} is not free: {touching}"
    return ""


class Carried:
    """A robot with what its hand holds; nothing where the scene does not know the object.

    Attributes:
        step: Motion of the palm [m] between two places where the object is compared with the scene.
        giving: By how much it may come nearer to what it stands on, or touches, while it is taken
            away [m].
    """

    step = 1e-3
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
        self._in_palm = None if pose is None else inverse(self._robot.palm(q)) @ pose

    def blocked(self, q: Array) -> str:
        """What is in the way from each of k postures (k, n) straight to the next; "": nothing."""
        query = self._query_at(q)
        return least_clearance(query, q)[1] or self._comes_near(q)

    def _query_at(self, q: Array) -> CollisionQuery:
        every = self._problem.rows(np.zeros(len(q), dtype=np.intp))
        if self._in_palm is None:
            return self._check.collision_query(every).rows(np.zeros(1, dtype=np.intp))
        poses = self._robot.palm(q) @ self._in_palm
        held = replace(every, object=self._name, object_pose=poses)
        return self._check.collision_query(held, carried=True)

    def _comes_near(self, q: Array) -> str:
        """What in the scene the object comes too near to, as far as it is not there already."""
        scene = self._check.scene
        if self._in_palm is None:
            return ""
        held = scene.holding(self._name, np.eye(4)).items[self._name]
        poses = (
            self._robot.palm(_finely(q, self._robot.palm(q)[:, :3, 3], self.step)) @ self._in_palm
        )
        allowed = {frozenset(one.links) for one in scene.touching}
        for name, item in scene.items.items():
            pair = frozenset((name, self._name))
            if name == self._name or pair in allowed:
                continue
            usual = scene.margin if item.margin is None else item.margin
            apart = gaps(held, [item], poses)
            if apart.min() < min(scene.margins.get(pair, usual), float(apart[0]) - self.giving):
                return f"{self._name} and {name} touch"
        return ""


def _finely(q: Array, places: Array, step: float) -> Array:
    """Postures (m, n) on the straight ways from each of some (k, n) to the next.

    Args:
        q: (k, n).
        places: (k, 3) where the palm is there [m].
        step: [m] between two of them.
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
        return _none(ReachStatus.NO_WAY, how)
    motion = _in_time(robot, [(GOING, np.stack(pair)) for pair in pairwise(corners)], pace)
    clearance, reason = (None, "") if query is None else least_clearance(query, motion.q)
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
