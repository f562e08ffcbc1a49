"""ROS 2 messages in little-endian plain CDR, and recorded motions read from them."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from casadi_ik.errors import LogError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.chunks import CDR_HEADER, MESSAGE
from casadi_ik.logs.container import open_log_file, read_chunk, read_contents


class NoMotionError(LogError):
    """Error of an intact log without a motion, such as a log of solves."""


Stamp = tuple[int, int]
"""Seconds and nanoseconds of a time or duration."""

Value = str | list[str] | Array | Stamp | int

TIME = """\
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

HEADER = f"""\
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{"=" * 80}
{TIME}"""

STRING = ("std_msgs/msg/String", "string data\n")

JOINT_STATE = (
    "sensor_msgs/msg/JointState",
    f"""\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{"=" * 80}
{HEADER}""",
)

JOINT_TRAJECTORY = (
    "trajectory_msgs/msg/JointTrajectory",
    f"""\
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
{"=" * 80}
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
{"=" * 80}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
{"=" * 80}
{HEADER}""",
)


def cdr_message(*values: Value) -> bytes:
    """Return a message with its CDR header.

    Args:
        values: Strings, lists of strings, arrays of float64, stamps, or lengths of sequences.
    """
    return CDR_HEADER + cdr(values)


def cdr(values: Iterable[Value]) -> bytes:
    """Return the CDR encoding of values without the header; see `cdr_message`."""
    data = bytearray()
    for value in values:
        data += bytes(-len(data) % 4)
        if isinstance(value, int):
            data += struct.pack("<I", value)
        elif isinstance(value, tuple):
            data += struct.pack("<iI", *value)
        elif isinstance(value, np.ndarray):
            data += struct.pack("<I", len(value))
            if len(value):
                data += bytes(-len(data) % 8) + value.astype("<f8").tobytes()
        else:
            if isinstance(value, list):
                data += struct.pack("<I", len(value))
            for text in [value] if isinstance(value, str) else value:
                encoded = text.encode() + b"\0"
                data += bytes(-len(data) % 4) + struct.pack("<I", len(encoded)) + encoded
    return bytes(data)


def ros_channel(writer: Writer, topic: str, definition: tuple[str, str]) -> int:
    """Register a channel of ROS 2 messages; `definition` is the name and text of their schema."""
    name, text = definition
    schema = writer.register_schema(name, "ros2msg", text.encode())
    return writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})


def write_postures(writer: Writer, robot: ArmHand, q: Array, stamps: Sequence[int]) -> None:
    """Write a robot description and its joint states after the couplings.

    Args:
        writer: Writer of the file.
        robot: The robot; its URDF is written once.
        q: (k, n) configurations [rad or m].
        stamps: (k,) times of the configurations [ns].
    """
    description_channel = ros_channel(writer, "/robot_description", STRING)
    start = min(stamps, default=0)
    writer.add_message(description_channel, start, cdr_message(robot.urdf()), start)
    joints, empty = robot.joints(q), np.zeros(0)
    positions = np.stack([np.atleast_1d(values) for values in joints.values()], axis=1)
    channel = ros_channel(writer, "/joint_states", JOINT_STATE)
    for i, stamp in enumerate(stamps):
        header = divmod(stamp, 1_000_000_000), robot.description.root
        state = cdr_message(*header, list(joints), positions[i], empty, empty)
        writer.add_message(channel, stamp, state, stamp, sequence=i)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """A motion from a file of `reach`, `follow` or `ik.motion.Motion.write`.

    Attributes:
        robot: Name of the robot in the URDF of the file.
        actuators: Names of the n actuators.
        times: (k,) times from the start [s].
        q: (k, n) configurations [rad or m].

    Example:
        >>> times, q = np.array([0.0, 0.1]), np.stack([robot.home, robot.home])
        >>> ik.motion.Motion(robot, times, q, 0 * q, 0 * q).write("still.mcap")
        >>> recorded = ik.logs.read_motion("still.mcap")
        >>> recorded.robot, recorded.q.shape
        ('kuka_lwr_barrett', (2, 14))
    """

    robot: str
    actuators: tuple[str, ...]
    times: Array
    q: Array

    def ordered(self, actuators: Sequence[str]) -> Array:
        """Return the configurations (k, n) in a robot's order of actuators.

        Raises:
            LogError: The motion has other actuators.
        """
        if sorted(self.actuators) != sorted(actuators):
            raise LogError(
                f"actuators: found {', '.join(self.actuators)}; expected {', '.join(actuators)}"
            )
        return self.q[:, [self.actuators.index(name) for name in actuators]]


