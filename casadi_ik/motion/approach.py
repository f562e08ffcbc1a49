"""Straight approaches to grasps, planned backwards from the grasp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.collision.distances import gaps
from casadi_ik.collision.scene import Scene
from casadi_ik.files.arrays import Array
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import point_normal_kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.cycle import side_name
from casadi_ik.motion.cycle_runner import UNUSED_NORMAL, CycleRunner, FollowerConfig
from casadi_ik.motion.free_path import minimum_clearance


@dataclass(frozen=True, eq=False)
class ApproachPath:
    """Postures of an approach.

    Attributes:
        coming: (k, n) postures of the straight motion with an open hand, from the pre-grasp on.
        closing: (k, n) postures while the hand closes; the last one is the grasp.
    """

    coming: Array
    closing: Array


class ApproachFinder:
    """Planner of straight approaches of one robot, backwards from the grasp.

    Attributes:
        postures: Number of postures of each of the two parts.
        cycles: Cycles of the follower's graph per posture.
        max_deviation: Maximum deviation of the palm from the straight line [m].
    """

    postures = 40
    cycles = 3
    max_deviation = 2e-3

    def __init__(self, config: FollowerConfig) -> None:
        """Compile the graph unless it is cached; the configuration has no velocity limits."""
        self._robot = config.robot
        self._runner = CycleRunner(config, point_normal_kinds(len(config.robot.fingers)), 0)

    def find(
        self,
        problem: TargetBatch,
        q: Array,
        opening: float,
        distance: float,
        directions: Array,
    ) -> ApproachPath | None:
        """Return the approach to a solution; None if the arm cannot follow it.

        Args:
            problem: Batch of one target, the grasp.
            q: (n,) solution of the grasp.
            opening: Distance of the fingertips of the open hand from their contacts [m].
            distance: Length of the straight motion [m].
            directions: (f, 3) unit vectors of the approach of each finger's hand, base frame.
        """
        robot = self._robot
        points, normals = robot.contacts(q)
        has_contact = ~np.isnan(problem.points[0, :, 0])
        fractions = np.linspace(0.0, 1.0, self.postures)[:, None, None]
        # Pad normals point into the object, so the fingertips open against them.
        opening_tips = points - opening * fractions * normals
        opening_path = self._follow(q, opening_tips, {}, has_contact)
        q_open = opening_path[-1]
        if not self._runner.cycle.palms:
            return ApproachPath(q_open[None], opening_path[::-1])
        coming = self.straight(q_open, -distance * directions * hands_used(robot, problem))
        return None if coming is None else ApproachPath(coming[::-1], opening_path[::-1])

    def straight(self, q: Array, shift: Array) -> Array | None:
        """Return postures (k, n) of a translation of the whole hand; None if it deviates.

        Args:
            q: (n,) first posture.
            shift: (3,) translation, or (f, 3) with equal rows for the fingers of a hand, base frame
                [m].
        """
        robot, fractions = self._robot, np.linspace(0.0, 1.0, self.postures)[:, None, None]
        tips, palms = robot.contacts(q)[0], dict[str | None, Array]()
        shifts = np.broadcast_to(shift, tips.shape)
        for side, hand in robot.hands.items():
            palms[side] = np.repeat(robot.palm(q, side)[None], self.postures, axis=0)
            palms[side][:, :3, 3] += fractions[:, 0] * shifts[hand[0]]
        all_fingers = np.ones(len(tips), dtype=bool)
        path = self._follow(q, tips + fractions * shifts, palms, all_fingers)
        for side, poses in palms.items():
            deviation = np.linalg.norm(robot.palm(path, side)[:, :3, 3] - poses[:, :3, 3], axis=1)
            if deviation.max() > self.max_deviation:
                return None
        return path

    def _follow(
        self, q: Array, tips: Array, palms: Mapping[str | None, Array], has_contact: Array
    ) -> Array:
        """Return postures (k, n) that follow targets of fingertips and palms.

        Args:
            q: (n,) first posture.
            tips: (k, f, 3) target positions of the fingertips [m].
            palms: (k, 4, 4) target poses of palms by side; other palms keep their poses.
            has_contact: (f,) True if the target of a fingertip counts.
        """
        runner, f = self._runner, len(has_contact)
        values: dict[str, Any] = {
            "points": tips,
            "normals": [UNUSED_NORMAL] * f,
            "weights": np.stack([has_contact, 0 * has_contact], axis=1),
            # The result does not depend on tolerances; the graph requires positive ones.
            "position_tolerance": np.ones(f),
            "angle_tolerance": np.ones(f),
        }
        for side in runner.cycle.palms:
            poses = palms.get(side, self._robot.palm(q, side))
            fields = {"point": poses[..., :3, 3], "axes": poses[..., :3, :3], "weight": np.ones(2)}
            values |= {side_name(f"palm_{name}", side): array for name, array in fields.items()}
        rows = np.repeat(runner.rows(len(tips), values), self.cycles, axis=0)
        states, _ = runner.recurrence.run(runner.state_at(q), rows)
        path = states[self.cycles - 1 :: self.cycles, : len(q)]
        path[0] = q
        return path


def hands_used(robot: ArmHand, problem: TargetBatch) -> Array:
    """Return (f, 1): 1 for the fingers of hands with a contact of the grasp, else 0."""
    has_contact, is_used = ~np.isnan(problem.points[0, :, 0]), np.zeros((len(robot.fingers), 1))
    for hand in map(list, robot.hands.values()):
        is_used[hand] = has_contact[hand].any()
    return is_used


TILT = float(np.tan(np.deg2rad(35.0)))
"""Tangent of the tilt of the last alternative approach directions."""

OPENING_FRACTIONS = np.array([1.0, 0.5, 0.25])
"""Fractions of the requested opening, in the order of preference."""

MAX_PAD_PENETRATION = 1e-3
"""Maximum penetration of a pad into the object before the hand closes [m].

