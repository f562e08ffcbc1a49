"""What is logged of an iteration of an enhanced method."""

from __future__ import annotations

import casadi as ca

from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.robots.description import RobotDescription
from casadi_ik.steps.limits import limit_mask
from casadi_ik.steps.status import Phase
from casadi_ik.symbolic.smooth import Expr

NOT_MEASURED = float("nan")


def enhanced_record(robot: RobotDescription) -> Layout:
    """The fields of a row."""
    n, f = len(robot.actuators), len(robot.fingers)
    return Layout.record(
        Field("q", (n,), "f8", "rad or m", "actuator positions"),
        Field("position_error", (f,), "f4", "m", "distance of every finger from its contact"),
        Field("angle_error", (f,), "f4", "rad", "angle of every finger from its normal"),
        Field("palm_error", (), "f4", "rad", "palm orientation task error (phase 1)"),
        Field("palm_motion", (2,), "f4", "mm, rad", "palm motion demanded (phase 2)"),
        Field("step_size", (), "f4", "rad or m", "largest motor change of this iteration"),
        Field("sigma_thumb", (), "f4", "m", "smallest singular value, thumb point Jacobian"),
        Field("sigma_palm", (), "f4", "", "smallest singular value, palm task (phase 1)"),
        Field("sigma_closed_chain", (), "f4", "", "smallest singular value of H_p (phase 2)"),
        Field("condition_closed_chain", (), "f4", "", "condition number of H_p (phase 2)"),
        Field("limit_mask", (), "u4", "", "bit i: actuator i at or beyond a limit"),
        Field("phase", (), "u1", "", "1 thumb reaching, 2 hand alignment"),
        Field("status", (), "u1", "", "0 running, else the final status"),
    )


def enhanced_row(
    layout: Layout,
    robot: RobotDescription,
    q: Expr,
    positions: Expr,
    angles: Expr,
    *,
    phase: Phase,
    **measured: Expr,
) -> ca.SX:
    """A row.

    Args:
        layout: `enhanced_record` of the robot.
        robot: The description.
        q: (n, 1) the configuration the row describes.
        positions: (f, 1) its errors [m].
        angles: (f, 1) [rad].
        phase: The phase.
        measured: The other fields; those that the phase does not have are left out.
    """
    values: dict[str, Expr] = {
        "q": q,
        "position_error": positions,
        "angle_error": angles,
        "palm_error": NOT_MEASURED,
        "palm_motion": [NOT_MEASURED, NOT_MEASURED],
        "sigma_palm": NOT_MEASURED,
        "sigma_closed_chain": NOT_MEASURED,
        "condition_closed_chain": NOT_MEASURED,
        "limit_mask": limit_mask(robot, q),
        "phase": float(phase),
    }
    return layout.pack(values | measured)
