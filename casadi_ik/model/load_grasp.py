"""Grasp files."""

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
    """When a contact counts as reached; what is left out is as everywhere.

    Attributes:
        position: Largest distance of the points [m].
        angle: Largest angle between the normals [rad].
    """

    position: Length = Tolerance.position
    angle: Angle = Tolerance.angle


class ContactEntry(Struct, frozen=True):
    """A finger's contact; ``direction`` stands alone, everything else needs a point.

    Attributes:
        point: Where the fingertip touches, in the robot's base frame (an object's, if its pose is
            said elsewhere) [m].
        normal: Which way the pad faces: out of the fingertip, into the object; left out: any.
        tolerance: When it counts as reached; left out: as for all.
        tangent: Where the second axis of the contact frame points; it needs a normal.
        line: Direction of a line through the point on which the fingertip may be anywhere.
        plane: Normal of a plane through the point in which the fingertip may be anywhere.
        ball: Outward normal that the pad's ball has where it touches the point.
        direction: Which way the pad faces wherever it is; it stands alone.
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
    """The object that is grasped and where it is.

    Attributes:
        name: A shipped object, or the path of an object file.
        pose: Of the object in the robot's base frame.
    """

    name: str
    pose: Frame = Frame()


class GraspFile(Struct, frozen=True):
    """A grasp: ``models/grasps/*.yaml``.

    Attributes:
        contacts: By finger; a finger left out is free.
        robot: The robot it was made for: a shipped name, ARM+HAND, or a path.
        description: One sentence.
        object: What is grasped, and where it is.
        posture: Position by actuator of the hand that it was made from [rad or m]; with a palm the
            posture to take.
        palm: Instead of contacts where the robot's palm frame is to be.
        palms: The same of a body, by side.
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


def grasp_from_entry(entry: GraspFile, path: Path, name: str, where: str = "") -> Grasp:
    """A grasp as a file has it.

    Args:
        entry: What the file says.
        path: The file.
        name: What to call it.
        where: Key of the entry in the file, with a dot behind.

    Raises:
        DescriptionError: A malformed contact.
    """
    contacts: dict[str, Contact] = {}
    for finger, contact in entry.contacts.items():
        try:
            contacts[finger] = _contact(contact)
        except InputError as error:
            raise DescriptionError(f"{path}: {where}contacts.{finger}.{error}") from error
    try:
        return Grasp(
            contacts=contacts,
            robot=entry.robot,
            name=name,
            object=entry.object.name if entry.object else "",
            object_pose=frame_matrix(entry.object.pose) if entry.object else None,
            posture=entry.posture,
            palm=_palm(entry),
        )
    except InputError as error:
        raise DescriptionError(f"{path}: {where}{error}") from error


def _palm(entry: GraspFile) -> Array | dict[str, Array] | None:
    if entry.palm and entry.palms:
        raise InputError("palms: found it beside palm, expected one of them")
    if entry.palms:
        return {side: frame_matrix(frame) for side, frame in entry.palms.items()}
    return frame_matrix(entry.palm) if entry.palm else None


def _contact(entry: ContactEntry) -> Contact:
    given: dict[str, Any] = msgspec.structs.asdict(entry)
    if entry.tolerance is not None:
        given["tolerance"] = Tolerance(entry.tolerance.position, entry.tolerance.angle)
    return Contact(**given)


def grasp_to_dict(grasp: Grasp) -> dict[str, Any]:
    """A grasp as a file has it, to the last digit; what comes before and after it is left out."""
    contacts: dict[str, dict[str, Any]] = {}
    for finger, contact in grasp.contacts.items():
        given = {key: getattr(contact, key) for key in ("point", "normal", *EXTRA_VECTORS)}
        if np.isnan(contact.point).any():
            given = {"direction": contact.normal}
        entry: dict[str, Any] = {
            key: _numbers(value) for key, value in given.items() if value is not None
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
    if grasp.one_palm is not None:
        data["palm"] = _frame(grasp.one_palm)
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
    """Names of the shipped grasps for a robot.

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
    """Grasps in a list, of which one is to be chosen.

    Attributes:
        candidates: Grasps.
        robot: Of all that name no other.
        description: One sentence.
        object: Of all that name no other.
    """

    candidates: list[GraspFile]
    robot: str = ""
    description: str = ""
    object: GraspedObjectEntry | None = None


def load_grasp_files(path: Path) -> tuple[Grasp, ...]:
    """Load grasps.

    Args:
        path: A YAML file with a list of grasps (``candidates:``) or with a single one, or a folder
            of such files, taken by their names.

    Raises:
        DescriptionError: It is missing, empty or malformed; the message names file and key.
    """
    if not path.is_dir():
        return _of_file(path)
    files = sorted(item for item in path.iterdir() if item.suffix in (".yaml", ".yml"))
    if not files:
        raise DescriptionError(f"{path}: found no YAML file, expected grasp files")
    return tuple(grasp for file in files for grasp in _of_file(file))


def _of_file(path: Path) -> tuple[Grasp, ...]:
    raw = parse_yaml(path)
    if not (isinstance(raw, dict) and "candidates" in raw):
        return (load_grasp(path),)
    file, _ = validated(raw, CandidatesFile, path)
    if not file.candidates:
        raise DescriptionError(f"{path}: candidates: found none, expected at least one grasp")
    found = []
    for i, entry in enumerate(file.candidates):
        whole = msgspec.structs.replace(
            entry, robot=entry.robot or file.robot, object=entry.object or file.object
        )
        found.append(grasp_from_entry(whole, path, f"{path.stem}[{i}]", f"candidates[{i}]."))
    return tuple(found)
