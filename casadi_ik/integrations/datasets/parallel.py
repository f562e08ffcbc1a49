"""Grasps of parallel grippers: a pose and an opening, which any two-finger gripper can take.

Two-finger grippers differ in where the base is and in how far the fingertips move forward as they
close. A grasp is therefore carried over by its grasp frame, which all of them have: its origin is
midway between the pads, z is the approach direction and y the direction in which the pads open.
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
from casadi_ik.files.input_checks.poses import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.number_files import READ_ERRORS, check_unpacked_size, read_npz
from casadi_ik.files.reading import parse_yaml, read_text
from casadi_ik.integrations.datasets.postures import HandPoses
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.pose import inverse

PAD_DISTANCE = 0.1034
"""Distance of the pads' middle from the base of the Panda hand, along the approach [m].

Source: `franka_hand.xacro` of franka_ros, frame `hand_tcp`."""

FINGERTIP = 0.0088
"""Distance of the fingertips' ends beyond the pads' middle [m].

Source: the fingertips of ACRONYM's gripper end 112.2 mm from the base of the Panda hand."""

PANDA_OPENING = 0.08
"""Opening of the Panda hand [m], with which the grasps of ACRONYM approach."""

SLACK = 2e-3
"""Excess of a width over the largest opening of a gripper that is taken for rounding [m]."""

OPENING_SAMPLES = 201
"""Positions of the motor at which the opening of a gripper is computed."""


@dataclass(frozen=True, eq=False)
class JawGrasps:
    """k grasps of a parallel gripper.

    Attributes:
        where: File, for messages.
        frames: (k, 4, 4) grasp frames: midway between the pads, z approaches, y opens.
        widths: (k,) openings between the pads [m]; NaN: as wide as the gripper opens.
        rows: (k,) numbers of the grasps in the file.
        scales: Factor by which the object is larger than its mesh; empty: not stated.
    """

    where: str
    frames: Array
    widths: Array
    rows: tuple[int, ...]
    scales: tuple[float, ...] = ()


def acronym(path: Path) -> JawGrasps:
    """Read an HDF5 or JSON file of ACRONYM; grasps that failed in its simulation are left out."""
    if path.suffix.lower() == ".json":
        content = _json(path)
        poses, quality = content.get("transforms"), content.get("quality_flex_object_in_gripper")
        scale = content.get("object_scale")
    else:
        poses, quality, scale = _read_hdf5(path)
    transforms = _poses(f"{path}: transforms", poses)
    success = np.ones(len(transforms), dtype=bool)
    if quality is not None:
        success = _column(f"{path}: quality", quality, len(transforms)) > 0
    if not success.any():
        raise DescriptionError(f"{path}: found no grasp that succeeded, expected at least one")
    kept = np.flatnonzero(success)
    scales = () if scale is None else (float(_column(f"{path}: scale", [scale], 1)[0]),) * len(kept)
    widths = np.full(len(kept), PANDA_OPENING)
    return JawGrasps(str(path), _of_panda(transforms[kept]), widths, _numbers(kept), scales)


def graspnet(path: Path) -> JawGrasps:
    """Read rows of GraspNet: score, width, height, depth, rotation (9), translation (3), object.

    x approaches and y opens; the fingertips end `depth` in front of the translation.
    """
    rows = _load_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise DescriptionError(f"{path}: found shape {rows.shape}, expected (k, 17)")
    rotation = rows[:, 4:13].reshape(-1, 3, 3)
    frames = np.tile(np.eye(4), (len(rows), 1, 1))
    frames[:, :3, :3] = rotation[:, :, [2, 1, 0]] * [-1.0, 1.0, 1.0]
    frames[:, :3, 3] = rows[:, 13:16] + (rows[:, 3:4] - FINGERTIP) * rotation[:, :, 0]
    return JawGrasps(str(path), frames, rows[:, 1], _numbers(np.arange(len(rows))))


POSES = ("poses", "transforms", "grasps", "grasp_poses")
WIDTH_KEYS = ("widths", "width", "openings", "opening")


def poses(path: Path) -> JawGrasps:
    """Read 4 x 4 poses and widths from an npz or JSON file, in the gripper frame of ACRONYM."""
    content = _json(path) if path.suffix.lower() == ".json" else _arrays(path)
    name = next((name for name in POSES if name in content), "")
    if not name:
        known = ", ".join(map(str, content)) or "nothing"
        raise DescriptionError(f"{path}: found {known}, expected one of {', '.join(POSES)}")
    transforms = _poses(f"{path}: {name}", content[name])
    width = next((name for name in WIDTH_KEYS if name in content), "")
    widths = np.full(len(transforms), np.nan)
    if width:
        widths = _column(f"{path}: {width}", content[width], len(transforms))
    rows = _numbers(np.arange(len(transforms)))
    return JawGrasps(str(path), _of_panda(transforms), widths, rows)


