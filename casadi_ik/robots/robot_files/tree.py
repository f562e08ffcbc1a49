"""What a file says of a robot: links and joints, before anything is chosen or guessed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.robots.couplings import Coupling
from casadi_ik.robots.robot_files.file_shapes import NO_FILE_SHAPES, FileShapes
from casadi_ik.robots.robot_files.xml_text import Element


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """A joint as its file has it.

    Attributes:
        name: Its name.
        parent: Link it hangs on.
        child: Link it carries.
        type: "revolute", "continuous", "prismatic" or "fixed"; or a kind of several axes.
        placement: (4, 4) pose of the child in the parent at zero.
        axis: (3,) unit axis in the child's frame.
        limits: Lower and upper [rad or m]; None if the file states none.
        velocity: Velocity limit [rad/s or m/s], inf if the file states none (or zero).
        coupling: What it follows; None if nothing.
    """

    name: str
    parent: str
    child: str
    type: str
    placement: Array
    axis: Array
    limits: tuple[float, float] | None
    velocity: float
    coupling: Coupling | None


@dataclass(frozen=True, eq=False)
class RobotTree:
    """The joints of a file.

    Attributes:
        path: The file.
        root: Its base link.
        joints: All joints, parents before children.
        motors: Lower and upper end of motors that are no joints (a tendon's), by name.
        shapes: Those of its links for collisions.
        element: Of a URDF what it was read from, its macros expanded.
        model: Of an MJCF the module and its model.
    """

    path: Path
    root: str
    joints: tuple[TreeJoint, ...]
    motors: dict[str, tuple[float, float]] = field(default_factory=dict)
    shapes: FileShapes = NO_FILE_SHAPES
    element: Element | None = None
    model: tuple[Any, Any] | None = None

    @cached_property
    def links(self) -> tuple[str, ...]:
        """All links, the root first."""
        return (self.root, *(joint.child for joint in self.joints))

    @cached_property
    def carried_by(self) -> dict[str, TreeJoint]:
        """The joint that carries a link, by link."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def by_name(self) -> dict[str, TreeJoint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    def chain(self, root: str, link: str, where: str) -> tuple[TreeJoint, ...]:
        """The joints from one link down to another.

        Args:
            root: The upper link.
            link: The lower link.
            where: File and key, for the message.

        Raises:
            DescriptionError: The one is not below the other.
        """
        chain: list[TreeJoint] = []
        current = link
        while current != root:
            if current not in self.carried_by:
                raise DescriptionError(f"{where}: link {link!r} does not hang on link {root!r}")
            chain.append(self.carried_by[current])
            current = chain[-1].parent
        return tuple(reversed(chain))

    def below(self, link: str) -> tuple[TreeJoint, ...]:
        """All joints that a link carries, directly or not."""
        carried = {link}
        found: list[TreeJoint] = []
        for joint in self.joints:
            if joint.parent in carried:
                carried.add(joint.child)
                found.append(joint)
        return tuple(found)

    def known_link(self, link: str, where: str) -> str:
        """The link, if there is one of that name.

        Raises:
            DescriptionError: There is none; the message lists the links.
        """
        return _known(link, self.links, "link", where)

    def known_joint(self, joint: str, where: str) -> str:
        """The joint, if there is one of that name.

        Raises:
            DescriptionError: There is none; the message lists those that move.
        """
        moving = [one.name for one in self.joints if one.type != "fixed"]
        if joint in self.by_name:
            return joint
        return _known(joint, moving, "joint", where)


def parents_first(joints: Iterable[TreeJoint], root: str) -> tuple[TreeJoint, ...]:
    """The order of the file, moved only where a child stands before its parent."""
    known, placed, waiting = {root}, [], list(joints)
    while waiting:
        joint = next((one for one in waiting if one.parent in known), None)
        if joint is None:
            break
        waiting.remove(joint)
        placed.append(joint)
        known.add(joint.child)
    return tuple(placed)


def fixed(name: str, parent: str, child: str, placement: Array) -> TreeJoint:
    """A joint that does not move."""
    axis = np.array([0.0, 0.0, 1.0])
    return TreeJoint(name, parent, child, "fixed", placement, axis, None, math.inf, None)


def turned(axis: Array, angle: float) -> Array:
    """(4, 4) rotation about an axis through the origin."""
    pose = np.eye(4)
    if angle:
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return pose


def _known(name: str, names: Iterable[str], noun: str, where: str) -> str:
    if name not in (known := list(names)):
        raise DescriptionError(f"{where}: unknown {noun} {name!r}; known: {', '.join(known)}")
    return name
