"""Candidates for `Solver.choose` from any file: grasp files, targets, data sets, tables."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
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
    os_errors,
)
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import rotations_from_quaternions
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.files.number_files import check_unpacked_size, read_npz
from casadi_ik.integrations.datasets.layouts import (
    LAYOUTS,
    READERS,
    Convention,
    convention_for,
    of_robot,
    read_layout,
)
from casadi_ik.integrations.datasets.parallel import (
    ISAAC_GRASP,
    PARALLEL,
    for_gripper,
    isaac_grasp,
    parallel_layout,
)
from casadi_ik.integrations.datasets.postures import (
    FIT,
    HandPoses,
    HandPostures,
    hand_postures,
    of_fixed_axes,
    palms_of,
)
from casadi_ik.kinematics.arm_hand import ArmHand, load_robot
from casadi_ik.kinematics.contacts import NAMES
from casadi_ik.model.grasp import Contact, Grasp
from casadi_ik.model.load_grasp import load_grasp_files
from casadi_ik.model.objects import GraspObject, is_mesh_name, load_object
from casadi_ik.model.targets import DIRECTIONS_KEY
from casadi_ik.solve.target_files import TargetFile, polars_module

Invalid = Literal["error", "drop", "clip"]
"""What becomes of a row that the hand cannot take."""

INVALIDS = ("error", "drop", "clip")


@dataclass(frozen=True)
class Reading:
    """How candidates are read.

    Attributes:
        noticed: A fingertip that was shifted less than this [m] counts as where it was.
        block: Rows of targets that are read at once.
        touching: A pad that is nearer to the object than this [m] touches it.
    """

    noticed: float = 1e-4
    block: int = 4096
    touching: float = 0.01


READING = Reading()


@dataclass(frozen=True, eq=False)
class Candidates(Sequence[Grasp]):
    """A sequence of grasps in the order of their file.

    Attributes:
        grasps: The grasps.
        rows: (k,) their numbers in the file.
        dropped: How many rows of the file were left out, as they are invalid.
        clipped: How many have a joint that was beyond its limits, and is at them now.
        shift: (k,) how far the fingertip that is moved farthest is from where the file has it [m],
            in the frame of the palm: by clipping, or since joints are coupled that are free in the
            data.
        scale: By what factor the object is larger than its mesh; None: the file does not say.

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
    def __getitem__(self, place: int) -> Grasp: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Grasp, ...]: ...

    def __getitem__(self, place: int | slice) -> Grasp | tuple[Grasp, ...]:
        return self.grasps[place]

    @property
    def notes(self) -> tuple[str, ...]:
        """What became of rows that could not be taken as they are, in short lines."""
        whole, found = len(self) + self.dropped, []
        if self.dropped:
            found.append(f"{self.dropped} of {whole} rows left out: invalid")
        if self.clipped:
            found.append(f"{self.clipped} of {whole} rows have joints put at their limits")
        moved = 1e3 * self.shift[self.shift > READING.noticed]
        if len(moved):
            found.append(
                f"fingertips of {len(moved)} candidates shifted, as the hand's joints are limited "
                f"and coupled: median {np.median(moved):.1f} mm, at most {moved.max():.1f} mm"
            )
        return tuple(found)

    def __str__(self) -> str:
        size = "" if self.scale is None else f" of an object of scale {self.scale:g}"
        return "\n".join([f"{len(self)} candidates{size}", *(f"  {note}" for note in self.notes)])


def kept_rows(
    where: str,
    rows: Sequence[int],
    faults: Mapping[int, str],
    beyond: Mapping[int, str],
    invalid: Invalid,
) -> NDArray[np.intp]:
    """Places of the rows that are taken.

    Args:
        where: File, for messages.
        rows: Their numbers in the file.
        faults: What is wrong with a row, by its number.
        beyond: What is beyond its limits in a row, by its number.
        invalid: What becomes of these: "clip" takes rows that are beyond limits only.

    Raises:
        DescriptionError: There are invalid rows that are not to be left out, or none is left.
    """
    bad = {**({} if invalid == "clip" else beyond), **faults}
    if bad and (invalid != "drop" or len(bad) == len(rows)):
        first = min(bad)
        clips = invalid == "error" and set(beyond) - set(faults)
        more = ", 'clip' puts joints at their limits" if clips else ""
        wayout = f"; invalid='drop' leaves such rows out{more} (--invalid)"
        kind = InvalidPoseError if bad[first].startswith("rotation") else DescriptionError
        raise kind(
            f"{where}: row {first}: {bad[first]}; {len(bad)} of {len(rows)} rows are invalid"
            f"{'' if invalid == 'drop' else wayout}"
        )
    return np.array([i for i, row in enumerate(rows) if row not in bad], dtype=np.intp)


