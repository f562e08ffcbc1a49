"""How a trace is to be read: the fields that mean the same in every method, and its Jacobians.

A method's record is made of the standard fields below and of fields of its own. What looks at
traces (events, explanations, pictures) goes by the standard fields alone: a method that has such a
number under another name, or of another kind, is refused by `trace_format`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.problem.status import Phase, Status
from casadi_ik.robots.description import RobotDescription

WORD = 32
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
        words = -(-n // WORD)
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

STANDARD = (
    *(Q, POSITION_ERROR, ANGLE_ERROR, COST, STEP_SIZE, DAMPING),
    *(LIMIT_MASK, ACTIVE_MASK, RESTART, ACCEPTED, PHASE, STATUS),
)
"""All of them."""

SIGMA, CONDITION = "sigma_", "condition_"
"""What stands before the name of a Jacobian in the fields of its smallest singular value and of its
condition number; NaN where it is not measured."""

CLEARANCE = "clearance"
"""Name of the field that a log adds where there is a scene."""


def packed(flags: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Flags of all actuators (k, n) as the words of a mask, (k,) or (k, words)."""
    padded = np.pad(flags, ((0, 0), (0, -flags.shape[1] % WORD)))
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
    for standard in STANDARD:
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
