"""Arm, hand and arm-hand files become one `RobotDescription`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.reading import (
    Frame,
    T,
    Vector,
    frame_matrix,
    read,
    read_yaml,
    refuse_non_finite,
)
from casadi_ik.files.shipped import resolve
from casadi_ik.robots.checks import (
    check_couplings,
    known_link,
    known_source,
    positive,
    unique,
    usable,
)
from casadi_ik.robots.description import Actuator, Array, Finger, Joint, RobotDescription
from casadi_ik.robots.motor_ranges import motor_ranges
from casadi_ik.robots.schema import (
    ActuatorEntry,
    ArmFile,
    ArmHandFile,
    ContactEntry,
    HandFile,
    JointEntry,
    LinkFrame,
)

ALONG = 0.995
"""Cosine with the normal above which the contact frame's x axis is no tangent."""

JOINT_TYPES = ("revolute", "prismatic", "fixed")


def load_description(name_or_path: str | Path) -> RobotDescription:
    """Load an arm-hand description.

    Args:
        name_or_path: A shipped name (`shipped_names("arm_hands")`) or the path of a YAML file,
            whose ``arm`` and ``hand`` may be shipped names or paths relative to it.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: A file is missing or malformed; the message names file and key.
    """
    path = resolve(name_or_path, "arm_hands")
    top, units = _read(path, ArmHandFile)
    usable(top.name, f"{path}: name")
    hand_path, hand = _part(top.hand, "hand", HandFile, path)
    joints: list[Joint] = []
    actuators: list[Actuator] = []
    sources: dict[str, str] = dict(top.sources)
    root = hand.root
    if top.arm is not None:
        arm_path, arm = _part(top.arm, "arm", ArmFile, path)
        joints += _joints(arm.joints, arm.root, arm.sources, "arm", arm_path)
        actuators += _actuators(None, joints, arm.sources, "arm", arm_path)
        tip = known_link(arm.tip.link, arm.root, joints, f"{arm_path}: tip.link")
        known_source(arm.tip.source, arm.sources, f"{arm_path}: tip.source")
        mount = _pose(arm.tip) @ frame_matrix(top.mount)
        joints.append(_fixed("mount", tip, hand.root, mount))
        sources |= _told_apart(arm.sources, sources, arm.name)
        root = arm.root
    elif top.mount != Frame():
        joints.append(_fixed("mount", "base", hand.root, frame_matrix(top.mount)))
        root = "base"
    hand_joints = _joints(hand.joints, hand.root, hand.sources, "hand", hand_path)
    joints += hand_joints
    actuators += _actuators(hand.actuators, hand_joints, hand.sources, "hand", hand_path)
    sources |= _told_apart(hand.sources, sources, hand.name)
    unique((a.name for a in actuators), f"{path}: actuators")
    unique((j.name for j in joints), f"{path}: joints")
    unique((root, *(j.child for j in joints)), f"{path}: links")
    palm_link = known_link(hand.palm.link, hand.root, hand_joints, f"{hand_path}: palm.link")
    known_source(hand.palm.source, hand.sources, f"{hand_path}: palm.source")
    return RobotDescription(
        name=top.name,
        root=root,
        joints=tuple(joints),
        actuators=tuple(actuators),
        fingers=_fingers(top, hand, hand_joints, path, hand_path),
        thumb=top.thumb,
        palm_link=palm_link,
        palm_placement=_freeze(_pose(hand.palm)),
        home=_home(top.home, units, actuators, joints, path),
        sources=sources,
    )


def _read(path: Path, type_: type[T]) -> tuple[T, dict[str, str]]:
    refuse_non_finite(read_yaml(path), path)
    return read(path, type_)


def _part(name_or_path: str | T, key: str, type_: type[T], beside: Path) -> tuple[Path, T]:
    """The arm or hand file that an arm-hand file names, or what stands there in full."""
    if not isinstance(name_or_path, str):
        return beside, name_or_path
    try:
        path = resolve(name_or_path, f"{key}s", beside=beside)
    except (UnknownNameError, DescriptionError) as error:
        raise DescriptionError(f"{beside}: {key}: {error}") from error
    return path, _read(path, type_)[0]


def _told_apart(new: dict[str, str], known: dict[str, str], owner: str) -> dict[str, str]:
    """Sources whose tag another file uses already get the owner's name before it."""
    return {f"{owner}.{tag}" if tag in known else tag: text for tag, text in new.items()}


