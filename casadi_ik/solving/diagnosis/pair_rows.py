"""What two contacts keep however the palm is moved: distance, angle, heights, handedness.

Each as a row ``|value| <= width``: the value asked for less that of the middle of the box, and a
width that holds the tolerances and all that the box lets the contacts move.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca

from casadi_ik.solving.diagnosis.box_contacts import BoxContact
from casadi_ik.symbolic.smooth import Expr, safe_norm

ROUNDING = 1e-8
"""What cosines are let off by: more than is lost where a sine is taken from one near 1."""


@dataclass(frozen=True, eq=False)
class Row:
    """One inequality; `shares` is what each coordinate adds to its width."""

    value: Expr
    width: Expr
    shares: list[Expr]


def pair_rows(a: BoxContact, b: BoxContact) -> Iterator[Row]:
    """The rows of two contacts; all zero where something of them is not asked for."""
    asked, here = b.target - a.target, b.point - a.point
    long, far = safe_norm(asked), a.radius + b.radius
    both = a.placed * b.placed
    moved = [one + other for one, other in zip(a.moved, b.moved, strict=True)]
    turned = [one + other for one, other in zip(a.turned, b.turned, strict=True)]
    yield Row(both * (long - safe_norm(here)), far, moved)
    faced = both * a.faced * b.faced
    cosine = ca.dot(a.facing, b.facing) - ca.dot(a.normal, b.normal)
    yield Row(faced * cosine, a.chord + b.chord, turned)
    for one in (a, b):
        height = ca.dot(one.facing, asked) - ca.dot(one.normal, here)
        shares = [m + t * long for m, t in zip(moved, one.turned, strict=True)]
        yield Row(both * one.faced * height, far + one.chord * long, shares)
    across, there = ca.cross(a.normal, b.normal), ca.cross(a.facing, b.facing)
    yield Row(
        faced * (ca.dot(there, asked) - ca.dot(across, here)),
        far + (a.chord + b.chord) * long,
        [m + t * long for m, t in zip(moved, turned, strict=True)],
    )


def pair_angles(a: BoxContact, b: BoxContact) -> Iterator[Expr]:
    """Tests > 0 if angles cannot be as asked: of the normals, and of each with the line of points.

    They say more than cosines where the angles are near 0 or half a turn, as of normals that face
    each other.
    """
    asked, here = b.target - a.target, b.point - a.point
    long, short, far = safe_norm(asked), safe_norm(here), a.radius + b.radius
    both, most = a.placed * b.placed, ca.fmax(long, short)
    cosines = ca.dot(a.facing, b.facing), ca.dot(a.normal, b.normal)
    turns = _turn(a.chord), _turn(b.chord)
    yield both * a.faced * b.faced * _apart(cosines, turns)
    # The line between the points turns by no more than asin(far / length), of either length.
    sine = ca.fmin(far / most, 1.0)
    tilt = ca.sqrt(1 - sine * sine), sine
    for one, turn in zip((a, b), turns, strict=True):
        cosines = ca.dot(one.facing, asked) / long, ca.dot(one.normal, here) / short
        test = ca.if_else(far < most, _apart(cosines, (turn, tilt)), -1.0)
        yield both * one.faced * test


def _turn(chord: Expr) -> tuple[Expr, Expr]:
    """Cosine and sine of the angle of a chord, half a turn at most."""
    half = ca.fmin(chord, 2.0) / 2
    return 1 - 2 * half * half, 2 * half * ca.sqrt(ca.fmax(1 - half * half, 0.0))


def _apart(cosines: tuple[Expr, Expr], turns: tuple[tuple[Expr, Expr], tuple[Expr, Expr]]) -> Expr:
    """> 0 if two angles differ by more than the sum of two others (cosine, sine), if < pi."""
    one, other = cosines
    sines = [ca.sqrt(ca.fmax(1 - c * c, 0.0)) for c in cosines]
    (cos_a, sin_a), (cos_b, sin_b) = turns
    widest = cos_a * cos_b - sin_a * sin_b
    excess = widest - ROUNDING - (one * other + sines[0] * sines[1])
    # Both are at most half a turn: their sum is less than that where cosine a > -cosine b.
    return ca.if_else(cos_a + cos_b > ROUNDING, excess, -1.0)
