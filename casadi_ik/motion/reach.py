"""Timed motions to grasps and postures: path, approach, closing, lifting and placing.

The approach is planned backwards (`casadi_ik.motion.approach`). An object that the hand holds moves
with the palm and must not collide either (`CarriedObject`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.collision.distances import gaps
from casadi_ik.files.arrays import Array
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.pose import inverse
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.approach import (
    ApproachAttempt,
    ApproachRequest,
    ReachStatus,
    approaches,
    hands_used,
)
from casadi_ik.motion.free_path import minimum_clearance, plan_path
from casadi_ik.motion.motion import Motion, Rates, limit_fraction, timed


class CarriedObject:
    """Collision checks of a robot and the object in its hand, if the scene knows the object.

    Attributes:
        palm_step: Motion of the palm between two checks of the object [m].
        motor_step: Norm of the motor motion between two checks of the robot [rad or m].
        slack: Permitted decrease of the object's distance from its support while the hand lifts
            it [m].
    """

    palm_step = 1e-3
    motor_step = 0.03
    slack = 1e-3

    def __init__(self, check: SceneCheck, problem: TargetBatch, q: Array) -> None:
        """Attach the object to the palm.

        Args:
            check: Scene.
            problem: Grasp.
            q: (n,) posture in which the hand grasps the object.
        """
        self._check, self._problem, self._robot = check, problem, check.robot
        self._name = problem.object or check.scene.grasped or ""
        pose = None if problem.object_pose is None else problem.object_pose[0]
        if pose is None and self._name in check.scene.items:
            pose = check.scene.items[self._name].pose
        # An object in the hands of several sides moves with the first of these sides.
        is_used = hands_used(check.robot, problem)[:, 0] > 0
        hands = check.robot.hands
        holding_sides = [side for side, hand in hands.items() if is_used[list(hand)].any()]
        self._side = (holding_sides or list(hands))[0]
        self._X_palm_object = None if pose is None else inverse(self._palm(q)) @ pose
        if pose is not None:
            self._object = check.scene.holding(self._name, np.eye(4)).items[self._name]

    def _palm(self, q: Array) -> Array:
        """Return the pose (..., 4, 4) of the palm that carries the object."""
        return self._robot.palm(q, self._side)

    def path_obstruction(self, q: Array) -> str:
        """Return the reason why the straight path through postures (k, n) is not free, or ""."""
        # Between postures the object moves straight and the palm on an arc, so steps are small.
        fine = _resampled(q, q, self.motor_step)
        return minimum_clearance(self._query_at(fine), fine)[1] or self._object_contact(q)

    def contact_at(self, q: Array) -> str:
        """Return the colliding pair of a posture (1, n) as text, "" if it is free."""
        clearances = self._query_at(q).check(q)
        if not clearances.free[0]:
            return f"{' and '.join(clearances.pair(0) or ())} touch"
        return self._object_contact(q, self.slack)

    def _query_at(self, q: Array) -> CollisionQuery:
        """Return the collision checks of the robot at postures (k, n) that carry the object."""
        problems = self._problem.rows(np.zeros(len(q), dtype=np.intp))
        if self._X_palm_object is None:
            return self._check.collision_query(problems).rows(np.zeros(1, dtype=np.intp))
        poses = self._palm(q) @ self._X_palm_object
        carrying = replace(problems, object=self._name, object_pose=poses)
        return self._check.collision_query(carrying, is_carried=True)

    def _object_contact(self, q: Array, initial: float | None = None) -> str:
        """Return the contact of the object with an obstacle as text, "" if there is none.

        Contacts that existed initially do not count.

        Args:
            q: (k, n) postures.
            initial: Initial distance from obstacles [m]; None: that of the first posture.
        """
        scene = self._check.scene
        if self._X_palm_object is None:
            return ""
        poses = (
            self._palm(_resampled(q, self._palm(q)[:, :3, 3], self.palm_step)) @ self._X_palm_object
        )
        allowed = {frozenset(contact.links) for contact in scene.touching}
        for name, item in scene.items.items():
            pair = frozenset((name, self._name))
            if name == self._name or pair in allowed:
                continue
            default_margin = scene.margin if item.margin is None else item.margin
            distances = gaps(self._object, [item], poses)
            first = float(distances[0]) if initial is None else initial
            if distances.min() < min(scene.margins.get(pair, default_margin), first - self.slack):
                return f"{self._name} and {name} touch"
        return ""


def _resampled(q: Array, positions: Array, step: float) -> Array:
    """Return postures (m, n) on the straight segments between consecutive postures.

    Args:
        q: (k, n) postures.
        positions: (k, d) positions of a point in these postures.
        step: Maximum distance between two consecutive positions.
    """
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    counts = np.maximum(np.ceil(lengths / step), 1).astype(int)
    fractions = [i + np.arange(count) / count for i, count in enumerate(counts)]
    parameters = np.append(np.concatenate([np.zeros(0), *fractions]), len(q) - 1)
    return np.array([np.interp(parameters, np.arange(len(q)), column) for column in q.T]).T


PARTS = ("going", "coming", "closing", "lifting", "retreating")
"""Parts of a motion: to the pre-grasp, approach, closing, lifting and retreat with the object."""

TRANSFER, APPROACH, CLOSING, LIFTING, RETREATING = PARTS

CARRYING, LOWERING, OPENING, LEAVING = "carrying", "lowering", "opening", "leaving"
"""Parts of a motion that places: carrying, lowering, opening of the hand, straight retreat."""

UP = np.array([0.0, 0.0, 1.0])
"""Vertical axis of the base frame."""


@dataclass(frozen=True, eq=False, repr=False)
class Reach(RecordReprMixin):
    """Timed motion to a grasp or to a posture.

    Attributes:
        status: Result of the planning.
        reason: How the path was planned, or the reason of a failure.
        motion: Motion from q0 at rest to the grasp at rest, and further if requested; its note
            "part" names the part (of `PARTS`) of each sample. None on failure.
        q: (n,) solution of the grasp at which the hand closes, or the requested posture; None on
            failure.
        clearance: Minimum clearance at the samples before the hand closes [m], see `Clearances`;
            between samples it is lower by at most 0.1 mm. None without a scene.
        tried: Number of attempted solutions of the grasp.
        velocity_share: Maximum velocity of the samples (first differences) relative to the limits;
            0 without a motion.
        acceleration_share: Maximum acceleration of the samples (second differences) relative to the
            limits; 0 without a motion.

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
        """True if there is a motion."""
        return self.status is ReachStatus.REACHED