def _joints(
    entries: list[JointEntry], root: str, sources: dict[str, str], part: str, path: Path
) -> list[Joint]:
    """Checked joints, parents before children."""
    names = [entry.name for entry in entries]
    unique(names, f"{path}: joints")
    unique([root, *(entry.child for entry in entries)], f"{path}: joints: child links")
    for entry in entries:
        where = f"{path}: joint {entry.name!r}"
        if entry.type not in JOINT_TYPES:
            raise DescriptionError(
                f"{where}: type: found {entry.type!r}, expected one of {', '.join(JOINT_TYPES)}"
            )
        low, high = entry.limits
        if not low <= high:
            raise DescriptionError(f"{where}: limits: lower {low:.6g} is above upper {high:.6g}")
        if not np.linalg.norm(entry.axis) > 1e-9:
            raise DescriptionError(f"{where}: axis: is zero, expected a direction")
        if entry.velocity is not None:
            positive(entry.velocity, f"{where}: velocity")
        known_source(entry.source, sources, f"{where}: source")
        if entry.coupling is not None:
            entry.coupling.check(f"{where}: coupling")
    by_parent: dict[str, list[JointEntry]] = {}
    for entry in entries:
        by_parent.setdefault(entry.parent, []).append(entry)
    ordered: list[JointEntry] = []
    frontier = [root]
    while frontier:
        children = by_parent.pop(frontier.pop(0), [])
        ordered += children
        frontier += [entry.child for entry in children]
    if by_parent:
        stray = next(iter(by_parent.values()))[0]
        links = {entry.child for entry in entries}
        problem = "is part of a frame cycle" if stray.parent in links else "is no link"
        raise DescriptionError(
            f"{path}: joint {stray.name!r}: parent: {stray.parent!r} {problem}; "
            f"expected a chain of joints down to the root {root!r}"
        )
    ordered.sort(key=lambda entry: names.index(entry.name))
    return [_joint(entry, part) for entry in _parents_first(ordered, root)]


def _parents_first(entries: list[JointEntry], root: str) -> list[JointEntry]:
    """The file's own order, moved only where a child stands before its parent."""
    placed, known = [], {root}
    waiting = list(entries)
    while waiting:
        entry = next(item for item in waiting if item.parent in known)
        waiting.remove(entry)
        placed.append(entry)
        known.add(entry.child)
    return placed


def _joint(entry: JointEntry, part: str) -> Joint:
    axis = np.asarray(entry.axis, dtype=float)
    return Joint(
        name=entry.name,
        parent=entry.parent,
        child=entry.child,
        type=entry.type,
        placement=_freeze(frame_matrix(entry.origin)),
        axis=_freeze(axis / np.linalg.norm(axis)),
        lower=entry.limits[0],
        upper=entry.limits[1],
        velocity=math.inf if entry.velocity is None else entry.velocity,
        coupling=entry.coupling,
        part=part,
    )


def _fixed(name: str, parent: str, child: str, pose: Array) -> Joint:
    axis = _freeze(np.array([0.0, 0.0, 1.0]))
    return Joint(
        name, parent, child, "fixed", _freeze(pose), axis, 0.0, 0.0, math.inf, None, "mount"
    )


def _actuators(
    entries: dict[str, ActuatorEntry] | None,
    joints: list[Joint],
    sources: dict[str, str],
    part: str,
    path: Path,
) -> list[Actuator]:
    """The part's actuators, after checking that every coupling ends at one of them."""
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    if entries is None:
        entries = {name: ActuatorEntry() for name, j in by_name.items() if j.coupling is None}
    actuators = []
    for name, entry in entries.items():
        where = f"{path}: actuators.{name}"
        joint = by_name.get(name)
        if joint is not None and joint.coupling is not None:
            raise DescriptionError(f"{where}: joint {name!r} follows {joint.coupling.of!r} already")
        if entry.limits is None and joint is None:
            raise DescriptionError(f"{where}: limits: missing (no joint has this name)")
        if entry.unit not in ("rad", "m"):
            raise DescriptionError(f"{where}: unit: found {entry.unit!r}, expected 'rad' or 'm'")
        low, high = entry.limits or ((joint.lower, joint.upper) if joint else (0.0, 0.0))
        if not low < high:
            raise DescriptionError(
                f"{where}: limits: lower {low:.6g} is not below upper {high:.6g}"
            )
        velocity = joint.velocity if joint else math.inf
        if entry.velocity is not None:
            velocity = positive(entry.velocity, f"{where}: velocity")
        if entry.source or joint is None:
            known_source(entry.source, sources, f"{where}: source")
        unit = ("m" if joint.type == "prismatic" else "rad") if joint else entry.unit
        actuators.append(Actuator(name, unit, low, high, velocity, part))
    check_couplings(by_name, actuators, path)
    return actuators


