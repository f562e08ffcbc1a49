"""An arm as the screws of its joints: what two or three axes have in common, turns about them.

Turns that bring a point to a height, or one direction to another, are the subproblems 1 and 4 of
Paden and Kahan, as IK-Geo numbers them (Elias and Wen 2022), with turns as cosine and sine so that
what follows from them needs no more of either. Out of reach the nearest turn is given, and where an
axis passes through the point, none: nothing is ever NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Pose, forward, number, sparse
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription

WHOLE_TURN = 2 * np.pi - 1e-6
"""Range [rad] from which on a joint may stand the same way at several angles."""


@dataclass(frozen=True, eq=False)
class Screws:
    """The axes of an arm's joints at q = 0, base frame, in the order of the chain.

    The arm moves its palm by ``e_1(q_1) ... e_n(q_n)``, each a rotation about an axis that stands
    still. Seen from the palm the chain is the same with its screws in the opposite order and its
    axes the other way round.

    Attributes:
        joints: Number of the joint that each screw belongs to.
        axes: (n, 3) unit.
        points: (n, 3) a point of each axis [m].
        lower: (n,) joint limits [rad].
        upper: (n,) joint limits [rad].
        rotation: (3, 3) of the palm at q = 0.
        origin: (3,) of the palm at q = 0 [m].
        reverse: Whether the chain is seen from the palm.
    """

    joints: tuple[int, ...]
    axes: Array
    points: Array
    lower: Array
    upper: Array
    rotation: Array
    origin: Array
    reverse: bool = False

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def turning(self) -> frozenset[int]:
        """Numbers of the joints that turn all around, and so may stand the same way twice."""
        wide = self.upper - self.lower >= WHOLE_TURN
        return frozenset(i for i, around in zip(self.joints, wide, strict=True) if around)

    def reversed(self) -> Screws:
        """The same arm seen from its other end."""
        return replace(
            self,
            joints=self.joints[::-1],
            axes=-self.axes[::-1],
            points=self.points[::-1],
            lower=self.lower[::-1],
            upper=self.upper[::-1],
            reverse=not self.reverse,
        )

    def motion(self, palm: Pose) -> Pose:
        """What the chain must move by for the palm to be at a pose."""
        turn = palm.rotation @ ca.DM(self.rotation.T)
        shift = palm.origin - turn @ ca.DM(self.origin)
        return Pose(turn.T, -(turn.T @ shift)) if self.reverse else Pose(turn, shift)

    def centred(self, place: int, angle: Expr) -> Expr:
        """An angle moved into the turn centred on its joint's range [rad]."""
        middle = float(self.lower[place] + self.upper[place]) / 2
        away = angle - middle
        return middle + away - 2 * np.pi * ca.floor((away + np.pi) / (2 * np.pi))


def arm_screws(robot: RobotDescription) -> Screws:
    """The screws of a robot's arm.

    Raises:
        UnsupportedError: A joint of the arm slides, or does not have a motor of its own.
    """
    where = f"robot {robot.name!r}: the arm has no closed form"
    motors = [robot.actuator_names[i] for i in robot.arm_actuators]
    joints = [joint for joint in robot.movable if joint.part == "arm"]
    if [joint.name for joint in joints] != motors:
        raise UnsupportedError(f"{where}: expected a motor for every joint")
    if any(joint.type != "revolute" for joint in joints):
        raise UnsupportedError(f"{where}: expected revolute joints only")
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    return Screws(
        tuple(range(len(joints))),
        np.array([number(kinematics.axes[joint.name]) for joint in joints]).reshape(-1, 3),
        np.array([number(kinematics.links[j.child].origin) for j in joints]).reshape(-1, 3),
        np.array([joint.lower for joint in joints]),
        np.array([joint.upper for joint in joints]),
        np.array(ca.evalf(ca.densify(kinematics.palm.rotation))),
        number(kinematics.palm.origin),
    )


