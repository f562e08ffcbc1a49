"""The last part of the way to a grasp, found backwards: the hand opens, and goes straight back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product
from typing import Any

import numpy as np

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.collision.distances import gaps
from casadi_ik.collision.scene import Scene
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import point_normal_kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.clear import least_clearance
from casadi_ik.motion.cycle import of_side
from casadi_ik.motion.inputs import ANY, FollowerInputs, FollowPlan


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
        self._asked = FollowerInputs(plan, point_normal_kinds(len(plan.robot.fingers)), 0)

    def find(
        self,
        problem: TargetBatch,
        q: Array,
        opening: float,
        distance: float,
        ways: Array,
    ) -> LastPart | None:
        """The last part of the way to a solution; None if there is none.

        Args:
            problem: The grasp.
            q: (n,) its solution.
            opening: How far the fingertips are from their contacts while the hand is open [m].
            distance: How far it comes straight [m].
            ways: (f, 3) unit, the way each finger's hand comes, base frame.
        """
        robot = self._robot
        points, normals = robot.contacts(q)
        given = ~np.isnan(problem.points[0, :, 0])
        share = np.linspace(0.0, 1.0, self.postures)[:, None, None]
        opened = points - opening * share * normals
        opening_way = self._walk(q, opened, {}, given)
        there = opening_way[-1]
        if not self._asked.cycle.palms:
            return LastPart(there[None], opening_way[::-1])
        coming = self.straight(there, -distance * ways * hands_used(robot, problem))
        return None if coming is None else LastPart(coming[::-1], opening_way[::-1])

    def straight(self, q: Array, shift: Array) -> Array | None:
        """(k, n) postures from q on with all of the hand moved; None: it strays.

        Args:
            q: (n,).
            shift: (3,), or (f, 3) the same for fingers of a hand, base frame [m].
        """
        robot, share = self._robot, np.linspace(0.0, 1.0, self.postures)[:, None, None]
        tips, palms = robot.contacts(q)[0], dict[str | None, Array]()
        shifts = np.broadcast_to(shift, tips.shape)
        for side, hand in robot.hands.items():
            palms[side] = np.repeat(robot.palm(q, side)[None], self.postures, axis=0)
            palms[side][:, :3, 3] += share[:, 0] * shifts[hand[0]]
        every = np.ones(len(tips), dtype=bool)
        found = self._walk(q, tips + share * shifts, palms, every)
        for side, poses in palms.items():
            off = np.linalg.norm(robot.palm(found, side)[:, :3, 3] - poses[:, :3, 3], axis=1)
            if off.max() > self.stray:
                return None
        return found

    def _walk(
        self, q: Array, tips: Array, palms: Mapping[str | None, Array], given: Array
    ) -> Array:
        """(k, n) postures from q on, with fingertips and palms where they are asked for.

        Args:
            q: (n,).
            tips: (k, f, 3) [m].
            palms: (k, 4, 4) by side; where they are if it is left out.
            given: (f,) whether a fingertip counts.
        """
        asked, f = self._asked, len(given)
        values: dict[str, Any] = {
            "points": tips,
            "normals": [ANY] * f,
            "weights": np.stack([given, 0 * given], axis=1),
            "position_tolerance": np.ones(f),
            "angle_tolerance": np.ones(f),
        }
        for side in asked.cycle.palms:
            poses = palms.get(side, self._robot.palm(q, side))
            wanted = {"point": poses[..., :3, 3], "axes": poses[..., :3, :3], "weight": np.ones(2)}
            values |= {of_side(f"palm_{name}", side): array for name, array in wanted.items()}
        rows = np.repeat(asked.rows(len(tips), values), self.cycles, axis=0)
        states, _ = asked.run.run(asked.state_at(q), rows)
        found = states[self.cycles - 1 :: self.cycles, : len(q)]
        found[0] = q
        return found


def hands_used(robot: ArmHand, problem: TargetBatch) -> Array:
    """(f, 1) for each finger 1 if its hand touches something, 0: then the hand stays."""
    given, used = ~np.isnan(problem.points[0, :, 0]), np.zeros((len(robot.fingers), 1))
    for hand in map(list, robot.hands.values()):
        used[hand] = given[hand].any()
    return used


LEAN = float(np.tan(np.deg2rad(35.0)))
"""How far ways lean that are tried when none before could be gone."""

NARROWER = np.array([1.0, 0.5, 0.25])
"""Of the opening that was asked for: where the hand, or a table, leaves no room for the whole."""

PRESSED = 1e-3
"""What a pad may be in the object while the open hand comes: as far off as a contact may be [m]."""


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


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

    def ways(self, q: Array) -> list[Array]:
        """(f, 3) unit, the ways hands may come to a solution (n,), the first that can be gone is.

        The one that was said, or: from where the grasp has its palm before it, from the palm to the
        contacts, from above, between those, and leaning to each side.
        """
        robot = self.plan.robot
        if self.direction is not None:
            return [np.tile(_unit(self.direction), (len(robot.fingers), 1))]
        given, tips = ~np.isnan(self.problem.points[0, :, 0]), robot.contacts(q)[0]
        every = dict[int, list[Array]]()
        for side, hand in robot.hands.items():
            fingers = [i for i in hand if given[i]]
            ways = self._ways_of_hand(robot.palm(q, side), tips[fingers])
            every |= dict.fromkeys(hand, ways)
        return [np.stack(ways) for ways in zip(*(every[i] for i in sorted(every)), strict=True)]

    def _ways_of_hand(self, palm: Array, tips: Array) -> list[Array]:
        """(3,) unit, of a hand whose fingertips (k, 3) touch."""
        down = np.array([0.0, 0.0, -1.0])
        first = tips.mean(axis=0) - palm[:3, 3] if len(tips) else down
        if self.pregrasp is not None:
            way = palm[:3, 3] - self.pregrasp
            # A palm that is nearer to its grasp before it does not say from where it comes.
            first = way if np.linalg.norm(way) > 5e-3 else first
        first = _unit(first)
        sides = [s * palm[:3, axis] for axis in (0, 1) for s in (1.0, -1.0)]
        others = [first + down, down, *(first + LEAN * side for side in sides)]
        return [first, *(_unit(one) if np.linalg.norm(one) > 0.1 else first for one in others)]


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
        coming: What is not to be touched while it comes: one of both.
    """

    closer: Closer
    number: int
    q: Array
    last: LastPart | None
    reason: str
    open_handed: CollisionQuery | None
    holding: CollisionQuery | None
    coming: CollisionQuery | None


