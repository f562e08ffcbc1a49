"""How far seven-joint arms can bend shoulder and wrist away from straight: cones about axes.

Of an arm with a spherical shoulder, an elbow and a spherical wrist joint 2 is the angle of the
upper arm to axis 1, and joint 6 that of axis 7 to the forearm, whatever the other joints do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.problem.hand_motors import OUTWARDS, motor_ends
from casadi_ik.problem.problems import Problems
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.srs_arm import Spherical, srs_arm

UPPER, WRIST = 1, 5
"""Numbers of the joints that open the two cones."""

NONE = -2.0
"""The cosine of a cone that excludes nothing."""


@dataclass(frozen=True, eq=False)
class ArmCones:
    """The two cones.

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

    def cosines(self, problems: Problems) -> Array:
        """(2,) of the half angles of the cones, `NONE` where all directions are inside."""
        lower, upper = motor_ends(self.robot, problems)
        found = []
        for joint, offset in zip((UPPER, WRIST), self.offsets, strict=True):
            i = self.robot.arm_actuators[joint]
            ends = lower[i] - OUTWARDS + offset, upper[i] + OUTWARDS + offset
            most = max(abs(end) for end in ends)
            found.append(float(np.cos(most)) if most < np.pi else NONE)
        return np.array(found)


def arm_cones(robot: RobotDescription) -> ArmCones | None:
    """The cones of an arm of that kind, else None."""
    try:
        arm = srs_arm(robot)
    except UnsupportedError:
        return None

    def third(joints: Spherical) -> Array:
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
        last=ahead * (arm.palm_rotation.T @ third(arm.wrist_joints)),
        lengths=(upper, fore),
        offsets=(arm.shoulder_joints.offset, arm.wrist_joints.offset),
    )
