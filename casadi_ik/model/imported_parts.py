"""Arms and hands in URDF and MJCF files as parts of a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from casadi_ik.errors import DescriptionError
from casadi_ik.files.arrays import read_only
from casadi_ik.files.reading import frame_matrix
from casadi_ik.model.couplings import Coupling, Linear
from casadi_ik.model.joints import Actuator, Joint, joint_motion, joints_below, leaf_links
from casadi_ik.model.link_shapes import NO_SHAPES, link_shapes
from casadi_ik.model.parts import RobotPart, check_couplings
from casadi_ik.model.schema import ArmFromFile, CollisionEntry, HandFromFile, LinkFrame, PadEntry
from casadi_ik.model.urdf_mjcf import read_tree
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

CONTINUOUS_RANGE = 2 * math.pi
"""Search range of a joint without limits, to either side of zero [rad]."""

FOLLOWER_GRID = 257
"""Positions of the leader at which the range of a follower without limits is evaluated."""

Entry = ArmFromFile | HandFromFile


def arm_from_file(entry: ArmFromFile, key: str, description: Path) -> RobotPart:
    """Return an arm: the chain of joints from root to tip.

    Args:
        entry: Entry of the description.
        key: Key of the entry.
        description: File of the description, to which the entry's file is relative.

    Raises:
        DescriptionError: The message names file, link or joint, and the required change.
        MissingExtraError: The package that reads the file's format is not installed.
    """
    tree, location, root = _open_tree(entry, key, description)
    tip = entry.tip
    if tip is None:
        leaves = leaf_links(tree, root)
        if len(leaves) != 1:
            raise DescriptionError(
                f"{location}.tip: missing; {tree.path.name} ends in several links; expected one of "
                + ", ".join(leaves)
            )
        tip = leaves[0]
    tree.require_link(tip, f"{location}.tip: {tree.path.name}")
    chain = tree.chain(root, tip, f"{location}.tip: {tree.path.name}")
    source = {key: f"{tree.path.name}, links {root} to {tip}"}
    return _part(tree, entry, (chain, ()), LinkFrame(link=tip), source, location)


def hand_from_file(
    entry: HandFromFile, pads: Mapping[str, PadEntry], key: str, description: Path
) -> RobotPart:
    """Return a hand: all joints below the palm, and the chain from the root to the palm.

    Args:
        entry: Entry of the description.
        pads: Contact frames by finger.
        key: Key of the entry.
        description: File of the description, to which the entry's file is relative.

    Raises:
        DescriptionError: The message names file, link or joint, and the required change.
        MissingExtraError: The package that reads the file's format is not installed.
    """
    tree, location, root = _open_tree(entry, key, description)
    palm = palm_frame(entry.palm or root)
    tree.require_link(palm.link, f"{location}.palm: {tree.path.name}")
    chain = tree.chain(root, palm.link, f"{location}.palm: {tree.path.name}")
    hand = tuple(joints_below(tree, palm.link))
    hand_links = {palm.link, *(joint.child for joint in hand)}
    for name, pad in pads.items():
        pad_key = f"{description}: fingers.{name}.link"
        tree.require_link(pad.link, f"{pad_key}: {tree.path.name}")
        if pad.link not in hand_links:
            raise DescriptionError(
                f"{pad_key}: {pad.link!r} is not below the palm {palm.link!r} of "
                f"{tree.path.name}; expected another link or another palm"
            )
    source = {key: f"{tree.path.name}, palm {palm.link}"}
    part = _part(tree, entry, (chain, hand), palm, source, location)
    return replace(part, location=f"{description}: ", pads=pads)


def palm_frame(palm: str | LinkFrame) -> LinkFrame:
    """Return the frame of a palm; a link alone gives the link's frame."""
    return palm if isinstance(palm, LinkFrame) else LinkFrame(link=palm)


def _open_tree(entry: Entry, key: str, description: Path) -> tuple[RobotTree, str, str]:
    """Return the tree of the entry's file, the prefix of messages, and the part's root link."""
    path, location = description.parent / Path(entry.file).expanduser(), f"{description}: {key}"
    if not path.exists():
        raise DescriptionError(f"{location}.file: {path}: no such file")
    tree = read_tree(path, entry.xacro)
    root = tree.require_link(entry.root or tree.root, f"{location}.root: {tree.path.name}")
    return tree, location, root


