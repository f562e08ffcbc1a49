"""Composition of robots: arm and hand as one tree of joints, and multi-arm robots on one trunk.

The parts are described, or imported from URDF and MJCF files.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.reading import Frame, Vector, frame_matrix, read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.model.description import Finger, RobotDescription, Side
from casadi_ik.model.imported_parts import arm_from_file, hand_from_file, palm_frame
from casadi_ik.model.joints import Actuator, Joint
from casadi_ik.model.link_shapes import NO_SHAPES
from casadi_ik.model.linkage import chain_to, joints_below, require_name
from casadi_ik.model.motor_ranges import motor_ranges
from casadi_ik.model.parts import (
    RobotPart,
    mirrored,
    part_from_file,
    prefix_side,
    require_unique,
    require_usable_name,
)
from casadi_ik.model.schema import (
    ArmFile,
    ArmFromFile,
    BallPad,
    BodyFile,
    FileSide,
    HandFile,
    ImportedBody,
    PartSide,
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
        preserved: Fixed links that are not merged: palms, from which fingers start.
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
    where: str,
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
        where: File, for messages.

    Raises:
        DescriptionError: A part is malformed; the message names file, key and expected value.
    """
    actuators = [actuator for _, part in parts for actuator in part.actuators]
    require_unique((actuator.name for actuator in actuators), f"{where}: actuators")
    require_unique((joint.name for joint in joints), f"{where}: joints")
    require_unique((root, *(joint.child for joint in joints)), f"{where}: links")
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
        home=_home(home, units, actuators, joints, where),
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
    where: str,
    side: str = "",
) -> tuple[Finger, ...]:
    """Return the fingers that a robot uses.

    Args:
        names: Names of the fingers in order.
        thumb: Finger placed first; None if there is none.
        hand: The hand.
        flat: All joints of the robot.
        where: Prefix of the keys ``fingers`` and ``thumb`` in messages.
        side: Prefix of all names that messages omit.

    Raises:
        DescriptionError: A finger is malformed; the message names file, key and expected value.
    """
    require_unique(names, f"{where}fingers")
    if not names:
        raise DescriptionError(f"{where}fingers: found none, expected at least one")
    named = [("fingers", name) for name in names]
    if thumb is not None:
        named.append(("thumb", thumb))
    for key, name in named:
        if name not in hand.pads:
            raise DescriptionError(
                f"{where}{key}: {hand.name} has no finger {name.removeprefix(side)!r}; it has "
                + ", ".join(pad.removeprefix(side) for pad in hand.pads)
            )
    if thumb is not None and thumb not in names:
        raise DescriptionError(
            f"{where}thumb: {thumb.removeprefix(side)!r} is not among the fingers"
        )
    return tuple(_finger(name, hand, flat, side) for name in names)


def _finger(name: str, hand: RobotPart, flat: FlatJoints, side: str) -> Finger:
    entry = hand.pads[name]
    where = f"{hand.where}fingers.{name.removeprefix(side)}"
    link, pose = flat.anchors[require_name(entry.link, hand.links, "link", f"{where}.link")]
    length = float(np.linalg.norm(entry.normal))
    if not length > 1e-9:
        raise DescriptionError(f"{where}.normal: is zero, expected a direction")
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
            f"{where}.link: no joint moves {entry.link!r} against the palm {hand.tip_link!r}"
        )
    normal = np.asarray(entry.normal, dtype=float) / length
    return Finger(
        name,
        link,
        read_only(pose @ frame_matrix(entry)),
        read_only(normal),
        tuple(chain[::-1]),
        read_only(_tangent(entry.tangent, normal, where)),
        entry.pad.radius if isinstance(entry.pad, BallPad) else 0.0,
    )


def _tangent(stated: Vector | None, normal: Array, where: str) -> Array:
    """Return the pad's second axis (3,): the stated one, or x (y if the normal is along x)."""
    axis = stated
    if stated is None:
        axis = (1.0, 0.0, 0.0) if abs(normal[0]) < MAX_NORMAL_COSINE else (0.0, 1.0, 0.0)
    tangent = np.asarray(axis, dtype=float)
    tangent = tangent - normal * (normal @ tangent)
    length = float(np.linalg.norm(tangent))
    if not length > 1e-3 * float(np.linalg.norm(np.asarray(axis))):
        raise DescriptionError(
            f"{where}.tangent: found {list(axis or ())}, expected a direction across the normal"
        )
    return tangent / length


