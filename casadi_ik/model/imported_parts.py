"""Arms and hands in other people's files, as parts of a robot."""

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
from casadi_ik.model.joints import Actuator, Joint
from casadi_ik.model.link_shapes import NO_SHAPES, link_shapes
from casadi_ik.model.linkage import joint_motion, joints_below, leaf_links
from casadi_ik.model.parts import RobotPart, check_couplings
from casadi_ik.model.schema import ArmFromFile, CollisionEntry, HandFromFile, LinkFrame, PadEntry
from casadi_ik.model.urdf_mjcf import read_tree
from casadi_ik.model.xml_tree import RobotTree, TreeJoint

CONTINUOUS_RANGE = 2 * math.pi
"""A joint without ends may turn this far to either side [rad]."""

GRID = 257
"""Positions of a leader at which the range of a follower without limits is looked for."""

Entry = ArmFromFile | HandFromFile


def arm_from_file(entry: ArmFromFile, key: str, beside: Path) -> RobotPart:
    """The chain of joints from root to tip.

    Args:
        entry: What the description says of it.
        key: Where.
        beside: The description, whose folder the file's path counts from.

    Raises:
        DescriptionError: One line that names file, link or joint, and what to write.
        MissingExtraError: What reads the file's format is not installed.
    """
    tree, where, root = _opened(entry, key, beside)
    tip = entry.tip
    if tip is None:
        last = leaf_links(tree, root)
        if len(last) != 1:
            raise DescriptionError(
                f"{where}.tip: missing; {tree.path.name} ends in several links, write one of "
                + ", ".join(last)
            )
        tip = last[0]
    tree.known_link(tip, f"{where}.tip: {tree.path.name}")
    chain = tree.chain(root, tip, f"{where}.tip: {tree.path.name}")
    source = {key: f"{tree.path.name}, links {root} to {tip}"}
    return _part(tree, entry, (chain, ()), LinkFrame(link=tip), source, where)


def hand_from_file(
    entry: HandFromFile, pads: Mapping[str, PadEntry], key: str, beside: Path
) -> RobotPart:
    """Everything below the palm, and the chain that leads to it.

    Args:
        entry: What the description says of it.
        pads: Its contact frames by finger.
        key: Where the entry stands.
        beside: The description, whose folder the file's path counts from.

    Raises:
        DescriptionError: One line that names file, link or joint, and what to write.
        MissingExtraError: What reads the file's format is not installed.
    """
    tree, where, root = _opened(entry, key, beside)
    palm = palm_frame(entry.palm or root)
    tree.known_link(palm.link, f"{where}.palm: {tree.path.name}")
    chain = tree.chain(root, palm.link, f"{where}.palm: {tree.path.name}")
    hand = tuple(joints_below(tree, palm.link))
    carried = {palm.link, *(joint.child for joint in hand)}
    for name, pad in pads.items():
        tree.known_link(pad.link, f"{beside}: fingers.{name}.link: {tree.path.name}")
        if pad.link not in carried:
            raise DescriptionError(
                f"{beside}: fingers.{name}.link: {pad.link!r} does not hang on the palm "
                f"{palm.link!r} of {tree.path.name}; write another link or another palm"
            )
    source = {key: f"{tree.path.name}, palm {palm.link}"}
    part = _part(tree, entry, (chain, hand), palm, source, where)
    return replace(part, where=f"{beside}: ", pads=pads)


def palm_frame(palm: str | LinkFrame) -> LinkFrame:
    """The frame of a palm, of which the link alone may be said."""
    return palm if isinstance(palm, LinkFrame) else LinkFrame(link=palm)


def _opened(entry: Entry, key: str, beside: Path) -> tuple[RobotTree, str, str]:
    """The file, the description with the key, and the link that the part begins with."""
    path, where = beside.parent / Path(entry.file).expanduser(), f"{beside}: {key}"
    if not path.exists():
        raise DescriptionError(f"{where}.file: {path}: no such file")
    tree = read_tree(path, entry.xacro)
    return tree, where, tree.known_link(entry.root or tree.root, f"{where}.root: {tree.path.name}")


