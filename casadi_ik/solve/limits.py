"""Joint limits inside a step, and record fields of limits and couplings."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.compile.layout import Field
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.couplings import has_toggle, toggle_margins
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.trace import WORD_BITS, RecordedJacobian


def clamp_to_limits(robot: RobotDescription, q: Expr, enforce: Expr) -> Expr:
    """Clamp q (n, 1) to the limits if `enforce` is 1; return q unchanged if it is 0."""
    lower, upper = ca.DM(robot.lower.tolist()), ca.DM(robot.upper.tolist())
    return ca.if_else(enforce > 0, ca.fmin(ca.fmax(q, lower), upper), q)


def clip_starts(robot: RobotDescription, targets: TargetBatch) -> Array:
    """Return start configurations (k, n), clipped to the limits if targets enforce them."""
    starts = targets.starts(robot)
    return np.clip(starts, robot.lower, robot.upper) if targets.enforce_limits else starts


def limit_mask(robot: RobotDescription, q: Expr) -> Expr:
    """Return a mask whose bit i is set if actuator i is at or beyond a limit."""
    lower, upper = ca.DM(robot.lower.tolist()), ca.DM(robot.upper.tolist())
    return pack_bits(ca.logic_or(q <= lower, q >= upper))


def pack_bits(flags: Expr) -> Expr:
    """Return a mask whose bit i is flag i (n, 1), one word (1, 1) for each `WORD_BITS` flags."""
    n = flags.numel()
    words = [flags[first : min(first + WORD_BITS, n)] for first in range(0, n, WORD_BITS)]
    return ca.vertcat(
        *(ca.dot(word, ca.DM([2.0**i for i in range(word.numel())])) for word in words)
    )


TOGGLE_THRESHOLD = 0.03
"""Squared sine of a transmission angle (10 deg) below which a mechanism is near its toggle."""


def coupling_fields(robot: RobotDescription) -> tuple[Field, ...]:
    """Return the record fields of the couplings; empty if no coupling has a toggle position."""
    if not _toggle_motors(robot):
        return ()
    doc = "smallest squared sine of the transmission angles, 0 at a toggle"
    return (Field("sigma_coupling", (), "f4", "", doc),)


def coupling_values(robot: RobotDescription, q: ca.SX) -> dict[str, Expr]:
    """Return the values of `coupling_fields` at q (n, 1)."""
    if not _toggle_motors(robot):
        return {}
    return {"sigma_coupling": ca.mmin(ca.vertcat(*toggle_margins(robot, q).values()))}


def coupling_jacobian(robot: RobotDescription) -> dict[str, RecordedJacobian]:
    """Return the threshold of the coupling Jacobian for the events of a log."""
    motors = _toggle_motors(robot)
    return {"coupling": RecordedJacobian(motors, singular=TOGGLE_THRESHOLD)} if motors else {}


def _toggle_motors(robot: RobotDescription) -> tuple[str, ...]:
    """Return the actuators of mechanisms that have a toggle position."""
    sources = {joint.name: joint.coupling.of for joint in robot.movable if joint.coupling}
    actuators: dict[str, None] = {}
    for joint in robot.movable:
        if has_toggle(joint):
            name = joint.name
            while name in sources and name not in robot.actuator_names:
                name = sources[name]
            actuators[name] = None
    return tuple(actuators)
