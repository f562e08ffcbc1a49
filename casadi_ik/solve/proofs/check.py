"""Independent check that a target is impossible.

The check shares the premises (`proofs.premises`) with the prover, but none of its bounds: it proves
the target impossible in numpy, with simpler bounds of the contacts (`contact_balls`) and finer
boxes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import combinations

import numpy as np

from casadi_ik.files.arrays import Array, Bools, Rows
from casadi_ik.kinematics.arms.recognise import srs_arm
from casadi_ik.kinematics.couplings import joint_bounds
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import link_poses
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.proofs.premises import (
    LIMIT_MARGIN,
    NO_CONE_LIMIT,
    ArmCones,
    arm_cones,
    arm_span,
    fingers_without_limits,
    joint_limits,
    motor_box,
    motor_limits,
    required_points,
)


@dataclass(frozen=True, eq=False)
class ContactBalls:
    """Bounds of the contacts of f fingers in k boxes.

    Attributes:
        points: (k, f, 3) points that must reach the target, at the centres of the boxes [m]; palm
            frame, or base frame if the palm does not move.
        normals: (k, f, 3) unit normals, in the same frame.
        radius: (k, f) largest distance of these points from `points` [m].
        angle: (k, f) largest angle of the contact normal to `normals` [rad].
        point_shares: (k, f, h) contribution of each motor to the radius [m].
        normal_shares: (k, f, h) contribution of each motor to the angle [rad].
        point_slopes: (k, f, m, 3) derivative of the point by each joint times the half width of
            the joint [m].
        normal_slopes: (k, f, m, 3) derivative of the normal by each joint times its half width.
        point_remainder: (k, f) remainder of the linearisation of the point [m].
        normal_remainder: (k, f) remainder of the linearisation of the normal.
        is_empty: (k,) True for boxes without a posture within the joint limits.
    """

    points: Array
    normals: Array
    radius: Array
    angle: Array
    point_shares: Array
    normal_shares: Array
    point_slopes: Array
    normal_slopes: Array
    point_remainder: Array
    normal_remainder: Array
    is_empty: Bools

    def rows(self, rows: Rows) -> ContactBalls:
        """Return the bounds of the boxes with these indices."""
        return ContactBalls(*(getattr(self, item.name)[rows] for item in fields(self)))

    @property
    def effect(self) -> Array:
        """Largest motion of a contact due to each motor, (k, h); 0.1 m count as one radian."""
        return (self.point_shares / 0.1 + self.normal_shares).max(axis=1)


def contact_balls(
    robot: RobotDescription,
    motors: Sequence[str],
    box: tuple[Array, Array],
    limits: tuple[Array, Array],
    fingers: Sequence[int],
    depths: Sequence[float],
    in_palm: bool,
) -> ContactBalls:
    """Return bounds of the contacts in boxes of motor positions.

    Args:
        robot: Description of the robot.
        motors: Names of the motors of the hand.
        box: Lower and upper bounds of the motors (k, h).
        limits: Lower and upper limits of the finger joints (m,).
        fingers: Indices of the fingers.
        depths: Depths of the required points below the pads [m], see `required_points`.
        in_palm: True for contacts in the palm frame, False for the base frame.
    """
    count = len(box[0])
    intervals, is_empty = {}, np.zeros(count, dtype=bool)
    names = robot.finger_joints
    finger_joints = {name for i in fingers for name in robot.fingers[i].joints}
    joint_names = [name for name in names if name in finger_joints]
    for name, (low, high) in joint_bounds(robot, motors, *box, joint_names).items():
        i = names.index(name)
        low, high = np.maximum(low, limits[0][i]), np.minimum(high, limits[1][i])
        is_empty |= low > high
        intervals[name] = (low + high) / 2, np.maximum(high - low, 0.0) / 2 + 1e-12
    links = [robot.palm_link, *(robot.fingers[i].link for i in fingers)]
    chained = {joint.name for link in links for joint in robot.chain(link)}
    chain = [joint for joint in robot.joints if joint.name in chained]
    middles = {name: middle for name, (middle, _) in intervals.items()}
    poses = link_poses(robot.root, chain, middles)
    joints_by_name = {joint.name: joint for joint in robot.movable}
    points, normals, radius, angle, point_remainder, normal_remainder = [], [], [], [], [], []
    slopes_of_joints = np.zeros((2, count, len(fingers), len(joint_names), 3))
    shares = np.zeros((2, count, len(fingers), len(motors)))
    for column, (i, depth) in enumerate(zip(fingers, depths, strict=True)):
        finger = robot.fingers[i]
        pad = np.broadcast_to(poses[finger.link] @ finger.placement, (count, 4, 4))
        normal = pad[:, :3, :3] @ finger.normal
        point = pad[:, :3, 3] - depth * normal
        displacement, rotation, remainder = np.zeros(count), np.zeros(count), np.zeros(count)
        inner_width = sum((intervals[name][1] for name in finger.joints), np.zeros(count))
        for name in reversed(finger.joints):
            joint, half_width = joints_by_name[name], intervals[name][1]
            frame = poses[joint.child]
            sine = np.sin(np.minimum(half_width, np.pi) / 2)
            axis, origin = frame[..., :3, :3] @ joint.axis, frame[..., :3, 3]
            if joint.type == "prismatic":
                point_slope, normal_slope, lever = axis, np.zeros((count, 3)), np.ones(count)
                point_share, normal_share = half_width, np.zeros(count)
            else:
                point_slope, normal_slope = np.cross(axis, point - origin), np.cross(axis, normal)
                lever = np.linalg.norm(point_slope, axis=1) + displacement
                point_share, normal_share = 2 * sine * lever, half_width
            # The norm of a second derivative by two joints is at most the lever arm of the distal
            # joint.
            inner_width = inner_width - half_width
            remainder = remainder + lever * half_width * (half_width / 2 + inner_width)
            m = joint_names.index(name)
            slopes_of_joints[0, :, column, m] = point_slope * half_width[:, None]
            slopes_of_joints[1, :, column, m] = normal_slope * half_width[:, None]
            displacement, rotation = displacement + point_share, rotation + normal_share
            (driver,) = robot.driving_actuators([name])
            k = list(motors).index(robot.actuator_names[driver])
            shares[0, :, column, k] += point_share
            shares[1, :, column, k] += normal_share
        if in_palm:
            palm = poses[robot.palm_link] @ robot.palm_placement
            R_base_palm = palm[:3, :3]
            point = (point - palm[:3, 3]) @ R_base_palm
            normal = normal @ R_base_palm
            slopes_of_joints[:, :, column] = slopes_of_joints[:, :, column] @ R_base_palm
        points.append(point)
        normals.append(normal)
        radius.append(displacement)
        angle.append(rotation)
        point_remainder.append(remainder)
        normal_remainder.append(rotation * rotation / 2)
    arrays = points, normals, radius, angle
    stacked = (np.stack(array, axis=1) for array in arrays)
    return ContactBalls(
        *stacked,
        point_shares=shares[0],
        normal_shares=shares[1],
        point_slopes=slopes_of_joints[0],
        normal_slopes=slopes_of_joints[1],
        point_remainder=np.stack(point_remainder, axis=1),
        normal_remainder=np.stack(normal_remainder, axis=1),
        is_empty=is_empty,
    )


def wrist_distances(
    balls: ContactBalls,
    target_contacts: tuple[Array, Array],
    margins: tuple[Array, Array],
    p_base_shoulder: Array,
    p_palm_wrist: Array,
) -> tuple[Array, Array]:
    """Return the smallest and largest distance (k,) from the shoulder to the wrist [m].

    The shoulder is a linear combination of the target contacts; in the palm frame it is the same
    combination of the contacts of the hand. In that frame the wrist is constant and the direction
    of every slope is known.

    Args:
        balls: Contacts of k boxes, palm frame.
        target_contacts: Target points and normals (f, 3), normals NaN where free.
        margins: Tolerances of the points (f,) [m], and of the normals as chords (f,).
        p_base_shoulder: (3,) shoulder, base frame [m].
        p_palm_wrist: (3,) wrist, palm frame [m].
    """
    points, normals = target_contacts
    has_normal = ~np.isnan(normals[:, 0])
    radius = balls.radius + margins[0]
    chord = 2 * np.sin(np.minimum(balls.angle, np.pi) / 2) + margins[1]
    targets = np.concatenate([points[1:] - points[0], normals[has_normal]])
    widths = np.concatenate([radius[:, 1:] + radius[:, :1], chord[:, has_normal]], axis=1)
    A, offset = targets / widths[:, :, None], p_base_shoulder - points[0]
    normal = np.einsum("kfi,kfj->kij", A, A)
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3)
    solved = np.linalg.solve(normal, np.tile(offset, (len(A), 1))[:, :, None])[:, :, 0]
    coefficients = np.einsum("kfi,ki->kf", A, solved) / widths
    n = len(points) - 1
    point_coefficients = np.concatenate(
        [1 - coefficients[:, :n].sum(axis=1, keepdims=True), coefficients[:, :n]], axis=1
    )
    normal_coefficients = np.zeros_like(point_coefficients)
    normal_coefficients[:, has_normal] = coefficients[:, n:]
    centre = np.einsum("kf,kfi->ki", point_coefficients, balls.points) + np.einsum(
        "kf,kfi->ki", normal_coefficients, balls.normals
    )
    point_slopes = np.einsum("kf,kfmi->kmi", point_coefficients, balls.point_slopes) + np.einsum(
        "kf,kfmi->kmi", normal_coefficients, balls.normal_slopes
    )
    margin = np.linalg.norm(offset - coefficients @ targets, axis=1)
    margin += (
        np.abs(point_coefficients) * (balls.point_remainder + margins[0])
        + np.abs(normal_coefficients) * (balls.normal_remainder + margins[1])
    ).sum(axis=1)
    shoulder_to_wrist = centre - p_palm_wrist
    length = np.linalg.norm(shoulder_to_wrist, axis=1)
    direction = shoulder_to_wrist / np.maximum(length, 1e-300)[:, None]
    parallel = np.einsum("kmi,ki->km", point_slopes, direction)
    perpendicular = np.linalg.norm(
        point_slopes - parallel[:, :, None] * direction[:, None], axis=2
    ).sum(axis=1)
    parallel_motion = np.abs(parallel).sum(axis=1)
    return length - parallel_motion - margin, np.hypot(
        length + parallel_motion, perpendicular
    ) + margin


CHECK_MARGIN = 1e-8
"""Margin against rounding errors [m, rad], ten times that of the prover."""


@dataclass(frozen=True)
class CheckEffort:
    """Limits of the check of a proof; a proof that exceeds them is not confirmed.

    Attributes:
        max_boxes: Maximum number of boxes.
        boxes_per_pass: Number of boxes evaluated together.
        elbow_samples: Number of samples of the swivel angle of the elbow.
        min_box_effect: Smallest motion of a contact within a box that is divided [0.1 m, rad].
    """

    max_boxes: int = 400_000
    boxes_per_pass: int = 512
    elbow_samples: int = 180
    min_box_effect: float = 1e-5


class Refutation:
    """Bisection of the box of hand postures until every part is refuted."""

    def __init__(
        self, robot: RobotDescription, target: TargetBatch, fingers: list[int], uses_arm: bool
    ) -> None:
        """Prepare the check of one target.

        Args:
            robot: Description of the robot.
            target: Target with the tolerances of the proof.
            fingers: Indices of the fingers whose contacts are contradictory.
            uses_arm: True to refute boxes by the reach of the arm too.
        """
        self.robot, self.target, self.fingers, self.uses_arm = robot, target, fingers, uses_arm
        self.motors = robot.finger_motors
        self.effort = CheckEffort()
        self.in_palm = any(j.type != "fixed" for j in robot.chain(robot.palm_link))
        self.limits = joint_limits(robot, target)
        points, depths = required_points(robot, target)
        self.points, self.normals = points[0, fingers], target.normals[0, fingers]
        self.depths = depths[0, fingers].tolist()
        self.position_margin = target.position_tolerance[fingers] + CHECK_MARGIN
        self.angle_margin = target.angle_tolerance[fingers] + CHECK_MARGIN

    def succeeds(self) -> bool:
        """Return True if every box is refuted within the effort of a check."""
        bounds = motor_box(self.robot, self.target)
        is_unbounded = fingers_without_limits(self.robot, bounds)
        if any(is_unbounded[i] for i in self.fingers):
            return False
        queue, count = [bounds[None]], 0
        while queue:
            boxes = queue.pop()
            count += len(boxes)
            if count > self.effort.max_boxes:
                return False
            balls = contact_balls(
                self.robot,
                self.motors,
                (boxes[:, 0], boxes[:, 1]),
                self.limits,
                self.fingers,
                self.depths,
                self.in_palm,
            )
            refuted, scores = self._check(balls)
            open_rows = np.flatnonzero(~(balls.is_empty | refuted))
            boxes, scores = boxes[open_rows], scores[open_rows]
            widest = scores.argmax(axis=1)
            if (
                balls.effect[open_rows][np.arange(len(open_rows)), widest]
                < self.effort.min_box_effect
            ).any():
                return False
            halves, size = bisect(boxes, widest), self.effort.boxes_per_pass
            queue += [halves[i : i + size] for i in range(0, len(halves), size)]
        return True

    def _check(self, balls: ContactBalls) -> tuple[Bools, Array]:
        """Return (k,) True for refuted boxes, and the effect of each motor (k, h)."""
        radius, angle = balls.radius + self.position_margin, balls.angle + self.angle_margin
        if not self.in_palm:
            too_far = np.linalg.norm(self.points - balls.points, axis=2) > radius
            too_rotated = angle_of(self.normals, balls.normals) > angle
            return (too_far | too_rotated).any(axis=1), balls.effect
        refuted, scores = self._check_pairs(balls, radius, angle)
        refuted[~refuted] = self._check_rigid_fit(balls, radius, angle, ~refuted)
        if self.uses_arm:
            refuted |= self._check_reach(balls, radius)
            rows = np.flatnonzero(~refuted)
            refuted[rows] = self._check_cones(balls.rows(rows), radius[rows])
        return refuted, scores

    def _check_pairs(self, balls: ContactBalls, radius: Array, angle: Array) -> tuple[Bools, Array]:
        """Return (k,) True for boxes without admissible distances and angles of pairs of contacts.

        The second result has the scores of the motors (k, h), which are highest for motors that
        affect nearly violated conditions; boxes are divided along them.
        """
        refuted, scores = np.zeros(len(radius), dtype=bool), 0.1 * balls.effect
        for i, j in combinations(range(len(self.fingers)), 2):
            target, line = self.points[j] - self.points[i], balls.points[:, j] - balls.points[:, i]
            radii = radius[:, i] + radius[:, j]
            target_distance, distance = np.linalg.norm(target), np.linalg.norm(line, axis=1)
            point_shares = balls.point_shares[:, i] + balls.point_shares[:, j]
            tests = [
                (
                    np.abs(distance - target_distance) - CHECK_MARGIN * target_distance,
                    radii,
                    point_shares,
                )
            ]
            target_angle = angle_of(self.normals[i], self.normals[j])
            hand_angle = angle_of(balls.normals[:, i], balls.normals[:, j])
            normal_shares = balls.normal_shares[:, i] + balls.normal_shares[:, j]
            tests.append(
                (np.abs(hand_angle - target_angle), angle[:, i] + angle[:, j], normal_shares)
            )
            # The line between the points rotates by at most asin(radii / target_distance).
            with np.errstate(divide="ignore", invalid="ignore"):
                line_rotation = np.arcsin(np.clip(radii / target_distance, 0.0, 1.0))
                line_rotation[radii >= target_distance] = np.pi
                for n in (i, j):
                    deviation = np.abs(
                        angle_of(balls.normals[:, n], line) - angle_of(self.normals[n], target)
                    )
                    shares = balls.normal_shares[:, n] + point_shares / target_distance
                    tests.append((deviation, angle[:, n] + line_rotation, shares))
                for deviation, width, shares in tests:
                    ratio = np.nan_to_num(deviation / width)
                    refuted |= ratio > 1
                    scores += np.nan_to_num(ratio[:, None] ** 4 * shares / width[:, None])
        return refuted, scores

    def _check_rigid_fit(
        self, balls: ContactBalls, radius: Array, angle: Array, rows: Bools
    ) -> Bools:
        """Return (k,) True for boxes without a rigid fit (Kabsch) within the bounds."""
        w = 1 / radius[rows] ** 2
        chord = 2 * np.sin(np.minimum(angle[rows], np.pi) / 2)
        has_normal = ~np.isnan(self.normals[:, 0])
        v = has_normal / chord**2
        target_normals = np.nan_to_num(self.normals)
        total = w.sum(axis=1, keepdims=True)
        x = balls.points[rows] - ((w[:, :, None] * balls.points[rows]).sum(axis=1) / total)[:, None]
        y = self.points - ((w[:, :, None] * self.points).sum(axis=1) / total)[:, None]
        S = np.einsum("kf,kfi,kfj->kij", w, x, y)
        S += np.einsum("kf,kfi,fj->kij", v, balls.normals[rows], target_normals)
        singular_values = np.linalg.svd(S, compute_uv=False)
        trace = (
            singular_values[:, 0]
            + singular_values[:, 1]
            + np.sign(np.linalg.det(S)) * singular_values[:, 2]
        )
        size = (w * ((x**2).sum(axis=2) + (y**2).sum(axis=2)) + 2 * v).sum(axis=1)
        allowed = len(self.fingers) + has_normal.sum()
        return size * (1 - 1e-9) - 2 * trace > allowed

    def _check_reach(self, balls: ContactBalls, radius: Array) -> Bools:
        """Return (k,) True for boxes whose wrist is out of the reach of the arm."""
        shoulder, wrist, nearest, farthest = self._arm
        target_distance = np.linalg.norm(self.points - shoulder, axis=1)
        wrist_distance = np.linalg.norm(wrist - balls.points, axis=2)
        is_refuted = (target_distance - wrist_distance - radius > farthest) | (
            wrist_distance - radius - target_distance > farthest
        )
        is_refuted |= target_distance + wrist_distance + radius < nearest
        centre, margin = self._palm_ball(balls, radius, wrist, 1)
        distance = np.linalg.norm(centre - shoulder, axis=1)
        is_refuted = (
            is_refuted.any(axis=1) | (distance - margin > farthest) | (distance + margin < nearest)
        )
        position_margin = (
            self.position_margin + CHECK_MARGIN,
            2 * np.sin(np.minimum(self.angle_margin, np.pi) / 2) + CHECK_MARGIN,
        )
        smallest, largest = wrist_distances(
            balls, (self.points, self.normals), position_margin, shoulder, wrist
        )
        return is_refuted | (smallest > farthest) | (largest < nearest)

    def _palm_ball(
        self, balls: ContactBalls, radius: Array, p_palm: Array, sum_of_points: int
    ) -> tuple[Array, Array]:
        """Return centres (k, 3) and radii (k,) of balls that contain a vector of the palm.

        The vector is a weighted sum of contacts and normals: a point if `sum_of_points` is 1, and
        a direction if it is 0.
        """
        has_normal = ~np.isnan(self.normals[:, 0])
        chord = 2 * np.sin(np.minimum(balls.angle + self.angle_margin, np.pi) / 2)
        first_point, first_target = balls.points[:, :1], self.points[0]
        # The vector is the first contact plus a combination of differences of contacts and normals.
        columns = np.concatenate(
            [balls.points[:, 1:] - first_point, balls.normals[:, has_normal]], axis=1
        )
        targets = np.concatenate([self.points[1:] - first_target, self.normals[has_normal]])
        position_margin = np.concatenate(
            [radius[:, 1:] + radius[:, :1], chord[:, has_normal]], axis=1
        )
        A = columns / position_margin[:, :, None]
        normal = np.einsum("kfi,kfj->kij", A, A)
        normal += (1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3)
        offset = p_palm - sum_of_points * first_point[:, 0]
        solved = np.linalg.solve(normal, offset[:, :, None])[:, :, 0]
        coefficients = np.einsum("kfi,ki->kf", A, solved) / position_margin
        unexplained = offset - np.einsum("kf,kfi->ki", coefficients, columns)
        n = len(self.fingers) - 1
        radius_of_ball = np.linalg.norm(unexplained, axis=1) + CHECK_MARGIN
        radius_of_ball += radius[:, 0] * np.abs(sum_of_points - coefficients[:, :n].sum(axis=1))
        radius_of_ball += (np.abs(coefficients[:, :n]) * radius[:, 1:]).sum(axis=1)
        radius_of_ball += (np.abs(coefficients[:, n:]) * chord[:, has_normal]).sum(axis=1)
        return sum_of_points * first_target + coefficients @ targets, radius_of_ball

    def _check_cones(self, balls: ContactBalls, radius: Array) -> Bools:
        """Return (k,) True for boxes in which every swivel angle violates a limit of the arm."""
        is_refuted = np.zeros(len(radius), dtype=bool)
        if self._cones is None or not len(radius):
            return is_refuted
        cones, (_, _, nearest, farthest) = self._cones, self._arm
        centre, wrist_margin = self._palm_ball(balls, radius, cones.wrist, 1)
        shoulder_to_wrist, length = (
            centre - cones.shoulder,
            np.linalg.norm(centre - cones.shoulder, axis=1),
        )
        rows = np.flatnonzero(wrist_margin < length)
        smallest = np.clip(length - wrist_margin, max(nearest, 1e-6), None)[rows]
        largest = np.maximum(np.clip(length + wrist_margin, None, farthest)[rows], smallest)
        tilt = np.arcsin(wrist_margin[rows] / length[rows]) + CHECK_MARGIN
        direction = shoulder_to_wrist[rows] / length[rows, None]
        axis, position_margin = self._palm_ball(balls.rows(rows), radius[rows], cones.last, 0)
        helper = np.eye(3)[np.abs(direction).argmin(axis=1)]
        x = np.cross(direction, helper)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        y, step = np.cross(direction, x), 2 * np.pi / self.effort.elbow_samples
        is_feasible = np.zeros(len(rows), dtype=bool)
        (upper_angle, upper_margin), (forearm_angle, forearm_margin) = (
            _triangle_angle(a, b, smallest, largest)
            for a, b in (cones.lengths, reversed(cones.lengths))
        )
        cosines = self._cosines
        for swivel in step * np.arange(self.effort.elbow_samples):
            radial = np.cos(swivel) * x + np.sin(swivel) * y
            upper_arm = (
                np.cos(upper_angle)[:, None] * direction + np.sin(upper_angle)[:, None] * radial
            )
            forearm = (
                np.cos(forearm_angle)[:, None] * direction - np.sin(forearm_angle)[:, None] * radial
            )
            # Between two samples a direction rotates by at most half a step.
            a = upper_arm @ cones.first + tilt + upper_margin + step / 2
            b = (forearm * axis).sum(axis=1) + position_margin + tilt + forearm_margin + step / 2
            is_feasible |= (a >= cosines[0]) & (b >= cosines[1])
        is_refuted[rows] = ~is_feasible
        return is_refuted

    @cached_property
    def _cones(self) -> ArmCones | None:
        cones = arm_cones(self.robot)
        return (
            None if cones is None or (cones.cosines(self.target) == NO_CONE_LIMIT).all() else cones
        )

    @cached_property
    def _cosines(self) -> Array:
        assert self._cones is not None
        return self._cones.cosines(self.target)

    @cached_property
    def _arm(self) -> tuple[Array, Array, float, float]:
        """Shoulder, wrist (palm frame), smallest and largest distance between them [m]."""
        arm = srs_arm(self.robot)
        if arm is None:
            span = arm_span(self.robot)
            assert span is not None
            return span.shoulder, span.wrist, *span.span(self.target)
        elbow = self.robot.arm_actuators[3]
        lower, upper = (np.clip(end, -1e3, 1e3) for end in motor_limits(self.robot, self.target))
        distances = arm.reach(lower[elbow] - LIMIT_MARGIN, upper[elbow] + LIMIT_MARGIN)
        nearest, farthest = (float(end) for end in distances)
        return arm.shoulder, arm.wrist_in_palm, nearest - CHECK_MARGIN, farthest + CHECK_MARGIN


def _triangle_angle(a: float, b: float, nearest: Array, farthest: Array) -> tuple[Array, Array]:
    """Return midpoint and half width of the angle between sides a and c in [nearest, farthest]."""
    sides = [nearest, farthest]
    if a > b:
        sides.append(np.clip(np.sqrt(a * a - b * b), nearest, farthest))
    angles = [np.arccos(np.clip((c * c + a * a - b * b) / (2 * a * c), -1, 1)) for c in sides]
    low, high = np.min(angles, axis=0), np.max(angles, axis=0)
    return (low + high) / 2, (high - low) / 2 + CHECK_MARGIN


def bisect(boxes: Array, widest: Rows) -> Array:
    """Bisect boxes (k, 2, h) along one motor each (k,) into (2 k, 2, h)."""
    rows = np.arange(len(boxes))
    middle = boxes.mean(axis=1)[rows, widest]
    low, high = boxes.copy(), boxes.copy()
    low[rows, 1, widest], high[rows, 0, widest] = middle, middle
    return np.concatenate([low, high])


def angle_of(a: Array, b: Array) -> Array:
    """Return the angles between vectors along the last axis [rad]; NaN where one is NaN."""
    a = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    difference, total = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    return 2 * np.arctan2(difference, total)
