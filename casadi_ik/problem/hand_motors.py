"""The motors of a hand, and everything that a problem lets them do."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.verdict import LIMIT_SLACK
from casadi_ik.robots.description import Joint, RobotDescription

OUTWARDS = 2 * LIMIT_SLACK
"""Limits are taken so much wider [rad or m], since the verdict allows half of it."""

ENDLESS = 1e9
"""Stands for a motor without ends whose motion does not repeat [rad or m]."""

TURNS = 12
"""Joints that turn by fractions of a motor's turn are followed over so many turns at most."""

EXACT = 1e-12
"""How near to a whole number a ratio has to be."""


def hand_motors(robot: RobotDescription) -> tuple[str, ...]:
    """The actuators that move a finger relative to the palm, in the order of q."""
    used = {i for name in robot.finger_names for i in robot.finger_actuators(name)}
    return tuple(robot.actuator_names[i] for i in sorted(used))


def finger_joints(robot: RobotDescription) -> tuple[str, ...]:
    """All movable joints of the fingers, in the order of `robot.joint_names`."""
    used = {name for finger in robot.fingers for name in finger.joints}
    return tuple(name for name in robot.joint_names if name in used)


def motor_ends(robot: RobotDescription, problems: Problems) -> tuple[Array, Array]:
    """(n,) lower and upper ends of all motors, as the verdict has them: each by itself.

    `RobotDescription.lower` leaves out what is of no use to a method; a proof must not.
    """
    lower, upper = robot.strokes if problems.enforce_limits else robot.mechanical
    if problems.fixed is None:
        return lower, upper
    free = np.isnan(problems.fixed)
    return np.where(free, lower, problems.fixed), np.where(free, upper, problems.fixed)


def motor_box(robot: RobotDescription, problems: Problems) -> Array:
    """(2, h) lower and upper ends of the motors of the hand.

    Limits where they are enforced; where they are ignored what the mechanisms can do, and else all
    turns until everything repeats. A motor whose motion never repeats is `ENDLESS`.
    """
    names = hand_motors(robot)
    lower, upper = motor_ends(robot, problems)
    columns = [robot.actuator_index(name) for name in names]
    ends = np.stack([lower[columns] - OUTWARDS, upper[columns] + OUTWARDS])
    for i in np.flatnonzero(np.isinf(ends).any(axis=0)):
        ends[:, i] = np.array([-1.0, 1.0]) * _half_period(robot, names[i])
    return ends


def joint_limits(robot: RobotDescription, problems: Problems) -> tuple[Array, Array]:
    """(m,) lower and upper limits of `finger_joints`; infinite where limits are ignored."""
    rows = [robot.joint_names.index(name) for name in finger_joints(robot)]
    if not problems.enforce_limits:
        return np.full(len(rows), -np.inf), np.full(len(rows), np.inf)
    return robot.joint_lower[rows] - OUTWARDS, robot.joint_upper[rows] + OUTWARDS


def endless_fingers(robot: RobotDescription, box: Array) -> list[bool]:
    """By finger whether one of its motors has no ends, so that nothing bounds it."""
    endless = {
        name
        for name, far in zip(hand_motors(robot), np.abs(box).max(axis=0), strict=True)
        if far >= ENDLESS
    }
    names = robot.actuator_names
    return [
        any(names[i] in endless for i in robot.finger_actuators(finger))
        for finger in robot.finger_names
    ]


def _half_period(robot: RobotDescription, motor: str) -> float:
    """Half of what a motor without limits turns until everything repeats [rad]."""
    by_name = {joint.name: joint for joint in robot.movable}
    ratios = []
    for name in finger_joints(robot):
        ratio = _rate(by_name, name, motor)
        if ratio is None:
            continue
        if by_name[name].type == "prismatic":
            return ENDLESS
        ratios.append(ratio)
    for turns in range(1, TURNS + 1):
        if all(abs(ratio * turns - round(ratio * turns)) <= EXACT for ratio in ratios):
            return np.pi * turns
    return ENDLESS


def _rate(by_name: dict[str, Joint], name: str, motor: str) -> float | None:
    """Turns of a joint for each turn of a motor, 1 beyond a mechanism; None if it does not follow.

    A mechanism repeats with each turn of what drives it, whatever it makes of it.
    """
    ratio = 1.0
    while True:
        if name == motor:
            return ratio
        joint = by_name.get(name)
        if joint is None or joint.coupling is None:
            return None
        coupling = joint.coupling
        slope = coupling.slope
        ratio = 1.0 if slope is None else ratio * slope[0]
        name = coupling.of
