"""Composition of robots: the joints of several parts become one tree.

The parts are described, or imported from URDF and MJCF files.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.reading import Vector, frame_matrix, read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.model.description import Finger, RobotDescription
from casadi_ik.model.imported_parts import arm_from_file
from casadi_ik.model.joints import Actuator, Joint, chain_to, motor_ranges, require_name
from casadi_ik.model.link_shapes import NO_SHAPES
from casadi_ik.model.parts import (
    RobotPart,
    part_from_file,
    require_unique,
)
from casadi_ik.model.schema import (
    ArmFile,
    ArmFromFile,
    BallPad,
    HandFile,
)


@dataclass(frozen=True, eq=False)
class FlatJoints:
    """The joints of a robot without chains of fixed joints.

    Attributes:
        joints: Joints, parents before children; fixed ones are leaves, except those of palms.
        anchors: By link, the link that it is fixed to (itself if it moves) and its (4, 4) pose
            there.
    """

    joints: tuple[Joint, ...]
    anchors: dict[str, tuple[str, Array]]


def flattened(joints: Sequence[Joint], root: str, preserved: Collection[str]) -> FlatJoints:
    """Attach every joint to the nearest moving link above it, to the root, or to a preserved link.

    Args:
        joints: Joints, parents before children.
        root: Root link.
        preserved: Fixed links that are not merged: palms, where fingers start.
    """
    anchors: dict[str, tuple[str, Array]] = {root: (root, np.eye(4))}
    flat: list[Joint] = []
    for joint in joints:
        link, pose = anchors[joint.parent]
        placement = pose @ joint.placement
        if joint.type == "fixed" and joint.child not in preserved:
            anchors[joint.child] = (link, placement)
        else:
            anchors[joint.child] = (joint.child, np.eye(4))
        flat.append(replace(joint, parent=link, placement=read_only(placement)))
    return FlatJoints(tuple(flat), anchors)


def join_parts(
    name: str,
    root: str,
    joints: Sequence[Joint],
    parts: Sequence[tuple[str, RobotPart]],
    preserved: Collection[str],
    home: dict[str, float],
    units: dict[str, str],
    sources: dict[str, str],
    location: str,
) -> tuple[RobotDescription, FlatJoints]:
    """Return a robot without palms and fingers, and its flattened joints.

    Args:
        name: Name of the robot.
        root: Root link.
        joints: All joints, parents before children.
        parts: Parts in the order of their motors, each with the prefix that makes tags of its
            sources unique.
        preserved: Fixed links that are not merged.
        home: Positions by actuator [rad or m].
        units: Units of numbers that have one, by key.
        sources: Sources of the robot by tag.
        location: File for error messages.

    Raises:
        DescriptionError: A part is malformed; the message names file, key and expected value.
    """
    actuators = [actuator for _, part in parts for actuator in part.actuators]
    require_unique((actuator.name for actuator in actuators), f"{location}: actuators")
    require_unique((joint.name for joint in joints), f"{location}: joints")
    require_unique((root, *(joint.child for joint in joints)), f"{location}: links")
    flat, all_sources = flattened(joints, root, preserved), dict(sources)
    for prefix, part in parts:
        all_sources |= {
            f"{prefix}.{tag}" if tag in all_sources else tag: text
            for tag, text in part.sources.items()
        }
    robot = RobotDescription(
        name=name,
        root=root,
        joints=flat.joints,
        actuators=tuple(actuators),
        fingers=(),
        named_thumb=None,
        palm_link=root,
        palm_placement=read_only(np.eye(4)),
        home=_home(home, units, actuators, joints, location),
        sources=all_sources,
        shapes=sum((part.shapes for _, part in parts), NO_SHAPES),
    )
    return robot, flat


MAX_NORMAL_COSINE = 0.995
"""Cosine with the normal above which the contact frame's x axis is not used as tangent."""


def build_fingers(
    names: Sequence[str],
    thumb: str | None,
    hand: RobotPart,
    flat: FlatJoints,
    location: str,
    side: str = "",
) -> tuple[Finger, ...]:
    """Return the fingers that a robot uses.

    Args:
        names: Names of the fingers in order.
        thumb: Finger placed first; None if there is none.
        hand: The hand.
        flat: All joints of the robot.
        location: Prefix of the keys ``fingers`` and ``thumb`` in error messages.
        side: Prefix of all names that messages omit.

    Raises:
        DescriptionError: A finger is malformed; the message names file, key and expected value.
    """
    require_unique(names, f"{location}fingers")
    if not names:
        raise DescriptionError(f"{location}fingers: is empty; expected at least one finger")
    named = [("fingers", name) for name in names]
    if thumb is not None:
        named.append(("thumb", thumb))
    for key, name in named:
        if name not in hand.pads:
            raise DescriptionError(
                f"{location}{key}: {hand.name} has no finger {name.removeprefix(side)!r}; "
                "expected one of: " + ", ".join(pad.removeprefix(side) for pad in hand.pads)
            )
    if thumb is not None and thumb not in names:
        raise DescriptionError(
            f"{location}thumb: {thumb.removeprefix(side)!r} is not one of the fingers"
        )
    return tuple(_finger(name, hand, flat, side) for name in names)


