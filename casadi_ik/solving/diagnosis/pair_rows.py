"""What two contacts keep however the palm is moved: distance, angle, heights, handedness.

Each as a row ``|value - slopes u| <= width``: the value asked for less that of the middle of the
box, the slopes by the coordinates u in [-1, 1], and a width that holds the tolerances, what the
slopes leave out, and the largest effect of u in second order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import casadi as ca

from casadi_ik.solving.diagnosis.box_contacts import BoxContact
from casadi_ik.symbolic.smooth import Expr, safe_norm


@dataclass(frozen=True, eq=False)
class Row:
    """One inequality; `plain` is the width of the same without slopes: |value| <= plain."""

    value: Expr
    slopes: Expr
    width: Expr
    plain: Expr


def pair_rows(a: BoxContact, b: BoxContact) -> Iterator[Row]:
    """The rows of two contacts; all zero where something of them is not asked for."""
    asked, here = b.target - a.target, b.point - a.point
    G = b.moves - a.moves
    long, short = safe_norm(asked), safe_norm(here)
    most, near, far = _most(G), a.near + b.near, a.radius + b.radius
    both = a.placed * b.placed
    # The norm is convex, so its slope errs to one side only.
    left_out = ca.fmin(most * most / (2 * ca.fmax(short - most, 1e-9)), 2 * most)
    yield _asked(both, long - short, here.T @ G / short, near + left_out, far)
    turning, facing = _most(a.turns), _most(b.turns)
    faced = both * a.faced * b.faced
    cosine = ca.dot(a.facing, b.facing) - ca.dot(a.normal, b.normal)
    yield _asked(
        faced,
        cosine,
        a.normal.T @ b.turns + b.normal.T @ a.turns,
        _product(a.close, b.close) + turning * facing,
        a.chord + b.chord,
    )
    for one, other in ((a, turning), (b, facing)):
        yield _asked(
            both * one.faced,
            ca.dot(one.facing, asked) - ca.dot(one.normal, here),
            one.normal.T @ G + here.T @ one.turns,
            near * (1 + one.close) + one.close * long + other * most,
            far + one.chord * long,
        )
    across, there = ca.cross(a.normal, b.normal), ca.cross(a.facing, b.facing)
    yield _asked(
        faced,
        ca.dot(there, asked) - ca.dot(across, here),
        across.T @ G + ca.cross(b.normal, here).T @ a.turns + ca.cross(here, a.normal).T @ b.turns,
        _product(a.close, b.close) * long
        + (1 + a.close) * (1 + b.close) * near
        + turning * facing * (short + most)
        + (turning + facing) * most,
        far + (a.chord + b.chord) * long,
    )


def _asked(asked: Expr, value: Expr, slopes: Expr, width: Expr, plain: Expr) -> Row:
    return Row(asked * value, asked * slopes, width, plain)


def _product(one: Expr, other: Expr) -> Expr:
    """How far a product of unit vectors is off whose factors are off by so much."""
    return one + other + one * other


def _most(G: Expr) -> Expr:
    """The longest that G u can be with u in [-1, 1]."""
    return sum((safe_norm(G[:, k]) for k in range(G.shape[1])), ca.SX(0))
