"""Premises of proofs: points that a target requires, and ranges of motors, joints and the arm.

The prover and the checker share this module; each bounds the contacts with separate code.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import SphericalJoints
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.contacts import CONDITIONS, POSITION
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint, link_poses
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.verdict import LIMIT_SLACK, TOLERANCE_SLACK

LIMIT_MARGIN = 2 * LIMIT_SLACK
"""Margin by which limits are widened [rad or m], twice that which the verdict allows."""

UNBOUNDED = 1e9
"""Limit of a motor without limits whose motion is not periodic [rad or m]."""

MAX_REVOLUTIONS = 12
"""Maximum number of motor revolutions in which coupled joints must repeat their motion."""

AXIS_TOLERANCE = 1e-9
"""Distance below which a point lies on an axis, and margin of the bounds of the arm [m]."""

NO_CONE_LIMIT = -2.0
"""Cosine of a cone that excludes no direction."""


SLIDING_ARRAYS = {
    f"{name}s"
    for condition in CONDITIONS.values()
    if condition.aspect == POSITION
    for name in condition.data
} - {"points", "balls"}
"""Arrays that let a contact slide away from its point; proofs ignore such fingers."""


def required_points(robot: RobotDescription, targets: TargetBatch) -> tuple[Array, Array]:
    """Return the points that the fingertips must reach, and their depths below the pads.

    A contact of a rolling pad requires the centre of the pad's ball: the point at one radius behind
    the contact point, opposite to the normal. All other contacts require the contact point itself.

    Returns:
        (k, f, 3) points [m], base frame, NaN where a finger is free or may slide; (k, f) depths
        below the contact points of the fingertips [m].
    """
    points, depths = targets.points.copy(), np.zeros(targets.points.shape[:2])
    for name, vectors in targets.extra_vectors.items():
        is_present = ~np.isnan(vectors[..., 0])
        if name in SLIDING_ARRAYS:
            points[is_present] = np.nan
        elif name == "balls":
            radii = np.array([finger.radius for finger in robot.fingers])
            depths = np.where(is_present, radii, 0.0)
            points -= depths[..., None] * np.where(is_present[..., None], vectors, 0.0)
    return points, depths


def motor_limits(robot: RobotDescription, targets: TargetBatch) -> tuple[Array, Array]:
    """Return the lower and upper limits (n,) of all motors that the verdict checks.

    `RobotDescription.lower` and `upper` exclude positions that are useless to a method; a proof
    must include them.
    """
    lower, upper = robot.actuator_limits if targets.enforce_limits else robot.mechanical_limits
    if targets.fixed is None:
        return lower, upper
    free = np.isnan(targets.fixed)
    return np.where(free, lower, targets.fixed), np.where(free, upper, targets.fixed)


def motor_box(robot: RobotDescription, targets: TargetBatch) -> Array:
    """Return lower and upper bounds (2, h) of `robot.finger_motors`.

    These are the limits if they are enforced, otherwise the mechanical range, or one period of a
    motor without a mechanical range. The bounds of a motor that is not periodic are `UNBOUNDED`.
    """
    names = robot.finger_motors
    lower, upper = motor_limits(robot, targets)
    columns = [robot.actuator_index(name) for name in names]
    bounds = np.stack([lower[columns] - LIMIT_MARGIN, upper[columns] + LIMIT_MARGIN])
    for i in np.flatnonzero(np.isinf(bounds).any(axis=0)):
        bounds[:, i] = np.array([-1.0, 1.0]) * _half_period(robot, names[i])
    return bounds


def joint_limits(robot: RobotDescription, targets: TargetBatch) -> tuple[Array, Array]:
    """Return the limits (m,) of `robot.finger_joints`; infinite if limits are ignored."""
    rows = [robot.joint_names.index(name) for name in robot.finger_joints]
    if not targets.enforce_limits:
        return np.full(len(rows), -np.inf), np.full(len(rows), np.inf)
    return robot.joint_lower[rows] - LIMIT_MARGIN, robot.joint_upper[rows] + LIMIT_MARGIN


def fingers_without_limits(robot: RobotDescription, box: Array) -> list[bool]:
    """Return for each finger whether one of its motors is unbounded."""
    largest_position = dict(zip(robot.finger_motors, np.abs(box).max(axis=0), strict=True))
    names = robot.actuator_names
    return [
        any(largest_position[names[i]] >= UNBOUNDED for i in robot.finger_actuators(finger))
        for finger in robot.finger_names
    ]


def _half_period(robot: RobotDescription, motor: str) -> float:
    """Return half the period of a motor without limits [rad], or `UNBOUNDED`."""
    by_name = {joint.name: joint for joint in robot.movable}
    ratios = []
    for name in robot.finger_joints:
        ratio = _speed_ratio(by_name, name, motor)
        if ratio is None:
            continue
        if by_name[name].type == "prismatic" or np.isnan(ratio):
            return UNBOUNDED
        ratios.append(ratio)
    for revolutions in range(1, MAX_REVOLUTIONS + 1):
        if all(abs(ratio * revolutions - round(ratio * revolutions)) <= 1e-12 for ratio in ratios):
            return np.pi * revolutions
    return UNBOUNDED


def _speed_ratio(by_name: dict[str, Joint], name: str, motor: str) -> float | None:
    """Return the revolutions of a joint per revolution of a motor; None if it is not driven by it.

    The ratio is 1 after a mechanism with the period of its driver, and NaN after a coupling that
    is not periodic.
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
    """Shoulder and wrist of an arm: points that its first and last joints do not move.

    Attributes:
        shoulder: (3,) point fixed in the base, base frame [m].
        wrist: (3,) point fixed in the palm, palm frame [m].
        between: Joints between them, the only ones that change the distance of the two points.
        robot: Description of the robot.
    """

    shoulder: Array
    wrist: Array
    between: tuple[Joint, ...]
    robot: RobotDescription

    def span(self, targets: TargetBatch) -> tuple[float, float]:
        """Return bounds of the distance from shoulder to wrist [m]."""
        if len(self.between) == 1 and self.between[0].type == "revolute":
            nearest, farthest = self._distance_over_one_joint(self.between[0], targets)
        else:
            nearest, farthest = 0.0, self._straight_length(targets)
        return nearest - AXIS_TOLERANCE, farthest + AXIS_TOLERANCE

    def _distance_over_one_joint(self, joint: Joint, targets: TargetBatch) -> tuple[float, float]:
        """Return the range of the distance, whose square is a + b cos(theta) + c sin(theta)."""
        samples = np.array([0.0, np.pi / 2, np.pi])
        p_base_wrist = self._palm_pose({joint.name: samples}) @ np.append(self.wrist, 1.0)
        squares = ((p_base_wrist[:, :3] - self.shoulder) ** 2).sum(axis=1)
        a = (squares[0] + squares[2]) / 2
        b, c = squares[0] - a, squares[1] - a
        lower, upper = self._joint_range(joint, targets)
        angles = [lower, upper]
        if upper - lower >= 2 * np.pi:
            angles = [0.0]
        angle_of_maximum = np.arctan2(c, b)
        for extreme in (angle_of_maximum, angle_of_maximum + np.pi):
            first = extreme + 2 * np.pi * np.ceil((lower - extreme) / (2 * np.pi))
            if upper - lower >= 2 * np.pi or first <= upper:
                angles.append(extreme)
        values = a + b * np.cos(angles) + c * np.sin(angles)
        nearest, farthest = np.sqrt(np.maximum([values.min(), values.max()], 0.0))
        return float(nearest), float(farthest)

    def _straight_length(self, targets: TargetBatch) -> float:
        """Return the length of the stretched arm, an upper bound of the distance [m]."""
        poses = link_poses(self.robot.root, self.robot.joints, {})
        points = [self.shoulder, *(poses[joint.child][:3, 3] for joint in self.between)]
        points.append((self._palm_pose({}) @ np.append(self.wrist, 1.0))[:3])
        length = sum(np.linalg.norm(b - a) for a, b in pairwise(points))
        for joint in self.between:
            if joint.type == "prismatic":
                length += np.abs(self._joint_range(joint, targets)).max()
        return float(length)

    def _joint_range(self, joint: Joint, targets: TargetBatch) -> tuple[float, float]:
        """Return the range of a joint: the intersection of joint limits and motor limits."""
        lower, upper = -np.inf, np.inf
        if targets.enforce_limits:
            lower, upper = joint.lower - LIMIT_MARGIN, joint.upper + LIMIT_MARGIN
        if joint.name in self.robot.actuator_names:
            i = self.robot.actuator_index(joint.name)
            limits = motor_limits(self.robot, targets)
            lower = max(lower, limits[0][i] - LIMIT_MARGIN)
            upper = min(upper, limits[1][i] + LIMIT_MARGIN)
        return float(lower), float(upper)

    def _palm_pose(self, values: dict[str, Array]) -> Array:
        robot = self.robot
        return link_poses(robot.root, robot.joints, values)[robot.palm_link] @ robot.palm_placement


