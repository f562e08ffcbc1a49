"""Contact conditions: residuals, Jacobians and errors of every kind of contact.

A contact constrains the position of a fingertip (a point, a line, a plane, or the ball of the pad
at a point) and its orientation (a normal or a full frame); either may be free. The pair of
conditions is the kind of the contact, and `CONDITIONS` defines each condition once. All position
conditions are measured by a distance [m], all orientation conditions by an angle [rad].

Each condition has two forms. `residual` and `jacobian` are differences of vectors for least
squares: polynomial in the vectors, with the distance or the chord 2 sin(angle / 2) as norm, and
without a false zero at pi. `error` and `directions` are displacements and rotation vectors for
Newton's method.

The verdict (`solve.verdict`) deliberately has independent formulas, against which tests check this
module.
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
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import ActuatedKinematics, Kinematics
from casadi_ik.kinematics.se3 import angle_between, log_so3, normal_error, perpendicular, skew
from casadi_ik.kinematics.smooth import Expr, safe_norm
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch

LENGTH = 0.1
"""Length by which position errors are divided, for equal weight with unit vectors [m]."""

POSITION, ORIENTATION = "place", "facing"
"""Aspects of a contact, in the order of the columns of all weights (f, 2)."""

Vectors = Mapping[str, Expr]
"""Vectors (3, 1) by name, in one common frame.

A fingertip has "point" [m], the unit vectors "normal" and "tangent", and "pad" from the centre of
the pad ball to the point [m] (zero without a ball); a target has the `data` of its conditions.
"""

Rates = Mapping[str, Expr]
"""Jacobians (3, k) of vectors by name."""


@dataclass(frozen=True, eq=False)
class Condition:
    """A condition that a contact can impose.

    Attributes:
        name: Unique name.
        aspect: `POSITION` or `ORIENTATION`.
        data: Names of the target vectors that the condition needs.
        rows: Number of rows of the residual.
        residual: ``(tip, goal) -> (rows, 1)`` [m], or differences of unit vectors.
        jacobian: ``(tip, tip_rates, goal, goal_rates) -> (rows, k)`` of the residual.
        error: ``(tip, goal) -> (3, 1)`` displacement from the tip to the goal [m], or rotation
            vector [rad].
        directions: ``(tip, goal) -> (m, 3)`` constrained directions; None if all three are
            constrained, in which case the error of a position is minus its residual. Their product
            with the geometric Jacobian is the Jacobian of the error at the goal.
        measure: ``(tip, goal) ->`` distance [m] or angle [rad].
    """

    name: str
    aspect: str
    data: tuple[str, ...]
    rows: int
    residual: Callable[[Vectors, Vectors], Expr]
    jacobian: Callable[[Vectors, Rates, Vectors, Rates], Expr]
    error: Callable[[Vectors, Vectors], Expr]
    directions: Callable[[Vectors, Vectors], Expr] | None
    measure: Callable[[Vectors, Vectors], Expr]


def _goal_to_tip(tip: Vectors, goal: Vectors) -> Expr:
    """Return the vector from the point of the goal to the point of the tip."""
    return tip["point"] - goal["point"]


def _line_moment(tip: Vectors, goal: Vectors) -> Expr:
    return ca.cross(goal["line"], _goal_to_tip(tip, goal))


def _line_moment_rates(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    translation = skew(goal["line"]) @ (tip_rates["point"] - goal_rates["point"])
    return translation - skew(_goal_to_tip(tip, goal)) @ goal_rates["line"]


def _plane_distance(tip: Vectors, goal: Vectors) -> Expr:
    return ca.dot(goal["plane"], _goal_to_tip(tip, goal))


def _plane_distance_rates(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    translation = goal["plane"].T @ (tip_rates["point"] - goal_rates["point"])
    return translation + _goal_to_tip(tip, goal).T @ goal_rates["plane"]


def _tip_to_line(tip: Vectors, goal: Vectors) -> Expr:
    direction = goal["line"]
    return direction * ca.dot(direction, _goal_to_tip(tip, goal)) - _goal_to_tip(tip, goal)


def _goal_to_pad(tip: Vectors, goal: Vectors) -> Expr:
    """Return the vector from the goal to the point of the pad ball whose normal is the goal's."""
    radius = ca.dot(tip["pad"], tip["normal"])
    return _goal_to_tip(tip, goal) - tip["pad"] + radius * goal["ball"]


