"""How fast motors may move, and when a robot is where on a path."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, MissingExtraError

CROSSING = 1.0
"""Seconds in which a motor whose velocity limit nobody states crosses its range."""

RUN_UP = 0.25
"""Seconds in which a motor comes from rest to its velocity limit, if no acceleration is given."""


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


def checked(
    name: str, value: Any, shape: tuple[int, ...], fits: Callable[[Array], Any], expected: str
) -> Array:
    """Finite numbers of a shape that fit.

    Raises:
        InputError: Something else; the message says what was expected.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all() or not np.all(fits(array)):
        raise InputError(f"{name}: found {value!r}, expected {expected}")
    return array


def each(robot: ArmHand, name: str, value: Any) -> Array:
    """One positive number per motor, see `checked`."""
    n = len(robot.actuators)
    shape, expected = () if np.ndim(value) == 0 else (n,), f"a number > 0, or {n} of them"
    found = checked(name, value, shape, lambda array: array > 0, expected)
    return np.array(np.broadcast_to(found, (n,)))


def seconds(name: str, value: Any) -> float:
    """A positive number of seconds, see `checked`."""
    return float(checked(name, value, (), lambda x: x > 0, "a number of seconds > 0"))


def length(name: str, value: Any) -> float:
    """A number of metres >= 0, see `checked`."""
    return float(checked(name, value, (), lambda x: x >= 0, "a number of metres >= 0"))


def a_direction(name: str, value: Any) -> Array:
    """(3,) a direction, see `checked`."""
    return checked(name, value, (3,), np.any, "three numbers, not all zero")


def unbounded(robot: ArmHand) -> Rates:
    """No limits, for cycles of one second."""
    anything = 1e6 * np.maximum(robot.upper - robot.lower, 1.0)
    return Rates(anything, anything)


@dataclass(frozen=True)
class TimingTuning:
    """Numbers of the timing of a path.

    Attributes:
        shortest: A posture is left out that is nearer to the next than this part of the whole way.
        grid: Places of a path at which its speed is found, at least.
        spare: Part of the limits that the speed is found for: between the places it is a little
            higher.
        before: How far before a posture the speed is found, too, as a part of the way from the
            place before.
    """

    shortest: float = 1e-6
    grid: int = 200
    spare: float = 0.99
    before: float = 0.1


def timed(path: Array, rates: Rates, period: float) -> Array:
    """A path from rest to rest, by TOPP-RA (Pham & Pham 2018).

    The curve through the postures is cubic between each two and never leaves what lies between them
    (Fritsch & Carlson 1980), so that it keeps to limits that the postures keep to. Its second
    derivative is a straight line from posture to posture and leaps there: the acceleration limits
    are asked for at both ends of every stretch between the places where the speed is found, and
    these are before, at and between postures. What counts in the end is what is sent: where the
    first and second differences of the samples take more than the limits, the whole is slower.

    Args:
        path: (k, n) postures, passed on a smooth curve.
        rates: The limits.
        period: Time between two samples [s].

    Returns:
        (m, n) where the motors are, one period after the other; both ends are those of the path.

    Raises:
        MissingExtraError: toppra is not installed.
    """
    try:
        import toppra
        from scipy.interpolate import PchipInterpolator
        from toppra import algorithm, constraint
        from toppra.simplepath import SimplePath
    except ImportError as error:
        raise MissingExtraError(
            "timing needs toppra, which is not installed: pip install 'casadi-ik[motion]'"
        ) from error
    tuning = TimingTuning()
    lengths = np.abs(np.diff(path, axis=0)).sum(axis=0)
    if not lengths.max(initial=0.0) > 1e-9:
        return path[:1]
    toppra.setup_logging("ERROR")
    # In units of what it may take and what a motor goes in it at full acceleration: near one.
    takes = max(lengths / rates.velocity) + math.sqrt(max(lengths / rates.acceleration))
    unit = rates.acceleration * takes**2
    ways = np.linalg.norm(np.diff(path / unit, axis=0), axis=1)
    kept = path[np.append(ways > tuning.shortest * ways.sum(), True)] / unit
    ways = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    along = np.append(0.0, np.cumsum(ways))
    along /= along[-1]
    slopes = PchipInterpolator(along, kept).derivative()(along)
    fastest, strongest = (
        tuning.spare * rates.velocity * takes / unit,
        np.full(len(unit), tuning.spare),
    )
    both_ends = constraint.DiscretizationType.Interpolation
    asked = [
        constraint.JointVelocityConstraint(np.stack([-fastest, fastest], axis=1)),
        constraint.JointAccelerationConstraint(
            np.stack([-strongest, strongest], axis=1), discretization_scheme=both_ends
        ),
    ]
    cuts = max(2, math.ceil(tuning.grid / (len(kept) - 1)))
    parts = np.linspace(0.0, 1.0, cuts, endpoint=False)
    way: Any = None
    # The short stretches before postures are sometimes too short for its linear programs.
    for some in (np.append(parts, 1.0 - tuning.before / cuts), parts):
        grid = np.append((along[:-1, None] + np.diff(along)[:, None] * some).ravel(), 1.0)
        way = algorithm.TOPPRA(
            asked,
            SimplePath(along, kept, slopes),
            gridpoints=grid,
            parametrizer="ParametrizeConstAccel",
        ).compute_trajectory()
        if way is not None:
            break
    assert way is not None
    count = math.ceil(takes * way.duration / period)
    while True:
        q = unit * way(np.linspace(0.0, way.duration, count + 1))
        q = np.clip(q, path.min(axis=0), path.max(axis=0))  # of rounding
        q[0], q[-1] = path[0], path[-1]
        velocity, acceleration = shares(q, period, rates)
        over = max(velocity, math.sqrt(acceleration))
        if over <= 1.0:
            return q
        count = max(count + 1, math.ceil(count * over))
