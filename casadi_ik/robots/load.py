"""Arms and hands, described or imported, become one `RobotDescription`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.arrays import Array, frozen
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
from casadi_ik.files.shipped import resolve, resolve_robot
from casadi_ik.robots.collision import link_shapes
from casadi_ik.robots.description import Actuator, Finger, Joint, RobotDescription
from casadi_ik.robots.file_parts import arm_from_file, hand_from_file
from casadi_ik.robots.motor_ranges import motor_ranges
from casadi_ik.robots.parts import (
    Part,
    arm_part,
    hand_part,
    known_link,
    told_apart,
    unique,
    usable,
)
from casadi_ik.robots.schema import (
    ArmFile,
    ArmFromFile,
    ArmHandFile,
    HandFile,
    ImportedFile,
    PadEntry,
)


@dataclass(frozen=True, eq=False)
class FlatJoints:
    """The joints of a robot without chains of fixed ones.

    Attributes:
        joints: The joints, parents before children; fixed ones are leaves but for the palm's.
        places: By link the link it is fixed to (itself, if it moves) and its (4, 4) pose there.
    """

    joints: tuple[Joint, ...]
    places: dict[str, tuple[str, Array]]


def flattened(joints: list[Joint], root: str, palm: str) -> FlatJoints:
    """Hang every joint on the nearest link above it that moves, or on root or palm.

    Args:
        joints: Parents before children.
        root: The base link.
        palm: The link of the palm, where fingers begin.
    """
    places: dict[str, tuple[str, Array]] = {root: (root, np.eye(4))}
    found: list[Joint] = []
    for joint in joints:
        link, pose = places[joint.parent]
        placement = pose @ joint.placement
        if joint.type == "fixed" and joint.child != palm:
            places[joint.child] = (link, placement)
        else:
            places[joint.child] = (joint.child, np.eye(4))
        found.append(replace(joint, parent=link, placement=frozen(placement)))
    return FlatJoints(tuple(found), places)


ALONG = 0.995
"""Cosine with the normal above which the contact frame's x axis is no tangent."""