def _home(
    home: Mapping[str, float],
    units: Mapping[str, str],
    actuators: Sequence[Actuator],
    joints: Sequence[Joint],
    where: str,
) -> Array:
    """Return the home position (n,); missing values are as close to zero as possible."""
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
    positions = np.array([home.get(name, 0.0) for name in names])
    movable = [joint for joint in joints if joint.type != "fixed"]
    lower, upper = motor_ranges(movable, actuators, positions, where)
    for name, value, low, high in zip(names, positions, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{where}: home.{name}: {value:.6g} is outside the limits [{low:.6g}, {high:.6g}] "
                "of the actuator and its joints"
            )
    return read_only(np.clip(positions, lower, upper))


def load_part(entry: str | ArmFromFile | HandFile, key: str, description: Path) -> RobotPart:
    """Return the trunk, arm or hand that a robot file names or contains.

    Args:
        entry: Shipped name, path, part of a URDF or MJCF file, or description of a hand.
        key: Key of the entry; its last word is the kind of part.
        description: File of the robot, to which paths are relative.

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


FIXED_BASE = RobotPart("base", "", "base", [], [], {}, "base", np.eye(4), {})
"""Trunk of a multi-arm robot on a fixed base."""

MAX_SIDES = 4


@dataclass(frozen=True, eq=False)
class _SidePart:
    """A side of a multi-arm robot during its composition.

    Attributes:
        name: Name of the side.
        hand: Its hand.
        fingers: Names of the fingers.
        thumb: Finger placed first.
        motors: Motors of arm and of hand, if known.
    """

    name: str
    hand: RobotPart
    fingers: Sequence[str]
    thumb: str | None
    motors: tuple[tuple[str, ...], ...] = ()


def body_from_parts(
    body: BodyFile, where: Path, units: dict[str, str], hand: str | None = None
) -> RobotDescription:
    """Return a multi-arm robot that is composed of parts.

    Args:
        body: Record of its file.
        where: The file, to which paths are relative.
        units: Units of numbers that have one, by key.
        hand: Name of the hand of sides that name none.

    Raises:
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    _check_sides(body.name, body.sides, where)
    with_pose = [name for name, entry in body.sides.items() if entry.at is not None]
    for name in body.sides:
        if with_pose and name not in with_pose:
            raise DescriptionError(
                f"{where}: sides.{name}.at: found none, expected one as in sides.{with_pose[0]} "
                "(at: {} is the trunk's end)"
            )
    arms = {
        name: _maybe_mirrored(
            load_part(entry.arm, f"sides.{name}.arm", where), entry, "arm", name, where
        )
        for name, entry in body.sides.items()
    }
    trunk = None if body.trunk is None else load_part(body.trunk, "trunk", where)
    roots = {arm.root for arm in arms.values()}
    has_common_root = len(roots) == 1 and all(entry.at is None for entry in body.sides.values())
    # Arms whose root is the trunk's end, or a common link, share that link.
    is_shared = has_common_root and (trunk is None or roots == {trunk.tip_link})
    shared = roots.pop() if is_shared else None
    base = FIXED_BASE if trunk is None else trunk
    if trunk is None and shared is not None:
        base = replace(FIXED_BASE, root=shared, tip_link=shared)
    joints, parts = list(base.joints), [(base.name, base)]
    home, sides = dict(base.home), []
    for name, entry in body.sides.items():
        arm = prefix_side(arms[name], name, shared)
        key = f"sides.{name}.hand"
        hand_entry = entry.hand if entry.hand is not None else hand
        if hand_entry is None:
            raise DescriptionError(f"{where}: {key}: missing; write one, or load BODY+HAND by name")
        side_hand = _maybe_mirrored(load_part(hand_entry, key, where), entry, "hand", name, where)
        mount = side_hand.mount if entry.mount is None else frame_matrix(entry.mount)
        side_hand = assign_wrist_to_arm(prefix_side(side_hand, name, shared))
        if shared is None:
            at = base.tip @ frame_matrix(entry.at or Frame())
            joints.append(fixed_joint(f"{name}_base", base.tip_link, arm.root, at))
        elif sides or trunk is not None:
            arm = replace(arm, shapes=arm.shapes.without([shared]))
        mount_joint = fixed_joint(f"{name}_mount", arm.tip_link, side_hand.root, arm.tip @ mount)
        joints += [*arm.joints, mount_joint, *side_hand.joints]
        parts += [(f"{name}.{part.name}", part) for part in (arm, side_hand)]
        home |= arm.home | side_hand.home
        fingers = list(side_hand.pads)
        if entry.fingers is not None:
            fingers = [f"{name}_{finger}" for finger in entry.fingers]
        thumb = side_hand.thumb if side_hand.thumb in fingers else None
        thumb = thumb if entry.thumb is None else f"{name}_{entry.thumb}"
        motors = [*arm.actuators, *side_hand.actuators]
        split = (
            tuple(motor.name for motor in motors if (motor.part == "arm") is is_arm)
            for is_arm in (True, False)
        )
        sides.append(_SidePart(name, side_hand, fingers, thumb, tuple(split)))
    palms = {side.hand.tip_link for side in sides}
    robot_and_joints = join_parts(
        *(body.name, base.root, joints, parts, palms | {base.tip_link}),
        *(home | body.home, units, body.sources, str(where)),
    )
    return _with_sides(*robot_and_joints, sides, base.tip_link, where)


