"""Records of arm, hand and robot files; their docstrings describe the JSON Schemas."""

from __future__ import annotations

import msgspec

from casadi_ik.files.reading import Angles, Frame, Point, Struct, Vector
from casadi_ik.files.units import AnyValue, Factor, JointRate, JointValue, Length, Size
from casadi_ik.model.couplings import Coupling


class _Shape(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """A shape.

    Attributes:
        excess: Largest distance between the surface of the shape and the mesh that it encloses [m].
    """


class LinkSphereEntry(_Shape, frozen=True, tag="sphere", kw_only=True):
    """A ball.

    Attributes:
        radius: Radius [m].
        center: Centre in the link's frame [m].
    """

    radius: Size
    center: Point = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class LinkCapsuleEntry(_Shape, frozen=True, tag="capsule", kw_only=True):
    """A capsule: all points within the radius of a segment.

    Attributes:
        ends: End points of the segment in the link's frame [m].
        radius: Radius [m].
    """

    ends: tuple[Point, Point]
    radius: Size
    excess: Length = 0.0


class LinkBoxEntry(_Shape, frozen=True, tag="box", kw_only=True):
    """A box centred in its frame.

    Attributes:
        size: Edges along x, y and z of its frame [m].
        xyz: Centre in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    size: tuple[Size, Size, Size]
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


class LinkCylinderEntry(_Shape, frozen=True, tag="cylinder", kw_only=True):
    """A cylinder along z, centred in its frame.

    Attributes:
        radius: Radius [m].
        length: Length along z of its frame [m].
        xyz: Centre in the link's frame [m].
        rpy: Angles about the fixed axes x, y, z [rad], as in URDF.
    """

    radius: Size
    length: Size
    xyz: Point = (0.0, 0.0, 0.0)
    rpy: Angles = (0.0, 0.0, 0.0)
    excess: Length = 0.0


ShapeEntry = LinkSphereEntry | LinkCapsuleEntry | LinkBoxEntry | LinkCylinderEntry


class TouchingEntry(Struct, frozen=True):
    """Two links that may touch, with the reason.

    Attributes:
        links: Names of two links; in a scene one may be the name of a solid.
        reason: Reason in words.
        depth: Largest allowed penetration [m]; default: any.
    """

    links: tuple[str, str]
    reason: str
    depth: Size | None = None


class CollisionEntry(Struct, frozen=True):
    """The key ``collision`` of a description.

    Attributes:
        links: Shapes by link.
        touching: Pairs of links that are not checked, or whose penetration is allowed.
        source: Keys of `sources` in this file, separated by spaces, for the shapes.
        srdf: SRDF file with further pairs that may touch.
    """

    links: dict[str, list[ShapeEntry]] = msgspec.field(default_factory=dict)
    touching: list[TouchingEntry] = msgspec.field(default_factory=list)
    source: str = ""
    srdf: str | None = None


class JointEntry(Struct, frozen=True):
    """A joint; without ``coupling`` a motor of its name drives it.

    Attributes:
        name: Name of the joint, and of its motor if it has no coupling.
        parent: Parent link.
        child: Child link.
        axis: Axis of rotation (prismatic: of translation) in the child's frame.
        limits: Lower and upper limit [rad or m].
        source: Keys of `sources` in this file, separated by spaces, for the numbers.
        type: revolute, prismatic or fixed.
        origin: Pose of the child's frame in the parent's at joint position zero.
        velocity: Velocity limit [rad/s or m/s]; default: unknown.
        effort: Largest torque or force [N m or N]; default: unknown.
        coupling: Coupling to an actuator or joint; default: the joint has a motor.
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
    """A motor; limits and velocity default to those of the joint of the same name.

    Attributes:
        limits: Lower and upper limit [rad or m]; default: those of the joint of the same name.
        velocity: Velocity limit [rad/s or m/s]; default: that of the joint.
        effort: Largest torque or force [N m or N]; default: that of the joint.
        unit: rad or m, if no joint has this name.
        source: Keys of `sources` in this file, separated by spaces, for the numbers.
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
        source: Keys of `sources` in this file, separated by spaces, for the numbers.
    """

    link: str
    source: str = ""


class BallPad(Struct, frozen=True, tag_field="kind", tag="ball"):
    """A pad that touches with any point of a ball, nominally with the contact frame's origin.

    Attributes:
        radius: Radius of the ball [m]. Its surface passes through the contact point, and its
            centre is a radius behind that point, inside the pad.
    """

    radius: Size


class PlanePad(Struct, frozen=True, tag_field="kind", tag="plane"):
    """A flat pad: it touches with the contact frame's origin and faces the surface."""


class PadEntry(Frame, frozen=True, kw_only=True):
    """The contact frame of a finger: contact point and orientation of its pad.

    The entry states a frame on the link, and normal and tangent of the pad in that frame. The
    contact frame has the same origin; its axes are normal, tangent and their cross product. The
    tangent is made orthogonal to the normal.

    Attributes:
        link: Link of the pad.
        normal: Direction out of the pad, away from the finger, in the stated frame.
        xyz: Contact point in the link's frame [m].
        rpy: Angles of the stated frame about the link's fixed axes [rad].
        tangent: Second axis of the pad in the stated frame; default: its x axis.
        pad: Shape of the pad; default: a plane.
    """

    link: str
    normal: Vector
    tangent: Vector | None = None
    pad: BallPad | PlanePad = PlanePad()


class FingertipEntry(PadEntry, frozen=True, kw_only=True):
    """The contact frame of a finger of a hand described in YAML; see `PadEntry`.

    Attributes:
        source: Keys of `sources` in this file, separated by spaces, for the numbers.
    """

    source: str


class _Description(Struct, frozen=True, kw_only=True):
    """Keys that all descriptions have.

    Attributes:
        name: Name.
        description: Description; the first sentence is a summary.
        home: Home position by actuator [rad or m].
        collision: Shapes of the links; they override those of the arm and hand files, or those of
            the imported file.
        sources: Sources of numbers by tag.
    """

    name: str
    description: str = ""
    home: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    collision: CollisionEntry | None = None


class _PartFile(_Description, frozen=True, kw_only=True):
    """An arm or hand file.

    Attributes:
        root: Root link.
        joints: Joints in any order.
    """

    root: str
    joints: list[JointEntry]
    sources: dict[str, str]


class ArmFile(_PartFile, frozen=True, kw_only=True):
    """An arm: ``models/arms/*.yaml``.

    Attributes:
        tip: Frame on which a hand is mounted.
    """

    tip: LinkFrame


class HandFile(_PartFile, frozen=True, kw_only=True):
    """A hand: ``models/hands/*.yaml``.

    ``thumb``, ``mount`` and ``home`` apply to robots that are loaded as ARM+HAND; a robot
    file states these keys itself.

    Attributes:
        palm: Frame of the palm: z away from it, y towards the thumb.
        fingers: Contact frame by finger.
        actuators: Motors by name; default: one for each joint without coupling.
        thumb: Finger whose contact thumb-first methods solve first.
        mount: Pose of the hand's root on an arm's tip.
    """

    palm: LinkFrame
    fingers: dict[str, FingertipEntry]
    actuators: dict[str, ActuatorEntry] | None = None
    thumb: str | None = None
    mount: Frame = Frame()


class _FromFile(Struct, frozen=True, kw_only=True):
    """A part of a URDF, xacro or MJCF file.

    Attributes:
        file: URDF, xacro or MJCF; relative to the description.
        root: Root link of the part; default: that of the file.
        locked: Fixed positions by joint [rad or m].
        limits: Limits by joint that override those of the file [rad or m].
        xacro: Values of the file's arguments, NAME:=VALUE; true: expand macros although the file is
            not called ``.xacro``.
    """

    file: str
    root: str | None = None
    locked: dict[str, AnyValue] = msgspec.field(default_factory=dict)
    limits: dict[str, tuple[AnyValue, AnyValue]] = msgspec.field(default_factory=dict)
    xacro: bool | list[str] = False


class ArmFromFile(_FromFile, frozen=True, kw_only=True):
    """An arm in a URDF or MJCF file: the chain from ``root`` to ``tip``.

    Attributes:
        tip: Link on which a hand is mounted; default: the only end of the chain.
    """

    tip: str | None = None


class HandFromFile(_FromFile, frozen=True, kw_only=True):
    """A hand in a URDF or MJCF file, or a whole robot, whose joints above ``palm`` move the hand.

    Attributes:
        palm: Link of the palm, or a frame on it.
    """

    palm: str | LinkFrame | None = None


class _Robot(_Description, frozen=True, kw_only=True):
    """A robot."""

    sources: dict[str, str] = msgspec.field(default_factory=dict)


class _SingleHandRobot(_Robot, frozen=True, kw_only=True):
    """A robot with one hand, on an arm or on a fixed base.

    Attributes:
        thumb: Finger whose contact thumb-first methods solve first; they need one.
        arm: Name of a model in the package, path, or arm in a URDF or MJCF file; default: the hand
            is on a fixed base.
        mount: Pose of the hand's root on the arm's tip.
    """

    thumb: str | None = None
    arm: str | ArmFromFile | None = None
    mount: Frame = Frame()


class ArmHandFile(_SingleHandRobot, frozen=True, kw_only=True):
    """A robot: an arm (or none), a hand described in YAML, and the mount between them.

    Attributes:
        hand: Name of a model in the package, path, or the description of the hand.
        fingers: Fingers of the hand that are used, in order.
    """

    hand: str | HandFile
    fingers: list[str]


class ImportedFile(_SingleHandRobot, frozen=True, kw_only=True):
    """A robot whose hand is in a URDF or MJCF file.

    It states ``hand`` for a file with a hand only, or ``robot`` for a file with arm and hand.

    Attributes:
        fingers: Contact frame by finger, which URDF and MJCF do not state.
        hand: Hand in a separate file.
        robot: Whole robot in one file; excludes ``arm``.
    """

    fingers: dict[str, PadEntry]
    hand: HandFromFile | None = None
    robot: HandFromFile | None = None


class PartSide(Struct, frozen=True):
    """A side of a multi-arm robot that is composed of parts.

    Attributes:
        arm: Name of a model in the package, path, or arm in a URDF or MJCF file.
        hand: Name of a model in the package, path, or the description of the hand; default: the
            hand after the plus sign of the robot's name.
        at: Pose of the arm's root on the trunk's end; omitted by all sides if their arms share a
            root link.
        mount: Pose of the hand's root on the arm's tip; default: that of the hand.
        mirror: Parts ("arm", "hand") that are mirror images of the description, left for right.
        fingers: Fingers of the hand that are used; default: all.
        thumb: Finger whose contact thumb-first methods solve first; default: that of the hand.
    """

    arm: str | ArmFromFile
    hand: str | HandFile | None = None
    at: Frame | None = None
    mount: Frame | None = None
    mirror: list[str] = msgspec.field(default_factory=list)
    fingers: list[str] | None = None
    thumb: str | None = None


class BodyFile(_Robot, frozen=True, kw_only=True):
    """A multi-arm robot that is composed of parts: arm-hands by name on a common trunk.

    Names of links, joints, motors and fingers are prefixed by the side's name and an underscore,
    unless they begin with it.

    Attributes:
        sides: Arm-hand by name.
        trunk: Part that carries all arms: shipped name of ``models/trunks``, path, or chain in a
            URDF or MJCF file; default: a fixed base.
        home: Home position by actuator, which overrides those of the parts [rad or m].
    """

    sides: dict[str, PartSide]
    trunk: str | ArmFromFile | None = None


class FileSide(Struct, frozen=True):
    """A side of a multi-arm robot in a URDF or MJCF file.

    Attributes:
        palm: Link of its palm, or a frame on it; the hand is everything below.
        fingers: Contact frame by finger, which URDF and MJCF do not state.
        thumb: Finger whose contact thumb-first methods solve first.
    """

    palm: str | LinkFrame
    fingers: dict[str, PadEntry]
    thumb: str | None = None


class ImportedBody(_Robot, frozen=True, kw_only=True):
    """A multi-arm robot in a URDF or MJCF file.

    Attributes:
        robot: The file; its ``locked`` names joints that are not used, such as legs and head.
        sides: Arm-hand by name; fingers are prefixed by the name and an underscore.
        trunk: Link that carries all sides; default: the last link that carries all palms.
    """

    robot: HandFromFile
    sides: dict[str, FileSide]
    trunk: str | None = None
