"""The layouts of other people's grasps: what stands where in their files.

A convention says what a data set calls a hand's joints, and where it has the hand's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, InvalidPoseError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import check_unpacked_size
from casadi_ik.files.reading import Frame, Point, Struct, frame_matrix, read
from casadi_ik.files.shipped import resolve_description, shipped_names
from casadi_ik.integrations.datasets.postures import HandPoses, of_fixed_axes, of_two_columns
from casadi_ik.integrations.datasets.unpickling import Packed, read_npy, read_torch
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.linkage import joint_motion
from casadi_ik.model.pose import inverse


class HandFrame(Frame, frozen=True, kw_only=True):
    """Where the data set's frame of the hand is, in the frame of one of the robot's links.

    Attributes:
        link: The robot's link.
        xyz: Origin of the data set's frame in the link's [m].
        rpy: Its axes, turned about the fixed axes of the link's frame [rad].
    """

    link: str


class WristJoint(Struct, frozen=True):
    """A joint of the data set's hand before the robot's link.

    Attributes:
        name: The data set's.
        axis: It turns about, in its own frame.
        xyz: Its origin in the frame before: the data set's, or that of the joint before [m].
    """

    name: str
    axis: Point
    xyz: Point = (0.0, 0.0, 0.0)


class ConventionFile(Struct, frozen=True):
    """How a data set has a hand: ``models/datasets/*.yaml``.

    Attributes:
        layouts: In which layouts.
        description: One sentence.
        source: Where that is from, and how it was checked.
        frame: Where the data set's frame of the hand is.
        joints: The data set's names, in the order of its arrays, and the robot's joints or motors;
            a minus sign before one: it turns the other way.
        wrist: Joints between the data set's frame and `frame`, before the others in its arrays:
            they place the hand, and are not asked for.
    """

    layouts: list[str]
    description: str
    source: str
    frame: HandFrame
    joints: dict[str, str]
    wrist: tuple[WristJoint, ...] = ()


@dataclass(frozen=True, eq=False)
class Convention:
    """How the data of a hand are read as those of a robot's.

    Attributes:
        name: Where it is written down.
        link: The robot's link in whose frame the data set's frame is.
        pose: (4, 4) of that frame in the link's.
        joints: Names of the data set, in the order of its arrays: the robot's joint, and 1 or -1.
        wrist: Joints of the data set before the link, before the others in its arrays.
    """

    name: str
    link: str
    pose: Array
    joints: dict[str, tuple[str, float]]
    wrist: tuple[WristJoint, ...] = ()

    def fits(self, robot: ArmHand) -> bool:
        """Whether the robot has this hand."""
        description = robot.description
        names = {joint for joint, _ in self.joints.values()}
        known = {*description.joint_names, *description.actuator_names}
        return self.link in description.links and names <= known

    def positions(self, given: HandPoses) -> dict[str, Array]:
        """Positions (k,) of the robot's joints and motors, by name.

        Raises:
            DescriptionError: Names that the data set does not have, or another number of joints.
        """
        wrist = tuple(one.name for one in self.wrist)
        every = (*wrist, *self.joints)
        names = given.names or every
        width = given.joints.shape[1]
        if len(names) != width:
            raise DescriptionError(
                f"{given.where}: joints: found {width}, expected {len(names)}: {', '.join(names)}"
            )
        for name in names:
            if name not in every:
                raise DescriptionError(
                    f"{given.where}: {name}: no such joint, expected {', '.join(every)}"
                )
        missing = [name for name in every if name not in names]
        if missing:
            raise DescriptionError(f"{given.where}: {missing[0]}: missing, expected a position")
        found: dict[str, Array] = {}
        for i, name in enumerate(names):
            if name in self.joints:
                joint, sign = self.joints[name]
                found[joint] = sign * given.joints[:, i]
        return found

    def frames(self, given: HandPoses) -> Array:
        """(k, 4, 4) poses of the robot's link that the data's poses, and their wrists, give."""
        poses, names = given.poses, given.names or tuple(one.name for one in self.wrist)
        for one in self.wrist:
            moved = joint_motion(
                "revolute", np.array(one.axis), given.joints[:, names.index(one.name)]
            )
            moved[:, :3, 3] = one.xyz
            poses = poses @ moved
        return poses @ inverse(self.pose)


def load_convention(name_or_path: str | Path) -> Convention:
    """A convention: a shipped one by name, or a file of one's own.

    Raises:
        UnknownNameError: No shipped convention has that name.
        DescriptionError: The file is missing or malformed.
    """
    path = resolve_description(name_or_path, "datasets")
    entry, _ = read(path, ConventionFile)
    joints: dict[str, tuple[str, float]] = {}
    for name, said in entry.joints.items():
        joint = said.removeprefix("-")
        if joint in (other for other, _ in joints.values()):
            raise DescriptionError(f"{path}: joints.{name}: {joint} is named twice")
        joints[name] = joint, -1.0 if said.startswith("-") else 1.0
    return Convention(path.stem, entry.frame.link, frame_matrix(entry.frame), joints, entry.wrist)


def convention_for(robot: ArmHand, layout: str, hand: str | Path | None) -> Convention:
    """The convention of a layout for the hand of a robot.

    Args:
        robot: The robot.
        layout: Of the file.
        hand: A convention by name or path; None: the shipped one that fits.

    Raises:
        UnsupportedError: None is shipped that fits, or the one that is named does not.
        UnknownNameError: See `load_convention`.
        DescriptionError: See there.
    """
    if hand is not None:
        named = load_convention(hand)
        if not named.fits(robot):
            raise UnsupportedError(
                f"{named.name}: robot {robot.name!r} has no link {named.link!r}, or not its joints"
            )
        return named
    shipped = [name for name in shipped_names("datasets") if layout in _layouts(name)]
    for name in shipped:
        found = load_convention(name)
        if found.fits(robot):
            return found
    raise UnsupportedError(
        f"layout {layout}: no hand of it is that of robot {robot.name!r}; known: "
        f"{', '.join(shipped)} (or say by a file of your own what its joints are called)"
    )


def of_robot(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """The convention of a table that uses the robot's own names, and its palm frame."""
    description = robot.description
    joints: dict[str, tuple[str, float]] = {name: (name, 1.0) for name in names}
    return Convention(
        robot.name, description.palm_link, np.asarray(description.palm_placement), joints
    )


def _layouts(name: str) -> list[str]:
    entry, _ = read(resolve_description(name, "datasets"), ConventionFile)
    return entry.layouts


STAGES = ("pregrasp", "grasp", "squeeze")
"""Of a grasp, in this order."""

TRANSLATION, TURN = ("WRJTx", "WRJTy", "WRJTz"), ("WRJRx", "WRJRy", "WRJRz")
"""Where DexGraspNet has the pose of a hand among its joints."""


def getagrip(path: Path, content: Any) -> HandPoses:
    """A dictionary of arrays: trans (k, 3), rot (k, 3, 3), joint_angles (k, 16).

    Postures are those before the fingers close.
    """
    where, found = str(path), _mapping(path, content)
    position, rotation, joints = (
        numbers(where, found, name) for name in ("trans", "rot", "joint_angles")
    )
    return HandPoses(where, position, rotation, joints)


def dexgraspnet(path: Path, content: Any) -> HandPoses:
    """A list of dictionaries with qpos: translation, angles about fixed axes, joints by name.

    Their scale is that of the object's mesh.
    """
    entries = content if isinstance(content, list) else [content]
    if not entries:
        raise DescriptionError(f"{path}: found no grasps, expected at least one")
    rows: list[list[float]] = []
    scales: list[float] = []
    names: tuple[str, ...] = ()
    for i, entry in enumerate(entries):
        where = f"{path}: row {i}"
        qpos = entry.get("qpos") if isinstance(entry, dict) else None
        if not isinstance(qpos, dict):
            raise DescriptionError(f"{where}: qpos: missing, expected numbers by joint")
        for key in (*TRANSLATION, *TURN):
            if key not in qpos:
                raise DescriptionError(f"{where}: qpos.{key}: missing, expected a number")
        if not names:
            names = tuple(str(key) for key in qpos if key not in (*TRANSLATION, *TURN))
        order = (*TRANSLATION, *TURN, *names)
        if set(qpos) != set(order):
            odd = sorted(map(str, set(qpos) ^ set(order)))[0]
            raise DescriptionError(f"{where}: qpos.{odd}: expected the joints of row 0")
        rows.append([_number(f"{where}: qpos.{key}", qpos[key]) for key in order])
        if "scale" in entry:
            scales.append(_scale(where, _number(f"{where}: scale", entry["scale"])))
    if scales and len(scales) != len(rows):
        raise DescriptionError(f"{path}: scale: found {len(scales)}, expected {len(rows)} or none")
    values = np.array(rows)
    return HandPoses(
        str(path),
        values[:, :3],
        of_fixed_axes(values[:, 3:6]),
        values[:, 6:],
        names,
        scales=tuple(scales),
    )


def bodex(path: Path, content: Any) -> HandPoses:
    """A dictionary: robot_pose (1, k, stages, 7 + joints), the pose as x y z, w x y z."""
    where, found = str(path), _mapping(path, content)
    rows = numbers(where, found, "robot_pose")
    if rows.ndim != 4 or rows.shape[0] != 1 or rows.shape[2] < 2 or rows.shape[3] <= 7:
        raise DescriptionError(
            f"{path}: robot_pose: found shape {rows.shape}, expected (1, k, stages, 7 + joints)"
        )
    stages = {name: rows[0, :, i] for i, name in enumerate(STAGES[: rows.shape[2]])}
    return _of_stages(where, found, stages)


def dexgraspbench(path: Path, content: Any) -> HandPoses:
    """A dictionary: grasp_qpos (7 + joints) or (k, 7 + joints), the pose as x y z, w x y z.

    Beside it, in the same shape, pregrasp_qpos and squeeze_qpos.
    """
    where, found = str(path), _mapping(path, content)
    stages: dict[str, Array] = {}
    for name in STAGES:
        key = f"{name}_qpos"
        if key not in found and name != "grasp":
            continue
        rows = np.atleast_2d(numbers(where, found, key))
        if rows.ndim != 2 or rows.shape[1] <= 7:
            raise DescriptionError(
                f"{path}: {key}: found shape {rows.shape}, expected (k, 7 + joints)"
            )
        stages[name] = rows
    return _of_stages(where, found, stages)


def multidex(path: Path, content: Any) -> HandPoses:
    """A dictionary of torch: metadata, a list of (q, object, hand), where the file has several.

    q: translation (3), the first two columns of the rotation (6), joints in the order of the hand.
    """
    where, found = str(path), _mapping(path, content)
    info, entries = found.get("info"), found.get("metadata")
    if isinstance(info, dict) and info and all(isinstance(hand, dict) for hand in info.values()):
        hands = ", ".join(str(hand) for hand in info)
        raise DescriptionError(
            f"{where}: info: found hands {hands}, as D(R,O) Grasp writes them, with rotations as"
            " Euler angles; expected a file of MultiDex (write the rows of a hand into a table)"
        )
    if not isinstance(entries, list) or not entries:
        raise DescriptionError(f"{where}: metadata: expected a list of at least one grasp")
    rows: list[Array] = []
    objects: list[str] = []
    for i, entry in enumerate(entries):
        row = f"{where}: metadata: row {i}"
        if not isinstance(entry, (tuple, list)) or len(entry) < 2 or type(entry[1]) is not str:
            raise DescriptionError(f"{row}: expected q and the name of its object")
        q = numbers(row, {"q": entry[0]}, "q")
        sound = q.ndim == 1 and 9 < len(q) <= LIMITS.grasp_numbers
        if not sound or (rows and len(q) != len(rows[0])):
            expected = f"({len(rows[0])},)" if rows else "(9 + joints,)"
            raise DescriptionError(f"{row}: q: found shape {q.shape}, expected {expected}")
        rows.append(q)
        objects.append(entry[1])
    values = np.stack(rows)
    turns = of_two_columns(values[:, 3:9])
    return HandPoses(where, values[:, :3], turns, values[:, 9:], objects=tuple(objects))


LAYOUTS: Mapping[str, Callable[[Path, Any], HandPoses]] = {
    "getagrip": getagrip,
    "dexgraspnet": dexgraspnet,
    "bodex": bodex,
    "dexgraspbench": dexgraspbench,
    "dexonomy": dexgraspbench,
    "multidex": multidex,
}
"""Of npy files and those of torch, by name."""

READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npy": read_npy,
    ".pt": read_torch,
    ".pth": read_torch,
}
"""What reads a file, by its ending."""

MARKS = {
    "joint_angles": "getagrip",
    "robot_pose": "bodex",
    "grasp_qpos": "dexgraspbench",
    "metadata": "multidex",
}
"""Keys that tell layouts from one another."""


def read_layout(path: Path, layout: str | None) -> tuple[HandPoses, str]:
    """Grasps of a file that ends as one of `READERS`, and their layout.

    Args:
        path: The file.
        layout: One of `LAYOUTS`; None: told from the file's keys.

    Raises:
        DescriptionError: It is not of the layout, or of none.
    """
    content = READERS[path.suffix.lower()](path)
    if layout is None:
        keys = content if isinstance(content, dict) else {}
        layout = next((found for mark, found in MARKS.items() if mark in keys), None)
        if isinstance(content, list) or "qpos" in keys:
            layout = "dexgraspnet"
    if layout is None:
        raise DescriptionError(f"{path}: its layout is none of {', '.join(LAYOUTS)}")
    return LAYOUTS[layout](path, content), layout


def numbers(where: str, found: Mapping[str, Any], key: str) -> Array:
    """An array of a file.

    Raises:
        DescriptionError: There is none of that name, or one of other things than numbers.
    """
    if key not in found:
        known = ", ".join(str(name) for name in found)
        raise DescriptionError(f"{where}: {key}: missing, expected an array; found {known}")
    value = found[key]
    if isinstance(value, Packed):
        value = value.value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DescriptionError(f"{where}: {key}: expected an array of numbers")
    check_unpacked_size(f"{where}: {key}", 8 * value.size, LIMITS.dataset_bytes)
    return value.astype(np.float64)


def _mapping(path: Path, content: Any) -> Mapping[str, Any]:
    if not isinstance(content, dict):
        raise DescriptionError(f"{path}: found no dictionary of arrays, expected one")
    return content


def _number(where: str, value: Any) -> float:
    if isinstance(value, Packed) and value.value is not None and value.value.size == 1:
        value = value.value.item()
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DescriptionError(f"{where}: expected a number")
    return float(value)


def _object_pose(where: str, found: Mapping[str, Any]) -> Array:
    """(4, 4) where the object is in the frame of the poses; where none is said, in its origin."""
    if "obj_pose" not in found:
        return np.eye(4)
    row = numbers(where, found, "obj_pose").reshape(-1)
    if row.shape != (7,):
        raise DescriptionError(f"{where}: obj_pose: found {row.size} numbers, expected 7")
    held = HandPoses(
        f"{where}: obj_pose",
        row[None, :3],
        rotations_from_quaternions(row[None, 3:]),
        np.zeros((1, 0)),
    )
    if held.faults:
        raise InvalidPoseError(f"{where}: obj_pose: {held.faults[0]}")
    return held.poses[0]


def _of_stages(where: str, found: Mapping[str, Any], stages: Mapping[str, Array]) -> HandPoses:
    """Rows (k, 7 + joints) of the stages, with poses as x y z, w x y z."""
    shape = stages["grasp"].shape
    back = inverse(_object_pose(where, found))
    made: dict[str, HandPoses] = {}
    for name, rows in stages.items():
        if rows.shape != shape:
            raise DescriptionError(f"{where}: {name}: found shape {rows.shape}, expected {shape}")
        given = HandPoses(where, rows[:, :3], rotations_from_quaternions(rows[:, 3:7]), rows[:, 7:])
        poses = back @ given.poses
        made[name] = replace(given, position=poses[:, :3, 3], rotation=poses[:, :3, :3])
    scales = _scales(where, found, len(stages["grasp"]))
    return replace(
        made["grasp"], scales=scales, pregrasp=made.get("pregrasp"), squeeze=made.get("squeeze")
    )


def _scales(where: str, found: Mapping[str, Any], count: int) -> tuple[float, ...]:
    """Of the object of each grasp; none where none is said."""
    if "obj_scale" not in found:
        return ()
    value = found["obj_scale"]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = np.array([value], dtype=float)
    values = numbers(where, {"obj_scale": value}, "obj_scale").reshape(-1)
    if len(values) == count:
        return tuple(_scale(where, one) for one in values)
    if not len(values) or (values != values[0]).any():
        raise DescriptionError(
            f"{where}: obj_scale: found {len(values)} numbers, expected one or {count}"
        )
    return (_scale(where, values[0]),) * count


def _scale(where: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise DescriptionError(f"{where}: scale: found {value:g}, expected a number > 0")
    return float(value)
