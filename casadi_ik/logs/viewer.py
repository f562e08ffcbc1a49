"""One solve as a file that Foxglove and Lichtblick play: robot, frames, contacts, phases, events.

======================  ==========================  ================================================
topic                   schema                      message
======================  ==========================  ================================================
``/robot_description``  std_msgs/msg/String         the robot as URDF, once
``/tf``                 foxglove.FrameTransforms    every link under its parent, each iteration
``/joint_states``       sensor_msgs/msg/JointState  joints after the couplings, each iteration
``/ik/targets``         foxglove.SceneUpdate        the contacts asked for, once
``/ik/contacts``        foxglove.SceneUpdate        where the fingertips are, each iteration
``/ik/iteration``       as in the log               all that the log holds of each iteration
``/ik/messages``        foxglove.Log                how it began, phases, events, how it ended
======================  ==========================  ================================================

An iteration takes 10 ms, and the first is at the time when the solve began.
"""

from __future__ import annotations

import os
import re
import struct
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import LogError, MissingExtraError
from casadi_ik.files.writing import written_whole
from casadi_ik.logs import schema
from casadi_ik.logs.message import CDR_HEADER
from casadi_ik.logs.one_solve import OneSolve
from casadi_ik.logs.phrases import SERIOUS, errors, told
from casadi_ik.symbolic.so3 import quaternion_from_matrix

try:
    from foxglove import Schema
    from foxglove import messages as fox
except ImportError as error:
    raise MissingExtraError(
        "viewer files need foxglove-sdk, which is not installed: pip install casadi-ik[viewer]"
    ) from error

Array = NDArray[np.float64]

ITERATION = 10_000_000
"""Time between two iterations in the viewer [ns]."""

STRING = ("std_msgs/msg/String", "string data\n")

