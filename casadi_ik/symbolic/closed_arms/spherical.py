"""Arms of six screws whose last three meet in a point (Pieper 1968), and chains that end so.

The point is moved by the first three alone. It has a closed form if the first two of them meet, or
if the second and third are parallel; then the last three make the rotation that is left.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.symbolic.closed_arms.form import Bend, ClosedForm, SphericalEnd
from casadi_ik.symbolic.closed_arms.turns import (
    Turn,
    about_axis,
    turn_between,
    turns_to_height,
)
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr, safe_norm

Signs: TypeAlias = tuple[Expr, Expr]
"""First and second sign of a bend."""


@dataclass(frozen=True, eq=False)
class SphericalArm(ClosedForm):
    """An arm that ends in a sphere, or begins with one and is seen from the palm.

    Attributes:
        end: The sphere.
    """

    end: SphericalEnd

    @property
    def kind(self) -> str:
        """Where the sphere is, and which joint is swept."""
        sphere = f"spherical {'shoulder' if self.screws.reverse else 'wrist'}"
        return f"{sphere}, joint {self.screws.joints[0] + 1} swept" if self.swept else sphere

    @abstractmethod
    def bent(self, motion: Pose, signs: Signs | None) -> list[Bend]:
        """The four bends for a motion of the six, or that of two signs (1 or -1)."""

    @abstractmethod
    def beyond_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """`beyond` for a motion of all screws."""

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By where the sphere's point has to be."""
        return self.beyond_reach(self.screws.motion(palm), lower, upper)

    def _bends(self, motion: Pose) -> list[Bend]:
        return self.bent(motion, None)

    def _base(self, joints: dict[int, Expr], turns: list[Turn], motion: Pose, slack: Expr) -> Bend:
        """A bend of the first three screws, and what they leave to the sphere."""
        left = motion.rotation
        for place, turn in zip(self.places, turns, strict=False):
            left = turn.back.about(self.screws.axes[place]) @ left
        return Bend(joints, self.end.triples(self.screws, left), slack)

    def _swing(self, place: int) -> tuple[Array, Array, Array]:
        """Where the sphere's point goes about a screw: ``constant + cosine c + sine s``, (3,)."""
        axis, point = self.screws.axes[place], self.screws.points[place]
        foot = point + axis * (axis @ (self.end.point - point))
        return foot, self.end.point - foot, np.cross(axis, self.end.point - foot)

    def _target(self, motion: Pose) -> Expr:
        """Where the sphere's point has to be, for a motion of all six."""
        return motion.rotation @ ca.DM(self.end.point) + motion.origin

    def _span(
        self, vectors: tuple[Array, Array, Array], lower: Expr, upper: Expr
    ) -> tuple[Expr, Expr]:
        """Smallest and largest length [m] of what the third screw swings, within its bounds."""
        constant, cosine, sine = vectors
        joint = self.screws.joints[self.places[2]]
        middle = float(constant @ constant + cosine @ cosine)
        ahead, aside = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        swing, turning = float(np.hypot(ahead, aside)), float(np.arctan2(aside, ahead))
        ends = lower[joint] - turning, upper[joint] - turning
        most = _largest_cosine(*ends)
        least = -_largest_cosine(ends[0] - np.pi, ends[1] - np.pi)
        near, far = (ca.sqrt(ca.fmax(middle + swing * c, 0.0)) for c in (least, most))
        return near, far


@dataclass(frozen=True, eq=False)
class MeetingAxes(SphericalArm):
    """The first two of the six screws meet: the third alone sets the distance to the sphere.

    Attributes:
        shoulder: (3,) where they meet [m].
    """

    shoulder: Array

    @property
    def parts(self) -> tuple[str, str, str]:
        """Elbow, then what is between elbow and palm or base, then the sphere."""
        if self.screws.reverse:
            return ("elbow", "wrist", "shoulder")
        return ("elbow", "shoulder", "wrist")

    def bent(self, motion: Pose, signs: Signs | None) -> list[Bend]:
        """The four bends, or that of two signs."""
        first, second, third = self.places[:3]
        axes = self.screws.axes
        from_shoulder = self._target(motion) - ca.DM(self.shoulder)
        constant, cosine, sine = self._swing(third)
        constant = constant - self.shoulder
        ahead, aside = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        fixed = float(constant @ constant + cosine @ cosine)
        *elbows, reachable = turns_to_height(
            ca.SX(ahead), ca.SX(aside), ca.sumsqr(from_shoulder) - fixed
        )
        bends = []
        height = ca.dot(ca.DM(axes[first]), from_shoulder)
        for elbow in _picked(elbows, signs, 0):
            point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
            parts = (ca.dot(ca.DM(axes[first]), part) for part in about_axis(axes[second], point))
            still, ahead_, aside_ = parts
            *tilts, tiltable = turns_to_height(ahead_, aside_, height - still)
            for tilt in _picked(tilts, signs, 1):
                tilted = tilt.about(axes[second]) @ point
                pan = turn_between(axes[first], tilted, from_shoulder)
                joints = self.angle(first, pan) | self.angle(second, tilt)
                joints |= self.angle(third, elbow)
                slack = ca.fmin(reachable, tiltable)
                bends.append(self._base(joints, [pan, tilt, elbow], motion, slack))
        return bends

    def beyond_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the distance of the sphere's point from where the first two meet."""
        constant, cosine, sine = self._swing(self.places[2])
        near, far = self._span((constant - self.shoulder, cosine, sine), lower, upper)
        if not self.swept:
            return _outside(safe_norm(self._target(motion) - ca.DM(self.shoulder)), near, far)
        # Turned about the swept axis the two points pass each other on circles.
        axis, foot = self.screws.axes[0], self.screws.points[0]
        still = ca.DM(self.shoulder - foot)
        seen = motion.rotation @ ca.DM(self.end.point) + motion.origin - ca.DM(foot)
        along = ca.dot(ca.DM(axis), seen - still)
        radius = float(np.linalg.norm(np.cross(axis, self.shoulder - foot)))
        far_out = safe_norm(ca.cross(ca.DM(axis), seen))
        least = ca.sqrt(along**2 + (far_out - radius) ** 2 + 1e-300)
        most = ca.sqrt(along**2 + (far_out + radius) ** 2 + 1e-300)
        return ca.fmax(least - far, 0.0) + ca.fmin(most - near, 0.0)


