"""How a trace is to be read: its fields, their names, and what its Jacobians mean."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from casadi_ik.kernels.layout import Layout
from casadi_ik.problem.status import Phase, Status
from casadi_ik.robots.description import RobotDescription


@dataclass(frozen=True)
class RecordedJacobian:
    """A Jacobian, and when its measures call it singular.

    Attributes:
        joints: Actuators whose motion it maps.
        singular: Smallest singular value below which it counts as near singular, in the unit of
            its field ``sigma_<name>``.
        condition: Condition number above which it counts as ill-conditioned, for its field
            ``condition_<name>``.
    """

    joints: tuple[str, ...] = ()
    singular: float = 0.0
    condition: float = math.inf


@dataclass(frozen=True, eq=False)
class TraceFormat:
    """How to read a trace.

    Attributes:
        layout: Fields of a row.
        labels: Names that make a field readable: of the codes 0, 1, ... of an integer scalar
            ("phase"; "" for a code not used), of the bits of a field ending in "_mask", of the
            elements along the first axis of any other field ("q": actuator names).
        jacobians: What there is to know of the Jacobians in fields ``sigma_<name>`` and
            ``condition_<name>``, by name. One that is not named here is never near singular.
    """

    layout: Layout
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    jacobians: Mapping[str, RecordedJacobian] = field(default_factory=dict)


def trace_format(
    layout: Layout,
    robot: RobotDescription,
    jacobians: Mapping[str, RecordedJacobian] | None = None,
) -> TraceFormat:
    """How to read a trace whose fields have the names all methods use.

    Args:
        layout: Fields of a row: "q", "position_error", "angle_error", "limit_mask", "phase" and
            "status", and whatever else needs no names.
        robot: The robot.
        jacobians: As in `TraceFormat`.
    """
    labels = {
        "q": robot.actuator_names,
        "position_error": robot.finger_names,
        "angle_error": robot.finger_names,
        "limit_mask": robot.actuator_names,
        "phase": Phase.labels(),
        "status": Status.labels(),
    }
    return TraceFormat(layout, labels, jacobians or {})
