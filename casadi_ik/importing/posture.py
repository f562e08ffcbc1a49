"""Where the links of a part are, in plain numbers: before there is a robot to be compiled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.robots.description import Actuator, Joint
from casadi_ik.robots.poses import link_poses


class Jointed(Protocol):
    """Links held together by joints: a part, or a robot."""

    @property
    def root(self) -> str:
        """The base link."""
        ...

    @property
    def joints(self) -> Sequence[Joint]:
        """The joints, parents before children."""
        ...

    @property
    def actuators(self) -> Sequence[Actuator]:
        """The motors."""
        ...


class Postures:
    """A part and its joints in positions."""

    def __init__(self, part: Jointed) -> None:
        """Take a part."""
        self.part = part
        self.joints = {joint.name: joint for joint in part.joints}
        self.by_child = {joint.child: joint for joint in part.joints}

    def middle(self) -> dict[str, float]:
        """Every joint in the middle of its range [rad or m]."""
        return {
            name: (joint.lower + joint.upper) / 2
            for name, joint in self.joints.items()
            if joint.type != "fixed"
        }

    def random(self, rng: np.random.Generator) -> dict[str, float]:
        """Every joint anywhere in the middle half of its range, couplings left out."""
        return {
            name: joint.lower + (0.25 + 0.5 * rng.random()) * (joint.upper - joint.lower)
            for name, joint in self.joints.items()
            if joint.type != "fixed"
        }

    def poses(self, values: Mapping[str, float]) -> dict[str, Array]:
        """(4, 4) pose of every link in the root's frame."""
        return link_poses(self.part.root, self.part.joints, values)

    def chain(self, link: str, top: str) -> list[Joint]:
        """The joints that move a link against one above it, in order."""
        found: list[Joint] = []
        while link != top and link in self.by_child:
            joint = self.by_child[link]
            if joint.type != "fixed":
                found.append(joint)
            link = joint.parent
        return found[::-1]

    def rigid(self, link: str) -> list[str]:
        """A link and all that is fixed to it below."""
        found = [link]
        for joint in self.part.joints:
            if joint.type == "fixed" and joint.parent in found:
                found.append(joint.child)
        return found

    def moving_link(self, link: str) -> str:
        """The link itself, or the next one above that a joint moves."""
        while link in self.by_child and self.by_child[link].type == "fixed":
            link = self.by_child[link].parent
        return link
