"""Hand postures by motor name, converted into arrays of motor positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand

POSTURE_LIMIT_SLACK = 1e-6
"""Limit violation of a posture that is clipped instead of refused [rad or m]."""


def hand_posture(robot: ArmHand, posture: Mapping[str, float], name: str = "posture") -> Array:
    """Return the posture as (n,) motor positions; NaN for motors that move no finger.

    Args:
        robot: The robot.
        posture: Position by actuator [rad or m].
        name: Name of the posture in errors.

    Raises:
        UnknownNameError: An actuator does not exist.
        InputError: A motor is missing or moves no finger, or a position is not a number within
            the limits.
    """
    motors = robot.description.finger_motors
    positions = np.full(len(robot.actuators), np.nan)
    for key, value in posture.items():
        if key not in motors:
            exists = key in robot.actuators
            error = InputError if exists else UnknownNameError
            problem = "moves no finger" if exists else "no such actuator"
            raise error(f"{name}.{key}: {problem}, expected {', '.join(motors)}")
        i = robot.actuators.index(key)
        low, high = robot.lower[i], robot.upper[i]
        is_number = isinstance(value, (int, float, np.integer, np.floating))
        if not (is_number and low - POSTURE_LIMIT_SLACK <= value <= high + POSTURE_LIMIT_SLACK):
            raise InputError(
                f"{name}.{key}: found {value!r}, expected a number from {low:g} to {high:g}"
            )
        positions[i] = min(max(float(value), low), high)
    missing = [key for key in motors if key not in posture]
    if missing:
        raise InputError(f"{name}.{missing[0]}: missing, expected a number for every finger motor")
    return positions


def stack_postures(
    robot: ArmHand, postures: Sequence[Mapping[str, float]], name: str = "posture"
) -> Array:
    """Return k postures that name the same motors as (k, n), see `hand_posture`."""
    motors = robot.description.finger_motors
    columns = [robot.actuators.index(motor) for motor in motors]
    q = np.full((len(postures), len(robot.actuators)), np.nan)
    try:
        rows = [[posture[motor] for motor in motors] for posture in postures]
        values = np.array(rows, float).reshape(len(postures), len(motors))
    except (KeyError, TypeError, ValueError):
        values = np.full((len(postures), len(motors)), np.nan)
    low, high = robot.lower[columns], robot.upper[columns]
    is_within = (values >= low - POSTURE_LIMIT_SLACK) & (values <= high + POSTURE_LIMIT_SLACK)
    is_valid = np.logical_and.reduce(is_within, axis=1)
    q[:, columns] = np.clip(values, low, high)
    for row, posture in enumerate(postures):
        if not is_valid[row] or len(posture) != len(motors):
            q[row] = hand_posture(robot, posture, name.format(row))  # raises a specific error
    return q


def broadcast_postures(
    robot: ArmHand, postures: Mapping[str, ArrayLike] | ArrayLike, count: int
) -> Array:
    """Return k postures as (k, n) motor positions; NaN for motors that move no finger.

    Args:
        robot: The robot.
        postures: Positions (k,), or one for all, by actuator [rad or m]; or configurations (k, n)
            or (n,), from which the finger motors are taken.
        count: Number of postures k.

    Raises:
        UnknownNameError: An actuator does not exist.
        InputError: As for `hand_posture`, or another number of positions; the message names the
            row.
    """
    if not isinstance(postures, Mapping):
        q = robot.configuration(postures, "postures")
        motors = [robot.actuators.index(name) for name in robot.description.finger_motors]
        postures = {robot.actuators[i]: q[..., i] for i in motors}
    columns: dict[str, Array] = {}
    for name, value in postures.items():
        try:
            columns[name] = np.broadcast_to(np.asarray(value, dtype=float), (count,))
        except (TypeError, ValueError) as error:
            raise InputError(f"postures.{name}: expected {count} numbers, or one") from error
    by_row = [
        {name: float(column[row]) for name, column in columns.items()} for row in range(count)
    ]
    return stack_postures(robot, by_row, "postures: row {}")