def arm_span(robot: RobotDescription) -> ArmSpan | None:
    """Return shoulder and wrist of the arm; None for a hand whose palm does not move."""
    joints = tuple(joint for joint in robot.chain(robot.palm_link) if joint.type != "fixed")
    if not joints:
        return None
    poses = link_poses(robot.root, robot.joints, {})
    lines = [(poses[j.child][:3, 3], poses[j.child][:3, :3] @ j.axis) for j in joints]
    shoulder, first = _common_point(joints, lines)
    wrist, last = _common_point(joints[::-1], lines[::-1])
    first, last = min(first, len(joints)), max(len(joints) - last, 0)
    palm = poses[robot.palm_link] @ robot.palm_placement
    p_palm_wrist = palm[:3, :3].T @ (wrist - palm[:3, 3])
    return ArmSpan(shoulder, p_palm_wrist, joints[first : max(last, first)], robot)


def _common_point(joints: tuple[Joint, ...], lines: list[tuple[Array, Array]]) -> tuple[Array, int]:
    """Return a common point of the first axes and their number; 0 if the first is prismatic."""
    point = lines[0][0]
    if joints[0].type != "revolute":
        return point, 0
    if len(lines) > 1 and joints[1].type == "revolute":
        (p, a), (q, b) = lines[0], lines[1]
        common_normal = np.cross(a, b)
        if np.linalg.norm(common_normal) > AXIS_TOLERANCE:
            # The point of the first axis that is nearest to the second.
            t = np.dot(np.cross(q - p, b), common_normal) / (common_normal @ common_normal)
            point = p + t * a
    count = 0
    for joint, (origin, axis) in zip(joints, lines, strict=True):
        if (
            joint.type != "revolute"
            or np.linalg.norm(np.cross(point - origin, axis)) > AXIS_TOLERANCE
        ):
            break
        count += 1
    return point, count


