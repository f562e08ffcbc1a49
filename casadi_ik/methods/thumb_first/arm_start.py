"""The arm in closed form that a start of the thumb-first method begins with."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.methods.common.arm_choice import Wanted, choose_arm
from casadi_ik.methods.common.arm_placement import place_arm
from casadi_ik.methods.common.form_search import choose_form, place_form
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_arms.recognise import ArmForm
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.srs_arm import SrsArm

TINY = 1e-9
"""Smallest range [rad] a motion is measured by."""


def arm_start(robot: RobotDescription, arm: ArmForm) -> ca.Function:
    """The arm farthest from its limits, or the one nearest to where the robot is.

    The steps that follow move it anyway: the first arms looked at are close enough.

    Returns:
        ``(nearest, rotation, origin, here, lower, upper) -> arm``, (n, 1) each but the palm's pose
        and whether it is to be the nearest.
    """
    # A pose is of either kind of symbols, which its annotations do not say.
    rotation: Any = ca.MX.sym("rotation", 3, 3)
    origin: Any = ca.MX.sym("origin", 3)
    columns = list(robot.arm_actuators)
    here, lower, upper = (ca.MX.sym(name, len(columns)) for name in ("here", "lower", "upper"))
    inputs, palm = [rotation, origin, here, lower, upper], Pose(rotation, origin)
    ranges = np.maximum((robot.upper - robot.lower)[columns], TINY)
    wanted = Wanted(here, lower, upper, ca.DM((1 / ranges).tolist()))
    first = ca.MX(0)
    if isinstance(arm, SrsArm):
        near, *_ = choose_arm(arm, palm, wanted, first, first, ca.MX(1))
        far, *_ = place_arm(arm, palm, lower, upper, first)
    else:
        near, *_ = choose_form(arm, palm, wanted, first, first)
        far, *_ = place_form(arm, palm, lower, upper, first, first, first)
    return ca.Function.if_else(
        "arm_start", ca.Function("near", inputs, [near]), ca.Function("far", inputs, [far])
    )