def _goal_to_pad_rates(tip: Vectors, tip_rates: Rates, _goal: Vectors, goal_rates: Rates) -> Expr:
    radius = ca.dot(tip["pad"], tip["normal"])
    translation = tip_rates["point"] - goal_rates["point"] - tip_rates["pad"]
    return translation + radius * goal_rates["ball"]


def _perpendicular_directions(direction: Expr) -> Expr:
    """Return two directions (2, 3) perpendicular to a unit vector."""
    first = perpendicular(direction)
    return ca.horzcat(first, ca.cross(direction, first)).T


def _axes(vectors: Vectors) -> Expr:
    """Return the axes of the contact frame (3, 3): normal, tangent, normal x tangent."""
    normal, tangent = vectors["normal"], vectors["tangent"]
    return ca.horzcat(normal, tangent, ca.cross(normal, tangent))


def _axis_rates(vectors: Vectors, rates: Rates) -> list[Expr]:
    third = skew(vectors["normal"]) @ rates["tangent"] - skew(vectors["tangent"]) @ rates["normal"]
    return [rates["normal"], rates["tangent"], third]


def _axis_weights(goal: Vectors) -> list[Expr]:
    """Return the weights of the three axes of a frame.

    Half the sum of the squared differences of all axes is 4 sin(angle / 2)^2, the square of the
    difference of one axis for a rotation perpendicular to it. A frame therefore has the weight of
    a normal for every axis of rotation. A goal with a zero tangent constrains its normal alone.
    """
    has_tangent = _has_tangent(goal)
    weight = ca.if_else(has_tangent, sqrt(0.5), 0.0)
    return [ca.if_else(has_tangent, sqrt(0.5), 1.0), weight, weight]


def _has_tangent(goal: Vectors) -> Expr:
    return ca.sumsqr(goal["tangent"]) > 0.5


def _frame_residual(tip: Vectors, goal: Vectors) -> Expr:
    differences = _axes(tip) - _axes(goal)
    return ca.vertcat(*(w * differences[:, i] for i, w in enumerate(_axis_weights(goal))))


def _frame_jacobian(tip: Vectors, tip_rates: Rates, goal: Vectors, goal_rates: Rates) -> Expr:
    pairs = zip(_axis_rates(tip, tip_rates), _axis_rates(goal, goal_rates), strict=True)
    differences = [tip_axis - goal_axis for tip_axis, goal_axis in pairs]
    return ca.vertcat(*(w * rows for w, rows in zip(_axis_weights(goal), differences, strict=True)))


def _frame_error(tip: Vectors, goal: Vectors) -> Expr:
    rotation_vector = log_so3(_axes(goal) @ _axes(tip).T)
    return ca.if_else(
        _has_tangent(goal), rotation_vector, normal_error(tip["normal"], goal["normal"])
    )


def _frame_directions(tip: Vectors, goal: Vectors) -> Expr:
    """Return the constrained rotation axes: all, or without a tangent all but the normal."""
    is_free = ca.if_else(_has_tangent(goal), 0.0, 1.0)
    return ca.DM.eye(3) - is_free * (tip["normal"] @ tip["normal"].T)


