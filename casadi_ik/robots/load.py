"""Arms and hands, described or imported, become one `RobotDescription`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from casadi_ik.arrays import Array, frozen
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import (
    Frame,
    checked,
    frame_matrix,
    parse_yaml,
    read,
)
from casadi_ik.files.shipped import BODIES, resolve_robot
from casadi_ik.robots.bodies import body_from_file, body_from_parts
from casadi_ik.robots.collision import link_shapes
from casadi_ik.robots.description import Joint, RobotDescription
from casadi_ik.robots.file_parts import hand_from_file
from casadi_ik.robots.joining import (
    a_part,
    fixed_joint,
    flattened,
    own_tags,
    the_fingers,
    the_home,
    with_wrist,
)
from casadi_ik.robots.parts import (
    Part,
    arm_part,
    hand_part,
    told_apart,
    unique,
    usable,
)
from casadi_ik.robots.schema import (
    ArmFile,
    ArmHandFile,
    BodyFile,
    HandFile,
    ImportedBody,
    ImportedFile,
    PadEntry,
)


def load_description(name_or_path: str | Path) -> RobotDescription:
    """Load an arm-hand description.

    Args:
        name_or_path: A shipped name (`shipped_names("arm_hands")`), a shipped arm and a shipped
            hand joined by a plus sign ("panda+allegro_right"), one of the two alone ("panda",
            whose one fingertip ``flange`` is its tip, facing along z; "allegro_right", which
            stands on a fixed base), a shipped body (`shipped_names("bodies")`, "g1+dex3") with a
            hand after a plus sign if it has none ("two_ur10e+leap"), or the path of a YAML file,
            whose ``arm`` and ``hand`` may be shipped names or paths relative to it, or may stand in
            somebody's URDF or MJCF.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: A file is missing or malformed; the message names file and key.
        MissingExtraError: What reads a file's format is not installed.
    """
    found = resolve_robot(name_or_path)
    if not isinstance(found, tuple):
        return _robot(found)
    first, hand = found
    if first is not None and first.parent.name == BODIES:
        return _body_with_hand(first, hand)
    return _pair(first, hand)


def _body_with_hand(path: Path, hand: Path | None) -> RobotDescription:
    """A shipped body, each of whose arms gets a shipped hand."""
    body, units = read(path, BodyFile)
    if hand is not None:
        body = msgspec.structs.replace(body, name=f"{body.name}+{hand.stem}")
    return body_from_parts(body, path, units, None if hand is None else hand.stem)


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
    arm = None if arm_path is None else arm_part(read(arm_path, ArmFile)[0], arm_path)
    hand = FLANGE if hand_path is None else hand_part(read(hand_path, HandFile)[0], hand_path)
    name = "+".join(path.stem for path in (arm_path, hand_path) if path is not None)
    return _joined(name, arm, hand.mount, hand, list(hand.pads), hand.thumb, {}, name, {}, {})


def _robot(path: Path) -> RobotDescription:
    raw = parse_yaml(path)
    if isinstance(raw, dict) and "sides" in raw:
        return _body(raw, path)
    top, units = checked(raw, ImportedFile if _imports(raw) else ArmHandFile, path)
    usable(top.name, f"{path}: name")
    arm = None if top.arm is None else a_part(top.arm, "arm", path)
    mount = frame_matrix(top.mount)
    moved = top.mount != Frame()
    if isinstance(top, ArmHandFile):
        hand, fingers = a_part(top.hand, "hand", path), top.fingers
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


def _body(raw: dict[str, Any], path: Path) -> RobotDescription:
    if "robot" in raw:
        top, units = checked(raw, ImportedBody, path)
        robot = body_from_file(top, path, units)
    else:
        top, units = checked(raw, BodyFile, path)
        robot = body_from_parts(top, path, units)
    said = () if top.collision is None else top.collision.links
    more = link_shapes(top.collision, robot.links, path)
    return replace(robot, shapes=robot.shapes.without(said) + more, path=path)


def _imports(raw: Any) -> bool:
    """Whether a description's hand stands in somebody's file."""
    if not isinstance(raw, dict):
        return False
    hand = raw.get("hand")
    return "robot" in raw or (isinstance(hand, dict) and "file" in hand)


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
        joints += [*arm.joints, fixed_joint("mount", arm.tip_link, hand.root, arm.tip @ mount)]
        sources |= own_tags(arm.sources, sources, arm.name)
        root = arm.root
    hand = with_wrist(hand)
    joints += hand.joints
    actuators = [*(arm.actuators if arm else ()), *hand.actuators]
    sources |= own_tags(hand.sources, sources, hand.name)
    unique((one.name for one in actuators), f"{where}: actuators")
    unique((joint.name for joint in joints), f"{where}: joints")
    unique((root, *(joint.child for joint in joints)), f"{where}: links")
    flat = flattened(joints, root, {hand.tip_link})
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
