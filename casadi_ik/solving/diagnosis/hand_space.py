"""The hand's motions as a box of coordinates that every finger joint follows.

A coordinate is the joint that a motor turns, where it turns one only: a slider's length bends the
slopes, the angle it makes does not. Otherwise it is the motor itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.hand_motors import OUTWARDS, finger_joints, hand_motors, motor_box
from casadi_ik.problem.problems import Problems
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.joint_ranges import Range, joint_ranges


@dataclass(frozen=True, eq=False)
class HandSpace:
    """Coordinates of the hand of a robot.

    Attributes:
        robot: The description.
    """

    robot: RobotDescription

    @cached_property
    def motors(self) -> tuple[str, ...]:
        """The actuators that move a finger relative to the palm."""
        return hand_motors(self.robot)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """All joints of the fingers, in the order of `robot.joint_names`."""
        return finger_joints(self.robot)

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, one for each motor: of a joint or of the motor."""
        found = []
        for motor in self.motors:
            moved = [
                joint.name
                for joint in self.robot.movable
                if joint.name == motor or (joint.coupling and joint.coupling.of == motor)
            ]
            found.append(moved[0] if len(moved) == 1 else motor)
        return tuple(found)

    def followed(self, joint: str) -> tuple[int, float | None]:
        """Which coordinate a joint follows, and its rate; None if that is not constant."""
        by_name = {item.name: item for item in self.robot.movable}
        rate: float | None = 1.0
        while joint not in self.coordinates:
            coupling = by_name[joint].coupling
            if coupling is None:
                raise AssertionError(f"joint {joint!r} follows no motor of the hand")
            slope = coupling.slope
            rate = None if slope is None or rate is None else rate * slope[0]
            joint = coupling.of
        return self.coordinates.index(joint), rate

    def ranges(self, lower: ca.SX, upper: ca.SX) -> dict[str, Range]:
        """Intervals of all joints of the fingers, by name.

        Args:
            lower: (h, 1) ends of the coordinates.
            upper: (h, 1).
        """
        given = {name: Range(lower[i], upper[i]) for i, name in enumerate(self.coordinates)}
        found = joint_ranges(self.robot, given)
        return {name: found[name] for name in self.joints}

    def of(self, places: Mapping[str, Array], problems: Problems) -> Array:
        """(k, h) coordinates of joint and motor positions, turned by whole periods into the box.

        Args:
            places: (k,) by name of the joint or motor [rad or m].
            problems: Whose limits count.
        """
        lower, upper = self.box(problems)
        found = np.stack([places[name] for name in self.coordinates], axis=1)
        turns = np.floor((found - lower) / (upper - lower))
        turns[(found >= lower) & (found <= upper)] = 0
        return found - turns * (upper - lower)

    def box(self, problems: Problems) -> tuple[Array, Array]:
        """(h,) ends of the coordinates within all that the problems let the hand do."""
        ends = motor_box(self.robot, problems)
        low, high = (np.array(part).ravel() for part in self._of_motors(ends[0], ends[1]))
        if problems.enforce_limits:
            # The limits of a coupled joint may be narrower than those of its motor.
            for joint in self.robot.movable:
                if joint.name in self.coordinates:
                    i = self.coordinates.index(joint.name)
                    low[i] = max(low[i], joint.lower - OUTWARDS)
                    high[i] = min(high[i], joint.upper + OUTWARDS)
        return low, high

    @cached_property
    def _of_motors(self) -> ca.Function:
        lower, upper = (ca.SX.sym(name, len(self.motors)) for name in ("lower", "upper"))
        given = {name: Range(lower[i], upper[i]) for i, name in enumerate(self.motors)}
        found = joint_ranges(self.robot, given) | given
        ranges = [found[name] for name in self.coordinates]
        ends = [ca.vertcat(*(getattr(r, side) for r in ranges)) for side in ("lower", "upper")]
        return ca.Function("coordinates", [lower, upper], ends)
