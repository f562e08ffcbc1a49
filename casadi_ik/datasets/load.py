"""Candidates for `Solver.choose` from any file: grasp files, targets, data sets, tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand, load_robot
from casadi_ik.arrays import Array
from casadi_ik.batches.target_file import TargetFile
from casadi_ik.datasets.conventions import Convention, convention_for, of_robot
from casadi_ik.datasets.hand_poses import FAR, HandPoses
from casadi_ik.datasets.hands import joints_at, motor_positions, palms_of
from casadi_ik.datasets.layouts import LAYOUTS, READERS, read_layout
from casadi_ik.datasets.tables import SUFFIXES, read_table
from casadi_ik.errors import DescriptionError, InputError, UnknownNameError
from casadi_ik.grasps import Contact, Grasp, GraspObject, load_object
from casadi_ik.grasps.candidates import load_grasp_files
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

TOUCHING = 0.01
"""A pad that is nearer to the object than this [m] touches it."""


def load_candidates(
    path: str | Path,
    robot: ArmHand | str,
    layout: str | None = None,
    hand: str | Path | None = None,
    object_pose: ArrayLike | None = None,
    take: Take = "palm",
    grasped: str | GraspObject | None = None,
    of: str | None = None,
) -> tuple[Grasp, ...]:
    """Grasps of a file or a folder, as `Solver.choose` takes them.

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
        grasped: The object, or its shipped name: of "contacts" only pads nearer to its surface
            than 10 mm count, and they are where the surface is; collisions know it by its name.
        of: Whose grasps, by the file's own name, where a file has those of several objects.

    Returns:
        The grasps in the order of the file, at least one.

    Raises:
        DescriptionError: The file is missing or malformed; the message names file, row and key.
        UnsupportedError: The robot has not the hand of the data.
        UnknownNameError: No such robot, layout, convention or object.
        InputError: No rigid object_pose, or another word than those of `take`.

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
    if not file.exists():
        raise DescriptionError(f"{file}: no such file or folder, expected candidates")
    thing = load_object(grasped) if isinstance(grasped, str) else grasped
    grasps = _loaded(file, held, layout, hand, take, thing, of)
    _refuse_other_units(file, grasps)
    if object_pose is None:
        return grasps
    return tuple(grasp.in_object_frame().at(object_pose) for grasp in grasps)


def _loaded(
    path: Path,
    robot: ArmHand,
    layout: str | None,
    hand: str | Path | None,
    take: Take,
    thing: GraspObject | None,
    of: str | None,
) -> tuple[Grasp, ...]:
    kind = path.suffix.lower()
    if kind in READERS and layout != TABLE:
        given, found = read_layout(path, layout)
        return _of_hand(given.of(of), robot, convention_for(robot, found, hand), take, thing)
    if of is not None:
        raise InputError(f"of: found {of!r}, but {path.name} has grasps of one object")
    if kind in SUFFIXES and (layout == TABLE or (layout is None and not _has_targets(path))):
        given = read_table(path)
        known = (*robot.description.joint_names, *robot.actuators)
        names = tuple(name for name in given.names if name in known)
        own = _own(robot, names) if hand is None else convention_for(robot, TABLE, hand)
        return _of_hand(given, robot, own, take, thing)
    if layout is not None:
        expected = ", ".join(READERS if layout != TABLE else SUFFIXES)
        raise DescriptionError(f"{path}: found no {expected} file, expected one of {layout}")
    if kind == ".npz":
        return tuple(_of_targets(path, robot.fingers))
    grasps = load_grasp_files(path)
    for grasp in grasps:
        try:
            grasp.arrays(robot.fingers)
        except InputError as error:
            raise DescriptionError(f"{path}: {grasp.name}: {error}") from error
    return grasps


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
    given: HandPoses, robot: ArmHand, convention: Convention, take: Take, thing: GraspObject | None
) -> tuple[Grasp, ...]:
    """Grasps of hands whose poses and joints are given in the object's frame."""
    joints = convention.positions(given)
    motors, postures = (), np.zeros((len(given.poses), 0))
    if take == "palm" or not set(finger_joints(robot.description)) <= set(joints):
        motors, postures = motor_positions(robot, given.where, joints)
        joints = joints_at(robot, motors, postures) | joints
    frames = convention.frames(given)
    palms, points, normals = palms_of(robot, convention.link, frames, joints)
    stem, name = Path(given.where).stem, "" if thing is None else thing.name
    if take == "palm":
        return tuple(
            Grasp(
                robot=robot.name,
                name=f"{stem}[{i}]",
                object=name,
                palm=palm,
                posture=dict(zip(motors, postures[i].tolist(), strict=True)),
            )
            for i, palm in enumerate(palms)
        )
    return tuple(
        Grasp(
            _contacts(f"{given.where}: row {i}", robot, points[i], normals[i], thing),
            robot.name,
            f"{stem}[{i}]",
            name,
        )
        for i in range(len(palms))
    )


def _contacts(
    where: str, robot: ArmHand, points: Array, normals: Array, thing: GraspObject | None
) -> dict[str, Contact]:
    """Contacts of pads (f, 3), where the object is if there is one."""
    if thing is None:
        rows = zip(robot.fingers, points, normals, strict=True)
        return {finger: Contact(point, normal) for finger, point, normal in rows}
    off, outward = thing.signed_distance(points), thing.normal(points)
    surface = points - off[:, None] * outward
    found = {
        finger: Contact(surface[i], -outward[i])
        for i, finger in enumerate(robot.fingers)
        if abs(off[i]) <= TOUCHING
    }
    if not found:
        raise DescriptionError(
            f"{where}: no pad is within {1e3 * TOUCHING:g} mm of {thing.name}'s surface: the "
            f"nearest is {1e3 * float(np.abs(off).min()):.1f} mm away"
        )
    return found


def _of_targets(path: Path, fingers: tuple[str, ...]) -> list[Grasp]:
    found: list[Grasp] = []
    for block in TargetFile(path, len(fingers)).blocks(lambda: BLOCK):
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
