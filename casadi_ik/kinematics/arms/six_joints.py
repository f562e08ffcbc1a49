"""Families of six joints, and of seven joints with one that is swept as the redundancy parameter.

Pieper (1968): the last three axes meet in a point, or the first three, seen from the palm. The
other three joints position this point; they have a closed form if the first two of their axes meet,
or if the second and third are parallel. The spherical joint then makes the remaining rotation.
Universal Robots and others have three parallel axes instead.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import (
    ClosedForm,
    ElbowBranch,
    JointAngle,
    JointAngles,
    Redundancy,
    SphericalJoints,
)
from casadi_ik.kinematics.arms.screws import (
    CosSin,
    Screws,
    about_axis,
    cos_sin_of,
    subproblem_1,
    subproblem_4,
)
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.smooth import Expr, safe_norm

Signs = tuple[Expr, ...] | None
"""First and second sign of an elbow branch; None: all branches."""


@dataclass(frozen=True, eq=False)
class SixJoints(ClosedForm):
    """An arm of six solved joints, after a swept joint if there are seven.

    Attributes:
        screws: Screws of the nominal arm, in the order of the solution.
        swept: True if the first screw belongs to a swept joint.
        model_error: Deviation of the nominal arm from the real one [m and rad].
    """

    screws: Screws
    swept: bool
    model_error: float

    @abstractmethod
    def branches_of_six(self, motion: Pose, signs: Signs) -> list[ElbowBranch]:
        """Return the four elbow branches for a motion of the six joints, or that of two signs."""

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The swept joint, if there is one."""
        return (Redundancy(self.screws.joints[0]),) if self.swept else ()

    @property
    def indices(self) -> tuple[int, ...]:
        """Indices of the six solved screws."""
        return tuple(range(int(self.swept), len(self.screws)))

    def bends(self, palm: Pose, redundancy: Expr, signs: Signs = None) -> list[ElbowBranch]:
        """Return the elbow branches of the six joints behind the swept joint."""
        branches = self.branches_of_six(self.remaining_motion(palm, redundancy), signs)
        if not self.swept:
            return branches
        value = redundancy[0]
        direction = CosSin(ca.cos(value), ca.sin(value))
        swept_joint = {self.screws.joints[0]: JointAngle(value, direction)}
        return [
            ElbowBranch(bend.joints | swept_joint, bend.wrist_flips, bend.slack)
            for bend in branches
        ]

    def remaining_motion(self, palm: Pose, redundancy: Expr) -> Pose:
        """Return the motion that the six joints must make for a palm pose."""
        motion = self.screws.motion(palm)
        if not self.swept:
            return motion
        swept = redundancy[0]
        inverse = CosSin(ca.cos(swept), -ca.sin(swept)).rotation(self.screws.axes[0])
        point = ca.DM(self.screws.points[0])
        return Pose(inverse @ motion.rotation, point + inverse @ (motion.origin - point))


