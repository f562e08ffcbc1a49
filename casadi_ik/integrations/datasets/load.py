"""Candidates for `Solver.choose`, read from grasp files, target files, data sets and tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.errors import (
    DescriptionError,
    InputError,
    InvalidPoseError,
    UnknownNameError,
)
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.files.number_files import npz_names
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.integrations.datasets.gripper_grasps import (
    GRIPPER_READERS,
    ISAAC_GRASP,
    read_isaac_grasp,
    recognise_layout,
    transfer_to_gripper,
)
from casadi_ik.integrations.datasets.layouts import (
    LAYOUTS,
    READERS,
    Convention,
    convention_for,
    convention_of_robot,
    read_layout,
)
from casadi_ik.integrations.datasets.postures import (
    POSTURE_FIT,
    HandPoses,
    HandPostures,
    hand_postures,
    palms_and_pads,
)
from casadi_ik.integrations.datasets.tables import TABLE_SUFFIXES, read_table
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.model.load_grasp import load_grasp_files
from casadi_ik.model.objects import GraspObject, is_mesh_name, load_object
from casadi_ik.model.targets import DIRECTIONS_KEY, EXTRA_ARRAY_NAMES
from casadi_ik.solve.target_files import TargetFile

MIN_REPORTED_SHIFT = 1e-4
"""Smallest shift of a fingertip that is reported [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class Candidates(RecordReprMixin, Sequence[Grasp]):
    """A sequence of grasps in the order of their file.

    Attributes:
        grasps: The grasps.
        rows: (k,) row numbers in the file.
        dropped: Number of invalid rows that were dropped.
        clipped: Number of rows with a joint that was clipped to its limits.
        shift: (k,) largest shift of a fingertip against the file in the palm frame [m]: by
            clipping, or by couplings of joints that are independent in the data.
        scale: Scale of the object relative to its mesh; None if the file does not state it.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(2), 20))
        >>> np.savez("targets.npz", points=points, normals=normals)
        >>> candidates = ik.load_candidates("targets.npz", robot)
        >>> print(candidates)
        20 candidates
        >>> candidates.dropped, candidates.clipped, candidates[3].name
        (0, 0, 'targets[3]')
    """

    grasps: tuple[Grasp, ...]
    rows: tuple[int, ...] = ()
    dropped: int = 0
    clipped: int = 0
    shift: Array = field(default_factory=lambda: np.zeros(0))
    scale: float | None = None

    def __post_init__(self) -> None:
        count = len(self.grasps)
        object.__setattr__(self, "rows", self.rows or tuple(range(count)))
        if not len(self.shift):
            object.__setattr__(self, "shift", np.zeros(count))

    def __len__(self) -> int:
        return len(self.grasps)

    def __iter__(self) -> Iterator[Grasp]:
        return iter(self.grasps)

    @overload
    def __getitem__(self, index: int) -> Grasp: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Grasp, ...]: ...

    def __getitem__(self, index: int | slice) -> Grasp | tuple[Grasp, ...]:
        return self.grasps[index]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on dropped, clipped and shifted rows."""
        total, notes = len(self) + self.dropped, []
        if self.dropped:
            notes.append(f"{self.dropped} of {total} rows dropped: invalid")
        if self.clipped:
            notes.append(f"{self.clipped} of {total} rows have joints clipped to their limits")
        shifts = 1e3 * self.shift[self.shift > MIN_REPORTED_SHIFT]
        if len(shifts):
            notes.append(
                f"fingertips of {len(shifts)} candidates shifted, as the hand's joints are limited "
                f"and coupled: median {np.median(shifts):.1f} mm, at most {shifts.max():.1f} mm"
            )
        return tuple(notes)

    def __str__(self) -> str:
        size = "" if self.scale is None else f" of an object of scale {self.scale:g}"
        return "\n".join([f"{len(self)} candidates{size}", *(f"  {note}" for note in self.notes)])


Invalid = Literal["error", "drop", "clip"]
"""Treatment of rows with invalid numbers or joints beyond their limits."""

INVALID_CHOICES = ("error", "drop", "clip")


@dataclass(frozen=True)
class ReadingSettings:
    """Settings of the reader.

    Attributes:
        block: Number of rows of a target file that are read at once.
        contact_distance: Largest distance of a pad that touches the object [m].
    """

    block: int = 4096
    contact_distance: float = 0.01


READING_SETTINGS = ReadingSettings()


def valid_rows(
    location: str,
    rows: Sequence[int],
    faults: Mapping[int, str],
    out_of_limits: Mapping[int, str],
    invalid: Invalid,
) -> NDArray[np.intp]:
    """Return the indices of the valid rows.

    Args:
        location: File, for messages.
        rows: Row numbers in the file.
        faults: Problems by row number.
        out_of_limits: Violated limits by row number.
        invalid: Treatment of invalid rows; "clip" accepts rows that only violate limits.

    Raises:
        DescriptionError: There are invalid rows that may not be dropped, or no valid row.
    """
    invalid_rows = {**({} if invalid == "clip" else out_of_limits), **faults}
    if invalid_rows and (invalid != "drop" or len(invalid_rows) == len(rows)):
        first = min(invalid_rows)
        clip_would_help = invalid == "error" and set(out_of_limits) - set(faults)
        clip_hint = ", 'clip' clips joints to their limits" if clip_would_help else ""
        hint = f"; invalid='drop' drops such rows{clip_hint} (--invalid)"
        error_type = (
            InvalidPoseError if invalid_rows[first].startswith("rotation") else DescriptionError
        )
        raise error_type(
            f"{location}: row {first}: {invalid_rows[first]}; "
            f"{len(invalid_rows)} of {len(rows)} rows are invalid"
            f"{'' if invalid == 'drop' else hint}"
        )
    return np.array([i for i, row in enumerate(rows) if row not in invalid_rows], dtype=np.intp)


Take = Literal["palm", "contacts"]
"""Kind of target that is made from the pose and posture of a hand."""

TAKE_CHOICES = ("palm", "contacts")

TABLE_LAYOUT = "table"
"""Layout of files with named columns."""

LAYOUT_NAMES = (*LAYOUTS, ISAAC_GRASP, *GRIPPER_READERS, TABLE_LAYOUT)
"""Names of all layouts of grasp files."""


def load_candidates(
    path: str | Path,
    robot: ArmHand | str,
    layout: str | None = None,
    hand: str | Path | None = None,
    object_pose: ArrayLike | None = None,
    take: Take = "palm",
    grasped: str | Path | Sequence[str | Path] | GraspObject | None = None,
    of: str | None = None,
    scale: float | None = None,
    invalid: Invalid = "error",
) -> Candidates:
    """Load the grasps of a file or a folder for `Solver.choose`.

    If joints that are independent in the data are coupled in the hand, the posture is the one whose
    fingertips are nearest to those of the data; `Candidates.shift` is their distance.

    Args:
        path: A YAML file with one grasp or a list (``candidates:``); a folder of such files; an npz
            file with points and normals, as `Solver.solve_batch` takes them; an npy or pt file of a
            data set; a table (CSV, npz, Parquet) with columns x y z, qw qx qy qz or roll pitch yaw,
            and the robot's joints by name, with the pose of the palm frame; grasps of a parallel
            gripper (isaac_grasp, ACRONYM, GraspNet, 4 x 4 poses with widths). No code in a file is
            executed.
        robot: The robot, or its name; its hand must be that of the data.
        layout: One of `LAYOUT_NAMES`; None: recognised from the file.
        hand: Convention of joint names and hand frame: a name in ``models/datasets``, or a file of
            the same format; None: the built-in convention that fits.
        object_pose: (4, 4) pose of the object in the base frame; None: grasps stay in its frame.
        take: "palm": the target is the palm pose with the posture, so that only the arm is solved.
            "contacts": the target is the set of fingertip contacts.
        grasped: The object, its built-in name, or the path of its file or mesh (several meshes are
            one body). For "contacts", only pads within 10 mm of its surface count, and contacts are
            projected onto it; `Grasp.object` names it for collisions. A mesh is scaled if the file
            states a `scale`.
        of: Name of the object in the file, if the file has grasps of several objects.
        scale: Scale of the object, if the file has grasps of several sizes.
        invalid: Treatment of rows of a data set or table with a joint beyond its limits, invalid
            numbers, or no fingertip on the object. "error": the file is refused; "drop": the row is
            dropped; "clip": joints are clipped to their limits, and other problems are refused.

    Returns:
        The grasps in the order of the file, at least one, with counts of dropped and clipped rows
        and the shifts of fingertips.

    Raises:
        DescriptionError: The file is missing or malformed, has invalid rows, or grasps of several
            objects or sizes; the message names file, row and key.
        UnsupportedError: The robot does not have the hand of the data.
        UnknownNameError: A robot, layout, convention or object of that name does not exist.
        InputError: object_pose is not rigid, or `take` or `invalid` has another value.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(2), 20))
        >>> np.savez("targets.npz", points=points, normals=normals)
        >>> ranked = solver.choose(ik.load_candidates("targets.npz", robot), limit=3)
        >>> ranked.candidates, len(ranked)
        (20, 3)
    """
    arm_hand = load_robot(robot) if isinstance(robot, str) else robot
    file = Path(path)
    if layout is not None and layout not in LAYOUT_NAMES:
        expected = ", ".join(LAYOUT_NAMES)
        raise UnknownNameError(f"layout: found {layout!r}, expected one of {expected}")
    if take not in TAKE_CHOICES:
        raise InputError(f"take: found {take!r}, expected one of {', '.join(TAKE_CHOICES)}")
    if invalid not in INVALID_CHOICES:
        raise InputError(
            f"invalid: found {invalid!r}, expected one of {', '.join(INVALID_CHOICES)}"
        )
    if not file.exists():
        raise DescriptionError(f"{file}: no such file or folder, expected candidates")
    if isinstance(grasped, Path):
        grasped = str(grasped)
    elif not (grasped is None or isinstance(grasped, (str, GraspObject))):
        grasped = ",".join(map(str, grasped))
    candidates = _load(file, arm_hand, layout, hand, take, grasped, of, scale, invalid)
    _check_units(file, candidates)
    if object_pose is None:
        return candidates
    return replace(
        candidates, grasps=tuple(g.in_object_frame().at(object_pose) for g in candidates)
    )


def _load(
    path: Path,
    robot: ArmHand,
    layout: str | None,
    hand: str | Path | None,
    take: Take,
    grasped: str | GraspObject | None,
    object_name: str | None,
    scale: float | None,
    invalid: Invalid,
) -> Candidates:
    """Return the candidates of a file of any layout; see `load_candidates`."""
    suffix = path.suffix.lower()
    gripper_layout = layout or recognise_layout(path)
    if gripper_layout == ISAAC_GRASP or gripper_layout in GRIPPER_READERS:
        if object_name is not None:
            raise InputError(f"of: found {object_name!r}, but {path.name} has grasps of one object")
        if gripper_layout == ISAAC_GRASP:
            convention = convention_for(robot, ISAAC_GRASP, hand)
            poses = read_isaac_grasp(path)
        else:
            poses = transfer_to_gripper(
                GRIPPER_READERS[gripper_layout](path), robot, clip=invalid == "clip"
            )
            convention = convention_of_robot(robot, poses.names)
        return _candidates_of_hand(
            poses.for_scale(scale), robot, convention, take, grasped, invalid
        )
    if suffix in READERS and layout != TABLE_LAYOUT:
        poses, file_layout = read_layout(path, layout)
        selected = poses.for_object(object_name).for_scale(scale)
        return _candidates_of_hand(
            selected, robot, convention_for(robot, file_layout, hand), take, grasped, invalid
        )
    if scale is not None:
        raise InputError(f"scale: found {scale:g}, but {path.name} states no sizes")
    if object_name is not None:
        raise InputError(f"of: found {object_name!r}, but {path.name} has grasps of one object")
    if suffix in TABLE_SUFFIXES and (
        layout == TABLE_LAYOUT or (layout is None and not _has_targets(path))
    ):
        poses = read_table(path)
        robot_names = (*robot.description.joint_names, *robot.actuators)
        names = tuple(name for name in poses.names if name in robot_names)
        convention = (
            _convention_of_joint_names(robot, names)
            if hand is None
            else convention_for(robot, TABLE_LAYOUT, hand)
        )
        return _candidates_of_hand(poses, robot, convention, take, grasped, invalid)
    if layout is not None:
        expected = ", ".join(READERS if layout != TABLE_LAYOUT else TABLE_SUFFIXES)
        raise DescriptionError(f"{path}: file is not a {expected} file of layout {layout}")
    if suffix == ".npz":
        return Candidates(tuple(_grasps_of_targets(path, robot.fingers)))
    grasps = load_grasp_files(path)
    for grasp in grasps:
        try:
            grasp.arrays(robot.fingers)
        except InputError as error:
            raise DescriptionError(f"{path}: {grasp.name}: {error}") from error
    return Candidates(grasps)


def _check_units(path: Path, grasps: Sequence[Grasp]) -> None:
    """Refuse contacts that are so far from the object that they are in another unit."""
    for grasp in grasps:
        for finger, contact in grasp.contacts.items():
            distance = 0.0 if contact.point is None else float(np.linalg.norm(contact.point))
            if distance > POSTURE_FIT.max_distance:
                raise DescriptionError(
                    f"{path}: {grasp.name}: {finger}: point: found {distance:.4g} m away, "
                    f"expected at most {POSTURE_FIT.max_distance:g} m (numbers in mm?)"
                )


def _convention_of_joint_names(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """Return the convention of the robot's joint names; the finger motors are required."""
    motors = robot.description.finger_motors
    return convention_of_robot(robot, (*names, *(name for name in motors if name not in names)))


