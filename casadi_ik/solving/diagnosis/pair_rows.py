"""What two contacts keep however the palm is moved: distance, angle, heights, handedness.

Each as a row ``|value| <= width``: the value asked for less that of the middle of the box, and a
width that holds the tolerances and all that the box lets the contacts move. That is bounded twice,
and the smaller bound taken: by the balls of the contacts, and by the slopes of the value itself,
which see only what changes it. What the slopes leave out are the products of two changes, and
`near` and `close` of the contacts. With unit vectors a, b asked for, a = (n + T u) + r in the frame
of the palm and |r| <= close: products are split so that one factor is what is asked for, whose
length is known.
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
    long, short, far = safe_norm(asked), safe_norm(here), a.radius + b.radius
    both, near = a.placed * b.placed, a.near + b.near
    apart = b.moves - a.moves
    moved = [one + other for one, other in zip(a.moved, b.moved, strict=True)]
    turned = [one + other for one, other in zip(a.turned, b.turned, strict=True)]
    drift, swing_a, swing_b = (_lengths(slopes) for slopes in (apart, a.turns, b.turns))
    line = here / short
    along = ca.fabs(line.T @ apart)
    aside = _lengths(apart - line @ (line.T @ apart))
    most = ca.sqrt((short + ca.sum2(along)) ** 2 + ca.sum2(aside) ** 2) - short
    yield Row(both * (long - short), ca.fmin(far, most + near), moved)
    faced = both * a.faced * b.faced
    cosine = ca.dot(a.facing, b.facing) - ca.dot(a.normal, b.normal)
    sloped = _total(b.normal.T @ a.turns + a.normal.T @ b.turns)
    sloped += ca.sum2(swing_a) * ca.sum2(swing_b) + a.close + b.close + a.close * b.close
    yield Row(faced * cosine, ca.fmin(a.chord + b.chord, sloped), turned)
    for one, swing in ((a, swing_a), (b, swing_b)):
        height = ca.dot(one.facing, asked) - ca.dot(one.normal, here)
        shares = [m + t * long for m, t in zip(moved, one.turned, strict=True)]
        sloped = _total(here.T @ one.turns + one.normal.T @ apart)
        sloped += ca.sum2(swing) * ca.sum2(drift) + one.close * long + (1 + one.close) * near
        yield Row(both * one.faced * height, ca.fmin(far + one.chord * long, sloped), shares)
    across, there = ca.cross(a.normal, b.normal), ca.cross(a.facing, b.facing)
    yield Row(
        faced * (ca.dot(there, asked) - ca.dot(across, here)),
        far + (a.chord + b.chord) * long,
        [m + t * long for m, t in zip(moved, turned, strict=True)],
    )


def _lengths(slopes: Expr) -> Expr:
    """(1, h) lengths of columns."""
    return ca.horzcat(*(safe_norm(slopes[:, k]) for k in range(slopes.shape[1])))


def _total(slopes: Expr) -> Expr:
    """How far slopes (1, h) carry a value within the box."""
    return ca.sum2(ca.fabs(slopes))


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
