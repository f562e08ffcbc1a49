"""Recognition of the family of an arm from its screws.

This is the only module that knows all families. They are tried in this order:

1. spherical shoulder and wrist (S-R-S), exact;
2. six joints, or seven with one swept: spherical wrist or shoulder with two axes that meet or are
   parallel, or three parallel axes; an exact family if there is one, otherwise the one with the
   smallest model error, whose solutions are refined by Newton steps;
3. offset wrist: the last axis misses the intersection of the previous two;
4. locked joints: seven or six consecutive joints belong to one of these families. A hand with a
   wrist turns an arm of seven joints into one of nine: with the wrist locked, the other joints
   belong to their family, for a palm pose that is moved by the wrist.

Arms of no family are solved by damped steps (`kinematics.palm`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import ArmFamily, Redundancy, Score, SphericalJoints
from casadi_ik.kinematics.arms.offset_wrist import OffsetWristArm
from casadi_ik.kinematics.arms.screws import (
    Screws,
    arm_screws,
    divergence,
    meeting_point,
    obliqueness,
)
from casadi_ik.kinematics.arms.six_joints import (
    MeetingAxes,
    ParallelPair,
    ParallelTriple,
    SixJoints,
    SphericalArm,
)
from casadi_ik.kinematics.arms.srs import SrsArm
from casadi_ik.kinematics.forward import axis_rotation
from casadi_ik.kinematics.se3 import Transform, compose, inverse
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True, eq=False)
class LockedJointArm(ArmFamily):
    """An arm that belongs to a family when some of its joints are locked.

    Attributes:
        inner: Family of the solved joints, numbered from 0.
        screws: Screws of the whole arm.
        solved: Consecutive numbers of the solved joints.
        locked: Numbers of the locked joints; they are redundancy parameters of the arm.
    """

    inner: ArmFamily
    screws: Screws
    solved: tuple[int, ...]
    locked: tuple[int, ...]  # type: ignore[misc]

    @property
    def kind(self) -> str:
        """Description of the inner arm, and the locked joints."""
        joints = ", ".join(str(joint + 1) for joint in self.locked)
        return f"{describe_family(self.inner)}, joints {joints} held"

    @property
    def sign_names(self) -> tuple[str, str, str]:
        """Value of the inner arm."""
        return self.inner.sign_names

    @property
    def redundancy(self) -> tuple[Redundancy, ...]:
        """The locked joints, then the redundancy parameters of the inner arm."""
        inner = [
            Redundancy(None if parameter.joint is None else self.solved[parameter.joint])
            for parameter in self.inner.redundancy
        ]
        return (*(Redundancy(joint) for joint in self.locked), *inner)

    @property
    def model_error(self) -> float:  # type: ignore[override]
        """Model error of the inner arm."""
        return self.inner.model_error

    @property
    def rows(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.rows

    @property
    def roots(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.roots

    @property
    def starts(self) -> int:  # type: ignore[override]
        """Value of the inner arm."""
        return self.inner.starts

    def arms(self) -> ca.Function:
        """Value of the inner arm."""
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        locked, free = self._split(redundancy)
        branches, slack = self.inner.arms()(*self._inner_palm()(rotation, origin, locked), free)
        join = self._joined_arm()
        rows = [join(branches[i, :].T, locked).T for i in range(self.rows)]
        return ca.Function("arms", [rotation, origin, redundancy], [ca.vertcat(*rows), slack])

    def best(self, name: str, score: Score) -> ca.Function:
        """Return the function of the best branch of the inner arm; locked joints are not scored."""
        n, solved = len(self.screws), list(self.solved)
        redundancy = ca.MX.sym("redundancy", len(self.redundancy))
        rotation, origin = ca.MX.sym("rotation", 3, 3), ca.MX.sym("origin", 3)
        bounds = [ca.MX.sym(word, n) for word in ("lower", "upper", "near")]
        locked, free = self._split(redundancy)
        inner_palm = self._inner_palm()(rotation, origin, locked)
        best = self.inner.best(f"{name}_inner", score.restrict(solved))
        branches, total = best(free, *inner_palm, *(end[solved] for end in bounds))
        outputs = [self._joined_arm()(branches, locked), total]
        return ca.Function(name, [redundancy, rotation, origin, *bounds], outputs)

    def _split(self, redundancy: Expr) -> tuple[Expr, Expr]:
        """Split the redundancy into locked joints and inner parameters (at least one number)."""
        count = len(self.locked)
        return redundancy[:count], redundancy[count:] if self.inner.redundancy else redundancy[:1]

    def _inner_palm(self) -> ca.Function:
        """Return (rotation, origin, locked joints) -> the palm pose for the solved joints."""
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        angles = ca.SX.sym("locked", len(self.locked))
        indices = range(len(self.locked))
        proximal = [index for index in indices if self.locked[index] < self.solved[0]]
        distal = [index for index in indices if self.locked[index] > self.solved[-1]]
        start: Transform = ca.DM(self.screws.rotation), ca.DM(self.screws.origin)
        motion = compose(self._inverse_motion(proximal, angles), (rotation, origin))
        motion = compose(compose(motion, inverse(start)), self._inverse_motion(distal, angles))
        outputs = [ca.densify(sub_chain) for sub_chain in compose(motion, start)]
        return ca.Function("left", [rotation, origin, angles], outputs)

    def _inverse_motion(self, indices: Sequence[int], angles: Expr) -> Transform:
        """Return the inverse motion of some locked joints."""
        motion: Transform = (ca.SX.eye(3), ca.SX.zeros(3, 1))
        for index in reversed(indices):
            joint = self.locked[index]
            point = ca.DM(self.screws.points[joint])
            turn = axis_rotation(self.screws.axes[joint], -angles[index])
            motion = compose(motion, (turn, point - turn @ point))
        return motion

    def _joined_arm(self) -> ca.Function:
        """Return (solved joints, locked joints) -> all joints of the arm (n, 1)."""
        solved, locked = (
            ca.SX.sym("solved", len(self.solved)),
            ca.SX.sym("locked", len(self.locked)),
        )
        values = dict(zip(self.solved, ca.vertsplit(solved), strict=True))
        values |= dict(zip(self.locked, ca.vertsplit(locked), strict=True))
        return ca.Function(
            "join", [solved, locked], [ca.vertcat(*(v for _, v in sorted(values.items())))]
        )


def describe_family(family: ArmFamily) -> str:
    """Describe an arm in words."""
    is_approximate = not family.is_exact and not family.is_iterative and not family.locked
    return f"nearly {family.kind}" if is_approximate else family.kind


def sub_chain(screws: Screws, indices: Sequence[int]) -> Screws:
    """Return consecutive joints of an arm as an arm."""
    rows = list(indices)
    return replace(
        screws,
        joints=tuple(range(len(rows))),
        axes=np.array(screws.axes[rows]),
        points=np.array(screws.points[rows]),
        lower=np.array(screws.lower[rows]),
        upper=np.array(screws.upper[rows]),
    )


EXACT_TOLERANCE = 1e-9
"""Largest distance between axes that meet [m] and deviation of right angles [rad] of exact arms."""

MAX_MODEL_ERROR = 1e-2
"""Largest model error that Newton steps can remove [m and rad]."""

MIN_LINK = 1e-2
"""Smallest links [m] and angles [rad] of an arm that is not degenerate."""


def arm_family(robot: RobotDescription) -> ArmFamily | None:
    """Return the family of a robot's arm; None if it has none."""
    try:
        screws = arm_screws(robot)
    except UnsupportedError:
        return None
    return family_of(screws) or _locked_joint_family(screws)


