"""Format of traces: the standard fields of all methods, and the measures of their Jacobians.

The record of a method has the standard fields below and fields specific to the method. Readers of
traces (events, explanations, pictures) use the standard fields alone; `trace_format` refuses a
record whose standard fields have another shape, type or unit.

The conditioning of Jacobians is computed from finished traces, for all rows in one call: solvers do
not need it, and solves without a log should not pay for it.

============  ==================================================================================
Jacobian      maps
============  ==================================================================================
arm           arm motors to the palm's twist: velocity by `LENGTH`, angular velocity
hand          each finger's motors to the velocity of its contact point in the palm frame, by
              `LENGTH`; the smallest value of all fingers and the largest condition number
closed_chain  motors of arm and thumb to the five rows of the thumb's contact: velocity of the
              point by `LENGTH`, rotation of the normal. Where these rows lose rank, the
              closed chain of arm and thumb is singular
============  ==================================================================================

Arm and hand of each side of a multi-arm robot are measured separately, named ``left_arm`` and so
on, without the trunk. Revolute motors are scaled by the radian, linear ones by their range. The
singular value of an r x c Jacobian is the smallest of its min(r, c) singular values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.kinematics.forward import ActuatedKinematics, actuated, motor_scales
from casadi_ik.kinematics.linear_algebra import extreme_singular_values
from casadi_ik.kinematics.se3 import perpendicular
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.status import Phase, Status

WORD_BITS = 32
"""Bits per word of a mask; viewers support no wider words."""


class Elements(Enum):
    """Kind of the elements of a standard field."""

    SOLVE = "the solve: one number"
    CODE = "the solve: one code with a name"
    ACTUATORS = "an actuator each"
    ACTUATOR_BITS = "a bit for each actuator, the first the least significant"
    FINGERS = "a finger each"


@dataclass(frozen=True)
class StandardField:
    """A field with the same meaning in the records of all methods.

    Attributes:
        name: Name of the field.
        elements: Kind of its elements, which determines shape and labels.
        dtype: Storage type, see `Field.dtype`.
        unit: SI unit, "" if dimensionless.
        doc: One-line description.
        codes: Names of the codes 0, 1, ...; "" for unused codes.
        required: True if every method must record the field.
    """

    name: str
    elements: Elements
    dtype: str
    unit: str
    doc: str
    codes: tuple[str, ...] = ()
    required: bool = True

    def for_robot(self, robot: RobotDescription, doc: str = "") -> Field:
        """Return the field of the record of a robot.

        Args:
            robot: The robot.
            doc: Description specific to a method; "": `StandardField.doc`.
        """
        n, f = len(robot.actuators), len(robot.fingers)
        words = -(-n // WORD_BITS)
        shape = {
            Elements.ACTUATORS: (n,),
            Elements.ACTUATOR_BITS: () if words <= 1 else (words,),
            Elements.FINGERS: (f,),
        }.get(self.elements, ())
        return Field(self.name, shape, self.dtype, self.unit, doc or self.doc)

    def labels(self, robot: RobotDescription) -> tuple[str, ...]:
        """Return the names of the elements, bits or codes; empty for a single number."""
        if self.elements in (Elements.ACTUATORS, Elements.ACTUATOR_BITS):
            return robot.actuator_names
        return robot.finger_names if self.elements is Elements.FINGERS else self.codes


Q = StandardField(
    "q",
    Elements.ACTUATORS,
    "f8",
    "rad or m",
    "actuator positions",
)
POSITION_ERROR = StandardField(
    "position_error",
    Elements.FINGERS,
    "f4",
    "m",
    "distance of every finger from its contact; NaN if free or not measured",
)
ANGLE_ERROR = StandardField(
    "angle_error",
    Elements.FINGERS,
    "f4",
    "rad",
    "angle of every finger from its normal; NaN if free or not measured",
)
COST = StandardField(
    "cost",
    Elements.SOLVE,
    "f8",
    "",
    "what the method brings down: squares of all contacts in 0.1 m and rad, summed",
    required=False,
)
STEP_SIZE = StandardField(
    "step_size",
    Elements.SOLVE,
    "f4",
    "rad or m",
    "largest motor change of the step; NaN if there is none",
)
DAMPING = StandardField("damping", Elements.SOLVE, "f4", "", "damping of the step", required=False)
LIMIT_MASK = StandardField(
    "limit_mask", Elements.ACTUATOR_BITS, "u4", "", "bit i: actuator i at or beyond a limit"
)
ACTIVE_MASK = StandardField(
    "active_mask",
    Elements.ACTUATOR_BITS,
    "u4",
    "",
    "bit i: actuator i held at its limit by the step",
    required=False,
)
RESTART = StandardField(
    "restart", Elements.SOLVE, "u4", "", "number of the start, from 0", required=False
)
ACCEPTED = StandardField(
    "accepted", Elements.SOLVE, "u1", "", "1 if the step lowered the cost", required=False
)
PHASE = StandardField(
    "phase", Elements.CODE, "u1", "", "what the iteration works on", codes=Phase.labels()
)
STATUS = StandardField(
    "status", Elements.CODE, "u1", "", "0 running, else the final status", codes=Status.labels()
)

STANDARD_FIELDS = (
    *(Q, POSITION_ERROR, ANGLE_ERROR, COST, STEP_SIZE, DAMPING),
    *(LIMIT_MASK, ACTIVE_MASK, RESTART, ACCEPTED, PHASE, STATUS),
)
"""Standard fields of all methods."""

SIGMA, CONDITION = "sigma_", "condition_"
"""Prefixes of the fields of the smallest singular value and of the condition number of a Jacobian;
NaN where it is not measured."""

CLEARANCE = "clearance"
"""Name of the field that a log adds for solvers with a scene."""


def pack_mask(flags: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Return flags of all actuators (k, n) as words of a mask, (k,) or (k, words)."""
    padded = np.pad(flags, ((0, 0), (0, -flags.shape[1] % WORD_BITS)))
    words = np.packbits(padded, axis=1, bitorder="little").view("<u4")
    return words[:, 0] if words.shape[1] == 1 else words


