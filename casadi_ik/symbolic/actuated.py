"""The robot seen from its motors: kinematics and Jacobians over the actuated coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.couplings import joint_positions
from casadi_ik.symbolic.kinematics import Kinematics, forward
from casadi_ik.symbolic.so3 import angular_velocity_to_euler_zyx, euler_zyx


@dataclass(frozen=True, eq=False)
class ActuatedKinematics:
    """Forward kinematics as a function of q, and Jacobians with respect to q.

    Attributes:
        robot: The description.
        q: (n, 1) actuator positions.
        kinematics: Poses and axes at theta = c(q).
    """

    robot: RobotDescription
    q: ca.SX
    kinematics: Kinematics

    @cached_property
    def coupling(self) -> ca.SX:
        """(m, n) Jacobian of theta = c(q), structurally sparse."""
        # Over symbols of its own, since q may be an expression here.
        symbols = ca.SX.sym("q", len(self.robot.actuators))
        jacobian = ca.jacobian(joint_positions(self.robot, symbols), symbols)
        return ca.Function("coupling", [symbols], [jacobian])(self.q)

    def twist(self, link: str, point: ca.SX, actuators: Sequence[int]) -> tuple[ca.SX, ca.SX]:
        """Geometric Jacobian of a point fixed to a link.

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
        """Geometric Jacobian of a finger's contact frame, as `twist`."""
        point, _ = self.kinematics.contact(finger)
        return self.twist(self.robot.finger(finger).link, point, actuators)

    def palm_jacobian(self, actuators: Sequence[int]) -> tuple[ca.SX, ca.SX]:
        """Geometric Jacobian of the palm frame, as `twist`."""
        return self.twist(self.robot.palm_link, self.kinematics.palm.origin, actuators)

    def palm_body_jacobian(self, actuators: Sequence[int]) -> ca.SX:
        """Body Jacobian of the palm (6, k): twist [v; w] of the palm expressed in the palm."""
        linear, angular = self.palm_jacobian(actuators)
        rotation = self.kinematics.palm.rotation
        return ca.vertcat(rotation.T @ linear, rotation.T @ angular)

    def palm_euler_jacobian(self, actuators: Sequence[int]) -> ca.SX:
        """Analytic Jacobian (3, k) of the palm's ZYX Euler angles; rates per unit of q."""
        _, angular = self.palm_jacobian(actuators)
        angles = euler_zyx(self.kinematics.palm.rotation)
        return angular_velocity_to_euler_zyx(angles) @ angular


def motor_scales(robot: RobotDescription) -> ca.DM:
    """(n, 1) what counts as a unit of each motor: 1 rad, or the range of a slider."""
    ranges = (robot.upper - robot.lower).tolist()
    units = [actuator.unit for actuator in robot.actuators]
    return ca.DM([1.0 if u == "rad" else r for u, r in zip(units, ranges, strict=True)])


def actuated(robot: RobotDescription, q: ca.SX) -> ActuatedKinematics:
    """Kinematics over the actuated coordinates.

    Args:
        robot: The description.
        q: (n, 1) actuator positions [rad or m].
    """
    return ActuatedKinematics(robot, q, forward(robot, joint_positions(robot, q)))