@dataclass(frozen=True, eq=False)
class ParallelPair(SphericalArm):
    """The second and third of the six screws are parallel: they bend the arm in a plane.

    The first one sets how far the sphere's point is aside of that plane.
    """

    @property
    def parts(self) -> tuple[str, str, str]:
        """What turns the plane, what bends in it, and the sphere."""
        if self.screws.reverse:
            return ("wrist", "elbow", "shoulder")
        return ("shoulder", "elbow", "wrist")

    def bent(self, motion: Pose, signs: Signs | None) -> list[Bend]:
        """The four bends, or that of two signs."""
        first, second, third = self.places[:3]
        axes, points = self.screws.axes, self.screws.points
        target = self._target(motion)
        across = axes[second]
        base, hinge = points[first], points[second]
        out = target - ca.DM(base)
        # The plane's normal turned by the first screw, seen from the target.
        parts = (ca.dot(ca.DM(across), part) for part in about_axis(-axes[first], out))
        still, ahead, aside = parts
        wanted = float(across @ (self.end.point - base))
        *pans, pannable = turns_to_height(ahead, aside, wanted - still)
        constant, cosine, sine = self._swing(third)
        constant = constant - hinge
        constant = constant - across * (across @ constant)
        bent, bent_aside = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        fixed = float(constant @ constant + cosine @ cosine)
        bends = []
        for pan in _picked(pans, signs, 0):
            inside = pan.back.about(axes[first]) @ out + ca.DM(base - hinge)
            inside = inside - ca.DM(across) * ca.dot(ca.DM(across), inside)
            height = ca.sumsqr(inside) - fixed
            *elbows, bendable = turns_to_height(ca.SX(bent), ca.SX(bent_aside), height)
            for elbow in _picked(elbows, signs, 1):
                point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
                tilt = turn_between(axes[second], point, inside)
                joints = self.angle(first, pan) | self.angle(second, tilt)
                joints |= self.angle(third, elbow)
                slack = ca.fmin(pannable, bendable)
                bends.append(self._base(joints, [pan, tilt, elbow], motion, slack))
        return bends

    def beyond_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the distance of the sphere's point from the first two axes."""
        first, second, third = self.places[:3]
        if self.swept:
            return ca.SX(0)
        constant, cosine, sine = self._swing(third)
        hinge, across = self.screws.points[second], self.screws.axes[second]
        constant = constant - hinge
        constant = constant - across * (across @ constant)
        near, far = self._span((constant, cosine, sine), lower, upper)
        axis, base = self.screws.axes[first], self.screws.points[first]
        out = self._target(motion) - ca.DM(base)
        aside = float(across @ (self.end.point - base))
        wide = ca.sqrt(ca.fmax(ca.sumsqr(out) - ca.dot(ca.DM(axis), out) ** 2 - aside**2, 1e-24))
        to_hinge = hinge - base
        lift, arm = float(axis @ to_hinge), float(np.cross(across, axis) @ to_hinge)
        up = ca.dot(ca.DM(axis), out) - lift
        # The plane may face the target or turn its back on it.
        reaches = [
            _outside(ca.sqrt((wide - s * arm) ** 2 + up**2 + 1e-24), near, far) for s in (1, -1)
        ]
        return ca.if_else(ca.fabs(reaches[0]) <= ca.fabs(reaches[1]), *reaches)


def _picked(turns: Sequence[Turn], signs: Signs | None, place: int) -> Sequence[Turn]:
    """Both turns, or the one of a sign."""
    if signs is None:
        return turns
    one, other = turns
    first = signs[place] > 0
    cosine = ca.if_else(first, one.cosine, other.cosine)
    return (Turn(cosine, ca.if_else(first, one.sine, other.sine)),)


def _largest_cosine(first: Expr, last: Expr) -> Expr:
    """The largest cosine of the angles from `first` to `last` [rad]."""
    turns = ca.floor(last / (2 * np.pi)) * 2 * np.pi
    return ca.if_else(turns >= first, 1.0, ca.fmax(ca.cos(first), ca.cos(last)))


def _outside(distance: Expr, near: Expr, far: Expr) -> Expr:
    """How far a distance is out of a span: > 0 beyond it, < 0 short of it."""
    return distance - ca.fmin(ca.fmax(distance, near), far)