PARALLEL: Mapping[str, Callable[[Path], JawGrasps]] = {
    "acronym": acronym,
    "graspnet": graspnet,
    "poses": poses,
}
"""Readers of grasps of parallel grippers, by layout."""

ISAAC_GRASP = "isaac_grasp"
"""Layout of YAML files that Isaac Sim's grasp editor writes; their joints have names."""


def parallel_layout(path: Path) -> str:
    """Return the layout of a file with grasps of a parallel gripper, told from the file.

    Returns:
        A key of `PARALLEL`, `ISAAC_GRASP`, or "" for any other file.
    """
    kind = path.suffix.lower()
    if kind in (".h5", ".hdf5"):
        return "acronym"
    if kind == ".json":
        try:
            names = set(_json(path))
        except DescriptionError:
            return ""  # another reader names what is wrong with the file
        if "quality_flex_object_in_gripper" in names:
            return "acronym"
        return "poses" if names & set(POSES) else ""
    if kind in (".yaml", ".yml") and path.is_file():
        content = parse_yaml(path)
        is_isaac = isinstance(content, dict) and content.get("format") == ISAAC_GRASP
        return ISAAC_GRASP if is_isaac else ""
    if kind == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                return "poses" if set(POSES) & set(archive.files) else ""
        except (OSError, ValueError, EOFError, KeyError):
            return ""  # another reader names what is wrong with the file
    if kind == ".npy":
        try:
            shape = np.lib.format.open_memmap(path, mode="r").shape
        except (OSError, *READ_ERRORS):
            return ""
        return "graspnet" if len(shape) == 2 and shape[1] == 17 else ""
    return ""


def isaac_grasp(path: Path) -> HandPoses:
    """Read a YAML file of the format isaac_grasp: poses of a gripper's base, and its joints."""
    content = parse_yaml(path)
    grasps = content.get("grasps") if isinstance(content, dict) else None
    if not isinstance(grasps, dict) or not grasps:
        raise DescriptionError(f"{path}: grasps: expected a mapping of at least one grasp")
    entries = list(grasps.items())
    names: tuple[str, ...] = ()
    pose_rows, closed, opened = list[list[float]](), list[list[float]](), list[list[float]]()
    for title, entry in entries:
        where = f"{path}: grasps.{title}"
        if not isinstance(entry, dict):
            raise DescriptionError(f"{where}: expected a mapping")
        turn = entry.get("orientation")
        turn = turn if isinstance(turn, dict) else {}
        numbers = [entry.get("position"), [turn.get("w")], turn.get("xyz")]
        pose_rows.append(_flat(where, numbers, (3, 1, 3), "position, orientation.w and .xyz"))
        joints = entry.get("cspace_position")
        if not isinstance(joints, dict) or not joints:
            raise DescriptionError(f"{where}.cspace_position: expected numbers by joint")
        names = names or tuple(map(str, joints))
        before = entry.get("pregrasp_cspace_position", joints)
        for rows, values in ((closed, joints), (opened, before)):
            if not isinstance(values, dict) or set(values) != set(names):
                raise DescriptionError(f"{where}: expected positions of {', '.join(names)}")
            row = [[values[name]] for name in names]
            rows.append(_flat(where, row, (1,) * len(names), "positions of joints"))
    values = np.array(pose_rows)
    rotation = rotations_from_quaternions(values[:, 3:])

    def stage(joints: list[list[float]], pregrasp: HandPoses | None) -> HandPoses:
        place = values[:, :3]
        return HandPoses(str(path), place, rotation, np.array(joints), names, pregrasp=pregrasp)

    return stage(closed, stage(opened, None))


def for_gripper(given: JawGrasps, robot: ArmHand, clip: bool) -> HandPoses:
    """Carry grasps over to a robot's two-finger gripper.

    Args:
        given: The grasps.
        robot: The robot.
        clip: Open as wide as possible where a grasp is wider than the gripper.

    Returns:
        Poses of the palm frame and positions of the motor, by the robot's own names.

    Raises:
        UnsupportedError: The robot's hand is not a two-finger gripper with one motor.
    """
    description = robot.description
    motors = description.finger_motors
    if len(robot.fingers) != 2 or len(motors) != 1 or robot.sides:
        raise UnsupportedError(
            f"{given.where}: grasps of a parallel gripper: robot {robot.name!r} has fingers"
            f" {', '.join(robot.fingers)}; expected two, moved by one motor"
        )
    motor = robot.actuators.index(motors[0])
    samples = np.linspace(robot.lower[motor], robot.upper[motor], OPENING_SAMPLES)
    openings = _openings(robot, motor, samples)
    order = np.argsort(openings)
    smallest, largest = openings[order[[0, -1]]]
    wanted = np.where(np.isnan(given.widths), largest, given.widths)
    positions = np.interp(wanted, openings[order], samples[order])
    frames = _grasp_frames(robot, motor, positions)
    palms = given.frames @ inverse(frames)
    too_wide = (wanted > largest + SLACK) | (wanted < -SLACK)
    text = "width: found {:.4g} m, expected {:.3g} to {:.3g} m, which the gripper opens"
    faults = {
        given.rows[i]: text.format(wanted[i], smallest, largest)
        for i in np.flatnonzero(too_wide & (not clip))
    }
    return HandPoses(
        given.where,
        palms[:, :3, 3],
        palms[:, :3, :3],
        positions[:, None],
        motors,
        scales=given.scales,
        rows=given.rows,
        faults=faults,
    )