def body_from_file(body: ImportedBody, where: Path, units: dict[str, str]) -> RobotDescription:
    """Return a multi-arm robot of one URDF or MJCF file.

    Args:
        body: Record of its description.
        where: The description, to which the file is relative.
        units: Units of numbers that have one, by key.

    Raises:
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    _check_sides(body.name, body.sides, where)
    if body.robot.palm is not None:
        raise DescriptionError(f"{where}: robot.palm: found one, expected it under each of 'sides'")
    robot = hand_from_file(body.robot, {}, "robot", where)
    sides, chains = [], {}
    for name, entry in body.sides.items():
        side, chains[name] = _side_in_file(name, entry, robot, where)
        sides.append(side)
    end = _trunk_end(body.trunk, sides, chains, robot, where)
    robot_and_joints = join_parts(
        *(body.name, robot.root, robot.joints, [("robot", robot)]),
        {end, *(side.hand.tip_link for side in sides)},
        *(body.home, units, body.sources, str(where)),
    )
    return _with_sides(*robot_and_joints, sides, end, where)


def _side_in_file(
    name: str, entry: FileSide, robot: RobotPart, where: Path
) -> tuple[_SidePart, list[str]]:
    """Return a side, and the links from the root to its palm."""
    key, palm = f"{where}: sides.{name}.", palm_frame(entry.palm)
    require_name(palm.link, robot.links, "link", f"{key}palm")
    pads = {f"{name}_{finger}": pad for finger, pad in entry.fingers.items()}
    for finger, pad in entry.fingers.items():
        require_name(pad.link, robot.links, "link", f"{key}fingers.{finger}.link")
        if palm.link not in _links_to(pad.link, robot):
            raise DescriptionError(
                f"{key}fingers.{finger}.link: {pad.link!r} is not below the palm "
                f"{palm.link!r}; expected another link or another palm"
            )
    hand = replace(
        robot,
        name=f"side {name!r}",
        where=key,
        tip_link=palm.link,
        tip=frame_matrix(palm),
        pads=pads,
    )
    thumb = None if entry.thumb is None else f"{name}_{entry.thumb}"
    return _SidePart(name, hand, list(pads), thumb), _links_to(palm.link, robot)


def _trunk_end(
    stated: str | None,
    sides: Sequence[_SidePart],
    chains: dict[str, list[str]],
    robot: RobotPart,
    where: Path,
) -> str:
    """Return the link that carries the sides: as stated, or the last one above all palms."""
    for side in sides:
        for lower_side in sides:
            if lower_side is not side and side.hand.tip_link in chains[lower_side.name]:
                raise DescriptionError(
                    f"{where}: sides.{side.name}.palm: found {side.hand.tip_link!r}, which carries "
                    f"the palm of {lower_side.name!r} too; expected palms on separate branches"
                )
    if stated is None and len(sides) == 1:
        raise DescriptionError(
            f"{where}: trunk: missing; expected a link, since a single side does not determine it"
        )
    first, *remaining = chains.values()
    common = [link for link in first if all(link in chain for chain in remaining)]
    end = (
        common[-1]
        if stated is None
        else require_name(stated, robot.links, "link", f"{where}: trunk")
    )
    for name, chain in chains.items():
        if end not in chain:
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, which does not carry the palm of {name!r}; "
                f"expected a link that carries all palms, such as {common[-1]!r}"
            )
    for joint in chain_to(robot, common[-1], end) if remaining else ():
        if joint.type != "fixed":
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, but joint {joint.name!r} beyond it moves every "
                f"palm; expected {common[-1]!r}"
            )
    return end


def _check_sides(name: str, sides: Collection[str], where: Path) -> None:
    require_usable_name(name, f"{where}: name")
    if not sides:
        raise DescriptionError(f"{where}: sides: found none, expected at least one")
    if len(sides) > MAX_SIDES:
        raise DescriptionError(f"{where}: sides: found {len(sides)}, expected {MAX_SIDES} at most")
    for side in sides:
        require_usable_name(side, f"{where}: sides")


def _maybe_mirrored(
    part: RobotPart, entry: PartSide, key: str, side: str, where: Path
) -> RobotPart:
    """Return a part of a side, or its mirror image if the entry asks for it."""
    for name in entry.mirror:
        if name not in ("arm", "hand"):
            raise DescriptionError(
                f"{where}: sides.{side}.mirror: found {name!r}, expected 'arm' or 'hand'"
            )
    return mirrored(part) if key in entry.mirror else part


def _links_to(link: str, robot: RobotPart) -> list[str]:
    """Return the links from the root to a link, both included."""
    return [robot.root, *(joint.child for joint in chain_to(robot, link))]


def _with_sides(
    robot: RobotDescription, flat: FlatJoints, sides: Sequence[_SidePart], end: str, where: Path
) -> RobotDescription:
    """Return the robot with the motors and fingers of its sides.

    Args:
        robot: The robot without sides.
        flat: Its joints.
        sides: Its sides.
        end: Link that carries the sides.
        where: File of the description, for messages.

    Raises:
        DescriptionError: A side is malformed; the message names file, key and expected value.
    """
    end = flat.anchors[end][0]
    trunk = _motors(robot, _moving(robot, end))
    # Sides without a moving trunk are solved independently, in the frame of the contacts: the root.
    end = end if trunk else robot.root
    fingers: list[Finger] = []
    built_sides: list[Side] = []
    for side in sides:
        key = f"{where}: sides.{side.name}."
        side_fingers = build_fingers(
            side.fingers, side.thumb, side.hand, flat, key, f"{side.name}_"
        )
        side_fingers = [
            replace(finger, joints=_moving(robot, finger.link)) for finger in side_fingers
        ]
        palm, pose = flat.anchors[side.hand.tip_link]
        names = tuple(finger.name for finger in side_fingers)
        placement = read_only(pose @ side.hand.tip)
        arm, hand = side.motors or _motors_of(robot, palm, side_fingers, end)
        built_sides.append(Side(side.name, palm, placement, side.thumb, names, arm, hand))
        fingers += side_fingers
    robot = replace(
        robot, fingers=tuple(fingers), sides=tuple(built_sides), trunk=trunk, trunk_link=end
    )
    _check_motors(robot, where)
    return robot


def _moving(robot: RobotDescription, link: str) -> tuple[str, ...]:
    return tuple(joint.name for joint in robot.chain(link) if joint.type != "fixed")


def _motors(robot: RobotDescription, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the motors that move some joints, in the order of q."""
    return tuple(robot.actuator_names[i] for i in sorted(robot.driving_actuators(joints)))


