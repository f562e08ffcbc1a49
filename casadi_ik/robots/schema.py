"""What may stand in an arm, hand or arm-hand file."""

from __future__ import annotations

import msgspec

from casadi_ik.files.reading import Angles, Frame, Point, Struct, Vector
from casadi_ik.files.units import AnyValue, JointRate, JointValue
from casadi_ik.robots.collision import CollisionEntry
from casadi_ik.robots.couplings import Coupling


class JointEntry(Struct, frozen=True):
    """A joint; ``coupling`` absent means that it is its own actuator."""

    name: str
    parent: str
    child: str
    axis: Vector
    limits: tuple[JointValue, JointValue]
    source: str
    type: str = "revolute"
    origin: Frame = Frame()
    velocity: JointRate | None = None
    coupling: Coupling | None = None


class ActuatorEntry(Struct, frozen=True):
    """A motor; limits and velocity are the joint's where it drives a joint of the same name."""

    limits: tuple[JointValue, JointValue] | None = None
    velocity: JointRate | None = None
    unit: str = "rad"
    source: str = ""


class LinkFrame(Struct, frozen=True):
    """A frame on a link."""

    link: str
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    source: str = ""


class ContactEntry(Struct, frozen=True):
    """The contact frame of a finger; ``normal`` is the outward pad normal in that frame.

    ``tangent`` is the pad's second axis; left out, it is the frame's x axis. Either is made
    orthogonal to the normal.
    """

    link: str
    normal: Vector
    source: str
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    tangent: Vector | None = None


class ArmFile(Struct, frozen=True):
    """``models/arms/*.yaml``; ``home`` is where an arm stands whose robot does not say."""

    name: str
    root: str
    tip: LinkFrame
    joints: list[JointEntry]
    sources: dict[str, str]
    description: str = ""
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    collision: CollisionEntry | None = None


class HandFile(Struct, frozen=True):
    """``models/hands/*.yaml``.

    ``thumb``, ``mount`` (the hand's root on the arm's tip) and ``home`` hold for a robot that is
    put together by name; others say them themselves.
    """

    name: str
    root: str
    palm: LinkFrame
    joints: list[JointEntry]
    fingers: dict[str, ContactEntry]
    sources: dict[str, str]
    actuators: dict[str, ActuatorEntry] | None = None
    description: str = ""
    thumb: str | None = None
    mount: Frame = Frame()
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    collision: CollisionEntry | None = None


class ArmFromFile(Struct, frozen=True):
    """An arm in somebody's file: the chain from ``root`` to ``tip``.

    ``locked`` joints stand still at a value; ``limits`` go before the file's.
    """

    file: str
    tip: str | None = None
    root: str | None = None
    locked: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    limits: dict[str, tuple[AnyValue, AnyValue]] = msgspec.field(default_factory=dict)


class HandFromFile(Struct, frozen=True):
    """A hand in somebody's file, or a whole robot: what is above ``palm`` moves the hand."""

    file: str
    palm: str | LinkFrame | None = None
    root: str | None = None
    locked: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    limits: dict[str, tuple[AnyValue, AnyValue]] = msgspec.field(default_factory=dict)


class PadEntry(Struct, frozen=True):
    """The contact frame of a finger of a `HandFromFile`; see `ContactEntry`."""

    link: str
    normal: Vector
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    tangent: Vector | None = None


class ArmHandFile(Struct, frozen=True):
    """``models/arm_hands/*.yaml``: an arm (or none), a hand, and what joins them.

    ``hand`` is a shipped name, a path, or the hand itself.
    """

    name: str
    hand: str | HandFile
    fingers: list[str]
    thumb: str | None = None
    arm: str | ArmFromFile | None = None
    mount: Frame = Frame()
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    sources: dict[str, str] = msgspec.field(default_factory=dict)
    description: str = ""
    collision: CollisionEntry | None = None


class ImportedFile(Struct, frozen=True):
    """An arm-hand whose hand is in somebody's file: either ``hand`` or ``robot``, which has an arm.

    The fingers are described here, since no file says where a pad is.
    """

    name: str
    fingers: dict[str, PadEntry]
    hand: HandFromFile | None = None
    robot: HandFromFile | None = None
    arm: str | ArmFromFile | None = None
    thumb: str | None = None
    mount: Frame = Frame()
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    sources: dict[str, str] = msgspec.field(default_factory=dict)
    description: str = ""
    collision: CollisionEntry | None = None
