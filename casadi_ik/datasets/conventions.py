"""What a data set calls a hand's joints, and where it has the hand's frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.datasets.postures import HandPoses
from casadi_ik.errors import DescriptionError, UnsupportedError
from casadi_ik.files.reading import Frame, Point, Struct, frame_matrix, read
from casadi_ik.files.shipped import resolve, shipped_names
from casadi_ik.grasps.pose import inverse
from casadi_ik.robots.poses import motion


class HandFrame(Frame, frozen=True, kw_only=True):
    """Where the data set's frame of the hand is, in the frame of one of the robot's links.

    Attributes:
        link: The robot's link.
        xyz: Origin of the data set's frame in the link's [m].
        rpy: Its axes, turned about the fixed axes of the link's frame [rad].
    """

    link: str


class WristJoint(Struct, frozen=True):
    """A joint of the data set's hand before the robot's link.

    Attributes:
        name: The data set's.
        axis: It turns about, in its own frame.
        xyz: Its origin in the frame before: the data set's, or that of the joint before [m].
    """

    name: str
    axis: Point
    xyz: Point = (0.0, 0.0, 0.0)


class ConventionFile(Struct, frozen=True):
    """How a data set has a hand: ``models/datasets/*.yaml``.

    Attributes:
        layouts: In which layouts.
        description: One sentence.
        source: Where that is from, and how it was checked.
        frame: Where the data set's frame of the hand is.
        joints: The data set's names, in the order of its arrays, and the robot's joints or motors;
            a minus sign before one: it turns the other way.
        wrist: Joints between the data set's frame and `frame`, before the others in its arrays:
            they place the hand, and are not asked for.
    """

    layouts: list[str]
    description: str
    source: str
    frame: HandFrame
    joints: dict[str, str]
    wrist: tuple[WristJoint, ...] = ()


@dataclass(frozen=True, eq=False)
class Convention:
    """How the data of a hand are read as those of a robot's.

    Attributes:
        name: Where it is written down.
        link: The robot's link in whose frame the data set's frame is.
        pose: (4, 4) of that frame in the link's.
        joints: Names of the data set, in the order of its arrays: the robot's joint, and 1 or -1.
        wrist: Joints of the data set before the link, before the others in its arrays.
    """

    name: str
    link: str
    pose: Array
    joints: dict[str, tuple[str, float]]
    wrist: tuple[WristJoint, ...] = ()

    def fits(self, robot: ArmHand) -> bool:
        """Whether the robot has this hand."""
        description = robot.description
        names = {joint for joint, _ in self.joints.values()}
        known = {*description.joint_names, *description.actuator_names}
        return self.link in description.links and names <= known

    def positions(self, given: HandPoses) -> dict[str, Array]:
        """Positions (k,) of the robot's joints and motors, by name.

        Raises:
            DescriptionError: Names that the data set does not have, or another number of joints.
        """
        wrist = tuple(one.name for one in self.wrist)
        every = (*wrist, *self.joints)
        names = given.names or every
        width = given.joints.shape[1]
        if len(names) != width:
            raise DescriptionError(
                f"{given.where}: joints: found {width}, expected {len(names)}: {', '.join(names)}"
            )
        for name in names:
            if name not in every:
                raise DescriptionError(
                    f"{given.where}: {name}: no such joint, expected {', '.join(every)}"
                )
        missing = [name for name in every if name not in names]
        if missing:
            raise DescriptionError(f"{given.where}: {missing[0]}: missing, expected a position")
        found: dict[str, Array] = {}
        for i, name in enumerate(names):
            if name in self.joints:
                joint, sign = self.joints[name]
                found[joint] = sign * given.joints[:, i]
        return found

    def frames(self, given: HandPoses) -> Array:
        """(k, 4, 4) poses of the robot's link that the data's poses, and their wrists, give."""
        poses, names = given.poses, given.names or tuple(one.name for one in self.wrist)
        for one in self.wrist:
            moved = motion("revolute", np.array(one.axis), given.joints[:, names.index(one.name)])
            moved[:, :3, 3] = one.xyz
            poses = poses @ moved
        return poses @ inverse(self.pose)


def load_convention(name_or_path: str | Path) -> Convention:
    """A convention: a shipped one by name, or a file of one's own.

    Raises:
        UnknownNameError: No shipped convention has that name.
        DescriptionError: The file is missing or malformed.
    """
    path = resolve(name_or_path, "datasets")
    entry, _ = read(path, ConventionFile)
    joints: dict[str, tuple[str, float]] = {}
    for name, said in entry.joints.items():
        joint = said.removeprefix("-")
        if joint in (other for other, _ in joints.values()):
            raise DescriptionError(f"{path}: joints.{name}: {joint} is named twice")
        joints[name] = joint, -1.0 if said.startswith("-") else 1.0
    return Convention(path.stem, entry.frame.link, frame_matrix(entry.frame), joints, entry.wrist)


def convention_for(robot: ArmHand, layout: str, hand: str | Path | None) -> Convention:
    """The convention of a layout for the hand of a robot.

    Args:
        robot: The robot.
        layout: Of the file.
        hand: A convention by name or path; None: the shipped one that fits.

    Raises:
        UnsupportedError: None is shipped that fits, or the one that is named does not.
        UnknownNameError: See `load_convention`.
        DescriptionError: See there.
    """
    if hand is not None:
        named = load_convention(hand)
        if not named.fits(robot):
            raise UnsupportedError(
                f"{named.name}: robot {robot.name!r} has no link {named.link!r}, or not its joints"
            )
        return named
    shipped = [name for name in shipped_names("datasets") if layout in _layouts(name)]
    for name in shipped:
        found = load_convention(name)
        if found.fits(robot):
            return found
    raise UnsupportedError(
        f"layout {layout}: no hand of it is that of robot {robot.name!r}; known: "
        f"{', '.join(shipped)} (or say by a file of your own what its joints are called)"
    )


def of_robot(robot: ArmHand, names: tuple[str, ...]) -> Convention:
    """The convention of a table that uses the robot's own names, and its palm frame."""
    description = robot.description
    joints: dict[str, tuple[str, float]] = {name: (name, 1.0) for name in names}
    return Convention(
        robot.name, description.palm_link, np.asarray(description.palm_placement), joints
    )


def _layouts(name: str) -> list[str]:
    entry, _ = read(resolve(name, "datasets"), ConventionFile)
    return entry.layouts