def _part(
    tree: RobotTree,
    entry: Entry,
    arm_and_hand_joints: tuple[tuple[TreeJoint, ...], tuple[TreeJoint, ...]],
    end: LinkFrame,
    source: dict[str, str],
    location: str,
) -> RobotPart:
    """Return joints of a file as a part of a robot.

    Args:
        tree: Joints of the file.
        entry: Entry of the description.
        arm_and_hand_joints: Joints of the arm (or above the palm), and joints of the hand.
        end: Frame of the tip or palm.
        source: Source of the numbers by tag.
        location: Description and key for error messages.
    """
    root = arm_and_hand_joints[0][0].parent if arm_and_hand_joints[0] else end.link
    joints, actuators = _PartJoints(tree, entry, *arm_and_hand_joints, location).convert()
    links = [root, *(joint.child for joint in joints)]
    shapes = NO_SHAPES
    if not tree.shapes.meshes & set(links):  # simple shapes alone would be incomplete
        primitives = tree.shapes.entries
        entries = {link: list(primitives[link]) for link in links if link in primitives}
        shapes = link_shapes(CollisionEntry(links=entries), links, tree.path)
    frame = frame_matrix(end)
    return RobotPart(
        name=tree.path.stem,
        location=f"{location}: ",
        root=root,
        joints=joints,
        actuators=actuators,
        sources=source,
        tip_link=end.link,
        tip=frame,
        home={},
        shapes=shapes,
    )


