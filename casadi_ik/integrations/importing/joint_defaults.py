"""Limits and fixed positions that are assumed for joints of a robot file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_ik.model.joints import joints_below, moving_below
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

ASSUMED_LIMITS = {"revolute": (-math.pi, math.pi), "prismatic": (-0.5, 0.5)}
"""Limits by type of joint if the file states none [rad or m]."""

SPINNER_REASON = "continuous joint, not treated as a finger"

UNUSED_JOINT_REASON = "moves no palm"


def joints_to_palm(tree: RobotTree, palm: str) -> list[TreeJoint]:
    """Return the joints from the root to a palm and all joints below the palm."""
    return [*joints_to_link(tree, palm), *joints_below(tree, palm)]


def joints_to_link(tree: RobotTree, link: str) -> list[TreeJoint]:
    """Return the joints from the root to a link."""
    return list(tree.chain(tree.root, link, str(tree.path)))


def assumed_limits(joints: Sequence[TreeJoint]) -> dict[str, tuple[float, float]]:
    """Return limits for the joints whose file states none."""
    return {
        joint.name: ASSUMED_LIMITS[joint.type]
        for joint in joints
        if joint.type in ASSUMED_LIMITS and joint.limits is None and joint.coupling is None
    }


def locked_multi_axis_joints(joints: Sequence[TreeJoint]) -> dict[str, float]:
    """Return the position zero for each joint with several axes."""
    single_axis = ("fixed", "revolute", "continuous", "prismatic")
    return {joint.name: 0.0 for joint in joints if joint.type not in single_axis}


def locked_unused_joints(tree: RobotTree, used_joints: Sequence[TreeJoint]) -> dict[str, float]:
    """Return positions of the joints that are not used, such as legs and head: zero if possible."""
    names = {joint.name for joint in used_joints}
    return {
        joint.name: float(np.clip(0.0, *(joint.limits or (0.0, 0.0))))
        for joint in tree.joints
        if joint.name not in names and joint.type != "fixed" and joint.coupling is None
    }


def locked_spinners(tree: RobotTree, palm: str) -> dict[str, float]:
    """Return the position zero for continuous joints below a palm, such as propellers.

    Only joints that move no other joint are fixed, and only if another chain may be a finger.
    """
    first_joints = moving_below(tree, palm)
    leaders = {joint.coupling.of for joint in tree.joints if joint.coupling is not None}
    spinners = [
        joint
        for joint in first_joints
        if joint.type == "continuous"
        and not joint.coupling
        and not moving_below(tree, joint.child)
        and joint.name not in leaders
    ]
    return {joint.name: 0.0 for joint in spinners} if len(spinners) < len(first_joints) else {}
