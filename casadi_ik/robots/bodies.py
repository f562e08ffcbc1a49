"""Bodies: arm-hands on a common trunk, put together from parts or found in somebody's file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from casadi_ik.arrays import frozen
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.robots.collision import NO_SHAPES
from casadi_ik.robots.description import Finger, Joint, RobotDescription, Side
from casadi_ik.robots.file_parts import hand_from_file
from casadi_ik.robots.joining import (
    FlatJoints,
    a_part,
    fixed_joint,
    flattened,
    own_tags,
    the_fingers,
    the_home,
    with_wrist,
)
from casadi_ik.robots.parts import Part, mirrored, of_side, unique, usable
from casadi_ik.robots.schema import BodyFile, ImportedBody, PartSide

STANDING = "base"
"""Root of a body that stands still."""


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
    hand: Part
    fingers: list[str]
    thumb: str | None
    motors: tuple[tuple[str, ...], tuple[str, ...]] | None = None


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
    _check_sides(body.name, list(body.sides), where)
    arms = {name: _arm(entry, name, where) for name, entry in body.sides.items()}
    trunk = None if body.trunk is None else a_part(body.trunk, "trunk", where)
    roots = {arm.root for arm in arms.values()}
    together = all(entry.at is None for entry in body.sides.values()) and len(roots) == 1
    ends = roots if trunk is None else {trunk.tip_link}
    shared = roots.pop() if together and roots == ends else None
    joints = [] if trunk is None else list(trunk.joints)
    actuators = [] if trunk is None else list(trunk.actuators)
    end, pose = (STANDING, np.eye(4)) if trunk is None else (trunk.tip_link, trunk.tip)
    root = (shared or STANDING) if trunk is None else trunk.root
    end = shared or end
    shapes = NO_SHAPES if trunk is None else trunk.shapes
    home = {} if trunk is None else dict(trunk.home)
    sources = dict(body.sources)
    sources |= {} if trunk is None else own_tags(trunk.sources, sources, trunk.name)
    sides = []
    for name, entry in body.sides.items():
        arm = of_side(arms[name], name, shared)
        key = f"sides.{name}.hand"
        own = _hand(entry, hand, where, key)
        mount = own.mount if entry.mount is None else frame_matrix(entry.mount)
        own = with_wrist(of_side(own, name, shared))
        if shared is None:
            at = pose @ frame_matrix(entry.at or Frame())
            joints.append(fixed_joint(f"{name}_base", end, arm.root, at))
        joints += [
            *arm.joints,
            fixed_joint(f"{name}_mount", arm.tip_link, own.root, arm.tip @ mount),
            *own.joints,
        ]
        actuators += [*arm.actuators, *own.actuators]
        known = shared and (sides or trunk is not None)
        kept = arm.shapes.without([shared]) if known and shared else arm.shapes
        shapes = shapes + kept + own.shapes
        home |= arm.home | own.home
        for part in (arms[name], own):
            sources |= own_tags(part.sources, sources, f"{name}.{part.name}")
        asked = None if entry.fingers is None else [f"{name}_{one}" for one in entry.fingers]
        fingers = list(own.pads) if asked is None else asked
        thumb = own.thumb if entry.thumb is None else f"{name}_{entry.thumb}"
        thumb = thumb if entry.thumb is not None or thumb in fingers else None
        motors = [*arm.actuators, *own.actuators]
        split = tuple(
            tuple(m.name for m in motors if (m.part == "arm") is is_arm) for is_arm in (True, False)
        )
        sides.append(_OneSide(name, own, fingers, thumb, (split[0], split[1])))
    palms = {side.hand.tip_link for side in sides}
    unique((root, *(joint.child for joint in joints)), f"{where}: links")
    flat = flattened(joints, root, palms | {end})
    drawn = RobotDescription(
        name=body.name,
        root=root,
        joints=flat.joints,
        actuators=tuple(actuators),
        fingers=(),
        named_thumb=None,
        palm_link=root,
        palm_placement=frozen(np.eye(4)),
        home=the_home(home | body.home, units, actuators, joints, str(where)),
        sources=sources,
        shapes=shapes,
    )
    return _with_sides(drawn, sides, end, flat, where)


def body_from_file(body: ImportedBody, where: Path, units: dict[str, str]) -> RobotDescription:
    """A body of one file.

    Args:
        body: What its description says.
        where: The description, beside which the file is looked for.
        units: Units of numbers that were given with one, by key.

    Raises:
        DescriptionError: With file, key, what was found and what was expected.
    """
    _check_sides(body.name, list(body.sides), where)
    pads = {
        f"{side}_{name}": pad
        for side, entry in body.sides.items()
        for name, pad in entry.fingers.items()
    }
    whole = hand_from_file(msgspec.structs.replace(body.robot, palm=None), pads, "robot", where)
    palms = {}
    for side, entry in body.sides.items():
        palm = entry.palm
        link = palm if isinstance(palm, str) else palm.link
        known = {whole.root, *(joint.child for joint in whole.joints)}
        if link not in known:
            raise DescriptionError(f"{where}: sides.{side}.palm: no link {link!r} in the file")
        pose = np.eye(4) if isinstance(palm, str) else frame_matrix(Frame(palm.xyz, palm.rpy))
        palms[side] = link, pose
    by_child = {joint.child: joint for joint in whole.joints}
    chains = {side: _links_to(link, by_child, whole.root) for side, (link, _) in palms.items()}
    common = [
        link for link in next(iter(chains.values())) if all(link in one for one in chains.values())
    ]
    end = common[-1] if body.trunk is None else body.trunk
    for side, chain in chains.items():
        if end not in chain:
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, which does not carry the palm of {side!r}; "
                f"expected a link that carries all, such as {common[-1]!r}"
            )
    if len(chains) == 1 and body.trunk is None:
        raise DescriptionError(f"{where}: trunk: missing; one side does not say where it ends")
    flat = flattened(whole.joints, whole.root, {end, *(link for link, _ in palms.values())})
    drawn = RobotDescription(
        name=body.name,
        root=whole.root,
        joints=flat.joints,
        actuators=tuple(whole.actuators),
        fingers=(),
        named_thumb=None,
        palm_link=whole.root,
        palm_placement=frozen(np.eye(4)),
        home=the_home(body.home, units, whole.actuators, whole.joints, str(where)),
        sources=dict(body.sources) | whole.sources,
        shapes=whole.shapes,
    )
    sides = []
    for side, entry in body.sides.items():
        link, pose = palms[side]
        fingers = [f"{side}_{name}" for name in entry.fingers]
        own = {name: pads[name] for name in fingers}
        hand = replace(whole, tip_link=link, tip=pose, pads=own)
        for name, pad in own.items():
            if link not in _links_to(pad.link, by_child, whole.root):
                raise DescriptionError(
                    f"{where}: sides.{side}.fingers.{name.removeprefix(side + '_')}.link: "
                    f"{pad.link!r} does not hang on the palm {link!r}"
                )
        thumb = None if entry.thumb is None else f"{side}_{entry.thumb}"
        sides.append(_OneSide(side, hand, fingers, thumb))
    return _with_sides(drawn, sides, end, flat, where)


def _check_sides(name: str, sides: Sequence[str], where: Path) -> None:
    usable(name, f"{where}: name")
    if not sides:
        raise DescriptionError(f"{where}: sides: found none, expected at least one")
    if len(sides) > MOST_SIDES:
        raise DescriptionError(f"{where}: sides: found {len(sides)}, expected {MOST_SIDES} at most")
    for side in sides:
        usable(side, f"{where}: sides")


MOST_SIDES = 4


def _arm(entry: PartSide, side: str, where: Path) -> Part:
    for found in entry.mirror:
        if found not in ("arm", "hand"):
            raise DescriptionError(
                f"{where}: sides.{side}.mirror: found {found!r}, expected 'arm' or 'hand'"
            )
    arm = a_part(entry.arm, f"sides.{side}.arm", where)
    return mirrored(arm) if "arm" in entry.mirror else arm


def _hand(entry: PartSide, other: str | None, where: Path, key: str) -> Part:
    """The hand of a side: its own, or the one that the robot's name has."""
    named = entry.hand if entry.hand is not None else other
    if named is None:
        raise DescriptionError(f"{where}: {key}: missing; write one, or load BODY+HAND by name")
    hand = a_part(named, key, where)
    return mirrored(hand) if "hand" in entry.mirror else hand


