"""Screw axes of an arm, and the Paden-Kahan subproblems 1 and 4 on them.

Subproblems are numbered as in IK-Geo (Elias and Wen 2022). Angles are represented by cosine and
sine, so that later expressions need no trigonometric functions. Out of reach the nearest angle is
returned, and zero if the axis passes through the point: results are never NaN.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import Pose, forward, number, sparse
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription

UNLIMITED_RANGE = 2 * np.pi - 1e-6
"""Joint range from which several joint positions give the same rotation [rad]."""


@dataclass(frozen=True, eq=False)
class Screws:
    """The joint axes of an arm at q = 0 in the base frame, in the order of the chain.

    The arm moves its palm by ``e_1(q_1) ... e_n(q_n)``, rotations about fixed axes. Seen from the
    palm the chain has the same screws in reverse order with opposite axes.

    Attributes:
        joints: Joint number of each screw.
        axes: (n, 3) unit.
        points: (n, 3) a point on each axis [m].
        lower: (n,) joint limits [rad].
        upper: (n,) joint limits [rad].
        rotation: (3, 3) rotation of the palm at q = 0.
        origin: (3,) origin of the palm at q = 0 [m].
        reverse: True if the chain is seen from the palm.
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
    def multi_turn_joints(self) -> frozenset[int]:
        """Numbers of the joints whose range is a full turn or more."""
        wide = self.upper - self.lower >= UNLIMITED_RANGE
        return frozenset(i for i, is_wide in zip(self.joints, wide, strict=True) if is_wide)

    def reversed(self) -> Screws:
        """Return the same arm seen from its other end."""
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
        """Return the motion of the chain that brings the palm to a pose."""
        cos_sin_of = palm.rotation @ ca.DM(self.rotation.T)
        shift = palm.origin - cos_sin_of @ ca.DM(self.origin)
        return (
            Pose(cos_sin_of.T, -(cos_sin_of.T @ shift)) if self.reverse else Pose(cos_sin_of, shift)
        )

    def centred(self, index: int, angle: Expr) -> Expr:
        """Shift an angle by full turns to within pi of the middle of its joint's range [rad]."""
        middle = float(self.lower[index] + self.upper[index]) / 2
        offset = angle - middle
        return middle + offset - 2 * np.pi * ca.floor((offset + np.pi) / (2 * np.pi))


def arm_screws(robot: RobotDescription) -> Screws:
    """Return the screws of a robot's arm.

    Raises:
        UnsupportedError: The arm has a prismatic joint, or a joint without a separate motor.
    """
    prefix = f"robot {robot.name!r}: the arm has no closed form"
    motors = [robot.actuator_names[i] for i in robot.arm_actuators]
    joints = [joint for joint in robot.movable if joint.part == "arm"]
    if [joint.name for joint in joints] != motors:
        raise UnsupportedError(f"{prefix}: expected a motor for every joint")
    if any(joint.type != "revolute" for joint in joints):
        raise UnsupportedError(f"{prefix}: expected revolute joints only")
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


