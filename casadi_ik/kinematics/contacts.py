"""What a contact asks of a fingertip: a row of `CONDITIONS` each, and one definition of each.

A contact asks for a place (at a point, anywhere on a line or a plane, the pad's ball against a
point) and for a facing (a normal, a whole frame); either may be left out. What it asks is the
contact's kind. All conditions of one aspect are told by one error: the distance from the place [m],
the angle from the facing [rad].

Each condition is there in two forms. As differences of vectors (`residual`, `jacobian`) it is
polynomial in the vectors, its length the distance or the chord 2 sin(angle / 2), and it has no
false zero at a half turn: the form for least squares. As a rotation vector (`error`, `across`) it
is what Newton's method on the angle needs.

The verdict (`solve.verdict`) has formulas of its own, on purpose: it is what this file is checked
against.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from math import sqrt
from typing import NamedTuple, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Field
from casadi_ik.errors import InputError, RowError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import ActuatedKinematics, Kinematics
from casadi_ik.kinematics.se3 import angle_between, log_so3, normal_error, perpendicular, skew
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.grasp import (
    EXTRA_VECTORS,
    invalid_mask,
    invalid_reason,
    orthogonal_tangents,
    unit_vectors,
)
from casadi_ik.model.targets import DIRECTIONS_KEY, TargetBatch

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like the normals' (unit vectors)."""

PLACE, FACING = "place", "facing"
"""The two aspects of a contact; the order of the columns of all weights (f, 2)."""

Vectors = Mapping[str, Expr]
"""Vectors (3, 1) by name, in one common frame.

Of a fingertip "point" [m], the unit vectors "normal" and "tangent", and "pad" from the middle of
the pad's ball to the point [m] (zero if it has none); of a target the `data` of its conditions.
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
            three, and the error of a place is minus its residual. With the rows of the geometric
            Jacobian it gives those of the error at the goal.
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


def _off_ball(tip: Vectors, goal: Vectors) -> Expr:
    """From the goal's point to where the pad's ball faces as it does there."""
    radius = ca.dot(tip["pad"], tip["normal"])
    return _beside(tip, goal) - tip["pad"] + radius * goal["ball"]


def _off_ball_rates(tip: Vectors, tip_rates: Rates, _goal: Vectors, goal_rates: Rates) -> Expr:
    radius = ca.dot(tip["pad"], tip["normal"])
    moved = tip_rates["point"] - goal_rates["point"] - tip_rates["pad"]
    return moved + radius * goal_rates["ball"]


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
            "ball",
            PLACE,
            ("point", "ball"),
            3,
            _off_ball,
            _off_ball_rates,
            lambda tip, goal: -_off_ball(tip, goal),
            None,
            lambda tip, goal: safe_norm(_off_ball(tip, goal)),
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
"""What can be asked. To add a condition, add a row; if it needs new data, see `model.grasp`."""


class ContactKind(NamedTuple):
    """A contact's conditions, by name; a weight of zero frees either.

    Point and normal is the usual kind. With weights it is a point alone, or a direction alone.
    """

    place: str = "point"
    facing: str = "normal"

    @property
    def conditions(self) -> tuple[Condition, Condition]:
        """The two of them."""
        return CONDITIONS[self.place], CONDITIONS[self.facing]

    @property
    def data(self) -> tuple[str, ...]:
        """Names of the target's vectors."""
        return tuple(dict.fromkeys(name for row in self.conditions for name in row.data))


USUAL = ContactKind()
"""Point and normal."""

Kinds: TypeAlias = tuple[ContactKind, ...]
"""A kind per finger: what a kernel is built for."""


def usual(f: int) -> Kinds:
    """Point and normal for all of f fingers."""
    return (USUAL,) * f


def suffix(kinds: Kinds) -> str:
    """What the name of a graph for these kinds ends with; nothing for the usual ones."""
    if set(kinds) <= {USUAL}:
        return ""
    return "_" + "_".join(f"{kind.place}{kind.facing}" for kind in kinds)


