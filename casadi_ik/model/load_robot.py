"""Loading of robots: described or imported arms and hands become one `RobotDescription`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.reading import Frame, frame_matrix, parse_yaml, read, validated
from casadi_ik.files.shipped import BODIES_FOLDER, resolve_robot
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.imported_parts import hand_from_file
from casadi_ik.model.joining import (
    assign_wrist_to_arm,
    build_fingers,
    fixed_joint,
    join_parts,
    load_part,
)
from casadi_ik.model.link_shapes import link_shapes
from casadi_ik.model.multi_arm import body_from_file, body_from_parts
from casadi_ik.model.parts import (
    RobotPart,
    part_from_file,
    prefix_shared_names,
    require_usable_name,
)
from casadi_ik.model.schema import (
    ArmFile,
    ArmHandFile,
    BodyFile,
    HandFile,
    ImportedBody,
    ImportedFile,
    PadEntry,
)


def load_description(name_or_path: str | Path) -> RobotDescription:
    """Load a robot description.

    Args:
        name_or_path: Any of: a shipped arm-hand (`shipped_names("arm_hands")`); a shipped arm and a
            shipped hand joined by a plus sign ("panda+allegro_right"); a shipped arm ("panda",
            whose fingertip ``flange`` is its tip and faces along z) or hand ("allegro_right", on a
            fixed base); a shipped multi-arm robot (`shipped_names("bodies")`), followed by a plus
            sign and a hand if it has none ("two_ur10e+leap"); or the path of a YAML file, whose
            ``arm`` and ``hand`` may be shipped names, paths relative to it, or parts of a URDF or
            MJCF file.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: A file is missing or malformed; the message names file and key.
        MissingExtraError: The package that reads a file's format is not installed.
    """
    files = resolve_robot(name_or_path)
    if not isinstance(files, tuple):
        return _robot(files)
    first, hand = files
    if first is None or first.parent.name != BODIES_FOLDER:
        return _pair(first, hand)
    body, units = read(first, BodyFile)
    if hand is None:
        return body_from_parts(body, first, units)
    body = msgspec.structs.replace(body, name=f"{body.name}+{hand.stem}")
    return body_from_parts(body, first, units, hand.stem)


FLANGE = RobotPart(
    *("flange", "flange: ", "flange"),
    *([], [], {}, "flange", np.eye(4), {}),
    pads={"flange": PadEntry(link="flange", normal=(0.0, 0.0, 1.0))},
)
"""Hand of an arm alone: its tip, which touches along z."""


def _pair(arm_path: Path | None, hand_path: Path | None) -> RobotDescription:
    """Return a shipped arm with a shipped hand, mounted as the hand's file states."""
    arm, hand = None, FLANGE
    if arm_path is not None:
        arm = part_from_file(read(arm_path, ArmFile)[0], arm_path)
    if hand_path is not None:
        hand = part_from_file(read(hand_path, HandFile)[0], hand_path)
    name = "+".join(path.stem for path in (arm_path, hand_path) if path is not None)
    return _arm_hand(name, arm, hand.mount, hand, list(hand.pads), hand.thumb, {}, {}, {}, name)


def file_type(raw: Any) -> type[ArmHandFile | ImportedFile | BodyFile | ImportedBody]:
    """Return the type of a robot description, which its keys determine."""
    keys = raw if isinstance(raw, dict) else {}
    if "sides" in keys:
        return ImportedBody if "robot" in keys else BodyFile
    hand = keys.get("hand")
    is_imported = "robot" in keys or (isinstance(hand, dict) and "file" in hand)
    return ImportedFile if is_imported else ArmHandFile


def _robot(path: Path) -> RobotDescription:
    raw = parse_yaml(path)
    top, units = validated(raw, file_type(raw), path)
    if isinstance(top, BodyFile):
        robot = body_from_parts(top, path, units)
    elif isinstance(top, ImportedBody):
        robot = body_from_file(top, path, units)
    else:
        robot = _single_hand_robot(top, units, path)
    # Shapes of the description override those of imported files.
    overridden = () if top.collision is None else top.collision.links
    shapes = robot.shapes.remove_links(overridden) + link_shapes(top.collision, robot.links, path)
    return replace(robot, shapes=shapes, path=path)


def _single_hand_robot(
    top: ArmHandFile | ImportedFile, units: dict[str, str], path: Path
) -> RobotDescription:
    require_usable_name(top.name, f"{path}: name")
    arm = None if top.arm is None else load_part(top.arm, "arm", path)
    if isinstance(top, ArmHandFile):
        hand = load_part(top.hand, "hand", path)
    else:
        entry, key = top.hand or top.robot, "hand" if top.hand else "robot"
        if entry is None or (top.hand and top.robot):
            raise DescriptionError(f"{path}: expected either 'hand' or 'robot'")
        if arm is not None and top.robot is not None:
            raise DescriptionError(f"{path}: arm: is given together with 'robot', which has an arm")
        hand = hand_from_file(entry, top.fingers, key, path)
    if arm is None and top.mount != Frame():
        arm = RobotPart("base", f"{path}: ", "base", [], [], {}, "base", np.eye(4), {})
    return _arm_hand(
        *(top.name, arm, frame_matrix(top.mount), hand, list(top.fingers), top.thumb),
        *(top.home, units, top.sources, str(path)),
    )


def _arm_hand(
    name: str,
    arm: RobotPart | None,
    mount: Array,
    hand: RobotPart,
    fingers: list[str],
    thumb: str | None,
    home: dict[str, float],
    units: dict[str, str],
    sources: dict[str, str],
    location: str,
) -> RobotDescription:
    """Return the robot of an arm (or None) and a hand on it."""
    if arm is not None:
        hand = prefix_shared_names(hand, arm)
    hand = assign_wrist_to_arm(hand)
    joints, root, parts = list(hand.joints), hand.root, [(hand.name, hand)]
    if arm is not None:
        mount_joint = fixed_joint("mount", arm.tip_link, hand.root, arm.tip @ mount)
        joints, root = [*arm.joints, mount_joint, *joints], arm.root
        parts.insert(0, (arm.name, arm))
    home = home or {motor: value for _, part in parts for motor, value in part.home.items()}
    palms = {hand.tip_link}
    robot, flat = join_parts(name, root, joints, parts, palms, home, units, sources, location)
    if thumb is None and hand.thumb in fingers:
        thumb = hand.thumb
    return replace(
        robot,
        fingers=build_fingers(fingers, thumb, hand, flat, f"{location}: "),
        named_thumb=thumb,
        palm_link=hand.tip_link,
        palm_placement=read_only(hand.tip),
    )