def approaches(asked: ApproachPlan, solutions: Sequence[Array]) -> Iterator[Tried]:
    """What becomes of solutions (n,) of a grasp, in order."""
    closer = Closer(asked.plan)
    holding, open_handed = _surroundings(asked)
    for number, q in enumerate(solutions, start=1):
        barred = -1.0
        last, reason, coming = None, "", open_handed
        for opening, way in product(asked.opening * NARROWER, asked.ways(q)):
            if barred == opening:
                continue
            last = closer.find(asked.problem, q, opening, asked.distance, way)
            why, coming = _blocked(asked, last, holding, open_handed)
            reason = reason or why
            if not why:
                reason = ""
                break
            last = None
            if why.startswith(CLOSES):
                barred = opening  # whichever way the hand comes
        yield Tried(closer, number, q, last, reason, open_handed, holding, coming)


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
        if one.coming is not None:
            clearance, _ = least_clearance(one.coming, one.last.coming)
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


CLOSES = "the closing"


def _blocked(
    asked: ApproachPlan,
    last: LastPart | None,
    holding: CollisionQuery | None,
    open_handed: CollisionQuery | None,
) -> tuple[str, CollisionQuery | None]:
    """Why the last part cannot be gone, "": it can; and what is not touched as the hand comes.

    Shapes of fingers are rounder than fingers are. Where a hand cannot open far enough for them,
    links with a contact may touch the object, if their pads keep out of it.
    """
    if last is None:
        return "the arm cannot follow the straight way back", open_handed
    if holding is None or open_handed is None:
        return "", None
    if len(last.closing) > 1 and (touching := least_clearance(holding, last.closing)[1]):
        return f"{CLOSES} is not free: {touching}", open_handed
    if len(last.coming) < 2:
        return "", open_handed
    _, touching = least_clearance(open_handed, last.coming)
    if not touching:
        return "", open_handed
    begins = not least_clearance(open_handed, last.coming[:1])[1]
    if begins and not least_clearance(holding, last.coming)[1] and _pads_clear(asked, last.coming):
        return "", holding
    return f"the approach is not free: {touching}", open_handed


def _pads_clear(asked: ApproachPlan, q: Array) -> bool:
    """Whether the pads of postures (k, n) keep out of the object."""
    check, problem = asked.plan.check, asked.problem
    assert check is not None
    name = problem.object or check.scene.grasped or ""
    pose = None if problem.object_pose is None else problem.object_pose[0]
    if pose is None and name not in check.scene.items:
        return False
    place = check.scene.items[name].pose if pose is None else pose
    thing = check.scene.holding(name, place).items[name]
    pad = Scene({"pad": {"kind": "sphere", "radius": 1e-4}}).items["pad"]
    given = ~np.isnan(problem.points[0, :, 0])
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    for i in np.flatnonzero(given):
        poses[:, :3, 3] = asked.plan.robot.contacts(q)[0][:, i]
        if gaps(pad, [thing], poses).min() < -PRESSED:
            return False
    return True
