"""Whether a robot is the one that a log was written for."""

from __future__ import annotations

import re

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import LogError


def check_robot(robot: ArmHand, urdf: str, where: str) -> None:
    """See to it that a robot is the one a log was written for.

    Args:
        robot: The robot.
        urdf: The robot description attached to the log.
        where: The log, for the message.

    Raises:
        LogError: They differ by more than rounding.
    """
    found, expected = (re.split(r'[\s"]+', text) for text in (robot.urdf(), urdf))
    alike = len(found) == len(expected)
    if not (alike and all(map(_same, found, expected))):
        raise LogError(
            f"{where}: the robot {robot.name!r} is not the one in the log (its URDF differs);"
            " give the description that was solved for (--robot)"
        )


def _same(first: str, second: str) -> bool:
    if first == second:
        return True
    try:
        return bool(np.isclose(float(first), float(second), rtol=1e-9, atol=1e-9))
    except ValueError:
        return False
