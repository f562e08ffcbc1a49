"""Bounds of the contacts of a hand in boxes of motor positions, in numpy.

The independent check of proofs (`proofs.check`) uses these bounds instead of those of the prover.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from casadi_ik.files.arrays import Array, Bools, Rows
from casadi_ik.kinematics.couplings import joint_bounds
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.linkage import link_poses


@dataclass(frozen=True, eq=False)
class ContactBalls:
    """Bounds of the contacts of f fingers in k boxes.

    Attributes:
        points: (k, f, 3) contact points at the centres of the boxes [m]; palm frame, or base frame
            if the palm does not move.
        normals: (k, f, 3) unit normals, in the same frame.
        radius: (k, f) largest distance of the contact from `points` [m].
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
    in_palm: bool,
) -> ContactBalls:
    """Return bounds of the contacts in boxes of motor positions.

    Args:
        robot: Description of the robot.
        motors: Names of the motors of the hand.
        box: Lower and upper bounds of the motors (k, h).
        limits: Lower and upper limits of the finger joints (m,).
        fingers: Indices of the fingers.
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
    for column, i in enumerate(fingers):
        finger = robot.fingers[i]
        pad = np.broadcast_to(poses[finger.link] @ finger.placement, (count, 4, 4))
        point, normal = pad[:, :3, 3], pad[:, :3, :3] @ finger.normal
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
