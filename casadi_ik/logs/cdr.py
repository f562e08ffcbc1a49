"""ROS 2 messages as bytes: plain CDR, little endian."""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.logs.chunks import CDR_HEADER

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
