"""Timed motions: velocity and acceleration limits, time parametrisation, and files."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from casadi_ik.errors import InputError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import cycle_count
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.files.writing import atomic_write
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.cdr import JOINT_TRAJECTORY, cdr_message, ros_channel, write_postures

CROSSING_TIME = 1.0
"""Time in which a motor without a velocity limit crosses its range [s]."""

RUN_UP = 0.25
"""Time from rest to the velocity limit of a motor without an acceleration limit [s]."""


MAX_RATE = 1e12
"""Largest limit of a velocity or an acceleration; with larger ones durations underflow."""


@dataclass(frozen=True, eq=False)
class Rates:
    """Velocity and acceleration limits of the motors.

    Attributes:
        velocity: (n,) velocity limits [rad/s or m/s].
        acceleration: (n,) acceleration limits [rad/s^2 or m/s^2].
    """

    velocity: Array
    acceleration: Array

    def steps(self, period: float) -> tuple[Array, Array]:
        """Return the longest step of a cycle, and its largest change from cycle to cycle.

        Args:
            period: Time from cycle to cycle [s].

        Returns:
            (n,) steps and (n,) changes [rad or m].
        """
        return self.velocity * period, self.acceleration * period**2


def own_velocities(robot: ArmHand) -> Array:
    """Return the velocity limits (n,) of the description; without one, range / `CROSSING_TIME`."""
    limits = np.array([actuator.velocity for actuator in robot.description.actuators])
    ranges = robot.upper - robot.lower
    return np.where(np.isfinite(limits), limits, ranges / CROSSING_TIME)


def rates_of(robot: ArmHand, velocity: Any, acceleration: Any) -> Rates:
    """Return the velocity and acceleration limits of a motion.

    Args:
        robot: Robot that moves.
        velocity: Velocity limits, (n,) or a number; None: those of the description.
        acceleration: Acceleration limits, (n,) or a number; None: those that reach the velocity
            limit within `RUN_UP`.

    Raises:
        InputError: A limit is not a positive number.
    """
    if velocity is None:
        limits = own_velocities(robot)
    else:
        limits = positive_per_motor(robot, "velocity", velocity)
    if acceleration is None:
        return Rates(limits, limits / RUN_UP)
    return Rates(limits, positive_per_motor(robot, "acceleration", acceleration))


def limit_fraction(q: Array, period: float, rates: Rates) -> tuple[float, float]:
    """Return the maximum velocity and acceleration of samples relative to the limits.

    The motors are at rest before the first sample and after the last one.

    Args:
        q: (m, n) positions of the motors at intervals of one period.
        period: Time between two samples [s].
        rates: Limits of velocities and accelerations.

    Returns:
        Velocity (first differences) and acceleration (second differences) as fractions of the
        limits.
    """
    velocity, acceleration = differences(q, period)
    return (
        float((np.abs(velocity) / rates.velocity).max(initial=0.0)),
        float((np.abs(acceleration) / rates.acceleration).max(initial=0.0)),
    )


def differences(q: Array, period: float) -> tuple[Array, Array]:
    """Return the first (m - 1, n) and second (m, n) difference quotients of samples.

    The motion is mirrored at the first and the last sample: the velocity is zero there, and the
    second difference quotient is twice the step over the squared period.
    """
    steps = np.diff(q, axis=0)
    if not len(steps):
        return steps, np.zeros_like(q)
    mirrored = np.concatenate([-steps[:1], steps, -steps[-1:]])
    return steps / period, np.diff(mirrored, axis=0) / period**2


def finite_array(
    name: str, value: Any, shape: tuple[int, ...], is_valid: Callable[[Array], Any], expected: str
) -> Array:
    """Return a value as an array, after checks of its shape and numbers.

    Raises:
        InputError: The value is not finite, not valid, or of another shape.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != shape or not np.isfinite(array).all() or not np.all(is_valid(array)):
        raise InputError(f"{name}: found {value!r}, expected {expected}")
    return array


def positive_per_motor(robot: ArmHand, name: str, value: Any) -> Array:
    """Return one positive number per motor, see `finite_array`."""
    n = len(robot.actuators)
    shape = () if np.ndim(value) == 0 else (n,)
    expected = f"a number > 0 and <= {MAX_RATE:g}, or {n} of them"
    array = finite_array(name, value, shape, lambda x: (x > 0) & (x <= MAX_RATE), expected)
    return np.array(np.broadcast_to(array, (n,)))


def seconds(name: str, value: Any) -> float:
    """Return a positive number of seconds, see `finite_array`."""
    return float(finite_array(name, value, (), lambda x: x > 0, "a number of seconds > 0"))


