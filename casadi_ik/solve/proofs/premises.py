"""What proofs start from: everything that a target lets the motors, and with them the arm, do.

Prover and checker bound the hand's contacts by arithmetics of their own; what is here they share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import Sphere
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint
from casadi_ik.model.linkage import link_poses
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK

OUTWARDS = 2 * LIMIT_SLACK
"""Limits are taken so much wider [rad or m], since the verdict allows half of it."""

ENDLESS = 1e9
"""Stands for a motor without ends whose motion does not repeat [rad or m]."""

TURNS = 12
"""Joints that turn by fractions of a motor's turn are followed over so many turns at most."""

MEETING = 1e-9
"""How far from an axis a point may be that counts as on it; also what the arm's bounds are moved
outwards by [m]."""

NO_CONE = -2.0
"""The cosine of a cone that excludes nothing."""


def motor_ends(robot: RobotDescription, targets: TargetBatch) -> tuple[Array, Array]:
    """(n,) lower and upper ends of all motors, as the verdict has them: each by itself.

    `RobotDescription.lower` leaves out what is of no use to a method; a proof must not.
    """
    lower, upper = robot.strokes if targets.enforce_limits else robot.mechanical
    if targets.fixed is None:
        return lower, upper
    free = np.isnan(targets.fixed)
    return np.where(free, lower, targets.fixed), np.where(free, upper, targets.fixed)


def motor_box(robot: RobotDescription, targets: TargetBatch) -> Array:
    """(2, h) lower and upper ends of `robot.finger_motors`.

    Limits where they are enforced; where they are ignored what the mechanisms can do, and else all
    turns until everything repeats. A motor whose motion never repeats is `ENDLESS`.
    """
    names = robot.finger_motors
    lower, upper = motor_ends(robot, targets)
    columns = [robot.actuator_index(name) for name in names]
    ends = np.stack([lower[columns] - OUTWARDS, upper[columns] + OUTWARDS])
    for i in np.flatnonzero(np.isinf(ends).any(axis=0)):
        ends[:, i] = np.array([-1.0, 1.0]) * _half_period(robot, names[i])
    return ends


def joint_limits(robot: RobotDescription, targets: TargetBatch) -> tuple[Array, Array]:
    """(m,) lower and upper limits of `robot.finger_joints`; infinite where limits are ignored."""
    rows = [robot.joint_names.index(name) for name in robot.finger_joints]
    if not targets.enforce_limits:
        return np.full(len(rows), -np.inf), np.full(len(rows), np.inf)
    return robot.joint_lower[rows] - OUTWARDS, robot.joint_upper[rows] + OUTWARDS


def endless_fingers(robot: RobotDescription, box: Array) -> list[bool]:
    """By finger whether one of its motors has no ends, so that nothing bounds it."""
    far = dict(zip(robot.finger_motors, np.abs(box).max(axis=0), strict=True))
    names = robot.actuator_names
    return [
        any(far[names[i]] >= ENDLESS for i in robot.finger_actuators(finger))
        for finger in robot.finger_names
    ]


def _half_period(robot: RobotDescription, motor: str) -> float:
    """Half of what a motor without limits turns until everything repeats [rad]."""
    by_name = {joint.name: joint for joint in robot.movable}
    ratios = []
    for name in robot.finger_joints:
        ratio = _rate(by_name, name, motor)
        if ratio is None:
            continue
        if by_name[name].type == "prismatic" or np.isnan(ratio):
            return ENDLESS
        ratios.append(ratio)
    for turns in range(1, TURNS + 1):
        if all(abs(ratio * turns - round(ratio * turns)) <= 1e-12 for ratio in ratios):
            return np.pi * turns
    return ENDLESS


def _rate(by_name: dict[str, Joint], name: str, motor: str) -> float | None:
    """Turns of a joint for each turn of a motor; None if it does not follow.

    1 beyond a mechanism that repeats with each turn of what drives it, whatever it makes of it;
    NaN beyond a coupling that does not repeat.
    """
    ratio = 1.0
    while name != motor:
        joint = by_name.get(name)
        if joint is None or joint.coupling is None:
            return None
        coupling = joint.coupling
        if coupling.slope is not None:
            ratio *= coupling.slope[0]
        else:
            ratio = 1.0 if coupling.periodic and not np.isnan(ratio) else np.nan
        name = coupling.of
    return ratio


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

    def span(self, targets: TargetBatch) -> tuple[float, float]:
        """Smallest and largest distance [m] within limits, or without where they are ignored."""
        if len(self.between) == 1 and self.between[0].type == "revolute":
            near, far = self._one_joint(self.between[0], targets)
        else:
            near, far = 0.0, self._length(targets)
        return near - MEETING, far + MEETING

    def _one_joint(self, joint: Joint, targets: TargetBatch) -> tuple[float, float]:
        """The squared distance is a + b cos(theta) + c sin(theta)."""
        samples = np.array([0.0, np.pi / 2, np.pi])
        wrists = self._palm({joint.name: samples}) @ np.append(self.wrist, 1.0)
        squares = ((wrists[:, :3] - self.shoulder) ** 2).sum(axis=1)
        a = (squares[0] + squares[2]) / 2
        b, c = squares[0] - a, squares[1] - a
        lower, upper = self._range(joint, targets)
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

    def _length(self, targets: TargetBatch) -> float:
        """The arm drawn straight: no pose is longer."""
        poses = link_poses(self.robot.root, self.robot.joints, {})
        points = [self.shoulder, *(poses[joint.child][:3, 3] for joint in self.between)]
        points.append((self._palm({}) @ np.append(self.wrist, 1.0))[:3])
        long = sum(np.linalg.norm(b - a) for a, b in pairwise(points))
        for joint in self.between:
            if joint.type == "prismatic":
                long += np.abs(self._range(joint, targets)).max()
        return float(long)

    def _range(self, joint: Joint, targets: TargetBatch) -> tuple[float, float]:
        """Ends of a joint: its own limits, and those of its motor where it is one."""
        lower, upper = -np.inf, np.inf
        if targets.enforce_limits:
            lower, upper = joint.lower - OUTWARDS, joint.upper + OUTWARDS
        if joint.name in self.robot.actuator_names:
            i = self.robot.actuator_index(joint.name)
            ends = motor_ends(self.robot, targets)
            lower = max(lower, ends[0][i] - OUTWARDS)
            upper = min(upper, ends[1][i] + OUTWARDS)
        return float(lower), float(upper)

    def _palm(self, values: dict[str, Array]) -> Array:
        robot = self.robot
        return link_poses(robot.root, robot.joints, values)[robot.palm_link] @ robot.palm_placement