def family_of(screws: Screws) -> ArmFamily | None:
    """Return the family of a chain without locked joints; None if it has none."""
    for recognise in FAMILIES:
        family = recognise(screws)
        if family is not None:
            return family
    return None


def srs_arm(robot: RobotDescription) -> SrsArm | None:
    """Return a robot's arm if it is an S-R-S arm, otherwise None."""
    try:
        return _srs(arm_screws(robot))
    except UnsupportedError:
        return None


def is_searched(robot: RobotDescription) -> bool:
    """Return True if a robot has an arm without a family."""
    return bool(robot.arm_actuators) and arm_family(robot) is None


def describe_arm(robot: RobotDescription) -> str:
    """Describe a robot's arm in words."""
    if not robot.arm_actuators:
        return "no arm"
    family = arm_family(robot)
    return "none, searched" if family is None else describe_family(family)


def _locked_joint_family(screws: Screws) -> LockedJointArm | None:
    """Return the family with as few locked joints as possible, preferably the last ones."""
    count = len(screws)
    for length in (7, 6):
        for recognise in FAMILIES:
            for first in range(count - length + 1 if count > length else 0):
                solved = tuple(range(first, first + length))
                inner = recognise(sub_chain(screws, solved))
                if inner is not None:
                    locked = tuple(joint for joint in range(count) if joint not in solved)
                    return LockedJointArm(inner, screws, solved, locked)
    return None