PLACE = ("x", "y", "z")
QUATERNION = ("qw", "qx", "qy", "qz")
ANGLES = ("roll", "pitch", "yaw")

SUFFIXES = (".csv", ".npz", ".parquet")

NOT_JOINTS = ("index", "id", "name", "object", "label", "score", "quality", "confidence", "success")
"""Columns of a table that are ignored, in any case of letters."""


def _is_ignored(column: str) -> bool:
    """Return whether a column is a note on a grasp, or the index that pandas writes."""
    column = column.strip().lower()
    return column in ("", *NOT_JOINTS) or column.startswith(("unnamed:", "__index_level_"))


def read_table(path: Path) -> HandPoses:
    """Grasps of a table: x y z [m], qw qx qy qz or roll pitch yaw [rad], then joints by name.

    Raises:
        DescriptionError: It is damaged, columns are missing, or not of numbers.
        UnsupportedError: Parquet, and polars is not installed.
    """
    readers: Mapping[str, Callable[[Path], Mapping[str, Array]]]
    readers = dict(zip(map(str, SUFFIXES), (_of_csv, _of_npz, _of_parquet), strict=True))
    with os_errors(f"{path}: cannot be read", DescriptionError):
        if path.suffix.lower() == ".csv":
            check_unpacked_size(str(path), path.stat().st_size, LIMITS.table_bytes)
        columns = readers[path.suffix.lower()](path)
    turned = QUATERNION if QUATERNION[0] in columns else ANGLES
    for name in (*PLACE, *turned):
        if name not in columns:
            raise DescriptionError(
                f"{path}: {name}: missing, expected columns x y z, qw qx qy qz or roll pitch yaw, "
                f"and joints; found {', '.join(columns)}"
            )
    names = tuple(name for name in columns if name not in (*PLACE, *turned))
    count = len(columns[PLACE[0]])

    def block(of: tuple[str, ...]) -> Array:
        return np.stack([columns[name] for name in of], axis=1) if of else np.zeros((count, 0))

    rotate = rotations_from_quaternions if turned is QUATERNION else of_fixed_axes
    return HandPoses(str(path), block(PLACE), rotate(block(turned)), block(names), names)


