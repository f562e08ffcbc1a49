"""How fast motors may move, and how fast they may become so."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError

CROSSING = 1.0
"""Seconds in which a motor whose velocity limit nobody states crosses its range."""

RUN_UP = 0.25
"""Seconds in which a motor comes from rest to its velocity limit, if no acceleration is given."""

UNBOUNDED = 1e6
"""What stands for no limit of a step, in ranges of the motor."""


@dataclass(frozen=True, eq=False)
class Rates:
    """Limits of the motors' motion.

    Attributes:
        velocity: (n,) [rad/s or m/s].
        acceleration: (n,) [rad/s^2 or m/s^2].
    """

    velocity: Array
    acceleration: Array

    def steps(self, period: float) -> tuple[Array, Array]:
        """Longest step of a cycle and by how much it may differ from the last, (n,) each."""
        return self.velocity * period, self.acceleration * period**2


def own_velocities(robot: ArmHand) -> Array:
    """(n,) velocity limits of the description; a range in `CROSSING` where it has none."""
    stated = np.array([actuator.velocity for actuator in robot.description.actuators])
    ranges = robot.upper - robot.lower
    return np.where(np.isfinite(stated), stated, ranges / CROSSING)


def rates_of(robot: ArmHand, velocity: Any, acceleration: Any) -> Rates:
    """The limits that are asked for.

    Args:
        robot: The robot.
        velocity: (n,) or a number; None: the description's.
        acceleration: (n,) or a number; None: the velocity limit within `RUN_UP`.

    Raises:
        InputError: Other than positive numbers.
    """
    fastest = own_velocities(robot) if velocity is None else each(robot, "velocity", velocity)
    if acceleration is None:
        return Rates(fastest, fastest / RUN_UP)
    return Rates(fastest, each(robot, "acceleration", acceleration))


def shares(q: Array, period: float, rates: Rates) -> tuple[float, float]:
    """The largest parts of the limits that samples take, at rest before and after.

    Args:
        q: (m, n) where the motors are, one period after the other.
        period: [s].
        rates: The limits.

    Returns:
        Of the velocity, by first differences; of the acceleration, by second differences.
    """
    velocity, acceleration = differences(q, period)
    return (
        float((np.abs(velocity) / rates.velocity).max(initial=0.0)),
        float((np.abs(acceleration) / rates.acceleration).max(initial=0.0)),
    )


def differences(q: Array, period: float) -> tuple[Array, Array]:
    """First (m - 1, n) and second (m, n) differences of samples over time.

    Before the first sample and after the last the motors move mirrored: the velocity there is zero,
    and the second difference twice the step over the time squared.
    """
    steps = np.diff(q, axis=0)
    if not len(steps):
        return steps, np.zeros_like(q)
    around = np.concatenate([-steps[:1], steps, -steps[-1:]])
    return steps / period, np.diff(around, axis=0) / period**2


def each(robot: ArmHand, name: str, value: Any) -> Array:
    """One positive number per motor.

    Raises:
        InputError: Something else.
    """
    n = len(robot.actuators)
    try:
        array = np.array(np.broadcast_to(np.asarray(value, dtype=float), (n,)))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}: found {value!r}, expected a number > 0, or {n} of them"
        ) from error
    if not (np.isfinite(array).all() and (array > 0).all()):
        raise InputError(f"{name}: found {value!r}, expected a number > 0, or {n} of them")
    return array


def seconds(name: str, value: Any) -> float:
    """A positive number of seconds.

    Raises:
        InputError: Something else.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 < number < math.inf:
        raise InputError(f"{name}: found {value!r}, expected a number of seconds > 0")
    return number


def length(name: str, value: Any) -> float:
    """A number of metres >= 0.

    Raises:
        InputError: Something else.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 <= number < math.inf:
        raise InputError(f"{name}: found {value!r}, expected a number of metres >= 0")
    return number


def a_direction(name: str, value: Any) -> Array:
    """(3,) a direction.

    Raises:
        InputError: Something else.
    """
    try:
        way = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        way = np.zeros(0)
    if way.shape != (3,) or not np.isfinite(way).all() or not way.any():
        raise InputError(f"{name}: found {value!r}, expected three numbers, not all zero")
    return way


def unbounded(robot: ArmHand) -> Rates:
    """No limits, for cycles of one second."""
    anything = UNBOUNDED * np.maximum(robot.upper - robot.lower, 1.0)
    return Rates(anything, anything)