def kind_of(data: Iterable[str]) -> ContactKind:
    """The kind of a contact that has these vectors beside point and normal."""
    known, asked = set(data), {PLACE: USUAL.place, FACING: USUAL.facing}
    for condition in CONDITIONS.values():
        if not known.isdisjoint(condition.data[1:]):
            asked[condition.aspect] = condition.name
    return ContactKind(asked[PLACE], asked[FACING])


DOCS = {
    "point": "contact points, base frame; 0 if free",
    "normal": "outward pad normals, base frame; 0 if free",
    "tangent": "second axes of the contact frames, base frame; 0 if free",
    "line": "directions of lines through the points, base frame",
    "plane": "normals of planes through the points, base frame",
    "ball": "outward normals of the pads' balls where they touch the points, base frame",
}


@dataclass(frozen=True)
class ContactRows:
    """The contacts of a robot's fingers, each of its kind.

    Rows are ordered by aspect: the places of all fingers, then the facings.

    Attributes:
        kinds: By finger.
    """

    kinds: Kinds

    @cached_property
    def data(self) -> tuple[str, ...]:
        """Names of the vectors that targets have, points and normals first."""
        found = (name for kind in self.kinds for name in kind.data)
        return tuple(dict.fromkeys(("point", "normal", *found)))

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Parameter fields that state the targets."""
        f = len(self.kinds)
        vectors = (
            Field(f"{name}s", (f, 3), unit="m" if name == "point" else "", doc=DOCS[name])
            for name in self.data
        )
        weights = Field("weights", (f, 2), doc="1 where point, normal count, 0 where free")
        return (*vectors, weights)

    @cached_property
    def size(self) -> int:
        """Number of rows of the residual."""
        return sum(condition.rows for kind in self.kinds for condition in kind.conditions)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Rows of the places of all fingers, then of their facings, (2 f,)."""
        sizes = [kind.conditions[aspect].rows for aspect in range(2) for kind in self.kinds]
        ends = accumulate(sizes, initial=0)
        return tuple(slice(*each) for each in pairwise(ends))

    def goals(self, p: dict[str, Expr]) -> list[Vectors]:
        """The targets by finger, base frame.

        Args:
            p: Parameters of `fields`.
        """
        return [
            {name: p[f"{name}s"][i, :].T for name in kind.data} for i, kind in enumerate(self.kinds)
        ]

    def residual(self, tips: Sequence[Vectors], goals: Sequence[Vectors], weights: Expr) -> Expr:
        """Residual (size, 1): places by `LENGTH`, then facings as chords.

        Args:
            tips: The fingertips, in any frame.
            goals: The targets in that frame.
            weights: (f, 2) 1 where place (facing) counts, 0 where it is free.
        """
        rows = [
            [condition.residual(tip, goal) for condition in kind.conditions]
            for kind, tip, goal in zip(self.kinds, tips, goals, strict=True)
        ]
        return _weighted(rows, weights)

    def jacobian(
        self,
        tips: Sequence[Vectors],
        tip_rates: Sequence[Rates],
        goals: Sequence[Vectors],
        goal_rates: Sequence[Rates],
        weights: Expr,
    ) -> Expr:
        """Jacobian (size, k) of `residual` where tips and targets move."""
        rows = [
            [condition.jacobian(*vectors) for condition in kind.conditions]
            for kind, *vectors in zip(self.kinds, tips, tip_rates, goals, goal_rates, strict=True)
        ]
        return _weighted(rows, weights)

    def errors(self, residual: Expr) -> tuple[Expr, Expr]:
        """Distances [m] and chords of a residual, each (f, 1); zero where free."""
        lengths = [ca.norm_2(residual[own]) for own in self.slices]
        f = len(self.kinds)
        return ca.vertcat(*(length * LENGTH for length in lengths[:f])), ca.vertcat(*lengths[f:])


def _weighted(rows: Sequence[Sequence[Expr]], weights: Expr) -> Expr:
    """(place, facing) rows of every finger, the places by `LENGTH`, one below the other."""
    places = [place / LENGTH * weights[i, 0] for i, (place, _) in enumerate(rows)]
    facings = [facing * weights[i, 1] for i, (_, facing) in enumerate(rows)]
    return ca.vertcat(*places, *facings)