def _motors_of(
    robot: RobotDescription, palm: str, fingers: Sequence[Finger], end: str
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the motors of a side: from the trunk's end to the palm, and below the palm."""
    to_palm = _moving(robot, palm)
    arm = _motors(robot, {*to_palm} - {*_moving(robot, end)})
    below_palm = _motors(robot, _hand_joints(robot, palm, fingers) - {*to_palm})
    return arm, tuple(name for name in below_palm if name not in arm)


def _hand_joints(robot: RobotDescription, palm: str, fingers: Iterable[Finger]) -> set[str]:
    """Return the names of the joints below a palm, and those of fingers."""
    below_palm = {joint.name for joint in joints_below(robot, palm) if joint.type != "fixed"}
    return below_palm.union(*(finger.joints for finger in fingers))


def _check_motors(robot: RobotDescription, where: Path) -> None:
    """Check that every motor belongs to the trunk or to one side."""
    trunk = {*_moving(robot, robot.trunk_link)}
    groups = {"trunk": ("the trunk", robot.trunk, trunk)}
    for side in robot.sides:
        hand_joints = _hand_joints(robot, side.palm_link, map(robot.finger, side.fingers))
        side_joints = {*_moving(robot, side.palm_link)} | hand_joints
        groups[f"sides.{side.name}"] = (
            f"side {side.name!r}",
            side.arm + side.hand,
            side_joints - trunk,
        )
    unassigned = []
    for motor in robot.actuator_names:
        keys = [key for key, (_, motors, _) in groups.items() if motor in motors]
        if len(keys) > 1:
            # The group of the joint that has the motor's name comes first.
            keys.sort(key=lambda key: motor not in groups[key][2])
            index = {robot.actuator_index(motor)}
            joints = [joint for joint in robot.joint_names if joint in groups[keys[1]][2]]
            followers = [joint for joint in joints if robot.driving_actuators([joint]) == index]
            raise DescriptionError(
                f"{where}: {keys[1]}: joint {followers[-1]!r} follows motor {motor!r}, "
                f"which is of {groups[keys[0]][0]}; expected a separate motor"
            )
        if not keys:
            unassigned.append(f"{motor}: 0")
    if unassigned:
        raise DescriptionError(
            f"{where}: robot: found motors that move no side; write them under locked: "
            f"{{{', '.join(unassigned)}}}"
        )
