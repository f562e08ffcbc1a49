"""Arms and hands as parts of a robot: validation, renaming and mirror images."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import Array, read_only
from casadi_ik.files.limits import LIMITS
from casadi_ik.files.reading import frame_matrix
from casadi_ik.model.couplings import Linear
from casadi_ik.model.joints import Actuator, Joint, links_of, parents_first, require_name
from casadi_ik.model.link_shapes import NO_SHAPES, Shapes, link_shapes
from casadi_ik.model.schema import ActuatorEntry, ArmFile, HandFile, JointEntry, PadEntry


def check_couplings(joints: dict[str, Joint], actuators: list[Actuator], path: Path) -> None:
    """Check that every coupling leads to an actuator, and that every actuator moves a joint.

    Args:
        joints: Movable joints by name.
        actuators: The actuators.
        path: File of the joints.

    Raises:
        DescriptionError: A check fails, a coupling follows a coordinate of another unit, or a
            slider leaves its triangle.
    """
    units = {joint.name: "m" if joint.type == "prismatic" else "rad" for joint in joints.values()}
    units |= {actuator.name: actuator.unit for actuator in actuators}
    sources = {joint.coupling.of for joint in joints.values() if joint.coupling is not None}
    for actuator in actuators:
        if actuator.name not in joints and actuator.name not in sources:
            raise DescriptionError(
                f"{path}: actuators.{actuator.name}: moves no joint; expected the name of a joint, "
                "or a coupling that follows it"
            )
    for joint in joints.values():
        _check_coupling(joint, joints, {actuator.name for actuator in actuators}, path)
        if (coupling := joint.coupling) is None:
            continue
        if coupling.source_unit and units[coupling.of] != coupling.source_unit:
            raise DescriptionError(
                f"{path}: joint {joint.name!r}: coupling.of: {coupling.of!r} is in "
                f"{units[coupling.of]}; expected a coordinate in {coupling.source_unit}"
            )
        motor = next((actuator for actuator in actuators if actuator.name == coupling.of), None)
        if motor is not None:
            location = f"{path}: joint {joint.name!r}: coupling"
            coupling.check_stroke(motor.name, motor.lower, motor.upper, location)


def _check_coupling(
    joint: Joint, by_name: dict[str, Joint], actuators: set[str], path: Path
) -> None:
    """Check that a joint's couplings lead to an actuator."""
    location = f"{path}: joint {joint.name!r}"
    sources, current = [joint.name], joint
    while current.coupling is not None:
        source = current.coupling.of
        if source in sources:
            cycle = " -> ".join([*sources, source])
            raise DescriptionError(f"{location}: coupling.of: is a cycle {cycle}")
        if source in actuators:
            return
        if source not in by_name:
            raise DescriptionError(
                f"{location}: coupling.of: unknown joint or actuator {source!r}; known: "
                + ", ".join([*by_name, *sorted(actuators - set(by_name))])
            )
        sources.append(source)
        current = by_name[source]
    if current.name not in actuators:
        raise DescriptionError(
            f"{location}: coupling: missing; expected one, or {current.name!r} under 'actuators'"
        )


def require_unique(names: Iterable[str], location: str) -> None:
    """Refuse names that appear twice."""
    unique: set[str] = set()
    for name in names:
        require_usable_name(name, location)
        if name in unique:
            raise DescriptionError(f"{location}: {name!r} appears twice")
        unique.add(name)


def require_usable_name(name: str, location: str) -> None:
    """Refuse a name that is empty, or too long for tables and file names."""
    if not 0 < len(name) <= LIMITS.name_text:
        raise DescriptionError(
            f"{location}: found a name of {len(name)} characters, expected 1 to {LIMITS.name_text}"
        )


def require_source(tags: str, sources: dict[str, str], location: str) -> None:
    """Refuse source tags (separated by spaces or commas) that are missing or unknown."""
    for tag in tags.replace(",", " ").split():
        if tag not in sources:
            raise DescriptionError(
                f"{location}: tag {tag!r} is unknown; expected one of: {', '.join(sources)}"
            )
    if not tags.strip():
        raise DescriptionError(f"{location}: is empty; expected the source of the numbers")


HAND_PREFIX = "hand_"
"""Prefix of a name of the hand that the arm has, too."""


