"""Export of one solve for Foxglove and Lichtblick: robot, frames, contacts, phases, events.

======================  ==========================  ================================================
topic                   schema                      message
======================  ==========================  ================================================
``/robot_description``  std_msgs/msg/String         the robot as URDF, once
``/tf``                 foxglove.FrameTransforms    every link under its parent, each iteration
``/joint_states``       sensor_msgs/msg/JointState  joints after the couplings, each iteration
``/ik/targets``         foxglove.SceneUpdate        the target contacts, once
``/ik/contacts``        foxglove.SceneUpdate        the fingertips, each iteration
``/ik/iteration``       as in the log               all fields of the log, each iteration
``/ik/messages``        foxglove.Log                start, phases, events, final status
======================  ==========================  ================================================

Iterations are 10 ms apart; the first one has the time at which the solve began.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from casadi_ik.app.drawing import palette
from casadi_ik.errors import LogError, optional_import, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.shipped import models_folder
from casadi_ik.files.writing import atomic_write
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs.cdr import ros_channel, write_postures
from casadi_ik.logs.chunks import CDR_HEADER
from casadi_ik.logs.events import SERIOUS, describe
from casadi_ik.logs.format import schema_name, schema_text
from casadi_ik.logs.solve import SolveRecord

with optional_import("viewer files"):
    from foxglove import Schema
    from foxglove import messages as fox
    from scipy.spatial.transform import Rotation

PLAYBACK_PERIOD = 10_000_000
"""Time between two iterations during playback [ns]."""

FREE_COLOR = "#999999"
"""Colour of the contact of a free finger."""

ARROW_LENGTH = 0.05
"""Length of the arrow of a normal [m]."""


def write_view(path: str | os.PathLike[str], solve: SolveRecord, robot: ArmHand) -> None:
    """Write a viewer file.

    Args:
        path: MCAP file, written atomically.
        solve: The solve.
        robot: Robot of the solve.

    Raises:
        LogError: The log has no iterations of the solve, or the file cannot be written.
    """
    if len(solve.rows) == 0:
        raise LogError(f"solve {solve.solve_id + 1} of {solve.method}: the log has no iterations")
    on_error = os_errors(f"{path}: cannot write the viewer file", LogError)
    with on_error, atomic_write(Path(path)) as temporary, temporary.open("xb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="casadi_ik")
        _View(writer, solve, robot).write()
        writer.finish()


class _View:
    """Writer of the topics of one solve."""

    def __init__(self, writer: Writer, solve: SolveRecord, robot: ArmHand) -> None:
        self.writer = writer
        self.solve = solve
        self.robot = robot
        self.root = robot.description.root
        self.q = solve.rows["q"].astype(float)
        self.times = solve.started + PLAYBACK_PERIOD * np.arange(len(solve.rows))

    def write(self) -> None:
        """Write all topics one after another; readers sort messages by time."""
        write_postures(self.writer, self.robot, self.q, self.times.tolist())
        self._targets()
        self._transforms()
        self._contacts()
        self._iterations()
        self._messages()

    def _protobuf(self, topic: str, schema: Schema) -> int:
        number = self.writer.register_schema(schema.name, schema.encoding, schema.data)
        return self.writer.register_channel(topic, "protobuf", number)

    def _add(self, channel: int, i: int, data: bytes) -> None:
        time = int(self.times[i])
        self.writer.add_message(channel, time, data, time, sequence=i)

    def _transforms(self) -> None:
        description, links = self.robot.description, self.robot.links(self.q)
        poses = [
            (joint.parent, joint.child, np.linalg.inv(links[joint.parent]) @ links[joint.child])
            for joint in description.joints
        ]
        poses += [
            (finger.link, f"{finger.name}_contact", np.tile(finger.placement, (len(self.q), 1, 1)))
            for finger in description.fingers
        ]
        frames = [
            (parent, child, pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]).as_quat())
            for parent, child, pose in poses
        ]
        channel = self._protobuf("/tf", fox.FrameTransforms.get_schema())
        for i, time in enumerate(self.times.tolist()):
            stamp = timestamp(time)
            transforms = [
                fox.FrameTransform(
                    timestamp=stamp,
                    parent_frame_id=parent,
                    child_frame_id=child,
                    translation=vector(positions[i]),
                    rotation=quaternion(rotations[i]),
                )
                for parent, child, positions, rotations in frames
            ]
            self._add(channel, i, fox.FrameTransforms(transforms=transforms).encode())

    def _targets(self) -> None:
        solve = self.solve
        rotations = quaternions_to(solve.target_normals)
        contacts = [
            (f"{finger} target", solve.target_points[j], rotations[j], palette.TARGET)
            for j, finger in enumerate(solve.fingers)
            if not np.isnan(solve.target_points[j]).any()
        ]
        channel = self._protobuf("/ik/targets", fox.SceneUpdate.get_schema())
        self._add(channel, 0, self._scene(0, contacts, thickness=0.008))

    def _contacts(self) -> None:
        solve = self.solve
        points, normals = self.robot.contacts(self.q)
        rotations = quaternions_to(normals.reshape(-1, 3)).reshape(*normals.shape[:2], 4)
        missed = (solve.rows["position_error"] > solve.position_tolerance) | (
            solve.rows["angle_error"] > solve.angle_tolerance
        )
        channel = self._protobuf("/ik/contacts", fox.SceneUpdate.get_schema())
        free = [bool(np.isnan(point).any()) for point in solve.target_points]
        for i in range(len(self.q)):
            colors = [
                FREE_COLOR if free[j] else palette.MISSED if missed[i, j] else palette.MET
                for j in range(len(free))
            ]
            contacts = list(zip(solve.fingers, points[i], rotations[i], colors, strict=True))
            self._add(channel, i, self._scene(i, contacts, thickness=0.004))

    def _scene(
        self, i: int, contacts: list[tuple[str, Array, Array, str]], thickness: float
    ) -> bytes:
        """Return contacts (name, point, rotation, colour) as balls with arrows."""
        stamp = timestamp(int(self.times[i]))
        entities = [
            fox.SceneEntity(
                timestamp=stamp,
                frame_id=self.root,
                id=name,
                spheres=[sphere(point, 2.5 * thickness, color)],
                arrows=[]
                if np.isnan(rotation).any()
                else [arrow(point, rotation, thickness, color)],
            )
            for name, point, rotation, color in contacts
        ]
        return fox.SceneUpdate(entities=entities).encode()

    def _iterations(self) -> None:
        solve = self.solve
        name = schema_name("iteration", solve.method, solve.layout, len(solve.fingers))
        text = schema_text(solve.layout, solve.labels)
        channel = ros_channel(self.writer, "/ik/iteration", (name, text))
        for i, row in enumerate(solve.rows):
            self._add(channel, i, CDR_HEADER + row.tobytes())

    def _messages(self) -> None:
        solve, last = self.solve, len(self.q) - 1
        lines = [
            (0, fox.LogLevel.Info, f"{solve.method} on {solve.robot}, solve {solve.solve_id + 1}")
        ]
        lines += [(span.first, fox.LogLevel.Info, span.phase) for span in solve.phase_spans]
        lines += [
            (
                event.iteration,
                fox.LogLevel.Warning if event.kind in SERIOUS else fox.LogLevel.Info,
                describe(event),
            )
            for event in solve.events
            if event.kind != "PHASE_CHANGE"
        ]
        level = fox.LogLevel.Info if solve.success else fox.LogLevel.Error
        lines.append((last, level, f"{solve.status} after {solve.iterations} iterations"))
        for i, finger in enumerate(solve.fingers):
            level = fox.LogLevel.Info if solve.ok[i] else fox.LogLevel.Error
            lines.append((last, level, f"{finger} off by {solve.errors_of(i)}"))
        channel = self._protobuf("/ik/messages", fox.Log.get_schema())
        for i, level, text in sorted(lines, key=lambda line: line[0]):
            stamp = timestamp(int(self.times[i]))
            log = fox.Log(timestamp=stamp, level=level, message=text, name=f"iteration {i + 1}")
            self._add(channel, i, log.encode())


def shipped_layout() -> Path:
    """Return the path of the shipped layout file."""
    return models_folder() / "viewer" / "layout.json"


def layout_of(solve: SolveRecord, robot: ArmHand) -> dict[str, Any]:
    """Return the shipped layout with the plots and the fixed frame of a solve.

    Args:
        solve: The solve, whose fields are plotted.
        robot: Robot of the solve.
    """
    layout = json.loads(shipped_layout().read_text(encoding="utf-8"))
    panels = layout["configById"]
    panels["3D!robot"]["followTf"] = robot.description.root
    for name in ("position_error", "angle_error"):
        panels[f"Plot!{name}"]["paths"] = _plot_paths(_plot_lines(solve, name))
    sigmas = [name for name in solve.layout.names if name.startswith("sigma_")]
    panels["Plot!sigma"]["paths"] = _plot_paths(
        line for name in sigmas for line in _plot_lines(solve, name)
    )
    panels["Plot!joints"]["paths"] = _plot_paths(
        (f"/joint_states.position[{i}]", joint)
        for i, joint in enumerate(robot.description.joint_names)
    )
    return layout


def _plot_lines(solve: SolveRecord, name: str) -> list[tuple[str, str]]:
    """Return path and label of a plot line per element of a field."""
    fields = {item.name: item for item in solve.layout}
    if name not in fields:
        return []
    if not fields[name].shape:
        return [(f"/ik/iteration.{name}", name.removeprefix("sigma_"))]
    return [
        (f"/ik/iteration.{name}[{i}]", solve.name_of(name, i)) for i in range(fields[name].size)
    ]


def _plot_paths(lines: Iterable[tuple[str, str]]) -> list[dict[str, Any]]:
    return [
        {
            "value": value,
            "label": label,
            "enabled": True,
            "timestampMethod": "receiveTime",
            "color": palette.LINE_COLORS[i % len(palette.LINE_COLORS)],
        }
        for i, (value, label) in enumerate(lines)
    ]


def timestamp(time: int) -> fox.Timestamp:
    """Return a time stamp from nanoseconds since the Unix epoch."""
    return fox.Timestamp(*divmod(time, 1_000_000_000))


def vector(values: Array) -> fox.Vector3:
    """Return a vector (3,) as a message."""
    x, y, z = values.tolist()
    return fox.Vector3(x=x, y=y, z=z)


def quaternion(values: Array) -> fox.Quaternion:
    """Return a quaternion (4,), scalar last, as a message."""
    x, y, z, w = values.tolist()
    return fox.Quaternion(x=x, y=y, z=z, w=w)


def quaternions_to(normals: Array) -> Array:
    """Return quaternions (k, 4), scalar last, that rotate x to unit vectors (k, 3); NaN for NaN."""
    x, y, z = normals.T
    quaternions = np.stack([0 * x, -z, y, 1 + x], axis=1)
    quaternions[~quaternions.any(axis=1)] = 0, 0, 1, 0
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), np.float64)


def opaque_color(color: str) -> fox.Color:
    """Return an opaque colour as a message."""
    red, green, blue = (part / 255 for part in palette.rgb(color))
    return fox.Color(r=red, g=green, b=blue, a=1.0)


def sphere(point: Array, size: float, color: str) -> fox.SpherePrimitive:
    """Return a sphere at a point, given its diameter [m]."""
    pose = fox.Pose(position=vector(point), orientation=fox.Quaternion(w=1.0))
    return fox.SpherePrimitive(
        pose=pose, size=fox.Vector3(x=size, y=size, z=size), color=opaque_color(color)
    )


def arrow(point: Array, rotation: Array, thickness: float, color: str) -> fox.ArrowPrimitive:
    """Return an arrow along the x axis of its frame."""
    return fox.ArrowPrimitive(
        pose=fox.Pose(position=vector(point), orientation=quaternion(rotation)),
        shaft_length=0.7 * ARROW_LENGTH,
        shaft_diameter=thickness,
        head_length=0.3 * ARROW_LENGTH,
        head_diameter=2.2 * thickness,
        color=opaque_color(color),
    )