def the_fingers(
    names: list[str], thumb: str | None, hand: Part, flat: FlatJoints, where: str
) -> tuple[Finger, ...]:
    """The fingers that a robot uses.

    Args:
        names: Their names in order.
        thumb: The one placed first, if there is one.
        hand: The hand.
        flat: All joints of the robot.
        where: The robot's file, for messages.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    unique(names, f"{where}: fingers")
    if not names:
        raise DescriptionError(f"{where}: fingers: found none, expected at least one")
    asked = [("fingers", name) for name in names]
    if thumb is not None:
        asked.append(("thumb", thumb))
    for key, name in asked:
        if name not in hand.pads:
            raise DescriptionError(
                f"{where}: {key}: {hand.name} has no finger {name!r}; it has "
                + ", ".join(hand.pads)
            )
    if thumb is not None and thumb not in names:
        raise DescriptionError(f"{where}: thumb: {thumb!r} is not among the fingers")
    return tuple(_finger(name, hand, flat) for name in names)


def _finger(name: str, hand: Part, flat: FlatJoints) -> Finger:
    entry = hand.pads[name]
    where = f"{hand.where}: fingers.{name}"
    link = known_link(entry.link, hand.root, hand.joints, f"{where}.link")
    length = float(np.linalg.norm(entry.normal))
    if not length > 1e-9:
        raise DescriptionError(f"{where}.normal: is zero, expected a direction")
    link, pose = flat.places[link]
    chain: list[str] = []
    by_child = {joint.child: joint for joint in flat.joints}
    while link in by_child and link not in (flat.places[hand.root][0], hand.tip_link):
        if by_child[link].type != "fixed":
            chain.append(by_child[link].name)
        link = by_child[link].parent
    if not chain and hand.actuators:
        raise DescriptionError(
            f"{where}.link: no joint moves {entry.link!r} against the palm {hand.tip_link!r}"
        )
    normal = np.asarray(entry.normal, dtype=float) / length
    return Finger(
        name,
        flat.places[entry.link][0],
        frozen(pose @ frame_matrix(Frame(entry.xyz, entry.rpy))),
        frozen(normal),
        tuple(chain[::-1]),
        frozen(_tangent(entry.tangent, normal, where)),
    )


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


def the_home(
    home: dict[str, float],
    units: dict[str, str],
    actuators: Sequence[Actuator],
    joints: Sequence[Joint],
    where: str,
) -> Array:
    """The home position (n,); where nothing is said, the position nearest to zero.

    Args:
        home: Positions by actuator [rad or m].
        units: Unit of those that were given with one, by key ("home.NAME").
        actuators: The motors.
        joints: All joints.
        where: The robot's file, for messages.

    Raises:
        DescriptionError: An unknown actuator, a wrong unit, or a position beyond limits.
    """
    names = [actuator.name for actuator in actuators]
    for name in home:
        if name not in names:
            raise DescriptionError(
                f"{where}: home.{name}: no such actuator; known: {', '.join(names)}"
            )
    for actuator in actuators:
        unit = units.get(f"home.{actuator.name}", actuator.unit)
        if unit != actuator.unit:
            raise DescriptionError(
                f"{where}: home.{actuator.name}: found a number in {unit}, expected {actuator.unit}"
            )
    asked = np.array([home.get(name, 0.0) for name in names])
    movable = [joint for joint in joints if joint.type != "fixed"]
    lower, upper = motor_ranges(movable, actuators, asked, where)
    values = np.clip(asked, lower, upper)
    for name, value, low, high in zip(names, asked, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{where}: home.{name}: {value:.6g} is outside the limits [{low:.6g}, {high:.6g}] "
                "of the actuator and its joints"
            )
    return frozen(values)


def load_description(name_or_path: str | Path) -> RobotDescription:
    """Load an arm-hand description.

    Args:
        name_or_path: A shipped name (`shipped_names("arm_hands")`), a shipped arm and a shipped
            hand joined by a plus sign ("panda+allegro_right"), one of the two alone ("panda",
            whose one fingertip ``flange`` is its tip, facing along z; "allegro_right", which
            stands on a fixed base), or the path of a YAML file, whose ``arm`` and ``hand`` may be
            shipped names or paths relative to it, or may stand in somebody's URDF or MJCF.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: A file is missing or malformed; the message names file and key.
        MissingExtraError: What reads a file's format is not installed.
    """
    found = resolve_robot(name_or_path)
    return _pair(*found) if isinstance(found, tuple) else _robot(found)


FLANGE = Part(
    "flange",
    "flange",
    "flange",
    *([], [], {}, "flange", np.eye(4), {}),
    pads={"flange": PadEntry("flange", (0.0, 0.0, 1.0))},
)
"""What an arm has that stands alone: its tip, which touches what is before it."""


def _pair(arm_path: Path | None, hand_path: Path | None) -> RobotDescription:
    """A shipped arm with a shipped hand, as their files say that they are put together."""
    arm = None if arm_path is None else arm_part(_read(arm_path, ArmFile)[0], arm_path)
    hand = FLANGE if hand_path is None else hand_part(_read(hand_path, HandFile)[0], hand_path)
    name = "+".join(path.stem for path in (arm_path, hand_path) if path is not None)
    return _joined(name, arm, hand.mount, hand, list(hand.pads), hand.thumb, {}, name, {}, {})


def _robot(path: Path) -> RobotDescription:
    raw = read_yaml(path)
    refuse_non_finite(raw, path)
    top, units = read(path, ImportedFile if _imports(raw) else ArmHandFile)
    usable(top.name, f"{path}: name")
    arm = None if top.arm is None else _arm(top.arm, path)
    mount = frame_matrix(top.mount)
    moved = top.mount != Frame()
    if isinstance(top, ArmHandFile):
        hand, fingers = _hand(top.hand, path), top.fingers
    else:
        entry, key = top.hand or top.robot, "hand" if top.hand else "robot"
        if entry is None or (top.hand and top.robot):
            raise DescriptionError(f"{path}: expected either 'hand' or 'robot'")
        if arm is not None and top.robot is not None:
            raise DescriptionError(f"{path}: arm: found beside 'robot', which has its own")
        hand, fingers = hand_from_file(entry, dict(top.fingers), key, path), list(top.fingers)
    if arm is None and moved:
        arm = Part("base", str(path), "base", [], [], {}, "base", np.eye(4), {})
    robot = _joined(
        top.name, arm, mount, hand, fingers, top.thumb, top.home, str(path), units, top.sources
    )
    # What a description says of a link goes before what its file says.
    said = () if top.collision is None else top.collision.links
    more = link_shapes(top.collision, robot.links, path)
    return replace(robot, shapes=robot.shapes.without(said) + more, path=path)


def _imports(raw: Any) -> bool:
    """Whether a description's hand stands in somebody's file."""
    if not isinstance(raw, dict):
        return False
    hand = raw.get("hand")
    return "robot" in raw or (isinstance(hand, dict) and "file" in hand)


def _arm(arm: str | ArmFromFile, beside: Path) -> Part:
    if not isinstance(arm, str):
        return arm_from_file(arm, "arm", beside)
    path = _file_of(arm, "arm", beside)
    return arm_part(_read(path, ArmFile)[0], path)


def _hand(hand: str | HandFile, beside: Path) -> Part:
    if not isinstance(hand, str):
        return hand_part(hand, beside)
    path = _file_of(hand, "hand", beside)
    return hand_part(_read(path, HandFile)[0], path)


def _read(path: Path, type_: type[T]) -> tuple[T, dict[str, str]]:
    refuse_non_finite(read_yaml(path), path)
    return read(path, type_)


def _file_of(name_or_path: str, key: str, beside: Path) -> Path:
    """The arm or hand file that an arm-hand file names."""
    try:
        return resolve(name_or_path, f"{key}s", beside=beside)
    except (UnknownNameError, DescriptionError) as error:
        raise DescriptionError(f"{beside}: {key}: {error}") from error


def _joined(
    name: str,
    arm: Part | None,
    mount: Array,
    hand: Part,
    fingers: list[str],
    thumb: str | None,
    home: dict[str, float],
    where: str,
    units: dict[str, str],
    sources: dict[str, str],
) -> RobotDescription:
    """The robot of an arm (if there is one) and a hand on it."""
    joints: list[Joint] = []
    root = hand.root
    sources = dict(sources)
    if arm is not None:
        hand = told_apart(hand, arm)
        joints += [*arm.joints, _fixed("mount", arm.tip_link, hand.root, arm.tip @ mount)]
        sources |= _told_apart(arm.sources, sources, arm.name)
        root = arm.root
    hand = _with_wrist(hand)
    joints += hand.joints
    actuators = [*(arm.actuators if arm else ()), *hand.actuators]
    sources |= _told_apart(hand.sources, sources, hand.name)
    unique((one.name for one in actuators), f"{where}: actuators")
    unique((joint.name for joint in joints), f"{where}: joints")
    unique((root, *(joint.child for joint in joints)), f"{where}: links")
    flat = flattened(joints, root, hand.tip_link)
    home = home or (arm.home if arm else {}) | hand.home
    if thumb is None and hand.thumb in fingers:
        thumb = hand.thumb
    return RobotDescription(
        name=name,
        root=root,
        joints=flat.joints,
        actuators=tuple(actuators),
        fingers=the_fingers(fingers, thumb, hand, flat, where),
        named_thumb=thumb,
        palm_link=hand.tip_link,
        palm_placement=frozen(hand.tip),
        home=the_home(home, units, actuators, joints, where),
        sources=sources,
        shapes=hand.shapes if arm is None else arm.shapes + hand.shapes,
    )


def _with_wrist(hand: Part) -> Part:
    """The hand, of which what moves the palm itself counts as arm, if all fingers are beyond it."""
    by_child = {joint.child: joint for joint in hand.joints}

    def above(link: str) -> list[Joint]:
        chain = []
        while link in by_child:
            chain.append(by_child[link])
            link = by_child[link].parent
        return chain

    wrist = {joint.name for joint in above(hand.tip_link)}
    beyond = all(
        hand.tip_link == hand.root or hand.tip_link in {joint.child for joint in above(pad.link)}
        for pad in hand.pads.values()
    )
    if not wrist or not beyond:
        return hand
    motors = set(wrist)
    while (
        more := {
            joint.coupling.of for joint in hand.joints if joint.name in motors and joint.coupling
        }
        - motors
    ):
        motors |= more
    return replace(
        hand,
        joints=[replace(one, part="arm") if one.name in wrist else one for one in hand.joints],
        actuators=[
            replace(one, part="arm") if one.name in motors else one for one in hand.actuators
        ],
    )


def _told_apart(new: dict[str, str], known: dict[str, str], owner: str) -> dict[str, str]:
    """Sources whose tag another file uses already get the owner's name before it."""
    return {f"{owner}.{tag}" if tag in known else tag: text for tag, text in new.items()}


def _fixed(name: str, parent: str, child: str, pose: Array) -> Joint:
    axis = frozen(np.array([0.0, 0.0, 1.0]))
    return Joint(name, parent, child, "fixed", frozen(pose), axis, 0.0, 0.0, np.inf, None, "mount")