def arm_span(robot: RobotDescription) -> ArmSpan | None:
    """The arm's shoulder and wrist; None for a hand whose palm does not move."""
    joints = tuple(joint for joint in robot.chain(robot.palm_link) if joint.type != "fixed")
    if not joints:
        return None
    poses = link_poses(robot.root, robot.joints, {})
    lines = [(poses[j.child][:3, 3], poses[j.child][:3, :3] @ j.axis) for j in joints]
    shoulder, first = _common(joints, lines)
    wrist, last = _common(joints[::-1], lines[::-1])
    first, last = min(first, len(joints)), max(len(joints) - last, 0)
    palm = poses[robot.palm_link] @ robot.palm_placement
    in_palm = palm[:3, :3].T @ (wrist - palm[:3, 3])
    return ArmSpan(shoulder, in_palm, joints[first : max(last, first)], robot)


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


def palms_in_span(arm: ArmSpan | None, targets: TargetBatch) -> NDArray[np.bool_] | None:
    """(k,) whether palms that are given have the wrist within the arm's span, tolerances aside.

    Args:
        arm: The span; None: nothing is known.
        targets: k targets with palms, of one arm.
    """
    if arm is None or targets.palms is None:
        return None
    fixed = targets.fixed
    one = targets if fixed is None or fixed.ndim == 1 else replace(targets, fixed=fixed[0])
    near, far = arm.span(one)
    allowed = targets.largest_tolerance
    turned = 2 * np.sin(min(allowed.angle, np.pi) / 2) * np.linalg.norm(arm.wrist)
    loose = (1 + TOLERANCE_SLACK) * (allowed.position + turned) + MEETING
    wrist = targets.palms[:, :3, :3] @ arm.wrist + targets.palms[:, :3, 3]
    away = np.linalg.norm(wrist - arm.shoulder, axis=1)
    return (away >= near - loose) & (away <= far + loose)


@dataclass(frozen=True, eq=False)
class ArmCones:
    """How far a seven-joint arm can bend shoulder and wrist away from straight.

    Of an arm with a spherical shoulder, an elbow and a spherical wrist joint 2 is the angle of the
    upper arm to axis 1, and joint 6 that of axis 7 to the forearm, whatever the other joints do.

    Attributes:
        robot: The description.
        shoulder: (3,) where the upper arm begins [m], base frame.
        wrist: (3,) where the forearm ends [m], palm frame.
        first: (3,) unit, base frame; the upper arm's angle to it is joint 2 and its offset.
        last: (3,) unit, palm frame; the forearm's angle to it is joint 6 and its offset.
        lengths: Of upper arm and forearm [m].
        offsets: Of joints 2 and 6 [rad].
    """

    robot: RobotDescription
    shoulder: Array
    wrist: Array
    first: Array
    last: Array
    lengths: tuple[float, float]
    offsets: tuple[float, float]

    def cosines(self, targets: TargetBatch) -> Array:
        """(2,) of the half angles of the cones, `NO_CONE` where all directions are inside."""
        lower, upper = motor_ends(self.robot, targets)
        found = []
        for joint, offset in zip((1, 5), self.offsets, strict=True):
            i = self.robot.arm_actuators[joint]
            ends = lower[i] - OUTWARDS + offset, upper[i] + OUTWARDS + offset
            most = max(abs(end) for end in ends)
            found.append(float(np.cos(most)) if most < np.pi else NO_CONE)
        return np.array(found)


def arm_cones(robot: RobotDescription) -> ArmCones | None:
    """The cones of an arm of that kind, else None."""
    arm = srs_arm(robot)
    if arm is None:
        return None

    def third(joints: Sphere) -> Array:
        return joints.frame @ [np.sin(joints.offset), 0.0, np.cos(joints.offset)]

    upper, fore = (float(np.linalg.norm(link)) for link in (arm.upper_arm, arm.forearm))
    # Axis 3 lies along the upper arm and axis 5 along the forearm, either way round.
    along = np.sign(third(arm.shoulder_joints) @ arm.upper_arm)
    ahead = np.sign(arm.wrist_joints.frame[:, 2] @ arm.forearm)
    return ArmCones(
        robot=robot,
        shoulder=arm.shoulder,
        wrist=arm.wrist_in_palm,
        first=along * arm.shoulder_joints.frame[:, 2],
        last=ahead * (arm.screws.rotation.T @ third(arm.wrist_joints)),
        lengths=(upper, fore),
        offsets=(arm.shoulder_joints.offset, arm.wrist_joints.offset),
    )