def length(name: str, value: Any) -> float:
    """Return a number of metres >= 0, see `finite_array`."""
    return float(finite_array(name, value, (), lambda x: x >= 0, "a number of metres >= 0"))


def direction_vector(name: str, value: Any) -> Array:
    """Return a direction (3,), see `finite_array`."""
    return finite_array(name, value, (3,), np.any, "three numbers, not all zero")


def unbounded(robot: ArmHand) -> Rates:
    """Return limits that motors never reach in cycles of one second."""
    limits = 1e6 * np.maximum(robot.upper - robot.lower, 1.0)
    return Rates(limits, limits)


@dataclass(frozen=True)
class TimingTuning:
    """Parameters of the time parametrisation of a path.

    Attributes:
        min_segment: Minimum distance between consecutive postures, relative to the path length;
            closer postures are omitted.
        grid: Minimum number of grid points at which the speed is computed.
        limit_share: Fraction of the limits at the grid points, because the speed is higher between
            them.
        last_grid_offset: Distance of an additional grid point before each posture, relative to the
            grid interval.
    """

    min_segment: float = 1e-6
    grid: int = 200
    limit_share: float = 0.99
    last_grid_offset: float = 0.1


TIMING_TUNING = TimingTuning()


def timed(path: Array, rates: Rates, period: float) -> Array:
    """Return samples of a path from rest to rest, timed by TOPP-RA (Pham & Pham 2018).

    The curve through the postures is cubic and monotonic between each two (Fritsch & Carlson 1980),
    so it satisfies all limits that the postures satisfy. Its second derivative is linear between
    postures and discontinuous at them: the acceleration limits are imposed at both ends of every
    grid interval, and there are grid points before, at and between postures. If first and second
    differences of the samples still exceed the limits, the motion is slowed down.

    Args:
        path: (k, n) postures that the curve passes.
        rates: Limits of velocities and accelerations.
        period: Time between two samples [s].

    Returns:
        (m, n) positions of the motors at intervals of one period, with the ends of the path.

    Raises:
        MissingExtraError: toppra is not installed.
    """
    with optional_import("timing"):
        import toppra
    lengths = np.abs(np.diff(path, axis=0)).sum(axis=0)
    if not lengths.max(initial=0.0) > 1e-9:
        return path[:1]
    toppra.setup_logging("ERROR")
    # Scale time and positions such that all numbers are near 1.
    time_unit = max(lengths / rates.velocity) + math.sqrt(max(lengths / rates.acceleration))
    units = rates.acceleration * time_unit**2
    max_velocity = TIMING_TUNING.limit_share * rates.velocity * time_unit / units
    trajectory = _fastest_trajectory(path / units, max_velocity, TIMING_TUNING.limit_share)
    count = cycle_count(time_unit * trajectory.duration, period, "period")
    while True:
        q = units * trajectory(np.linspace(0.0, trajectory.duration, count + 1))
        q = np.clip(q, path.min(axis=0), path.max(axis=0))  # remove rounding errors
        q[0], q[-1] = path[0], path[-1]
        velocity, acceleration = limit_fraction(q, period, rates)
        slowdown = max(velocity, math.sqrt(acceleration))
        if slowdown <= 1.0:
            return q
        count = max(count + 1, cycle_count(count * slowdown * period, period, "period"))


def _fastest_trajectory(path: Array, max_velocity: Array, max_acceleration: float) -> Any:
    """Return the fastest trajectory of TOPP-RA from rest to rest, in scaled units.

    Args:
        path: (k, n) postures.
        max_velocity: (n,) velocity limits.
        max_acceleration: Acceleration limit of all motors.
    """
    with optional_import("timing"):
        from scipy.interpolate import PchipInterpolator
        from toppra import algorithm, constraint
        from toppra.simplepath import SimplePath
    tuning = TIMING_TUNING
    segment_lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    is_long = segment_lengths > tuning.min_segment * segment_lengths.sum()
    postures = path[np.append(is_long, True)]
    segment_lengths = np.linalg.norm(np.diff(postures, axis=0), axis=1)
    parameters = np.append(0.0, np.cumsum(segment_lengths))
    parameters /= parameters[-1]
    slopes = PchipInterpolator(parameters, postures).derivative()(parameters)
    accelerations = np.full(path.shape[1], max_acceleration)
    both_ends = constraint.DiscretizationType.Interpolation
    constraints = [
        constraint.JointVelocityConstraint(np.stack([-max_velocity, max_velocity], axis=1)),
        constraint.JointAccelerationConstraint(
            np.stack([-accelerations, accelerations], axis=1), discretization_scheme=both_ends
        ),
    ]
    intervals = max(2, math.ceil(tuning.grid / (len(postures) - 1)))
    regular = np.linspace(0.0, 1.0, intervals, endpoint=False)
    with_last_point = np.append(regular, 1.0 - tuning.last_grid_offset / intervals)
    trajectory: Any = None
    # The interval before a posture is sometimes too short for the linear programs of TOPP-RA.
    for segment_grid in (with_last_point, regular):
        points = parameters[:-1, None] + np.diff(parameters)[:, None] * segment_grid
        trajectory = algorithm.TOPPRA(
            constraints,
            SimplePath(parameters, postures, slopes),
            gridpoints=np.append(points.ravel(), 1.0),
            parametrizer="ParametrizeConstAccel",
        ).compute_trajectory()
        if trajectory is not None:
            break
    assert trajectory is not None
    return trajectory