def _links_to(link: str, by_child: dict[str, Joint], root: str) -> list[str]:
    """Links from the root to one, both included."""
    found = [link]
    while found[-1] != root:
        found.append(by_child[found[-1]].parent)
    return found[::-1]


def _with_sides(
    robot: RobotDescription, sides: list[_OneSide], end: str, flat: FlatJoints, where: Path
) -> RobotDescription:
    """The body, once it is known which motors and fingers are whose."""
    end = flat.places[end][0]
    fingers: list[Finger] = []
    found: list[Side] = []
    for side in sides:
        own = the_fingers(side.fingers, side.thumb, side.hand, flat, str(where))
        fingers += [replace(one, joints=tuple(_moving(robot, one.link))) for one in own]
        found.append(_side(robot, side, own, end, flat))
    unique((one.name for one in fingers), f"{where}: fingers")
    trunk = _motors(robot, (j.name for j in robot.chain(end)))
    robot = replace(
        robot,
        fingers=tuple(fingers),
        sides=tuple(found),
        trunk=trunk,
        trunk_link=end,
    )
    _check_motors(robot, where)
    return robot


def _moving(robot: RobotDescription, link: str) -> list[str]:
    return [joint.name for joint in robot.chain(link) if joint.type != "fixed"]


def _motors(robot: RobotDescription, joints: Iterable[str]) -> tuple[str, ...]:
    """The motors that move some joints, in the order of q."""
    moving = {joint.name for joint in robot.movable}
    places = sorted(robot.driving([name for name in joints if name in moving]))
    return tuple(robot.actuator_names[i] for i in places)