def _of_csv(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            names, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise DescriptionError(f"{path}: no CSV file: {error}") from error
    columns = {j: name.strip() for j, name in enumerate(names) if not _is_ignored(name)}
    if len(set(columns.values())) < len(columns):
        raise DescriptionError(f"{path}: found columns of the same name")
    values = {name: np.full(len(rows), np.nan) for name in columns.values()}
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise DescriptionError(
                f"{path}: row {i}: found {len(row)} values, expected {len(names)}"
            )
        for j, name in columns.items():
            try:
                # An empty cell is a number that is missing; the row is invalid.
                values[name][i] = float(row[j].strip() or "nan")
            except ValueError:
                raise DescriptionError(
                    f"{path}: row {i}: {name}: found {row[j]!r}, expected a number"
                ) from None
    return values


def _of_npz(path: Path) -> dict[str, Array]:
    columns: dict[str, Array] = {}
    for name, array in read_npz(path, LIMITS.table_bytes).items():
        if _is_ignored(name):
            continue
        if array.ndim != 1:
            raise DescriptionError(
                f"{path}: {name}: found shape {array.shape}, expected a column of numbers"
            )
        columns[name] = array
    if len({len(column) for column in columns.values()}) > 1:
        raise DescriptionError(f"{path}: found columns of different lengths")
    return columns


def _of_parquet(path: Path) -> Mapping[str, Array]:
    pl = polars_module()
    try:
        scanned = pl.scan_parquet(path)
        names = [name for name in scanned.collect_schema().names() if not _is_ignored(name)]
        scanned = scanned.select(names)
        schema = scanned.collect_schema()
        for name, kind in schema.items():
            if not kind.is_numeric():
                raise DescriptionError(
                    f"{path}: {name}: found values of type {kind}, expected numbers"
                )
        count = int(scanned.select(pl.len()).collect().item())
        check_unpacked_size(str(path), 8 * len(schema) * count, LIMITS.table_bytes)
        frame = scanned.select(pl.all().cast(pl.Float64).fill_null(np.nan)).collect()
    except (pl.exceptions.PolarsError, OSError) as error:
        raise DescriptionError(f"{path}: no Parquet file: {error}") from error
    return {name: frame[name].to_numpy() for name in frame.columns}


Take = Literal["palm", "contacts"]
"""What a pose and posture of a hand are taken for."""

TAKES = ("palm", "contacts")

TABLE = "table"
"""The layout of files with named columns."""

LAYOUT_NAMES = (*LAYOUTS, ISAAC_GRASP, *PARALLEL, TABLE)
"""All layouts of files of grasps."""


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

    Where the data have joints free that are coupled in the hand, the posture is the one whose
    fingertips are nearest to those of the data; how far they are away is `Candidates.shift`.

    Args:
        path: A YAML file with one grasp or a list (``candidates:``); a folder of such files; an npz
            file with points and normals, as `Solver.solve_batch` takes them; an npy or pt file of a
            data set; a table (CSV, npz, Parquet) with columns x y z, qw qx qy qz or roll pitch yaw,
            and the robot's joints by name, the pose that of its palm frame; grasps of a parallel
            gripper (isaac_grasp, ACRONYM, GraspNet, 4 x 4 poses with widths). Nothing in a file is
            run.
        robot: The robot, or its name; its hand must be that of the data.
        layout: One of `LAYOUT_NAMES`; None: told from the file.
        hand: How the data name joints and where they have the hand's frame: one of
            ``models/datasets``, or a file of the same kind. None: the shipped one that fits.
        object_pose: (4, 4) where the object is in the base frame; None: grasps stay in its frame.
        take: What a palm and a posture are taken for. "palm": the palm is given and the hand too,
            only the arm is looked for. "contacts": the fingertips are asked for, where they are.
        grasped: The object, its shipped name, or the path of its file or mesh (several meshes are
            one body): of "contacts" only pads nearer to its surface than 10 mm count, and they are
            where the surface is; `Grasp.object` names it for collisions. Where the file says by
            what `scale` the object is larger than its mesh, a mesh is.
        of: Whose grasps, by the file's own name, where a file has those of several objects.
        scale: Which size of the object, where a file has grasps of several.
        invalid: What becomes of a row of a data set or table with a joint beyond its limits, with
            numbers that are none, or of whose fingertips none touches the object. "error": the
            file is refused, "drop": the row is left out, "clip": joints are put at their limits,
            and what else is wrong is refused.

    Returns:
        The grasps in the order of the file, at least one; how many were left out or clipped, and
        how far fingertips were shifted.

    Raises:
        DescriptionError: The file is missing or malformed, has invalid rows, or grasps of several
            objects or sizes; the message names file, row and key.
        UnsupportedError: The robot has not the hand of the data.
        UnknownNameError: No such robot, layout, convention or object.
        InputError: No rigid object_pose, or another word than those of `take` and `invalid`.

    Example:
        >>> points, normals = robot.contacts(robot.random(np.random.default_rng(2), 20))
        >>> np.savez("targets.npz", points=points, normals=normals)
        >>> ranked = solver.choose(ik.load_candidates("targets.npz", robot), limit=3)
        >>> ranked.candidates, len(ranked)
        (20, 3)
    """
    held = load_robot(robot) if isinstance(robot, str) else robot
    file = Path(path)
    if layout is not None and layout not in LAYOUT_NAMES:
        known = ", ".join(LAYOUT_NAMES)
        raise UnknownNameError(f"layout: found {layout!r}, expected one of {known}")
    if take not in TAKES:
        raise InputError(f"take: found {take!r}, expected one of {', '.join(TAKES)}")
    if invalid not in INVALIDS:
        raise InputError(f"invalid: found {invalid!r}, expected one of {', '.join(INVALIDS)}")
    if not file.exists():
        raise DescriptionError(f"{file}: no such file or folder, expected candidates")
    if isinstance(grasped, Path):
        grasped = str(grasped)
    elif not (grasped is None or isinstance(grasped, (str, GraspObject))):
        grasped = ",".join(map(str, grasped))
    found = _loaded(file, held, layout, hand, take, grasped, of, scale, invalid)
    _refuse_other_units(file, found)
    if object_pose is None:
        return found
    return replace(found, grasps=tuple(g.in_object_frame().at(object_pose) for g in found))


def _loaded(
    path: Path,
    robot: ArmHand,
    layout: str | None,
    hand: str | Path | None,
    take: Take,
    grasped: str | GraspObject | None,
    of: str | None,
    scale: float | None,
    invalid: Invalid,
) -> Candidates:
    kind = path.suffix.lower()
    jaws = layout or parallel_layout(path)
    if jaws == ISAAC_GRASP or jaws in PARALLEL:
        if of is not None:
            raise InputError(f"of: found {of!r}, but {path.name} has grasps of one object")
        if jaws == ISAAC_GRASP:
            convention = convention_for(robot, ISAAC_GRASP, hand)
            given = isaac_grasp(path)
        else:
            given = for_gripper(PARALLEL[jaws](path), robot, clip=invalid == "clip")
            convention = of_robot(robot, given.names)
        return _of_hand(given.of_scale(scale), robot, convention, take, grasped, invalid)
    if kind in READERS and layout != TABLE:
        given, found = read_layout(path, layout)
        one = given.of(of).of_scale(scale)
        return _of_hand(one, robot, convention_for(robot, found, hand), take, grasped, invalid)
    if scale is not None:
        raise InputError(f"scale: found {scale:g}, but {path.name} says of no size")
    if of is not None:
        raise InputError(f"of: found {of!r}, but {path.name} has grasps of one object")
    if kind in SUFFIXES and (layout == TABLE or (layout is None and not _has_targets(path))):
        given = read_table(path)
        known = (*robot.description.joint_names, *robot.actuators)
        names = tuple(name for name in given.names if name in known)
        own = _own(robot, names) if hand is None else convention_for(robot, TABLE, hand)
        return _of_hand(given, robot, own, take, grasped, invalid)
    if layout is not None:
        expected = ", ".join(READERS if layout != TABLE else SUFFIXES)
        raise DescriptionError(f"{path}: found no {expected} file, expected one of {layout}")
    if kind == ".npz":
        return Candidates(tuple(_of_targets(path, robot.fingers)))
    grasps = load_grasp_files(path)
    for grasp in grasps:
        try:
            grasp.arrays(robot.fingers)
        except InputError as error:
            raise DescriptionError(f"{path}: {grasp.name}: {error}") from error
    return Candidates(grasps)


def _refuse_other_units(path: Path, grasps: Sequence[Grasp]) -> None:
    for grasp in grasps:
        for finger, contact in grasp.contacts.items():
            away = 0.0 if contact.point is None else float(np.linalg.norm(contact.point))
            if away > FIT.far:
                raise DescriptionError(
                    f"{path}: {grasp.name}: {finger}: point: found {away:.4g} m away, expected at "
                    f"most {FIT.far:g} m (numbers in mm?)"
                )


def _own(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """A table's joints are called as the robot's; those of the fingers' motors have to be there."""
    motors = robot.description.finger_motors
    return of_robot(robot, (*names, *(name for name in motors if name not in names)))


def _has_targets(path: Path) -> bool:
    if path.suffix.lower() != ".npz":
        return False
    try:
        with np.load(path, allow_pickle=False) as archive:
            return "points" in archive.files
    except (OSError, ValueError, EOFError, KeyError):
        return True  # whose reader says best what is wrong


def _of_hand(
    given: HandPoses,
    robot: ArmHand,
    convention: Convention,
    take: Take,
    grasped: str | GraspObject | None,
    invalid: Invalid,
) -> Candidates:
    """Grasps of hands whose poses and joints are given in the object's frame."""
    thing, name = _thing(grasped, given.scales)
    _refuse_too_many(given.where, len(given.rows))
    joints = convention.positions(given)
    hands = None
    if take == "palm" or not set(robot.description.finger_joints) <= set(joints):
        hands = hand_postures(robot, given.where, joints)
        joints = hands.joints
    palms, points, normals = palms_of(robot, convention.link, convention.frames(given), joints)
    faults = dict(given.faults)
    beyond = {} if hands is None else {given.rows[i]: text for i, text in hands.beyond.items()}
    contacts: dict[int, dict[str, Contact]] = {}
    for i, row in enumerate(given.rows if take == "contacts" else ()):
        try:
            contacts[i] = _contacts(robot, points[i], normals[i], thing)
        except DescriptionError as error:
            faults.setdefault(row, str(error))
    kept = kept_rows(given.where, given.rows, faults, beyond, invalid)
    stages = {
        name: _palm_grasps(stage.select(kept), robot, convention)
        for name, stage in (("pregrasp", given.pregrasp), ("squeeze", given.squeeze))
        if stage is not None
    }
    stem = Path(given.where).stem
    grasps = []
    for place, i in enumerate(kept):
        asked: dict[str, Any]
        asked = {"contacts": contacts[i]} if take == "contacts" else _palm(palms[i], hands, i)
        asked |= {stage: found[place] for stage, found in stages.items()}
        title = f"{stem}[{given.rows[i]}]"
        grasps.append(Grasp(robot=robot.name, name=title, object=name, **asked))
    return Candidates(
        tuple(grasps),
        tuple(given.rows[i] for i in kept),
        len(given.rows) - len(kept),
        sum(given.rows[i] in beyond for i in kept),
        hands.shift[kept] if take == "palm" and hands is not None else np.zeros(len(kept)),
        given.scales[0] if given.scales else None,
    )


def _thing(
    grasped: str | GraspObject | None, scales: tuple[float, ...]
) -> tuple[GraspObject | None, str]:
    """What is grasped, and the name by which it is found again; a mesh as large as it is said."""
    if not isinstance(grasped, str):
        return grasped, "" if grasped is None else grasped.name
    if scales and is_mesh_name(grasped) and "@" not in grasped:
        grasped = f"{grasped}@{scales[0]:.6g}"
    thing = load_object(grasped)
    return thing, grasped


def _refuse_too_many(where: str, count: int) -> None:
    if count > scaled_limit(LIMITS.candidates):
        raise DescriptionError(
            f"{where}: found {count} grasps, expected at most {scaled_limit(LIMITS.candidates)} "
            f"{RAISE_HINT}"
        )


def _palm(pose: Array, hands: HandPostures | None, row: int) -> dict[str, Any]:
    assert hands is not None
    posture = dict(zip(hands.motors, hands.positions[row].tolist(), strict=True))
    return {"palm": pose, "posture": posture}


def _palm_grasps(given: HandPoses, robot: ArmHand, convention: Convention) -> list[Grasp]:
    """Palms and postures as they are given, or as near as the hand can take them."""
    hands = hand_postures(robot, given.where, convention.positions(given))
    palms = palms_of(robot, convention.link, convention.frames(given), hands.joints)[0]
    return [Grasp(robot=robot.name, **_palm(palms[i], hands, i)) for i in range(len(palms))]


def _contacts(
    robot: ArmHand, points: Array, normals: Array, thing: GraspObject | None
) -> dict[str, Contact]:
    """Contacts of pads (f, 3), where the object is if there is one."""
    if thing is None:
        rows = zip(robot.fingers, points, normals, strict=True)
        return {finger: Contact(point, normal) for finger, point, normal in rows}
    off = thing.signed_distance(points)
    near = np.flatnonzero(np.abs(off) <= READING.touching)
    outward = thing.normal(points[near])
    surface = points[near] - off[near, None] * outward
    found = {
        robot.fingers[finger]: Contact(surface[i], -outward[i]) for i, finger in enumerate(near)
    }
    if not found:
        raise DescriptionError(
            f"no pad is within {1e3 * READING.touching:g} mm of {thing.name}'s surface: the "
            f"nearest is {1e3 * float(np.abs(off).min()):.1f} mm away"
        )
    return found


def _of_targets(path: Path, fingers: tuple[str, ...]) -> list[Grasp]:
    found: list[Grasp] = []
    file = TargetFile(path, len(fingers))
    _refuse_too_many(str(path), file.rows())
    for block in file.blocks(lambda: READING.block):
        for row in range(len(block["points"])):
            try:
                given = {name: rows[row] for name, rows in block.items()}
                contacts = {
                    finger: contact
                    for i, finger in enumerate(fingers)
                    if (contact := _contact({name: v[i] for name, v in given.items()})) is not None
                }
                found.append(Grasp(contacts, name=f"{path.stem}[{len(found)}]"))
            except InputError as error:
                raise DescriptionError(f"{path}: row {len(found)}: {error}") from error
    return found


def _contact(vectors: dict[str, np.ndarray]) -> Contact | None:
    """What an npz file says of a finger; None where that is free."""
    given = {name: vector for name, vector in vectors.items() if not np.isnan(vector).all()}
    if not given:
        return None
    if DIRECTIONS_KEY in given and "points" not in given:
        return Contact(direction=given[DIRECTIONS_KEY])
    more: dict[str, Any] = {name[:-1]: given[name] for name in NAMES if name in given}
    return Contact(given.get("points"), given.get("normals"), **more)