def meeting_point(screws: Screws, indices: Sequence[int]) -> tuple[Array, float]:
    """Return the point (3,) nearest to several axes and its largest distance from them [m]."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for i in indices:
        projector = np.eye(3) - np.outer(screws.axes[i], screws.axes[i])
        normal += projector
        right += projector @ screws.points[i]
    point: Array = np.linalg.lstsq(normal, right, rcond=None)[0].astype(float)
    misses = [np.cross(point - screws.points[i], screws.axes[i]) for i in indices]
    return point, float(np.linalg.norm(misses, axis=1).max())


def obliqueness(screws: Screws, first: int, second: int) -> float:
    """Return the sine of the deviation of two axes from a right angle."""
    return abs(float(screws.axes[first] @ screws.axes[second]))


def divergence(screws: Screws, first: int, second: int) -> float:
    """Return the sine of the angle between two axes, regardless of their signs."""
    return float(np.linalg.norm(np.cross(screws.axes[first], screws.axes[second])))


MIN_SQUARED_LENGTH = 1e-24
"""Squared length below which a vector has no direction."""

MIN_SQUARED_PRODUCT = MIN_SQUARED_LENGTH * MIN_SQUARED_LENGTH
"""Squared length below which a product of two vectors has no direction."""


@dataclass(frozen=True, eq=False)
class CosSin:
    """An angle represented by its cosine and sine."""

    cosine: Expr
    sine: Expr

    @property
    def angle(self) -> Expr:
        """The angle in [-pi, pi] [rad]."""
        return ca.atan2(self.sine, self.cosine)

    @property
    def inverse(self) -> CosSin:
        """The opposite angle."""
        return CosSin(self.cosine, -self.sine)

    def compose(self, angle: CosSin) -> CosSin:
        """Return the sum of both angles."""
        return CosSin(
            self.cosine * angle.cosine - self.sine * angle.sine,
            self.sine * angle.cosine + self.cosine * angle.sine,
        )

    def select(self, condition: Expr, angle: CosSin) -> CosSin:
        """Return this angle where the condition holds, otherwise the given one."""
        if isinstance(condition, bool):
            return self if condition else angle
        cosine = ca.if_else(condition, self.cosine, angle.cosine)
        return CosSin(cosine, ca.if_else(condition, self.sine, angle.sine))

    def rotation(self, axis: Array) -> Expr:
        """Return the rotation (3, 3) by the angle about a constant unit axis (3,)."""
        outer = np.outer(axis, axis)
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return (
            ca.SX(sparse(outer))
            + ca.SX(sparse(np.eye(3) - outer)) * self.cosine
            + ca.SX(sparse(cross)) * self.sine
        )


_CLIPS_DIRECTIONS: ContextVar[bool] = ContextVar("clips_directions", default=False)


@contextmanager
def clipped_directions() -> Iterator[None]:
    """Clip cosines and sines to [-1, 1] in the graphs that are built in this context.

    In exact arithmetic nothing changes, but intervals cannot know that cosines and sines of wide
    intervals are bounded.
    """
    token = _CLIPS_DIRECTIONS.set(True)
    try:
        yield
    finally:
        _CLIPS_DIRECTIONS.reset(token)


def _direction(cosine: Expr, sine: Expr) -> CosSin:
    """Return an angle, with cosine and sine clipped in the context of `clipped_directions`."""
    if _CLIPS_DIRECTIONS.get():
        cosine, sine = (ca.fmin(ca.fmax(part, -1.0), 1.0) for part in (cosine, sine))
    return CosSin(cosine, sine)


def cos_sin_of(cosine: Expr, sine: Expr) -> CosSin:
    """Return the angle of a direction of any length; zero if it has no length."""
    squared = cosine * cosine + sine * sine
    scale = 1 / ca.sqrt(ca.fmax(squared, MIN_SQUARED_PRODUCT))
    has_length = squared > MIN_SQUARED_PRODUCT
    return _direction(
        ca.if_else(has_length, cosine * scale, 1.0), ca.if_else(has_length, sine * scale, 0.0)
    )


def subproblem_4(cosine: Expr, sine: Expr, height: Expr) -> tuple[CosSin, CosSin, Expr]:
    """Solve ``cosine cos(t) + sine sin(t) = height`` for t.

    Returns:
        Both angles, and the reach margin 1 - (height / largest height)^2, negative without a
        solution.
    """
    squared = cosine * cosine + sine * sine
    safe = ca.fmax(squared, MIN_SQUARED_LENGTH)
    slack = 1 - height * height / safe
    root = ca.sqrt(ca.fmax(squared - height * height, 0.0))
    # Without a solution: the angle of the largest or smallest height.
    length = ca.sqrt(safe)
    clipped = ca.fmin(ca.fmax(height, -length), length)
    has_length = squared > MIN_SQUARED_LENGTH
    solutions = [
        _direction(
            ca.if_else(has_length, (cosine * clipped - sine * side) / safe, 1.0),
            ca.if_else(has_length, (sine * clipped + cosine * side) / safe, 0.0),
        )
        for side in (root, -root)
    ]
    return solutions[0], solutions[1], slack


def subproblem_1(axis: Array, start: Expr, end: Expr) -> CosSin:
    """Return the angle about a constant unit axis that brings one vector nearest to another."""
    a = ca.DM(axis)
    axial_product = ca.dot(a, start) * ca.dot(a, end)
    return cos_sin_of(ca.dot(start, end) - axial_product, ca.dot(a, ca.cross(start, end)))


def about_axis(axis: Array, vector: Expr) -> tuple[Expr, Expr, Expr]:
    """Decompose the rotation of a vector about a constant unit axis.

    Returns:
        ``constant``, ``cosine``, ``sine``, (3, 1) each: the vector rotated by t is
        ``constant + cosine cos(t) + sine sin(t)``.
    """
    a = ca.SX(sparse(axis.reshape(3, 1)))
    constant = a * ca.dot(a, vector)
    return constant, vector - constant, ca.cross(a, vector)
