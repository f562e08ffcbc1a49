"""Bodies: arm-hands on a common trunk, put together from parts or found in somebody's file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.arrays import frozen
from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Frame, frame_matrix
from casadi_ik.robots.description import Finger, RobotDescription, Side
from casadi_ik.robots.file_parts import hand_from_file, palm_frame
from casadi_ik.robots.joining import (
    FlatJoints,
    a_part,
    fixed_joint,
    joined,
    the_fingers,
    with_wrist,
)
from casadi_ik.robots.linkage import above, below, known
from casadi_ik.robots.parts import Part, mirrored, of_side, usable
from casadi_ik.robots.schema import BodyFile, FileSide, ImportedBody, PartSide

STANDING = Part("base", "", "base", [], [], {}, "base", np.eye(4), {})
"""What carries the sides of a body that stands still."""

MOST_SIDES = 4


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
    arms = {
        name: _mirrored(a_part(entry.arm, f"sides.{name}.arm", where), entry, "arm", name, where)
        for name, entry in body.sides.items()
    }
    trunk = None if body.trunk is None else a_part(body.trunk, "trunk", where)
    roots = {arm.root for arm in arms.values()}
    alike = len(roots) == 1 and all(entry.at is None for entry in body.sides.values())
    # Arms that have the trunk's end, or each other's root, share that link.
    shared = roots.pop() if alike and (trunk is None or roots == {trunk.tip_link}) else None
    base = STANDING if trunk is None else trunk
    if trunk is None and shared is not None:
        base = replace(STANDING, root=shared, tip_link=shared)
    joints, parts = list(base.joints), [(base.name, base)]
    home, sides = dict(base.home), []
    for name, entry in body.sides.items():
        arm = of_side(arms[name], name, shared)
        key = f"sides.{name}.hand"
        named = entry.hand if entry.hand is not None else hand
        if named is None:
            raise DescriptionError(f"{where}: {key}: missing; write one, or load BODY+HAND by name")
        own = _mirrored(a_part(named, key, where), entry, "hand", name, where)
        mount = own.mount if entry.mount is None else frame_matrix(entry.mount)
        own = with_wrist(of_side(own, name, shared))
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
    drawn = joined(
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
    drawn = joined(
        *(body.name, whole.root, whole.joints, [("robot", whole)]),
        {end, *(side.hand.tip_link for side in sides)},
        *(body.home, units, body.sources, str(where)),
    )
    return _with_sides(*drawn, sides, end, where)


def _side_in_file(
    name: str, entry: FileSide, whole: Part, where: Path
) -> tuple[_OneSide, list[str]]:
    """A side, and the links from the root to its palm."""
    key, palm = f"{where}: sides.{name}.", palm_frame(entry.palm)
    known(palm.link, whole.links, "link", f"{key}palm")
    pads = {f"{name}_{finger}": pad for finger, pad in entry.fingers.items()}
    for finger, pad in entry.fingers.items():
        known(pad.link, whole.links, "link", f"{key}fingers.{finger}.link")
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
    whole: Part,
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
    end = common[-1] if said is None else known(said, whole.links, "link", f"{where}: trunk")
    for name, chain in chains.items():
        if end not in chain:
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, which does not carry the palm of {name!r}; "
                f"expected a link that carries all, such as {common[-1]!r}"
            )
    for joint in above(whole, common[-1], end) if others else ():
        if joint.type != "fixed":
            raise DescriptionError(
                f"{where}: trunk: found {end!r}, but joint {joint.name!r} beyond it moves every "
                f"palm; expected {common[-1]!r}"
            )
    return end


def _check_sides(name: str, sides: Collection[str], where: Path) -> None:
    usable(name, f"{where}: name")
    if not sides:
        raise DescriptionError(f"{where}: sides: found none, expected at least one")
    if len(sides) > MOST_SIDES:
        raise DescriptionError(f"{where}: sides: found {len(sides)}, expected {MOST_SIDES} at most")
    for side in sides:
        usable(side, f"{where}: sides")


def _mirrored(part: Part, entry: PartSide, key: str, side: str, where: Path) -> Part:
    """A part of a side, or its mirror image if the side says so."""
    for found in entry.mirror:
        if found not in ("arm", "hand"):
            raise DescriptionError(
                f"{where}: sides.{side}.mirror: found {found!r}, expected 'arm' or 'hand'"
            )
    return mirrored(part) if key in entry.mirror else part


def _links_to(link: str, whole: Part) -> list[str]:
    """Links from the root to one, both included."""
    return [whole.root, *(joint.child for joint in above(whole, link))]


def _with_sides(
    robot: RobotDescription, flat: FlatJoints, sides: Sequence[_OneSide], end: str, where: Path
) -> RobotDescription:
    """The body, once it is known which motors and fingers are whose."""
    end = flat.places[end][0]
    fingers: list[Finger] = []
    found: list[Side] = []
    for side in sides:
        key = f"{where}: sides.{side.name}."
        own = the_fingers(side.fingers, side.thumb, side.hand, flat, key, f"{side.name}_")
        own = [replace(one, joints=_moving(robot, one.link)) for one in own]
        palm, pose = flat.places[side.hand.tip_link]
        names = tuple(one.name for one in own)
        placement = frozen(pose @ side.hand.tip)
        arm, hand = side.motors or _motors_of(robot, palm, own, end)
        found.append(Side(side.name, palm, placement, side.thumb, names, arm, hand))
        fingers += own
    trunk = _motors(robot, _moving(robot, end))
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
    carried = {one.name for one in below(robot, palm) if one.type != "fixed"}
    beyond = carried.union(*(one.joints for one in fingers)) - {*to_palm}
    arm = _motors(robot, {*to_palm} - {*_moving(robot, end)})
    return arm, tuple(name for name in _motors(robot, beyond) if name not in arm)


def _check_motors(robot: RobotDescription, where: Path) -> None:
    """Every motor is of the trunk or of one side."""
    owners = dict.fromkeys(robot.trunk, "the trunk")
    for side in robot.sides:
        for motor in (*side.arm, *side.hand):
            if motor in owners:
                place = {robot.actuator_index(motor)}
                moved = [one for one in robot.joint_names if robot.driving([one]) == place]
                raise DescriptionError(
                    f"{where}: sides.{side.name}: joint {moved[-1]!r} follows motor {motor!r}, "
                    f"which is of {owners[motor]}; expected a motor of its own"
                )
            owners[motor] = f"side {side.name!r}"
    for motor in robot.actuator_names:
        if motor not in owners:
            raise DescriptionError(
                f"{where}: motor {motor!r} moves no side; write locked: {{{motor}: 0}} under robot"
            )
