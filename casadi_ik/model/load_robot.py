"""Loading of robots: described or imported arms and hands become one `RobotDescription`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

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
        return _robot_from_file(files)
    arm_or_body, hand = files
    if arm_or_body is None or arm_or_body.parent.name != BODIES_FOLDER:
        return _shipped_arm_hand(arm_or_body, hand)
    body, units = read(arm_or_body, BodyFile)
    if hand is None:
        return body_from_parts(body, arm_or_body, units)
    body = msgspec.structs.replace(body, name=f"{body.name}+{hand.stem}")
    return body_from_parts(body, arm_or_body, units, hand.stem)


FLANGE = RobotPart.one_link(
    "flange",
    location="flange: ",
    pads={"flange": PadEntry(link="flange", normal=(0.0, 0.0, 1.0))},
)
"""Hand of an arm alone: its tip, which touches along z."""


def _shipped_arm_hand(arm_path: Path | None, hand_path: Path | None) -> RobotDescription:
    """Return a shipped arm with a shipped hand, mounted as the hand's file states.

    An arm without a hand has its flange as the only fingertip; a hand without an arm has a fixed
    base.
    """
    arm, hand = None, FLANGE
    if arm_path is not None:
        arm = part_from_file(read(arm_path, ArmFile)[0], arm_path)
    if hand_path is not None:
        hand = part_from_file(read(hand_path, HandFile)[0], hand_path)
    name = "+".join(path.stem for path in (arm_path, hand_path) if path is not None)
    return _arm_hand(
        name=name,
        arm=arm,
        mount=hand.mount,
        hand=hand,
        fingers=list(hand.pads),
        thumb=hand.thumb,
        location=name,
        home={},
        units={},
        sources={},
    )


def file_type(raw: Any) -> type[ArmHandFile | ImportedFile | BodyFile | ImportedBody]:
    """Return the type of a robot description, which its keys determine."""
    keys = raw if isinstance(raw, dict) else {}
    if "sides" in keys:
        return ImportedBody if "robot" in keys else BodyFile
    hand = keys.get("hand")
    is_imported = "robot" in keys or (isinstance(hand, dict) and "file" in hand)
    return ImportedFile if is_imported else ArmHandFile


def _robot_from_file(path: Path) -> RobotDescription:
    """Return the robot of a description file."""
    raw = parse_yaml(path)
    robot_file, units = validated(raw, file_type(raw), path)
    if isinstance(robot_file, BodyFile):
        robot = body_from_parts(robot_file, path, units)
    elif isinstance(robot_file, ImportedBody):
        robot = body_from_file(robot_file, path, units)
    else:
        robot = _arm_hand_from_file(robot_file, units, path)
    # Shapes of the description override those of imported files.
    collision = robot_file.collision
    overridden = () if collision is None else collision.links
    shapes = robot.shapes.remove_links(overridden) + link_shapes(collision, robot.links, path)
    return replace(robot, shapes=shapes, path=path)


def _arm_hand_from_file(
    robot_file: ArmHandFile | ImportedFile, units: dict[str, str], path: Path
) -> RobotDescription:
    """Return an arm-hand, or a hand on a fixed base, whose parts are in one or two files."""
    require_usable_name(robot_file.name, f"{path}: name")
    arm = None if robot_file.arm is None else load_part(robot_file.arm, "arm", path)
    if isinstance(robot_file, ArmHandFile):
        hand = load_part(robot_file.hand, "hand", path)
    else:
        entry = robot_file.hand or robot_file.robot
        if entry is None or (robot_file.hand and robot_file.robot):
            raise DescriptionError(f"{path}: expected either 'hand' or 'robot'")
        if arm is not None and robot_file.robot is not None:
            raise DescriptionError(f"{path}: arm: is given together with 'robot', which has an arm")
        key = "hand" if robot_file.hand else "robot"
        hand = hand_from_file(entry, robot_file.fingers, key, path)
    if arm is None and robot_file.mount != Frame():
        arm = RobotPart.one_link("base", location=f"{path}: ")
    return _arm_hand(
        name=robot_file.name,
        arm=arm,
        mount=frame_matrix(robot_file.mount),
        hand=hand,
        fingers=list(robot_file.fingers),
        thumb=robot_file.thumb,
        location=str(path),
        home=robot_file.home,
        units=units,
        sources=robot_file.sources,
    )


def _arm_hand(
    name: str,
    arm: RobotPart | None,
    mount: Array,
    hand: RobotPart,
    fingers: list[str],
    thumb: str | None,
    location: str,
    home: dict[str, float],
    units: dict[str, str],
    sources: dict[str, str],
) -> RobotDescription:
    """Return the robot of an arm and a hand.

    Args:
        name: Name of the robot.
        arm: The arm; None for a hand on a fixed base.
        mount: (4, 4) pose of the hand's root on the arm's tip.
        hand: The hand.
        fingers: Names of the fingers.
        thumb: Finger placed first; None for the thumb of the hand's file.
        location: File or name for error messages.
        home: Positions by actuator [rad or m]; empty for the positions of the parts.
        units: Units of numbers that have one, by key.
        sources: Sources of the robot by tag.
    """
    if arm is not None:
        hand = prefix_shared_names(hand, arm)
    hand = assign_wrist_to_arm(hand)
    joints, root, parts = list(hand.joints), hand.root, [(hand.name, hand)]
    if arm is not None:
        mount_joint = fixed_joint("mount", arm.tip_link, hand.root, arm.tip @ mount)
        joints, root = [*arm.joints, mount_joint, *joints], arm.root
        parts.insert(0, (arm.name, arm))
    home = home or {motor: value for _, part in parts for motor, value in part.home.items()}
    robot, flat = join_parts(
        name=name,
        root=root,
        joints=joints,
        parts=parts,
        preserved={hand.tip_link},
        home=home,
        units=units,
        sources=sources,
        location=location,
    )
    if thumb is None and hand.thumb in fingers:
        thumb = hand.thumb
    return replace(
        robot,
        fingers=build_fingers(fingers, thumb, hand, flat, f"{location}: "),
        named_thumb=thumb,
        palm_link=hand.tip_link,
        palm_placement=read_only(hand.tip),
    )