CONDITIONS: dict[str, Condition] = {
    condition.name: condition
    for condition in (
        Condition(
            "point",
            POSITION,
            ("point",),
            3,
            _goal_to_tip,
            lambda _tip, tip_rates, _goal, goal_rates: tip_rates["point"] - goal_rates["point"],
            lambda tip, goal: goal["point"] - tip["point"],
            None,
            lambda tip, goal: safe_norm(goal["point"] - tip["point"]),
        ),
        Condition(
            "line",
            POSITION,
            ("point", "line"),
            3,
            _line_moment,
            _line_moment_rates,
            _tip_to_line,
            lambda _tip, goal: _perpendicular_directions(goal["line"]),
            lambda tip, goal: safe_norm(_line_moment(tip, goal)),
        ),
        Condition(
            "plane",
            POSITION,
            ("point", "plane"),
            1,
            _plane_distance,
            _plane_distance_rates,
            lambda tip, goal: -goal["plane"] * _plane_distance(tip, goal),
            lambda _tip, goal: goal["plane"].T,
            lambda tip, goal: ca.fabs(_plane_distance(tip, goal)),
        ),
        Condition(
            "ball",
            POSITION,
            ("point", "ball"),
            3,
            _goal_to_pad,
            _goal_to_pad_rates,
            lambda tip, goal: -_goal_to_pad(tip, goal),
            None,
            lambda tip, goal: safe_norm(_goal_to_pad(tip, goal)),
        ),
        Condition(
            "normal",
            ORIENTATION,
            ("normal",),
            3,
            lambda tip, goal: tip["normal"] - goal["normal"],
            lambda _tip, tip_rates, _goal, goal_rates: tip_rates["normal"] - goal_rates["normal"],
            lambda tip, goal: normal_error(tip["normal"], goal["normal"]),
            lambda tip, _goal: _perpendicular_directions(tip["normal"]),
            lambda tip, goal: angle_between(tip["normal"], goal["normal"]),
        ),
        Condition(
            "frame",
            ORIENTATION,
            ("normal", "tangent"),
            9,
            _frame_residual,
            _frame_jacobian,
            _frame_error,
            _frame_directions,
            lambda tip, goal: safe_norm(_frame_error(tip, goal)),
        ),
    )
}
"""Conditions by name. To add one, add an entry; for new data see `model.grasp`."""


class ContactKind(NamedTuple):
    """Names of the two conditions of a contact.

    A weight of zero frees a condition, so that point and normal also covers a point alone or a
    normal alone.
    """

    position: str = "point"
    orientation: str = "normal"

    @property
    def conditions(self) -> tuple[Condition, Condition]:
        """Conditions of position and orientation."""
        return CONDITIONS[self.position], CONDITIONS[self.orientation]

    @property
    def data(self) -> tuple[str, ...]:
        """Names of the target vectors."""
        return tuple(dict.fromkeys(name for row in self.conditions for name in row.data))


POINT_AND_NORMAL = ContactKind()
"""Kind of a contact with a point and a normal."""

Kinds: TypeAlias = tuple[ContactKind, ...]
"""Kind of contact of each finger, for which a kernel is built."""


def point_normal_kinds(f: int) -> Kinds:
    """Return point and normal as the kinds of f fingers."""
    return (POINT_AND_NORMAL,) * f


def kinds_suffix(kinds: Kinds) -> str:
    """Return the suffix of the name of a graph for these kinds; "" for points and normals."""
    if set(kinds) <= {POINT_AND_NORMAL}:
        return ""
    return "_" + "_".join(f"{kind.position}{kind.orientation}" for kind in kinds)


def kind_from_vectors(data: Iterable[str]) -> ContactKind:
    """Return the kind of a contact with these vectors in addition to point and normal."""
    vectors, conditions = (
        set(data),
        {POSITION: POINT_AND_NORMAL.position, ORIENTATION: POINT_AND_NORMAL.orientation},
    )
    for condition in CONDITIONS.values():
        if not vectors.isdisjoint(condition.data[1:]):
            conditions[condition.aspect] = condition.name
    return ContactKind(conditions[POSITION], conditions[ORIENTATION])


VECTOR_DOCS = {
    "point": "contact points, base frame; 0 if free",
    "normal": "outward pad normals, base frame; 0 if free",
    "tangent": "second axes of the contact frames, base frame; 0 if free",
    "line": "directions of lines through the points, base frame",
    "plane": "normals of planes through the points, base frame",
    "ball": "outward normals of the pads' balls where they touch the points, base frame",
}