@dataclass(frozen=True)
class RobotPart:
    """An arm or a hand.

    Attributes:
        name: Name of the part.
        location: Prefix of its keys in messages: its file, "arm.yaml: ".
        root: Root link.
        joints: Joints, parents before children.
        actuators: Motors.
        sources: Sources of the numbers by tag.
        tip_link: Link that carries the next part: tip of an arm, palm of a hand.
        tip: (4, 4) pose of the tip or palm frame in that link.
        home: Home positions of some motors.
        shapes: Collision shapes of the links.
        pads: Contact frames of a hand by finger.
        thumb: Finger placed first; None if the part names none.
        mount: (4, 4) default pose of a hand's root on an arm's tip.
    """

    name: str
    location: str
    root: str
    joints: list[Joint]
    actuators: list[Actuator]
    sources: dict[str, str]
    tip_link: str
    tip: Array
    home: dict[str, float]
    shapes: Shapes = NO_SHAPES
    pads: Mapping[str, PadEntry] = field(default_factory=dict)
    thumb: str | None = None
    mount: Array = field(default_factory=lambda: np.eye(4))

    @classmethod
    def one_link(
        cls,
        link: str,
        location: str = "",
        name: str | None = None,
        pads: Mapping[str, PadEntry] | None = None,
    ) -> RobotPart:
        """Return a part that consists of one link without joints.

        Args:
            link: Name of the link.
            location: Prefix of its keys in messages.
            name: Name of the part; None for the name of the link.
            pads: Contact frames by finger.
        """
        return cls(
            name=link if name is None else name,
            location=location,
            root=link,
            joints=[],
            actuators=[],
            sources={},
            tip_link=link,
            tip=np.eye(4),
            home={},
            pads=pads or {},
        )

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links; the root is first."""
        return links_of(self)

    @property
    def movers(self) -> set[str]:
        """Names of all joints and motors."""
        return {item.name for item in (*self.joints, *self.actuators)}


def prefix_shared_names(hand: RobotPart, arm: RobotPart) -> RobotPart:
    """Return the hand with `HAND_PREFIX` before every name that the arm has, too."""
    movers = arm.movers | {"mount"}
    return _renamed(
        hand,
        lambda name: _prefixed(name, arm.links, hand.links),
        lambda name: _prefixed(name, movers, hand.movers),
    )


def prefix_side(part: RobotPart, side: str, shared_link: str | None = None) -> RobotPart:
    """Return the part with the side's name before all names that do not begin with it.

    Args:
        part: An arm or a hand.
        side: Name of the side; "left" gives the prefix "left_".
        shared_link: Link that keeps its name.
    """

    def prefixed(name: str) -> str:
        unchanged = name == shared_link or name.startswith(f"{side}_")
        return name if unchanged else f"{side}_{name}"

    renamed = _renamed(part, prefixed, prefixed)
    thumb = None if part.thumb is None else prefixed(part.thumb)
    pads = {prefixed(name): pad for name, pad in renamed.pads.items()}
    return replace(renamed, pads=pads, thumb=thumb)


def mirrored(part: RobotPart) -> RobotPart:
    """Return the mirror image of a part, in which y is inverted in the frame of its root.

    Every frame is mirrored in y of that frame. The axis of a joint is mirrored, too; if the
    opposite axis is closer to the original one, the joint uses that one and its positions change
    sign, unless it has a coupling that is not linear.
    """
    nonlinear = [j for j in part.joints if j.coupling and not isinstance(j.coupling, Linear)]
    unchanged = {j.name for j in nonlinear} | {j.coupling.of for j in nonlinear if j.coupling}
    inverted: set[str] = set()
    joints = []
    for joint in part.joints:
        axis = joint.axis * MIRROR_SIGNS
        if joint.type == "revolute":
            axis = -axis
        if joint.type != "fixed" and axis @ joint.axis < 0 and joint.name not in unchanged:
            axis = -axis
            inverted.add(joint.name)
        joints.append(replace(joint, axis=read_only(axis), placement=_mirrored(joint.placement)))
    # A motor that is not a joint changes its sign with the joints that follow it.
    sources = {j.coupling.of for j in joints if j.coupling is not None and j.name in inverted}
    inverted |= sources - {joint.name for joint in joints}
    return replace(
        part,
        joints=[_inverted_joint(joint, inverted) for joint in joints],
        actuators=[
            replace(motor, lower=-motor.upper, upper=-motor.lower)
            if motor.name in inverted
            else motor
            for motor in part.actuators
        ],
        tip=_mirrored(part.tip),
        mount=_mirrored(part.mount),
        home={name: -q if name in inverted else q for name, q in part.home.items()},
        shapes=part.shapes.mirrored(),
        pads={name: _mirrored_pad(pad) for name, pad in part.pads.items()},
    )


MIRROR_SIGNS = np.array([1.0, -1.0, 1.0])
"""Signs of the components of a vector in the mirror image."""


def _mirrored(pose: Array) -> Array:
    mirror = np.diag([*MIRROR_SIGNS, 1.0])
    return read_only(mirror @ pose @ mirror)


def _mirrored_pad(pad: PadEntry) -> PadEntry:
    """Return the mirror image of a contact frame."""

    def mirror(vector: tuple[float, ...]) -> tuple[float, ...]:
        return vector[0], -vector[1], vector[2]

    return msgspec.structs.replace(
        pad,
        xyz=mirror(pad.xyz),
        rpy=(-pad.rpy[0], pad.rpy[1], -pad.rpy[2]),
        normal=mirror(pad.normal),
        tangent=None if pad.tangent is None else mirror(pad.tangent),
    )


def _inverted_joint(joint: Joint, inverted: set[str]) -> Joint:
    """Return a joint of a mirror image after the positions of some joints have changed sign.

    Args:
        joint: Joint of the mirror image.
        inverted: Names of joints and motors whose positions have changed sign.
    """
    coupling, is_inverted = joint.coupling, joint.name in inverted
    if isinstance(coupling, Linear) and (is_inverted or coupling.of in inverted):
        sign = -1.0 if is_inverted else 1.0
        ratio = coupling.ratio * sign * (-1.0 if coupling.of in inverted else 1.0)
        coupling = msgspec.structs.replace(coupling, ratio=ratio, offset=sign * coupling.offset)
    lower, upper = (-joint.upper, -joint.lower) if is_inverted else (joint.lower, joint.upper)
    return replace(joint, coupling=coupling, lower=lower, upper=upper)


def _renamed(part: RobotPart, link: Callable[[str], str], mover: Callable[[str], str]) -> RobotPart:
    """Return the part with other names of links, and of joints and motors."""
    joints = [
        replace(
            joint,
            name=mover(joint.name),
            parent=link(joint.parent),
            child=link(joint.child),
            coupling=joint.coupling
            and msgspec.structs.replace(joint.coupling, of=mover(joint.coupling.of)),
        )
        for joint in part.joints
    ]
    return replace(
        part,
        root=link(part.root),
        joints=joints,
        actuators=[replace(motor, name=mover(motor.name)) for motor in part.actuators],
        shapes=part.shapes.renamed({name: link(name) for name in part.links}),
        tip_link=link(part.tip_link),
        home={mover(name): value for name, value in part.home.items()},
        pads={
            name: msgspec.structs.replace(pad, link=link(pad.link))
            for name, pad in part.pads.items()
        },
    )


def _prefixed(name: str, arm_names: Collection[str], hand_names: Collection[str]) -> str:
    """Return a name of a hand, with prefixes until neither arm nor hand has it."""
    if name not in arm_names:
        return name
    while name in arm_names or name in hand_names:
        name = HAND_PREFIX + name
    return name


JOINT_TYPES = ("revolute", "prismatic", "fixed")


def part_from_file(file: ArmFile | HandFile, path: Path) -> RobotPart:
    """Return the checked arm or hand of a description file.

    Args:
        file: Record of the file.
        path: The file.

    Raises:
        DescriptionError: The file is malformed; the message names file, key and expected value.
    """
    is_hand = isinstance(file, HandFile)
    kind, key, end = ("hand", "palm", file.palm) if is_hand else ("arm", "tip", file.tip)
    joints = _joints(file.joints, file.root, file.sources, kind, path)
    motors = _actuators(file.actuators if is_hand else None, joints, file.sources, kind, path)
    links = (file.root, *(joint.child for joint in joints))
    require_name(end.link, links, "link", f"{path}: {key}.link")
    require_source(end.source, file.sources, f"{path}: {key}.source")
    for name, finger in file.fingers.items() if is_hand else ():
        require_source(finger.source, file.sources, f"{path}: fingers.{name}.source")
    if file.collision is not None and file.collision.links:
        require_source(file.collision.source, file.sources, f"{path}: collision.source")
    part = RobotPart(
        file.name,
        f"{path}: ",
        file.root,
        joints,
        motors,
        file.sources,
        end.link,
        frame_matrix(end),
        file.home,
        link_shapes(file.collision, links, path),
    )
    if not is_hand:
        return part
    return replace(part, pads=file.fingers, thumb=file.thumb, mount=frame_matrix(file.mount))


def _joints(
    entries: list[JointEntry], root: str, sources: dict[str, str], part: str, path: Path
) -> list[Joint]:
    """Return checked joints, parents before children."""
    names = [entry.name for entry in entries]
    require_unique(names, f"{path}: joints")
    require_unique([root, *(entry.child for entry in entries)], f"{path}: joints: child links")
    for entry in entries:
        location = f"{path}: joint {entry.name!r}"
        if entry.type not in JOINT_TYPES:
            raise DescriptionError(
                f"{location}: type: found {entry.type!r}, expected one of {', '.join(JOINT_TYPES)}"
            )
        low, high = entry.limits
        if not low <= high:
            raise DescriptionError(f"{location}: limits: lower {low:.6g} is above upper {high:.6g}")
        if not np.linalg.norm(entry.axis) > 1e-9:
            raise DescriptionError(f"{location}: axis: is zero, expected a direction")
        require_source(entry.source, sources, f"{location}: source")
        if entry.coupling is not None:
            entry.coupling.check(f"{location}: coupling")
    ordered = parents_first(entries, root)
    detached = next((entry for entry in entries if entry not in ordered), None)
    if detached is not None:
        links = {entry.child for entry in entries}
        problem = "is part of a cycle" if detached.parent in links else "is not a link"
        raise DescriptionError(
            f"{path}: joint {detached.name!r}: parent: {detached.parent!r} {problem}; "
            f"expected a chain of joints from the root {root!r}"
        )
    return [_joint(entry, part) for entry in ordered]


def _joint(entry: JointEntry, part: str) -> Joint:
    """Return the joint of an entry of a description file."""
    axis = np.asarray(entry.axis, dtype=float)
    return Joint(
        name=entry.name,
        parent=entry.parent,
        child=entry.child,
        type=entry.type,
        placement=read_only(frame_matrix(entry.origin)),
        axis=read_only(axis / np.linalg.norm(axis)),
        lower=entry.limits[0],
        upper=entry.limits[1],
        velocity=entry.velocity or math.inf,
        coupling=entry.coupling,
        part=part,
        effort=entry.effort or math.inf,
    )


def _actuators(
    entries: dict[str, ActuatorEntry] | None,
    joints: list[Joint],
    sources: dict[str, str],
    part: str,
    path: Path,
) -> list[Actuator]:
    """Return the part's actuators, after a check that every coupling leads to one of them."""
    by_name = {joint.name: joint for joint in joints if joint.type != "fixed"}
    if entries is None:
        entries = {name: ActuatorEntry() for name, j in by_name.items() if j.coupling is None}
    actuators = []
    for name, entry in entries.items():
        location = f"{path}: actuators.{name}"
        joint = by_name.get(name)
        if joint is not None and joint.coupling is not None:
            raise DescriptionError(
                f"{location}: joint {name!r} has a coupling to {joint.coupling.of!r}; "
                "expected a joint without coupling"
            )
        if entry.limits is None and joint is None:
            raise DescriptionError(f"{location}: limits: missing (no joint has this name)")
        if entry.unit not in ("rad", "m"):
            raise DescriptionError(f"{location}: unit: found {entry.unit!r}, expected 'rad' or 'm'")
        low, high = entry.limits or ((joint.lower, joint.upper) if joint else (0.0, 0.0))
        if not low < high:
            raise DescriptionError(
                f"{location}: limits: lower {low:.6g} is not below upper {high:.6g}"
            )
        velocity = entry.velocity or (joint.velocity if joint else math.inf)
        effort = entry.effort or (joint.effort if joint else math.inf)
        if entry.source or joint is None:
            require_source(entry.source, sources, f"{location}: source")
        unit = ("m" if joint.type == "prismatic" else "rad") if joint else entry.unit
        actuators.append(Actuator(name, unit, low, high, velocity, part, effort))
    check_couplings(by_name, actuators, path)
    return actuators
