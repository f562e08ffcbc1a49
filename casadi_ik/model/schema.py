"""What may stand in an arm, hand or arm-hand file."""

from __future__ import annotations

import msgspec

from casadi_ik.files.reading import Angles, Frame, Point, Struct, Vector
from casadi_ik.files.units import AnyValue, Factor, JointRate, JointValue, Length, Size
from casadi_ik.model.couplings import Coupling


class _Shape(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A shape.

    Attributes:
        excess: By how much it is larger than the mesh it holds, at most [m].
    """


class SphereEntry(_Shape, frozen=True, tag="sphere", kw_only=True):
    """A ball about a point of the link.

    Attributes:
        radius: [m].
        center: In the link's frame [m].
    """

    radius: Size
    center: Point = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class CapsuleEntry(_Shape, frozen=True, tag="capsule", kw_only=True):
    """All within the radius of the segment between two points of the link.

    Attributes:
        ends: Two points of the link's frame [m].
        radius: [m].
    """

    ends: tuple[Point, Point]
    radius: Size
    excess: Length = 0.0


class BoxEntry(_Shape, frozen=True, tag="box", kw_only=True):
    """A box about its own frame's origin.

    Attributes:
        size: Along its own x, y and z [m].
        xyz: Its middle in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    size: tuple[Size, Size, Size]
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class CylinderEntry(_Shape, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z about its own frame's origin.

    Attributes:
        radius: [m].
        length: Along its own z [m].
        xyz: Its middle in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    radius: Size
    length: Size
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


ShapeEntry = SphereEntry | CapsuleEntry | BoxEntry | CylinderEntry


class TouchingEntry(Struct, frozen=True):
    """Two links that may touch, and why.

    Attributes:
        links: Their names; in a scene a solid's too.
        reason: Why, in words.
        depth: How far their shapes may overlap [m]; left out: any.
    """

    links: tuple[str, str]
    reason: str
    depth: Size | None = None


class CollisionEntry(Struct, frozen=True):
    """The key ``collision`` of a description.

    Attributes:
        links: Shapes by link.
        touching: Pairs of links that are not checked, or less strictly.
        source: Tags of `sources` that the shapes are from.
        srdf: A file with more pairs that may touch.
    """

    links: dict[str, list[ShapeEntry]] = msgspec.field(default_factory=dict)
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    source: str = ""
    srdf: str | None = None


class JointEntry(Struct, frozen=True):
    """A joint; ``coupling`` absent means that it is its own actuator.

    Attributes:
        name: Of the joint; an actuator of a joint that follows none has it too.
        parent: Link that it is on.
        child: Link that it moves.
        axis: Direction in the child's frame about which (prismatic: along which) the child moves.
        limits: Lower and upper end [rad or m].
        source: Tags of `sources` that its numbers are from.
        type: revolute, prismatic or fixed.
        origin: The child's frame in the parent's while the joint reads zero.
        velocity: Its limit [rad/s or m/s]; left out: not known.
        effort: Its largest torque or force [N m or N]; left out: not known.
        coupling: What it follows; left out: it has a motor of its own.
    """

    name: str
    parent: str
    child: str
    axis: Vector
    limits: tuple[JointValue, JointValue]
    source: str
    type: str = "revolute"
    origin: Frame = Frame()
    velocity: JointRate | None = None
    effort: Factor | None = None
    coupling: Coupling | None = None


class ActuatorEntry(Struct, frozen=True):
    """A motor; limits and velocity are the joint's where it drives a joint of the same name.

    Attributes:
        limits: Lower and upper end [rad or m]; left out: the joint's of the same name.
        velocity: Its limit [rad/s or m/s]; left out: the joint's.
        effort: Its largest torque or force [N m or N]; left out: the joint's.
        unit: rad or m, where no joint has its name.
        source: Tags of `sources` that its numbers are from.
    """

    limits: tuple[JointValue, JointValue] | None = None
    velocity: JointRate | None = None
    effort: Factor | None = None
    unit: str = "rad"
    source: str = ""


class LinkFrame(Frame, frozen=True, kw_only=True):
    """A frame on a link.

    Attributes:
        link: Name of the link.
        xyz: Origin in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
        source: Tags of `sources` that its numbers are from.
    """

    link: str
    source: str = ""


class BallPad(Struct, frozen=True, tag_field="kind", tag="ball"):
    """A pad that touches with any point of a ball; at zero lean with the contact frame's origin.

    Attributes:
        radius: Of the ball, whose middle is behind the contact frame's origin [m].
    """

    radius: Size


class PlanePad(Struct, frozen=True, tag_field="kind", tag="plane"):
    """A flat pad: it touches with the contact frame's origin and faces what it touches."""


class PadEntry(Frame, frozen=True, kw_only=True):
    """The contact frame of a finger: where its pad touches and which way that faces.

    Normal and tangent are made orthogonal.

    Attributes:
        link: Link that the pad is on.
        normal: Direction out of the pad, away from the finger, in the contact frame.
        xyz: Where the pad touches, in the link's frame [m].
        rpy: Angles of the contact frame about the link's fixed axes [rad].
        tangent: The pad's second axis; left out: the frame's x axis.
        pad: What it touches with; left out: a plane.
    """

    link: str
    normal: Vector
    tangent: Vector | None = None
    pad: BallPad | PlanePad = PlanePad()


class FingertipEntry(PadEntry, frozen=True, kw_only=True):
    """The contact frame of a finger of a described hand; see `PadEntry`.

    Attributes:
        source: Tags of `sources` that its numbers are from.
    """

    source: str


class _Described(Struct, frozen=True, kw_only=True):
    """What a file of ours says of whatever it describes.

    Attributes:
        name: What it is called.
        description: What it is, the first sentence by itself.
        home: Position by actuator where it is taken to stand [rad or m].
        collision: Shapes of its links; these go before those of its parts, or of its file.
        sources: Where numbers are from, by tag.
    """

    name: str
    description: str = ""
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    collision: CollisionEntry | None = None


class _Part(_Described, frozen=True, kw_only=True):
    """What a robot is put together from.

    Attributes:
        root: Link that all others hang on.
        joints: In any order.
    """

    root: str
    joints: list[JointEntry]
    sources: dict[str, str]


class ArmFile(_Part, frozen=True, kw_only=True):
    """An arm: ``models/arms/*.yaml``.

    Attributes:
        tip: Frame that a hand is mounted on.
    """

    tip: LinkFrame


class HandFile(_Part, frozen=True, kw_only=True):
    """A hand: ``models/hands/*.yaml``.

    ``thumb``, ``mount`` and ``home`` hold for a robot that is put together by name; others say
    them themselves.

    Attributes:
        palm: Frame of the palm: z away from it, y towards the thumb.
        fingers: Contact frame by finger.
        actuators: Motors by name; left out: one for each joint without coupling.
        thumb: Finger that is placed first.
        mount: The hand's root on an arm's tip.
    """

    palm: LinkFrame
    fingers: dict[str, FingertipEntry]
    actuators: dict[str, ActuatorEntry] | None = None
    thumb: str | None = None
    mount: Frame = Frame()


class _FromFile(Struct, frozen=True, kw_only=True):
    """What stands in somebody's file.

    Attributes:
        file: URDF, xacro or MJCF; a path counts from the description.
        root: Link that it begins with; left out: the file's.
        locked: Joints that stand still, and where [rad or m].
        limits: Limits by joint that go before the file's [rad or m].
        xacro: Values of the file's arguments, NAME:=VALUE; true: its macros are expanded although
            it is not called ``.xacro``.
    """

    file: str
    root: str | None = None
    locked: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    limits: dict[str, tuple[AnyValue, AnyValue]] = msgspec.field(default_factory=dict)
    xacro: bool | list[str] = False


class ArmFromFile(_FromFile, frozen=True, kw_only=True):
    """An arm in somebody's file: the chain from ``root`` to ``tip``.

    Attributes:
        tip: Link that a hand is mounted on; left out: the only end of the chain.
    """

    tip: str | None = None


class HandFromFile(_FromFile, frozen=True, kw_only=True):
    """A hand in somebody's file, or a whole robot: what is above ``palm`` moves the hand.

    Attributes:
        palm: Link of the palm, or a frame on it.
    """

    palm: str | LinkFrame | None = None


class _Robot(_Described, frozen=True, kw_only=True):
    """A robot."""

    sources: dict[str, str] = msgspec.field(default_factory=dict)


class _OnArm(_Robot, frozen=True, kw_only=True):
    """A robot of one hand, on an arm or on a fixed base.

    Attributes:
        thumb: Finger that is placed first; the paper's methods need one.
        arm: A shipped name, a path, or an arm in somebody's file; left out: the hand stands on a
            fixed base.
        mount: The hand's root on the arm's tip.
    """

    thumb: str | None = None
    arm: str | ArmFromFile | None = None
    mount: Frame = Frame()


class ArmHandFile(_OnArm, frozen=True, kw_only=True):
    """A robot: an arm (or none), a described hand, and what joins them.

    Attributes:
        hand: A shipped name, a path, or the hand itself.
        fingers: The hand's fingers that take part, in their order.
    """

    hand: str | HandFile
    fingers: list[str]


class ImportedFile(_OnArm, frozen=True, kw_only=True):
    """A robot whose hand is in somebody's file: either ``hand`` or ``robot``, which has an arm.

    Attributes:
        fingers: Contact frame by finger, since no file says where a pad is.
        hand: A hand in a file of its own.
        robot: A whole robot in one file; then there is no `arm`.
    """

    fingers: dict[str, PadEntry]
    hand: HandFromFile | None = None
    robot: HandFromFile | None = None


class PartSide(Struct, frozen=True):
    """An arm-hand of a body that is put together.

    Attributes:
        arm: A shipped name, a path, or an arm in somebody's file.
        hand: A shipped name, a path, or the hand itself; left out: the one that the robot's name
            has after its plus sign.
        at: Where the arm's root stands on the trunk's end; left out by all sides whose arms have
            the same root: they share that link.
        mount: The hand's root on the arm's tip; left out: as the hand says.
        mirror: Which of "arm" and "hand" are mirror images of what is described, left for right.
        fingers: The hand's fingers that take part; left out: all.
        thumb: Finger that is placed first; left out: the hand's.
    """

    arm: str | ArmFromFile
    hand: str | HandFile | None = None
    at: Frame | None = None
    mount: Frame | None = None
    mirror: list[str] = msgspec.field(default_factory=list)
    fingers: list[str] | None = None
    thumb: str | None = None


class BodyFile(_Robot, frozen=True, kw_only=True):
    """A body that is put together: arm-hands by name on a common trunk.

    Every name of a link, joint, motor or finger gets the side's name and an underscore before it,
    unless it begins with them.

    Attributes:
        sides: Arm-hand by name.
        trunk: What carries all arms: a shipped name of ``models/trunks``, a path, or a chain in
            somebody's file; left out: they stand still.
        home: Position by actuator that goes before those of the parts [rad or m].
    """

    sides: dict[str, PartSide]
    trunk: str | ArmFromFile | None = None


class FileSide(Struct, frozen=True):
    """An arm-hand of a body in somebody's file.

    Attributes:
        palm: Link of its palm, or a frame on it; what is below is the hand.
        fingers: Contact frame by finger, since no file says where a pad is.
        thumb: Finger that is placed first.
    """

    palm: str | LinkFrame
    fingers: dict[str, PadEntry]
    thumb: str | None = None


class ImportedBody(_Robot, frozen=True, kw_only=True):
    """A body in somebody's file.

    Attributes:
        robot: The file; its ``locked`` names what does not take part, such as legs and head.
        sides: Arm-hand by name; fingers get it and an underscore before their names.
        trunk: Link that all sides stand on; left out: the last one that carries all palms.
    """

    robot: HandFromFile
    sides: dict[str, FileSide]
    trunk: str | None = None