def _fingers(
    top: ArmHandFile, hand: HandFile, joints: list[Joint], path: Path, hand_path: Path
) -> tuple[Finger, ...]:
    unique(top.fingers, f"{path}: fingers")
    for key, name in (*(("fingers", name) for name in top.fingers), ("thumb", top.thumb)):
        if name not in hand.fingers:
            raise DescriptionError(
                f"{path}: {key}: {hand_path.name} has no finger {name!r}; it has "
                + ", ".join(hand.fingers)
            )
    if top.thumb not in top.fingers:
        raise DescriptionError(f"{path}: thumb: {top.thumb!r} is not among the fingers")
    by_child = {joint.child: joint for joint in joints}
    fingers = []
    for name in top.fingers:
        entry = hand.fingers[name]
        where = f"{hand_path}: fingers.{name}"
        link = known_link(entry.link, hand.root, joints, f"{where}.link")
        known_source(entry.source, hand.sources, f"{where}.source")
        length = float(np.linalg.norm(entry.normal))
        if not length > 1e-9:
            raise DescriptionError(f"{where}.normal: is zero, expected a direction")
        chain: list[str] = []
        while link not in (hand.root, hand.palm.link):
            if by_child[link].type != "fixed":
                chain.append(by_child[link].name)
            link = by_child[link].parent
        normal = np.asarray(entry.normal, dtype=float) / length
        fingers.append(
            Finger(
                name,
                entry.link,
                _freeze(_pose(entry)),
                _freeze(normal),
                tuple(chain[::-1]),
                _freeze(_tangent(entry.tangent, normal, where)),
            )
        )
    return tuple(fingers)


def _tangent(given: Vector | None, normal: Array, where: str) -> Array:
    """The pad's second axis (3,): what is given, else x (y if the normal is along x)."""
    along = given
    if given is None:
        along = (1.0, 0.0, 0.0) if abs(normal[0]) < ALONG else (0.0, 1.0, 0.0)
    across = np.asarray(along, dtype=float)
    across = across - normal * (normal @ across)
    length = float(np.linalg.norm(across))
    if not length > 1e-3 * float(np.linalg.norm(np.asarray(along))):
        raise DescriptionError(
            f"{where}.tangent: found {list(along or ())}, expected a direction across the normal"
        )
    return across / length


def _home(
    home: dict[str, float],
    units: dict[str, str],
    actuators: list[Actuator],
    joints: list[Joint],
    path: Path,
) -> Array:
    """The home position; where the file gives none, the position nearest to zero."""
    names = [actuator.name for actuator in actuators]
    for name in home:
        if name not in names:
            raise DescriptionError(
                f"{path}: home.{name}: no such actuator; known: {', '.join(names)}"
            )
    for actuator in actuators:
        unit = units.get(f"home.{actuator.name}", actuator.unit)
        if unit != actuator.unit:
            raise DescriptionError(
                f"{path}: home.{actuator.name}: found a number in {unit}, expected {actuator.unit}"
            )
    asked = np.array([home.get(name, 0.0) for name in names])
    movable = [joint for joint in joints if joint.type != "fixed"]
    lower, upper = motor_ranges(movable, actuators, asked, str(path))
    values = np.clip(asked, lower, upper)
    for name, value, low, high in zip(names, asked, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{path}: home.{name}: {value:.6g} is outside the limits [{low:.6g}, {high:.6g}] "
                "of the actuator and its joints"
            )
    return _freeze(values)


def _pose(entry: LinkFrame | ContactEntry) -> Array:
    return frame_matrix(Frame(entry.xyz, entry.rpy))


def _freeze(array: Array) -> Array:
    array.flags.writeable = False
    return array
