"""The contacts of all fingers as rows of one problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.kernels.layout import Field
from casadi_ik.problem.contacts.conditions import LENGTH, Rates, Vectors
from casadi_ik.problem.contacts.kinds import Kinds
from casadi_ik.symbolic.actuated import ActuatedKinematics
from casadi_ik.symbolic.kinematics import Kinematics
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.so3 import skew

DOCS = {
    "point": "contact points, base frame; 0 if free",
    "normal": "outward pad normals, base frame; 0 if free",
    "tangent": "second axes of the contact frames, base frame; 0 if free",
    "line": "directions of lines through the points, base frame",
    "plane": "normals of planes through the points, base frame",
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
        units = {"point": "m"}
        vectors = (
            Field(f"{name}s", (f, 3), unit=units.get(name, ""), doc=DOCS[name])
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
        found, first = [], 0
        for aspect in range(2):
            for kind in self.kinds:
                after = first + kind.conditions[aspect].rows
                found.append(slice(first, after))
                first = after
        return tuple(found)

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
    """Point, normal and tangent of a fingertip, base frame."""
    point, normal = kinematics.contact(finger)
    return {"point": point, "normal": normal, "tangent": kinematics.tangent(finger)}


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