def _has_targets(path: Path) -> bool:
    """Return True if a file is an npz file of targets instead of palm poses."""
    if path.suffix.lower() != ".npz":
        return False
    names = npz_names(path)
    return names is None or "points" in names  # the reader of targets reports a damaged file


def _candidates_of_hand(
    poses: HandPoses,
    robot: ArmHand,
    convention: Convention,
    take: Take,
    grasped: str | GraspObject | None,
    invalid: Invalid,
) -> Candidates:
    """Return the candidates of hand poses and joints in the object's frame."""
    grasped_object, name = _load_object(grasped, poses.scales)
    _check_count(poses.location, len(poses.rows))
    joints = convention.positions(poses)
    hands = None
    if take == "palm" or not set(robot.description.finger_joints) <= set(joints):
        hands = hand_postures(robot, poses.location, joints)
        joints = hands.joints
    palms, points, normals = palms_and_pads(
        robot, convention.link, convention.frames(poses), joints
    )
    faults = dict(poses.faults)
    out_of_limits = (
        {} if hands is None else {poses.rows[i]: text for i, text in hands.out_of_limits.items()}
    )
    contacts: dict[int, dict[str, Contact]] = {}
    for i, row in enumerate(poses.rows if take == "contacts" else ()):
        try:
            contacts[i] = _contacts_of_pads(robot, points[i], normals[i], grasped_object)
        except DescriptionError as error:
            faults.setdefault(row, str(error))
    selected = valid_rows(poses.location, poses.rows, faults, out_of_limits, invalid)
    stages = {
        name: _palm_grasps(stage.select(selected), robot, convention)
        for name, stage in (("pregrasp", poses.pregrasp), ("squeeze", poses.squeeze))
        if stage is not None
    }
    stem = Path(poses.location).stem
    grasps = []
    for k, i in enumerate(selected):
        fields: dict[str, Any]
        fields = (
            {"contacts": contacts[i]} if take == "contacts" else _palm_fields(palms[i], hands, i)
        )
        fields |= {stage: stage_grasps[k] for stage, stage_grasps in stages.items()}
        title = f"{stem}[{poses.rows[i]}]"
        grasps.append(Grasp(robot=robot.name, name=title, object=name, **fields))
    return Candidates(
        tuple(grasps),
        tuple(poses.rows[i] for i in selected),
        len(poses.rows) - len(selected),
        sum(poses.rows[i] in out_of_limits for i in selected),
        hands.shift[selected] if take == "palm" and hands is not None else np.zeros(len(selected)),
        poses.scales[0] if poses.scales else None,
    )