@dataclass(frozen=True, eq=False)
class SphericalArm(SixJoints):
    """An arm with a spherical wrist, or with a spherical shoulder and seen from the palm.

    Attributes:
        end: The spherical joint.
    """

    end: SphericalJoints

    @property
    def kind(self) -> str:
        """Position of the spherical joint, and the swept joint."""
        sphere = f"spherical {'shoulder' if self.screws.reverse else 'wrist'}"
        return f"{sphere}, joint {self.screws.joints[0] + 1} swept" if self.swept else sphere

    @abstractmethod
    def motion_out_of_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return `distance_out_of_reach` for a motion of all screws."""

    def distance_out_of_reach(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the required position of the spherical joint's point."""
        return self.motion_out_of_reach(self.screws.motion(palm), lower, upper)

    def _branch(
        self, joints: JointAngles, angles: list[CosSin], motion: Pose, slack: Expr
    ) -> ElbowBranch:
        """Return the elbow branch of three angles and the remaining rotation."""
        remaining_motion = motion.rotation
        for index, angle in zip(self.indices, angles, strict=False):
            remaining_motion = angle.inverse.rotation(self.screws.axes[index]) @ remaining_motion
        return ElbowBranch(joints, (self.end.triples(self.screws, remaining_motion),), slack)

    def _circle(self, index: int) -> tuple[Array, Array, Array]:
        """Return the circle of the sphere's point about a screw: constant, cosine and sine part."""
        axis, point = self.screws.axes[index], self.screws.points[index]
        foot = point + axis * (axis @ (self.end.point - point))
        return foot, self.end.point - foot, np.cross(axis, self.end.point - foot)

    def _target(self, motion: Pose) -> Expr:
        """Return the required position of the sphere's point for a motion of the six joints."""
        return motion.rotation @ ca.DM(self.end.point) + motion.origin

    def _span(
        self, vectors: tuple[Array, Array, Array], lower: Expr, upper: Expr
    ) -> tuple[Expr, Expr]:
        """Return the smallest and largest length [m] of a vector that the third screw rotates."""
        constant, cosine, sine = vectors
        joint = self.screws.joints[self.indices[2]]
        middle = float(constant @ constant + cosine @ cosine)
        cos_part, sin_part = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        swing, phase = float(np.hypot(cos_part, sin_part)), float(np.arctan2(sin_part, cos_part))
        interval = lower[joint] - phase, upper[joint] - phase
        max_cosine = _largest_cosine(*interval)
        min_cosine = -_largest_cosine(interval[0] - np.pi, interval[1] - np.pi)
        min_distance, max_distance = (
            ca.sqrt(ca.fmax(middle + swing * c, 0.0)) for c in (min_cosine, max_cosine)
        )
        return min_distance, max_distance


@dataclass(frozen=True, eq=False)
class MeetingAxes(SphericalArm):
    """An arm whose first two screws meet; the third alone sets the distance to the sphere.

    Attributes:
        shoulder: (3,) intersection of the first two axes [m].
    """

    shoulder: Array

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """The elbow, the joint beyond it, the spherical joint."""
        if self.screws.reverse:
            return ("elbow", "wrist", "shoulder")
        return ("elbow", "shoulder", "wrist")

    def branches_of_six(self, motion: Pose, signs: Signs) -> list[ElbowBranch]:
        """Return the four elbow branches, or that of two signs."""
        first, second, third = self.indices[:3]
        axes = self.screws.axes
        from_shoulder = self._target(motion) - ca.DM(self.shoulder)
        constant, cosine, sine = self._circle(third)
        constant = constant - self.shoulder
        cos_part, sin_part = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        fixed = float(constant @ constant + cosine @ cosine)
        *elbows, reachable = subproblem_4(
            ca.SX(cos_part), ca.SX(sin_part), ca.sumsqr(from_shoulder) - fixed
        )
        bends = []
        height = ca.dot(ca.DM(axes[first]), from_shoulder)
        for elbow in _with_sign(elbows, signs, 0):
            point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
            sign_names = (
                ca.dot(ca.DM(axes[first]), part) for part in about_axis(axes[second], point)
            )
            constant_part, tilt_cos_part, tilt_sin_part = sign_names
            *tilts, tiltable = subproblem_4(tilt_cos_part, tilt_sin_part, height - constant_part)
            for tilt in _with_sign(tilts, signs, 1):
                tilted = tilt.rotation(axes[second]) @ point
                pan = subproblem_1(axes[first], tilted, from_shoulder)
                joints = self.angle(first, pan) | self.angle(second, tilt)
                joints |= self.angle(third, elbow)
                slack = ca.fmin(reachable, tiltable)
                bends.append(self._branch(joints, [pan, tilt, elbow], motion, slack))
        return bends

    def motion_out_of_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the distance between the sphere's point and the shoulder."""
        constant, cosine, sine = self._circle(self.indices[2])
        min_distance, max_distance = self._span(
            (constant - self.shoulder, cosine, sine), lower, upper
        )
        if not self.swept:
            return _distance_outside(
                safe_norm(self._target(motion) - ca.DM(self.shoulder)), min_distance, max_distance
            )
        # About the swept axis both points move on circles.
        axis, foot = self.screws.axes[0], self.screws.points[0]
        constant_part = ca.DM(self.shoulder - foot)
        from_foot = motion.rotation @ ca.DM(self.end.point) + motion.origin - ca.DM(foot)
        axial_distance = ca.dot(ca.DM(axis), from_foot - constant_part)
        radius = float(np.linalg.norm(np.cross(axis, self.shoulder - foot)))
        radial_distance = safe_norm(ca.cross(ca.DM(axis), from_foot))
        min_separation = ca.sqrt(axial_distance**2 + (radial_distance - radius) ** 2 + 1e-300)
        max_separation = ca.sqrt(axial_distance**2 + (radial_distance + radius) ** 2 + 1e-300)
        return ca.fmax(min_separation - max_distance, 0.0) + ca.fmin(
            max_separation - min_distance, 0.0
        )


