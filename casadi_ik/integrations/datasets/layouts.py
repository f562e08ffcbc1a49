"""Layouts of published data sets of grasps, and conventions of hands.

A convention states the joint names of a hand in a data set, and the pose of its hand frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, InvalidPoseError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import check_unpacked_size
from casadi_ik.files.reading import Frame, Point, Struct, frame_matrix, read
from casadi_ik.files.shipped import resolve_description, shipped_names
from casadi_ik.integrations.datasets.postures import (
    HandPoses,
    rotations_from_columns,
    rotations_from_rpy,
)
from casadi_ik.integrations.datasets.unpickling import PickledArray, read_npy, read_torch
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.joints import joint_motion
from casadi_ik.model.pose import inverse


class HandFrame(Frame, frozen=True, kw_only=True):
    """Pose of the data set's hand frame in the frame of a link of the robot.

    Attributes:
        link: Link of the robot.
        xyz: Origin of the hand frame in the link frame [m].
        rpy: Rotation of the hand frame about the fixed axes of the link frame [rad].
    """

    link: str


class WristJoint(Struct, frozen=True):
    """A joint of the data set between its hand frame and the robot's link.

    Attributes:
        name: Name in the data set.
        axis: Rotation axis in the joint frame.
        xyz: Origin in the hand frame, or in the frame of the previous wrist joint [m].
    """

    name: str
    axis: Point
    xyz: Point = (0.0, 0.0, 0.0)


class ConventionFile(Struct, frozen=True):
    """Convention of a hand in a data set: ``models/datasets/*.yaml``.

    Attributes:
        layouts: Layouts that use the convention.
        description: One sentence.
        source: Source of the convention, and how it was checked.
        frame: Pose of the data set's hand frame.
        joints: Robot joints or motors by name in the data set, in the order of its arrays; a minus
            sign reverses the direction.
        wrist: Joints between the data set's hand frame and `frame`, first in its arrays; they place
            the hand.
    """

    layouts: list[str]
    description: str
    source: str
    frame: HandFrame
    joints: dict[str, str]
    wrist: tuple[WristJoint, ...] = ()


@dataclass(frozen=True, eq=False)
class Convention:
    """Convention by which data of a hand are converted to a robot.

    Attributes:
        name: Name of the convention.
        link: Link of the robot to which the hand frame is attached.
        pose: (4, 4) pose of the hand frame in the link frame.
        joints: Robot joint and sign (1 or -1) by name in the data set, in the order of its arrays.
        wrist: Joints of the data set between its hand frame and the link, first in its arrays.
    """

    name: str
    link: str
    pose: Array
    joints: dict[str, tuple[str, float]]
    wrist: tuple[WristJoint, ...] = ()

    def matches(self, robot: ArmHand) -> bool:
        """Return True if the robot has this hand."""
        description = robot.description
        names = {joint for joint, _ in self.joints.values()}
        robot_names = {*description.joint_names, *description.actuator_names}
        return self.link in description.links and names <= robot_names

    def positions(self, poses: HandPoses) -> dict[str, Array]:
        """Return the positions (k,) of the robot's joints and motors by name.

        Raises:
            DescriptionError: A name is unknown or missing, or the number of joints differs.
        """
        wrist = tuple(joint.name for joint in self.wrist)
        all_names = (*wrist, *self.joints)
        names = poses.names or all_names
        width = poses.joints.shape[1]
        if len(names) != width:
            raise DescriptionError(
                f"{poses.location}: joints: found {width}, expected {len(names)}: "
                f"{', '.join(names)}"
            )
        for name in names:
            if name not in all_names:
                raise DescriptionError(
                    f"{poses.location}: joint {name!r} is unknown; expected one of "
                    f"{', '.join(all_names)}"
                )
        missing = [name for name in all_names if name not in names]
        if missing:
            raise DescriptionError(f"{poses.location}: {missing[0]}: missing, expected a position")
        positions: dict[str, Array] = {}
        for i, name in enumerate(names):
            if name in self.joints:
                joint, sign = self.joints[name]
                positions[joint] = sign * poses.joints[:, i]
        return positions

    def frames(self, hand_poses: HandPoses) -> Array:
        """Return the poses (k, 4, 4) of the robot's link from hand poses and wrist joints."""
        poses, names = (
            hand_poses.poses,
            hand_poses.names or tuple(joint.name for joint in self.wrist),
        )
        for joint in self.wrist:
            wrist_motion = joint_motion(
                "revolute", np.array(joint.axis), hand_poses.joints[:, names.index(joint.name)]
            )
            wrist_motion[:, :3, 3] = joint.xyz
            poses = poses @ wrist_motion
        return poses @ inverse(self.pose)


def load_convention(name_or_path: str | Path) -> Convention:
    """Load a convention by its built-in name or from a file.

    Raises:
        UnknownNameError: There is no built-in convention of that name.
        DescriptionError: The file is missing or malformed.
    """
    path = resolve_description(name_or_path, "datasets")
    entry, _ = read(path, ConventionFile)
    joints: dict[str, tuple[str, float]] = {}
    for name, value in entry.joints.items():
        joint = value.removeprefix("-")
        if joint in (robot_joint for robot_joint, _ in joints.values()):
            raise DescriptionError(f"{path}: joints.{name}: {joint} is named twice")
        joints[name] = joint, -1.0 if value.startswith("-") else 1.0
    return Convention(path.stem, entry.frame.link, frame_matrix(entry.frame), joints, entry.wrist)


def convention_for(robot: ArmHand, layout: str, hand: str | Path | None) -> Convention:
    """Return the convention of a layout for the hand of a robot.

    Args:
        robot: The robot.
        layout: Layout of the file.
        hand: Name or path of a convention; None: the built-in convention for its hand.

    Raises:
        UnsupportedError: No built-in convention is for the robot's hand, or the named one is not.
        UnknownNameError: See `load_convention`.
        DescriptionError: See `load_convention`.
    """
    if hand is not None:
        named = load_convention(hand)
        if not named.matches(robot):
            raise UnsupportedError(
                f"{named.name}: robot {robot.name!r} has no link {named.link!r}, or not its joints"
            )
        return named
    shipped = [name for name in shipped_names("datasets") if layout in _layouts(name)]
    for name in shipped:
        convention = load_convention(name)
        if convention.matches(robot):
            return convention
    raise UnsupportedError(
        f"layout {layout}: robot {robot.name!r} has no hand with a built-in convention; expected "
        f"one of {', '.join(shipped)}, or a convention file with the joint names of its hand"
    )


def convention_of_robot(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """Return the convention of the robot's own joint names and palm frame."""
    description = robot.description
    joints: dict[str, tuple[str, float]] = {name: (name, 1.0) for name in names}
    return Convention(
        robot.name, description.palm_link, np.asarray(description.palm_placement), joints
    )


def _layouts(name: str) -> list[str]:
    entry, _ = read(resolve_description(name, "datasets"), ConventionFile)
    return entry.layouts


STAGES = ("pregrasp", "grasp", "squeeze")
"""Stages of a grasp, in this order."""

TRANSLATION_KEYS, ROTATION_KEYS = ("WRJTx", "WRJTy", "WRJTz"), ("WRJRx", "WRJRy", "WRJRz")
"""Keys of the pose of a hand among the joints of DexGraspNet."""


def getagrip(path: Path, content: Any) -> HandPoses:
    """Read a dictionary of arrays: trans (k, 3), rot (k, 3, 3), joint_angles (k, 16).

    The postures are those before the fingers close.
    """
    location, arrays = str(path), _mapping(path, content)
    position, rotation, joints = (
        numbers(location, arrays, name) for name in ("trans", "rot", "joint_angles")
    )
    return HandPoses(location, position, rotation, joints)


def dexgraspnet(path: Path, content: Any) -> HandPoses:
    """Read a list of dictionaries with qpos: translation, angles about fixed axes, joints.

    Their scale is that of the object's mesh.
    """
    entries = content if isinstance(content, list) else [content]
    if not entries:
        raise DescriptionError(f"{path}: found no grasps, expected at least one")
    rows: list[list[float]] = []
    scales: list[float] = []
    names: tuple[str, ...] = ()
    for i, entry in enumerate(entries):
        location = f"{path}: row {i}"
        qpos = entry.get("qpos") if isinstance(entry, dict) else None
        if not isinstance(qpos, dict):
            raise DescriptionError(f"{location}: qpos: missing, expected numbers by joint")
        for key in (*TRANSLATION_KEYS, *ROTATION_KEYS):
            if key not in qpos:
                raise DescriptionError(f"{location}: qpos.{key}: missing, expected a number")
        if not names:
            names = tuple(
                str(key) for key in qpos if key not in (*TRANSLATION_KEYS, *ROTATION_KEYS)
            )
        order = (*TRANSLATION_KEYS, *ROTATION_KEYS, *names)
        if set(qpos) != set(order):
            unexpected = sorted(map(str, set(qpos) ^ set(order)))[0]
            raise DescriptionError(f"{location}: qpos.{unexpected}: expected the joints of row 0")
        rows.append([_number(f"{location}: qpos.{key}", qpos[key]) for key in order])
        if "scale" in entry:
            scales.append(_scale(location, _number(f"{location}: scale", entry["scale"])))
    if scales and len(scales) != len(rows):
        raise DescriptionError(f"{path}: scale: found {len(scales)}, expected {len(rows)} or none")
    values = np.array(rows)
    return HandPoses(
        str(path),
        values[:, :3],
        rotations_from_rpy(values[:, 3:6]),
        values[:, 6:],
        names,
        scales=tuple(scales),
    )


def bodex(path: Path, content: Any) -> HandPoses:
    """Read robot_pose (1, k, stages, 7 + joints) of a dictionary, poses as x y z, w x y z."""
    location, arrays = str(path), _mapping(path, content)
    rows = numbers(location, arrays, "robot_pose")
    if rows.ndim != 4 or rows.shape[0] != 1 or rows.shape[2] < 2 or rows.shape[3] <= 7:
        raise DescriptionError(
            f"{path}: robot_pose: found shape {rows.shape}, expected (1, k, stages, 7 + joints)"
        )
    stages = {name: rows[0, :, i] for i, name in enumerate(STAGES[: rows.shape[2]])}
    return _poses_of_stages(location, arrays, stages)


def dexgraspbench(path: Path, content: Any) -> HandPoses:
    """Read grasp_qpos (7 + joints) or (k, 7 + joints) of a dictionary, poses as x y z, w x y z.

    pregrasp_qpos and squeeze_qpos have the same shape.
    """
    location, arrays = str(path), _mapping(path, content)
    stages: dict[str, Array] = {}
    for name in STAGES:
        key = f"{name}_qpos"
        if key not in arrays and name != "grasp":
            continue
        rows = np.atleast_2d(numbers(location, arrays, key))
        if rows.ndim != 2 or rows.shape[1] <= 7:
            raise DescriptionError(
                f"{path}: {key}: found shape {rows.shape}, expected (k, 7 + joints)"
            )
        stages[name] = rows
    return _poses_of_stages(location, arrays, stages)


def multidex(path: Path, content: Any) -> HandPoses:
    """Read metadata, a list of (q, object, hand), of a dictionary of torch.

    q: translation (3), first two columns of the rotation (6), joints in the order of the hand.
    """
    location, contents = str(path), _mapping(path, content)
    info, entries = contents.get("info"), contents.get("metadata")
    if isinstance(info, dict) and info and all(isinstance(hand, dict) for hand in info.values()):
        hands = ", ".join(str(hand) for hand in info)
        raise DescriptionError(
            f"{location}: info: found hands {hands}, as D(R,O) Grasp writes them, with rotations as"
            " Euler angles; expected a file of MultiDex (write the rows of a hand into a table)"
        )
    if not isinstance(entries, list) or not entries:
        raise DescriptionError(f"{location}: metadata: expected a list of at least one grasp")
    rows: list[Array] = []
    objects: list[str] = []
    for i, entry in enumerate(entries):
        row = f"{location}: metadata: row {i}"
        if not isinstance(entry, (tuple, list)) or len(entry) < 2 or type(entry[1]) is not str:
            raise DescriptionError(f"{row}: expected q and the name of its object")
        q = numbers(row, {"q": entry[0]}, "q")
        is_valid = q.ndim == 1 and 9 < len(q) <= LIMITS.grasp_numbers
        if not is_valid or (rows and len(q) != len(rows[0])):
            expected = f"({len(rows[0])},)" if rows else "(9 + joints,)"
            raise DescriptionError(f"{row}: q: found shape {q.shape}, expected {expected}")
        rows.append(q)
        objects.append(entry[1])
    values = np.stack(rows)
    rotations = rotations_from_columns(values[:, 3:9])
    return HandPoses(location, values[:, :3], rotations, values[:, 9:], objects=tuple(objects))


LAYOUTS: Mapping[str, Callable[[Path, Any], HandPoses]] = {
    "getagrip": getagrip,
    "dexgraspnet": dexgraspnet,
    "bodex": bodex,
    "dexgraspbench": dexgraspbench,
    "dexonomy": dexgraspbench,
    "multidex": multidex,
}
"""Readers of layouts in npy and torch files, by name."""

READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npy": read_npy,
    ".pt": read_torch,
    ".pth": read_torch,
}
"""Readers of files by suffix."""

LAYOUT_KEYS = {
    "joint_angles": "getagrip",
    "robot_pose": "bodex",
    "grasp_qpos": "dexgraspbench",
    "metadata": "multidex",
}
"""Layouts by the key that identifies them."""


def read_layout(path: Path, layout: str | None) -> tuple[HandPoses, str]:
    """Read the grasps of a file with a suffix in `READERS`, and their layout.

    Args:
        path: Path of the file.
        layout: One of `LAYOUTS`; None: recognised from the keys of the file.

    Raises:
        DescriptionError: The file does not have the layout, or an unknown one.
    """
    content = READERS[path.suffix.lower()](path)
    if layout is None:
        keys = content if isinstance(content, dict) else {}
        layout = next((name for key, name in LAYOUT_KEYS.items() if key in keys), None)
        if isinstance(content, list) or "qpos" in keys:
            layout = "dexgraspnet"
    if layout is None:
        raise DescriptionError(f"{path}: its layout is none of {', '.join(LAYOUTS)}")
    return LAYOUTS[layout](path, content), layout


def numbers(location: str, contents: Mapping[str, Any], key: str) -> Array:
    """Return an array of a file.

    Raises:
        DescriptionError: There is no array of that name, or it is not numeric.
    """
    if key not in contents:
        names = ", ".join(str(name) for name in contents)
        raise DescriptionError(f"{location}: {key}: missing, expected an array; found {names}")
    value = contents[key]
    if isinstance(value, PickledArray):
        value = value.array
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DescriptionError(f"{location}: {key}: expected an array of numbers")
    check_unpacked_size(f"{location}: {key}", 8 * value.size, LIMITS.dataset_bytes)
    return value.astype(np.float64)


def _mapping(path: Path, content: Any) -> Mapping[str, Any]:
    if not isinstance(content, dict):
        raise DescriptionError(f"{path}: expected a dictionary of arrays")
    return content


def _number(location: str, value: Any) -> float:
    if isinstance(value, PickledArray) and value.array is not None and value.array.size == 1:
        value = value.array.item()
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DescriptionError(f"{location}: expected a number")
    return float(value)


def _object_pose(location: str, contents: Mapping[str, Any]) -> Array:
    """Return the pose (4, 4) of the object in the frame of the poses; identity if not stated."""
    if "obj_pose" not in contents:
        return np.eye(4)
    row = numbers(location, contents, "obj_pose").reshape(-1)
    if row.shape != (7,):
        raise DescriptionError(f"{location}: obj_pose: found {row.size} numbers, expected 7")
    pose = HandPoses(
        f"{location}: obj_pose",
        row[None, :3],
        rotations_from_quaternions(row[None, 3:]),
        np.zeros((1, 0)),
    )
    if pose.faults:
        raise InvalidPoseError(f"{location}: obj_pose: {pose.faults[0]}")
    return pose.poses[0]


def _poses_of_stages(
    location: str, contents: Mapping[str, Any], stages: Mapping[str, Array]
) -> HandPoses:
    """Return hand poses from rows (k, 7 + joints) of the stages, poses as x y z, w x y z."""
    shape = stages["grasp"].shape
    object_inverse = inverse(_object_pose(location, contents))
    by_stage: dict[str, HandPoses] = {}
    for name, rows in stages.items():
        if rows.shape != shape:
            raise DescriptionError(
                f"{location}: {name}: found shape {rows.shape}, expected {shape}"
            )
        hand_poses = HandPoses(
            location, rows[:, :3], rotations_from_quaternions(rows[:, 3:7]), rows[:, 7:]
        )
        poses = object_inverse @ hand_poses.poses
        by_stage[name] = replace(hand_poses, position=poses[:, :3, 3], rotation=poses[:, :3, :3])
    scales = _scales(location, contents, len(stages["grasp"]))
    return replace(
        by_stage["grasp"],
        scales=scales,
        pregrasp=by_stage.get("pregrasp"),
        squeeze=by_stage.get("squeeze"),
    )


def _scales(location: str, contents: Mapping[str, Any], count: int) -> tuple[float, ...]:
    """Return the scale of the object of each grasp; empty if not stated."""
    if "obj_scale" not in contents:
        return ()
    value = contents["obj_scale"]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = np.array([value], dtype=float)
    values = numbers(location, {"obj_scale": value}, "obj_scale").reshape(-1)
    if len(values) == count:
        return tuple(_scale(location, value) for value in values)
    if not len(values) or (values != values[0]).any():
        raise DescriptionError(
            f"{location}: obj_scale: found {len(values)} numbers, expected one or {count}"
        )
    return (_scale(location, values[0]),) * count


def _scale(location: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise DescriptionError(f"{location}: scale: found {value:g}, expected a number > 0")
    return float(value)