def within_tolerance(
    distances: Expr, turns: Expr, position_tolerance: Expr, turn_tolerance: Expr
) -> Expr:
    """Whether every contact is met; boolean.

    Args:
        distances: (f, 1) [m], zero where free.
        turns: (f, 1) angles [rad] or chords, zero where free.
        position_tolerance: (f, 1) [m].
        turn_tolerance: (f, 1) as the turns.
    """
    return ca.logic_and(
        ca.mmax(distances - position_tolerance) <= 0, ca.mmax(turns - turn_tolerance) <= 0
    )


def chord(angle: Expr) -> Expr:
    """Length of the difference of two unit vectors that include an angle [rad]."""
    return 2 * ca.sin(angle / 2)


def tip_vectors(kinematics: Kinematics, finger: str) -> Vectors:
    """Point, normal, tangent and pad of a fingertip, base frame."""
    point, normal = kinematics.contact(finger)
    pad = kinematics.robot.finger(finger).radius * normal
    return {"point": point, "normal": normal, "tangent": kinematics.tangent(finger), "pad": pad}


def tip_rates(body: ActuatedKinematics, finger: str, actuators: Sequence[int]) -> Rates:
    """Their Jacobians (3, k) over some actuators."""
    linear, angular = body.contact_jacobian(finger, actuators)
    turned = {
        name: -skew(axis) @ angular
        for name, axis in tip_vectors(body.kinematics, finger).items()
        if name != "point"
    }
    return {"point": linear, **turned}


def resting(goals: Sequence[Vectors], k: int) -> list[Rates]:
    """The Jacobians of targets that nothing moves."""
    return [dict.fromkeys(goal, ca.SX(3, k)) for goal in goals]


NAMES = tuple(f"{name}s" for name in EXTRA_VECTORS)
"""Names of the arrays."""