@dataclass(frozen=True, eq=False)
class ParallelPair(SphericalArm):
    """An arm whose second and third screws are parallel, so that they bend it in a plane.

    The first screw sets the distance of the sphere's point from that plane.
    """

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """The joint that turns the plane, the joint that bends in it, the spherical joint."""
        if self.screws.reverse:
            return ("wrist", "elbow", "shoulder")
        return ("shoulder", "elbow", "wrist")

    def branches_of_six(self, motion: Pose, signs: Signs) -> list[ElbowBranch]:
        """Return the four elbow branches, or that of two signs."""
        first, second, third = self.indices[:3]
        axes, points = self.screws.axes, self.screws.points
        target = self._target(motion)
        normal = axes[second]
        base, hinge = points[first], points[second]
        from_base = target - ca.DM(base)
        # Component along the plane's normal, which the first screw rotates.
        sign_names = (ca.dot(ca.DM(normal), part) for part in about_axis(-axes[first], from_base))
        constant_part, cos_part, sin_part = sign_names
        target_offset = float(normal @ (self.end.point - base))
        *pans, pannable = subproblem_4(cos_part, sin_part, target_offset - constant_part)
        constant, cosine, sine = self._circle(third)
        constant = constant - hinge
        constant = constant - normal * (normal @ constant)
        elbow_cos_part, elbow_sin_part = 2 * float(constant @ cosine), 2 * float(constant @ sine)
        fixed = float(constant @ constant + cosine @ cosine)
        bends = []
        for pan in _with_sign(pans, signs, 0):
            in_plane = pan.inverse.rotation(axes[first]) @ from_base + ca.DM(base - hinge)
            in_plane = in_plane - ca.DM(normal) * ca.dot(ca.DM(normal), in_plane)
            height = ca.sumsqr(in_plane) - fixed
            *elbows, bendable = subproblem_4(ca.SX(elbow_cos_part), ca.SX(elbow_sin_part), height)
            for elbow in _with_sign(elbows, signs, 1):
                point = ca.DM(constant) + ca.DM(cosine) * elbow.cosine + ca.DM(sine) * elbow.sine
                tilt = subproblem_1(axes[second], point, in_plane)
                joints = self.angle(first, pan) | self.angle(second, tilt)
                joints |= self.angle(third, elbow)
                slack = ca.fmin(pannable, bendable)
                bends.append(self._branch(joints, [pan, tilt, elbow], motion, slack))
        return bends

    def motion_out_of_reach(self, motion: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the distance between the sphere's point and the first two axes."""
        first, second, third = self.indices[:3]
        if self.swept:
            return ca.SX(0)
        constant, cosine, sine = self._circle(third)
        hinge, normal = self.screws.points[second], self.screws.axes[second]
        constant = constant - hinge
        constant = constant - normal * (normal @ constant)
        min_distance, max_distance = self._span((constant, cosine, sine), lower, upper)
        axis, base = self.screws.axes[first], self.screws.points[first]
        from_base = self._target(motion) - ca.DM(base)
        sin_part = float(normal @ (self.end.point - base))
        wide = ca.sqrt(
            ca.fmax(ca.sumsqr(from_base) - ca.dot(ca.DM(axis), from_base) ** 2 - sin_part**2, 1e-24)
        )
        to_hinge = hinge - base
        lift, arm = float(axis @ to_hinge), float(np.cross(normal, axis) @ to_hinge)
        up = ca.dot(ca.DM(axis), from_base) - lift
        # The plane can face the target from either side.
        reaches = [
            _distance_outside(
                ca.sqrt((wide - s * arm) ** 2 + up**2 + 1e-24), min_distance, max_distance
            )
            for s in (1, -1)
        ]
        return ca.if_else(ca.fabs(reaches[0]) <= ca.fabs(reaches[1]), *reaches)


@dataclass(frozen=True, eq=False)
class ParallelTriple(SixJoints):
    """An arm whose second to fourth screws are parallel and whose last two meet.

    Attributes:
        wrist: (3,) intersection of the fifth and sixth axis [m].
    """

    wrist: Array

    @property
    def kind(self) -> str:
        """Description of the arm."""
        return "three parallel axes"

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """Joints that rotate the plane, leave it, and bend within it."""
        return ("shoulder", "wrist", "elbow")

    def branches_of_six(self, motion: Pose, signs: Signs) -> list[ElbowBranch]:
        """Return the four elbow branches, or that of two signs."""
        first, second, _, _, fifth, sixth = self.indices
        axes, points = self.screws.axes, self.screws.points
        normal = axes[second]
        from_base = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        constant_part, cos_part, sin_part = (
            ca.dot(ca.DM(normal), part) for part in about_axis(-axes[first], from_base)
        )
        target_offset = float(normal @ (self.wrist - points[first]))
        *pans, pannable = subproblem_4(cos_part, sin_part, target_offset - constant_part)
        leans = [float(normal @ part) for part in _coefficients(axes[fifth], axes[sixth])]
        bends = []
        for pan in _with_sign(pans, signs, 0):
            facing = pan.inverse.rotation(axes[first]) @ motion.rotation
            height = ca.dot(ca.DM(normal), facing @ ca.DM(axes[sixth])) - leans[0]
            *tilts, leanable = subproblem_4(ca.SX(leans[1]), ca.SX(leans[2]), height)
            for tilt in _with_sign(tilts, signs, 1):
                slack = ca.fmin(pannable, leanable)
                bends.append(self._planar(pan, tilt, facing, motion, slack))
        return bends

    def _planar(
        self, pan: CosSin, tilt: CosSin, facing: Expr, motion: Pose, slack: Expr
    ) -> ElbowBranch:
        """Solve the three parallel screws for the remaining motion."""
        first, second, third, fourth, fifth, sixth = self.indices
        axes, points = self.screws.axes, self.screws.points
        normal = axes[second]
        from_foot = tilt.inverse.rotation(axes[fifth]) @ ca.DM(normal)
        roll = subproblem_1(axes[sixth], facing.T @ ca.DM(normal), from_foot)
        # The motion of the three: a rotation about `normal`, and the position of the fourth axis.
        rotation_before = (
            facing @ roll.inverse.rotation(axes[sixth]) @ tilt.inverse.rotation(axes[fifth])
        )
        start = _perpendicular(normal)
        total = subproblem_1(normal, ca.DM(start), rotation_before @ ca.DM(start))
        from_base_point = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(points[first])
        wrist = pan.inverse.rotation(axes[first]) @ from_base_point + ca.DM(points[first])
        hinge = points[second]
        to_fourth = wrist + rotation_before @ ca.DM(points[fourth] - self.wrist) - ca.DM(hinge)
        in_plane = to_fourth - ca.DM(normal) * ca.dot(ca.DM(normal), to_fourth)
        upper, fore = (
            link - normal * (normal @ link)
            for link in (points[third] - hinge, points[fourth] - points[third])
        )
        cos_part, sin_part = 2 * float(upper @ fore), 2 * float(upper @ np.cross(normal, fore))
        fixed = float(upper @ upper + fore @ fore)
        *elbows, bendable = subproblem_4(
            ca.SX(cos_part), ca.SX(sin_part), ca.sumsqr(in_plane) - fixed
        )
        flips = []
        for elbow in elbows:
            wrist_position = ca.DM(upper) + elbow.rotation(normal) @ ca.DM(fore)
            lift = subproblem_1(normal, wrist_position, in_plane)
            last = total.compose(lift.inverse).compose(elbow.inverse)
            last = cos_sin_of(last.cosine, last.sine)
            flips.append(
                self.angle(second, lift)
                | self.angle(third, self._signed(third, elbow))
                | self.angle(fourth, self._signed(fourth, last))
            )
        joints = self.angle(first, pan) | self.angle(fifth, tilt) | self.angle(sixth, roll)
        return ElbowBranch(joints, ((flips[0], flips[1]),), ca.fmin(slack, bendable))

    def _signed(self, index: int, about_second: CosSin) -> CosSin:
        """Convert an angle about the second axis to one about another of the three axes."""
        is_parallel = self.screws.axes[index] @ self.screws.axes[self.indices[1]] > 0
        return about_second if is_parallel else about_second.inverse

    def distance_out_of_reach(self, palm: Pose, lower: Expr, upper: Expr) -> Expr:
        """Return the bound from the distance between wrist and shoulder axes."""
        del lower, upper
        _, second, third, fourth, *_ = self.indices
        points = self.screws.points
        axis = self.screws.axes[second]
        links = np.diff([*points[[second, third, fourth]], self.wrist], axis=0)
        flat = links - np.outer(links @ axis, axis)
        max_distance = float(np.linalg.norm(flat, axis=1).sum())
        motion = self.screws.motion(palm)
        first = self.indices[0]
        first_axis, base = self.screws.axes[first], points[first]
        from_base = motion.rotation @ ca.DM(self.wrist) + motion.origin - ca.DM(base)
        sin_part = float(axis @ (self.wrist - base))
        hinge = points[second] - base
        lift, arm = float(first_axis @ hinge), abs(float(np.cross(axis, first_axis) @ hinge))
        up = ca.dot(ca.DM(first_axis), from_base) - lift
        wide = ca.sqrt(
            ca.fmax(
                ca.sumsqr(from_base) - ca.dot(ca.DM(first_axis), from_base) ** 2 - sin_part**2,
                1e-24,
            )
        )
        return ca.fmax(ca.sqrt((wide - arm) ** 2 + up**2 + 1e-24) - max_distance, 0.0)


def _with_sign(angles: Sequence[CosSin], signs: Signs, index: int) -> Sequence[CosSin]:
    """Return both angles, or the one of a sign."""
    if signs is None:
        return angles
    first, second = angles
    return (first.select(signs[index] > 0, second),)


def _largest_cosine(first: Expr, last: Expr) -> Expr:
    """Return the largest cosine of the angles from `first` to `last` [rad]."""
    last_full_turn = ca.floor(last / (2 * np.pi)) * 2 * np.pi
    return ca.if_else(last_full_turn >= first, 1.0, ca.fmax(ca.cos(first), ca.cos(last)))


def _distance_outside(distance: Expr, min_distance: Expr, max_distance: Expr) -> Expr:
    """Return by how much a distance is outside an interval: > 0 above, < 0 below."""
    return distance - ca.fmin(ca.fmax(distance, min_distance), max_distance)


def _coefficients(axis: Array, vector: Array) -> tuple[Array, Array, Array]:
    constant = axis * (axis @ vector)
    return constant, vector - constant, np.cross(axis, vector)


def _perpendicular(axis: Array) -> Array:
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    normal = np.cross(axis, helper).astype(float)
    return normal / np.linalg.norm(normal)