class _PartJoints:
    """Conversion of the joints of a file to joints and motors of a robot."""

    def __init__(
        self,
        tree: RobotTree,
        entry: Entry,
        chain: tuple[TreeJoint, ...],
        hand: tuple[TreeJoint, ...],
        location: str,
    ) -> None:
        self._tree = tree
        self._location = f"{location}: {tree.path.name}"
        self._key = location
        self._arm = {joint.name for joint in chain}
        self._joints = {joint.name: joint for joint in (*chain, *hand)}
        for key, names in (("locked", entry.locked), ("limits", entry.limits)):
            for name in names:
                tree.require_joint(name, f"{location}.{key}: {tree.path.name}")
        for name, (low, high) in entry.limits.items():
            if not low < high:
                raise DescriptionError(
                    f"{location}.limits.{name}: lower {low:.6g} is not below upper {high:.6g}"
                )
        self._locked, self._stated = entry.locked, entry.limits
        self._ranges: dict[str, tuple[float, float]] = {}
        self._additional: dict[str, Actuator] = {}

    def convert(self) -> tuple[list[Joint], list[Actuator]]:
        """Return the joints, and the motors in the joints' order."""
        for name in self._joints:
            self._check_mimic_chain(name)
        joints = [self._joint(joint) for joint in self._joints.values()]
        motors = [
            Actuator(
                joint.name,
                "m" if joint.type == "prismatic" else "rad",
                joint.lower,
                joint.upper,
                joint.velocity,
                joint.part,
                joint.effort,
                self._is_continuous(joint.name),
            )
            for joint in joints
            if joint.type != "fixed" and joint.coupling is None
        ]
        motors += self._additional.values()
        movable = {joint.name: joint for joint in joints if joint.type != "fixed"}
        check_couplings(movable, motors, self._tree.path)
        return joints, motors

    def _is_continuous(self, name: str) -> bool:
        """Return True if a joint has no limits."""
        joint = self._tree.by_name[name]
        limited = name in self._tree.motors or name in self._stated or joint.limits is not None
        return joint.type == "continuous" and not limited

    def _joint(self, joint: TreeJoint) -> Joint:
        """Return a joint of the robot; a locked joint becomes a fixed one."""
        part = "arm" if joint.name in self._arm else "hand"
        coupling = self._coupling(joint)
        position = self._fixed_position(joint.name)
        moving_type = "prismatic" if joint.type == "prismatic" else "revolute"
        placement, kind, low, high = joint.placement, "fixed", 0.0, 0.0
        if position is not None:
            placement = placement @ joint_motion(moving_type, joint.axis, position)
            coupling = None
        elif joint.type != "fixed":
            kind = moving_type
            low, high = self._limits(joint.name)
        return Joint(
            name=joint.name,
            parent=joint.parent,
            child=joint.child,
            type=kind,
            placement=read_only(placement),
            axis=read_only(joint.axis),
            lower=low,
            upper=high,
            velocity=joint.velocity,
            coupling=coupling,
            part=part,
            effort=joint.effort,
        )

    def _check_mimic_chain(self, name: str) -> None:
        """Check that the joints that a joint mimics end at a motor."""
        chain: list[str] = []
        current: str | None = name
        while current is not None and current in self._tree.by_name:
            chain.append(current)
            coupling = self._tree.by_name[current].coupling
            current = None if coupling is None or current in self._locked else coupling.of
            if current in chain:
                raise DescriptionError(
                    f"{self._location}: joint {name!r} mimics itself: "
                    f"{' -> '.join([*chain, current])}; write locked: {{{name}: 0}} under "
                    f"{self._key.rpartition(' ')[2]}"
                )
        if current is not None and current not in self._tree.motors:
            raise DescriptionError(
                f"{self._location}: joint {chain[-1]!r} mimics {current!r}, which is not a joint"
            )

    def _fixed_position(self, name: str) -> float | None:
        """Return the position of a joint that does not move [rad or m]; None if it moves."""
        if name not in self._tree.by_name:
            return None
        joint = self._tree.by_name[name]
        if name in self._locked:
            return self._locked[name]
        if joint.type == "fixed":
            return 0.0
        if joint.type not in ("revolute", "continuous", "prismatic"):
            raise DescriptionError(
                f"{self._location}: joint {name!r} is {joint.type}, which has no single axis; "
                f"write locked: {{{name}: 0}} under {self._key.rpartition(' ')[2]}"
            )
        if joint.coupling is not None:
            source = self._fixed_position(joint.coupling.of)
            if source is not None:
                return float(joint.coupling.joint_position(np.array([source]))[0])
            if isinstance(joint.coupling, Linear) and joint.coupling.ratio == 0:
                return joint.coupling.offset
        limits = self._stated.get(name, joint.limits)
        if limits is not None and limits[0] == limits[1] and joint.coupling is None:
            return limits[0]
        return None

    def _limits(self, name: str) -> tuple[float, float]:
        """Return the limits of a motor or joint that moves."""
        if name in self._tree.motors:
            return self._tree.motors[name]
        if name not in self._ranges:
            self._ranges[name] = self._derive_limits(self._tree.by_name[name])
        return self._ranges[name]

    def _derive_limits(self, joint: TreeJoint) -> tuple[float, float]:
        """Return the limits of a joint: stated, those of the file, or derived from its leader."""
        limits = self._stated.get(joint.name, joint.limits)
        if limits is not None:
            return limits
        if joint.coupling is not None:  # the range of the leader determines that of the follower
            low, high = self._limits(joint.coupling.of)
            values = joint.coupling.joint_position(np.linspace(low, high, FOLLOWER_GRID))
            slack = 1e-6 + 1e-3 * float(np.ptp(values))
            return float(values.min()) - slack, float(values.max()) + slack
        if joint.type == "continuous":
            return -CONTINUOUS_RANGE, CONTINUOUS_RANGE
        raise DescriptionError(
            f"{self._location}: joint {joint.name!r} of link {joint.child!r} has no limits; write "
            f"limits: {{{joint.name}: [LOWER, UPPER]}} under {self._key.rpartition(' ')[2]}"
        )

    def _coupling(self, joint: TreeJoint) -> Coupling | None:
        """Return the coupling of a joint to a joint of the part, or to an additional motor."""
        coupling = joint.coupling
        while coupling is not None and coupling.of not in self._joints:
            name = coupling.of
            leader = self._tree.by_name.get(name)
            if leader is None or leader.coupling is None:
                self._add_motor(name, leader)
                break
            if not (isinstance(coupling, Linear) and isinstance(leader.coupling, Linear)):
                raise DescriptionError(
                    f"{self._location}: joint {joint.name!r} follows {name!r}, which is not part "
                    f"of this robot; write locked: {{{joint.name}: 0}}"
                )
            coupling = Linear(
                leader.coupling.of,
                coupling.ratio * leader.coupling.ratio,
                coupling.ratio * leader.coupling.offset + coupling.offset,
            )
        return coupling

    def _add_motor(self, name: str, leader: TreeJoint | None) -> None:
        """Add a motor that moves only its followers."""
        if name in self._additional or self._fixed_position(name) is not None:
            return
        low, high = self._limits(name)
        is_prismatic = leader is not None and leader.type == "prismatic"
        velocity, effort = (math.inf,) * 2 if leader is None else (leader.velocity, leader.effort)
        unit = "m" if is_prismatic else "rad"
        self._additional[name] = Actuator(name, unit, low, high, velocity, "hand", effort)