@dataclass(frozen=True, eq=False)
class Pace:
    """Timing of a motion.

    Attributes:
        rates: Limits of velocities and accelerations.
        period: Time between two samples [s].
    """

    rates: Rates
    period: float


@dataclass(frozen=True, eq=False)
class ReachRequest:
    """Requirements of a motion to a grasp.

    Attributes:
        approach: Requirements of its approach.
        pace: Timing.
        seed: Seed of the path planner.
        q0: (n,) initial posture.
    """

    approach: ApproachRequest
    pace: Pace
    seed: int
    q0: Array

    @property
    def robot(self) -> ArmHand:
        """Robot of the approach."""
        return self.approach.config.robot


Segment = tuple[str, Array]
"""Name of a part, and postures (k, n) on it."""


@dataclass(frozen=True, eq=False)
class _Stage:
    """Segments with the same collision checks.

    Attributes:
        segments: Segments in their order.
        query: Collision checks; None checks nothing.
        limits_clearance: True if the clearance of the segments is part of `Reach.clearance`.
    """

    segments: Sequence[Segment]
    query: CollisionQuery | CarriedObject | None
    limits_clearance: bool = True


def reach(
    request: ReachRequest, solutions: Sequence[Array], reason: str, lift: float, retreat: float
) -> Reach:
    """Plan a motion to the first reachable solution of a grasp.

    Args:
        request: Requirements.
        solutions: (n,) solutions of the grasp, best first.
        reason: Reason why there are no solutions.
        lift: Height by which the hand is lifted after it has closed [m].
        retreat: Length of the retreat along the reverse approach after that [m].
    """
    check, problem, robot = request.approach.config.check, request.approach.problem, request.robot

    def plan_motion(attempt: ApproachAttempt) -> Reach:
        path = attempt.path
        if path is None:
            return failed(ReachStatus.NO_APPROACH, attempt.reason)
        carried_object = None if check is None else CarriedObject(check, problem, attempt.q)
        (first_tips, last_tips), _ = robot.contacts(path.coming[[0, -1]])
        reverse_approach = first_tips - last_tips
        lengths = np.linalg.norm(reverse_approach, axis=1, keepdims=True)
        reverse_approach /= np.maximum(lengths, 1e-9)
        q, is_used, segments = attempt.q, hands_used(robot, problem), list[Segment]()
        for name, shift in ((LIFTING, lift * UP), (RETREATING, retreat * reverse_approach)):
            if not shift.any():
                continue
            postures = attempt.finder.straight(q, shift * is_used)
            if postures is None:
                reason = f"the arm cannot follow the straight line of {name}"
                return failed(ReachStatus.NO_RETREAT, reason)
            if carried_object is not None and (reason := carried_object.path_obstruction(postures)):
                return failed(ReachStatus.NO_RETREAT, f"{name} is not free: {reason}")
            segments.append((name, postures))
            q = postures[-1]
        transfer, note = _plan_segments(request, TRANSFER, path.coming[0], attempt.open_query)
        stages = (
            _Stage(transfer, attempt.open_query),
            _Stage([(APPROACH, path.coming)], attempt.coming_query),
            _Stage([(CLOSING, path.closing)], attempt.closing_query, limits_clearance=False),
            _Stage(segments, carried_object, limits_clearance=False),
        )
        return _timed_motion(robot, stages, request.pace, note, attempt.q, attempt.number)

    return _first_motion(request, solutions, reason, plan_motion)