@dataclass(frozen=True)
class ContactRows:
    """Residual rows of the contacts of all fingers.

    Rows are ordered by aspect: positions of all fingers, then orientations.

    Attributes:
        kinds: Kind of contact of each finger.
    """

    kinds: Kinds

    @cached_property
    def data(self) -> tuple[str, ...]:
        """Names of the target vectors, point and normal first."""
        names = (name for kind in self.kinds for name in kind.data)
        return tuple(dict.fromkeys(("point", "normal", *names)))

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """Parameter fields of the targets."""
        f = len(self.kinds)
        vectors = (
            Field(f"{name}s", (f, 3), unit="m" if name == "point" else "", doc=VECTOR_DOCS[name])
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
        """Rows of the positions of all fingers, then of their orientations, (2 f,)."""
        sizes = [kind.conditions[aspect].rows for aspect in range(2) for kind in self.kinds]
        boundaries = accumulate(sizes, initial=0)
        return tuple(slice(*pair) for pair in pairwise(boundaries))

    def goals(self, p: dict[str, Expr]) -> list[Vectors]:
        """Return the target vectors of each finger, base frame.

        Args:
            p: Parameters with `fields`.
        """
        return [
            {name: p[f"{name}s"][i, :].T for name in kind.data} for i, kind in enumerate(self.kinds)
        ]

    def residual(self, tips: Sequence[Vectors], goals: Sequence[Vectors], weights: Expr) -> Expr:
        """Return the residual (size, 1): positions divided by `LENGTH`, then orientations.

        Args:
            tips: Vectors of the fingertips, in any frame.
            goals: Vectors of the targets, in the same frame.
            weights: (f, 2) 1 where position or orientation is constrained, 0 where it is free.
        """
        rows = [
            [condition.residual(tip, goal) for condition in kind.conditions]
            for kind, tip, goal in zip(self.kinds, tips, goals, strict=True)
        ]
        return _weighted_rows(rows, weights)

    def jacobian(
        self,
        tips: Sequence[Vectors],
        tip_rates: Sequence[Rates],
        goals: Sequence[Vectors],
        goal_rates: Sequence[Rates],
        weights: Expr,
    ) -> Expr:
        """Return the Jacobian (size, k) of `residual` for moving tips and targets."""
        rows = [
            [condition.jacobian(*vectors) for condition in kind.conditions]
            for kind, *vectors in zip(self.kinds, tips, tip_rates, goals, goal_rates, strict=True)
        ]
        return _weighted_rows(rows, weights)

    def errors(self, residual: Expr) -> tuple[Expr, Expr]:
        """Return distances [m] and chords of a residual, each (f, 1); zero where free."""
        lengths = [ca.norm_2(residual[rows]) for rows in self.slices]
        f = len(self.kinds)
        return ca.vertcat(*(length * LENGTH for length in lengths[:f])), ca.vertcat(*lengths[f:])


def _weighted_rows(rows: Sequence[Sequence[Expr]], weights: Expr) -> Expr:
    """Return the rows of all fingers: positions divided by `LENGTH`, then orientations."""
    positions = [position / LENGTH * weights[i, 0] for i, (position, _) in enumerate(rows)]
    orientations = [orientation * weights[i, 1] for i, (_, orientation) in enumerate(rows)]
    return ca.vertcat(*positions, *orientations)


def within_tolerance(
    distances: Expr, angles: Expr, position_tolerance: Expr, angle_tolerance: Expr
) -> Expr:
    """Return 1 if the errors of all contacts are within tolerance.

    Args:
        distances: (f, 1) [m], zero where free.
        angles: (f, 1) [rad] or chords, zero where free.
        position_tolerance: (f, 1) [m].
        angle_tolerance: (f, 1) in the unit of `angles`.
    """
    return ca.logic_and(
        ca.mmax(distances - position_tolerance) <= 0, ca.mmax(angles - angle_tolerance) <= 0
    )


def chord(angle: Expr) -> Expr:
    """Return the norm of the difference of two unit vectors that include an angle [rad]."""
    return 2 * ca.sin(angle / 2)


def tip_vectors(kinematics: Kinematics, finger: str) -> Vectors:
    """Return point, normal, tangent and pad of a fingertip, base frame."""
    point, normal = kinematics.contact(finger)
    pad = kinematics.robot.finger(finger).radius * normal
    return {"point": point, "normal": normal, "tangent": kinematics.tangent(finger), "pad": pad}


def tip_jacobians(body: ActuatedKinematics, finger: str, actuators: Sequence[int]) -> Rates:
    """Return the Jacobians (3, k) of `tip_vectors` with respect to actuators."""
    linear, angular = body.contact_jacobian(finger, actuators)
    axis_jacobians = {
        name: -skew(axis) @ angular
        for name, axis in tip_vectors(body.kinematics, finger).items()
        if name != "point"
    }
    return {"point": linear, **axis_jacobians}


def fixed_goal_rates(goals: Sequence[Vectors], k: int) -> list[Rates]:
    """Return the zero Jacobians of fixed targets."""
    return [dict.fromkeys(goal, ca.SX(3, k)) for goal in goals]


def target_fields(robot: RobotDescription) -> tuple[Field, ...]:
    """Return the parameter fields of targets and tolerances."""
    f = len(robot.fingers)
    return (
        Field("points", (f, 3), unit="m", doc="contact points, base frame"),
        Field("normals", (f, 3), doc="outward pad normals, base frame"),
        Field("position_tolerance", (f,), unit="m"),
        Field("angle_tolerance", (f,), unit="rad"),
    )


def target_values(targets: TargetBatch) -> dict[str, Array]:
    """Return the values of `target_fields` for a batch: targets (k, f, 3), tolerances (f,)."""
    return {
        "points": targets.points,
        "normals": targets.normals,
        "position_tolerance": targets.position_tolerance,
        "angle_tolerance": targets.angle_tolerance,
    }


@dataclass(frozen=True, eq=False)
class Target:
    """Target of one finger: point (3, 1) [m] and unit normal (3, 1), in a common frame."""

    point: Expr
    normal: Expr

    @property
    def vectors(self) -> Vectors:
        """Point and normal by name, for the conditions of a contact."""
        return {"point": self.point, "normal": self.normal}


def goal_contacts(robot: RobotDescription, parameters: dict[str, ca.SX]) -> dict[str, Target]:
    """Return the targets by finger name, base frame."""
    return {
        name: Target(parameters["points"][i, :].T, parameters["normals"][i, :].T)
        for i, name in enumerate(robot.finger_names)
    }


def contact_errors(
    kinematics: Kinematics, goal: dict[str, Target], fingers: Sequence[str]
) -> tuple[ca.SX, ca.SX]:
    """Return the distance and angle of each finger from its contact.

    Returns:
        Position errors (f, 1) [m] and angle errors (f, 1) [rad].
    """
    positions, angles = [], []
    for name in fingers:
        tip, target = tip_vectors(kinematics, name), goal[name].vectors
        position, orientation = POINT_AND_NORMAL.conditions
        positions.append(position.measure(tip, target))
        angles.append(orientation.measure(tip, target))
    return ca.vertcat(*positions), ca.vertcat(*angles)


def group_by_kinds(
    targets: TargetBatch,
) -> Iterator[tuple[Kinds, slice | NDArray[np.intp], TargetBatch]]:
    """Group targets by the kinds of their contacts, one group per kernel.

    The kinds of a target do not depend on the batch. If a finger has a tangent, all fingers get a
    free tangent, and if a finger has a ball, fingers without a point get a ball: a kernel for every
    combination would not be faster.

    Yields:
        Kinds, rows (a full slice if there is one group) and the targets in these rows.
    """
    f = targets.points.shape[1]
    if not targets.extra_vectors:
        yield point_normal_kinds(f), slice(None), targets
        return
    names = list(targets.extra_vectors)
    has_vector = np.stack(
        [~np.isnan(targets.extra_vectors[name][..., 0]) for name in names], axis=2
    )
    if "tangents" in names:
        has_tangent = has_vector[..., names.index("tangents")]
        has_tangent[:] = has_tangent.any(axis=1, keepdims=True)
    if "balls" in names:
        has_ball = has_vector[..., names.index("balls")]
        has_ball |= has_ball.any(axis=1, keepdims=True) & np.isnan(targets.points[..., 0])
    first_rows, group = np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp)
    if len(has_vector) != 1:
        flags = has_vector.reshape(len(has_vector), -1)
        _, first_rows, group = np.unique(
            flags @ (1 << np.arange(flags.shape[1])), return_index=True, return_inverse=True
        )
    for i, finger_flags in enumerate(has_vector[first_rows].tolist()):
        kinds = tuple(
            kind_from_vectors(name[:-1] for name, flag in zip(names, row, strict=True) if flag)
            for row in finger_flags
        )
        if len(first_rows) == 1:
            yield kinds, slice(None), targets
            return
        rows = np.flatnonzero(group == i)
        row_numbers = np.array([targets.row_number(row) for row in rows.tolist()])
        yield kinds, rows, replace(targets.rows(rows), row_numbers=row_numbers)
