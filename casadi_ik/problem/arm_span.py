"""How far an arm can hold the wrist from the shoulder: guaranteed bounds for any arm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.problem.hand_motors import OUTWARDS, motor_ends
from casadi_ik.problem.joint_frames import link_frames, placed
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import TOLERANCE_SLACK
from casadi_ik.robots.description import Joint, RobotDescription

MEETING = 1e-9
"""How far from an axis a point may be that counts as on it [m]."""

ROUNDING = 1e-9
"""What the bounds are moved outwards by [m]."""


@dataclass(frozen=True, eq=False)
class ArmSpan:
    """A point that the first joints leave in place, one of the palm that the last ones do.

    Attributes:
        shoulder: (3,) in the base frame [m].
        wrist: (3,) in the palm frame [m].
        between: The joints in between: only these change the distance of the two points.
        robot: The description.
    """

    shoulder: Array
    wrist: Array
    between: tuple[Joint, ...]
    robot: RobotDescription

    def span(self, problems: Problems) -> tuple[float, float]:
        """Smallest and largest distance [m] within limits, or without where they are ignored."""
        if len(self.between) == 1 and self.between[0].type == "revolute":
            near, far = self._one_joint(self.between[0], problems)
        else:
            near, far = 0.0, self._length(problems)
        return near - ROUNDING, far + ROUNDING

    def _one_joint(self, joint: Joint, problems: Problems) -> tuple[float, float]:
        """The squared distance is a + b cos(theta) + c sin(theta)."""
        samples = np.array([0.0, np.pi / 2, np.pi])
        squares = self._distances(joint.name, samples) ** 2
        a = (squares[0] + squares[2]) / 2
        b, c = squares[0] - a, squares[1] - a
        lower, upper = self._range(joint, problems)
        angles = [lower, upper]
        if upper - lower >= 2 * np.pi:
            angles = [0.0]
        top = np.arctan2(c, b)
        for extreme in (top, top + np.pi):
            first = extreme + 2 * np.pi * np.ceil((lower - extreme) / (2 * np.pi))
            if upper - lower >= 2 * np.pi or first <= upper:
                angles.append(extreme)
        values = a + b * np.cos(angles) + c * np.sin(angles)
        near, far = np.sqrt(np.maximum([values.min(), values.max()], 0.0))
        return float(near), float(far)

    def _length(self, problems: Problems) -> float:
        """The arm drawn straight: no pose is longer."""
        frames = link_frames(self.robot, {}, 1)
        points = [self.shoulder, *(frames[joint.child][1][0] for joint in self.between)]
        rotation, origin = placed(frames[self.robot.palm_link], self.robot.palm_placement)
        points.append(origin[0] + rotation[0] @ self.wrist)
        long = sum(np.linalg.norm(b - a) for a, b in pairwise(points))
        for joint in self.between:
            if joint.type == "prismatic":
                long += np.abs(self._range(joint, problems)).max()
        return float(long)

    def _range(self, joint: Joint, problems: Problems) -> tuple[float, float]:
        """Ends of a joint: its own limits, and those of its motor where it is one."""
        if not problems.enforce_limits:
            lower, upper = -np.inf, np.inf
        else:
            lower, upper = joint.lower - OUTWARDS, joint.upper + OUTWARDS
        if joint.name in self.robot.actuator_names:
            i = self.robot.actuator_index(joint.name)
            ends = motor_ends(self.robot, problems)
            lower = max(lower, ends[0][i] - OUTWARDS)
            upper = min(upper, ends[1][i] + OUTWARDS)
        return float(lower), float(upper)

    def _distances(self, name: str, values: Array) -> Array:
        frames = link_frames(self.robot, {name: values}, len(values))
        rotation, origin = placed(frames[self.robot.palm_link], self.robot.palm_placement)
        return np.linalg.norm(origin + rotation @ self.wrist - self.shoulder, axis=1)


def palms_in_span(arm: ArmSpan | None, problems: Problems) -> NDArray[np.bool_] | None:
    """(k,) whether palms that are given have the wrist within the arm's span, tolerances aside.

    Args:
        arm: The span; None: nothing is known.
        problems: k targets with palms, of one arm.
    """
    if arm is None or problems.palms is None:
        return None
    fixed = problems.fixed
    one = problems if fixed is None or fixed.ndim == 1 else replace(problems, fixed=fixed[0])
    near, far = arm.span(one)
    allowed = problems.largest_tolerance
    turned = 2 * np.sin(min(allowed.angle, np.pi) / 2) * np.linalg.norm(arm.wrist)
    loose = (1 + TOLERANCE_SLACK) * (allowed.position + turned) + ROUNDING
    wrist = problems.palms[:, :3, :3] @ arm.wrist + problems.palms[:, :3, 3]
    away = np.linalg.norm(wrist - arm.shoulder, axis=1)
    return (away >= near - loose) & (away <= far + loose)


def arm_span(robot: RobotDescription) -> ArmSpan | None:
    """The arm's shoulder and wrist; None for a hand whose palm does not move."""
    joints = tuple(joint for joint in robot.chain(robot.palm_link) if joint.type != "fixed")
    if not joints:
        return None
    frames = link_frames(robot, {}, 1)
    lines = [(frames[j.child][1][0], frames[j.child][0][0] @ j.axis) for j in joints]
    shoulder, first = _common(joints, lines)
    wrist, last = _common(joints[::-1], lines[::-1])
    first, last = min(first, len(joints)), max(len(joints) - last, 0)
    rotation, origin = placed(frames[robot.palm_link], robot.palm_placement)
    return ArmSpan(
        shoulder, rotation[0].T @ (wrist - origin[0]), joints[first : max(last, first)], robot
    )


def _common(joints: tuple[Joint, ...], lines: list[tuple[Array, Array]]) -> tuple[Array, int]:
    """A point on as many of the first axes as meet, and how many: 0 if the first slides."""
    point = lines[0][0]
    if joints[0].type != "revolute":
        return point, 0
    if len(lines) > 1 and joints[1].type == "revolute":
        (p, a), (q, b) = lines[0], lines[1]
        across = np.cross(a, b)
        if np.linalg.norm(across) > MEETING:
            # Where the first axis is nearest to the second.
            t = np.dot(np.cross(q - p, b), across) / (across @ across)
            point = p + t * a
    count = 0
    for joint, (origin, axis) in zip(joints, lines, strict=True):
        if joint.type != "revolute" or np.linalg.norm(np.cross(point - origin, axis)) > MEETING:
            break
        count += 1
    return point, count