The value equals a typical position tolerance of a contact.
"""


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


class ReachStatus(Enum):
    """Result of planning a motion.

    Example:
        >>> solver.reach(grasp).status is ik.motion.ReachStatus.REACHED
        True
    """

    REACHED = "reached"
    """There is a motion; with a scene it is free of collisions."""
    NOT_SOLVED = "not solved"
    """The grasp has no solution; `Solver.solve` returns the reason."""
    NO_APPROACH = "no approach"
    """The open hand collides on every straight approach to a solution."""
    NO_RETREAT = "no retreat"
    """The hand with the object cannot be lifted or retreat as requested."""
    NO_WAY = "no way"
    """There is no path to a pre-grasp or posture."""


@dataclass(frozen=True, eq=False, repr=False)
class Approach(RecordReprMixin):
    """Straight approach to a grasp.

    Attributes:
        status: REACHED, NO_APPROACH or NOT_SOLVED.
        reason: Reason of a failure, "" on success.
        q: (n,) solution of the grasp at which the approach ends; None on failure.
        coming: (k, n) postures of the straight motion from the pre-grasp with open fingers; None on
            failure.
        closing: (k, n) postures while the hand closes, up to the grasp; None on failure.
        clearance: Minimum clearance before the hand closes [m]; None without a scene.
        tried: Number of attempted solutions of the grasp.

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
        """True if there is an approach."""
        return self.status is ReachStatus.REACHED

    @property
    def pregrasp(self) -> Array | None:
        """First posture (n,) of the approach; None on failure."""
        return None if self.coming is None else self.coming[0]


