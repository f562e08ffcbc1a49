"""What contacts keep however the palm is moved, and what of it a robot can make: guaranteed bounds.

For each finger with an arm the distance of its contact from the shoulder, for each pair of fingers
the distance of their points and the angle of their normals; of a hand that cannot move the
coordinates of each point. The bounds are those over all postures of the hand, by branch and bound
with balls that hold every contact of a box of postures.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.proofs.numeric_bounds import Balls, angle_of, contact_balls, halved
from casadi_ik.proofs.premises import arm_span, endless_fingers, joint_limits, motor_box
from casadi_ik.robots.description import RobotDescription

SLACK = 1e-8
"""What bounds are moved outwards by and tolerances widened by [m, rad]: for rounding."""

Measure = Callable[[Balls], tuple[Array, Array]]
"""A quantity's value in the middle of boxes, and how far it can be from there."""


@dataclass(frozen=True)
class RigidInvariant:
    """What contacts keep however the palm is moved, or where the arm reaches, of one robot.

    Attributes:
        name: What it is, with the fingers.
        unit: "m" or "rad".
        fingers: Their numbers.
        reach: Whether it follows from the arm, too.
        lower: The smallest value that the robot can make; a guaranteed bound.
        upper: The largest.
    """

    name: str
    unit: str
    fingers: tuple[int, ...]
    reach: bool
    lower: float
    upper: float


@dataclass(frozen=True)
class Quantity(RigidInvariant):
    """The same with what a target asks of it.

    Attributes:
        asked: Its value in the target.
        give: By how much the tolerances let it differ.
    """

    asked: float
    give: float

    @property
    def excess(self) -> float:
        """By how much it is out of what is possible, whatever the tolerances give; <= 0 within."""
        return max(self.lower - self.asked, self.asked - self.upper) - self.give

    def agrees(self, other: Quantity) -> bool:
        """Whether both say the same, rounding aside."""
        named = (self.name, self.unit, self.fingers, self.reach)
        if named != (other.name, other.unit, other.fingers, other.reach):
            return False
        return all(
            abs(getattr(self, part) - getattr(other, part)) <= 1e-9
            for part in ("asked", "give", "lower", "upper")
        )


def rigid_invariants(robot: RobotDescription, targets: TargetBatch) -> tuple[RigidInvariant, ...]:
    """All quantities of a robot under the limits and locked motors of some problems.

    Takes some tenths of a second.
    """
    return tuple(_invariants(_Hand(robot, targets)))


def asked_values(
    robot: RobotDescription, invariants: tuple[RigidInvariant, ...], targets: TargetBatch
) -> tuple[Array, Array]:
    """What k targets ask of the quantities, and by how much the tolerances let it differ.

    Returns:
        Two arrays (k, m), NaN where a target does not ask for it.
    """
    position, angle = targets.position_tolerance, targets.angle_tolerance
    points, normals = targets.points, targets.normals
    span = arm_span(robot)
    asked = np.full((len(targets), len(invariants)), np.nan)
    give = np.full_like(asked, np.nan)
    for column, item in enumerate(invariants):
        first, last = points[:, item.fingers[0]], points[:, item.fingers[-1]]
        far = SLACK + 1e-12 * (np.abs(first).sum(axis=1) + np.abs(last).sum(axis=1))
        loose = position[list(item.fingers)].sum() + far
        if item.reach:
            assert span is not None
            asked[:, column] = np.linalg.norm(first - span.shoulder, axis=1)
        elif len(item.fingers) == 1:
            asked[:, column] = first[:, "xyz".index(item.name[0])]
        elif item.unit == "m":
            asked[:, column] = np.linalg.norm(last - first, axis=1)
        else:
            asked[:, column] = angle_of(*(normals[:, i] for i in item.fingers))
            loose = angle[list(item.fingers)].sum() + 2 * SLACK
        give[:, column] = loose
    return asked, np.where(np.isnan(asked), np.nan, give)


def quantities_of(
    invariants: Sequence[RigidInvariant], asked: Array, give: Array, fingers: Collection[int]
) -> tuple[Quantity, ...]:
    """What one target asks of some fingers alone.

    Args:
        invariants: Of the robot.
        asked: (m,) of `asked_values`.
        give: (m,) likewise.
        fingers: Their numbers.
    """
    return tuple(
        Quantity(**vars(item), asked=value, give=loose)
        for item, value, loose in zip(invariants, asked.tolist(), give.tolist(), strict=True)
        if set(item.fingers) <= set(fingers) and value == value
    )