SUFFIXES = (".npz", ".csv", ".mcap")
"""Suffixes of the file formats of a motion."""

NANOSECONDS_PER_SECOND = 1_000_000_000


@dataclass(frozen=True, eq=False, repr=False)
class Motion(RecordReprMixin):
    """Timed motion: motor positions at k times.

    Attributes:
        robot: Robot that moves.
        times: (k,) times from the start [s].
        q: (k, n) positions [rad or m].
        velocity: (k, n) velocities [rad/s or m/s].
        acceleration: (k, n) accelerations [rad/s^2 or m/s^2].
        notes: Additional arrays (k, ...) by name; only npz files contain them.

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
        """Return the motion of a follower.

        Args:
            robot: Robot that moves.
            period: Time from cycle to cycle [s].
            q: (k + 1, n) configuration at rest, then the configurations after the cycles.
            notes: (k + 1, ...) arrays by name.
        """
        velocity = np.diff(q, axis=0, prepend=q[:1]) / period
        acceleration = np.diff(velocity, axis=0, prepend=velocity[:1]) / period
        times = period * np.arange(len(q), dtype=float)
        return cls(robot, times, q, velocity, acceleration, notes)

    @classmethod
    def of_samples(
        cls, robot: ArmHand, period: float, q: Array, notes: dict[str, np.ndarray]
    ) -> Motion:
        """Return a motion from rest to rest; its velocities are central differences of samples.

        Args:
            robot: Robot that moves.
            period: Time from sample to sample [s].
            q: (k, n) positions of the motors.
            notes: (k, ...) arrays by name.
        """
        steps, acceleration = differences(q, period)
        velocity = np.zeros_like(q)
        velocity[1:-1] = (steps[1:] + steps[:-1]) / 2
        times = period * np.arange(len(q), dtype=float)
        return cls(robot, times, q, velocity, acceleration, notes)

    def write(self, path: str | Path) -> None:
        """Write a file in the format of its suffix.

        ``.npz`` has `times`, `q`, `velocity`, `acceleration`, `actuators` and the notes. ``.csv``
        has the time, then positions, velocities and accelerations by actuator. ``.mcap`` is for
        ROS 2 and viewers: ``trajectory_msgs/JointTrajectory`` on ``/joint_trajectory``,
        ``sensor_msgs/JointState`` of all joints at every time, and the robot as URDF.

        Args:
            path: File path; the file appears once it is complete.

        Raises:
            InputError: The suffix is unknown.
            OSError: The file cannot be written.
        """
        with atomic_write(Path(path)) as temporary:
            self.write_to(temporary)

    def write_to(self, path: Path) -> None:
        """Write a new file without a temporary one, see `write`."""
        methods = self._npz, self._csv, self._mcap
        writers: dict[str, Callable[[Path], None]] = dict(zip(SUFFIXES, methods, strict=True))
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
            f"{name}{suffix}"
            for suffix in ("", ".velocity", ".acceleration")
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
        robot, no_efforts = self.robot, np.zeros(0)
        root, stamps = (
            robot.description.root,
            np.rint(self.times * NANOSECONDS_PER_SECOND).astype(np.int64),
        )
        points: list[str | list[str] | Array | tuple[int, int] | int] = []
        rows = zip(stamps.tolist(), self.q, self.velocity, self.acceleration, strict=True)
        for stamp, *values in rows:
            points += [*values, no_efforts, divmod(stamp, NANOSECONDS_PER_SECOND)]
        trajectory = cdr_message((0, 0), root, list(robot.actuators), len(self), *points)
        channel = ros_channel(writer, "/joint_trajectory", JOINT_TRAJECTORY)
        writer.add_message(channel, 0, trajectory, 0)
        write_postures(writer, robot, self.q, stamps.tolist())
