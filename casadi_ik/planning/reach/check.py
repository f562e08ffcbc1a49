"""Independent check of the verdicts of a reachability map.

The decision uses closed forms, CasADi graphs and compiled code. The check uses none of them: it
takes the joints from the description of the robot, and refutes a palm pose again by branch and
bound over boxes of joint positions, in NumPy and in ball arithmetic (a centre, and a radius that
includes the rounding).

A box is refuted by the relative poses of joint axes. Between joints i < j, the joints outside
(before i and after j, seen from the base and from the palm) and the joints between determine the
same four numbers: the cosine of the angle between the axes, the position of each joint along the
axis of the other, and the distance of the joints. If the two results of a number are disjoint, no
configuration in the box reaches the palm pose. The directions of axis and joint j, seen from joint
i, moreover bound the position of joint i, and vice versa.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array, Bools, Rows
from casadi_ik.model.description import RobotDescription

RELATIVE_ROUNDING = 4e-15
"""Bound of the relative error of a sum of four products, and of the radius of a ball."""

ELEMENTARY_ERROR = 1e-14
"""Bound of the error of NumPy's elementary functions for angles of a few turns."""

DESCRIPTION_ERROR = 1e-14
"""Deviation from exact rotations and unit axes that the description may have by rounding."""

LIMIT_ROUNDING = 1e-12
"""Distance from a limit that may be due to rounding [rad]."""

PARALLEL_SINE = 1e-6
"""Sine of the angle of two axes below which they count as parallel."""


@dataclass(frozen=True)
class CheckParameters:
    """Parameters of the branch and bound over joint positions.

    Attributes:
        parts: Number of parts into which a joint's interval is divided.
        trial_boxes: Number of boxes on which the division of each joint is tried.
        passes: Number of contractions of a box.
    """

    parts: int = 4
    trial_boxes: int = 24
    passes: int = 2


CHECK_PARAMETERS = CheckParameters()

MAX_BOXES = 100_000
"""Default of the number of boxes after which a palm pose is not confirmed."""


@dataclass(frozen=True, eq=False)
class MapCheck:
    """Result of the check of some cells of a reachability map.

    Attributes:
        cells: (m, 2) position and orientation of the cells, by number.
        status: (m,) their verdicts, by name.
        is_confirmed: (m,) True where the check arrives at the same verdict. It is False for a wrong
            verdict, and where the check would need more than `max_boxes` boxes.

    Example:
        >>> reach = solver.reach_map(([0.3, -0.2, 0.3], [0.7, 0.2, 0.5]), 8, resolution=0.2)
        >>> bool(reach.check(solver, 5).is_confirmed.all())
        True
    """

    cells: NDArray[np.intp]
    status: NDArray[np.str_]
    is_confirmed: Bools


class BallArray(NamedTuple):
    """Numbers within a radius of a centre, elementwise."""

    center: Array
    radius: Array

    def __add__(self, other: BallArray) -> BallArray:  # type: ignore[override]
        center = self.center + other.center
        return BallArray(center, _rounded_up(self.radius + other.radius, center))

    def __sub__(self, other: BallArray) -> BallArray:
        center = self.center - other.center
        return BallArray(center, _rounded_up(self.radius + other.radius, center))

    def __matmul__(self, other: BallArray) -> BallArray:
        size, other_size = np.abs(self.center), np.abs(other.center)
        radius = size @ other.radius + self.radius @ (other_size + other.radius)
        return BallArray(self.center @ other.center, _rounded_up(radius, size @ other_size))

    def scale(self, factor: float) -> BallArray:
        """Return the numbers times an integer power of two."""
        return BallArray(self.center * factor, self.radius * abs(factor))

    def transpose(self) -> BallArray:
        """Return the transposed matrices."""
        return BallArray(self.center.swapaxes(-1, -2), self.radius.swapaxes(-1, -2))

    def part(self, index: tuple[slice | int | None, ...]) -> BallArray:
        """Return a part of each matrix."""
        return BallArray(self.center[(..., *index)], self.radius[(..., *index)])


def _rounded_up(radius: Array, size: Array) -> Array:
    """Return a radius with the rounding of results of a size, and of the radius itself."""
    return radius * (1 + RELATIVE_ROUNDING) + RELATIVE_ROUNDING * np.abs(size) + 1e-300


def _dot(a: BallArray, b: BallArray) -> BallArray:
    """Return scalar products (k,) of vectors (k, m, 1)."""
    return (a.transpose() @ b).part((0, 0))


def _is_disjoint(a: BallArray, b: BallArray) -> Bools:
    difference = a - b
    return np.abs(difference.center) > difference.radius


