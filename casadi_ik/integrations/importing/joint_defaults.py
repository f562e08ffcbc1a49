"""Assumed values of an imported robot: joint limits, fixed joint positions, home configuration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.limbs import is_wheel
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint, joint_positions, joints_below, link_poses, moving_below
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

    The joints are fixed only if another chain may be a finger.
    """
    first_joints = moving_below(tree, palm)
    spinners = [joint for joint in first_joints if is_wheel(tree, joint)]
    return {joint.name: 0.0 for joint in spinners} if len(spinners) < len(first_joints) else {}


HOME_SAMPLES = 300
"""Number of arm postures that are compared for an arm of `FULLY_SAMPLED_JOINTS` or fewer."""

FULLY_SAMPLED_JOINTS = 12
"""Number of joints of an arm up to which all samples are compared."""

JACOBIAN_STEP = 1e-6
"""Step of numerical Jacobians [rad or m]."""

MAX_HOME_OFFSET = np.pi / 2
"""Largest distance of a home position from the middle of the joint range [rad]."""


def guess_home(robot: RobotDescription) -> Array:
    """Return a home configuration (n,): the hand half closed, the arm far from singularities.

    The sides of a multi-arm robot are treated separately, with the trunk at zero.
    """
    middle = (robot.lower + robot.upper) / 2
    if robot.sides:
        home = np.clip(0.0, robot.lower, robot.upper)
        for side, (arm, hand) in zip(robot.sides, robot.side_actuators, strict=True):
            home[sorted((*arm, *hand))] = guess_home(robot.side(side.name))
        return home
    arm = list(robot.arm_actuators)
    if not arm:
        return _rounded(middle, robot)
    chain = robot.chain(robot.palm_link)
    rng = np.random.default_rng(0)
    half_width = np.minimum((robot.upper - robot.lower)[arm] / 4, MAX_HOME_OFFSET)
    best_value, best_q = -1.0, middle
    # The cost of a posture grows with the square of the number of joints.
    samples = int(HOME_SAMPLES * min(1.0, (FULLY_SAMPLED_JOINTS / len(arm)) ** 2))
    for i in range(max(1, samples)):
        q = middle.copy()
        if i:
            q[arm] += half_width * rng.uniform(-1, 1, len(arm))
        value = _smallest_singular_value(robot, chain, q, arm)
        if value > best_value:
            best_value, best_q = value, q
    return _rounded(best_q, robot)


def _smallest_singular_value(
    robot: RobotDescription, chain: tuple[Joint, ...], q: Array, arm: list[int]
) -> float:
    """Return the smallest singular value of the palm Jacobian; 1 m counts as much as 1 rad."""
    pose = _palm_pose(robot, chain, q)
    columns = []
    for i in arm:
        q_step = q.copy()
        q_step[i] += JACOBIAN_STEP
        change = (_palm_pose(robot, chain, q_step) - pose) @ np.linalg.inv(pose) / JACOBIAN_STEP
        columns.append([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(values[: min(6, len(arm))].min())


def _palm_pose(robot: RobotDescription, chain: tuple[Joint, ...], q: Array) -> Array:
    values = joint_positions(robot.joints, dict(zip(robot.actuator_names, q, strict=True)))
    positions = {name: float(value[0]) for name, value in values.items()}
    return link_poses(robot.root, chain, positions)[robot.palm_link]


def _rounded(q: Array, robot: RobotDescription) -> Array:
    """Round to two digits (four for small ranges) where that stays within the limits."""
    rounded = np.where(robot.upper - robot.lower > 0.5, np.round(q, 2), np.round(q, 4))
    is_inside = (rounded > robot.lower) & (rounded < robot.upper)
    return np.where(is_inside, rounded, q)
