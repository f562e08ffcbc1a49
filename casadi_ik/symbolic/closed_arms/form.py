"""What every arm in closed form offers: all arms for a palm pose, and the redundancy if any.

An arm of six joints has up to eight arms for a palm pose: two by two *bends* of three joints, and
for each of them two *ends*, the three joints that are left. An arm of seven joints has as many for
every position of one of its joints, the *swept* one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.symbolic.closed_arms.screws import Screws
from casadi_ik.symbolic.closed_arms.turns import Turn
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr

SIGNS = tuple(product((1, -1), (1, -1), (1, -1)))
"""First and second sign of the bend, and that of the end, in the order of the arms."""


@dataclass(frozen=True, eq=False)
class Bend:
    """One way to bend an arm, with both ways to end it.

    Attributes:
        joints: Angle [rad] by number of the joint.
        ends: The same of the three joints that can be turned in two ways.
        slack: >= 0 where the palm pose can be reached like this.
    """

    joints: dict[int, Expr]
    ends: tuple[dict[int, Expr], dict[int, Expr]]
    slack: Expr

    def arms(self) -> tuple[Expr, Expr]:
        """Both arms (n, 1) [rad]."""
        count = len(self.joints) + len(self.ends[0])
        first, second = (
            ca.vertcat(*((self.joints | end)[i] for i in range(count))) for end in self.ends
        )
        return first, second


@dataclass(frozen=True, eq=False)
class ClosedForm(ABC):
    """An arm in closed form.

    Attributes:
        screws: Of the ideal arm that is solved, in the order of the solution.
        swept: Whether the first screw is that of the swept joint.
        off: How far the ideal arm is from the real one [m and rad].
    """

    screws: Screws
    swept: bool
    off: float

    @property
    @abstractmethod
    def kind(self) -> str:
        """What the arm is, in a few words."""

    @property
    @abstractmethod
    def parts(self) -> tuple[str, str, str]:
        """Which part of the arm the signs of bend and end are of: shoulder, elbow, wrist."""

    @abstractmethod
    def _bends(self, motion: Pose) -> list[Bend]:
        """The four bends for a motion of all screws but the swept one."""

    @abstractmethod
    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """How far [m] a palm is out of reach for certain, 0 where it may be in reach.

        Args:
            palm: Pose of the palm, base frame.
            lower: (n, 1) bounds of the arm [rad].
            upper: (n, 1).

        Returns:
            Positive if it is too far away, negative if too near.
        """

    @property
    def exact(self) -> bool:
        """Whether the ideal arm is the real one."""
        return self.off <= EXACT

    @property
    def swept_joint(self) -> int | None:
        """Number of the swept joint."""
        return self.screws.joints[0] if self.swept else None

    @property
    def places(self) -> tuple[int, ...]:
        """Places of the six screws that are solved for."""
        return tuple(range(int(self.swept), len(self.screws)))

    def bends(self, palm: Pose, swept: Expr) -> list[Bend]:
        """All arms for a palm pose; those out of reach are the nearest, with a negative slack.

        Args:
            palm: Desired pose of the palm, base frame.
            swept: Position of the swept joint [rad]; not looked at if there is none.
        """
        moved = self.left(palm, swept)
        if not self.swept:
            return self._bends(moved)
        joint = self.screws.joints[0]
        return [
            Bend(bend.joints | {joint: swept}, bend.ends, bend.slack) for bend in self._bends(moved)
        ]

    def left(self, palm: Pose, swept: Expr) -> Pose:
        """The motion for a palm pose that the swept joint leaves to the other six."""
        motion = self.screws.motion(palm)
        if not self.swept:
            return motion
        back = Turn(ca.cos(swept), -ca.sin(swept)).about(self.screws.axes[0])
        point = ca.DM(self.screws.points[0])
        return Pose(back @ motion.rotation, point + back @ (motion.origin - point))

    def angle(self, place: int, turn: Turn) -> dict[int, Expr]:
        """The angle of a screw's joint in the turn centred on its range."""
        return {self.screws.joints[place]: self.screws.centred(place, turn.angle)}

    def moved(self, place: int, turn: Turn, point: Expr) -> Expr:
        """A point moved by a screw."""
        on_axis = ca.DM(self.screws.points[place])
        return on_axis + turn.about(self.screws.axes[place]) @ (point - on_axis)


EXACT = 1e-9
"""Within this the ideal arm is the real one [m and rad]."""


@dataclass(frozen=True, eq=False)
class SphericalEnd:
    """The last three screws of a chain, through one point and each perpendicular to the next.

    Attributes:
        places: Of the screws.
        point: (3,) where they meet [m].
        frame: (3, 3) columns x, y, z with z along the first axis and y along the second.
        offset: Angle by which the third axis is turned from z about y [rad].
    """

    places: tuple[int, int, int]
    point: Array
    frame: Array
    offset: float

    def triples(self, screws: Screws, rotation: Expr) -> tuple[dict[int, Expr], dict[int, Expr]]:
        """Both ways to make a rotation (3, 3), base frame.

        Read as Rz(t1) Ry(t2 + offset) Rz(t3). Where first and third axis are aligned, the first
        stays at its zero and the third makes all of the turn.
        """
        local = ca.DM(self.frame.T) @ rotation @ ca.DM(self.frame)
        # The frame's z is not yet along the third axis.
        c, s = float(np.cos(self.offset)), float(np.sin(self.offset))
        matrix = local @ ca.sparsify(ca.DM([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
        return self._read(screws, matrix)

    def _read(self, screws: Screws, matrix: Expr) -> tuple[dict[int, Expr], dict[int, Expr]]:
        squared = matrix[0, 2] ** 2 + matrix[1, 2] ** 2
        tilted = squared > ALIGNED
        sine = ca.sqrt(ca.fmax(squared, ALIGNED))
        cos_first = ca.if_else(tilted, matrix[0, 2] / sine, 1.0)
        sin_first = ca.if_else(tilted, matrix[1, 2] / sine, 0.0)
        first = ca.atan2(sin_first, cos_first)
        second = ca.atan2(ca.if_else(tilted, sine, 0.0), matrix[2, 2])
        # From what the first angle leaves, so that both together are right however small the tilt.
        third = ca.atan2(
            cos_first * matrix[1, 0] - sin_first * matrix[0, 0],
            cos_first * matrix[1, 1] - sin_first * matrix[0, 1],
        )
        pi = np.pi
        found = []
        for angles in ((first, second, third), (first + pi, -second, third + pi)):
            moved = (angles[0], angles[1] - self.offset, angles[2])
            found.append(
                {
                    screws.joints[place]: screws.centred(place, angle)
                    for place, angle in zip(self.places, moved, strict=True)
                }
            )
        return found[0], found[1]


ALIGNED = 1e-24
"""Squared sine of the tilt below which first and third axis of a sphere count as aligned."""
