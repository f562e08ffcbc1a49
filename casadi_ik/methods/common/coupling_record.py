"""How near the mechanisms of a robot come to their toggle positions, as a part of a record."""

from __future__ import annotations

import casadi as ca

from casadi_ik.kernels.layout import Field
from casadi_ik.problem.trace import RecordedJacobian
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.couplings import has_toggle, toggle_margins
from casadi_ik.symbolic.smooth import Expr

NEAR_TOGGLE = 0.03
"""Squared sine of a transmission angle (10 deg) below which a mechanism counts as near toggle."""


def coupling_fields(robot: RobotDescription) -> tuple[Field, ...]:
    """The field of the record; none for a robot whose couplings have no toggle position."""
    if not _motors(robot):
        return ()
    doc = "smallest squared sine of the transmission angles, 0 at a toggle"
    return (Field("sigma_coupling", (), "f4", "", doc),)


def coupling_values(robot: RobotDescription, q: ca.SX) -> dict[str, Expr]:
    """The value of the field at q (n, 1)."""
    if not _motors(robot):
        return {}
    return {"sigma_coupling": ca.mmin(ca.vertcat(*toggle_margins(robot, q).values()))}


def coupling_jacobian(robot: RobotDescription) -> dict[str, RecordedJacobian]:
    """When the coupling Jacobian counts as near singular, for the events of a log."""
    motors = _motors(robot)
    return {"coupling": RecordedJacobian(motors, singular=NEAR_TOGGLE)} if motors else {}


def _motors(robot: RobotDescription) -> tuple[str, ...]:
    """The actuators behind mechanisms that have a toggle position."""
    sources = {joint.name: joint.coupling.of for joint in robot.movable if joint.coupling}
    found: dict[str, None] = {}
    for joint in robot.movable:
        if has_toggle(joint):
            name = joint.name
            while name in sources and name not in robot.actuator_names:
                name = sources[name]
            found[name] = None
    return tuple(found)