@dataclass(frozen=True)
class RecordedJacobian:
    """A Jacobian of a trace, with thresholds of its measures.

    Attributes:
        joints: Actuators whose motion it maps.
        singular: Threshold of the smallest singular value below which the Jacobian is near
            singular, in the unit of its field ``sigma_<name>``.
        condition: Threshold of the condition number above which the Jacobian is ill-conditioned,
            for its field ``condition_<name>``.
    """

    joints: tuple[str, ...] = ()
    singular: float = 0.0
    condition: float = math.inf


class Measures(Protocol):
    """Quantities that are computed from the rows of a trace when it is written to a log."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """Fields that the measures add to a row, all of dtype "f4"."""
        ...

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Jacobians among the measures, as in `TraceFormat`."""
        ...

    def prepare(self) -> None:
        """Build and compile the graphs."""
        ...

    def __call__(self, rows: NDArray[Any]) -> NDArray[np.float32]:
        """Return the values (m, fields) of rows (m,); NaN where nothing is measured."""
        ...


@dataclass(frozen=True, eq=False)
class TraceFormat:
    """Layout and labels of a trace.

    Attributes:
        layout: Fields of a row.
        labels: Names that make a field readable: of the codes 0, 1, ... of an integer scalar
            ("phase"; "" for unused codes), of the bits of a field ending in "_mask", of the
            elements along the first axis of any other field ("q": actuator names); "q_unit":
            units of the actuators.
        jacobians: Actuators and thresholds of the Jacobians in fields ``sigma_<name>`` and
            ``condition_<name>``, by name. Other Jacobians are never near singular.
        measures: Quantities that a log adds to the rows; None: none.
    """

    layout: Layout
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    jacobians: Mapping[str, RecordedJacobian] = field(default_factory=dict)
    measures: Measures | None = None


