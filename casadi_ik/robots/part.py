"""An arm or a hand before they are put together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.robots.collision import NO_SHAPES, Shapes
from casadi_ik.robots.description import Actuator, Joint
from casadi_ik.robots.schema import ContactEntry, PadEntry

PREFIX = "hand_"
"""Put before a name of the hand that the arm has as well."""


@dataclass(frozen=True)
class Part:
    """An arm, or what all parts have.

    Attributes:
        name: What it is called.
        where: Its file and key, for messages.
        root: Its base link.
        joints: Its joints, parents before children.
        actuators: Its motors.
        sources: Where its numbers come from, by tag.
        tip_link: Link that carries what comes next: an arm's tip, a hand's palm.
        tip: (4, 4) pose of the tip or palm frame in that link.
        home: Positions of some motors.
        shapes: Of its links, for collisions.
    """

    name: str
    where: str
    root: str
    joints: list[Joint]
    actuators: list[Actuator]
    sources: dict[str, str]
    tip_link: str
    tip: Array
    home: dict[str, float]
    shapes: Shapes = NO_SHAPES


@dataclass(frozen=True)
class HandPart(Part):
    """A hand.

    Attributes:
        pads: Its contact frames, by finger.
        thumb: The finger placed first, if it says so itself.
        mount: (4, 4) pose of its root on an arm's tip, if the robot says nothing.
    """

    pads: dict[str, ContactEntry | PadEntry] = field(default_factory=dict)
    thumb: str | None = None
    mount: Array = field(default_factory=lambda: np.eye(4))


def told_apart(hand: HandPart, arm: Part) -> HandPart:
    """The hand, with `PREFIX` before every name of a link, joint or motor that the arm has too."""
    links = {arm.root, *(joint.child for joint in arm.joints)}
    movers = {joint.name for joint in arm.joints} | {one.name for one in arm.actuators} | {"mount"}
    theirs = {joint.name for joint in hand.joints} | {one.name for one in hand.actuators}
    theirs_links = {hand.root, *(joint.child for joint in hand.joints)}

    def link(name: str) -> str:
        return _free(name, links, theirs_links)

    def mover(name: str) -> str:
        return _free(name, movers, theirs)

    joints = [
        replace(
            joint,
            name=mover(joint.name),
            parent=link(joint.parent),
            child=link(joint.child),
            coupling=joint.coupling
            and msgspec.structs.replace(joint.coupling, of=mover(joint.coupling.of)),
        )
        for joint in hand.joints
    ]
    return replace(
        hand,
        root=link(hand.root),
        joints=joints,
        actuators=[replace(one, name=mover(one.name)) for one in hand.actuators],
        shapes=hand.shapes.renamed({name: link(name) for name in theirs_links}),
        tip_link=link(hand.tip_link),
        home={mover(name): value for name, value in hand.home.items()},
        pads={
            name: msgspec.structs.replace(pad, link=link(pad.link))
            for name, pad in hand.pads.items()
        },
    )


def _free(name: str, taken: set[str], own: set[str]) -> str:
    if name not in taken:
        return name
    while name in taken or name in own:
        name = PREFIX + name
    return name