def _load_object(
    grasped: str | GraspObject | None, scales: tuple[float, ...]
) -> tuple[GraspObject | None, str]:
    """Return the grasped object, scaled as the file states, and the name that loads it again."""
    if not isinstance(grasped, str):
        return grasped, "" if grasped is None else grasped.name
    if scales and is_mesh_name(grasped) and "@" not in grasped:
        grasped = f"{grasped}@{scales[0]:.6g}"
    grasped_object = load_object(grasped)
    return grasped_object, grasped


def _check_count(location: str, count: int) -> None:
    """Refuse a file with too many grasps."""
    if count > scaled_limit(LIMITS.candidates):
        raise DescriptionError(
            f"{location}: found {count} grasps, expected at most {scaled_limit(LIMITS.candidates)} "
            f"{RAISE_HINT}"
        )


def _palm_fields(pose: Array, hands: HandPostures | None, row: int) -> dict[str, Any]:
    assert hands is not None
    posture = dict(zip(hands.motors, hands.positions[row].tolist(), strict=True))
    return {"palm": pose, "posture": posture}


def _palm_grasps(poses: HandPoses, robot: ArmHand, convention: Convention) -> list[Grasp]:
    """Return grasps of palm poses with the nearest postures that the hand can take."""
    hands = hand_postures(robot, poses.location, convention.positions(poses))
    palms = palms_and_pads(robot, convention.link, convention.frames(poses), hands.joints)[0]
    return [Grasp(robot=robot.name, **_palm_fields(palms[i], hands, i)) for i in range(len(palms))]


