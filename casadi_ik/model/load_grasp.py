"""Grasp files, read and written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from casadi_ik.errors import DescriptionError, InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import (
    Frame,
    Point,
    Struct,
    Vector,
    frame_matrix,
    parse_yaml,
    read,
    roll_pitch_yaw,
    validated,
)
from casadi_ik.files.shipped import resolve_description, shipped_names
from casadi_ik.files.units import Angle, AnyValue, Length
from casadi_ik.model.grasp import EXTRA_VECTORS, Contact, Grasp, Tolerance


class ToleranceEntry(Struct, frozen=True):
    """Tolerances of a contact; omitted values are the defaults.

    Attributes:
        position: Largest position error [m].
        angle: Largest angle between the normals [rad].
    """

    position: Length = Tolerance.position
    angle: Angle = Tolerance.angle


class ContactEntry(Struct, frozen=True):
    """A contact of a finger; ``direction`` excludes the other keys, which require a point.

    Attributes:
        point: Contact point in the robot's base frame, or in an object's frame if its pose is given
            elsewhere [m].
        normal: Outward normal of the pad, into the object; default: free.
        tolerance: Tolerances of the contact; default: those of all contacts.
        tangent: Direction of the second axis of the contact frame; needs a normal.
        line: Direction of a line through the point on which the contact may be anywhere.
        plane: Normal of a plane through the point in which the contact may be anywhere.
        ball: Outward normal of the pad's ball where it touches the point.
        direction: Outward normal of a pad that may be anywhere.
    """

    point: Point | None = None
    normal: Vector | None = None
    tolerance: ToleranceEntry | None = None
    tangent: Vector | None = None
    line: Vector | None = None
    plane: Vector | None = None
    ball: Vector | None = None
    direction: Vector | None = None


class GraspedObjectEntry(Struct, frozen=True):
    """The grasped object and its pose.

    Attributes:
        name: Shipped object, or path of an object file.
        pose: Pose of the object in the robot's base frame.
    """

    name: str
    pose: Frame = Frame()


class GraspFile(Struct, frozen=True):
    """A grasp: ``models/grasps/*.yaml``.

    Attributes:
        contacts: Contact by finger; omitted fingers are free.
        robot: Robot that the grasp was made for: shipped name, ARM+HAND, or path.
        description: Description in one sentence.
        object: Grasped object and its pose.
        posture: Position by hand actuator that realises the contacts [rad or m]; with a palm, the
            posture to take.
        palm: Pose of the robot's palm frame, instead of contacts.
        palms: Pose of the palm frame by side of a multi-arm robot.
    """

    contacts: dict[str, ContactEntry] = msgspec.field(default_factory=dict)
    robot: str = ""
    description: str = ""
    object: GraspedObjectEntry | None = None
    posture: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    palm: Frame | None = None
    palms: dict[str, Frame] = msgspec.field(default_factory=dict)


def load_grasp(name_or_path: str | Path) -> Grasp:
    """Load a grasp.

    Args:
        name_or_path: A shipped name or the path of a YAML file.

    Raises:
        UnknownNameError: No shipped grasp has that name.
        DescriptionError: The file is missing or malformed; the message names file and key.

    Example:
        >>> ik.load_grasp("cup").robot
        'kuka_lwr_barrett'
    """
    path = resolve_description(name_or_path, "grasps")
    entry, _ = read(path, GraspFile)
    return grasp_from_entry(entry, path, path.stem)


def grasp_from_entry(entry: GraspFile, path: Path, name: str, key_prefix: str = "") -> Grasp:
    """Return the grasp of a file entry.

    Args:
        entry: Entry of the file.
        path: The file.
        name: Name of the grasp.
        key_prefix: Key of the entry in the file with a trailing dot, for messages.

    Raises:
        DescriptionError: A contact is malformed.
    """
    contacts: dict[str, Contact] = {}
    location = f"{path}: {key_prefix}"
    for finger, contact in entry.contacts.items():
        try:
            contacts[finger] = _contact(contact)
        except InputError as error:
            raise DescriptionError(f"{path}: {key_prefix}contacts.{finger}.{error}") from error
    try:
        return Grasp(
            contacts=contacts,
            robot=entry.robot,
            name=name,
            object=entry.object.name if entry.object else "",
            object_pose=frame_matrix(entry.object.pose, f"{location}object.pose")
            if entry.object
            else None,
            posture=entry.posture,
            palm=_palm(entry, location),
        )
    except InputError as error:
        raise DescriptionError(f"{path}: {key_prefix}{error}") from error


def _palm(entry: GraspFile, location: str) -> Array | dict[str, Array] | None:
    if entry.palm and entry.palms:
        raise InputError("palms: is given together with palm; expected one of them")
    if entry.palms:
        return {
            side: frame_matrix(frame, f"{location}palms.{side}")
            for side, frame in entry.palms.items()
        }
    return frame_matrix(entry.palm, f"{location}palm") if entry.palm else None


def _contact(entry: ContactEntry) -> Contact:
    arguments: dict[str, Any] = msgspec.structs.asdict(entry)
    if entry.tolerance is not None:
        arguments["tolerance"] = Tolerance(entry.tolerance.position, entry.tolerance.angle)
    return Contact(**arguments)


def grasp_to_dict(grasp: Grasp) -> dict[str, Any]:
    """Return the data of a grasp file, to the last digit, without pregrasp and squeeze."""
    contacts: dict[str, dict[str, Any]] = {}
    for finger, contact in grasp.contacts.items():
        vectors = {key: getattr(contact, key) for key in ("point", "normal", *EXTRA_VECTORS)}
        if np.isnan(contact.point).any():
            vectors = {"direction": contact.normal}
        entry: dict[str, Any] = {
            key: _numbers(value) for key, value in vectors.items() if value is not None
        }
        if contact.tolerance is not None:
            position, angle = contact.tolerance.position, contact.tolerance.angle
            entry["tolerance"] = {"position": float(position), "angle": float(angle)}
        contacts[finger] = entry
    data: dict[str, Any] = {"robot": grasp.robot} if grasp.robot else {}
    if grasp.object:
        pose = grasp.known_pose
        data["object"] = {"name": grasp.object} | ({} if pose is None else {"pose": _frame(pose)})
    data |= {"contacts": contacts} if contacts else {}
    if grasp.single_palm is not None:
        data["palm"] = _frame(grasp.single_palm)
    elif isinstance(grasp.palm, Mapping):
        data["palms"] = {side: _frame(pose) for side, pose in grasp.palm.items()}
    if grasp.posture:
        data["posture"] = {name: float(value) for name, value in grasp.posture.items()}
    return data


def _frame(pose: Array) -> dict[str, list[float]]:
    return {"xyz": _numbers(pose[:3, 3]), "rpy": _numbers(roll_pitch_yaw(pose[:3, :3]))}


def _numbers(values: Array) -> list[float]:
    return [float(value) + 0.0 for value in values]


def shipped_grasps(robot: str) -> tuple[str, ...]:
    """Return the names of the shipped grasps for a robot.

    Args:
        robot: Name of the robot.

    Raises:
        DescriptionError: A shipped file is damaged.

    Example:
        >>> "cup" in ik.shipped_grasps("kuka_lwr_barrett")
        True
    """
    return tuple(name for name in shipped_names("grasps") if load_grasp(name).robot == robot)


class CandidatesFile(Struct, frozen=True):
    """A list of grasps to choose from.

    Attributes:
        candidates: Grasps.
        robot: Robot of grasps that name none.
        description: Description in one sentence.
        object: Object of grasps that name none.
    """

    candidates: list[GraspFile]
    robot: str = ""
    description: str = ""
    object: GraspedObjectEntry | None = None


def load_grasp_files(path: Path) -> tuple[Grasp, ...]:
    """Load all grasps of a file or folder.

    Args:
        path: YAML file with a list of grasps (``candidates:``) or a single grasp, or a folder of
            such files, which are read in alphabetical order.

    Raises:
        DescriptionError: A file is missing, empty or malformed; the message names file and key.
    """
    if not path.is_dir():
        return _load_file(path)
    files = sorted(item for item in path.iterdir() if item.suffix in (".yaml", ".yml"))
    if not files:
        raise DescriptionError(f"{path}: found no YAML file, expected grasp files")
    return tuple(grasp for file in files for grasp in _load_file(file))


def _load_file(path: Path) -> tuple[Grasp, ...]:
    """Return the grasp of a file, or all candidates of a file of candidates."""
    raw = parse_yaml(path)
    if not (isinstance(raw, dict) and "candidates" in raw):
        return (load_grasp(path),)
    file, _ = validated(raw, CandidatesFile, path)
    if not file.candidates:
        raise DescriptionError(f"{path}: candidates: found none, expected at least one grasp")
    grasps = []
    for i, entry in enumerate(file.candidates):
        complete = msgspec.structs.replace(
            entry, robot=entry.robot or file.robot, object=entry.object or file.object
        )
        grasps.append(grasp_from_entry(complete, path, f"{path.stem}[{i}]", f"candidates[{i}]."))
    return tuple(grasps)
