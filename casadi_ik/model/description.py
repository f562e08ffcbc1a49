"""The description of a robot: frozen data, validated once, in NumPy only."""

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
from casadi_ik.model.joints import Actuator, Joint, chain_to, links_of, motor_ranges
from casadi_ik.model.link_shapes import NO_SHAPES, Shapes

CONTINUOUS_LIMIT = 1e6
"""Limit of the motion of a motor without limits [rad]: 28 hours at 10 rad/s."""


@dataclass(frozen=True, eq=False)
class Finger:
    """A finger: the chain from the palm to one contact frame.

    Attributes:
        name: Unique name.
        link: Link that carries the contact frame.
        placement: (4, 4) pose of the contact frame in that link.
        normal: (3,) outward unit pad normal, in the contact frame.
        joints: Names of the movable joints from the palm to the contact, in order.
        tangent: (3,) unit second axis of the pad, in the contact frame and orthogonal to the
            normal; a contact's tangent fixes the rotation of this axis about the normal. Default:
            the contact frame's x axis, made orthogonal to the normal.
        radius: Radius of a ball-shaped pad, which touches with any point [m]; 0 for a plane.
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
    """An arm-hand of a multi-arm robot.

    Attributes:
        name: Unique name ("left").
        palm_link: Link that carries the palm frame.
        palm_placement: (4, 4) pose of the palm frame in that link.
        named_thumb: Name of the finger placed first; None if the description names none.
        fingers: Names of the fingers.
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
    """An arm-hand, a hand on a fixed base, or a multi-arm robot: arm-hands on a common trunk.

    A multi-arm robot is a single tree. It has no palm; `palm_link` is its root. `sides` and `trunk`
    assign its motors.

    Attributes:
        name: Name of the description.
        root: Base link; contacts and normals are expressed in its frame.
        joints: All joints, parents before children, including fixed ones.
        actuators: Motors in the order of q.
        fingers: Fingers in the order of `contacts`.
        named_thumb: Name of the finger placed first; None if the description names none.
        palm_link: Link that carries the palm frame.
        palm_placement: (4, 4) pose of the palm frame in that link.
        home: (n,) home position of the actuators.
        sources: Sources of the numbers by tag.
        shapes: Collision shapes of the links.
        path: File of the description; None for a combination of shipped parts.
        sides: Arm-hands of a multi-arm robot; empty otherwise.
        trunk: Motors of a multi-arm robot that move every palm: a waist, a lift, a mobile base.
        trunk_link: Link of a multi-arm robot that carries the sides; the root without trunk motors.
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
            UnsupportedError: The description names none, or the robot has several sides with a
                thumb each.
        """
        self.require_single_hand("thumb")
        if self.named_thumb is None:
            raise UnsupportedError(
                f"robot {self.name!r} names no thumb, which this feature needs; write "
                f"'thumb: FINGER' in its description, one of {', '.join(self.finger_names)}"
            )
        return self.named_thumb

    def require_single_hand(self, feature: str) -> None:
        """Check that this is not a multi-arm robot.

        Args:
            feature: Feature that needs a single hand, for the message.

        Raises:
            UnsupportedError: It is a multi-arm robot.
        """
        if self.sides:
            sides = ", ".join(side.name for side in self.sides)
            raise UnsupportedError(
                f"{feature} is for one arm with one hand, found {self.name!r}, a multi-arm robot "
                f"({sides}); use robot.side({self.sides[0].name!r})"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without cached properties."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @cached_property
    def movable(self) -> tuple[Joint, ...]:
        """Movable joints in order: the entries of theta."""
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
        """Lower limits (n,) of the actuators, which imply those of all joints."""
        return self._ranges[0]

    @cached_property
    def upper(self) -> Array:
        """Upper limits (n,) of the actuators, which imply those of all joints."""
        return self._ranges[1]

    @cached_property
    def _ranges(self) -> tuple[Array, Array]:
        location = f"robot {self.name!r}"
        lower, upper = motor_ranges(self.movable, self.actuators, self.home, location)
        return read_only(lower), read_only(upper)

    @cached_property
    def actuator_limits(self) -> tuple[Array, Array]:
        """Lower and upper limits (n,) of the actuators alone, regardless of joint limits."""
        lower = [actuator.lower for actuator in self.actuators]
        return read_only(lower), read_only([actuator.upper for actuator in self.actuators])

    @cached_property
    def mechanical_limits(self) -> tuple[Array, Array]:
        """Limits (n,) due to mechanisms: positions at which a slider's triangle is flat.

        They are infinite for all other actuators.
        """
        lower = dict.fromkeys(self.actuator_names, -np.inf)
        upper = dict.fromkeys(self.actuator_names, np.inf)
        for joint in self.movable:
            coupling = joint.coupling
            if coupling is not None and coupling.of in lower:
                start, end = coupling.stroke
                lower[coupling.of] = max(lower[coupling.of], start)
                upper[coupling.of] = min(upper[coupling.of], end)
        return read_only(list(lower.values())), read_only(list(upper.values()))

    @cached_property
    def _independent_turns(self) -> NDArray[np.bool_]:
        """Mask (n,) of the motors that move one revolute joint by an equal angle."""
        joints_of: dict[int, list[Joint]] = {i: [] for i in range(len(self.actuators))}
        for joint in self.movable:
            for motor in self.driving_actuators([joint.name]):
                joints_of[motor].append(joint)
        return np.array(
            [
                len(joints) == 1 and joints[0].type == "revolute" and joints[0].coupling is None
                for joints in joints_of.values()
            ],
            dtype=bool,
        )

    @cached_property
    def continuous(self) -> NDArray[np.bool_]:
        """Mask (n,) of motors without limits, whose `lower` and `upper` are the search range."""
        unlimited = np.array([actuator.continuous for actuator in self.actuators], dtype=bool)
        return self._independent_turns & unlimited

    @cached_property
    def multi_turn(self) -> tuple[int, ...]:
        """Indices in q of the motors that can reach the same pose in several turns."""
        wide = self.continuous | (self.upper - self.lower >= 2 * np.pi)
        return tuple(np.flatnonzero(self._independent_turns & wide).tolist())

    @cached_property
    def motion_limits(self) -> tuple[Array, Array]:
        """Lower and upper limits (n,) of motions; ±`CONTINUOUS_LIMIT` for continuous motors."""
        lower = np.where(self.continuous, -CONTINUOUS_LIMIT, self.lower)
        return read_only(lower), read_only(np.where(self.continuous, CONTINUOUS_LIMIT, self.upper))

    @cached_property
    def joint_lower(self) -> Array:
        """Lower limits (m,) of the movable joints."""
        return read_only([joint.lower for joint in self.movable])

    @cached_property
    def joint_upper(self) -> Array:
        """Upper limits (m,) of the movable joints."""
        return read_only([joint.upper for joint in self.movable])

    @cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links; the root is first."""
        return links_of(self)

    def finger(self, name: str) -> Finger:
        """Return the finger of a name.

        Raises:
            UnknownNameError: The finger does not exist; the message lists the fingers.
        """
        for finger in self.fingers:
            if finger.name == name:
                return finger
        raise UnknownNameError(
            f"robot {self.name!r} has no finger {name!r}; its fingers: "
            + ", ".join(self.finger_names)
        )

    def actuator_index(self, name: str) -> int:
        """Return the index of an actuator in q.

        Raises:
            UnknownNameError: The actuator does not exist; the message lists the actuators.
        """
        try:
            return self.actuator_names.index(name)
        except ValueError:
            raise UnknownNameError(
                f"robot {self.name!r} has no actuator {name!r}; its actuators: "
                + ", ".join(self.actuator_names)
            ) from None

    def chain(self, link: str) -> tuple[Joint, ...]:
        """Return the joints from the root to a link, in order, including fixed ones.

        Raises:
            UnknownNameError: The link does not exist.
        """
        if link not in self.links:
            raise UnknownNameError(f"robot {self.name!r} has no link {link!r}")
        return tuple(chain_to(self, link))

    @cached_property
    def arm_actuators(self) -> tuple[int, ...]:
        """Indices in q of the arm's actuators; empty for a hand alone and for a multi-arm robot."""
        if self.sides:
            return ()
        return tuple(i for i, a in enumerate(self.actuators) if a.part == "arm")

    @cached_property
    def hand_actuators(self) -> tuple[int, ...]:
        """Indices in q of all actuators but the arm's; of a multi-arm robot, those of all hands."""
        if self.sides:
            return tuple(index for _, hand in self.side_actuators for index in hand)
        arm = set(self.arm_actuators)
        return tuple(i for i in range(len(self.actuators)) if i not in arm)

    @property
    def as_hand(self) -> RobotDescription:
        """The robot as a hand on a fixed base, to which all motors of a multi-arm robot belong."""
        return replace(self, sides=(), trunk=(), trunk_link="") if self.sides else self

    @cached_property
    def trunk_actuators(self) -> tuple[int, ...]:
        """Indices in q of the motors that move every palm of a multi-arm robot."""
        return tuple(self.actuator_index(name) for name in self.trunk)

    @cached_property
    def side_actuators(self) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
        """Indices in q of the motors of arm and hand, by side."""
        return tuple(
            (
                tuple(map(self.actuator_index, side.arm)),
                tuple(map(self.actuator_index, side.hand)),
            )
            for side in self.sides
        )

    def get_side(self, name: str) -> Side:
        """Return a side of a multi-arm robot.

        Raises:
            UnknownNameError: The side does not exist; the message lists the sides.
        """
        for side in self.sides:
            if side.name == name:
                return side
        sides = ", ".join(side.name for side in self.sides) or "none"
        raise UnknownNameError(f"robot {self.name!r} has no side {name!r}; its sides: {sides}")

    def side(self, name: str, with_trunk: bool = False) -> RobotDescription:
        """Return a side as an arm-hand whose root is the link at the trunk's end.

        Motors, fingers and links keep their names, and the order of q is preserved.

        Args:
            name: Name of the side.
            with_trunk: True to include the trunk as the first joints of the arm.

        Raises:
            UnknownNameError: The side does not exist; the message lists the sides.
        """
        side = self.get_side(name)
        root, arm = self.trunk_link, side.arm
        if with_trunk:
            root, arm = self.root, (*self.trunk, *arm)
        parts = dict.fromkeys(arm, "arm") | dict.fromkeys(side.hand, "hand")
        motors = {i for i, motor in enumerate(self.actuator_names) if motor in parts}
        moved_by_others = self.links_moved(set(range(len(self.actuators))) - motors)
        excluded = moved_by_others if with_trunk else set()
        links = set(self.links_moved(motors) - excluded) | {side.palm_link}
        for finger in side.fingers:
            links.add(self.finger(finger).link)
        for link in tuple(links):
            links |= {joint.child for joint in self.chain(link)}
        links -= {joint.child for joint in self.chain(root)}
        to_palm = {joint.name for joint in self.chain(side.palm_link)}
        return replace(
            self,
            name=f"{self.name}.{name}",
            root=root,
            joints=tuple(
                replace(joint, part="arm" if joint.name in to_palm else "hand")
                for joint in self.joints
                if joint.child in links
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
                        if joint.type != "fixed" and joint.child in links
                        if joint.name not in to_palm
                    ),
                )
                for finger in map(self.finger, side.fingers)
            ),
            named_thumb=side.named_thumb,
            palm_link=side.palm_link,
            palm_placement=side.palm_placement,
            home=self.home[sorted(motors)],
            shapes=self.shapes.remove_links(set(self.links) - links - {root}),
            sides=(),
            trunk=(),
            trunk_link="",
        )

    def finger_actuators(self, name: str) -> tuple[int, ...]:
        """Return the indices in q of the actuators that move a finger relative to the palm.

        Raises:
            UnknownNameError: The finger does not exist.
        """
        return tuple(sorted(self.driving_actuators(self.finger(name).joints)))

    @cached_property
    def finger_motors(self) -> tuple[str, ...]:
        """Names of the actuators that move a finger relative to the palm, in the order of q."""
        of_fingers = {i for name in self.finger_names for i in self.finger_actuators(name)}
        return tuple(self.actuator_names[i] for i in sorted(of_fingers))

    @cached_property
    def finger_joints(self) -> tuple[str, ...]:
        """Names of all movable joints of the fingers, in the order of `joint_names`."""
        of_fingers = {name for finger in self.fingers for name in finger.joints}
        return tuple(name for name in self.joint_names if name in of_fingers)

    def links_moved(self, actuators: Collection[int]) -> frozenset[str]:
        """Return the links that any of some actuators (indices in q) moves."""
        links: set[str] = set()
        for link in self.links:
            joints = [joint.name for joint in self.chain(link) if joint.type != "fixed"]
            if not self.driving_actuators(joints).isdisjoint(actuators):
                links.add(link)
        return frozenset(links)

    def driving_actuators(self, joints: Iterable[str]) -> set[int]:
        """Return the indices in q of the actuators that drive some joints."""
        by_name = {joint.name: joint for joint in self.joints}
        actuators: set[int] = set()
        for joint_name in joints:
            joint = by_name[joint_name]
            while joint.coupling is not None and joint.coupling.of in by_name:
                joint = by_name[joint.coupling.of]
            source = joint.name if joint.coupling is None else joint.coupling.of
            actuators.add(self.actuator_index(source))
        return actuators
