"""How a trace is to be read: the fields that mean the same in every method, and its Jacobians.

A method's record is made of the standard fields below and of fields of its own. What looks at
traces (events, explanations, pictures) goes by the standard fields alone: a method that has such a
number under another name, or of another kind, is refused by `trace_format`.

How near the Jacobians of a robot are to a singularity is measured of finished traces, all rows at
once: solvers have no use for these numbers, and a solve that nobody logs costs nothing more.

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
"""Bits of a word of a mask: viewers show wider ones badly."""


class Elements(Enum):
    """What the numbers of a standard field belong to."""

    SOLVE = "the solve: one number"
    CODE = "the solve: one code with a name"
    ACTUATORS = "an actuator each"
    ACTUATOR_BITS = "a bit for each actuator, the first the least significant"
    FINGERS = "a finger each"


@dataclass(frozen=True)
class StandardField:
    """A field that means the same in the record of every method that has it.

    Attributes:
        name: Its name.
        elements: What its numbers belong to; sets shape and labels.
        dtype: Storage, as in `Field.dtype`.
        unit: SI unit, "" if dimensionless.
        doc: What it is, one line.
        codes: Names of the codes 0, 1, ... of a code; "" for one that is not used.
        required: Whether every method has to record it.
    """

    name: str
    elements: Elements
    dtype: str
    unit: str
    doc: str
    codes: tuple[str, ...] = ()
    required: bool = True

    def of(self, robot: RobotDescription, doc: str = "") -> Field:
        """The field in the record of a robot.

        Args:
            robot: The robot.
            doc: What it is in this method, where more can be said than `StandardField.doc`.
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
        """Names of its elements, bits or codes; none if it is a plain number."""
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
"""All of them."""

SIGMA, CONDITION = "sigma_", "condition_"
"""What stands before the name of a Jacobian in the fields of its smallest singular value and of its
condition number; NaN where it is not measured."""

CLEARANCE = "clearance"
"""Name of the field that a log adds where there is a scene."""


def pack_mask(flags: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Flags of all actuators (k, n) as the words of a mask, (k,) or (k, words)."""
    padded = np.pad(flags, ((0, 0), (0, -flags.shape[1] % WORD_BITS)))
    words = np.packbits(padded, axis=1, bitorder="little").view("<u4")
    return words[:, 0] if words.shape[1] == 1 else words


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


class Measures(Protocol):
    """Numbers that follow from the rows of a trace, and are measured when it goes to a log."""

    @property
    def fields(self) -> tuple[Field, ...]:
        """What they add to a row, all of dtype "f4"."""
        ...

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """The Jacobians among them, as in `TraceFormat`."""
        ...

    def prepare(self) -> None:
        """Build and compile what is needed."""
        ...

    def __call__(self, rows: NDArray[Any]) -> NDArray[np.float32]:
        """The values (m, fields) of rows (m,); NaN where there is nothing to measure."""
        ...


@dataclass(frozen=True, eq=False)
class TraceFormat:
    """How to read a trace.

    Attributes:
        layout: Fields of a row.
        labels: Names that make a field readable: of the codes 0, 1, ... of an integer scalar
            ("phase"; "" for a code not used), of the bits of a field ending in "_mask", of the
            elements along the first axis of any other field ("q": actuator names); "q_unit":
            what actuators are measured in.
        jacobians: What there is to know of the Jacobians in fields ``sigma_<name>`` and
            ``condition_<name>``, by name. One that is not named here is never near singular.
        measures: What a log adds to the rows; None: nothing.
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
    """How to read the traces of a method.

    Args:
        layout: Fields of a row: the standard ones, and the method's own.
        robot: The robot.
        jacobians: As in `TraceFormat`.
        measures: As in `TraceFormat`.

    Raises:
        InputError: A standard field is not what it is elsewhere, or a required one is missing.
    """
    found = {item.name: item for item in layout}
    labels: dict[str, tuple[str, ...]] = {}
    for standard in STANDARD_FIELDS:
        expected, item = standard.of(robot), found.get(standard.name)
        if item is None:
            if standard.required:
                raise InputError(f"trace: no field {standard.name!r}, which every method records")
            continue
        for name in ("shape", "dtype", "unit"):
            ours, theirs = getattr(item, name), getattr(expected, name)
            if ours != theirs:
                raise InputError(
                    f"trace: field {standard.name!r} has {name} {ours!r}, expected {theirs!r}"
                )
        if names := standard.labels(robot):
            labels[standard.name] = names
    labels["q_unit"] = tuple(actuator.unit for actuator in robot.actuators)
    return TraceFormat(layout, labels, jacobians or {}, measures)


MAX_CONDITION = 1e7
"""Beyond it the smallest singular value is not resolved."""

ARM, HAND, CLOSED_CHAIN = "arm", "hand", "closed_chain"

SINGULARITY_THRESHOLDS = {ARM: (0.05, 500.0), HAND: (0.02, 200.0), CLOSED_CHAIN: (0.1, 150.0)}
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
        return _Measured(
            name, places, graph, self._compiled, kind == HAND, SINGULARITY_THRESHOLDS[kind]
        )


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
    return smallest, largest / ca.fmax(smallest, largest / MAX_CONDITION + 1e-300)