class FrameBalls(NamedTuple):
    """Rotations (k, 3, 3) and origins (k, 3, 1) of frames."""

    rotation: BallArray
    origin: BallArray

    def compose(self, other: FrameBalls) -> FrameBalls:
        """Return the frames `other`, given in these frames."""
        return FrameBalls(
            self.rotation @ other.rotation, self.rotation @ other.origin + self.origin
        )

    def inverse(self) -> FrameBalls:
        """Return the inverse transforms."""
        rotation = self.rotation.transpose()
        return FrameBalls(rotation, (rotation @ self.origin).scale(-1.0))


class JointChain:
    """The joints of an arm, with frames whose z axis is the joint's axis.

    Attributes:
        links: Transform from the frame of each joint to the next, at position zero: the first one
            from the base, the last one to the palm.
        lower: (n,) lower limits [rad]; a joint with a full turn has -pi.
        upper: (n,) upper limits [rad].
    """

    def __init__(self, robot: RobotDescription, enforce_limits: bool = True) -> None:
        """Read the joints between the base and the palm from the description."""
        pose, axes, poses, limits = np.eye(4), [], [], []
        names = [robot.actuator_names[i] for i in robot.arm_actuators]
        lower, upper = (dict(zip(robot.actuator_names, side, strict=True)) for side in
                        robot.actuator_limits)  # fmt: skip
        for joint in robot.chain(robot.palm_link):
            pose = pose @ joint.placement
            if joint.type == "fixed":
                continue
            if joint.type != "revolute" or joint.name not in names:
                raise UnsupportedError(
                    f"robot {robot.name!r}: joint {joint.name!r} is not checked; "
                    "expected a revolute joint with a motor"
                )
            poses.append(pose)
            axes.append(pose[:3, :3] @ (joint.axis / np.linalg.norm(joint.axis)))
            low, high = max(joint.lower, lower[joint.name]), min(joint.upper, upper[joint.name])
            is_full_turn = not enforce_limits or high - low >= 2 * np.pi
            limits.append((-np.pi, np.pi) if is_full_turn else (low, high))
        self.lower, self.upper = np.array(limits).T
        points = _axis_points(np.array([pose[:3, 3] for pose in poses]), np.array(axes))
        frames = [np.eye(4)]
        for pose_of_joint, axis, point in zip(poses, axes, points, strict=True):
            frame = np.eye(4)
            helper = pose_of_joint[:3, int(np.argmin(np.abs(pose_of_joint[:3, :3].T @ axis)))]
            x = helper - axis * (axis @ helper)
            x /= np.linalg.norm(x)
            frame[:3, :3] = np.column_stack([x, np.cross(axis, x), axis])
            frame[:3, 3] = point
            frames.append(frame)
        frames.append(pose @ robot.palm_placement)
        self.links = [
            pose_frames(np.linalg.inv(first) @ second, DESCRIPTION_ERROR)
            for first, second in pairwise(frames)
        ]

    def palm(self, q: Array) -> FrameBalls:
        """Return the palm of configurations (k, n) [rad]."""
        pose = self.links[0]
        for i, link in enumerate(self.links[1:]):
            turn = _rotations_about_z(q[:, i], q[:, i])
            pose = pose.compose(turn).compose(link)
        return pose

    def is_reached(self, palm: Array, q: Array, radius: float) -> bool:
        """Return True if a configuration (n,) within limits reaches a palm pose (4, 4).

        Args:
            palm: Palm pose in the base frame.
            q: Joint positions [rad].
            radius: Accepted deviation of each coordinate [m] and each element of the rotation.
        """
        offset = q - (self.lower + self.upper) / 2
        is_turning = self.upper - self.lower >= 2 * np.pi
        is_within = is_turning | (np.abs(offset) <= (self.upper - self.lower) / 2 + LIMIT_ROUNDING)
        difference = [
            np.abs(side.center - exact) + side.radius
            for side, exact in zip(self.palm(q[None]), (palm[:3, :3], palm[:3, 3:]), strict=True)
        ]
        return bool(is_within.all()) and all((part <= radius).all() for part in difference)

    def is_refuted(
        self,
        palm: Array,
        position_radius: float,
        rotation_radius: float,
        max_boxes: int = MAX_BOXES,
    ) -> bool:
        """Return True if no configuration within limits reaches a palm pose (4, 4).

        Args:
            palm: Palm pose in the base frame.
            position_radius: Deviation of each coordinate of the palm that is included [m].
            rotation_radius: Deviation of each element of its rotation that is included.
            max_boxes: Number of boxes after which the palm pose is not refuted.
        """
        parameters = CHECK_PARAMETERS
        target = pose_frames(palm, position_radius, rotation_radius)
        lower, upper, _ = self.contract(self.lower[None], self.upper[None], target)
        count = 0
        while len(lower):
            trial = slice(0, parameters.trial_boxes)
            joint = self._best_division(lower[trial], upper[trial], target)
            lower, upper = _divide(lower, upper, joint, parameters.parts)
            count += len(lower)
            if count > max_boxes:
                return False
            lower, upper, _ = self.contract(lower, upper, target)
        return True

    def _best_division(self, lower: Array, upper: Array, target: FrameBalls) -> int:
        """Return the joint whose division leaves the smallest volume of boxes."""
        n = len(self.lower)
        divided = [_divide(lower, upper, joint, CHECK_PARAMETERS.parts) for joint in range(n)]
        count = len(divided[0][0])
        lows, highs, rows = self.contract(
            np.concatenate([low for low, _ in divided]),
            np.concatenate([high for _, high in divided]),
            target,
        )
        size = (highs - lows) / (self.upper - self.lower) + 1e-6
        volume = np.bincount(rows // count, np.prod(size, axis=1), minlength=n)
        # Equal volumes: the widest joint.
        width = ((upper - lower) / (self.upper - self.lower)).mean(axis=0)
        return int(np.lexsort((-width, np.round(np.log(volume + 1e-300), 1)))[0])

    def contract(self, lower: Array, upper: Array, target: FrameBalls) -> tuple[Array, Array, Rows]:
        """Return the contracted boxes that are not refuted, and their row numbers."""
        rows = np.arange(len(lower))
        for _ in range(CHECK_PARAMETERS.passes):
            if not len(rows):
                break
            lower, upper = lower.copy(), upper.copy()
            is_empty = self._compare_axes(lower, upper, target) | (lower > upper).any(axis=1)
            lower, upper, rows = lower[~is_empty], upper[~is_empty], rows[~is_empty]
        return lower, upper, rows

    def _compare_axes(self, lower: Array, upper: Array, target: FrameBalls) -> Bools:
        """Contract boxes in place by all pairs of joints; return (k,) True where refuted."""
        n = len(self.lower)
        rotations = [_rotations_about_z(lower[:, i], upper[:, i]) for i in range(n)]
        from_base, from_palm = [self.links[0]], [target.compose(self.links[-1].inverse())]
        for i in range(n - 1):
            from_base.append(from_base[i].compose(rotations[i]).compose(self.links[i + 1]))
            back = rotations[n - 1 - i].inverse().compose(self.links[n - 1 - i].inverse())
            from_palm.append(from_palm[i].compose(back))
        from_palm.reverse()
        is_refuted = np.zeros(len(lower), dtype=bool)
        for j in range(n):
            # Pose of joint j in the frame of joint i, its inverse, and the squared distance.
            between = pose_frames(np.eye(4), 0.0)
            inverse_origin = between.origin
            squared = BallArray(np.zeros(1), np.zeros(1))
            for i in range(j, -1, -1):
                if i < j:
                    link, turn = self.links[i + 1], rotations[i + 1]
                    if i + 1 == j:
                        turn = pose_frames(np.eye(4), 0.0)
                    offset = link.rotation.transpose() @ link.origin
                    turned_back = turn.rotation.transpose() @ offset
                    squared = (
                        squared
                        + _dot(offset, offset)
                        + _dot(turned_back, between.origin).scale(2.0)
                    )
                    inverse_origin = inverse_origin - (between.rotation.transpose() @ turned_back)
                    between = link.compose(turn).compose(between)
                base, palm = from_base[i], from_palm[j]
                distance = palm.origin - base.origin
                axes = (
                    base.rotation.part((slice(None), slice(2, 3))),
                    palm.rotation.part((slice(None), slice(2, 3))),
                )
                is_refuted |= _is_disjoint(_dot(*axes), between.rotation.part((2, 2)))
                is_refuted |= _is_disjoint(_dot(axes[0], distance), between.origin.part((2, 0)))
                is_refuted |= _is_disjoint(
                    _dot(axes[1], distance), inverse_origin.part((2, 0)).scale(-1.0)
                )
                is_refuted |= _is_disjoint(_dot(distance, distance), squared)
                to_base, to_palm = base.rotation.transpose(), palm.rotation.transpose()
                if i == j:
                    relative = to_base @ palm.rotation
                    unit = pose_frames(np.eye(4), 0.0).rotation
                    first = slice(0, 1)
                    _limit_angle(lower, upper, i, unit.part((slice(None), first)),
                                 relative.part((slice(None), first)))  # fmt: skip
                    continue
                axis = between.rotation.part((slice(None), slice(2, 3)))
                _limit_angle(lower, upper, i, axis, to_base @ axes[1])
                _limit_angle(lower, upper, i, between.origin, to_base @ distance)
                axis = between.rotation.transpose().part((slice(None), slice(2, 3)))
                _limit_angle(lower, upper, j, to_palm @ axes[0], axis)
                _limit_angle(lower, upper, j, (to_palm @ distance).scale(-1.0), inverse_origin)
        return is_refuted


def pose_frames(
    pose: Array, origin_radius: float, rotation_radius: float | None = None
) -> FrameBalls:
    """Return the frame of a pose (4, 4) with radii of its origin and rotation."""
    radius = origin_radius if rotation_radius is None else rotation_radius
    return FrameBalls(
        BallArray(pose[None, :3, :3], np.full((1, 3, 3), radius)),
        BallArray(pose[None, :3, 3:], np.full((1, 3, 1), origin_radius)),
    )


def _axis_points(points: Array, axes: Array) -> Array:
    """Return the point of each axis that is nearest to the next axis (or the previous one)."""
    result = points.copy()
    n = len(points)
    for i in range(n):
        for k in (i + 1, i - 1):
            if not 0 <= k < n:
                continue
            normal = np.cross(axes[i], axes[k])
            if np.linalg.norm(normal) > PARALLEL_SINE:
                other_normal = np.cross(axes[k], normal)
                step = (points[k] - points[i]) @ other_normal / (axes[i] @ other_normal)
                result[i] = points[i] + step * axes[i]
                break
        else:
            if i:
                result[i] = points[i] + axes[i] * (axes[i] @ (result[i - 1] - points[i]))
    return result


def _rotations_about_z(lower: Array, upper: Array) -> FrameBalls:
    """Return rotations about z by angles in intervals [rad]."""
    cosine = _cosine(lower, upper)
    sine = _cosine(lower - np.pi / 2, upper - np.pi / 2)
    center, radius = np.zeros((2, len(lower), 3, 3))
    for matrix, c, s, sign in (
        (center, cosine.center, sine.center, -1.0),
        (radius, cosine.radius, sine.radius, 1.0),
    ):
        matrix[:, 0, 0] = matrix[:, 1, 1] = c
        matrix[:, 1, 0], matrix[:, 0, 1] = s, sign * s
    center[:, 2, 2] = 1.0
    zero = np.zeros((1, 3, 1))
    return FrameBalls(BallArray(center, radius), BallArray(zero, zero))


def _cosine(lower: Array, upper: Array) -> BallArray:
    """Return the cosines of angles in intervals of at most a few turns [rad]."""
    cosines = np.cos(lower), np.cos(upper)
    low, high = np.minimum(*cosines), np.maximum(*cosines)
    for extreme, shift in ((1.0, 0.0), (-1.0, np.pi)):
        cycles = np.floor((upper - shift + 1e-9) / (2 * np.pi))
        has_extreme = cycles * (2 * np.pi) + shift >= lower - 1e-9
        if extreme > 0:
            high = np.where(has_extreme, 1.0, high)
        else:
            low = np.where(has_extreme, -1.0, low)
    return BallArray((low + high) / 2, (high - low) / 2 + ELEMENTARY_ERROR)


def _limit_angle(lower: Array, upper: Array, joint: int, start: BallArray, end: BallArray) -> None:
    """Intersect intervals of a joint with the angles about z from vectors to vectors, in place."""
    x, y = (start.part((slice(i, i + 1), slice(None))) for i in (0, 1))
    end_x, end_y = (end.part((slice(i, i + 1), slice(None))) for i in (0, 1))
    cosine = (x @ end_x + y @ end_y).part((0, 0))
    sine = (x @ end_y - y @ end_x).part((0, 0))
    length = np.hypot(cosine.center, sine.center)
    error = np.hypot(cosine.radius, sine.radius) * (1 + RELATIVE_ROUNDING)
    ratio = np.minimum(error / np.maximum(length, 1e-300), 1.0)
    width = np.arcsin(ratio) + 1e-12
    middle = (lower[:, joint] + upper[:, joint]) / 2
    offset = np.arctan2(sine.center, cosine.center) - middle
    offset -= 2 * np.pi * np.round(offset / (2 * np.pi))
    # Near half a turn from the middle the angles are at both ends of the interval.
    is_known = (ratio < 0.999) & (np.abs(offset) + width < np.pi - 1e-9)
    low, high = middle + offset - width, middle + offset + width
    lower[:, joint] = np.where(is_known, np.maximum(lower[:, joint], low), lower[:, joint])
    upper[:, joint] = np.where(is_known, np.minimum(upper[:, joint], high), upper[:, joint])


def _divide(lower: Array, upper: Array, joint: int, parts: int) -> tuple[Array, Array]:
    """Return boxes with the interval of a joint divided into equal parts."""
    edges = np.linspace(lower[:, joint], upper[:, joint], parts + 1, axis=1)
    low, high = np.repeat(lower, parts, axis=0), np.repeat(upper, parts, axis=0)
    low[:, joint], high[:, joint] = edges[:, :-1].ravel(), edges[:, 1:].ravel()
    return low, high
