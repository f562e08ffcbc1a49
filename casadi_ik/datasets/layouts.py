"""The layouts of other people's grasps: what stands where in their files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.datasets.postures import (
    HandPoses,
    of_fixed_axes,
    of_two_columns,
)
from casadi_ik.datasets.unpickling import Packed, read_npy, read_torch
from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.npz import refuse_giants
from casadi_ik.grasps.pose import inverse, rotations_of

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
    entries = found.get("metadata")
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
    refuse_giants(f"{where}: {key}", 8 * value.size, LIMITS.dataset_bytes)
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
        f"{where}: obj_pose", row[None, :3], rotations_of(row[None, 3:]), np.zeros((1, 0))
    )
    if held.faults:
        raise DescriptionError(f"{where}: obj_pose: {held.faults[0]}")
    return held.poses[0]


def _of_stages(where: str, found: Mapping[str, Any], stages: Mapping[str, Array]) -> HandPoses:
    """Rows (k, 7 + joints) of the stages, with poses as x y z, w x y z."""
    shape = stages["grasp"].shape
    back = inverse(_object_pose(where, found))
    made: dict[str, HandPoses] = {}
    for name, rows in stages.items():
        if rows.shape != shape:
            raise DescriptionError(f"{where}: {name}: found shape {rows.shape}, expected {shape}")
        given = HandPoses(where, rows[:, :3], rotations_of(rows[:, 3:7]), rows[:, 7:])
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
