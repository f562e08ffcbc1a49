"""What joins the parts of a robot: one tree of joints, its fingers, where it stands."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casadi_ik.arrays import Array, frozen
from casadi_ik.errors import DescriptionError, UnknownNameError
from casadi_ik.files.reading import Vector, frame_matrix, read
from casadi_ik.files.shipped import resolve
from casadi_ik.robots.collision import NO_SHAPES
from casadi_ik.robots.description import Actuator, Finger, Joint, RobotDescription
from casadi_ik.robots.file_parts import arm_from_file
from casadi_ik.robots.linkage import above, known
from casadi_ik.robots.motor_ranges import motor_ranges
from casadi_ik.robots.parts import Part, described_part, unique
from casadi_ik.robots.schema import ArmFile, ArmFromFile, BallPad, HandFile


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
        found.append(replace(joint, parent=link, placement=frozen(placement)))
    return FlatJoints(tuple(found), places)


def joined(
    name: str,
    root: str,
    joints: Sequence[Joint],
    parts: Sequence[tuple[str, Part]],
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
    unique((one.name for one in actuators), f"{where}: actuators")
    unique((joint.name for joint in joints), f"{where}: joints")
    unique((root, *(joint.child for joint in joints)), f"{where}: links")
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
        palm_placement=frozen(np.eye(4)),
        home=_home(home, units, actuators, joints, where),
        sources=all_sources,
        shapes=sum((part.shapes for _, part in parts), NO_SHAPES),
    )
    return robot, flat


ALONG = 0.995
"""Cosine with the normal above which the contact frame's x axis is no tangent."""


def the_fingers(
    names: Sequence[str],
    thumb: str | None,
    hand: Part,
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
    unique(names, f"{where}fingers")
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


def _finger(name: str, hand: Part, flat: FlatJoints, side: str) -> Finger:
    entry = hand.pads[name]
    where = f"{hand.where}fingers.{name.removeprefix(side)}"
    link, pose = flat.places[known(entry.link, hand.links, "link", f"{where}.link")]
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
        frozen(pose @ frame_matrix(entry)),
        frozen(normal),
        tuple(chain[::-1]),
        frozen(_tangent(entry.tangent, normal, where)),
        entry.pad.radius if isinstance(entry.pad, BallPad) else 0.0,
    )


def _tangent(given: Vector | None, normal: Array, where: str) -> Array:
    """The pad's second axis (3,): what is given, else x (y if the normal is along x)."""
    along = given
    if given is None:
        along = (1.0, 0.0, 0.0) if abs(normal[0]) < ALONG else (0.0, 1.0, 0.0)
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
    return frozen(np.clip(asked, lower, upper))


def a_part(entry: str | ArmFromFile | HandFile, key: str, beside: Path) -> Part:
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
        return described_part(entry, beside)
    kind = key.rpartition(".")[2]
    try:
        path = resolve(entry, f"{kind}s", beside=beside)
    except (UnknownNameError, DescriptionError) as error:
        raise DescriptionError(f"{beside}: {key}: {error}") from error
    return described_part(read(path, HandFile if kind == "hand" else ArmFile)[0], path)


def with_wrist(hand: Part) -> Part:
    """The hand, of which what moves the palm itself counts as arm, if all fingers are beyond it."""
    wrist = {joint.name for joint in above(hand, hand.tip_link)}
    beyond = all(
        hand.tip_link in {joint.child for joint in above(hand, pad.link)}
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
    axis = frozen(np.array([0.0, 0.0, 1.0]))
    return Joint(name, parent, child, "fixed", frozen(pose), axis, 0.0, 0.0, np.inf, None, "mount")