def trace_format(
    layout: Layout,
    robot: RobotDescription,
    jacobians: Mapping[str, RecordedJacobian] | None = None,
    measures: Measures | None = None,
) -> TraceFormat:
    """Return the format of the traces of a method.

    Args:
        layout: Fields of a row: the standard fields and those of the method.
        robot: The robot.
        jacobians: Jacobians of the record, see `TraceFormat`.
        measures: Measures of the trace, see `TraceFormat`.

    Raises:
        InputError: A standard field differs from its definition, or a required one is missing.
    """
    fields = {item.name: item for item in layout}
    labels: dict[str, tuple[str, ...]] = {}
    for standard in STANDARD_FIELDS:
        expected, item = standard.for_robot(robot), fields.get(standard.name)
        if item is None:
            if standard.required:
                raise InputError(
                    f"trace: field {standard.name!r} is missing; every method records it"
                )
            continue
        for name in ("shape", "dtype", "unit"):
            value, expected_value = getattr(item, name), getattr(expected, name)
            if value != expected_value:
                raise InputError(
                    f"trace: field {standard.name!r} has {name} {value!r}, expected "
                    f"{expected_value!r}"
                )
        if names := standard.labels(robot):
            labels[standard.name] = names
    labels["q_unit"] = tuple(actuator.unit for actuator in robot.actuators)
    return TraceFormat(layout, labels, jacobians or {}, measures)


MAX_CONDITION = 1e7
"""Condition number beyond which the smallest singular value is not resolved."""

ARM, HAND, CLOSED_CHAIN = "arm", "hand", "closed_chain"

SINGULARITY_THRESHOLDS = {ARM: (0.05, 500.0), HAND: (0.02, 200.0), CLOSED_CHAIN: (0.1, 150.0)}
"""Thresholds of the smallest singular value and of the condition number by Jacobian."""


@dataclass(frozen=True, eq=False)
class _MeasuredJacobian:
    """A Jacobian of the robot.

    Attributes:
        name: Name in the fields of the trace.
        columns: Columns of q that the Jacobian depends on and maps.
        graph: Graph of smallest singular value and condition number.
        compiled: False: use CasADi's virtual machine.
        in_all_phases: True to measure it in phases without an arm too.
        thresholds: Thresholds of smallest singular value and condition number.
    """

    name: str
    columns: tuple[int, ...]
    graph: FunctionGraph
    compiled: bool
    in_all_phases: bool
    thresholds: tuple[float, float]

    @cached_property
    def kernel(self) -> FunctionKernel:
        """Kernel of the graph, built when first needed."""
        return FunctionKernel(self.graph, self.compiled, in_lanes=True)