def palms_in_span(arm: ArmSpan | None, targets: TargetBatch) -> NDArray[np.bool_] | None:
    """Return whether palm poses put the wrist within the span of the arm, up to tolerances.

    Args:
        arm: Shoulder and wrist of the arm; None if there is no arm.
        targets: k targets with palm poses, of one arm.

    Returns:
        (k,) True where the wrist is within the span; None without an arm or palm poses.
    """
    if arm is None or targets.palms is None:
        return None
    if not len(targets):
        return np.zeros(0, dtype=bool)
    fixed = targets.fixed
    first_target = targets if fixed is None or fixed.ndim == 1 else replace(targets, fixed=fixed[0])
    nearest, farthest = arm.span(first_target)
    tolerance = targets.largest_tolerance
    wrist_displacement = 2 * np.sin(min(tolerance.angle, np.pi) / 2) * np.linalg.norm(arm.wrist)
    margin = (1 + TOLERANCE_SLACK) * (tolerance.position + wrist_displacement) + AXIS_TOLERANCE
    p_base_wrist = targets.palms[:, :3, :3] @ arm.wrist + targets.palms[:, :3, 3]
    distance = np.linalg.norm(p_base_wrist - arm.shoulder, axis=1)
    return (distance >= nearest - margin) & (distance <= farthest + margin)


@dataclass(frozen=True, eq=False)
class ArmCones:
    """Cones of the upper arm and the forearm of a seven-joint arm.

    In an arm with spherical shoulder, elbow and spherical wrist the angle between the upper arm
    and axis 1 depends on joint 2 only, and the angle between axis 7 and the forearm on joint 6
    only.

    Attributes:
        robot: Description of the robot.
        shoulder: (3,) proximal end of the upper arm [m], base frame.
        wrist: (3,) distal end of the forearm [m], palm frame.
        first: (3,) unit vector, base frame; its angle to the upper arm is joint 2 plus the offset.
        last: (3,) unit vector, palm frame; its angle to the forearm is joint 6 plus the offset.
        lengths: Lengths of upper arm and forearm [m].
        offsets: Offsets of joints 2 and 6 [rad].
    """

    robot: RobotDescription
    shoulder: Array
    wrist: Array
    first: Array
    last: Array
    lengths: tuple[float, float]
    offsets: tuple[float, float]

    def cosines(self, targets: TargetBatch) -> Array:
        """Return the cosines (2,) of the half angles; `NO_CONE_LIMIT` without a limit."""
        lower, upper = motor_limits(self.robot, targets)
        cosines = []
        for joint, offset in zip((1, 5), self.offsets, strict=True):
            i = self.robot.arm_actuators[joint]
            bounds = lower[i] - LIMIT_MARGIN + offset, upper[i] + LIMIT_MARGIN + offset
            largest_angle = max(abs(end) for end in bounds)
            cosines.append(float(np.cos(largest_angle)) if largest_angle < np.pi else NO_CONE_LIMIT)
        return np.array(cosines)


def arm_cones(robot: RobotDescription) -> ArmCones | None:
    """Return the cones of a robot with such an arm, else None."""
    arm = srs_arm(robot)
    if arm is None:
        return None

    def third_axis(joints: SphericalJoints) -> Array:
        return joints.frame @ [np.sin(joints.offset), 0.0, np.cos(joints.offset)]

    upper, fore = (float(np.linalg.norm(link)) for link in (arm.upper_arm, arm.forearm))
    # Axis 3 is parallel or antiparallel to the upper arm, and axis 5 to the forearm.
    upper_sign = np.sign(third_axis(arm.shoulder_joints) @ arm.upper_arm)
    forearm_sign = np.sign(arm.wrist_joints.frame[:, 2] @ arm.forearm)
    return ArmCones(
        robot=robot,
        shoulder=arm.shoulder,
        wrist=arm.wrist_in_palm,
        first=upper_sign * arm.shoulder_joints.frame[:, 2],
        last=forearm_sign * (arm.screws.rotation.T @ third_axis(arm.wrist_joints)),
        lengths=(upper, fore),
        offsets=(arm.shoulder_joints.offset, arm.wrist_joints.offset),
    )
