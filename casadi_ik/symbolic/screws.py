"""Forward kinematics by unit dual quaternions: the product of exponentials of Chandra et al. 2019.

Section II-A, eqs. (1) to (7). Every joint is a screw about a line that is fixed in the base frame
at the reference pose, all joints at zero; the pose of the end is

    x_e = delta_1 delta_2 ... delta_n x_e0,   delta_j = exp(theta_j / 2  s_j0).

The numbers are those of `casadi_ik.symbolic.kinematics`, which multiplies frames instead. The
coupled joints of eq. (12) come in by the chain rule, as everywhere: the Jacobian over q is
`Screws.jacobian` times the couplings' own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic.kinematics import Pose, forward, number
from casadi_ik.symbolic.smooth import Expr


@dataclass(frozen=True, eq=False)
class Screw:
    """A joint's axis at the reference pose, in the base frame.

    Attributes:
        direction: (3,) unit direction l.
        moment: (3,) moment m = p x l [m], p any point of the axis.
        revolute: Whether it turns about the axis, else it slides along it.
    """

    direction: Array
    moment: Array
    revolute: bool

    def displacement(self, theta: Expr) -> Expr:
        """Unit dual quaternion (8, 1) of moving by theta [rad or m]: delta_j of eq. (3)."""
        angle, distance = (theta, 0.0) if self.revolute else (0.0, theta)
        return dq.exp_screw(angle, distance, ca.DM(self.direction), ca.DM(self.moment))


@dataclass(frozen=True, eq=False)
class ScrewChain:
    """The joints from the base to one frame.

    Attributes:
        joints: Names of the movable joints, from the base on.
        screws: Their screws at the reference pose.
        reference: (8,) unit dual quaternion x_e0 of the frame at the reference pose.
    """

    joints: tuple[str, ...]
    screws: tuple[Screw, ...]
    reference: Array

    def at(self, theta: Expr) -> Screws:
        """The chain with its joints at theta (len(joints), 1) [rad or m]."""
        return Screws(self, theta)


@dataclass(frozen=True, eq=False)
class Screws:
    """A chain at a configuration.

    Attributes:
        chain: The chain.
        theta: (len(chain.joints), 1) joint positions [rad or m].
    """

    chain: ScrewChain
    theta: Expr

    @cached_property
    def displacements(self) -> list[Expr]:
        """The products delta_1 ... delta_j for j = 0 (nothing moved), 1, ..., n: eq. (7)."""
        products = [dq.identity()]
        for i, screw in enumerate(self.chain.screws):
            products.append(dq.multiply(products[-1], screw.displacement(self.theta[i])))
        return products

    @property
    def pose(self) -> Expr:
        """Unit dual quaternion (8, 1) of the frame in the base frame: eq. (3)."""
        return dq.multiply(self.displacements[-1], ca.DM(self.chain.reference))

    @property
    def axes(self) -> list[tuple[Expr, Expr]]:
        """Direction (3, 1) and moment (3, 1) [m] of every joint's axis now: eq. (6)."""
        return [
            dq.act_on_line(moved, ca.DM(screw.direction), ca.DM(screw.moment))
            for moved, screw in zip(self.displacements, self.chain.screws, strict=False)
        ]

    @property
    def jacobian(self) -> Expr:
        """Screw Jacobian (6, n): eq. (5), written as twists [v; w] per joint unit.

        v is the velocity of the point of the end's body that is instantly at the base's origin,
        as in eq. (4); a point p of the body moves with v + w x p.
        """
        columns = [
            ca.vertcat(moment, direction) if screw.revolute else ca.vertcat(direction, 0, 0, 0)
            for screw, (direction, moment) in zip(self.chain.screws, self.axes, strict=True)
        ]
        return ca.densify(ca.horzcat(ca.DM.zeros(6, 0), *columns))


def screw_chain_to_link(robot: RobotDescription, link: str) -> ScrewChain:
    """The chain to a link's frame.

    Raises:
        UnknownNameError: There is no such link.
    """
    return _chain(robot, link, np.eye(4))


def screw_chain_to_contact(robot: RobotDescription, finger: str) -> ScrewChain:
    """The chain to a finger's contact frame.

    Raises:
        UnknownNameError: There is no such finger.
    """
    entry = robot.finger(finger)
    return _chain(robot, entry.link, entry.placement)


def _chain(robot: RobotDescription, link: str, placement: Array) -> ScrewChain:
    reference = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    joints = [joint for joint in robot.chain(link) if joint.type != "fixed"]
    end = reference.links[link].at(placement)
    return ScrewChain(
        joints=tuple(joint.name for joint in joints),
        screws=tuple(
            _screw(joint, reference.links[joint.child], reference.axes[joint.name])
            for joint in joints
        ),
        reference=number(dq.from_pose(end.rotation, end.origin)),
    )


def _screw(joint: Joint, frame: Pose, axis: ca.SX) -> Screw:
    direction = number(axis)
    moment = np.cross(number(frame.origin), direction)
    return Screw(direction, moment, joint.type == "revolute")