JOINT_STATE = (
    "sensor_msgs/msg/JointState",
    """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
)

Color = tuple[float, float, float]
TARGET, FREE = (0.94, 0.71, 0.0), (0.6, 0.6, 0.6)
MET, MISSED = (0.12, 0.62, 0.33), (0.84, 0.18, 0.24)
"""Of contacts: asked for, of a free finger; within tolerance, out of it."""

ARROW = 0.05
"""Length of a contact's normal [m]."""


def write_view(path: str | os.PathLike[str], solve: OneSolve, robot: ArmHand) -> None:
    """Write a viewer file.

    Args:
        path: The MCAP file; it is there when it is complete.
        solve: The solve.
        robot: The robot that it was solved for.

    Raises:
        LogError: The log has no iterations of the solve, or the file cannot be written.
    """
    if len(solve.rows) == 0:
        raise LogError(
            f"solve {solve.solve_id} of {solve.method}: the log kept no iterations of it"
        )
    try:
        with written_whole(Path(path)) as part, part.open("xb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2", library="casadi_ik")
            _View(writer, solve, robot).write()
            writer.finish()
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogError(f"{path}: cannot write the viewer file: {reason}") from error


def check_robot(robot: ArmHand, urdf: str, where: str) -> None:
    """See to it that a robot is the one a log was written for.

    Args:
        robot: The robot.
        urdf: The robot description attached to the log.
        where: The log, for the message.

    Raises:
        LogError: They differ by more than rounding.
    """
    found, expected = (re.split(r'[\s"]+', text) for text in (robot.urdf(), urdf))
    alike = len(found) == len(expected)
    if not (alike and all(map(_same, found, expected))):
        raise LogError(
            f"{where}: the robot {robot.name!r} is not the one in the log (its URDF differs);"
            " give the description that was solved for (--robot)"
        )


def _same(first: str, second: str) -> bool:
    if first == second:
        return True
    try:
        return bool(np.isclose(float(first), float(second), rtol=1e-9, atol=1e-9))
    except ValueError:
        return False


class _View:
    """The topics of one solve."""

    def __init__(self, writer: Writer, solve: OneSolve, robot: ArmHand) -> None:
        self.writer = writer
        self.solve = solve
        self.robot = robot
        self.root = robot.description.root
        self.q = solve.rows["q"].astype(float)
        self.times = solve.started + ITERATION * np.arange(len(solve.rows))

    def write(self) -> None:
        """All topics, each in its order; a reader sorts by time."""
        self._add(self._ros("/robot_description", STRING), 0, _cdr(self.robot.urdf()))
        self._targets()
        self._transforms()
        self._joint_states()
        self._contacts()
        self._iterations()
        self._messages()

    def _ros(self, topic: str, definition: tuple[str, str]) -> int:
        name, text = definition
        number = self.writer.register_schema(name, "ros2msg", text.encode())
        return self.writer.register_channel(topic, "cdr", number, {"offered_qos_profiles": ""})

    def _protobuf(self, topic: str, found: Schema) -> int:
        number = self.writer.register_schema(found.name, found.encoding, found.data)
        return self.writer.register_channel(topic, "protobuf", number)

    def _add(self, channel: int, i: int, data: bytes) -> None:
        time = int(self.times[i])
        self.writer.add_message(channel, time, data, time, sequence=i)

    def _transforms(self) -> None:
        description, links = self.robot.description, self.robot.links(self.q)
        poses = [
            (joint.parent, joint.child, _inverse(links[joint.parent]) @ links[joint.child])
            for joint in description.joints
        ]
        poses += [
            (finger.link, f"{finger.name}_contact", np.tile(finger.placement, (len(self.q), 1, 1)))
            for finger in description.fingers
        ]
        frames = [
            (parent, child, pose[:, :3, 3], _quaternions(pose[:, :3, :3]))
            for parent, child, pose in poses
        ]
        channel = self._protobuf("/tf", fox.FrameTransforms.get_schema())
        for i, time in enumerate(self.times.tolist()):
            stamp = _stamp(time)
            transforms = [
                fox.FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=parent,
                    child_frame_id=child,
                    translation=_vector(positions[i]),
                    rotation=_quaternion(rotations[i]),
                )
                for parent, child, positions, rotations in frames
            ]
            self._add(channel, i, fox.FrameTransforms(transforms=transforms).encode())

    def _joint_states(self) -> None:
        joints = self.robot.joints(self.q)
        positions = np.stack([np.atleast_1d(values) for values in joints.values()], axis=1)
        channel = self._ros("/joint_states", JOINT_STATE)
        none = np.zeros(0)
        for i, time in enumerate(self.times.tolist()):
            state = _cdr(_stamp(time), self.root, list(joints), positions[i], none, none)
            self._add(channel, i, state)

    def _targets(self) -> None:
        solve = self.solve
        turned = _quaternions(_along(solve.target_normals))
        contacts = [
            (f"{finger} target", solve.target_points[j], turned[j], TARGET)
            for j, finger in enumerate(solve.fingers)
            if not np.isnan(solve.target_points[j]).any()
        ]
        channel = self._protobuf("/ik/targets", fox.SceneUpdate.get_schema())
        self._add(channel, 0, self._scene(0, contacts, thickness=0.008))

    def _contacts(self) -> None:
        solve = self.solve
        points, normals = self.robot.contacts(self.q)
        turned = _quaternions(_along(normals.reshape(-1, 3))).reshape(*normals.shape[:2], 4)
        missed = (solve.rows["position_error"] > solve.position_tolerance) | (
            solve.rows["angle_error"] > solve.angle_tolerance
        )
        channel = self._protobuf("/ik/contacts", fox.SceneUpdate.get_schema())
        free = [bool(np.isnan(point).any()) for point in solve.target_points]
        for i in range(len(self.q)):
            colors = [
                FREE if free[j] else MISSED if missed[i, j] else MET for j in range(len(free))
            ]
            contacts = list(zip(solve.fingers, points[i], turned[i], colors, strict=True))
            self._add(channel, i, self._scene(i, contacts, thickness=0.004))

    def _scene(
        self, i: int, contacts: list[tuple[str, Array, Array, Color]], thickness: float
    ) -> bytes:
        """Contacts as points with arrows along their normals: name, point, rotation, colour."""
        stamp = _stamp(int(self.times[i]))
        entities = [
            fox.SceneEntity(
                timestamp=stamp,
                frame_id=self.root,
                id=name,
                spheres=[_sphere(point, 2.5 * thickness, color)],
                arrows=[] if np.isnan(turned).any() else [_arrow(point, turned, thickness, color)],
            )
            for name, point, turned, color in contacts
        ]
        return fox.SceneUpdate(entities=entities).encode()

    def _iterations(self) -> None:
        solve = self.solve
        name = schema.schema_name("iteration", solve.method, solve.layout, len(solve.fingers))
        text = schema.schema_text(solve.layout, solve.labels)
        channel = self._ros("/ik/iteration", (name, text))
        for i, row in enumerate(solve.rows):
            self._add(channel, i, CDR_HEADER + row.tobytes())

    def _messages(self) -> None:
        solve, last = self.solve, len(self.q) - 1
        lines = [(0, fox.LogLevel.Info, f"{solve.method} on {solve.robot}, solve {solve.solve_id}")]
        lines += [(each.first, fox.LogLevel.Info, each.phase) for each in solve.stretches]
        lines += [
            (
                event.iteration,
                fox.LogLevel.Warning if event.kind in SERIOUS else fox.LogLevel.Info,
                told(event),
            )
            for event in solve.events
            if event.kind != "PHASE_CHANGE"
        ]
        level = fox.LogLevel.Info if solve.success else fox.LogLevel.Error
        lines.append((last, level, f"{solve.status} after {solve.iterations} iterations"))
        for finger, position, angle, ok in zip(
            solve.fingers, solve.position_error, solve.angle_error, solve.ok, strict=True
        ):
            level = fox.LogLevel.Info if ok else fox.LogLevel.Error
            lines.append((last, level, f"{finger} off by {errors(float(position), float(angle))}"))
        channel = self._protobuf("/ik/messages", fox.Log.get_schema())
        for i, level, text in sorted(lines, key=lambda line: line[0]):
            stamp = _stamp(int(self.times[i]))
            log = fox.Log(timestamp=stamp, level=level, message=text, name=f"iteration {i}")
            self._add(channel, i, log.encode())


