"""A motion of the motors in time, and the files it is kept in."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.files.writing import written_whole
from casadi_ik.logs.cdr import JOINT_TRAJECTORY, cdr_message, ros_channel, write_postures
from casadi_ik.motion.timing import differences

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
        with written_whole(Path(path)) as part:
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