class _Hand:
    """All postures of a hand, and balls that hold its contacts."""

    def __init__(self, robot: RobotDescription, targets: TargetBatch) -> None:
        self.robot = robot
        self.motors = robot.finger_motors
        self.ends = motor_box(robot, targets)
        self.limits = joint_limits(robot, targets)
        self.endless = endless_fingers(robot, self.ends)
        self.arm = arm_span(robot)
        self.span = (0.0, 0.0) if self.arm is None else self.arm.span(targets)

    def largest(
        self,
        fingers: tuple[int, ...],
        measure: Measure,
        sign: int,
        gap: float,
        most_boxes: int = 1000,
    ) -> float:
        """An upper bound of `sign` times a measure over all postures.

        Args:
            fingers: Their numbers.
            measure: The measure.
            sign: 1 or -1.
            gap: How near to what the hand can do the bound has to come.
            most_boxes: After so many it stays as far off as it is.
        """
        boxes, best, found, seen = self.ends[None], -np.inf, -np.inf, 0
        while len(boxes):
            seen += len(boxes)
            ball = contact_balls(
                self.robot,
                self.motors,
                (boxes[:, 0], boxes[:, 1]),
                self.limits,
                fingers,
                self.arm is not None,
            )
            value, give = measure(ball)
            real = ~ball.empty
            value, most, boxes = sign * value[real], (sign * value + give)[real], boxes[real]
            effect = ball.effect[real]
            best = max(best, value.max(initial=-np.inf))
            near = most <= best + gap
            if seen > most_boxes or not self.motors:
                near[:] = True
            found = max(found, most[near].max(initial=-np.inf))
            if near.all():
                break
            boxes, widest = boxes[~near], effect[~near].argmax(axis=1)
            boxes = halved(boxes, widest)
        return float(found) + SLACK

    def range(self, fingers: tuple[int, ...], measure: Measure, unit: str) -> tuple[float, float]:
        """Guaranteed bounds of a measure over all postures."""
        gap = 0.01 if unit == "m" else 0.1
        lower, upper = (self.largest(fingers, measure, sign, gap) for sign in (-1, 1))
        return -lower, upper


def _invariants(hand: _Hand) -> Iterator[RigidInvariant]:
    names = hand.robot.finger_names
    fingers = [i for i, endless in enumerate(hand.endless) if not endless]
    if hand.arm is None:
        for i in fingers:
            for axis, letter in enumerate("xyz"):
                ends = hand.range((i,), _coordinate(axis), "m")
                yield RigidInvariant(f"{letter} of {names[i]}", "m", (i,), False, *ends)
        return
    for i, j in combinations(fingers, 2):
        both, pair = f"{names[i]} and {names[j]}", (i, j)
        least, most = hand.range(pair, _distance, "m")
        yield RigidInvariant(f"distance of {both}", "m", pair, False, max(least, 0.0), most)
        least, most = hand.range(pair, _angle, "rad")
        angles = max(least, 0.0), min(most, np.pi)
        yield RigidInvariant(f"angle of the normals of {both}", "rad", pair, False, *angles)
    near, far = hand.span
    for i in fingers:
        least, most = hand.range((i,), _from(hand.arm.wrist), "m")
        # The contact is that far from the wrist, and the wrist that far from the shoulder.
        ends = max(least - far, near - most, 0.0), far + most
        yield RigidInvariant(f"distance of {names[i]} from the shoulder", "m", (i,), True, *ends)


def _coordinate(axis: int) -> Measure:
    return lambda found: (found.points[:, 0, axis], found.radius[:, 0])


def _from(point: Array) -> Measure:
    return lambda found: (
        np.linalg.norm(found.points[:, 0] - point, axis=1),
        found.radius[:, 0],
    )


def _distance(found: Balls) -> tuple[Array, Array]:
    apart = np.linalg.norm(found.points[:, 1] - found.points[:, 0], axis=1)
    return apart, found.radius.sum(axis=1)


def _angle(found: Balls) -> tuple[Array, Array]:
    return angle_of(found.normals[:, 0], found.normals[:, 1]), found.angle.sum(axis=1)