def _contacts_of_pads(
    robot: ArmHand, points: Array, normals: Array, grasped_object: GraspObject | None
) -> dict[str, Contact]:
    """Return the contacts of pads (f, 3), projected onto the object if there is one."""
    if grasped_object is None:
        rows = zip(robot.fingers, points, normals, strict=True)
        return {finger: Contact(point, normal) for finger, point, normal in rows}
    distance = grasped_object.signed_distance(points)
    touching_pads = np.flatnonzero(np.abs(distance) <= READING_SETTINGS.contact_distance)
    outward = grasped_object.normal(points[touching_pads])
    surface = points[touching_pads] - distance[touching_pads, None] * outward
    contacts = {
        robot.fingers[finger]: Contact(surface[i], -outward[i])
        for i, finger in enumerate(touching_pads)
    }
    if not contacts:
        raise DescriptionError(
            f"no pad is within {1e3 * READING_SETTINGS.contact_distance:g} mm of the surface of "
            f"{grasped_object.name}: the nearest is "
            f"{1e3 * float(np.abs(distance).min()):.1f} mm away"
        )
    return contacts


def _grasps_of_targets(path: Path, fingers: tuple[str, ...]) -> list[Grasp]:
    """Return the grasps of the rows of a target file."""
    grasps: list[Grasp] = []
    file = TargetFile(path, len(fingers))
    _check_count(str(path), file.rows())
    for block in file.blocks(lambda: READING_SETTINGS.block):
        for row in range(len(block["points"])):
            try:
                vectors = {name: rows[row] for name, rows in block.items()}
                contacts = {
                    finger: contact
                    for i, finger in enumerate(fingers)
                    if (contact := _contact_of_finger({name: v[i] for name, v in vectors.items()}))
                    is not None
                }
                grasps.append(Grasp(contacts, name=f"{path.stem}[{len(grasps)}]"))
            except InputError as error:
                raise DescriptionError(f"{path}: row {len(grasps)}: {error}") from error
    return grasps


def _contact_of_finger(vectors: dict[str, np.ndarray]) -> Contact | None:
    """Return the contact of a finger in a target file; None if the finger is free."""
    stated = {name: vector for name, vector in vectors.items() if not np.isnan(vector).all()}
    if not stated:
        return None
    if DIRECTIONS_KEY in stated and "points" not in stated:
        return Contact(direction=stated[DIRECTIONS_KEY])
    optional: dict[str, Any] = {
        name[:-1]: stated[name] for name in EXTRA_ARRAY_NAMES if name in stated
    }
    return Contact(stated.get("points"), stated.get("normals"), **optional)
