"""Composition of multi-arm robots: arm-hands on a common trunk."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import read_only
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.model.description import Finger, RobotDescription, Side
from casadi_ik.model.imported_parts import hand_from_file, palm_frame
from casadi_ik.model.joining import (
    FlatJoints,
    assign_wrist_to_arm,
    build_fingers,
    fixed_joint,
    join_parts,
    load_part,
)
from casadi_ik.model.joints import chain_to, joints_below, require_name
from casadi_ik.model.parts import (
    RobotPart,
    mirrored,
    prefix_side,
    require_usable_name,
)
from casadi_ik.model.schema import BodyFile, FileSide, ImportedBody, PartSide

FIXED_BASE = RobotPart.one_link("base")
"""Trunk of a multi-arm robot on a fixed base."""

MAX_SIDES = 4
"""Maximum number of sides of a multi-arm robot."""


@dataclass(frozen=True, eq=False)
class _SidePart:
    """A side of a multi-arm robot during its composition.

    Attributes:
        name: Name of the side.
        hand: The hand.
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
    body: BodyFile, path: Path, units: dict[str, str], hand: str | None = None
) -> RobotDescription:
    """Return a multi-arm robot that is composed of parts.

    Args:
        body: Record of its file.
        path: The file, from which paths are relative.
        units: Units of numbers that have one, by key.
        hand: Name of the hand of sides that state none.

    Raises:
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    _check_sides(body.name, body.sides, path)
    with_pose = [name for name, entry in body.sides.items() if entry.at is not None]
    for name in body.sides:
        if with_pose and name not in with_pose:
            raise DescriptionError(
                f"{path}: sides.{name}.at: missing; expected a pose as in sides.{with_pose[0]} "
                "(at: {} is the trunk's end)"
            )
    arms = {
        name: _maybe_mirrored(
            load_part(entry.arm, f"sides.{name}.arm", path), entry, "arm", name, path
        )
        for name, entry in body.sides.items()
    }
    trunk = None if body.trunk is None else load_part(body.trunk, "trunk", path)
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
            raise DescriptionError(f"{path}: {key}: missing; write one, or load BODY+HAND by name")
        side_hand = _maybe_mirrored(load_part(hand_entry, key, path), entry, "hand", name, path)
        mount = side_hand.mount if entry.mount is None else frame_matrix(entry.mount)
        side_hand = assign_wrist_to_arm(prefix_side(side_hand, name, shared))
        if shared is None:
            pose = base.tip @ frame_matrix(entry.at or Frame())
            joints.append(fixed_joint(f"{name}_base", base.tip_link, arm.root, pose))
        elif sides or trunk is not None:
            arm = replace(arm, shapes=arm.shapes.remove_links([shared]))
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
    robot, flat = join_parts(
        name=body.name,
        root=base.root,
        joints=joints,
        parts=parts,
        preserved=palms | {base.tip_link},
        home=home | body.home,
        units=units,
        sources=body.sources,
        location=str(path),
    )
    return _with_sides(robot, flat, sides, base.tip_link, path)


def body_from_file(body: ImportedBody, path: Path, units: dict[str, str]) -> RobotDescription:
    """Return a multi-arm robot of one URDF or MJCF file.

    Args:
        body: Record of its description.
        path: The description, from which the path of the file is relative.
        units: Units of numbers that have one, by key.

    Raises:
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    _check_sides(body.name, body.sides, path)
    if body.robot.palm is not None:
        raise DescriptionError(f"{path}: robot.palm: is not allowed; expected palms below 'sides'")
    part = hand_from_file(body.robot, {}, "robot", path)
    sides, chains = [], {}
    for name, entry in body.sides.items():
        side, chains[name] = _side_in_file(name, entry, part, path)
        sides.append(side)
    trunk_link = _trunk_link(body.trunk, sides, chains, part, path)
    robot, flat = join_parts(
        name=body.name,
        root=part.root,
        joints=part.joints,
        parts=[("robot", part)],
        preserved={trunk_link, *(side.hand.tip_link for side in sides)},
        home=body.home,
        units=units,
        sources=body.sources,
        location=str(path),
    )
    return _with_sides(robot, flat, sides, trunk_link, path)


def _side_in_file(
    name: str, entry: FileSide, robot: RobotPart, path: Path
) -> tuple[_SidePart, list[str]]:
    """Return a side, and the links from the root to its palm."""
    key, palm = f"{path}: sides.{name}.", palm_frame(entry.palm)
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
        location=key,
        tip_link=palm.link,
        tip=frame_matrix(palm),
        pads=pads,
    )
    thumb = None if entry.thumb is None else f"{name}_{entry.thumb}"
    return _SidePart(name, hand, list(pads), thumb), _links_to(palm.link, robot)


def _trunk_link(
    stated: str | None,
    sides: Sequence[_SidePart],
    chains: dict[str, list[str]],
    robot: RobotPart,
    path: Path,
) -> str:
    """Return the link that carries the sides: as stated, or the last one above all palms."""
    for side in sides:
        for lower_side in sides:
            if lower_side is not side and side.hand.tip_link in chains[lower_side.name]:
                raise DescriptionError(
                    f"{path}: sides.{side.name}.palm: found {side.hand.tip_link!r}, which carries "
                    f"the palm of {lower_side.name!r} too; expected palms on separate branches"
                )
    if stated is None and len(sides) == 1:
        raise DescriptionError(
            f"{path}: trunk: missing; expected a link, since a single side does not determine it"
        )
    first, *remaining = chains.values()
    common = [link for link in first if all(link in chain for chain in remaining)]
    trunk_link = (
        common[-1]
        if stated is None
        else require_name(stated, robot.links, "link", f"{path}: trunk")
    )
    for name, chain in chains.items():
        if trunk_link not in chain:
            raise DescriptionError(
                f"{path}: trunk: found {trunk_link!r}, which does not carry the palm of {name!r}; "
                f"expected a link that carries all palms, such as {common[-1]!r}"
            )
    for joint in chain_to(robot, common[-1], trunk_link) if remaining else ():
        if joint.type != "fixed":
            raise DescriptionError(
                f"{path}: trunk: found {trunk_link!r}, but joint {joint.name!r} beyond it moves "
                f"every palm; expected {common[-1]!r}"
            )
    return trunk_link


