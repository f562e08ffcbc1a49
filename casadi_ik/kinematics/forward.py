"""Kinematics as graphs: poses and Jacobians over the joints theta, and over the motors q."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.kinematics.se3 import angular_velocity_to_euler_zyx, euler_zyx
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint

MAX_ROUNDING_ERROR = 1e-15
"""Threshold below which constants of a description are rounding errors, treated as zero."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A frame in the base frame: ``rotation`` (3, 3), columns its axes; ``origin`` (3, 1) [m]."""

    rotation: ca.SX
    origin: ca.SX

    def compose(self, placement: Array) -> Pose:
        """Return the frame with the constant pose `placement` (4, 4) relative to this frame."""
        rotation, origin = _constants(placement)
        return Pose(self.rotation @ rotation, self.origin + self.rotation @ origin)

    def rotate(self, vector: Array) -> ca.SX:
        """Return a constant (3,) direction of this frame in the base frame, (3, 1)."""
        return self.rotation @ sparse(np.asarray(vector, dtype=float).reshape(3, 1))

    def inverse_apply(self, point: ca.SX) -> ca.SX:
        """Return a point of the base frame in this frame, (3, 1) [m]."""
        return self.rotation.T @ (point - self.origin)


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Poses of links, joint axes and contacts as functions of theta.

    Attributes:
        robot: Description of the robot.
        theta: (m, 1) positions of the movable joints, in the order of `robot.joint_names`.
        links: Pose of every link.
        axes: Axis direction (3, 1) of each movable joint in the base frame.
    """

    robot: RobotDescription
    theta: ca.SX
    links: dict[str, Pose]
    axes: dict[str, ca.SX]

    @property
    def palm(self) -> Pose:
        """Pose of the palm frame."""
        return self.links[self.robot.palm_link].compose(self.robot.palm_placement)

    def contact_frame(self, finger: str) -> Pose:
        """Return the pose of a finger's contact frame."""
        entry = self.robot.finger(finger)
        return self.links[entry.link].compose(entry.placement)

    def contact(self, finger: str) -> tuple[ca.SX, ca.SX]:
        """Return a finger's contact point (3, 1) [m] and outward pad normal (3, 1), base frame."""
        frame = self.contact_frame(finger)
        return frame.origin, frame.rotate(self.robot.finger(finger).normal)

    def tangent(self, finger: str) -> ca.SX:
        """Return the unit tangent (3, 1) of the pad of a finger, base frame."""
        return self.contact_frame(finger).rotate(self.robot.finger(finger).tangent)

    def twist_columns(self, joints: Sequence[str], link: str, point: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the geometric Jacobian of a point fixed to a link with respect to some joints.

        Args:
            joints: Names of movable joints; a joint that does not carry the link gets zeros.
            link: The link.
            point: (3, 1) the point in the base frame [m].

        Returns:
            linear (3, len(joints)) [m per joint unit] and angular (3, len(joints)).
        """
        carrying = {joint.name: joint for joint in self.robot.chain(link)}
        linear, angular = [ca.SX.zeros(3, 0)], [ca.SX.zeros(3, 0)]  # the shape without joints
        for name in joints:
            joint = carrying.get(name)
            if joint is None:
                linear.append(ca.SX.zeros(3, 1))
                angular.append(ca.SX.zeros(3, 1))
            elif joint.type == "revolute":
                axis = self.axes[name]
                linear.append(ca.cross(axis, point - self.links[joint.child].origin))
                angular.append(axis)
            else:
                linear.append(self.axes[name])
                angular.append(ca.SX.zeros(3, 1))
        return ca.horzcat(*linear), ca.horzcat(*angular)


def forward(robot: RobotDescription, theta: ca.SX) -> Kinematics:
    """Return all link poses as functions of theta.

    Args:
        robot: Description of the robot.
        theta: (m, 1) positions of the movable joints [rad or m].

    Returns:
        Poses and axes in the base frame.
    """
    index = {name: i for i, name in enumerate(robot.joint_names)}
    links = {robot.root: Pose(ca.SX.eye(3), ca.SX.zeros(3, 1))}
    axes: dict[str, ca.SX] = {}
    for joint in robot.joints:
        frame = links[joint.parent].compose(joint.placement)
        if joint.type != "fixed":
            axes[joint.name] = frame.rotate(joint.axis)
            frame = _displaced_frame(frame, joint, theta[index[joint.name]])
        links[joint.child] = frame
    return Kinematics(robot, theta, links, axes)


def _displaced_frame(frame: Pose, joint: Joint, value: ca.SX) -> Pose:
    """Return the frame after the motion of a joint by a value [rad or m]."""
    if joint.type == "prismatic":
        return Pose(frame.rotation, frame.origin + frame.rotate(joint.axis) * value)
    return Pose(frame.rotation @ axis_rotation(joint.axis, value), frame.origin)


def axis_rotation(axis: Array, angle: ca.SX) -> ca.SX:
    """Return the rotation (3, 3) about a constant unit axis, exploiting zeros of the axis."""
    a = np.asarray(axis, dtype=float)
    outer = np.outer(a, a)
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    c, s = ca.cos(angle), ca.sin(angle)
    # The sum of constant, cosine and sine terms keeps exact zeros and ones.
    return ca.SX(sparse(outer)) + ca.SX(sparse(np.eye(3) - outer)) * c + ca.SX(sparse(cross)) * s


def number(value: ca.SX) -> Array:
    """Return the entries of a constant graph, row by row (rows * columns,)."""
    return np.array(ca.evalf(ca.densify(value))).ravel()


def _constants(placement: Array) -> tuple[ca.DM, ca.DM]:
    return sparse(placement[:3, :3]), sparse(placement[:3, 3:])


def sparse(array: Array) -> ca.DM:
    """Return a constant with structural zeros in place of entries below rounding errors."""
    exact = np.where(np.abs(array) < MAX_ROUNDING_ERROR, 0.0, array)
    # Cosines of quarter turns have rounding errors, e.g. 1 - 1e-16.
    integers = np.round(exact)
    exact = np.where(np.abs(exact - integers) < MAX_ROUNDING_ERROR, integers, exact)
    return ca.sparsify(ca.DM(exact))


@dataclass(frozen=True, eq=False)
class ActuatedKinematics:
    """Forward kinematics as a function of q, and Jacobians with respect to q.

    Attributes:
        robot: Description of the robot.
        q: (n, 1) actuator positions.
        kinematics: Poses and axes at theta = c(q).
    """

    robot: RobotDescription
    q: ca.SX
    kinematics: Kinematics

    @cached_property
    def coupling(self) -> ca.SX:
        """(m, n) Jacobian of theta = c(q), structurally sparse."""
        # Differentiate with respect to new symbols, because q may be an expression.
        symbols = ca.SX.sym("q", len(self.robot.actuators))
        jacobian = ca.jacobian(joint_positions(self.robot, symbols), symbols)
        return ca.Function("coupling", [symbols], [jacobian])(self.q)

    def twist(self, link: str, point: ca.SX, actuators: Sequence[int]) -> tuple[ca.SX, ca.SX]:
        """Return the geometric Jacobian of a point fixed to a link.

        Args:
            link: The link.
            point: (3, 1) the point in the base frame [m].
            actuators: Positions in q of the columns wanted.

        Returns:
            linear (3, k) [m per unit of q] and angular (3, k) [rad per unit of q], base frame.
        """
        joints = [joint.name for joint in self.robot.chain(link) if joint.type != "fixed"]
        rows = [self.robot.joint_names.index(name) for name in joints]
        linear, angular = self.kinematics.twist_columns(joints, link, point)
        chain_rule = self.coupling[rows, list(actuators)]
        return ca.densify(linear @ chain_rule), ca.densify(angular @ chain_rule)

    def contact_jacobian(self, finger: str, actuators: Sequence[int]) -> tuple[ca.SX, ca.SX]:
        """Return the geometric Jacobian of a finger's contact frame, as `twist`."""
        point, _ = self.kinematics.contact(finger)
        return self.twist(self.robot.finger(finger).link, point, actuators)

    def palm_jacobian(self, actuators: Sequence[int]) -> tuple[ca.SX, ca.SX]:
        """Return the geometric Jacobian of the palm frame, as `twist`."""
        return self.twist(self.robot.palm_link, self.kinematics.palm.origin, actuators)

    def palm_euler_jacobian(self, actuators: Sequence[int]) -> ca.SX:
        """Return analytic Jacobian (3, k) of the palm's ZYX Euler angles; rates per unit of q."""
        _, angular = self.palm_jacobian(actuators)
        angles = euler_zyx(self.kinematics.palm.rotation)
        return angular_velocity_to_euler_zyx(angles) @ angular


def motor_scales(robot: RobotDescription) -> ca.DM:
    """Return the unit of each motor (n, 1): 1 rad, or the range of a slider."""
    ranges = (robot.upper - robot.lower).tolist()
    units = [actuator.unit for actuator in robot.actuators]
    return ca.DM([1.0 if u == "rad" else r for u, r in zip(units, ranges, strict=True)])


def actuated(robot: RobotDescription, q: ca.SX) -> ActuatedKinematics:
    """Return the kinematics as a function of the motor positions.

    Args:
        robot: Description of the robot.
        q: (n, 1) actuator positions [rad or m].
    """
    return ActuatedKinematics(robot, q, forward(robot, joint_positions(robot, q)))
