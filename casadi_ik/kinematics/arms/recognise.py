"""The registry of families: which of them an arm is of, from its screws alone.

This is the one place that knows the families. They are tried in this order:

1. spherical shoulder and wrist (S-R-S), exact;
2. six joints, or seven with one swept: spherical wrist or shoulder with two axes that meet or are
   parallel, or three parallel axes; the exact one of several, else the one with the least model
   error, to be polished by Newton's steps;
3. offset wrist: the last axis passes by where the two before it meet;
4. locked joints: a stretch of seven or six joints is of one of these families.

What is of none is searched by damped steps (`kinematics.palm`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import ArmFamily, Sphere
from casadi_ik.kinematics.arms.locked_joints import LockedJointArm, in_words, part
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
from casadi_ik.model.description import RobotDescription

MEETING = 1e-9
"""How far axes of an exact arm pass each other [m], or are off perpendicular [rad]."""

NEAR = 1e-2
"""Largest model error [m and rad]: what is left is for Newton's steps."""

APART = 1e-2
"""Links [m] and angles [rad] below which an arm is too degenerate to be solved like this."""


def arm_family(robot: RobotDescription) -> ArmFamily | None:
    """The family of a robot's arm, None if it has to be searched."""
    try:
        screws = arm_screws(robot)
    except UnsupportedError:
        return None
    return family_of(screws) or _locked(screws)


def family_of(screws: Screws) -> ArmFamily | None:
    """The family of a chain none of whose joints is locked."""
    for recognise in FAMILIES:
        found = recognise(screws)
        if found is not None:
            return found
    return None


def srs_arm(robot: RobotDescription) -> SrsArm | None:
    """A robot's arm if it is an S-R-S arm."""
    try:
        return _srs(arm_screws(robot))
    except UnsupportedError:
        return None


def is_searched(robot: RobotDescription) -> bool:
    """Whether a robot has an arm of no family."""
    return bool(robot.arm_actuators) and arm_family(robot) is None


def family_in_words(robot: RobotDescription) -> str:
    """What a robot's arm is, for a reader."""
    if not robot.arm_actuators:
        return "no arm"
    family = arm_family(robot)
    return "none, searched" if family is None else in_words(family)


def _locked(screws: Screws) -> LockedJointArm | None:
    """As few joints as possible are locked, rather the last ones than the first.

    Rather so that the family needs no search of its own.
    """
    count = len(screws)
    for length in (7, 6):
        for recognise in FAMILIES:
            for first in range(count - length + 1 if count > length else 0):
                solved = tuple(range(first, first + length))
                inner = recognise(part(screws, solved))
                if inner is not None:
                    locked = tuple(joint for joint in range(count) if joint not in solved)
                    return LockedJointArm(inner, screws, solved, locked)
    return None


def _srs(screws: Screws) -> SrsArm | None:
    """Exact S-R-S arms only."""
    if len(screws) != 7:
        return None
    ends = [_sphere(screws, places) for places in ((0, 1, 2), (4, 5, 6))]
    # The elbow point is where axis 4 is closest to the lines of axes 3 and 5: on both links.
    elbow, passes = meeting_point(screws, (2, 3, 4))
    if passes > MEETING or any(end is None or end[2] > MEETING for end in ends):
        return None
    shoulder, wrist = (end[1] for end in ends if end is not None)
    for link in (elbow - shoulder.point, wrist.point - elbow):
        if abs(link @ screws.axes[3]) > MEETING or np.linalg.norm(link) < 1e-6:
            return None
    return SrsArm(screws, elbow, shoulder, wrist)


def _six(screws: Screws) -> SixJoints | None:
    """The one with the least model error."""
    if len(screws) not in (6, 7):
        return None
    swept = len(screws) == 7
    tried: Sequence[Callable[[Screws, bool], SixJoints | None]]
    tried = (_meeting, _parallel_pair) if swept else (_meeting, _parallel_pair, _parallel_triple)
    found = [
        family
        for chain in (screws, screws.reversed())
        for recognise in tried
        if (family := recognise(chain, swept)) is not None and family.model_error <= NEAR
    ]
    # Of those that are exact the first: the fewest operations.
    return min(found, key=lambda one: 0.0 if one.exact else one.model_error, default=None)