def read_motion(path: str | os.PathLike[str]) -> RecordedMotion:
    """Read a motion from an MCAP file; `ArmHand.contacts` computes its contacts.

    Raises:
        LogError: The file is missing, damaged or not an MCAP file, or it holds no motion.

    Example:
        >>> times, q = np.array([0.0, 0.1]), np.stack([robot.home, robot.home])
        >>> ik.motion.Motion(robot, times, q, 0 * q, 0 * q).write("still.mcap")
        >>> motion = ik.logs.read_motion("still.mcap")
        >>> points, normals = robot.contacts(motion.ordered(robot.actuators))
    """
    with open_log_file(Path(path)) as stream:
        contents = read_contents(Path(path))
        topics = {channel.id: channel.topic for channel in contents.summary.channels.values()}
        messages: dict[str, bytes] = {}
        required = "/robot_description", "/joint_trajectory"
        for index in contents.chunks:
            chunk = read_chunk(stream, index)
            for run in chunk.runs:
                if topics.get(run.channel) in required:
                    start = run.start + MESSAGE.itemsize
                    messages[topics[run.channel]] = chunk.data[start : run.start + run.size]
        if len(messages) < len(required):
            raise NoMotionError(
                f"motion: found topics {', '.join(topics.values()) or 'none'}; expected"
                f" {', '.join(required)}"
            )
        try:
            description, trajectory = (CdrReader(messages[topic]) for topic in required)
            robot = re.search(r'<robot\s[^>]*?name="([^"<]*)"', description.text())
            trajectory.position = 8  # after the stamp
            trajectory.text()  # the frame
            actuators = tuple(trajectory.text() for _ in range(trajectory.number("<I")))
            times, q = [], []
            for _ in range(trajectory.number("<I")):
                q.append(trajectory.numbers())
                for _ in range(3):  # velocities, accelerations, efforts
                    trajectory.numbers()
                times.append(trajectory.number("<i") + 1e-9 * trajectory.number("<I"))
            motion = RecordedMotion(
                robot[1] if robot else "", actuators, np.array(times), np.array(q)
            )
        except (struct.error, ValueError) as error:
            raise LogError(f"the motion is damaged: {error}") from error
        shape = len(times), len(actuators)
        if not times or motion.q.shape != shape or not np.isfinite(motion.q).all():
            raise LogError(f"the motion is damaged: expected {shape} finite positions")
        return motion


class CdrReader:
    """Sequential reader of the values of a message; the inverse of `cdr`.

    Attributes:
        data: Message without its header.
        position: Offset of the next value [bytes].
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.position = data, 0

    def number(self, code: str) -> Any:
        """Read a number of four bytes with a format code of `struct`."""
        self.position += -self.position % 4
        (value,) = struct.unpack_from(code, self.data, self.position)
        self.position += 4
        return value

    def text(self) -> str:
        """Read a string without its terminating zero."""
        length = self.number("<I")
        self.position += length
        return self.data[self.position - length : self.position - 1].decode()

    def numbers(self) -> Array:
        """Read a sequence of float64."""
        count = self.number("<I")
        self.position += -self.position % 8 if count else 0
        values = np.frombuffer(self.data, "<f8", count, self.position)
        self.position += 8 * count
        return values