def _srs(screws: Screws) -> SrsArm | None:
    """Recognise an exact S-R-S arm."""
    if len(screws) != 7:
        return None
    spheres = [_sphere(screws, indices) for indices in ((0, 1, 2), (4, 5, 6))]
    # The elbow point is nearest to axes 3, 4 and 5, and lies on both links.
    elbow, miss = meeting_point(screws, (2, 3, 4))
    if miss > EXACT_TOLERANCE or any(end is None or end[2] > EXACT_TOLERANCE for end in spheres):
        return None
    shoulder, wrist = (end[1] for end in spheres if end is not None)
    for link in (elbow - shoulder.point, wrist.point - elbow):
        if abs(link @ screws.axes[3]) > EXACT_TOLERANCE or np.linalg.norm(link) < 1e-6:
            return None
    return SrsArm(screws, elbow, shoulder, wrist)


def _six_joints(screws: Screws) -> SixJoints | None:
    """Recognise the family of six joints with the smallest model error."""
    if len(screws) not in (6, 7):
        return None
    swept = len(screws) == 7
    recognisers: Sequence[Callable[[Screws, bool], SixJoints | None]]
    recognisers = (
        (_meeting, _parallel_pair) if swept else (_meeting, _parallel_pair, _parallel_triple)
    )
    candidates = [
        family
        for chain in (screws, screws.reversed())
        for recognise in recognisers
        if (family := recognise(chain, swept)) is not None and family.model_error <= MAX_MODEL_ERROR
    ]
    # Among exact families the first one needs the fewest operations.
    return min(
        candidates, key=lambda first: 0.0 if first.is_exact else first.model_error, default=None
    )


def _offset_wrist(screws: Screws) -> OffsetWristArm | None:
    """Recognise an offset wrist; of two solutions the one with the smaller offset."""
    if len(screws) not in (6, 7):
        return None
    swept, candidates = len(screws) == 7, []
    for chain in (screws, screws.reversed()):
        *_, fifth, sixth = _indices(swept)
        point, miss = meeting_point(chain, (fifth - 1, fifth))
        if miss > EXACT_TOLERANCE:
            continue
        offset, axis = chain.points[sixth] - point, chain.axes[sixth]
        offset = offset - axis * (axis @ offset)
        nominal = _through(chain, (sixth,), point)
        for recognise in (_meeting, _parallel_pair):
            ideal = recognise(nominal, swept)
            if ideal is not None and ideal.is_exact:
                candidates.append(OffsetWristArm(chain, ideal, offset))
    return min(candidates, key=lambda first: float(np.linalg.norm(first.offset)), default=None)


FAMILIES: tuple[Callable[[Screws], ArmFamily | None], ...] = (_srs, _six_joints, _offset_wrist)
"""Recognition functions of the families, in the order in which they are tried."""


