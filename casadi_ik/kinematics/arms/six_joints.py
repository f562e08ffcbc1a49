"""Families of six joints, and of seven of which one is swept: the redundancy is its position.

Pieper (1968): the last three axes meet in a point, or the first three, seen from the palm. The
point is moved by the other three alone; it has a closed form if the first two of them meet, or if
the second and third are parallel. Then the last three make the rotation that is left. Universal
Robots and others have three parallel axes in the middle instead.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import Bend, ClosedForm, Redundancy, Sphere
from casadi_ik.kinematics.arms.screws import (
    Screws,
    Turn,
    about_axis,
    subproblem_1,
    subproblem_4,
    turn,
)
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, safe_norm

Signs = tuple[Expr, ...] | None
"""First and second sign of a bend; None: of all."""


@dataclass(frozen=True, eq=False)
class SixJoints(ClosedForm):
    """Six joints, and before them one that is swept, if there are seven.

    Attributes:
        screws: Of the nominal arm, in the order of the solution.
        swept: Whether the first screw is that of the swept joint.
        model_error: How far the nominal arm is from the real one [m and rad].
    """

    screws: Screws
    swept: bool
    model_error: float

    @abstractmethod
    def six(self, motion: Pose, signs: Signs) -> list[Bend]:
        """The four bends for a motion of the six, or that of two signs."""

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The swept joint."""
        return (Redundancy(self.screws.joints[0]),) if self.swept else ()

    @property
    def places(self) -> tuple[int, ...]:
        """Places of the six screws that are solved for."""
        return tuple(range(int(self.swept), len(self.screws)))

    def bends(self, palm: Pose, redundancy: Expr, signs: Signs = None) -> list[Bend]:
        """Those of the six for what the swept joint leaves them."""
        found = self.six(self.left(palm, redundancy), signs)
        if not self.swept:
            return found
        own = {self.screws.joints[0]: redundancy[0]}
        return [Bend(bend.joints | own, bend.ends, bend.slack) for bend in found]

    def left(self, palm: Pose, redundancy: Expr) -> Pose:
        """The motion for a palm pose that the swept joint leaves to the other six."""
        motion = self.screws.motion(palm)
        if not self.swept:
            return motion
        swept = redundancy[0]
        back = Turn(ca.cos(swept), -ca.sin(swept)).about(self.screws.axes[0])
        point = ca.DM(self.screws.points[0])
        return Pose(back @ motion.rotation, point + back @ (motion.origin - point))


@dataclass(frozen=True, eq=False)
class SphericalArm(SixJoints):
    """An arm that ends in a sphere, or begins with one and is seen from the palm.

    Attributes:
        end: The sphere.
    """

    end: Sphere

    @property
    def kind(self) -> str:
        """Where the sphere is, and which joint is swept."""
        sphere = f"spherical {'shoulder' if self.screws.reverse else 'wrist'}"
        return f"{sphere}, joint {self.screws.joints[0] + 1} swept" if self.swept else sphere

    @abstractmethod
    def beyond_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """`beyond` for a motion of all screws."""

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By where the sphere's point has to be."""
        return self.beyond_reach(self.screws.motion(palm), lower, upper)

    def _base(self, joints: dict[int, Expr], turns: list[Turn], motion: Pose, slack: Expr) -> Bend:
        """A bend of the first three screws, and what they leave to the sphere."""
        left = motion.rotation
        for place, one in zip(self.places, turns, strict=False):
            left = one.back.about(self.screws.axes[place]) @ left
        return Bend(joints, (self.end.triples(self.screws, left),), slack)

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

    def six(self, motion: Pose, signs: Signs) -> list[Bend]:
        """The four bends, or that of two signs."""
        first, second, third = self.places[:3]
        axes = self.screws.axes
        from_shoulder = self._target(motion) - ca.DM(self.shoulder)
        constant, cosine, sine = self._swing(third)
        constant = constant - self.shoulder
        ahead, aside = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        fixed = float(constant @ constant + cosine @ cosine)
        *elbows, reachable = subproblem_4(
            ca.SX(ahead), ca.SX(aside), ca.sumsqr(from_shoulder) - fixed
        )
        bends = []
        height = ca.dot(ca.DM(axes[first]), from_shoulder)
        for elbow in _picked(elbows, signs, 0):
            point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
            parts = (ca.dot(ca.DM(axes[first]), part) for part in about_axis(axes[second], point))
            still, ahead_, aside_ = parts
            *tilts, tiltable = subproblem_4(ahead_, aside_, height - still)
            for tilt in _picked(tilts, signs, 1):
                tilted = tilt.about(axes[second]) @ point
                pan = subproblem_1(axes[first], tilted, from_shoulder)
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

    def six(self, motion: Pose, signs: Signs) -> list[Bend]:
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
        *pans, pannable = subproblem_4(ahead, aside, wanted - still)
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
            *elbows, bendable = subproblem_4(ca.SX(bent), ca.SX(bent_aside), height)
            for elbow in _picked(elbows, signs, 1):
                point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
                tilt = subproblem_1(axes[second], point, inside)
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


