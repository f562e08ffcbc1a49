"""The contacts as residuals of the program, with formulas of its own.

On purpose nothing here is taken from `problem.contacts` but the names of the kinds: a fault in the
definition that all other methods share shows up as a difference to this one.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels.layout import Field
from casadi_ik.problem.contacts.kinds import Kinds
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.actuated import actuated
from casadi_ik.symbolic.kinematics import Kinematics

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like the normals' (unit vectors)."""

PLACES = {"point": 3, "line": 3, "plane": 1}
FACINGS = {"normal": 3, "frame": 9}
"""Rows by condition."""


@dataclass(frozen=True)
class NlpContacts:
    """Residuals of all contacts: places by `LENGTH` of all fingers, then facings.

    Attributes:
        kinds: By finger.

    Raises:
        UnsupportedError: A condition that the program has no formula for.
    """

    kinds: Kinds

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind.place not in PLACES or kind.facing not in FACINGS:
                raise UnsupportedError(
                    f"method 'ipopt' knows no contacts of the kind {kind.place} and {kind.facing}"
                )

    @property
    def sizes(self) -> list[int]:
        """Rows of each place, then of each facing."""
        places = [PLACES[kind.place] for kind in self.kinds]
        return places + [FACINGS[kind.facing] for kind in self.kinds]

    @property
    def fields(self) -> tuple[Field, ...]:
        """Targets and weights."""
        f = len(self.kinds)
        asked = {name for kind in self.kinds for name in (kind.place, kind.facing)}
        own = {"frame": "tangents", "line": "lines", "plane": "planes"}
        return (
            Field("points", (f, 3), unit="m", doc="contact points, base frame; 0 if free"),
            Field("normals", (f, 3), doc="outward pad normals, base frame; 0 if free"),
            *(
                Field(array, (f, 3), doc="unit vectors, base frame; 0 if free")
                for name, array in own.items()
                if name in asked
            ),
            Field("weights", (f, 2), doc="1 where point, normal count, 0 where free"),
        )

    def residual(self, robot: RobotDescription, q: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        """All rows at q (n, 1)."""
        kinematics = actuated(robot, q).kinematics
        places, facings = [], []
        for i, (name, kind) in enumerate(zip(robot.finger_names, self.kinds, strict=True)):
            point, normal = kinematics.contact(name)
            off = (point - p["points"][i, :].T) / LENGTH
            if kind.place == "line":
                # What is left of the way to the line's point without its part along the line.
                along = p["lines"][i, :].T
                off = off - along @ (along.T @ off)
            elif kind.place == "plane":
                off = p["planes"][i, :] @ off
            places.append(off * p["weights"][i, 0])
            facing = normal - p["normals"][i, :].T
            if kind.facing == "frame":
                tangent = p["tangents"][i, :].T
                facing = _turned(kinematics, name, p["normals"][i, :].T, tangent)
            facings.append(facing * p["weights"][i, 1])
        return ca.vertcat(*places, *facings)

    def errors(self, residuals: Array) -> tuple[Array, Array]:
        """Distances [m] and angles [rad], (k, f) each and zero where free, of residuals (k, r)."""
        ends = np.cumsum(self.sizes)[:-1]
        parts = np.split(residuals, ends, axis=1)
        lengths = np.stack([np.linalg.norm(part, axis=1) for part in parts], axis=1)
        f = len(self.kinds)
        return lengths[:, :f] * LENGTH, 2 * np.arcsin(np.minimum(lengths[:, f:] / 2, 1.0))


def _turned(kinematics: Kinematics, finger: str, normal: ca.SX, tangent: ca.SX) -> ca.SX:
    """Difference (9, 1) of two frames; its length is the chord of the angle between them.

    Two rotations that differ by an angle a differ by 8 sin(a / 2)^2 in squares of all entries. A
    tangent of zero is free: then the difference of the normals alone.
    """
    own, facing = kinematics.tangent(finger), kinematics.contact(finger)[1]
    given = ca.dot(tangent, tangent)
    half = ca.sqrt(ca.SX(2)) / 2
    first = (facing - normal) * ca.if_else(given > 0.5, half, 1.0)
    second = (own - tangent) * half
    third = (ca.cross(facing, own) - ca.cross(normal, tangent)) * half
    return ca.vertcat(first, *(ca.if_else(given > 0.5, rows, 0.0) for rows in (second, third)))
