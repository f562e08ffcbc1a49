"""Targets of methods that need a point and a normal for every finger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.kernels.layout import Field
from casadi_ik.problem.contacts.conditions import Vectors
from casadi_ik.problem.contacts.kinds import USUAL
from casadi_ik.problem.contacts.rows import tip_vectors
from casadi_ik.problem.problems import Problems
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import Kinematics
from casadi_ik.symbolic.smooth import Expr


def target_fields(robot: RobotDescription) -> tuple[Field, ...]:
    """Parameter fields that state the problem: targets and tolerances."""
    f = len(robot.fingers)
    return (
        Field("points", (f, 3), unit="m", doc="contact points, base frame"),
        Field("normals", (f, 3), doc="outward pad normals, base frame"),
        Field("position_tolerance", (f,), unit="m"),
        Field("angle_tolerance", (f,), unit="rad"),
    )


def target_values(problems: Problems) -> dict[str, Array]:
    """Values of `target_fields` for a batch: targets (k, f, 3), tolerances (f,)."""
    return {
        "points": problems.points,
        "normals": problems.normals,
        "position_tolerance": problems.position_tolerance,
        "angle_tolerance": problems.angle_tolerance,
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


def targets(robot: RobotDescription, parameters: dict[str, ca.SX]) -> dict[str, Target]:
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