@dataclass(frozen=True, eq=False)
class ApproachRequest:
    """Requirements of an approach.

    Attributes:
        config: Robot and scene.
        problem: Grasp.
        opening: Distance of the fingertips from their contacts before the hand closes [m].
        distance: Length of the straight motion [m].
        direction: (3,) direction of the approach, base frame; None: it follows from the grasp.
        pregrasp: (3,) position of the palm at the pre-grasp, base frame [m]; None if the grasp does
            not specify it.
    """

    config: FollowerConfig
    problem: TargetBatch
    opening: float
    distance: float
    direction: Array | None = None
    pregrasp: Array | None = None

    def directions(self, q: Array) -> list[Array]:
        """Return approach directions to a solution (n,), in the order of preference.

        They are the requested direction alone; or else the direction from the pre-grasp (without
        one, from the palm to the contacts), then between that and vertical, vertical, and tilted to
        each side.

        Returns:
            (f, 3) unit vectors of each finger's hand, base frame, per direction.
        """
        robot = self.config.robot
        if self.direction is not None:
            return [np.tile(_unit(self.direction), (len(robot.fingers), 1))]
        has_contact, tips = ~np.isnan(self.problem.points[0, :, 0]), robot.contacts(q)[0]
        by_finger = dict[int, list[Array]]()
        for side, hand in robot.hands.items():
            fingers = [i for i in hand if has_contact[i]]
            directions = self._hand_directions(robot.palm(q, side), tips[fingers])
            by_finger |= dict.fromkeys(hand, directions)
        in_finger_order = (by_finger[i] for i in sorted(by_finger))
        return [np.stack(directions) for directions in zip(*in_finger_order, strict=True)]

    def _hand_directions(self, palm: Array, tips: Array) -> list[Array]:
        """Return approach directions (3,) of a hand with fingertips (k, 3) in contact."""
        down = np.array([0.0, 0.0, -1.0])
        first = tips.mean(axis=0) - palm[:3, 3] if len(tips) else down
        if self.pregrasp is not None:
            line = palm[:3, 3] - self.pregrasp
            # A pre-grasp that nearly coincides with the grasp does not define a direction.
            first = line if np.linalg.norm(line) > 5e-3 else first
        first = _unit(first)
        sides = [sign * palm[:3, axis] for axis in (0, 1) for sign in (1.0, -1.0)]
        alternatives = [first + down, down, *(first + TILT * side for side in sides)]
        # Opposite vectors cancel: such a sum does not define a direction. All hands of a robot have
        # the same number of directions, so the first one replaces it.
        are_defined = [np.linalg.norm(vector) > 0.1 for vector in alternatives]
        pairs = zip(alternatives, are_defined, strict=True)
        return [first, *(_unit(vector) if is_defined else first for vector, is_defined in pairs)]


@dataclass(frozen=True, eq=False)
class ApproachAttempt:
    """Result of planning the approach to one solution of a grasp.

    Attributes:
        finder: Planner of straight motions.
        number: Number of attempted solutions up to this one.
        q: (n,) solution of the grasp.
        path: Approach; None if there is none.
        reason: Reason of a failure, "" on success.
        open_query: Collision checks before the hand closes; None checks nothing.
        closing_query: Collision checks while it closes; None checks nothing.
        coming_query: Collision checks of the straight motion: `open_query` or `closing_query`.
    """

    finder: ApproachFinder
    number: int
    q: Array
    path: ApproachPath | None
    reason: str
    open_query: CollisionQuery | None
    closing_query: CollisionQuery | None
    coming_query: CollisionQuery | None


def approaches(request: ApproachRequest, solutions: Sequence[Array]) -> Iterator[ApproachAttempt]:
    """Yield the approaches to solutions (n,) of a grasp, in their order.

    Each attempt varies the opening of the hand and the direction; the reason of a failure is that
    of the preferred opening and direction.
    """
    finder = ApproachFinder(request.config)
    closing_query, open_query = _queries(request)
    for number, q in enumerate(solutions, start=1):
        path, first_reason, coming_query = None, "", open_query
        all_directions = request.directions(q)
        for opening in request.opening * OPENING_FRACTIONS:
            for directions in all_directions:
                path = finder.find(request.problem, q, opening, request.distance, directions)
                obstruction = _obstruction(request, path, closing_query, open_query)
                coming_query = obstruction.coming_query
                if not obstruction.reason:
                    break
                first_reason, path = first_reason or obstruction.reason, None
                if obstruction.is_closing_blocked:
                    break  # The closing does not depend on the direction.
            if path is not None:
                break
        reason = first_reason if path is None else ""
        yield ApproachAttempt(
            finder, number, q, path, reason, open_query, closing_query, coming_query
        )


