"""The arm-hand as the synthesis needs it: contacts and links relative to the palm, and the palm."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Kinematics, Pose, forward
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.load_robot import load_description

ROBOT = "kuka_lwr_barrett"
FRAME_W = "bh_base"  # on the mounting face; the palm surface is 80 mm above it
FINGERS = ("thumb", "finger_2", "finger_3")
DISTAL_LENGTH = 0.050  # [m] distal joint to {T}, along the link (A3)
DRIVEN = {"bh_finger_2_spread": "bh_spread", "bh_finger_3_spread": "bh_spread"}


class ArmHand:
    """KUKA LWR with Barrett hand.

    A posture is (7,): spread, then proximal and distal of thumb, finger_2 and finger_3 [rad]. A
    symmetric posture is (5,): spread, thumb proximal, distal, then those of both other fingers.
    """

    def __init__(self) -> None:
        self.robot: RobotDescription = load_description(ROBOT)
        names = self.robot.actuator_names
        self.arm_names = tuple(n for n in names if n.startswith("lwr_"))
        self.hand_names = tuple(n for n in names if n.startswith("bh_"))

    @cached_property
    def lower(self) -> Array:
        """(7,) lower limits of the posture [rad]."""
        return self.robot.lower[-7:]

    @cached_property
    def upper(self) -> Array:
        """(7,) upper limits of the posture [rad]."""
        return self.robot.upper[-7:]

    def theta(self, arm: ca.SX, posture: ca.SX) -> ca.SX:
        """Joint positions (m, 1) from the actuators; the spread motor drives two joints."""
        values = dict(zip(self.arm_names, ca.vertsplit(arm), strict=True))
        values |= dict(zip(self.hand_names, ca.vertsplit(posture), strict=True))
        return ca.vertcat(*(values[DRIVEN.get(name, name)] for name in self.robot.joint_names))

    def kinematics(self, arm: ca.SX, posture: ca.SX) -> Kinematics:
        """Forward kinematics from the actuators."""
        return forward(self.robot, self.theta(arm, posture))

    def contacts_in_palm(self, posture: ca.SX) -> dict[str, Pose]:
        """Contact frame of each finger in palm frame W: x along it, y the outward pad normal."""
        kin = self.kinematics(ca.SX.zeros(7), posture)
        palm = kin.links[FRAME_W]
        frames = {name: kin.contact_frame(name) for name in FINGERS}
        return {
            name: Pose(palm.rotation.T @ frame.rotation, palm.inverse_apply(frame.origin))
            for name, frame in frames.items()
        }

    @cached_property
    def _numeric(self) -> ca.Function:
        arm, posture = ca.SX.sym("arm", 7), ca.SX.sym("posture", 7)
        kin = self.kinematics(arm, posture)
        contacts = [kin.contact(name) for name in FINGERS]
        points = ca.horzcat(*(point for point, _ in contacts))
        normals = ca.horzcat(*(normal for _, normal in contacts))
        joints = []
        for name in FINGERS:
            knuckle = kin.links[f"bh_{name}_link_2"].origin
            distal = kin.links[f"bh_{name}_link_3"]
            end = distal.origin + distal.rotation[:, 0] * DISTAL_LENGTH
            joints.append(ca.horzcat(knuckle, distal.origin, end))
        arm_links = [kin.links[f"lwr_link_{i}"].origin for i in range(1, 7)]
        outputs = [kin.links[FRAME_W].rotation, kin.links[FRAME_W].origin, points, normals, *joints]
        return ca.Function("arm_hand", [arm, posture], [*outputs, ca.horzcat(*arm_links)])

    def evaluate(self, arm: Array, posture: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Numbers in the base frame.

        Returns:
            The palm's pose (4, 4), contact points (3, 3), normals (3, 3), finger lines
            (3, 3, 3): per finger knuckle, distal joint and tip; the arm's joints (6, 3).
        """
        rotation, origin, points, normals, *remainder = (
            np.array(m) for m in self._numeric(arm, posture)
        )
        palm = np.eye(4)
        palm[:3, :3], palm[:3, 3] = rotation, origin[:, 0]
        lines = np.stack([line.T for line in remainder[:3]])
        return palm, points.T, normals.T, lines, remainder[3].T


def full_posture(symmetric: Array) -> Array:
    """(7,) from (5,): both fingers alike."""
    return np.asarray(symmetric)[[0, 1, 2, 3, 4, 3, 4]]
