"""How near the Jacobians of a robot are to a singularity, from the configurations of a trace.

Solvers have no use for these numbers, logs do: they are measured of finished traces, all rows at
once, so that a solve that nobody logs costs nothing more. What is measured:

============  ==================================================================================
Jacobian      maps
============  ==================================================================================
arm           arm motors to the palm's twist: velocity by `LENGTH`, angular velocity
hand          each finger's motors to the velocity of its contact point in the palm frame, by
              `LENGTH`; the smallest value of all fingers and the largest condition number
closed_chain  motors of arm and thumb to the five rows of the thumb's contact: velocity of the
              point by `LENGTH`, turning of the normal. Where these rows lose rank the
              closed chain of arm and thumb is singular
============  ==================================================================================

Of a body arm and hand of every side are measured, named ``left_arm`` and so on; the arm by itself,
without the trunk. A revolute motor counts by the radian, a linear one by its range. Of an r x c
Jacobian the smallest of its min(r, c) singular values is meant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.graphs import FunctionGraph, recipe
from casadi_ik.kernels.layout import Field
from casadi_ik.problem.contacts import LENGTH
from casadi_ik.problem.status import Phase
from casadi_ik.problem.trace import CONDITION, PHASE, SIGMA, Q, RecordedJacobian
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import ActuatedKinematics, actuated, motor_scales
from casadi_ik.symbolic.linear_algebra import extreme_singular_values
from casadi_ik.symbolic.se3 import perpendicular
from casadi_ik.symbolic.smooth import Expr

LARGEST_CONDITION = 1e7
"""Beyond it the smallest singular value is not resolved."""

ARM, HAND, CLOSED_CHAIN = "arm", "hand", "closed_chain"

THRESHOLDS = {ARM: (0.05, 500.0), HAND: (0.02, 200.0), CLOSED_CHAIN: (0.1, 150.0)}
"""Smallest singular value and condition number at which each counts as near singular."""


@dataclass(frozen=True, eq=False)
class _Measured:
    """A Jacobian of the robot.

    Attributes:
        name: Its name in the fields of the trace.
        columns: Positions in q of what it depends on and maps.
        graph: Smallest singular value and condition number for values of these.
        compiled: False keeps to the virtual machine.
        everywhere: Whether it is measured where the arm is not yet placed, too.
        thresholds: Smallest singular value and condition number at which it is near singular.
    """

    name: str
    columns: tuple[int, ...]
    graph: FunctionGraph
    compiled: bool
    everywhere: bool
    thresholds: tuple[float, float]

    @cached_property
    def kernel(self) -> FunctionKernel:
        """Made when first needed."""
        return FunctionKernel(self.graph, self.compiled, in_lanes=True)


class JacobianMeasures:
    """Measures arm and hand, and the closed chain of arm and thumb where a method follows it."""

    def __init__(
        self,
        robot: RobotDescription,
        *,
        without_arm: Sequence[Phase] = (),
        closed_chain: bool = False,
        compiled: bool = True,
    ) -> None:
        """Choose what is measured; nothing is built yet.

        Args:
            robot: The robot.
            without_arm: Phases in which the arm of q is not yet placed: there only the hand is
                measured.
            closed_chain: Whether the closed chain is.
            compiled: False keeps to the virtual machine.
        """
        self._robot = robot
        self._without_arm = tuple(map(int, without_arm))
        self._compiled = compiled
        names = list(robot.actuator_names)
        parts: list[_Measured] = []
        by_side = {f"{one.name}_": robot.side(one.name) for one in robot.sides}
        for label, side in (by_side or {"": robot}).items():
            motors = [names.index(name) for name in side.actuator_names]
            arm, hand = side.arm_actuators, side.hand_actuators
            if arm:
                parts.append(self._measured(ARM, label, side, motors, arm, _arm))
            if hand:
                parts.append(self._measured(HAND, label, side, motors, hand, _hand))
            if closed_chain and arm and side.named_thumb is not None:
                both = (*arm, *side.finger_actuators(side.thumb))
                chain = self._measured(CLOSED_CHAIN, label, side, motors, both, _thumb_contact)
                parts.append(chain)
        self._parts = tuple(parts)

    @property
    def fields(self) -> tuple[Field, ...]:
        """What it adds to a row: per Jacobian its smallest singular value and condition number."""
        return tuple(
            Field(kind + part.name, (), "f4", "", doc)
            for part in self._parts
            for kind, doc in (
                (SIGMA, "smallest singular value; NaN while not measured"),
                (CONDITION, "condition number; NaN while not measured"),
            )
        )

    @property
    def jacobians(self) -> dict[str, RecordedJacobian]:
        """The Jacobians by name: their motors and thresholds."""
        names = self._robot.actuator_names
        return {
            part.name: RecordedJacobian(tuple(names[i] for i in part.columns), *part.thresholds)
            for part in self._parts
        }

    def prepare(self) -> None:
        """Compile what it needs."""
        for part in self._parts:
            _ = part.kernel

    def __call__(self, rows: NDArray[Any]) -> NDArray[np.float32]:
        """The values (m, fields) of rows (m,) that have the standard fields q and phase."""
        values = np.full((len(rows), 2 * len(self._parts)), np.nan, np.float32)
        q, placed = np.ascontiguousarray(rows[Q.name]), None
        if self._without_arm:
            phase = np.ascontiguousarray(rows[PHASE.name])
            placed = np.logical_and.reduce([phase != code for code in self._without_arm])
            placed = np.flatnonzero(placed)
        for i, part in enumerate(self._parts):
            columns = slice(2 * i, 2 * i + 2)
            if part.everywhere or placed is None:
                (values[:, columns],) = part.kernel(q)
            else:
                (values[placed, columns],) = part.kernel(np.take(q, placed, axis=0))
        return values

    def _measured(
        self,
        kind: str,
        label: str,
        side: RobotDescription,
        motors: Sequence[int],
        columns: tuple[int, ...],
        extremes: Callable[[RobotDescription, ActuatedKinematics], tuple[Expr, Expr]],
    ) -> _Measured:
        """A Jacobian of a side, or of the robot, whose motors have places in the robot's q."""
        robot, name, n = self._robot, f"{label}{kind}", len(self._robot.actuators)
        full = ca.Function.fix_name(f"{robot.name}_singular_{name}")

        def build() -> ca.Function:
            q = ca.SX.sym("q", n)
            # What does not matter is at zero and folds away.
            matters = ca.SX.zeros(len(motors), 1)
            for column in columns:
                matters[column] = q[motors[column]]
            smallest, condition = extremes(side, actuated(side, matters))
            return ca.Function(full, [q], [ca.vertcat(smallest, condition)], ["q"], ["out"])

        inputs = {"q": (n, 1)}
        graph = FunctionGraph(full, build, inputs, ((2, 1),), recipe(full, robot))
        places = tuple(motors[column] for column in columns)
        return _Measured(name, places, graph, self._compiled, kind == HAND, THRESHOLDS[kind])


