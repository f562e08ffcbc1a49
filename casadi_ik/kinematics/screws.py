"""Kinematics by unit dual quaternions: the product of exponentials of Chandra et al. 2019.

Section II-A, eqs. (1) to (7). Every joint is a screw about a line that is fixed in the base frame
at the reference pose, in which all joint positions are zero. The pose of the end of a chain is

    x_e = delta_1 delta_2 ... delta_n x_e0,   delta_j = exp(theta_j / 2  s_j0).

It agrees with `casadi_ik.kinematics.forward`, which multiplies frames instead.

Jacobians of a fingertip with respect to joints and sliders follow eqs. (10), (12) and (15). The
pose of a tip is expressed relative to the robot's base or to another fingertip, and is a product of
screws and a reference pose, eq. (3). Relative to another tip, the chain leads from that tip back to
the palm and from there to the finger; joints on the way back move with inverted sign, eq. (16).

Coupled joints have no columns: their screws, multiplied by the rate of the coupling, are added to
the column of the joint that drives them. The joint-space Jacobian therefore has a column per
driving joint (eqs. 12 and 15), and the same graph yields a column per actuator (slider space).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.couplings import coupling_rate, joint_positions
from casadi_ik.kinematics.forward import Pose, forward, number
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint


@dataclass(frozen=True, eq=False)
class Screw:
    """Axis of a joint at the reference pose, in the base frame.

    Attributes:
        direction: (3,) unit direction l.
        moment: (3,) moment m = p x l [m] for any point p of the axis.
        revolute: True for a rotation about the axis, False for a translation along it.
    """

    direction: Array
    moment: Array
    revolute: bool

    def displacement(self, theta: Expr) -> Expr:
        """Return the displacement delta_j (8, 1) of eq. (3) for theta [rad or m]."""
        angle, distance = (theta, 0.0) if self.revolute else (0.0, theta)
        return dq.exp_screw(angle, distance, ca.DM(self.direction), ca.DM(self.moment))


@dataclass(frozen=True, eq=False)
class ScrewChain:
    """Joints from the base to a frame.

    Attributes:
        joints: Names of the movable joints, starting at the base.
        screws: Screws of the joints at the reference pose.
        reference: (8,) unit dual quaternion x_e0 of the frame at the reference pose.
    """

    joints: tuple[str, ...]
    screws: tuple[Screw, ...]
    reference: Array

    def evaluate(self, theta: Expr) -> ChainScrews:
        """Return the chain with its joints at theta (len(joints), 1) [rad or m]."""
        return ChainScrews(self, theta)


@dataclass(frozen=True, eq=False)
class ChainScrews:
    """A chain at a configuration.

    Attributes:
        chain: The chain.
        theta: (len(chain.joints), 1) joint positions [rad or m].
    """

    chain: ScrewChain
    theta: Expr

    @cached_property
    def displacements(self) -> list[Expr]:
        """Products delta_1 ... delta_j for j = 0 (the identity), 1, ..., n: eq. (7)."""
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
        """Current direction (3, 1) and moment (3, 1) [m] of each joint axis: eq. (6)."""
        return [
            dq.act_on_line(displacement, ca.DM(screw.direction), ca.DM(screw.moment))
            for displacement, screw in zip(self.displacements, self.chain.screws, strict=False)
        ]

    @property
    def jacobian(self) -> Expr:
        """Screw Jacobian (6, n) of eq. (5) with twists [v; w] per joint unit.

        As in eq. (4), v is the velocity of the point of the last link that is instantaneously at
        the origin of the base; a point p of the link has the velocity v + w x p.
        """
        columns = [
            ca.vertcat(moment, direction) if screw.revolute else ca.vertcat(direction, 0, 0, 0)
            for screw, (direction, moment) in zip(self.chain.screws, self.axes, strict=True)
        ]
        return ca.densify(ca.horzcat(ca.DM.zeros(6, 0), *columns))


def screw_chain_to_contact(robot: RobotDescription, finger: str) -> ScrewChain:
    """Return the chain to a finger's contact frame.

    Raises:
        UnknownNameError: The finger does not exist.
    """
    entry = robot.finger(finger)
    return _chain(robot, entry.link, entry.placement)


def _chain(robot: RobotDescription, link: str, placement: Array) -> ScrewChain:
    reference = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    joints = [joint for joint in robot.chain(link) if joint.type != "fixed"]
    end = reference.links[link].compose(placement)
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


@dataclass(frozen=True, eq=False)
class TipChain:
    """Joints between a reference frame and a fingertip.

    Attributes:
        robot: Description of the robot.
        chain: Screws in the reference frame, and the reference pose of the tip.
        signs: Sign of each joint of the chain, eq. (16): -1 on the way back to the palm, else +1.
    """

    robot: RobotDescription
    chain: ScrewChain
    signs: tuple[int, ...]

    def evaluate(self, q: Expr) -> TipMotion:
        """Return the chain with the actuators at q (n, 1) [rad or m]."""
        return TipMotion(self, q)

    @cached_property
    def drivers(self) -> tuple[str, ...]:
        """Joints without a coupling, in the order of the chain."""
        return tuple(dict.fromkeys(self.driver(name) for name in self.chain.joints))

    @cached_property
    def actuators(self) -> tuple[int, ...]:
        """Indices in q of the actuators that move the tip, in order."""
        return tuple(
            sorted({self.robot.actuator_index(self.source(name)) for name in self.drivers})
        )

    def driver(self, name: str) -> str:
        """Return the joint that drives a joint through its couplings; the joint if uncoupled."""
        joint = self.joint(name)
        while joint.coupling is not None and joint.coupling.of in self.robot.joint_names:
            joint = self.joint(joint.coupling.of)
        return joint.name

    def source(self, driver: str) -> str:
        """Return the actuator that moves a driving joint."""
        coupling = self.joint(driver).coupling
        return driver if coupling is None else coupling.of

    def joint(self, name: str) -> Joint:
        """Return a movable joint by name."""
        return self.robot.movable[self.robot.joint_names.index(name)]


@dataclass(frozen=True, eq=False)
class TipMotion:
    """A tip at a configuration; twists are [v; w] in the reference frame.

    Attributes:
        tip: Chain of the tip.
        q: (n, 1) actuator positions [rad or m].
    """

    tip: TipChain
    q: Expr

    @cached_property
    def joints(self) -> dict[str, Expr]:
        """Position of every movable joint of the robot [rad or m]."""
        robot = self.tip.robot
        theta = joint_positions(robot, self.q)
        return {name: theta[i] for i, name in enumerate(robot.joint_names)}

    @cached_property
    def screws(self) -> ChainScrews:
        """Screws of the chain at this configuration: eqs. (3), (5) to (7)."""
        pairs = zip(self.tip.signs, self.tip.chain.joints, strict=True)
        return self.tip.chain.evaluate(
            ca.vertcat(*(sign * self.joints[name] for sign, name in pairs))
        )

    @property
    def pose(self) -> Expr:
        """Unit dual quaternion (8, 1) of the tip: eq. (3)."""
        return self.screws.pose

    @cached_property
    def joint_jacobian(self) -> Expr:
        """Twist (6, d) per unit rate of the driving joints, eq. (12); relative to a tip, eq. (15).

        Column i belongs to `tip.drivers[i]`. For the index finger of the AR10 it is
        [s_1, s_2 + f s_3]; from its tip to that of the thumb [s_i2 + f s_i3, s_i1, s_t1, s_t2].
        Eq. (15) of the paper omits s_i1, which its eq. (16) requires. The rate of a driving joint
        on the way back is the negative rate of the joint: see `displacement`.
        """
        tip, columns = self.tip, dict.fromkeys(self.tip.drivers, ca.DM.zeros(6, 1))
        for i, name in enumerate(tip.chain.joints):
            driver = tip.driver(name)
            scale = tip.signs[i] * self._sign(driver) * self._rate(name)
            columns[driver] = columns[driver] + scale * self.screws.jacobian[:, i]
        return ca.densify(ca.horzcat(*columns.values()))

    def displacement(self, rates: Expr) -> Expr:
        """Return the joint displacements (d, 1) that `joint_jacobian` multiplies: eq. (16).

        Args:
            rates: (d, 1) displacements of the driving joints [rad or m].
        """
        return ca.vertcat(*(self._sign(name) for name in self.tip.drivers)) * rates

    @cached_property
    def jacobian(self) -> Expr:
        """Twist (6, k) per unit rate of `tip.actuators`; for the AR10, in slider space."""
        tip = self.tip
        drive = ca.SX.zeros(len(tip.drivers), len(tip.actuators))
        for row, driver in enumerate(tip.drivers):
            index = tip.robot.actuator_index(tip.source(driver))
            rate = coupling_rate(tip.joint(driver), self.q[index])
            drive[row, tip.actuators.index(index)] = self._sign(driver) * rate
        return ca.densify(self.joint_jacobian @ drive)

    def _rate(self, name: str) -> Expr:
        """Return the rate of a joint per unit of its driving joint, through its couplings."""
        joint, rate = self.tip.joint(name), ca.DM(1)
        while joint.coupling is not None and joint.coupling.of in self.joints:
            rate = rate * coupling_rate(joint, self.joints[joint.coupling.of])
            joint = self.tip.joint(joint.coupling.of)
        return rate

    def _sign(self, driver: str) -> int:
        """Return the sign of a driving joint in the chain; 1 for a joint outside the chain."""
        joints = self.tip.chain.joints
        return self.tip.signs[joints.index(driver)] if driver in joints else 1


def finger_chain(robot: RobotDescription, finger: str) -> TipChain:
    """Return the contact frame of a finger relative to the base: the chain of eq. (12).

    Raises:
        UnknownNameError: A finger does not exist.
    """
    chain = screw_chain_to_contact(robot, finger)
    return TipChain(robot, chain, (1,) * len(chain.joints))


def relative_chain(robot: RobotDescription, reference: str, finger: str) -> TipChain:
    """Return the chain between the contact frames of two fingers: eqs. (15) and (16).

    Joints that carry both fingers, such as those of an arm, do not move them relative to each other
    and are omitted.

    Args:
        robot: Description of the robot.
        reference: Finger whose contact frame is the reference frame.
        finger: Finger at the end of the chain.

    Raises:
        UnknownNameError: A finger does not exist.
        InputError: Both fingers are the same.
    """
    if reference == finger:
        raise InputError(f"relative chain: found {finger!r} twice, expected two fingers")
    back, forth = (screw_chain_to_contact(robot, name) for name in (reference, finger))
    shared = sum(a == b for a, b in zip(back.joints, forth.joints, strict=False))
    base_in_reference = dq.conjugate(ca.DM(back.reference))

    def in_reference(screw: Screw) -> Screw:
        direction, moment = dq.act_on_line(
            base_in_reference, ca.DM(screw.direction), ca.DM(screw.moment)
        )
        return Screw(number(direction), number(moment), screw.revolute)

    screws = (*reversed(back.screws[shared:]), *forth.screws[shared:])
    chain = ScrewChain(
        joints=(*reversed(back.joints[shared:]), *forth.joints[shared:]),
        screws=tuple(in_reference(screw) for screw in screws),
        reference=number(dq.multiply(base_in_reference, ca.DM(forth.reference))),
    )
    signs = (-1,) * len(back.joints[shared:]) + (1,) * len(forth.joints[shared:])
    return TipChain(robot, chain, signs)
