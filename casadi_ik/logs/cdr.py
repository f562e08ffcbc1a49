"""ROS 2 messages as bytes (plain CDR, little endian), and recorded motions read from them."""

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
from casadi_ik.logs.container import CDR_HEADER, MESSAGE, open_log_file, read_chunk, read_contents

Stamp = tuple[int, int]
"""Seconds and nanoseconds: a time, or a duration."""

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
    """A message of texts, lists of them, sequences of float64, stamps, and lengths of sequences."""
    return CDR_HEADER + cdr(values)


def cdr(values: Iterable[Value]) -> bytes:
    """The same without the header."""
    out = bytearray()
    for value in values:
        out += bytes(-len(out) % 4)
        if isinstance(value, int):
            out += struct.pack("<I", value)
        elif isinstance(value, tuple):
            out += struct.pack("<iI", *value)
        elif isinstance(value, np.ndarray):
            out += struct.pack("<I", len(value))
            if len(value):
                out += bytes(-len(out) % 8) + value.astype("<f8").tobytes()
        else:
            if isinstance(value, list):
                out += struct.pack("<I", len(value))
            for text in [value] if isinstance(value, str) else value:
                data = text.encode() + b"\0"
                out += bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data
    return bytes(out)


def ros_channel(writer: Writer, topic: str, definition: tuple[str, str]) -> int:
    """Register a channel of ROS 2 messages, defined by the name and the text of their schema."""
    name, text = definition
    schema = writer.register_schema(name, "ros2msg", text.encode())
    return writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})


def write_postures(writer: Writer, robot: ArmHand, q: Array, stamps: Sequence[int]) -> None:
    """Write the robot as URDF, once, and its joints after the couplings at each of k times.

    Args:
        writer: Of the file.
        robot: The robot.
        q: (k, n) [rad or m].
        stamps: (k,) times [ns].
    """
    described = ros_channel(writer, "/robot_description", STRING)
    first = min(stamps, default=0)
    writer.add_message(described, first, cdr_message(robot.urdf()), first)
    joints, none = robot.joints(q), np.zeros(0)
    positions = np.stack([np.atleast_1d(values) for values in joints.values()], axis=1)
    channel = ros_channel(writer, "/joint_states", JOINT_STATE)
    for i, stamp in enumerate(stamps):
        header = divmod(stamp, 1_000_000_000), robot.description.root
        state = cdr_message(*header, list(joints), positions[i], none, none)
        writer.add_message(channel, stamp, state, stamp, sequence=i)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """A motion read from a file of `reach`, `follow` or `ik.motion.Motion.write`.

    Attributes:
        robot: Name of the robot, as its URDF in the file has it.
        actuators: Names of the n actuators.
        times: (k,) from the start [s].
        q: (k, n) [rad or m].

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
        """The positions (k, n) of a robot's actuators, in its order.

        Raises:
            LogError: The motion is of other actuators.
        """
        if sorted(self.actuators) != sorted(actuators):
            raise LogError(
                f"a motion of {', '.join(self.actuators)}; the robot has {', '.join(actuators)}"
            )
        return self.q[:, [self.actuators.index(name) for name in actuators]]


def read_motion(path: str | os.PathLike[str]) -> RecordedMotion:
    """Read a motion from an MCAP file; the contacts follow from `ArmHand.contacts`.

    Raises:
        LogError: The file is missing, damaged, no MCAP file, or holds no motion.

    Example:
        >>> times, q = np.array([0.0, 0.1]), np.stack([robot.home, robot.home])
        >>> ik.motion.Motion(robot, times, q, 0 * q, 0 * q).write("still.mcap")
        >>> motion = ik.logs.read_motion("still.mcap")
        >>> points, normals = robot.contacts(motion.ordered(robot.actuators))
    """
    with open_log_file(Path(path)) as stream:
        contents = read_contents(Path(path))
        topics = {channel.id: channel.topic for channel in contents.summary.channels.values()}
        found: dict[str, bytes] = {}
        wanted = "/robot_description", "/joint_trajectory"
        for index in contents.chunks:
            chunk = read_chunk(stream, index)
            for run in chunk.runs:
                if topics.get(run.channel) in wanted:
                    start = run.start + MESSAGE.itemsize
                    found[topics[run.channel]] = chunk.data[start : run.start + run.size]
        if len(found) < len(wanted):
            raise LogError(f"no motion: found {', '.join(topics.values()) or 'no topic'}")
        try:
            description, trajectory = (CdrReader(found[topic]) for topic in wanted)
            robot = re.search(r'<robot\s[^>]*?name="([^"<]*)"', description.text())
            trajectory.place = 8
            trajectory.text()
            actuators = tuple(trajectory.text() for _ in range(trajectory.number("<I")))
            times, q = [], []
            for _ in range(trajectory.number("<I")):
                q.append(trajectory.numbers())
                for _ in range(3):
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
    """Values of a message, one after the other; the inverse of `cdr`."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def number(self, kind: str) -> Any:
        """A number of four bytes."""
        self.place += -self.place % 4
        (value,) = struct.unpack_from(kind, self.data, self.place)
        self.place += 4
        return value

    def text(self) -> str:
        """A text, its end mark left out."""
        length = self.number("<I")
        self.place += length
        return self.data[self.place - length : self.place - 1].decode()

    def numbers(self) -> Array:
        """A sequence of float64."""
        count = self.number("<I")
        self.place += -self.place % 8 if count else 0
        values = np.frombuffer(self.data, "<f8", count, self.place)
        self.place += 8 * count
        return values