def _arm(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    columns = robot.arm_actuators
    linear, angular = body.palm_jacobian(columns)
    return _judged(ca.vertcat(linear * (1 / LENGTH), angular), _scales(robot, columns))


def _hand(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    found = []
    for finger in robot.finger_names:
        columns = robot.finger_actuators(finger)
        linear, _ = body.contact_jacobian(finger, columns)
        found.append(_judged(linear * (1 / LENGTH), _scales(robot, columns)))
    smallest, condition = (ca.vertcat(*values) for values in zip(*found, strict=True))
    return ca.mmin(smallest), ca.mmax(condition)


def _thumb_contact(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    thumb = robot.thumb
    columns = (*robot.arm_actuators, *robot.finger_actuators(thumb))
    linear, angular = body.contact_jacobian(thumb, columns)
    _, normal = body.kinematics.contact(thumb)
    first = perpendicular(normal)
    across = ca.horzcat(first, ca.cross(normal, first)).T
    return _judged(ca.vertcat(linear * (1 / LENGTH), across @ angular), _scales(robot, columns))


def _scales(robot: RobotDescription, columns: Sequence[int]) -> ca.DM:
    return motor_scales(robot)[list(columns)]


def _judged(jacobian: Expr, scales: ca.DM) -> tuple[Expr, Expr]:
    """Smallest singular value and condition number of a Jacobian, columns by their scales."""
    smallest, largest = extreme_singular_values(jacobian @ ca.diag(scales))
    return smallest, largest / ca.fmax(smallest, largest / LARGEST_CONDITION + 1e-300)
