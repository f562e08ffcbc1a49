"""Robots put together: arm and hand as one tree of joints, and bodies, several on one trunk.

The parts are described, or found in somebody's file.
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
    """The joints of a robot without chains of fixed ones.

    Attributes:
        joints: The joints, parents before children; fixed ones are leaves but for the palms'.
        places: By link the link it is fixed to (itself, if it moves) and its (4, 4) pose there.
    """

    joints: tuple[Joint, ...]
    places: dict[str, tuple[str, Array]]


def flattened(joints: Sequence[Joint], root: str, kept: Collection[str]) -> FlatJoints:
    """Hang every joint on the nearest link above it that moves, or on root or a link that is kept.

    Args:
        joints: Parents before children.
        root: The base link.
        kept: Links of palms, where fingers begin.
    """
    places: dict[str, tuple[str, Array]] = {root: (root, np.eye(4))}
    found: list[Joint] = []
    for joint in joints:
        link, pose = places[joint.parent]
        placement = pose @ joint.placement
        if joint.type == "fixed" and joint.child not in kept:
            places[joint.child] = (link, placement)
        else:
            places[joint.child] = (joint.child, np.eye(4))
        found.append(replace(joint, parent=link, placement=read_only(placement)))
    return FlatJoints(tuple(found), places)


def join_parts(
    name: str,
    root: str,
    joints: Sequence[Joint],
    parts: Sequence[tuple[str, RobotPart]],
    kept: Collection[str],
    home: dict[str, float],
    units: dict[str, str],
    sources: dict[str, str],
    where: str,
) -> tuple[RobotDescription, FlatJoints]:
    """A robot of whose palms and fingers nothing is said yet.

    Args:
        name: What it is called.
        root: Its base link.
        joints: All joints, parents before children.
        parts: What it consists of, in the order of its motors, each with the name that parts its
            sources from those of the same tag.
        kept: Links that stay links although they are fixed.
        home: Positions by actuator [rad or m].
        units: Units of numbers that were given with one, by key.
        sources: Its own sources by tag.
        where: Its file, for messages.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    actuators = [one for _, part in parts for one in part.actuators]
    require_unique((one.name for one in actuators), f"{where}: actuators")
    require_unique((joint.name for joint in joints), f"{where}: joints")
    require_unique((root, *(joint.child for joint in joints)), f"{where}: links")
    flat, all_sources = flattened(joints, root, kept), dict(sources)
    for owner, part in parts:
        # A tag that is used already gets the owner's name before it.
        all_sources |= {
            f"{owner}.{tag}" if tag in all_sources else tag: text
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
"""Cosine with the normal above which the contact frame's x axis is no tangent."""


def build_fingers(
    names: Sequence[str],
    thumb: str | None,
    hand: RobotPart,
    flat: FlatJoints,
    where: str,
    side: str = "",
) -> tuple[Finger, ...]:
    """The fingers that a robot uses.

    Args:
        names: Their names in order.
        thumb: The one placed first, if there is one.
        hand: The hand.
        flat: All joints of the robot.
        where: What stands before the keys ``fingers`` and ``thumb`` in messages.
        side: What all names begin with that messages leave out.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    require_unique(names, f"{where}fingers")
    if not names:
        raise DescriptionError(f"{where}fingers: found none, expected at least one")
    asked = [("fingers", name) for name in names]
    if thumb is not None:
        asked.append(("thumb", thumb))
    for key, name in asked:
        if name not in hand.pads:
            raise DescriptionError(
                f"{where}{key}: {hand.name} has no finger {name.removeprefix(side)!r}; it has "
                + ", ".join(one.removeprefix(side) for one in hand.pads)
            )
    if thumb is not None and thumb not in names:
        raise DescriptionError(
            f"{where}thumb: {thumb.removeprefix(side)!r} is not among the fingers"
        )
    return tuple(_finger(name, hand, flat, side) for name in names)


def _finger(name: str, hand: RobotPart, flat: FlatJoints, side: str) -> Finger:
    entry = hand.pads[name]
    where = f"{hand.where}fingers.{name.removeprefix(side)}"
    link, pose = flat.places[require_name(entry.link, hand.links, "link", f"{where}.link")]
    length = float(np.linalg.norm(entry.normal))
    if not length > 1e-9:
        raise DescriptionError(f"{where}.normal: is zero, expected a direction")
    chain: list[str] = []
    by_child = {joint.child: joint for joint in flat.joints}
    here = link
    while here in by_child and here not in (flat.places[hand.root][0], hand.tip_link):
        if by_child[here].type != "fixed":
            chain.append(by_child[here].name)
        here = by_child[here].parent
    # On the palm's own link a pad is meant to stay: a jaw that is fixed.
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


def _tangent(given: Vector | None, normal: Array, where: str) -> Array:
    """The pad's second axis (3,): what is given, else x (y if the normal is along x)."""
    along = given
    if given is None:
        along = (1.0, 0.0, 0.0) if abs(normal[0]) < MAX_NORMAL_COSINE else (0.0, 1.0, 0.0)
    across = np.asarray(along, dtype=float)
    across = across - normal * (normal @ across)
    length = float(np.linalg.norm(across))
    if not length > 1e-3 * float(np.linalg.norm(np.asarray(along))):
        raise DescriptionError(
            f"{where}.tangent: found {list(along or ())}, expected a direction across the normal"
        )
    return across / length


def _home(
    home: Mapping[str, float],
    units: Mapping[str, str],
    actuators: Sequence[Actuator],
    joints: Sequence[Joint],
    where: str,
) -> Array:
    """The home position (n,); where nothing is said, the position nearest to zero."""
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
    for name, value, low, high in zip(names, asked, lower, upper, strict=True):
        if name in home and not low <= value <= high:
            raise DescriptionError(
                f"{where}: home.{name}: {value:.6g} is outside the limits [{low:.6g}, {high:.6g}] "
                "of the actuator and its joints"
            )
    return read_only(np.clip(asked, lower, upper))


def load_part(entry: str | ArmFromFile | HandFile, key: str, beside: Path) -> RobotPart:
    """The trunk, arm or hand that a robot's file names or holds.

    Args:
        entry: A shipped name, a path, what stands in somebody's file, or a hand in full.
        key: Where it stands; its last word says which of them it is.
        beside: The robot's file.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    if isinstance(entry, ArmFromFile):
        return arm_from_file(entry, key, beside)
    if isinstance(entry, HandFile):
        return part_from_file(entry, beside)
    kind = key.rpartition(".")[2]
    try:
        path = resolve_description(entry, f"{kind}s", relative_to=beside)
    except (UnknownNameError, DescriptionError) as error:
        raise DescriptionError(f"{beside}: {key}: {error}") from error
    return part_from_file(read(path, HandFile if kind == "hand" else ArmFile)[0], path)


def assign_wrist_to_arm(hand: RobotPart) -> RobotPart:
    """The hand, of which what moves the palm itself counts as arm, if all fingers are beyond it."""
    wrist = {joint.name for joint in chain_to(hand, hand.tip_link)}
    beyond = all(
        hand.tip_link in {joint.child for joint in chain_to(hand, pad.link)}
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


def fixed_joint(name: str, parent: str, child: str, pose: Array) -> Joint:
    """What mounts a link (4, 4) on another."""
    axis = read_only(np.array([0.0, 0.0, 1.0]))
    return Joint(
        name, parent, child, "fixed", read_only(pose), axis, 0.0, 0.0, np.inf, None, "mount"
    )


FIXED_BASE = RobotPart("base", "", "base", [], [], {}, "base", np.eye(4), {})
"""What carries the sides of a body that stands still."""

MAX_SIDES = 4


@dataclass(frozen=True, eq=False)
class _OneSide:
    """An arm-hand of a body on the way.

    Attributes:
        name: Of the side.
        hand: Its hand.
        fingers: Their names.
        thumb: The one placed first.
        motors: Of arm and hand, if that is known.
    """

    name: str
    hand: RobotPart
    fingers: Sequence[str]
    thumb: str | None
    motors: tuple[tuple[str, ...], ...] = ()


def body_from_parts(
    body: BodyFile, where: Path, units: dict[str, str], hand: str | None = None
) -> RobotDescription:
    """Put a body together.

    Args:
        body: What its file says.
        where: The file, beside which others are looked for.
        units: Units of numbers that were given with one, by key.
        hand: Name of the hand of sides that say none.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    _check_sides(body.name, body.sides, where)
    placed = [name for name, entry in body.sides.items() if entry.at is not None]
    for name in body.sides:
        if placed and name not in placed:
            raise DescriptionError(
                f"{where}: sides.{name}.at: found none, expected one as in sides.{placed[0]}; "
                "at: {} is the trunk's end"
            )
    arms = {
        name: _mirrored(load_part(entry.arm, f"sides.{name}.arm", where), entry, "arm", name, where)
        for name, entry in body.sides.items()
    }
    trunk = None if body.trunk is None else load_part(body.trunk, "trunk", where)
    roots = {arm.root for arm in arms.values()}
    alike = len(roots) == 1 and all(entry.at is None for entry in body.sides.values())
    # Arms that have the trunk's end, or each other's root, share that link.
    shared = roots.pop() if alike and (trunk is None or roots == {trunk.tip_link}) else None
    base = FIXED_BASE if trunk is None else trunk
    if trunk is None and shared is not None:
        base = replace(FIXED_BASE, root=shared, tip_link=shared)
    joints, parts = list(base.joints), [(base.name, base)]
    home, sides = dict(base.home), []
    for name, entry in body.sides.items():
        arm = prefix_side(arms[name], name, shared)
        key = f"sides.{name}.hand"
        named = entry.hand if entry.hand is not None else hand
        if named is None:
            raise DescriptionError(f"{where}: {key}: missing; write one, or load BODY+HAND by name")
        own = _mirrored(load_part(named, key, where), entry, "hand", name, where)
        mount = own.mount if entry.mount is None else frame_matrix(entry.mount)
        own = assign_wrist_to_arm(prefix_side(own, name, shared))
        if shared is None:
            at = base.tip @ frame_matrix(entry.at or Frame())
            joints.append(fixed_joint(f"{name}_base", base.tip_link, arm.root, at))
        elif sides or trunk is not None:
            arm = replace(arm, shapes=arm.shapes.without([shared]))
        fixed = fixed_joint(f"{name}_mount", arm.tip_link, own.root, arm.tip @ mount)
        joints += [*arm.joints, fixed, *own.joints]
        parts += [(f"{name}.{part.name}", part) for part in (arm, own)]
        home |= arm.home | own.home
        asked = None if entry.fingers is None else [f"{name}_{one}" for one in entry.fingers]
        fingers = list(own.pads) if asked is None else asked
        thumb = own.thumb if own.thumb in fingers else None
        thumb = thumb if entry.thumb is None else f"{name}_{entry.thumb}"
        motors = [*arm.actuators, *own.actuators]
        split = (
            tuple(one.name for one in motors if (one.part == "arm") is of_arm)
            for of_arm in (True, False)
        )
        sides.append(_OneSide(name, own, fingers, thumb, tuple(split)))
    palms = {side.hand.tip_link for side in sides}
    drawn = join_parts(
        *(body.name, base.root, joints, parts, palms | {base.tip_link}),
        *(home | body.home, units, body.sources, str(where)),
    )
    return _with_sides(*drawn, sides, base.tip_link, where)


def body_from_file(body: ImportedBody, where: Path, units: dict[str, str]) -> RobotDescription:
    """A body of one file.

    Args:
        body: What its description says.
        where: The description, beside which the file is looked for.
        units: Units of numbers that were given with one, by key.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    _check_sides(body.name, body.sides, where)
    if body.robot.palm is not None:
        raise DescriptionError(f"{where}: robot.palm: found one, expected it under each of 'sides'")
    whole = hand_from_file(body.robot, {}, "robot", where)
    sides, chains = [], {}
    for name, entry in body.sides.items():
        side, chains[name] = _side_in_file(name, entry, whole, where)
        sides.append(side)
    end = _trunk_end(body.trunk, sides, chains, whole, where)
    drawn = join_parts(
        *(body.name, whole.root, whole.joints, [("robot", whole)]),
        {end, *(side.hand.tip_link for side in sides)},
        *(body.home, units, body.sources, str(where)),
    )
    return _with_sides(*drawn, sides, end, where)


def _side_in_file(
    name: str, entry: FileSide, whole: RobotPart, where: Path
) -> tuple[_OneSide, list[str]]:
    """A side, and the links from the root to its palm."""
    key, palm = f"{where}: sides.{name}.", palm_frame(entry.palm)
    require_name(palm.link, whole.links, "link", f"{key}palm")
    pads = {f"{name}_{finger}": pad for finger, pad in entry.fingers.items()}
    for finger, pad in entry.fingers.items():
        require_name(pad.link, whole.links, "link", f"{key}fingers.{finger}.link")
        if palm.link not in _links_to(pad.link, whole):
            raise DescriptionError(
                f"{key}fingers.{finger}.link: {pad.link!r} does not hang on the palm "
                f"{palm.link!r}; write another link or another palm"
            )
    hand = replace(
        whole,
        name=f"side {name!r}",
        where=key,
        tip_link=palm.link,
        tip=frame_matrix(palm),
        pads=pads,
    )
    thumb = None if entry.thumb is None else f"{name}_{entry.thumb}"
    return _OneSide(name, hand, list(pads), thumb), _links_to(palm.link, whole)


def _trunk_end(
    said: str | None,
    sides: Sequence[_OneSide],
    chains: dict[str, list[str]],
    whole: RobotPart,
    where: Path,
) -> str:
    """The link that the sides stand on: what is said, or the last one that carries all palms."""
    for side in sides:
        for other in sides:
            if other is not side and side.hand.tip_link in chains[other.name]:
                raise DescriptionError(
                    f"{where}: sides.{side.name}.palm: found {side.hand.tip_link!r}, which carries "
                    f"the palm of {other.name!r} too; expected palms of which none carries another"
                )
    if said is None and len(sides) == 1:
        raise DescriptionError(f"{where}: trunk: missing; one side does not say where it ends")
    first, *others = chains.values()
    common = [link for link in first if all(link in one for one in others)]
    end = common[-1] if said is None else require_name(said, whole.links, "link", f"{where}: trunk")
    for name, chain in chains.items():
        if end not in chain:
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, which does not carry the palm of {name!r}; "
                f"expected a link that carries all, such as {common[-1]!r}"
            )
    for joint in chain_to(whole, common[-1], end) if others else ():
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


def _mirrored(part: RobotPart, entry: PartSide, key: str, side: str, where: Path) -> RobotPart:
    """A part of a side, or its mirror image if the side says so."""
    for found in entry.mirror:
        if found not in ("arm", "hand"):
            raise DescriptionError(
                f"{where}: sides.{side}.mirror: found {found!r}, expected 'arm' or 'hand'"
            )
    return mirrored(part) if key in entry.mirror else part


def _links_to(link: str, whole: RobotPart) -> list[str]:
    """Links from the root to one, both included."""
    return [whole.root, *(joint.child for joint in chain_to(whole, link))]


def _with_sides(
    robot: RobotDescription, flat: FlatJoints, sides: Sequence[_OneSide], end: str, where: Path
) -> RobotDescription:
    """Return the body with the motors and fingers of its sides.

    Args:
        robot: The robot without sides.
        flat: Its joints.
        sides: Its sides.
        end: Link that the sides stand on.
        where: The description's file, for messages.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    end = flat.places[end][0]
    trunk = _motors(robot, _moving(robot, end))
    # Sides without a moving trunk are solved independently, in the frame of the contacts: the root.
    end = end if trunk else robot.root
    fingers: list[Finger] = []
    found: list[Side] = []
    for side in sides:
        key = f"{where}: sides.{side.name}."
        own = build_fingers(side.fingers, side.thumb, side.hand, flat, key, f"{side.name}_")
        own = [replace(one, joints=_moving(robot, one.link)) for one in own]
        palm, pose = flat.places[side.hand.tip_link]
        names = tuple(one.name for one in own)
        placement = read_only(pose @ side.hand.tip)
        arm, hand = side.motors or _motors_of(robot, palm, own, end)
        found.append(Side(side.name, palm, placement, side.thumb, names, arm, hand))
        fingers += own
    robot = replace(robot, fingers=tuple(fingers), sides=tuple(found), trunk=trunk, trunk_link=end)
    _check_motors(robot, where)
    return robot


def _moving(robot: RobotDescription, link: str) -> tuple[str, ...]:
    return tuple(joint.name for joint in robot.chain(link) if joint.type != "fixed")


def _motors(robot: RobotDescription, joints: Iterable[str]) -> tuple[str, ...]:
    """The motors that move some joints, in the order of q."""
    return tuple(robot.actuator_names[i] for i in sorted(robot.driving(joints)))


def _motors_of(
    robot: RobotDescription, palm: str, fingers: Sequence[Finger], end: str
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The motors of a side's arm and hand: between the trunk's end and the palm, and below it."""
    to_palm = _moving(robot, palm)
    arm = _motors(robot, {*to_palm} - {*_moving(robot, end)})
    beyond = _motors(robot, _carried(robot, palm, fingers) - {*to_palm})
    return arm, tuple(name for name in beyond if name not in arm)


def _carried(robot: RobotDescription, palm: str, fingers: Iterable[Finger]) -> set[str]:
    """The joints below a palm, and those of fingers."""
    below_it = {one.name for one in joints_below(robot, palm) if one.type != "fixed"}
    return below_it.union(*(one.joints for one in fingers))


def _check_motors(robot: RobotDescription, where: Path) -> None:
    """Every motor is of the trunk or of one side."""
    trunk = {*_moving(robot, robot.trunk_link)}
    places = {"trunk": ("the trunk", robot.trunk, trunk)}
    for side in robot.sides:
        carried = _carried(robot, side.palm_link, map(robot.finger, side.fingers))
        own = {*_moving(robot, side.palm_link)} | carried
        places[f"sides.{side.name}"] = f"side {side.name!r}", side.arm + side.hand, own - trunk
    still = []
    for motor in robot.actuator_names:
        keys = [key for key, (_, motors, _) in places.items() if motor in motors]
        if len(keys) > 1:
            # Its own joint is called like the motor.
            keys.sort(key=lambda key: motor not in places[key][2])
            place = {robot.actuator_index(motor)}
            others = [one for one in robot.joint_names if one in places[keys[1]][2]]
            moved = [one for one in others if robot.driving([one]) == place]
            raise DescriptionError(
                f"{where}: {keys[1]}: joint {moved[-1]!r} follows motor {motor!r}, "
                f"which is of {places[keys[0]][0]}; expected a motor of its own"
            )
        if not keys:
            still.append(f"{motor}: 0")
    if still:
        raise DescriptionError(
            f"{where}: robot: found motors that move no side; write them under locked: "
            f"{{{', '.join(still)}}}"
        )
