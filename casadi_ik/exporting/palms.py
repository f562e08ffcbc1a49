"""Palms that are given with the hand's posture, as targets of an exported solver."""

from __future__ import annotations

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.exporting.single import filled
from casadi_ik.kernels.codegen import define_arrays, number
from casadi_ik.problem.questions import BEYOND, touched

MARKS = ("PALM_CALLS", "PALM", "PALM_WASM", "PALM_JS", "PALM_DTS")


def palm_marks(robot: ArmHand, prefix: str) -> dict[str, str]:
    """What stands for the marks of palms; nothing without an arm, or if contacts leave it free."""
    motors = robot.description.finger_motors
    own = np.where(np.isin(robot.actuators, motors), robot.home, np.nan)
    home = robot.palm(robot.home)
    if not robot.description.arm_actuators or touched(robot, home[None], own[None])[2]:
        return dict.fromkeys(MARKS, "")
    pose = np.concatenate([home[:3, :3].ravel(), home[:3, 3]])
    constants = f"#define POSTURE_ROUNDING {number(BEYOND)}\n" + define_arrays(
        {"HOME_PALM": pose, "OF_HAND": np.isin(robot.actuators, motors).astype(int)}
    )
    marks = {"PREFIX": prefix, "GUARD": prefix.upper()}
    return {
        "PALM_CALLS": filled("palm.h", marks),
        "PALM": "\n" + constants + filled("palm.c", marks),
        "PALM_WASM": filled("palm_wasm.c", marks),
        "PALM_JS": filled("palm.js", marks),
        "PALM_DTS": filled("palm.d.ts", marks),
    }