@dataclass(frozen=True, eq=False)
class ParallelTriple(SixJoints):
    """Second to fourth of the six screws are parallel, fifth and sixth meet.

    Attributes:
        wrist: (3,) where fifth and sixth meet [m].
    """

    wrist: Array

    @property
    def kind(self) -> str:
        """What the arm is."""
        return "three parallel axes"

    @property
    def parts(self) -> tuple[str, str, str]:
        """What turns the plane, what leans out of it, what bends in it."""
        return ("shoulder", "wrist", "elbow")

    def six(self, motion: Pose, signs: Signs) -> list[Bend]:
        """The four bends, or that of two signs."""
        first, second, _, _, fifth, sixth = self.places
        axes, points = self.screws.axes, self.screws.points
        across = axes[second]
        out = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        still, ahead, aside = (
            ca.dot(ca.DM(across), part) for part in about_axis(-axes[first], out)
        )
        wanted = float(across @ (self.wrist - points[first]))
        *pans, pannable = subproblem_4(ahead, aside, wanted - still)
        leans = [float(across @ part) for part in _parts(axes[fifth], axes[sixth])]
        bends = []
        for pan in _picked(pans, signs, 0):
            facing = pan.back.about(axes[first]) @ motion.rotation
            height = ca.dot(ca.DM(across), facing @ ca.DM(axes[sixth])) - leans[0]
            *tilts, leanable = subproblem_4(ca.SX(leans[1]), ca.SX(leans[2]), height)
            for tilt in _picked(tilts, signs, 1):
                slack = ca.fmin(pannable, leanable)
                bends.append(self._planar(pan, tilt, facing, motion, slack))
        return bends

    def _planar(self, pan: Turn, tilt: Turn, facing: Expr, motion: Pose, slack: Expr) -> Bend:
        """What is left to the three parallel screws."""
        first, second, third, fourth, fifth, sixth = self.places
        axes, points = self.screws.axes, self.screws.points
        across = axes[second]
        seen = tilt.back.about(axes[fifth]) @ ca.DM(across)
        roll = subproblem_1(axes[sixth], facing.T @ ca.DM(across), seen)
        # The motion of the three: a turn about `across`, and where it takes the fourth axis.
        turned = facing @ roll.back.about(axes[sixth]) @ tilt.back.about(axes[fifth])
        start = _perpendicular(across)
        whole = subproblem_1(across, ca.DM(start), turned @ ca.DM(start))
        at = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        wrist = pan.back.about(axes[first]) @ at + ca.DM(points[first])
        hinge = points[second]
        to_fourth = wrist + turned @ ca.DM(points[fourth] - self.wrist) - ca.DM(hinge)
        inside = to_fourth - ca.DM(across) * ca.dot(ca.DM(across), to_fourth)
        upper, fore = (
            link - across * (across @ link)
            for link in (points[third] - hinge, points[fourth] - points[third])
        )
        ahead, aside = 2 * float(upper @ fore), 2 * float(upper @ np.cross(across, fore))
        fixed = float(upper @ upper + fore @ fore)
        *elbows, bendable = subproblem_4(ca.SX(ahead), ca.SX(aside), ca.sumsqr(inside) - fixed)
        ends = []
        for elbow in elbows:
            reached = ca.DM(upper) + elbow.about(across) @ ca.DM(fore)
            lift = subproblem_1(across, reached, inside)
            last = whole.plus(lift.back).plus(elbow.back)
            last = turn(last.cosine, last.sine)
            ends.append(
                self.angle(second, lift)
                | self.angle(third, self._signed(third, elbow))
                | self.angle(fourth, self._signed(fourth, last))
            )
        joints = self.angle(first, pan) | self.angle(fifth, tilt) | self.angle(sixth, roll)
        return Bend(joints, ((ends[0], ends[1]),), ca.fmin(slack, bendable))

    def _signed(self, place: int, about_second: Turn) -> Turn:
        """A turn about the second axis as one about another of the three."""
        same = self.screws.axes[place] @ self.screws.axes[self.places[1]] > 0
        return about_second if same else about_second.back

    def beyond(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """By the distance of the wrist from the shoulder's axes, the elbow bent as it likes."""
        del lower, upper
        _, second, third, fourth, *_ = self.places
        points = self.screws.points
        axis = self.screws.axes[second]
        links = np.diff([*points[[second, third, fourth]], self.wrist], axis=0)
        flat = links - np.outer(links @ axis, axis)
        far = float(np.linalg.norm(flat, axis=1).sum())
        motion = self.screws.motion(palm)
        first = self.places[0]
        about, base = self.screws.axes[first], points[first]
        out = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(base)
        aside = float(axis @ (self.wrist - base))
        hinge = points[second] - base
        lift, arm = float(about @ hinge), abs(float(np.cross(axis, about) @ hinge))
        up = ca.dot(ca.DM(about), out) - lift
        wide = ca.sqrt(ca.fmax(ca.sumsqr(out) - ca.dot(ca.DM(about), out) ** 2 - aside**2, 1e-24))
        return ca.fmax(ca.sqrt((wide - arm) ** 2 + up**2 + 1e-24) - far, 0.0)


def _picked(turns: Sequence[Turn], signs: Signs, place: int) -> Sequence[Turn]:
    """Both turns, or the one of a sign."""
    if signs is None:
        return turns
    one, other = turns
    return (one.or_other(signs[place] > 0, other),)


def _largest_cosine(first: Expr, last: Expr) -> Expr:
    """The largest cosine of the angles from `first` to `last` [rad]."""
    turns = ca.floor(last / (2 * np.pi)) * 2 * np.pi
    return ca.if_else(turns >= first, 1.0, ca.fmax(ca.cos(first), ca.cos(last)))


def _outside(distance: Expr, near: Expr, far: Expr) -> Expr:
    """How far a distance is out of a span: > 0 beyond it, < 0 short of it."""
    return distance - ca.fmin(ca.fmax(distance, near), far)


def _parts(axis: Array, vector: Array) -> tuple[Array, Array, Array]:
    constant = axis * (axis @ vector)
    return constant, vector - constant, np.cross(axis, vector)


def _perpendicular(axis: Array) -> Array:
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    across = np.cross(axis, helper).astype(float)
    return across / np.linalg.norm(across)
