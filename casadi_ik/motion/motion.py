"""A motion of the motors in time: how fast they may move, when they are where, and its files."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from casadi_ik.errors import InputError, MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.times import cycle_count
from casadi_ik.files.writing import atomic_write
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.cdr import JOINT_TRAJECTORY, cdr_message, ros_channel, write_postures

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
    count = cycle_count(takes * way.duration, period, "period")
    while True:
        q = unit * way(np.linspace(0.0, way.duration, count + 1))
        q = np.clip(q, path.min(axis=0), path.max(axis=0))  # of rounding
        q[0], q[-1] = path[0], path[-1]
        velocity, acceleration = shares(q, period, rates)
        over = max(velocity, math.sqrt(acceleration))
        if over <= 1.0:
            return q
        count = max(count + 1, cycle_count(count * over * period, period, "period"))


SUFFIXES = (".npz", ".csv", ".mcap")
"""Kinds of files."""

BILLION = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Motion:
    """A timed motion: motor positions at k times.

    Attributes:
        robot: The robot.
        times: (k,) from the start [s].
        q: (k, n) [rad or m].
        velocity: (k, n) [rad/s or m/s].
        acceleration: (k, n) [rad/s^2 or m/s^2].
        notes: More that belongs to the times, (k, ...) by name; in npz files only.

    Example:
        >>> times, q = np.array([0.0, 0.1]), np.stack([robot.home, robot.home])
        >>> motion = ik.motion.Motion(robot, times, q, 0 * q, 0 * q)
        >>> motion.write("still.csv")
    """

    robot: ArmHand
    times: Array
    q: Array
    velocity: Array
    acceleration: Array
    notes: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def of_cycles(
        cls, robot: ArmHand, period: float, q: Array, notes: dict[str, np.ndarray]
    ) -> Motion:
        """What a follower returned cycle by cycle.

        Args:
            robot: The robot.
            period: Time of a cycle [s].
            q: (k + 1, n) where the robot was at rest first, then the answers.
            notes: (k + 1, ...) by name.
        """
        velocity = np.diff(q, axis=0, prepend=q[:1]) / period
        acceleration = np.diff(velocity, axis=0, prepend=velocity[:1]) / period
        times = period * np.arange(len(q), dtype=float)
        return cls(robot, times, q, velocity, acceleration, notes)

    @classmethod
    def of_samples(
        cls, robot: ArmHand, period: float, q: Array, notes: dict[str, np.ndarray]
    ) -> Motion:
        """A motion from rest to rest, by samples: rates are their central differences.

        Args:
            robot: The robot.
            period: Time from sample to sample [s].
            q: (k, n) where the motors are.
            notes: (k, ...) by name.
        """
        steps, acceleration = differences(q, period)
        velocity = np.zeros_like(q)
        velocity[1:-1] = (steps[1:] + steps[:-1]) / 2
        times = period * np.arange(len(q), dtype=float)
        return cls(robot, times, q, velocity, acceleration, notes)

    def write(self, path: str | Path) -> None:
        """Write a file; its kind follows from the suffix.

        ``.npz``: `times`, `q`, `velocity`, `acceleration`, `actuators` and the notes. ``.csv``:
        time, then positions, velocities and accelerations by actuator. ``.mcap``: for ROS 2 and
        viewers, the whole as ``trajectory_msgs/JointTrajectory`` on ``/joint_trajectory``, every
        time as ``sensor_msgs/JointState`` of all joints, and the robot as URDF.

        Args:
            path: The file; it is there when it is complete.

        Raises:
            InputError: Another suffix.
            OSError: It cannot be written.
        """
        with atomic_write(Path(path)) as part:
            self.write_to(part)

    def write_to(self, path: Path) -> None:
        """Write a file that is not there yet, as `write` does but in its place."""
        every = self._npz, self._csv, self._mcap
        writers: dict[str, Callable[[Path], None]] = dict(zip(SUFFIXES, every, strict=True))
        write = writers.get(path.suffix.lower())
        if write is None:
            expected = ", ".join(SUFFIXES)
            raise InputError(f"{path}: found suffix {path.suffix!r}, expected one of {expected}")
        write(path)

    def _npz(self, path: Path) -> None:
        np.savez(
            path,
            times=self.times,
            q=self.q,
            velocity=self.velocity,
            acceleration=self.acceleration,
            actuators=np.array(self.robot.actuators),
            allow_pickle=False,
            **self.notes,
        )

    def _csv(self, path: Path) -> None:
        names = [
            f"{name}{what}"
            for what in ("", ".velocity", ".acceleration")
            for name in self.robot.actuators
        ]
        rows = np.hstack([self.times[:, None], self.q, self.velocity, self.acceleration])
        with path.open("x", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["time", *names])
            writer.writerows(rows.tolist())

    def _mcap(self, path: Path) -> None:
        with path.open("xb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2", library="casadi_ik")
            self._messages(writer)
            writer.finish()

    def _messages(self, writer: Writer) -> None:
        robot, none = self.robot, np.zeros(0)
        root, stamps = robot.description.root, np.rint(self.times * BILLION).astype(np.int64)
        points: list[str | list[str] | Array | tuple[int, int] | int] = []
        rows = zip(stamps.tolist(), self.q, self.velocity, self.acceleration, strict=True)
        for stamp, *values in rows:
            points += [*values, none, divmod(stamp, BILLION)]
        whole = cdr_message((0, 0), root, list(robot.actuators), len(self), *points)
        channel = ros_channel(writer, "/joint_trajectory", JOINT_TRAJECTORY)
        writer.add_message(channel, 0, whole, 0)
        write_postures(writer, robot, self.q, stamps.tolist())