class JacobianMeasures:
    """Measures of the Jacobians of arm, hand, and the closed chain of arm and thumb."""

    def __init__(
        self,
        robot: RobotDescription,
        *,
        without_arm: Sequence[Phase] = (),
        closed_chain: bool = False,
        compiled: bool = True,
    ) -> None:
        """Select the Jacobians; graphs are built when first needed.

        Args:
            robot: The robot.
            without_arm: Phases in which the arm's part of q is undefined, so that only the hand
                is measured.
            closed_chain: Whether to measure the closed chain.
            compiled: False: use CasADi's virtual machine.
        """
        self._robot = robot
        self._without_arm = tuple(map(int, without_arm))
        self._compiled = compiled
        names = list(robot.actuator_names)
        parts: list[_MeasuredJacobian] = []
        by_side = {f"{side.name}_": robot.side(side.name) for side in robot.sides}
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
        """Fields of the smallest singular value and condition number of each Jacobian."""
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
        """Actuators and thresholds of the Jacobians by name."""
        names = self._robot.actuator_names
        return {
            part.name: RecordedJacobian(tuple(names[i] for i in part.columns), *part.thresholds)
            for part in self._parts
        }

    def prepare(self) -> None:
        """Build and compile the graphs."""
        for part in self._parts:
            _ = part.kernel

    def __call__(self, rows: NDArray[Any]) -> NDArray[np.float32]:
        """Return the values (m, fields) of rows (m,) with the standard fields q and phase."""
        values = np.full((len(rows), 2 * len(self._parts)), np.nan, np.float32)
        q, rows_with_arm = np.ascontiguousarray(rows[Q.name]), None
        if self._without_arm:
            phase = np.ascontiguousarray(rows[PHASE.name])
            has_arm = np.logical_and.reduce([phase != code for code in self._without_arm])
            rows_with_arm = np.flatnonzero(has_arm)
        for i, part in enumerate(self._parts):
            columns = slice(2 * i, 2 * i + 2)
            if part.in_all_phases or rows_with_arm is None:
                (values[:, columns],) = part.kernel(q)
            else:
                (values[rows_with_arm, columns],) = part.kernel(np.take(q, rows_with_arm, axis=0))
        return values

    def _measured(
        self,
        kind: str,
        label: str,
        side: RobotDescription,
        motors: Sequence[int],
        columns: tuple[int, ...],
        extremes: Callable[[RobotDescription, ActuatedKinematics], tuple[Expr, Expr]],
    ) -> _MeasuredJacobian:
        """Return a Jacobian of a side, whose motors are columns `motors` of the robot's q."""
        robot, name, n = self._robot, f"{label}{kind}", len(self._robot.actuators)
        full = ca.Function.fix_name(f"{robot.name}_singular_{name}")

        def build() -> ca.Function:
            q = ca.SX.sym("q", n)
            # Other motors are constant zeros, so that CasADi folds their expressions.
            side_q = ca.SX.zeros(len(motors), 1)
            for column in columns:
                side_q[column] = q[motors[column]]
            smallest, condition = extremes(side, actuated(side, side_q))
            return ca.Function(full, [q], [ca.vertcat(smallest, condition)], ["q"], ["out"])

        inputs = {"q": (n, 1)}
        graph = FunctionGraph(full, build, inputs, ((2, 1),), recipe(full, robot))
        robot_columns = tuple(motors[column] for column in columns)
        return _MeasuredJacobian(
            name, robot_columns, graph, self._compiled, kind == HAND, SINGULARITY_THRESHOLDS[kind]
        )


def _arm(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    columns = robot.arm_actuators
    linear, angular = body.palm_jacobian(columns)
    return _conditioning(ca.vertcat(linear * (1 / LENGTH), angular), _scales(robot, columns))


def _hand(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    measures = []
    for finger in robot.finger_names:
        columns = robot.finger_actuators(finger)
        linear, _ = body.contact_jacobian(finger, columns)
        measures.append(_conditioning(linear * (1 / LENGTH), _scales(robot, columns)))
    smallest, condition = (ca.vertcat(*values) for values in zip(*measures, strict=True))
    return ca.mmin(smallest), ca.mmax(condition)


def _thumb_contact(robot: RobotDescription, body: ActuatedKinematics) -> tuple[Expr, Expr]:
    thumb = robot.thumb
    columns = (*robot.arm_actuators, *robot.finger_actuators(thumb))
    linear, angular = body.contact_jacobian(thumb, columns)
    _, normal = body.kinematics.contact(thumb)
    tangent = perpendicular(normal)
    tangents = ca.horzcat(tangent, ca.cross(normal, tangent)).T
    return _conditioning(
        ca.vertcat(linear * (1 / LENGTH), tangents @ angular), _scales(robot, columns)
    )


def _scales(robot: RobotDescription, columns: Sequence[int]) -> ca.DM:
    return motor_scales(robot)[list(columns)]


def _conditioning(jacobian: Expr, scales: ca.DM) -> tuple[Expr, Expr]:
    """Return smallest singular value and condition number of a Jacobian with scaled columns."""
    smallest, largest = extreme_singular_values(jacobian @ ca.diag(scales))
    return smallest, largest / ca.fmax(smallest, largest / MAX_CONDITION + 1e-300)