def _side(
    robot: RobotDescription,
    side: _OneSide,
    fingers: Sequence[Finger],
    end: str,
    flat: FlatJoints,
) -> Side:
    palm, pose = flat.places[side.hand.tip_link]
    if side.motors is not None:
        names = tuple(finger.name for finger in fingers)
        placement = frozen(pose @ side.hand.tip)
        return Side(side.name, palm, placement, side.thumb, names, *side.motors)
    trunk = {joint.name for joint in robot.chain(end)}
    to_palm = {joint.name for joint in robot.chain(palm)}
    arm = _motors(robot, (name for name in to_palm if name not in trunk))
    below = {j.name for j in robot.joints if palm in _all_above(robot, j.child)} - to_palm
    beyond = {name for one in fingers for name in one.joints}
    hand = _motors(robot, (name for name in below | beyond))
    return Side(
        side.name,
        palm,
        frozen(pose @ side.hand.tip),
        side.thumb,
        tuple(finger.name for finger in fingers),
        arm,
        tuple(name for name in hand if name not in arm),
    )


def _all_above(robot: RobotDescription, link: str) -> set[str]:
    return {joint.child for joint in robot.chain(link)} | {robot.root}


def _check_motors(robot: RobotDescription, where: Path) -> None:
    """Every motor is of the trunk or of one side."""
    owners: dict[str, list[str]] = {name: ["the trunk"] for name in robot.trunk}
    for side in robot.sides:
        for motor in (*side.arm, *side.hand):
            owners.setdefault(motor, []).append(f"side {side.name!r}")
    for motor in robot.actuator_names:
        found = owners.get(motor, [])
        if len(found) > 1:
            raise DescriptionError(
                f"{where}: sides: motor {motor!r} is of {' and '.join(found)}; expected one"
            )
        if not found:
            raise DescriptionError(
                f"{where}: motor {motor!r} moves no side; write locked: {{{motor}: 0}} under robot"
            )
