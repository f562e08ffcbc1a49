"""The description of an arm-hand: frozen data, checked once, numpy only."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import UnknownNameError, UnsupportedError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.model.joints import Actuator, Joint
from casadi_ik.model.link_shapes import NO_SHAPES, Shapes
from casadi_ik.model.linkage import chain_to, links_of
from casadi_ik.model.motor_ranges import motor_ranges

CONTINUOUS_LIMIT = 1e6
"""Limit of the motion of a motor without limits [rad]: 28 hours at 10 rad/s."""


@dataclass(frozen=True, eq=False)
class Finger:
    """A finger: the chain from the palm to one contact frame.

    Attributes:
        name: Unique name.
        link: Link that carries the contact frame.
        placement: (4, 4) pose of the contact frame in that link.
        normal: (3,) outward pad normal, unit, in the contact frame.
        joints: Names of the movable joints from the palm to the contact, in order.
        tangent: (3,) second axis of the pad, unit, in the contact frame and orthogonal to the
            normal: what a contact's tangent turns about the normal. If the description names
            none, the contact frame's x axis made orthogonal to the normal.
        radius: Of the pad, a ball that touches with any point of it [m]; 0: a plane.
    """

    name: str
    link: str
    placement: Array
    normal: Array
    joints: tuple[str, ...]
    tangent: Array
    radius: float = 0.0


@dataclass(frozen=True, eq=False)
class Side:
    """An arm with a hand of a robot that has several, or that stands on a trunk.

    Attributes:
        name: Unique name ("left").
        palm_link: Link that its palm frame sits on.
        palm_placement: (4, 4) pose of the palm frame in that link.
        named_thumb: Name of its finger placed first; None if the description names none.
        fingers: Names of its fingers.
        arm: Names of the motors between the trunk and the palm.
        hand: Names of the motors beyond the palm.
    """

    name: str
    palm_link: str
    palm_placement: Array
    named_thumb: str | None
    fingers: tuple[str, ...]
    arm: tuple[str, ...]
    hand: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """An arm-hand, a hand alone on a fixed base, or a body: arm-hands on a common trunk.

    A body is one tree like any other robot, without a palm of its own: that is its root. `sides`
    and `trunk` say which motors are whose.

    Attributes:
        name: Name of the description.
        root: The base link; contacts and normals are expressed in its frame.
        joints: All joints, parents before children, fixed ones included.
        actuators: The motors in the fixed order of q.
        fingers: The fingers, in the order of `contacts`.
        named_thumb: Name of the finger placed first; None if the description names none.
        palm_link: Link the palm frame sits on.
        palm_placement: (4, 4) pose of the palm frame in that link.
        home: (n,) home position of the actuators.
        sources: Where the numbers come from, by tag.
        shapes: Of its links, for collisions; none where they are not described.
        path: The file that it was read from; None: its parts are shipped.
        sides: Of a body, its arm-hands; none of an arm-hand or a hand.
        trunk: Of a body, the motors that move every palm: a waist, a lift, a mobile base.
        trunk_link: Of a body, the link that the sides stand on; the root if it has no trunk motors.
    """

    name: str
    root: str
    joints: tuple[Joint, ...]
    actuators: tuple[Actuator, ...]
    fingers: tuple[Finger, ...]
    named_thumb: str | None
    palm_link: str
    palm_placement: Array
    home: Array
    sources: dict[str, str]
    shapes: Shapes = NO_SHAPES
    path: Path | None = None
    sides: tuple[Side, ...] = ()
    trunk: tuple[str, ...] = ()
    trunk_link: str = ""

    @property
    def thumb(self) -> str:
        """Name of the finger placed first.

        Raises:
            UnsupportedError: The description names none, or it is a body, which has one by side.
        """
        self.one_hand("thumb")
        if self.named_thumb is None:
            raise UnsupportedError(
                f"robot {self.name!r} names no thumb, which is needed here; write 'thumb: FINGER' "
                f"in its description, one of {', '.join(self.finger_names)}"
            )
        return self.named_thumb

    def one_hand(self, what: str) -> None:
        """See to it that this is no body, for what can do one arm with one hand alone.

        Args:
            what: What needs it, for the message.

        Raises:
            UnsupportedError: It is one.
        """
        if self.sides:
            sides = ", ".join(side.name for side in self.sides)
            raise UnsupportedError(
                f"{what} is for one arm with one hand, found {self.name!r}, a body ({sides}); take "
                f"robot.side({self.sides[0].name!r})"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Its fields alone: what was worked out of them so far is no part of what it is."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @cached_property
    def movable(self) -> tuple[Joint, ...]:
        """The joints that move, in order: the entries of theta."""
        return tuple(joint for joint in self.joints if joint.type != "fixed")

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the movable joints, the order of theta."""
        return tuple(joint.name for joint in self.movable)

    @cached_property
    def actuator_names(self) -> tuple[str, ...]:
        """Names of the actuators, the order of q."""
        return tuple(actuator.name for actuator in self.actuators)

    @cached_property
    def finger_names(self) -> tuple[str, ...]:
        """Names of the fingers in order."""
        return tuple(finger.name for finger in self.fingers)

    @cached_property
    def lower(self) -> Array:
        """(n,) lower limits of the actuators, which keep all joints within theirs as well."""
        return self._ranges[0]

    @cached_property
    def upper(self) -> Array:
        """(n,) upper limits of the actuators, which keep all joints within theirs as well."""
        return self._ranges[1]

    @cached_property
    def _ranges(self) -> tuple[Array, Array]:
        found = motor_ranges(self.movable, self.actuators, self.home, f"robot {self.name!r}")
        return read_only(found[0]), read_only(found[1])

    @cached_property
    def strokes(self) -> tuple[Array, Array]:
        """(n,) what the actuators could do by themselves, whatever their joints' limits say."""
        lower = [actuator.lower for actuator in self.actuators]
        return read_only(lower), read_only([actuator.upper for actuator in self.actuators])

    @cached_property
    def mechanical(self) -> tuple[Array, Array]:
        """(n,) ends that the mechanisms set by themselves: where a slider's triangle is flat.

        Infinite for all other actuators.
        """
        lower = dict.fromkeys(self.actuator_names, -np.inf)
        upper = dict.fromkeys(self.actuator_names, np.inf)
        for joint in self.movable:
            coupling = joint.coupling
            if coupling is not None and coupling.of in lower:
                least, most = coupling.stroke
                lower[coupling.of] = max(lower[coupling.of], least)
                upper[coupling.of] = min(upper[coupling.of], most)
        return read_only(list(lower.values())), read_only(list(upper.values()))

    @cached_property
    def _independent_turns(self) -> NDArray[np.bool_]:
        """(n,) True for motors that move one revolute joint, by their own angle."""
        moved: dict[int, list[Joint]] = {i: [] for i in range(len(self.actuators))}
        for joint in self.movable:
            for motor in self.driving([joint.name]):
                moved[motor].append(joint)
        return np.array(
            [
                len(joints) == 1 and joints[0].type == "revolute" and joints[0].coupling is None
                for joints in moved.values()
            ],
            dtype=bool,
        )

    @cached_property
    def continuous(self) -> NDArray[np.bool_]:
        """(n,) True for motors without limits, whose `lower` and `upper` are the search range."""
        unlimited = np.array([actuator.continuous for actuator in self.actuators], dtype=bool)
        return self._independent_turns & unlimited

    @cached_property
    def turning(self) -> tuple[int, ...]:
        """Positions in q of the motors that may take the same pose in several turns."""
        wide = self.continuous | (self.upper - self.lower >= 2 * np.pi)
        return tuple(np.flatnonzero(self._independent_turns & wide).tolist())

    @cached_property
    def stops(self) -> tuple[Array, Array]:
        """(n,) limits of motions; ±`CONTINUOUS_LIMIT` for continuous motors."""
        lower = np.where(self.continuous, -CONTINUOUS_LIMIT, self.lower)
        return read_only(lower), read_only(np.where(self.continuous, CONTINUOUS_LIMIT, self.upper))

    @cached_property
    def joint_lower(self) -> Array:
        """(m,) lower limits of the movable joints."""
        return read_only([joint.lower for joint in self.movable])

    @cached_property
    def joint_upper(self) -> Array:
        """(m,) upper limits of the movable joints."""
        return read_only([joint.upper for joint in self.movable])

    @cached_property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return links_of(self)

    def finger(self, name: str) -> Finger:
        """The finger of that name.

        Raises:
            UnknownNameError: There is none; the message lists the fingers.
        """
        for finger in self.fingers:
            if finger.name == name:
                return finger
        raise UnknownNameError(
            f"robot {self.name!r} has no finger {name!r}; its fingers: "
            + ", ".join(self.finger_names)
        )

    def actuator_index(self, name: str) -> int:
        """Position of an actuator in q.

        Raises:
            UnknownNameError: There is none; the message lists the actuators.
        """
        try:
            return self.actuator_names.index(name)
        except ValueError:
            raise UnknownNameError(
                f"robot {self.name!r} has no actuator {name!r}; its actuators: "
                + ", ".join(self.actuator_names)
            ) from None

    def chain(self, link: str) -> tuple[Joint, ...]:
        """The joints from the root to a link, in order, fixed ones included.

        Raises:
            UnknownNameError: There is no such link.
        """
        if link not in self.links:
            raise UnknownNameError(f"robot {self.name!r} has no link {link!r}")
        return tuple(chain_to(self, link))

    @cached_property
    def arm_actuators(self) -> tuple[int, ...]:
        """Positions in q of the arm's actuators (empty for a hand alone, and for a body)."""
        if self.sides:
            return ()
        return tuple(i for i, a in enumerate(self.actuators) if a.part == "arm")

    @cached_property
    def hand_actuators(self) -> tuple[int, ...]:
        """Positions in q of the hand's actuators, all but the arm's; of a body all its hands'."""
        if self.sides:
            return tuple(place for _, hand in self.side_actuators for place in hand)
        arm = set(self.arm_actuators)
        return tuple(i for i in range(len(self.actuators)) if i not in arm)

    @property
    def as_hand(self) -> RobotDescription:
        """A body as a hand on a fixed base, whose motors are all motors there are."""
        return replace(self, sides=(), trunk=(), trunk_link="") if self.sides else self

    @cached_property
    def trunk_actuators(self) -> tuple[int, ...]:
        """Positions in q of the motors that move every palm of a body."""
        return tuple(self.actuator_index(name) for name in self.trunk)

    @cached_property
    def side_actuators(self) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
        """Positions in q of the motors of arm and hand, by side."""
        return tuple(
            (
                tuple(map(self.actuator_index, side.arm)),
                tuple(map(self.actuator_index, side.hand)),
            )
            for side in self.sides
        )

    def side_named(self, name: str) -> Side:
        """A side of a body.

        Raises:
            UnknownNameError: There is none; the message lists the sides.
        """
        for side in self.sides:
            if side.name == name:
                return side
        sides = ", ".join(side.name for side in self.sides) or "none"
        raise UnknownNameError(f"robot {self.name!r} has no side {name!r}; its sides: {sides}")

    def side(self, name: str, carried: bool = False) -> RobotDescription:
        """An arm-hand of a body by itself, as it stands on the link that ends the trunk.

        Its motors, fingers and links keep their names; q is ordered as in the body.

        Args:
            name: Of the side.
            carried: Whether the trunk is a part of it, as the first joints of its arm.

        Raises:
            UnknownNameError: There is none; the message lists the sides.
        """
        found = self.side_named(name)
        root, arm = self.trunk_link, found.arm
        if carried:
            root, arm = self.root, (*self.trunk, *arm)
        parts = dict.fromkeys(arm, "arm") | dict.fromkeys(found.hand, "hand")
        places = {i for i, motor in enumerate(self.actuator_names) if motor in parts}
        others = self.links_moved(set(range(len(self.actuators))) - places)
        kept = set(self.links_moved(places) - (others if carried else set())) | {found.palm_link}
        for finger in found.fingers:
            kept.add(self.finger(finger).link)
        for link in tuple(kept):
            kept |= {joint.child for joint in self.chain(link)}
        kept -= {joint.child for joint in self.chain(root)}
        to_palm = {joint.name for joint in self.chain(found.palm_link)}
        return replace(
            self,
            name=f"{self.name}.{name}",
            root=root,
            joints=tuple(
                replace(joint, part="arm" if joint.name in to_palm else "hand")
                for joint in self.joints
                if joint.child in kept
            ),
            actuators=tuple(
                replace(motor, part=parts[motor.name])
                for motor in self.actuators
                if motor.name in parts
            ),
            fingers=tuple(
                replace(
                    finger,
                    joints=tuple(
                        joint.name
                        for joint in self.chain(finger.link)
                        if joint.type != "fixed" and joint.child in kept
                        if joint.name not in to_palm
                    ),
                )
                for finger in map(self.finger, found.fingers)
            ),
            named_thumb=found.named_thumb,
            palm_link=found.palm_link,
            palm_placement=found.palm_placement,
            home=self.home[sorted(places)],
            shapes=self.shapes.without(set(self.links) - kept - {root}),
            sides=(),
            trunk=(),
            trunk_link="",
        )

    def finger_actuators(self, name: str) -> tuple[int, ...]:
        """Positions in q of the actuators that move a finger relative to the palm.

        Raises:
            UnknownNameError: There is no such finger.
        """
        return tuple(sorted(self.driving(self.finger(name).joints)))

    @cached_property
    def finger_motors(self) -> tuple[str, ...]:
        """The actuators that move a finger relative to the palm, in the order of q."""
        used = {i for name in self.finger_names for i in self.finger_actuators(name)}
        return tuple(self.actuator_names[i] for i in sorted(used))

    @cached_property
    def finger_joints(self) -> tuple[str, ...]:
        """All movable joints of the fingers, in the order of `joint_names`."""
        used = {name for finger in self.fingers for name in finger.joints}
        return tuple(name for name in self.joint_names if name in used)

    def links_moved(self, actuators: Collection[int]) -> frozenset[str]:
        """Links that one of some actuators (positions in q) moves."""
        moved: set[str] = set()
        for link in self.links:
            joints = [joint.name for joint in self.chain(link) if joint.type != "fixed"]
            if not self.driving(joints).isdisjoint(actuators):
                moved.add(link)
        return frozenset(moved)

    def driving(self, joints: Iterable[str]) -> set[int]:
        """Positions in q of the actuators of some joints."""
        by_name = {joint.name: joint for joint in self.joints}
        found: set[int] = set()
        for joint_name in joints:
            joint = by_name[joint_name]
            while joint.coupling is not None and joint.coupling.of in by_name:
                joint = by_name[joint.coupling.of]
            source = joint.name if joint.coupling is None else joint.coupling.of
            found.add(self.actuator_index(source))
        return found