def _part(
    tree: RobotTree,
    entry: Entry,
    chosen: tuple[tuple[TreeJoint, ...], tuple[TreeJoint, ...]],
    end: LinkFrame,
    source: dict[str, str],
    where: str,
) -> RobotPart:
    """The joints of an arm, or of what moves a palm, and those of a hand, as a part."""
    root = chosen[0][0].parent if chosen[0] else end.link
    joints, actuators = _Chosen(tree, entry, *chosen, where).parts()
    links = [root, *(joint.child for joint in joints)]
    shapes = NO_SHAPES
    if not tree.shapes.meshes & set(links):  # so that nothing is left out
        simple = tree.shapes.entries
        entries = {link: list(simple[link]) for link in links if link in simple}
        shapes = link_shapes(CollisionEntry(links=entries), links, tree.path)
    frame = frame_matrix(end)
    return RobotPart(
        *(tree.path.stem, f"{where}: ", root, joints, actuators, source, end.link, frame, {}),
        shapes,
    )


class _Chosen:
    """The joints of a file that a robot has, as its own."""

    def __init__(
        self,
        tree: RobotTree,
        entry: Entry,
        chain: tuple[TreeJoint, ...],
        joints_below: tuple[TreeJoint, ...],
        where: str,
    ) -> None:
        self._tree = tree
        self._where = f"{where}: {tree.path.name}"
        self._key = where
        self._arm = {joint.name for joint in chain}
        self._joints = {joint.name: joint for joint in (*chain, *joints_below)}
        for key, names in (("locked", entry.locked), ("limits", entry.limits)):
            for name in names:
                tree.known_joint(name, f"{where}.{key}: {tree.path.name}")
        for name, (low, high) in entry.limits.items():
            if not low < high:
                raise DescriptionError(
                    f"{where}.limits.{name}: lower {low:.6g} is not below upper {high:.6g}"
                )
        self._locked, self._stated = entry.locked, entry.limits
        self._ends: dict[str, tuple[float, float]] = {}
        self._extra: dict[str, Actuator] = {}

    def parts(self) -> tuple[list[Joint], list[Actuator]]:
        """Joints, and the motors in the joints' order."""
        for name in self._joints:
            self._refuse_circle(name)
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
        motors += self._extra.values()
        movable = {joint.name: joint for joint in joints if joint.type != "fixed"}
        check_couplings(movable, motors, self._tree.path)
        return joints, motors

    def _is_continuous(self, name: str) -> bool:
        """Return whether a joint has no limits."""
        joint = self._tree.by_name[name]
        limited = name in self._tree.motors or name in self._stated or joint.limits is not None
        return joint.type == "continuous" and not limited

    def _joint(self, joint: TreeJoint) -> Joint:
        part = "arm" if joint.name in self._arm else "hand"
        coupling = self._coupling(joint)
        held = self._held(joint.name)
        moves = "prismatic" if joint.type == "prismatic" else "revolute"
        placement, kind, low, high = joint.placement, "fixed", 0.0, 0.0
        if held is not None:
            placement, coupling = placement @ joint_motion(moves, joint.axis, held), None
        elif joint.type != "fixed":
            kind = moves
            low, high = self._limits(joint.name)
        return Joint(
            joint.name,
            joint.parent,
            joint.child,
            kind,
            read_only(placement),
            read_only(joint.axis),
            low,
            high,
            joint.velocity,
            coupling,
            part,
            joint.effort,
        )

    def _refuse_circle(self, name: str) -> None:
        seen: list[str] = []
        current: str | None = name
        while current is not None and current in self._tree.by_name:
            seen.append(current)
            coupling = self._tree.by_name[current].coupling
            current = None if coupling is None or current in self._locked else coupling.of
            if current in seen:
                raise DescriptionError(
                    f"{self._where}: joint {name!r} mimics in a circle: "
                    f"{' -> '.join([*seen, current])}; write locked: {{{name}: 0}} under "
                    f"{self._key.rpartition(' ')[2]}"
                )
        if current is not None and current not in self._tree.motors:
            raise DescriptionError(
                f"{self._where}: joint {seen[-1]!r} mimics {current!r}, which is no joint"
            )

    def _held(self, name: str) -> float | None:
        """Where a joint stands for good [rad or m]; None if it moves."""
        if name not in self._tree.by_name:
            return None
        joint = self._tree.by_name[name]
        if name in self._locked:
            return self._locked[name]
        if joint.type == "fixed":
            return 0.0
        if joint.type not in ("revolute", "continuous", "prismatic"):
            raise DescriptionError(
                f"{self._where}: joint {name!r} is {joint.type}, which has no single axis; write "
                f"locked: {{{name}: 0}} under {self._key.rpartition(' ')[2]}"
            )
        if joint.coupling is not None:
            source = self._held(joint.coupling.of)
            if source is not None:
                return float(joint.coupling.followed(np.array([source]))[0])
            if isinstance(joint.coupling, Linear) and joint.coupling.ratio == 0:
                return joint.coupling.offset
        limits = self._stated.get(name, joint.limits)
        if limits is not None and limits[0] == limits[1] and joint.coupling is None:
            return limits[0]
        return None

    def _limits(self, name: str) -> tuple[float, float]:
        """Ends of a motor or joint that moves."""
        if name in self._tree.motors:
            return self._tree.motors[name]
        if name not in self._ends:
            self._ends[name] = self._found_limits(self._tree.by_name[name])
        return self._ends[name]

    def _found_limits(self, joint: TreeJoint) -> tuple[float, float]:
        limits = self._stated.get(joint.name, joint.limits)
        if limits is not None:
            return limits
        if joint.coupling is not None:  # as far as what it follows takes it
            low, high = self._limits(joint.coupling.of)
            values = joint.coupling.followed(np.linspace(low, high, GRID))
            slack = 1e-6 + 1e-3 * float(np.ptp(values))
            return float(values.min()) - slack, float(values.max()) + slack
        if joint.type == "continuous":
            return -CONTINUOUS_RANGE, CONTINUOUS_RANGE
        raise DescriptionError(
            f"{self._where}: joint {joint.name!r} of link {joint.child!r} states no limits; write "
            f"limits: {{{joint.name}: [LOWER, UPPER]}} under {self._key.rpartition(' ')[2]}"
        )

    def _coupling(self, joint: TreeJoint) -> Coupling | None:
        """What a joint follows among the joints that are there, or a motor of its own."""
        coupling = joint.coupling
        while coupling is not None and coupling.of not in self._joints:
            name = coupling.of
            leader = self._tree.by_name.get(name)
            if leader is None or leader.coupling is None:
                self._add_motor(name, leader)
                break
            if not (isinstance(coupling, Linear) and isinstance(leader.coupling, Linear)):
                raise DescriptionError(
                    f"{self._where}: joint {joint.name!r} follows {name!r}, which is no part of "
                    f"this robot; write locked: {{{joint.name}: 0}}"
                )
            coupling = Linear(
                leader.coupling.of,
                coupling.ratio * leader.coupling.ratio,
                coupling.ratio * leader.coupling.offset + coupling.offset,
            )
        return coupling

    def _add_motor(self, name: str, leader: TreeJoint | None) -> None:
        """A motor that moves no joint of this robot but what follows it."""
        if name in self._extra or self._held(name) is not None:
            return
        low, high = self._limits(name)
        slides = leader is not None and leader.type == "prismatic"
        velocity, effort = (math.inf,) * 2 if leader is None else (leader.velocity, leader.effort)
        unit = "m" if slides else "rad"
        self._extra[name] = Actuator(name, unit, low, high, velocity, "hand", effort)
