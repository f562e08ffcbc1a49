"""What a contact can ask of a fingertip: a row of `CONDITIONS` each, and one definition of each.

A contact asks for a place (at a point, anywhere on a line or a plane) and for a facing (a normal,
a whole frame); either may be left out. What it asks is the contact's kind. All conditions of one
aspect are told by one error: the distance from the place [m], the angle from the facing [rad].

Each condition is there in two forms. As differences of vectors (`residual`, `jacobian`) it is
polynomial in the vectors, its length the distance or the chord 2 sin(angle / 2), and it has no
false zero at a half turn: the form for least squares. As a rotation vector (`error`, `across`) it
is what Newton's method on the angle needs.

The verdict (`problem.verdict`) and the method `ipopt` have formulas of their own, on purpose:
they are what this file is checked against.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import sqrt

import casadi as ca

from casadi_ik.symbolic.directions import angle_between, normal_error, perpendicular
from casadi_ik.symbolic.smooth import Expr, safe_norm
from casadi_ik.symbolic.so3 import log_so3, skew

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like the normals' (unit vectors)."""

PLACE, FACING = "place", "facing"
"""The two aspects of a contact; the order of the columns of all weights (f, 2)."""

Vectors = Mapping[str, Expr]
"""Vectors (3, 1) by name, in one common frame.

Of a fingertip "point" [m] and the unit vectors "normal" and "tangent"; of a target the `data` of
its conditions.
"""

Rates = Mapping[str, Expr]
"""Their Jacobians (3, k)."""


@dataclass(frozen=True, eq=False)
class Condition:
    """One thing that a contact can ask.

    Attributes:
        name: Unique name.
        aspect: `PLACE` or `FACING`.
        data: Names of the target's vectors that it needs.
        rows: Of the residual.
        residual: ``(tip, goal) -> (rows, 1)`` in metres, or in chords.
        jacobian: ``(tip, tip_rates, goal, goal_rates) -> (rows, k)`` of the residual.
        error: ``(tip, goal) -> (3, 1)`` what is left, from the tip to the goal [m], or the rotation
            vector [rad].
        across: ``(tip, goal) -> (m, 3)`` directions in which it asks something; None: in all
            three. With the rows of the geometric Jacobian it gives those of the error at the goal.
        measure: ``(tip, goal) ->`` distance [m] or angle [rad].
    """

    name: str
    aspect: str
    data: tuple[str, ...]
    rows: int
    residual: Callable[[Vectors, Vectors], Expr]
    jacobian: Callable[[Vectors, Rates, Vectors, Rates], Expr]
    error: Callable[[Vectors, Vectors], Expr]
    across: Callable[[Vectors, Vectors], Expr] | None
    measure: Callable[[Vectors, Vectors], Expr]


def _beside(tip: Vectors, goal: Vectors) -> Expr:
    """From the goal's point to the tip's."""
    return tip["point"] - goal["point"]


def _off_line(tip: Vectors, goal: Vectors) -> Expr:
    return ca.cross(goal["line"], _beside(tip, goal))