def meeting_point(screws: Screws, places: Sequence[int]) -> tuple[Array, float]:
    """The point (3,) nearest to some axes [m], and how far the farthest of them passes it [m]."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for i in places:
        across = np.eye(3) - np.outer(screws.axes[i], screws.axes[i])
        normal += across
        right += across @ screws.points[i]
    point: Array = np.linalg.lstsq(normal, right, rcond=None)[0].astype(float)
    passes = [np.cross(point - screws.points[i], screws.axes[i]) for i in places]
    return point, float(np.linalg.norm(passes, axis=1).max())


def obliqueness(screws: Screws, one: int, other: int) -> float:
    """Sine of the angle that two axes lack to a right one, or have too much."""
    return abs(float(screws.axes[one] @ screws.axes[other]))


def divergence(screws: Screws, one: int, other: int) -> float:
    """Sine of the angle between two axes, whichever way they point."""
    return float(np.linalg.norm(np.cross(screws.axes[one], screws.axes[other])))


TINY = 1e-24
"""Squared length below which a vector has no direction."""

TINIEST = TINY * TINY
"""Likewise of a product of two vectors: of those that are longer each has one."""


@dataclass(frozen=True, eq=False)
class Turn:
    """An angle by its cosine and sine."""

    cosine: Expr
    sine: Expr

    @property
    def angle(self) -> Expr:
        """In [-pi, pi] [rad]."""
        return ca.atan2(self.sine, self.cosine)

    @property
    def back(self) -> Turn:
        """The opposite turn."""
        return Turn(self.cosine, -self.sine)

    def plus(self, other: Turn) -> Turn:
        """Both turns, one after the other."""
        return Turn(
            self.cosine * other.cosine - self.sine * other.sine,
            self.sine * other.cosine + self.cosine * other.sine,
        )

    def or_other(self, first: Expr, other: Turn) -> Turn:
        """This one where a condition holds, else another."""
        if isinstance(first, bool):
            return self if first else other
        cosine = ca.if_else(first, self.cosine, other.cosine)
        return Turn(cosine, ca.if_else(first, self.sine, other.sine))

    def about(self, axis: Array) -> Expr:
        """As a rotation (3, 3) about a constant unit axis (3,)."""
        outer = np.outer(axis, axis)
        x, y, z = axis
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return (
            ca.SX(sparse(outer))
            + ca.SX(sparse(np.eye(3) - outer)) * self.cosine
            + ca.SX(sparse(across)) * self.sine
        )


def turn(cosine: Expr, sine: Expr) -> Turn:
    """The turn towards a direction of any length; none where it has no length."""
    squared = cosine * cosine + sine * sine
    scale = 1 / ca.sqrt(ca.fmax(squared, TINIEST))
    known = squared > TINIEST
    return Turn(ca.if_else(known, cosine * scale, 1.0), ca.if_else(known, sine * scale, 0.0))


def subproblem_4(cosine: Expr, sine: Expr, height: Expr) -> tuple[Turn, Turn, Expr]:
    """Both turns t with ``cosine cos(t) + sine sin(t) = height``.

    Returns:
        The turns, and the slack: one less the squared part of the largest height that is asked
        for, negative if that is too much.
    """
    squared = cosine * cosine + sine * sine
    safe = ca.fmax(squared, TINY)
    slack = 1 - height * height / safe
    root = ca.sqrt(ca.fmax(squared - height * height, 0.0))
    # Too high or too low: towards where it is highest or lowest.
    length = ca.sqrt(safe)
    within = ca.fmin(ca.fmax(height, -length), length)
    known = squared > TINY
    found = [
        Turn(
            ca.if_else(known, (cosine * within - sine * side) / safe, 1.0),
            ca.if_else(known, (sine * within + cosine * side) / safe, 0.0),
        )
        for side in (root, -root)
    ]
    return found[0], found[1], slack


def subproblem_1(axis: Array, start: Expr, end: Expr) -> Turn:
    """The turn about a constant unit axis that brings one vector nearest to another."""
    a = ca.DM(axis)
    along = ca.dot(a, start) * ca.dot(a, end)
    return turn(ca.dot(start, end) - along, ca.dot(a, ca.cross(start, end)))


def about_axis(axis: Array, vector: Expr) -> tuple[Expr, Expr, Expr]:
    """A vector as what a turn about a constant unit axis does to it.

    Returns:
        ``constant``, ``cosine``, ``sine`` (3, 1) each: turned by t the vector is
        ``constant + cosine cos(t) + sine sin(t)``.
    """
    a = ca.SX(sparse(axis.reshape(3, 1)))
    constant = a * ca.dot(a, vector)
    return constant, vector - constant, ca.cross(a, vector)