def approach(request: ApproachRequest, solutions: Sequence[Array], reason: str) -> Approach:
    """Plan the approach to the first solution of a grasp that has one.

    Args:
        request: Requirements.
        solutions: (n,) solutions of the grasp, best first.
        reason: Reason why there are no solutions.
    """
    if not solutions:
        return Approach(ReachStatus.NOT_SOLVED, reason, None, None, None, None, 0)
    reason = ""
    for attempt in approaches(request, solutions):
        path = attempt.path
        if path is None:
            reason = reason or attempt.reason
            continue
        clearance = None
        if attempt.coming_query is not None:
            clearance, _ = minimum_clearance(attempt.coming_query, path.coming)
        postures = attempt.q, path.coming, path.closing
        return Approach(ReachStatus.REACHED, "", *postures, clearance, attempt.number)
    count = len(solutions)
    return Approach(ReachStatus.NO_APPROACH, reason, None, None, None, None, count)


def _queries(request: ApproachRequest) -> tuple[CollisionQuery | None, CollisionQuery | None]:
    """Return the collision checks while the hand closes, and before it closes.

    Before the hand closes, the fingers must not touch the object either.
    """
    check, problem = request.config.check, request.problem
    if check is None:
        return None, None
    row = np.zeros(1, dtype=np.intp)
    without_contacts = replace(problem, points=np.full_like(problem.points, np.nan))
    closing_query = check.collision_query(problem).rows(row)
    return closing_query, check.collision_query(without_contacts).rows(row)


@dataclass(frozen=True, eq=False)
class _Obstruction:
    """Result of checking an approach.

    Attributes:
        reason: Reason why the approach is not free, "" if it is free.
        coming_query: Collision checks of the straight motion; None checks nothing.
        is_closing_blocked: True if the hand collides while it closes.
    """

    reason: str
    coming_query: CollisionQuery | None
    is_closing_blocked: bool = False


def _obstruction(
    request: ApproachRequest,
    path: ApproachPath | None,
    closing_query: CollisionQuery | None,
    open_query: CollisionQuery | None,
) -> _Obstruction:
    """Check an approach for collisions.

    Collision shapes of fingers are larger than the fingers. If a hand cannot open far enough for
    these shapes, links with a contact may touch the object if their pads do not penetrate it.
    """
    if path is None:
        return _Obstruction("the arm cannot follow the straight retreat", open_query)
    if closing_query is None or open_query is None:
        return _Obstruction("", None)
    if len(path.closing) > 1 and (contact := minimum_clearance(closing_query, path.closing)[1]):
        return _Obstruction(f"the closing is not free: {contact}", open_query, True)
    if len(path.coming) < 2:
        return _Obstruction("", open_query)
    _, contact = minimum_clearance(open_query, path.coming)
    if not contact:
        return _Obstruction("", open_query)
    pregrasp_is_free = not minimum_clearance(open_query, path.coming[:1])[1]
    if (
        pregrasp_is_free
        and not minimum_clearance(closing_query, path.coming)[1]
        and _pads_are_free(request, path.coming)
    ):
        return _Obstruction("", closing_query)
    return _Obstruction(f"the approach is not free: {contact}", open_query)


def _pads_are_free(request: ApproachRequest, q: Array) -> bool:
    """Return True if the pads do not penetrate the object in postures (k, n)."""
    check, problem, robot = request.config.check, request.problem, request.config.robot
    assert check is not None
    name = problem.object or check.scene.grasped or ""
    pose = None if problem.object_pose is None else problem.object_pose[0]
    if pose is None and name not in check.scene.items:
        return False
    object_pose = check.scene.items[name].pose if pose is None else pose
    solid = check.scene.holding(name, object_pose).items[name]
    # A small sphere at the contact point represents a pad.
    pad = Scene({"pad": {"kind": "sphere", "radius": 1e-4}}).items["pad"]
    has_contact, tips = ~np.isnan(problem.points[0, :, 0]), robot.contacts(q)[0]
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    for i in np.flatnonzero(has_contact):
        poses[:, :3, 3] = tips[:, i]
        if gaps(pad, [solid], poses).min() < -MAX_PAD_PENETRATION:
            return False
    return True
