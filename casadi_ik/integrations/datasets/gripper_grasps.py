"""Grasps of parallel grippers: a pose and an opening, which any two-finger gripper can take.

Two-finger grippers differ in their base frames and in how far the fingertips move forward as they
close. Grasps are therefore transferred by the grasp frame: its origin is midway between the pads,
z is the approach direction and y the direction in which the pads open.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, UnsupportedError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import READ_ERRORS, check_unpacked_size, npz_names, read_npz
from casadi_ik.files.reading import parse_yaml, read_text
from casadi_ik.integrations.datasets.postures import HandPoses
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.pose import inverse

BASE_TO_PADS = 0.1034
"""Distance from the base of the Panda hand to the middle of the pads, along the approach [m].

Source: `franka_hand.xacro` of franka_ros, frame `hand_tcp`."""

PAD_TO_FINGERTIP = 0.0088
"""Distance from the middle of the pads to the ends of the fingertips [m].

Source: the fingertips of ACRONYM's gripper end 112.2 mm from the base of the Panda hand."""

PANDA_OPENING = 0.08
"""Opening of the Panda hand at the approach of the grasps of ACRONYM [m]."""

WIDTH_TOLERANCE = 2e-3
"""Largest excess of a width over the opening of a gripper that counts as rounding [m]."""

OPENING_SAMPLES = 201
"""Number of motor positions at which the opening of a gripper is computed."""


@dataclass(frozen=True, eq=False)
class JawGrasps:
    """k grasps of a parallel gripper.

    Attributes:
        location: File, for messages.
        frames: (k, 4, 4) grasp frames: midway between the pads, z approaches, y opens.
        widths: (k,) openings between the pads [m]; NaN: the largest opening of the gripper.
        rows: (k,) row numbers in the file.
        scales: Scale of the object of each grasp relative to its mesh; empty: not stated.
    """

    location: str
    frames: Array
    widths: Array
    rows: tuple[int, ...]
    scales: tuple[float, ...] = ()


def read_acronym(path: Path) -> JawGrasps:
    """Read an HDF5 or JSON file of ACRONYM; grasps that failed in its simulation are omitted."""
    if path.suffix.lower() == ".json":
        content = _read_json(path)
        poses, quality = content.get("transforms"), content.get("quality_flex_object_in_gripper")
        scale = content.get("object_scale")
    else:
        poses, quality, scale = _read_hdf5(path)
    transforms = _pose_array(f"{path}: transforms", poses)
    success = np.ones(len(transforms), dtype=bool)
    if quality is not None:
        success = _column(f"{path}: quality", quality, len(transforms)) > 0
    if not success.any():
        raise DescriptionError(f"{path}: found no grasp that succeeded, expected at least one")
    successful = np.flatnonzero(success)
    scales = (
        ()
        if scale is None
        else (float(_column(f"{path}: scale", [scale], 1)[0]),) * len(successful)
    )
    widths = np.full(len(successful), PANDA_OPENING)
    return JawGrasps(
        str(path),
        _panda_grasp_frames(transforms[successful]),
        widths,
        _as_tuple(successful),
        scales,
    )