def _check_sides(name: str, sides: Collection[str], path: Path) -> None:
    """Check the number and the names of the sides."""
    require_usable_name(name, f"{path}: name")
    if not sides:
        raise DescriptionError(f"{path}: sides: is empty; expected at least one side")
    if len(sides) > MAX_SIDES:
        raise DescriptionError(f"{path}: sides: found {len(sides)}, expected at most {MAX_SIDES}")
    for side in sides:
        require_usable_name(side, f"{path}: sides")


def _maybe_mirrored(part: RobotPart, entry: PartSide, key: str, side: str, path: Path) -> RobotPart:
    """Return a part of a side, or its mirror image if the entry says so."""
    for name in entry.mirror:
        if name not in ("arm", "hand"):
            raise DescriptionError(
                f"{path}: sides.{side}.mirror: found {name!r}, expected 'arm' or 'hand'"
            )
    return mirrored(part) if key in entry.mirror else part


def _links_to(link: str, robot: RobotPart) -> list[str]:
    """Return the links from the root to a link, both included."""
    return [robot.root, *(joint.child for joint in chain_to(robot, link))]


def _with_sides(
    robot: RobotDescription,
    flat: FlatJoints,
    sides: Sequence[_SidePart],
    trunk_link: str,
    path: Path,
) -> RobotDescription:
    """Return the robot with the motors and fingers of its sides.

    Args:
        robot: Robot without sides.
        flat: Joints of the robot.
        sides: Sides of the robot.
        trunk_link: Link that carries the sides.
        path: File of the description, for error messages.

    Raises:
        DescriptionError: A side is malformed; the message names file, key and expected value.
    """
    trunk_link = flat.anchors[trunk_link][0]
    trunk = _driving_motors(robot, _moving_joints(robot, trunk_link))
    # Sides without a moving trunk are solved independently, in the frame of the contacts: the root.
    if not trunk:
        trunk_link = robot.root
    fingers: list[Finger] = []
    built_sides: list[Side] = []
    for side in sides:
        key = f"{path}: sides.{side.name}."
        side_fingers = build_fingers(
            side.fingers, side.thumb, side.hand, flat, key, f"{side.name}_"
        )
        side_fingers = [
            replace(finger, joints=_moving_joints(robot, finger.link)) for finger in side_fingers
        ]
        palm, pose = flat.anchors[side.hand.tip_link]
        names = tuple(finger.name for finger in side_fingers)
        placement = read_only(pose @ side.hand.tip)
        arm, hand = side.motors or _side_motors(robot, palm, side_fingers, trunk_link)
        built_sides.append(Side(side.name, palm, placement, side.thumb, names, arm, hand))
        fingers += side_fingers
    robot = replace(
        robot, fingers=tuple(fingers), sides=tuple(built_sides), trunk=trunk, trunk_link=trunk_link
    )
    _check_motors(robot, path)
    return robot


def _moving_joints(robot: RobotDescription, link: str) -> tuple[str, ...]:
    """Return the names of the joints that move a link."""
    return tuple(joint.name for joint in robot.chain(link) if joint.type != "fixed")


def _driving_motors(robot: RobotDescription, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the motors that move the joints, in the order of q."""
    return tuple(robot.actuator_names[i] for i in sorted(robot.driving_actuators(joints)))


def _side_motors(
    robot: RobotDescription, palm: str, fingers: Sequence[Finger], trunk_link: str
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the motors of a side: from the trunk's end to the palm, and below the palm."""
    to_palm = _moving_joints(robot, palm)
    arm = _driving_motors(robot, {*to_palm} - {*_moving_joints(robot, trunk_link)})
    below_palm = _driving_motors(robot, _hand_joints(robot, palm, fingers) - {*to_palm})
    return arm, tuple(name for name in below_palm if name not in arm)


def _hand_joints(robot: RobotDescription, palm: str, fingers: Iterable[Finger]) -> set[str]:
    """Return the names of the joints below a palm, and those of fingers."""
    below_palm = {joint.name for joint in joints_below(robot, palm) if joint.type != "fixed"}
    return below_palm.union(*(finger.joints for finger in fingers))


def _check_motors(robot: RobotDescription, path: Path) -> None:
    """Check that every motor belongs to the trunk or to one side."""
    trunk = {*_moving_joints(robot, robot.trunk_link)}
    groups = {"trunk": ("the trunk", robot.trunk, trunk)}
    for side in robot.sides:
        hand_joints = _hand_joints(robot, side.palm_link, map(robot.finger, side.fingers))
        side_joints = {*_moving_joints(robot, side.palm_link)} | hand_joints
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
                f"{path}: {keys[1]}: joint {followers[-1]!r} follows motor {motor!r}, "
                f"which belongs to {groups[keys[0]][0]}; expected a separate motor"
            )
        if not keys:
            unassigned.append(f"{motor}: 0")
    if unassigned:
        raise DescriptionError(
            f"{path}: robot: motors move no side; write them under locked: "
            f"{{{', '.join(unassigned)}}}"
        )