def _meeting(screws: Screws, swept: bool) -> SphericalArm | None:
    first, second, third, *_ = _indices(swept)
    end = _sphere(screws, _indices(swept)[3:])
    if end is None or divergence(screws, first, second) < MIN_LINK:
        return None
    screws, sphere, sphere_error = end
    shoulder, miss = meeting_point(screws, (first, second))
    screws = _through(screws, (first, second), shoulder)
    swing = np.cross(screws.axes[third], sphere.point - screws.points[third])
    offset = np.cross(screws.axes[third], shoulder - screws.points[third])
    if min(np.linalg.norm(swing), np.linalg.norm(offset)) < MIN_LINK:
        return None
    return MeetingAxes(screws, swept, max(sphere_error, miss), sphere, shoulder)


def _parallel_pair(screws: Screws, swept: bool) -> SphericalArm | None:
    first, second, third, *_ = _indices(swept)
    end = _sphere(screws, _indices(swept)[3:])
    if end is None or divergence(screws, first, second) < MIN_LINK:
        return None
    screws, sphere, sphere_error = end
    misalignment = divergence(screws, second, third)
    screws = _aligned(screws, second, (third,))
    upper = _distance_across(screws, second, screws.points[third] - screws.points[second])
    fore = _distance_across(screws, second, sphere.point - screws.points[third])
    if min(upper, fore) < MIN_LINK:
        return None
    return ParallelPair(screws, swept, max(sphere_error, misalignment), sphere)


def _parallel_triple(screws: Screws, swept: bool) -> ParallelTriple | None:
    first, second, third, fourth, fifth, sixth = _indices(swept)
    misalignment = max(divergence(screws, second, index) for index in (third, fourth))
    if misalignment > MAX_MODEL_ERROR or divergence(screws, first, second) < MIN_LINK:
        return None
    if min(divergence(screws, fifth, index) for index in (second, sixth)) < MIN_LINK:
        return None
    screws = _aligned(screws, second, (third, fourth))
    wrist, miss = meeting_point(screws, (fifth, sixth))
    screws = _through(screws, (fifth, sixth), wrist)
    links = (
        screws.points[third] - screws.points[second],
        screws.points[fourth] - screws.points[third],
    )
    if min(_distance_across(screws, second, link) for link in links) < MIN_LINK:
        return None
    return ParallelTriple(screws, swept, max(misalignment, miss), wrist)


def _indices(swept: bool) -> tuple[int, int, int, int, int, int]:
    first = int(swept)
    return first, first + 1, first + 2, first + 3, first + 4, first + 5


def _sphere(
    screws: Screws, indices: tuple[int, int, int]
) -> tuple[Screws, SphericalJoints, float] | None:
    """Return the chain with an ideal spherical joint of three screws, the joint, and its error.

    Returns None if the screws are far from a spherical joint.
    """
    first, two, three = indices
    point, miss = meeting_point(screws, indices)
    oblique = max(obliqueness(screws, first, two), obliqueness(screws, two, three))
    if max(miss, oblique) > MAX_MODEL_ERROR:
        return None
    z, y, third = screws.axes[list(indices)]
    y = _unit(y - z * (z @ y))
    third = _unit(third - y * (y @ third))
    x = np.cross(y, z).astype(float)
    axes = screws.axes.copy()
    axes[list(indices)] = z, y, third
    ideal = _through(replace(screws, axes=axes), indices, point)
    offset = float(np.arctan2(third @ x, third @ z))
    sphere = SphericalJoints(indices, point, np.column_stack([x, y, z]), offset)
    return ideal, sphere, max(miss, oblique)


def _through(screws: Screws, indices: Sequence[int], point: Array) -> Screws:
    """Return screws with some axes moved through a point."""
    points = screws.points.copy()
    points[list(indices)] = point
    return replace(screws, points=points)


def _aligned(screws: Screws, reference: int, indices: Sequence[int]) -> Screws:
    """Return screws with some axes made parallel to a reference axis, keeping their signs."""
    axes = screws.axes.copy()
    for index in indices:
        axes[index] = axes[reference] * np.sign(axes[reference] @ axes[index])
    return replace(screws, axes=axes)


def _distance_across(screws: Screws, index: int, vector: Array) -> float:
    """Return the length of a vector's component perpendicular to an axis [m]."""
    return float(np.linalg.norm(np.cross(screws.axes[index], vector)))


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
