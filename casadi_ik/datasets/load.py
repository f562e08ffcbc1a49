"""Candidates for `Solver.choose` from any file: grasp files, targets, data sets, tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.arrays import Array
from casadi_ik.batches.target_file import TargetFile
from casadi_ik.datasets.candidates import INVALIDS, Candidates, Invalid, kept_rows
from casadi_ik.datasets.conventions import Convention, convention_for, of_robot
from casadi_ik.datasets.hand_poses import FAR, HandPoses
from casadi_ik.datasets.hands import palms_of
from casadi_ik.datasets.layouts import LAYOUTS, READERS, read_layout
from casadi_ik.datasets.postures import HandPostures, hand_postures
from casadi_ik.datasets.tables import SUFFIXES, read_table
from casadi_ik.errors import DescriptionError, InputError, UnknownNameError
from casadi_ik.files.limits import RAISED, limit
from casadi_ik.grasps import Contact, Grasp, GraspObject, load_object
from casadi_ik.grasps.candidates import load_grasp_files
from casadi_ik.grasps.objects import is_mesh
from casadi_ik.problem.contacts.arrays import NAMES
from casadi_ik.problem.hand_motors import finger_joints, hand_motors
from casadi_ik.problem.problems import DIRECTIONS

Take = Literal["palm", "contacts"]
"""What a pose and posture of a hand are taken for."""

TAKES = ("palm", "contacts")

TABLE = "table"
"""The layout of files with named columns."""

BLOCK = 4096
"""Rows of targets that are read at once."""

MOST_CANDIDATES = 200_000
"""Grasps of a file."""

TOUCHING = 0.01
"""A pad that is nearer to the object than this [m] touches it."""


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
    """Grasps of a file or a folder, as `Solver.choose` takes them.

    Where the data have joints free that are coupled in the hand, the posture is the one whose
    fingertips are nearest to those of the data; how far they are away is `Candidates.shift`.

    Args:
        path: A YAML file with one grasp or a list (``candidates:``); a folder of such files; an npz
            file with points and normals, as `Solver.solve_batch` takes them; an npy or pt file of a
            data set; a table (CSV, npz, Parquet) with columns x y z, qw qx qy qz or roll pitch yaw,
            and the robot's joints by name, the pose that of its palm frame. Nothing in a file is
            run.
        robot: The robot, or its name; its hand must be that of the data.
        layout: One of `LAYOUTS`, or "table"; None: told from the file.
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
    if layout is not None and layout not in (*LAYOUTS, TABLE):
        known = ", ".join((*LAYOUTS, TABLE))
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
            if away > FAR:
                raise DescriptionError(
                    f"{path}: {grasp.name}: {finger}: point: found {away:.4g} m away, expected at "
                    f"most {FAR:g} m (numbers in mm?)"
                )


def _own(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """A table's joints are called as the robot's; those of the fingers' motors have to be there."""
    motors = hand_motors(robot.description)
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
    if take == "palm" or not set(finger_joints(robot.description)) <= set(joints):
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
    if scales and is_mesh(grasped) and "@" not in grasped:
        grasped = f"{grasped}@{scales[0]:.6g}"
    thing = load_object(grasped)
    return thing, grasped


def _refuse_too_many(where: str, count: int) -> None:
    if count > limit(MOST_CANDIDATES):
        raise DescriptionError(
            f"{where}: found {count} grasps, expected at most {limit(MOST_CANDIDATES)} {RAISED}"
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
    near = np.flatnonzero(np.abs(off) <= TOUCHING)
    outward = thing.normal(points[near])
    surface = points[near] - off[near, None] * outward
    found = {
        robot.fingers[finger]: Contact(surface[i], -outward[i]) for i, finger in enumerate(near)
    }
    if not found:
        raise DescriptionError(
            f"no pad is within {1e3 * TOUCHING:g} mm of {thing.name}'s surface: the nearest is "
            f"{1e3 * float(np.abs(off).min()):.1f} mm away"
        )
    return found


def _of_targets(path: Path, fingers: tuple[str, ...]) -> list[Grasp]:
    found: list[Grasp] = []
    file = TargetFile(path, len(fingers))
    _refuse_too_many(str(path), file.rows())
    for block in file.blocks(lambda: BLOCK):
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
    if DIRECTIONS in given and "points" not in given:
        return Contact(direction=given[DIRECTIONS])
    more: dict[str, Any] = {name[:-1]: given[name] for name in NAMES if name in given}
    return Contact(given.get("points"), given.get("normals"), **more)