def _off_line_rates(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    moved = skew(goal["line"]) @ (tip_rates["point"] - goal_rates["point"])
    return moved - skew(_beside(tip, goal)) @ goal_rates["line"]


def _off_plane(tip: Vectors, goal: Vectors) -> Expr:
    return ca.dot(goal["plane"], _beside(tip, goal))


def _off_plane_rates(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    moved = goal["plane"].T @ (tip_rates["point"] - goal_rates["point"])
    return moved + _beside(tip, goal).T @ goal_rates["plane"]


def _back_to_line(tip: Vectors, goal: Vectors) -> Expr:
    along = goal["line"]
    return along * ca.dot(along, _beside(tip, goal)) - _beside(tip, goal)


def _around(direction: Expr) -> Expr:
    """Two directions (2, 3) across a unit vector."""
    first = perpendicular(direction)
    return ca.horzcat(first, ca.cross(direction, first)).T


def _axes(vectors: Vectors) -> Expr:
    """The contact frame (3, 3): normal, tangent, and what is orthogonal to both."""
    normal, tangent = vectors["normal"], vectors["tangent"]
    return ca.horzcat(normal, tangent, ca.cross(normal, tangent))


def _axis_rates(vectors: Vectors, rates: Rates) -> list[Expr]:
    third = skew(vectors["normal"]) @ rates["tangent"] - skew(vectors["tangent"]) @ rates["normal"]
    return [rates["normal"], rates["tangent"], third]


def _axis_weights(goal: Vectors) -> list[Expr]:
    """Of the three axes.

    Half the squares of all three differences is 4 sin(angle / 2)^2, as the square of one axis is
    for a turn across it: so a frame weighs like a normal, about whatever axis it is turned. A goal
    whose tangent is zero asks for its normal alone.
    """
    known = _has_tangent(goal)
    others = ca.if_else(known, sqrt(0.5), 0.0)
    return [ca.if_else(known, sqrt(0.5), 1.0), others, others]


def _has_tangent(goal: Vectors) -> Expr:
    return ca.sumsqr(goal["tangent"]) > 0.5


def _frame_residual(tip: Vectors, goal: Vectors) -> Expr:
    apart = _axes(tip) - _axes(goal)
    return ca.vertcat(*(w * apart[:, i] for i, w in enumerate(_axis_weights(goal))))


def _frame_jacobian(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    pairs = zip(_axis_rates(tip, tip_rates), _axis_rates(goal, goal_rates), strict=True)
    apart = [of_tip - of_goal for of_tip, of_goal in pairs]
    return ca.vertcat(*(w * rows for w, rows in zip(_axis_weights(goal), apart, strict=True)))


def _frame_error(tip: Vectors, goal: Vectors) -> Expr:
    turned = log_so3(_axes(goal) @ _axes(tip).T)
    return ca.if_else(_has_tangent(goal), turned, normal_error(tip["normal"], goal["normal"]))


def _frame_across(tip: Vectors, goal: Vectors) -> Expr:
    """Every direction; without a tangent all but the normal's."""
    free = ca.if_else(_has_tangent(goal), 0.0, 1.0)
    return ca.DM.eye(3) - free * (tip["normal"] @ tip["normal"].T)


CONDITIONS: dict[str, Condition] = {
    condition.name: condition
    for condition in (
        Condition(
            "point",
            PLACE,
            ("point",),
            3,
            _beside,
            lambda _tip, tip_rates, _goal, goal_rates: tip_rates["point"] - goal_rates["point"],
            lambda tip, goal: goal["point"] - tip["point"],
            None,
            lambda tip, goal: safe_norm(goal["point"] - tip["point"]),
        ),
        Condition(
            "line",
            PLACE,
            ("point", "line"),
            3,
            _off_line,
            _off_line_rates,
            _back_to_line,
            lambda _tip, goal: _around(goal["line"]),
            lambda tip, goal: safe_norm(_off_line(tip, goal)),
        ),
        Condition(
            "plane",
            PLACE,
            ("point", "plane"),
            1,
            _off_plane,
            _off_plane_rates,
            lambda tip, goal: -goal["plane"] * _off_plane(tip, goal),
            lambda _tip, goal: goal["plane"].T,
            lambda tip, goal: ca.fabs(_off_plane(tip, goal)),
        ),
        Condition(
            "normal",
            FACING,
            ("normal",),
            3,
            lambda tip, goal: tip["normal"] - goal["normal"],
            lambda _tip, tip_rates, _goal, goal_rates: tip_rates["normal"] - goal_rates["normal"],
            lambda tip, goal: normal_error(tip["normal"], goal["normal"]),
            lambda tip, _goal: _around(tip["normal"]),
            lambda tip, goal: angle_between(tip["normal"], goal["normal"]),
        ),
        Condition(
            "frame",
            FACING,
            ("normal", "tangent"),
            9,
            _frame_residual,
            _frame_jacobian,
            _frame_error,
            _frame_across,
            lambda tip, goal: safe_norm(_frame_error(tip, goal)),
        ),
    )
}
"""What can be asked. To add a condition, add a row; if it needs new data, see `grasps.grasp`."""
