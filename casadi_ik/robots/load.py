"""Arms and hands, described or imported, become one `RobotDescription`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.reading import (
    Frame,
    T,
    frame_matrix,
    read,
    read_yaml,
    refuse_non_finite,
)
from casadi_ik.files.shipped import resolve, resolve_robot
from casadi_ik.robots.checks import unique, usable
from casadi_ik.robots.collision import link_shapes
from casadi_ik.robots.described_parts import arm_part, hand_part
from casadi_ik.robots.description import Joint, RobotDescription, frozen
from casadi_ik.robots.file_parts import arm_from_file, hand_from_file
from casadi_ik.robots.fingers import the_fingers
from casadi_ik.robots.flat import flattened
from casadi_ik.robots.home import the_home
from casadi_ik.robots.part import HandPart, Part, told_apart
from casadi_ik.robots.schema import (
    ArmFile,
    ArmFromFile,
    ArmHandFile,
    HandFile,
    ImportedFile,
    PadEntry,
)


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


FLANGE = HandPart(
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
    return replace(robot, shapes=robot.shapes.without(said) + more)


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


def _hand(hand: str | HandFile, beside: Path) -> HandPart:
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
    hand: HandPart,
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


def _with_wrist(hand: HandPart) -> HandPart:
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