def _contacts(robot: ArmHand, motor: int, positions: Array) -> tuple[Array, Array]:
    """Pads' points (k, 2, 3) and normals (k, 2, 3) in the palm frame."""
    q = np.tile(robot.home, (len(positions), 1))
    q[:, motor] = positions
    points, normals = robot.contacts(q)
    back = inverse(robot.palm(q))
    rotation = back[:, :3, :3].transpose(0, 2, 1)
    return points @ rotation + back[:, None, :3, 3], normals @ rotation


def _openings(robot: ArmHand, motor: int, positions: Array) -> Array:
    points, _ = _contacts(robot, motor, positions)
    return np.linalg.norm(points[:, 0] - points[:, 1], axis=1)


def _grasp_frames(robot: ArmHand, motor: int, positions: Array) -> Array:
    """(k, 4, 4) grasp frames in the palm frame, whose z axis is along the fingers."""
    points, normals = _contacts(robot, motor, positions)
    frames = np.tile(np.eye(4), (len(positions), 1, 1))
    # The pads face each other: the normals tell the direction where the pads touch, too.
    y = normals[:, 1] - normals[:, 0]
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.array([0.0, 0.0, 1.0]) - y[:, 2:3] * y
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    frames[:, :3, :3] = np.stack([np.cross(y, z), y, z], axis=2)
    frames[:, :3, 3] = points.mean(axis=1)
    return frames


def _of_panda(transforms: Array) -> Array:
    """Grasp frames of grippers whose base is that of ACRONYM: z approaches and x opens."""
    frames = transforms.copy()
    frames[:, :3, 0], frames[:, :3, 1] = -transforms[:, :3, 1], transforms[:, :3, 0]
    frames[:, :3, 3] += PAD_DISTANCE * transforms[:, :3, 2]
    return frames


def _poses(where: str, value: Any) -> Array:
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.ndim != 3 or found.shape[1:] != (4, 4) or not len(found):
        raise DescriptionError(f"{where}: found shape {found.shape}, expected (k, 4, 4)")
    check_unpacked_size(where, 8 * found.size, LIMITS.dataset_bytes)
    return found


def _column(where: str, value: Any, count: int) -> Array:
    try:
        found = np.asarray(value, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if len(found) != count:
        raise DescriptionError(f"{where}: found {len(found)} numbers, expected {count}")
    return found


def _flat(where: str, parts: list[Any], sizes: tuple[int, ...], expected: str) -> list[float]:
    numbers: list[float] = []
    for part, size in zip(parts, sizes, strict=True):
        values = part if isinstance(part, list) else []
        if len(values) != size or not all(type(value) in (int, float) for value in values):
            raise DescriptionError(f"{where}: expected numbers for {expected}")
        numbers += map(float, values)
    return numbers


def _numbers(rows: np.ndarray) -> tuple[int, ...]:
    return tuple(rows.tolist())


def _json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(read_text(path, LIMITS.table_bytes))
    except (ValueError, RecursionError) as error:
        raise DescriptionError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict):
        raise DescriptionError(f"{path}: expected a mapping of poses and widths")
    return content


def _arrays(path: Path) -> Mapping[str, Array]:
    return read_npz(path, LIMITS.dataset_bytes)


def _load_npy(path: Path) -> Array:
    try:
        rows = np.lib.format.open_memmap(path, mode="r")
    except (OSError, *READ_ERRORS) as error:
        raise DescriptionError(f"{path}: cannot be read: {error}") from error
    check_unpacked_size(str(path), 8 * rows.size, LIMITS.dataset_bytes)
    if rows.dtype.kind not in "fiu":
        raise DescriptionError(f"{path}: found values of type {rows.dtype}, expected numbers")
    return np.array(rows, dtype=float)


def _read_hdf5(path: Path) -> tuple[Any, Any, Any]:
    """Transforms, success and scale of a file of ACRONYM."""
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
        raise DescriptionError(f"{path}: not a file of ACRONYM: {reason}") from error