def more_arrays(
    more: Mapping[str, ArrayLike | None], points: Array, normals: Array, first_row: int = 0
) -> dict[str, Array]:
    """Checked vectors of a batch.

    Args:
        more: (k, f, 3) by name; NaN where free, None where there is none at all.
        points: (k, f, 3) checked [m].
        normals: (k, f, 3) checked, unit.
        first_row: Number of the first row, for messages.

    Returns:
        Unit vectors (k, f, 3) by name; nothing that is free everywhere.

    Raises:
        UnknownNameError: No such name.
        RowError: A vector that is partly NaN, infinite or zero, or does not go with the others;
            the message names row and finger.
        InputError: Wrong shape, no numbers.
    """
    found: dict[str, Array] = {}
    for name, value in more.items():
        if name not in NAMES:
            raise UnknownNameError(
                f"{name!r} does not exist; expected one of {', '.join((*NAMES, DIRECTIONS_KEY))}"
            )
        if value is None:
            continue
        try:
            array = np.array(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected an array of numbers") from error
        if array.shape != points.shape:
            raise InputError(f"{name}: found shape {array.shape}, expected {points.shape}")
        if not np.isnan(array).all():
            found[name] = array
    if not found:
        return found
    wrong, units = np.zeros(points.shape[:2], dtype=bool), dict[str, Array]()
    for name, array in found.items():
        given = ~np.isnan(array).all(axis=2)
        with np.errstate(invalid="ignore"):
            units[name], zero = unit_vectors(array)
        wrong |= given & (zero | ~np.isfinite(array).all(axis=2))
    vectors = {name[:-1]: array for name, array in units.items()}
    wrong |= invalid_mask({"point": points, "normal": normals, **vectors})
    for row, finger in np.argwhere(wrong)[:1].tolist():
        of_contact = {"points": points, "normals": normals, **found}
        problem = _problem({name: array[row, finger] for name, array in of_contact.items()})
        raise RowError(f"row {first_row + row}, finger {finger}: {problem}", first_row + row)
    if "tangents" in units:
        units["tangents"] = orthogonal_tangents(units["tangents"], normals)
    return units


def _problem(vectors: Mapping[str, Array]) -> str:
    """What is wrong with a contact, of which something is."""
    units: dict[str, Array] = {}
    for name, vector in vectors.items():
        if np.isnan(vector).all():
            continue
        if not np.isfinite(vector).all():
            return f"{name[:-1]}: found {vector.tolist()}, expected finite numbers, or all NaN"
        unit, zero = unit_vectors(vector)
        if name in NAMES and zero:
            return f"{name[:-1]}: found {vector.tolist()}, expected a direction, not zero"
        units[name[:-1]] = unit if name in NAMES else vector
    return invalid_reason(units) or "malformed"


def by_kinds(targets: TargetBatch) -> Iterator[tuple[Kinds, slice | NDArray[np.intp], TargetBatch]]:
    """Targets sorted by the kinds of their contacts: what one kernel solves.

    The kinds of a target are its own, whatever else is in the batch. If a finger has a tangent,
    the others count as having one that is free, and if one has a ball, those without a point count
    as having one: a kernel for each of their combinations would have to be compiled, and gains next
    to nothing.

    Yields:
        Kinds, rows (a slice: all, as they are) and the targets in these rows.
    """
    f = targets.points.shape[1]
    if not targets.more:
        yield usual(f), slice(None), targets
        return
    names = list(targets.more)
    given = np.stack([~np.isnan(targets.more[name][..., 0]) for name in names], axis=2)
    if "tangents" in names:
        turned = given[..., names.index("tangents")]
        turned[:] = turned.any(axis=1, keepdims=True)
    if "balls" in names:
        rolling = given[..., names.index("balls")]
        rolling |= rolling.any(axis=1, keepdims=True) & np.isnan(targets.points[..., 0])
    flat = given.reshape(len(given), -1)
    _, firsts, which = np.unique(
        flat @ (1 << np.arange(flat.shape[1])), return_index=True, return_inverse=True
    )
    for i, of_fingers in enumerate(given[firsts].tolist()):
        kinds = tuple(
            kind_of(name[:-1] for name, has in zip(names, row, strict=True) if has)
            for row in of_fingers
        )
        if len(firsts) == 1:
            yield kinds, slice(None), targets
            return
        rows = np.flatnonzero(which == i)
        picked = np.array([targets.number(row) for row in rows.tolist()])
        yield kinds, rows, replace(targets.rows(rows), picked=picked)


def target_fields(robot: RobotDescription) -> tuple[Field, ...]:
    """Parameter fields that state the problem: targets and tolerances."""
    f = len(robot.fingers)
    return (
        Field("points", (f, 3), unit="m", doc="contact points, base frame"),
        Field("normals", (f, 3), doc="outward pad normals, base frame"),
        Field("position_tolerance", (f,), unit="m"),
        Field("angle_tolerance", (f,), unit="rad"),
    )


def target_values(targets: TargetBatch) -> dict[str, Array]:
    """Values of `target_fields` for a batch: targets (k, f, 3), tolerances (f,)."""
    return {
        "points": targets.points,
        "normals": targets.normals,
        "position_tolerance": targets.position_tolerance,
        "angle_tolerance": targets.angle_tolerance,
    }


@dataclass(frozen=True, eq=False)
class Target:
    """One finger's contact: point (3, 1) [m] and unit normal (3, 1), in one common frame."""

    point: Expr
    normal: Expr

    @property
    def vectors(self) -> Vectors:
        """As the conditions of a contact take them."""
        return {"point": self.point, "normal": self.normal}


def goal_contacts(robot: RobotDescription, parameters: dict[str, ca.SX]) -> dict[str, Target]:
    """The targets by finger name, base frame."""
    return {
        name: Target(parameters["points"][i, :].T, parameters["normals"][i, :].T)
        for i, name in enumerate(robot.finger_names)
    }


def contact_errors(
    kinematics: Kinematics, goal: dict[str, Target], fingers: Sequence[str]
) -> tuple[ca.SX, ca.SX]:
    """Distance and angle of each finger from its contact.

    Returns:
        position errors (f, 1) [m] and angle errors (f, 1) [rad].
    """
    positions, angles = [], []
    for name in fingers:
        tip, target = tip_vectors(kinematics, name), goal[name].vectors
        place, facing = USUAL.conditions
        positions.append(place.measure(tip, target))
        angles.append(facing.measure(tip, target))
    return ca.vertcat(*positions), ca.vertcat(*angles)