def _finger(name: str, hand: RobotPart, flat: FlatJoints, side: str) -> Finger:
    """Return a finger whose pad, joints and frames are those of the flattened hand."""
    entry = hand.pads[name]
    location = f"{hand.location}fingers.{name.removeprefix(side)}"
    link, pose = flat.anchors[require_name(entry.link, hand.links, "link", f"{location}.link")]
    length = float(np.linalg.norm(entry.normal))
    if not length > 1e-9:
        raise DescriptionError(f"{location}.normal: is zero; expected a direction")
    chain: list[str] = []
    by_child = {joint.child: joint for joint in flat.joints}
    current = link
    while current in by_child and current not in (flat.anchors[hand.root][0], hand.tip_link):
        if by_child[current].type != "fixed":
            chain.append(by_child[current].name)
        current = by_child[current].parent
    # A pad on the palm's link is the fixed jaw of a gripper.
    if not chain and hand.actuators and entry.link != hand.tip_link:
        raise DescriptionError(
            f"{location}.link: no joint moves {entry.link!r} relative to the palm "
            f"{hand.tip_link!r}; expected a link of a finger"
        )
    normal = np.asarray(entry.normal, dtype=float) / length
    return Finger(
        name=name,
        link=link,
        placement=read_only(pose @ frame_matrix(entry)),
        normal=read_only(normal),
        joints=tuple(chain[::-1]),
        tangent=read_only(_tangent(entry.tangent, normal, location)),
        radius=entry.pad.radius if isinstance(entry.pad, BallPad) else 0.0,
    )


def _tangent(stated: Vector | None, normal: Array, location: str) -> Array:
    """Return the pad's second axis (3,): the stated one, or x (y if the normal is along x)."""
    axis = stated
    if stated is None:
        axis = (1.0, 0.0, 0.0) if abs(normal[0]) < MAX_NORMAL_COSINE else (0.0, 1.0, 0.0)
    tangent = np.asarray(axis, dtype=float)
    tangent = tangent - normal * (normal @ tangent)
    length = float(np.linalg.norm(tangent))
    if not length > 1e-3 * float(np.linalg.norm(np.asarray(axis))):
        raise DescriptionError(
            f"{location}.tangent: {list(axis or ())} is parallel to the normal; "
            "expected another direction"
        )
    return tangent / length


def _home(
    home: Mapping[str, float],
    units: Mapping[str, str],
    actuators: Sequence[Actuator],
    joints: Sequence[Joint],
    location: str,
) -> Array:
    """Return the home position (n,); missing values are as close to zero as possible."""
    names = [actuator.name for actuator in actuators]
    for name in home:
        if name not in names:
            raise DescriptionError(
                f"{location}: home.{name}: actuator is unknown; expected one of: {', '.join(names)}"
            )
    for actuator in actuators:
        unit = units.get(f"home.{actuator.name}", actuator.unit)
        if unit != actuator.unit:
            raise DescriptionError(
                f"{location}: home.{actuator.name}: found a number in {unit}, "
                f"expected {actuator.unit}"
            )
    positions = np.array([home.get(name, 0.0) for name in names])
    movable = [joint for joint in joints if joint.type != "fixed"]
    lower, upper = motor_ranges(movable, actuators, positions, location)
    for name, value, low, high in zip(names, positions, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{location}: home.{name}: {value:.6g} is outside the limits "
                f"[{low:.6g}, {high:.6g}] of the actuator and its joints"
            )
    return read_only(np.clip(positions, lower, upper))


def load_part(entry: str | ArmFromFile | HandFile, key: str, description: Path) -> RobotPart:
    """Return the trunk, arm or hand that a robot file names or contains.

    Args:
        entry: Shipped name, path, part of a URDF or MJCF file, or description of a hand.
        key: Key of the entry; its last word is the kind of part.
        description: File of the robot, from which paths are relative.

    Raises:
        DescriptionError: The part is malformed; the message names file, key and expected value.
    """
    if isinstance(entry, ArmFromFile):
        return arm_from_file(entry, key, description)
    if isinstance(entry, HandFile):
        return part_from_file(entry, description)
    kind = key.rpartition(".")[2]
    try:
        path = resolve_description(entry, f"{kind}s", relative_to=description)
    except (UnknownNameError, DescriptionError) as error:
        raise DescriptionError(f"{description}: {key}: {error}") from error
    return part_from_file(read(path, HandFile if kind == "hand" else ArmFile)[0], path)


def assign_wrist_to_arm(hand: RobotPart) -> RobotPart:
    """Return the hand with joints above the palm assigned to the arm.

    The hand is returned unchanged if a finger is not below the palm.
    """
    wrist = {joint.name for joint in chain_to(hand, hand.tip_link)}
    below_palm = all(
        hand.tip_link in {joint.child for joint in chain_to(hand, pad.link)}
        for pad in hand.pads.values()
    )
    if not wrist or not below_palm:
        return hand
    motors = set(wrist)
    while (
        leaders := {
            joint.coupling.of for joint in hand.joints if joint.name in motors and joint.coupling
        }
        - motors
    ):
        motors |= leaders
    return replace(
        hand,
        joints=[
            replace(joint, part="arm") if joint.name in wrist else joint for joint in hand.joints
        ],
        actuators=[
            replace(motor, part="arm") if motor.name in motors else motor
            for motor in hand.actuators
        ],
    )


def fixed_joint(name: str, parent: str, child: str, pose: Array) -> Joint:
    """Return the fixed joint of a link at a pose (4, 4) on another link."""
    axis = read_only(np.array([0.0, 0.0, 1.0]))
    return Joint(
        name, parent, child, "fixed", read_only(pose), axis, 0.0, 0.0, np.inf, None, "mount"
    )