def place(
    request: ReachRequest,
    solutions: Sequence[Array],
    reason: str,
    carried_object: CarriedObject | None,
    lower: float,
) -> Reach:
    """Plan a motion that places the object in the hand, for the first solution that permits it.

    Args:
        request: Requirements; the hand leaves the object along the reverse approach.
        solutions: (n,) postures in which the object has its target pose, best first.
        reason: Reason why there are no solutions.
        carried_object: Collision checks of robot and object; None checks nothing.
        lower: Height above the target pose from which the object is lowered straight [m].
    """

    def plan_motion(attempt: ApproachAttempt) -> Reach:
        path = attempt.path
        if path is None:
            retreat_reason = attempt.reason.replace("approach", "retreat")
            return failed(ReachStatus.NO_RETREAT, retreat_reason)
        up = attempt.finder.straight(attempt.q, lower * UP)
        if up is None:
            return failed(ReachStatus.NO_APPROACH, "the arm cannot follow the straight line down")
        down = up[::-1]
        if carried_object is not None and (obstruction := carried_object.path_obstruction(down)):
            return failed(ReachStatus.NO_APPROACH, f"the path down is not free: {obstruction}")
        carrying, note = _plan_segments(request, CARRYING, down[0], carried_object)
        stages = (
            _Stage(
                [*carrying, (LOWERING, down)] if carrying else [],
                carried_object,
                limits_clearance=False,
            ),
            _Stage([(OPENING, path.closing[::-1])], attempt.closing_query, limits_clearance=False),
            _Stage([(LEAVING, path.coming[::-1])], attempt.coming_query),
        )
        return _timed_motion(request.robot, stages, request.pace, note, attempt.q, attempt.number)

    return _first_motion(request, solutions, reason, plan_motion)