def _offset_wrist(screws: Screws) -> OffsetWristArm | None:
    """Of two the one with the smaller offset."""
    if len(screws) not in (6, 7):
        return None
    swept, found = len(screws) == 7, []
    for chain in (screws, screws.reversed()):
        *_, fifth, sixth = _places(swept)
        point, passes = meeting_point(chain, (fifth - 1, fifth))
        if passes > MEETING:
            continue
        away, axis = chain.points[sixth] - point, chain.axes[sixth]
        offset = away - axis * (axis @ away)
        beside = _through(chain, (sixth,), point)
        for recognise in (_meeting, _parallel_pair):
            ideal = recognise(beside, swept)
            if ideal is not None and ideal.exact:
                found.append(OffsetWristArm(chain, ideal, offset))
    return min(found, key=lambda one: float(np.linalg.norm(one.offset)), default=None)


FAMILIES: tuple[Callable[[Screws], ArmFamily | None], ...] = (_srs, _six, _offset_wrist)
"""What recognises each family, in the order in which they are tried."""


def _meeting(screws: Screws, swept: bool) -> SphericalArm | None:
    first, second, third, *_ = _places(swept)
    end = _sphere(screws, _places(swept)[3:])
    if end is None or divergence(screws, first, second) < APART:
        return None
    screws, sphere, off = end
    shoulder, passes = meeting_point(screws, (first, second))
    screws = _through(screws, (first, second), shoulder)
    swing = np.cross(screws.axes[third], sphere.point - screws.points[third])
    away = np.cross(screws.axes[third], shoulder - screws.points[third])
    if min(np.linalg.norm(swing), np.linalg.norm(away)) < APART:
        return None
    return MeetingAxes(screws, swept, max(off, passes), sphere, shoulder)


def _parallel_pair(screws: Screws, swept: bool) -> SphericalArm | None:
    first, second, third, *_ = _places(swept)
    end = _sphere(screws, _places(swept)[3:])
    if end is None or divergence(screws, first, second) < APART:
        return None
    screws, sphere, off = end
    lean = divergence(screws, second, third)
    screws = _aligned(screws, second, (third,))
    upper = _across(screws, second, screws.points[third] - screws.points[second])
    fore = _across(screws, second, sphere.point - screws.points[third])
    if min(upper, fore) < APART:
        return None
    return ParallelPair(screws, swept, max(off, lean), sphere)


def _parallel_triple(screws: Screws, swept: bool) -> ParallelTriple | None:
    first, second, third, fourth, fifth, sixth = _places(swept)
    lean = max(divergence(screws, second, place) for place in (third, fourth))
    if lean > NEAR or divergence(screws, first, second) < APART:
        return None
    if min(divergence(screws, fifth, place) for place in (second, sixth)) < APART:
        return None
    screws = _aligned(screws, second, (third, fourth))
    wrist, passes = meeting_point(screws, (fifth, sixth))
    screws = _through(screws, (fifth, sixth), wrist)
    links = (
        screws.points[third] - screws.points[second],
        screws.points[fourth] - screws.points[third],
    )
    if min(_across(screws, second, link) for link in links) < APART:
        return None
    return ParallelTriple(screws, swept, max(lean, passes), wrist)


def _places(swept: bool) -> tuple[int, int, int, int, int, int]:
    first = int(swept)
    return first, first + 1, first + 2, first + 3, first + 4, first + 5


def _sphere(screws: Screws, places: tuple[int, int, int]) -> tuple[Screws, Sphere, float] | None:
    """The sphere of three screws, the chain with an ideal one, and how far it is from that.

    None where they are far from one.
    """
    one, two, three = places
    point, passes = meeting_point(screws, places)
    oblique = max(obliqueness(screws, one, two), obliqueness(screws, two, three))
    if max(passes, oblique) > NEAR:
        return None
    z, y, third = screws.axes[list(places)]
    y = _unit(y - z * (z @ y))
    third = _unit(third - y * (y @ third))
    x = np.cross(y, z).astype(float)
    axes = screws.axes.copy()
    axes[list(places)] = z, y, third
    ideal = _through(replace(screws, axes=axes), places, point)
    offset = float(np.arctan2(third @ x, third @ z))
    sphere = Sphere(places, point, np.column_stack([x, y, z]), offset)
    return ideal, sphere, max(passes, oblique)


def _through(screws: Screws, places: Sequence[int], point: Array) -> Screws:
    """Some axes moved to a point."""
    points = screws.points.copy()
    points[list(places)] = point
    return replace(screws, points=points)


def _aligned(screws: Screws, one: int, others: Sequence[int]) -> Screws:
    """Some axes made parallel to one, each pointing as it did."""
    axes = screws.axes.copy()
    for other in others:
        axes[other] = axes[one] * np.sign(axes[one] @ axes[other])
    return replace(screws, axes=axes)


def _across(screws: Screws, place: int, vector: Array) -> float:
    """Length of a vector across an axis [m]."""
    return float(np.linalg.norm(np.cross(screws.axes[place], vector)))


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