def read_graspnet(path: Path) -> JawGrasps:
    """Read rows of GraspNet: score, width, height, depth, rotation (9), translation (3), object.

    x approaches and y opens; the fingertips end `depth` in front of the translation.
    """
    rows = _read_npy_table(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise DescriptionError(f"{path}: found shape {rows.shape}, expected (k, 17)")
    rotation = rows[:, 4:13].reshape(-1, 3, 3)
    frames = np.tile(np.eye(4), (len(rows), 1, 1))
    frames[:, :3, :3] = rotation[:, :, [2, 1, 0]] * [-1.0, 1.0, 1.0]
    frames[:, :3, 3] = rows[:, 13:16] + (rows[:, 3:4] - PAD_TO_FINGERTIP) * rotation[:, :, 0]
    return JawGrasps(str(path), frames, rows[:, 1], _as_tuple(np.arange(len(rows))))


POSE_KEYS = ("poses", "transforms", "grasps", "grasp_poses")
WIDTH_KEYS = ("widths", "width", "openings", "opening")


def read_poses(path: Path) -> JawGrasps:
    """Read 4 x 4 poses and widths from an npz or JSON file, in the gripper frame of ACRONYM."""
    content = (
        _read_json(path) if path.suffix.lower() == ".json" else read_npz(path, LIMITS.dataset_bytes)
    )
    name = next((name for name in POSE_KEYS if name in content), "")
    if not name:
        keys = ", ".join(map(str, content)) or "nothing"
        raise DescriptionError(f"{path}: found {keys}, expected one of {', '.join(POSE_KEYS)}")
    transforms = _pose_array(f"{path}: {name}", content[name])
    width = next((name for name in WIDTH_KEYS if name in content), "")
    widths = np.full(len(transforms), np.nan)
    if width:
        widths = _column(f"{path}: {width}", content[width], len(transforms))
    rows = _as_tuple(np.arange(len(transforms)))
    return JawGrasps(str(path), _panda_grasp_frames(transforms), widths, rows)


GRIPPER_READERS: Mapping[str, Callable[[Path], JawGrasps]] = {
    "acronym": read_acronym,
    "graspnet": read_graspnet,
    "poses": read_poses,
}
"""Readers of grasps of parallel grippers, by layout."""

ISAAC_GRASP = "isaac_grasp"
"""Layout of YAML files that Isaac Sim's grasp editor writes; their joints have names."""


def recognise_layout(path: Path) -> str:
    """Return the layout of a file with grasps of a parallel gripper.

    Returns:
        A key of `GRIPPER_READERS`, `ISAAC_GRASP`, or "" for any other file.
    """
    kind = path.suffix.lower()
    if kind in (".h5", ".hdf5"):
        return "acronym"
    if kind == ".json":
        try:
            names = set(_read_json(path))
        except DescriptionError:
            return ""  # another reader reports the problem
        if "quality_flex_object_in_gripper" in names:
            return "acronym"
        return "poses" if names & set(POSE_KEYS) else ""
    if kind in (".yaml", ".yml") and path.is_file():
        content = parse_yaml(path)
        is_isaac = isinstance(content, dict) and content.get("format") == ISAAC_GRASP
        return ISAAC_GRASP if is_isaac else ""
    if kind == ".npz":
        # Of a file that cannot be read another reader reports the problem.
        return "poses" if set(POSE_KEYS) & {*(npz_names(path) or ())} else ""
    if kind == ".npy":
        try:
            shape = np.lib.format.open_memmap(path, mode="r").shape
        except (OSError, *READ_ERRORS):
            return ""
        return "graspnet" if len(shape) == 2 and shape[1] == 17 else ""
    return ""


def read_isaac_grasp(path: Path) -> HandPoses:
    """Read a YAML file of the format isaac_grasp: poses of a gripper's base, and its joints."""
    content = parse_yaml(path)
    grasps = content.get("grasps") if isinstance(content, dict) else None
    if not isinstance(grasps, dict) or not grasps:
        raise DescriptionError(f"{path}: grasps: expected a mapping of at least one grasp")
    entries = list(grasps.items())
    names: tuple[str, ...] = ()
    pose_rows, grasp_rows, pregrasp_rows = (
        list[list[float]](),
        list[list[float]](),
        list[list[float]](),
    )
    for title, entry in entries:
        location = f"{path}: grasps.{title}"
        if not isinstance(entry, dict):
            raise DescriptionError(f"{location}: expected a mapping")
        orientation = entry.get("orientation")
        orientation = orientation if isinstance(orientation, dict) else {}
        numbers = [entry.get("position"), [orientation.get("w")], orientation.get("xyz")]
        pose_rows.append(
            _flat_row(location, numbers, (3, 1, 3), "position, orientation.w and .xyz")
        )
        joints = entry.get("cspace_position")
        if not isinstance(joints, dict) or not joints:
            raise DescriptionError(f"{location}.cspace_position: expected numbers by joint")
        names = names or tuple(map(str, joints))
        pregrasp_joints = entry.get("pregrasp_cspace_position", joints)
        for rows, values in ((grasp_rows, joints), (pregrasp_rows, pregrasp_joints)):
            if not isinstance(values, dict) or set(values) != set(names):
                raise DescriptionError(f"{location}: expected positions of {', '.join(names)}")
            row = [[values[name]] for name in names]
            rows.append(_flat_row(location, row, (1,) * len(names), "positions of joints"))
    values = np.array(pose_rows)
    rotation = rotations_from_quaternions(values[:, 3:])

    def hand_poses(joints: list[list[float]], pregrasp: HandPoses | None) -> HandPoses:
        position = values[:, :3]
        return HandPoses(str(path), position, rotation, np.array(joints), names, pregrasp=pregrasp)

    return hand_poses(grasp_rows, hand_poses(pregrasp_rows, None))


def transfer_to_gripper(grasps: JawGrasps, robot: ArmHand, clip: bool) -> HandPoses:
    """Return grasps transferred to the two-finger gripper of a robot.

    Args:
        grasps: The grasps.
        robot: The robot.
        clip: Whether grasps that are wider than the gripper get its largest opening.

    Returns:
        Poses of the palm frame and positions of the motor, with the names of the robot.

    Raises:
        UnsupportedError: The robot's hand is not a two-finger gripper with one motor.
    """
    description = robot.description
    motors = description.finger_motors
    if len(robot.fingers) != 2 or len(motors) != 1 or robot.sides:
        raise UnsupportedError(
            f"{grasps.location}: grasps of a parallel gripper: robot {robot.name!r} has fingers"
            f" {', '.join(robot.fingers)}; expected two fingers with one motor"
        )
    motor = robot.actuators.index(motors[0])
    samples = np.linspace(robot.lower[motor], robot.upper[motor], OPENING_SAMPLES)
    openings = _openings(robot, motor, samples)
    order = np.argsort(openings)
    smallest, largest = openings[order[[0, -1]]]
    widths = np.where(np.isnan(grasps.widths), largest, grasps.widths)
    positions = np.interp(widths, openings[order], samples[order])
    frames = _grasp_frames(robot, motor, positions)
    palms = grasps.frames @ inverse(frames)
    too_wide = (widths > largest + WIDTH_TOLERANCE) | (widths < -WIDTH_TOLERANCE)
    text = "width: found {:.4g} m, expected {:.3g} to {:.3g} m, the opening range of the gripper"
    faults = {
        grasps.rows[i]: text.format(widths[i], smallest, largest)
        for i in np.flatnonzero(too_wide & (not clip))
    }
    return HandPoses(
        grasps.location,
        palms[:, :3, 3],
        palms[:, :3, :3],
        positions[:, None],
        motors,
        scales=grasps.scales,
        rows=grasps.rows,
        faults=faults,
    )


def _contacts(robot: ArmHand, motor: int, positions: Array) -> tuple[Array, Array]:
    """Return points (k, 2, 3) and normals (k, 2, 3) of the pads in the palm frame."""
    q = np.tile(robot.home, (len(positions), 1))
    q[:, motor] = positions
    points, normals = robot.contacts(q)
    palm_from_base = inverse(robot.palm(q))
    rotation = palm_from_base[:, :3, :3].transpose(0, 2, 1)
    return points @ rotation + palm_from_base[:, None, :3, 3], normals @ rotation


def _openings(robot: ArmHand, motor: int, positions: Array) -> Array:
    points, _ = _contacts(robot, motor, positions)
    return np.linalg.norm(points[:, 0] - points[:, 1], axis=1)


def _grasp_frames(robot: ArmHand, motor: int, positions: Array) -> Array:
    """Return grasp frames (k, 4, 4) in the palm frame, whose z axis is along the fingers."""
    points, normals = _contacts(robot, motor, positions)
    frames = np.tile(np.eye(4), (len(positions), 1, 1))
    # Unlike the points, the normals give the opening direction even if the pads touch.
    y = normals[:, 1] - normals[:, 0]
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.array([0.0, 0.0, 1.0]) - y[:, 2:3] * y
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    frames[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    frames[:, :3, 3] = points.mean(axis=1)
    return frames


def _panda_grasp_frames(transforms: Array) -> Array:
    """Return grasp frames of grippers with the base frame of ACRONYM: z approaches, x opens."""
    frames = transforms.copy()
    frames[:, :3, 0], frames[:, :3, 1] = -transforms[:, :3, 1], transforms[:, :3, 0]
    frames[:, :3, 3] += BASE_TO_PADS * transforms[:, :3, 2]
    return frames


def _pose_array(location: str, value: Any) -> Array:
    """Return poses (k, 4, 4) of a data set, at least one."""
    try:
        transforms = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        transforms = np.zeros(0)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not len(transforms):
        raise DescriptionError(f"{location}: found shape {transforms.shape}, expected (k, 4, 4)")
    check_unpacked_size(location, 8 * transforms.size, LIMITS.dataset_bytes)
    return transforms


def _column(location: str, value: Any, count: int) -> Array:
    """Return `count` numbers of a data set."""
    try:
        column = np.asarray(value, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        column = np.zeros(0)
    if len(column) != count:
        raise DescriptionError(f"{location}: found {len(column)} numbers, expected {count}")
    return column


def _flat_row(
    location: str, parts: list[Any], sizes: tuple[int, ...], expected: str
) -> list[float]:
    """Return the numbers of lists with the given sizes as one list."""
    numbers: list[float] = []
    for part, size in zip(parts, sizes, strict=True):
        values = part if isinstance(part, list) else []
        if len(values) != size or not all(type(value) in (int, float) for value in values):
            raise DescriptionError(f"{location}: expected numbers for {expected}")
        numbers += map(float, values)
    return numbers


def _as_tuple(rows: np.ndarray) -> tuple[int, ...]:
    return tuple(rows.tolist())


def _read_json(path: Path) -> Mapping[str, Any]:
    """Return the mapping of a JSON file."""
    try:
        content = json.loads(read_text(path, LIMITS.table_bytes))
    except (ValueError, RecursionError) as error:
        raise DescriptionError(f"{path}: file is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise DescriptionError(f"{path}: expected a mapping of poses and widths")
    return content


def _read_npy_table(path: Path) -> Array:
    """Return the rows of an npy file."""
    try:
        rows = np.lib.format.open_memmap(path, mode="r")
    except (OSError, *READ_ERRORS) as error:
        raise DescriptionError(f"{path}: cannot be read: {error}") from error
    check_unpacked_size(str(path), 8 * rows.size, LIMITS.dataset_bytes)
    if rows.dtype.kind not in "fiu":
        raise DescriptionError(f"{path}: found values of type {rows.dtype}, expected numbers")
    return np.array(rows, dtype=float)


def _read_hdf5(path: Path) -> tuple[Any, Any, Any]:
    """Return transforms, success and scale of an HDF5 file of ACRONYM."""
    with optional_import(f"{path}: HDF5 files"):
        library: Any = importlib.import_module("h5py")
    try:
        with library.File(path, "r") as file:
            for name in ("grasps/transforms", "grasps/qualities/flex/object_in_gripper"):
                if name in file:
                    check_unpacked_size(
                        f"{path}: {name}", 8 * file[name].size, LIMITS.dataset_bytes
                    )
            transforms = file["grasps/transforms"][()]
            quality = file.get("grasps/qualities/flex/object_in_gripper")
            scale = file.get("object/scale")
            success = None if quality is None else quality[()]
            return transforms, success, None if scale is None else scale[()]
    except (OSError, KeyError, AttributeError, *READ_ERRORS) as error:
        reason = " ".join(str(error).split())
        raise DescriptionError(f"{path}: file is not of ACRONYM: {reason}") from error