def move(
    robot: ArmHand,
    endpoints: tuple[Array, Array],
    query: CollisionQuery | None,
    pace: Pace,
    seed: int,
) -> Reach:
    """Plan a motion from one posture (n,) to another.

    Args:
        robot: Robot that moves.
        endpoints: First and last posture.
        query: Collision checks; None checks nothing.
        pace: Timing.
        seed: Seed of the path planner.
    """
    corners, note = plan_path(robot, *endpoints, query, seed)
    stages = [_Stage(_segments(TRANSFER, corners), query)]
    return _timed_motion(robot, stages, pace, note, endpoints[1], 1)


def _first_motion(
    request: ReachRequest,
    solutions: Sequence[Array],
    reason: str,
    plan_motion: Callable[[ApproachAttempt], Reach],
) -> Reach:
    """Return the first successful motion, or the failure of the latest planning stage."""
    if not solutions:
        return failed(ReachStatus.NOT_SOLVED, reason)
    failures: list[Reach] = []
    for attempt in approaches(request.approach, solutions):
        result = plan_motion(attempt)
        if result.success:
            return result
        failures.append(result)
    order = list(ReachStatus)
    latest = max(failures, key=lambda result: order.index(result.status))
    return failed(latest.status, latest.reason, len(solutions))


def _plan_segments(
    request: ReachRequest, name: str, end: Array, query: CollisionQuery | CarriedObject | None
) -> tuple[list[Segment], str]:
    """Return the segments of a free path from q0, and how it was planned or the failure."""
    corners, note = plan_path(request.robot, request.q0, end, query, request.seed)
    return _segments(name, corners), note if corners is None else f"path: {note}"


def _segments(name: str, corners: Array | None) -> list[Segment]:
    return [] if corners is None else [(name, np.stack(pair)) for pair in pairwise(corners)]


def failed(status: ReachStatus, reason: str, attempts: int = 0) -> Reach:
    """Return the result of a failure."""
    return Reach(status, reason, None, None, None, attempts)


def _timed_motion(
    robot: ArmHand, stages: Sequence[_Stage], pace: Pace, note: str, q: Array, attempts: int
) -> Reach:
    """Return the timed motion of consecutive stages, at rest between segments, and check it.

    Args:
        robot: Robot that moves.
        stages: Stages; the planning has failed if the first has no segments.
        pace: Timing.
        note: How the path was planned, or the reason of the failure.
        q: (n,) posture at the grasp, or at the end.
        attempts: Number of attempted solutions.
    """
    if not stages[0].segments:
        return failed(ReachStatus.NO_WAY, note)
    segments = [segment for stage in stages for segment in stage.segments]
    samples, names = [segments[0][1][:1]], [segments[0][0]]
    for name, postures in segments:
        samples.append(timed(postures, pace.rates, pace.period)[1:])
        names += [name] * len(samples[-1])
    parts = np.array(names)
    motion = Motion.of_samples(robot, pace.period, np.concatenate(samples), {"part": parts})
    clearance, reason, first = None, "", 0
    for stage in stages:
        last = first + int(np.isin(parts, [name for name, _ in stage.segments]).sum())
        # Each stage begins at the last posture of the one before.
        postures, first = motion.q[max(first - 1, 0) : last], last
        if isinstance(stage.query, CarriedObject):
            reason = stage.query.path_obstruction(postures)
        elif stage.query is not None:
            stage_clearance, reason = minimum_clearance(stage.query, postures)
            if stage.limits_clearance:
                clearance = min(stage_clearance, np.inf if clearance is None else clearance)
        if reason:
            return failed(ReachStatus.NO_WAY, f"the timed motion is not free: {reason}")
    limit_fractions = limit_fraction(motion.q, pace.period, pace.rates)
    return Reach(ReachStatus.REACHED, note, motion, q, clearance, attempts, *limit_fractions)