def _inverse(pose: Array) -> Array:
    """Inverse of rigid poses (k, 4, 4)."""
    turned = pose[:, :3, :3].swapaxes(1, 2)
    result = np.zeros_like(pose)
    result[:, :3, :3] = turned
    result[:, :3, 3] = -(turned @ pose[:, :3, 3, None])[..., 0]
    result[:, 3, 3] = 1.0
    return result


def _cdr(*values: str | list[str] | Array | fox.Timestamp) -> bytes:
    """A ROS 2 message of texts, lists of them, sequences of float64, and times."""
    out = bytearray()
    for value in values:
        if isinstance(value, fox.Timestamp):
            out += struct.pack("<iI", value.sec, value.nsec)
        elif isinstance(value, np.ndarray):
            out += bytes(-len(out) % 4) + struct.pack("<I", len(value))
            if len(value):
                out += bytes(-len(out) % 8) + value.astype("<f8").tobytes()
        else:
            if isinstance(value, list):
                out += bytes(-len(out) % 4) + struct.pack("<I", len(value))
            for text in [value] if isinstance(value, str) else value:
                data = text.encode() + b"\0"
                out += bytes(-len(out) % 4) + struct.pack("<I", len(data)) + data
    return CDR_HEADER + bytes(out)


def _stamp(time: int) -> fox.Timestamp:
    return fox.Timestamp(*divmod(time, 1_000_000_000))


def _vector(values: Array) -> fox.Vector3:
    x, y, z = values.tolist()
    return fox.Vector3(x=x, y=y, z=z)


def _quaternion(values: Array) -> fox.Quaternion:
    w, x, y, z = values.tolist()
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def _quaternions(rotations: Array) -> Array:
    """Unit quaternions (k, 4), scalar first, of rotations (k, 3, 3)."""
    stacked = _quaternion_function().map(len(rotations))(np.hstack(list(rotations)))
    return np.asarray(stacked, dtype=np.float64).T


def _along(normals: Array) -> Array:
    """Rotations (k, 3, 3) whose x axes are unit vectors (k, 3); NaN where those are."""
    other = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    y = np.cross(normals, other)
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(normals, y)
    return np.stack([normals, y, z], axis=2).astype(np.float64)


@cache
def _quaternion_function() -> ca.Function:
    R = ca.SX.sym("R", 3, 3)
    return ca.Function("quaternion", [R], [quaternion_from_matrix(R)])


def _color(color: Color) -> fox.Color:
    return fox.Color(r=color[0], g=color[1], b=color[2], a=1.0)


def _sphere(point: Array, size: float, color: Color) -> fox.SpherePrimitive:
    pose = fox.Pose(position=_vector(point), orientation=fox.Quaternion(w=1.0))
    return fox.SpherePrimitive(
        pose=pose, size=fox.Vector3(x=size, y=size, z=size), color=_color(color)
    )


def _arrow(point: Array, turned: Array, thickness: float, color: Color) -> fox.ArrowPrimitive:
    """An arrow from a point; in its own frame it points along x."""
    return fox.ArrowPrimitive(
        pose=fox.Pose(position=_vector(point), orientation=_quaternion(turned)),
        shaft_length=0.7 * ARROW,
        shaft_diameter=thickness,
        head_length=0.3 * ARROW,
        head_diameter=2.2 * thickness,
        color=_color(color),
    )
