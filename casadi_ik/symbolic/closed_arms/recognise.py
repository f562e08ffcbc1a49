"""Which closed form an arm has, from its screws alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_arms.form import EXACT, ClosedForm, SphericalEnd
from casadi_ik.symbolic.closed_arms.parallel import ParallelTriple
from casadi_ik.symbolic.closed_arms.passing import PassingArm
from casadi_ik.symbolic.closed_arms.screws import (
    Screws,
    arm_screws,
    divergence,
    meeting_point,
    obliqueness,
)
from casadi_ik.symbolic.closed_arms.spherical import MeetingAxes, ParallelPair, SphericalArm
from casadi_ik.symbolic.srs_arm import SrsArm, srs_arm

NEAR = 1e-2
"""How far an arm may be from the ideal one [m and rad]: what is left is for steps of Newton's."""

APART = 1e-2
"""Links [m] and angles [rad] below which an arm is too degenerate to be solved like this."""

LEFT = 1e-3
"""How far [m and rad] the search for the turn of a joint off a sphere may end from it."""


ArmForm: TypeAlias = SrsArm | ClosedForm
"""An arm whose joints follow from a palm pose."""


def arm_form(robot: RobotDescription) -> ArmForm | None:
    """The form that a robot's arm is solved in, None if it has to be searched."""
    for form in (srs_arm, closed_form):
        try:
            return form(robot)
        except UnsupportedError:
            continue
    return None


def closed_form(robot: RobotDescription) -> ClosedForm:
    """The closed form of a robot's arm, the exact one if there are several.

    Raises:
        UnsupportedError: None is known for it; the message says what was looked for.
    """
    return form_of_screws(robot.name, arm_screws(robot))


def form_of_screws(name: str, screws: Screws) -> ClosedForm:
    """The same of its screws.

    Raises:
        UnsupportedError: None is known.
    """
    found = recognised(screws) or passing(screws)
    if found is None:
        raise UnsupportedError(
            f"robot {name!r}: the arm has no closed form: found no three axes that meet at "
            "one of its ends, with two more that meet or are parallel, nor three parallel ones"
        )
    return found


def recognised(screws: Screws) -> ClosedForm | None:
    """The closed form of a chain, or None."""
    if len(screws) not in (6, 7):
        return None
    swept = len(screws) == 7
    tried: Sequence[Callable[[Screws, bool], ClosedForm | None]]
    tried = (_meeting, _parallel_pair) if swept else (_meeting, _parallel_pair, _parallel_triple)
    found = [
        form
        for chain in (screws, screws.reversed())
        for recognise in tried
        if (form := recognise(chain, swept)) is not None and form.off <= NEAR
    ]
    # Of forms that are exact the first: the fewest operations.
    return min(found, key=lambda form: 0.0 if form.exact else form.off, default=None)


def passing(screws: Screws) -> PassingArm | None:
    """The form of a chain whose last axis passes by where the two before it meet, or None."""
    if len(screws) not in (6, 7):
        return None
    swept, found = len(screws) == 7, []
    for chain in (screws, screws.reversed()):
        *_, fifth, sixth = _places(swept)
        point, passes = meeting_point(chain, (fifth - 1, fifth))
        if passes > EXACT:
            continue
        away, axis = chain.points[sixth] - point, chain.axes[sixth]
        aside = away - axis * (axis @ away)
        beside = _through(chain, (sixth,), point)
        for recognise in (_meeting, _parallel_pair):
            ideal = recognise(beside, swept)
            if ideal is not None and ideal.exact:
                found.append(PassingArm(chain, swept, LEFT, ideal, aside))
    return min(found, key=lambda form: float(np.linalg.norm(form.aside)), default=None)


def _meeting(screws: Screws, swept: bool) -> SphericalArm | None:
    first, second, third, *_ = _places(swept)
    end = _spherical_end(screws, swept)
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
    end = _spherical_end(screws, swept)
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


def _parallel_triple(screws: Screws, swept: bool) -> ClosedForm | None:
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


def _spherical_end(screws: Screws, swept: bool) -> tuple[Screws, SphericalEnd, float] | None:
    """The sphere at the end of a chain, the chain with an ideal one, and how far it was off."""
    places = _places(swept)[3:]
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
    frame = np.column_stack([x, y, z])
    return ideal, SphericalEnd(places, point, frame, offset), max(passes, oblique)


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
