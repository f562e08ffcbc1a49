"""Parameters and open choices of Qiu & Kermani 2021, and the base class of the steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Generic, TypeVar

import casadi as ca

from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import target_fields, target_values
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.papers.qiu.tasks import HIERARCHIES
from casadi_ik.solve.trace import ANGLE_ERROR, LIMIT_MASK, PHASE, POSITION_ERROR, STATUS, Q

ORDERS = ("per-finger", "points-first")
"""Order of the tasks of the original methods: finger by finger, or all points, then all normals."""

PROJECTIONS = (*HIERARCHIES, "stacked")
"""Combination of the tasks of the original methods: a hierarchy, or one damped least-squares
problem (only with DLS, because selective damping is per task)."""

FINGER_STEPS = ("ipopt", "closed-form")
"""Solvers of the other fingers, see `QiuParameters.finger_step`."""

CHOICES = {
    "chain_tasks": ("successive", "stacked"),
    "steps": ("dls", "sdls"),
    "finger_step": FINGER_STEPS,
    "palm_error": ("euler", "rotation-vector"),
    "platform": ("arm-leg", "palm"),
    "projection": PROJECTIONS,
    "projectors": ("exact", "damped"),
    "order": ORDERS,
}
"""Admissible values by parameter; the parameter records describe them."""

MAY_BE_ZERO = ("borrowed",)
"""Numeric parameters whose value may be zero; the others are positive."""


@dataclass(frozen=True)
class QiuParameters:
    """Parameters of the enhanced methods; defaults are those of the paper where it states them.

    The solver uses millimetres and radians: the paper states damping factors without units, and
    only these units reproduce its description (lambda = 150 is "considerably large").

    Attributes:
        steps: Solver of a task: "dls" (Wampler 1986) or "sdls" (Buss & Kim 2005).
        reaching_damping: Damping lambda of thumb reaching (paper: 1), squared in the normal matrix;
            in [mm] for the position task, in [rad/rad] for the orientation tasks.
        chain_damping: Damping lambda of the closed chain (paper: 150), squared in the normal
            matrix. Source: if 150 itself is the term of the matrix (a value of 12.25 here), success
            falls from 97 % to 82 % (12 shipped grasps x 40 random arms, limits ignored).
        reaching_gamma: SDLS: largest joint change in one step of thumb reaching (paper: pi/9)
            [rad].
        chain_gamma: SDLS: largest joint change in one step of the closed chain (paper: pi/500)
            [rad].
        longest_error: SDLS: position errors are shortened to this (paper: 200) [mm].
        widest_error: SDLS: orientation errors are shortened to this (paper: pi/6) [rad].
        virtual_weight: Weight of the virtual joint in the closed chain (paper: 10).
        joint_weight: Weight of the other active joints (paper: 1).
        palm_error: "euler": differences of Euler angles, as in the paper, which does not name the
            convention; here it is ZYX, and each difference is wrapped to (-pi, pi].
            "rotation-vector": rotation logarithm and geometric Jacobian, which have no Euler
            singularity.
        palm_task: True if the estimated palm orientation is the first task of thumb reaching
            (paper: yes).
        closed_chain: True if the closed chain moves the palm (paper: yes); otherwise only the
            fingers close.
        chain_tasks: "successive": the palm's position, and its orientation in the null space of the
            position (paper). "stacked": both as one task, with rotations times `chain_lever`.
        chain_lever: Length that converts palm rotation to translation [mm/rad].
        platform: Body whose twist J_cc of eq. (8) describes: "arm-leg" as printed (without the
            last joint of the arm), or "palm" with it.
        borrowed: Number of the last arm joints that belong to the leg of the thumb in the closed
            chain (paper: 1, the 7th joint).
        finger_step: Solver of eq. (5): "ipopt" (the paper: fmincon) or "closed-form" (the same
            result, much faster).
        reaching_patience: Number of iterations without a gain of 1 % in the summed errors after
            which thumb reaching ends although palm and thumb are not within tolerance. The paper
            does not specify the end if the tasks conflict.
        reaching_iterations: Maximum number of iterations of thumb reaching.
        step_cap: Largest change of a motor per iteration [rad or m] (paper: unlimited).
        max_iterations: Maximum number of iterations of both phases together (paper: 10,000).
    """

    steps: str = "dls"
    reaching_damping: float = 1.0
    chain_damping: float = 150.0
    reaching_gamma: float = math.pi / 9
    chain_gamma: float = math.pi / 500
    longest_error: float = 200.0
    widest_error: float = math.pi / 6
    virtual_weight: float = 10.0
    joint_weight: float = 1.0
    palm_error: str = "euler"
    palm_task: bool = True
    closed_chain: bool = True
    chain_tasks: str = "successive"
    chain_lever: float = 300.0
    platform: str = "arm-leg"
    borrowed: int = 1
    finger_step: str = "ipopt"
    reaching_patience: int = 10
    reaching_iterations: int = 100
    step_cap: float = 1e9
    max_iterations: int = 10_000

    def __post_init__(self) -> None:
        _check_fields(self)


def _check_fields(record: QiuParameters | OriginalParameters) -> None:
    """Raise InputError unless every field has an admissible value."""
    for entry in fields(record):
        value = getattr(record, entry.name)
        if entry.name in CHOICES:
            if value not in CHOICES[entry.name]:
                names = ", ".join(CHOICES[entry.name])
                raise InputError(f"{entry.name}: found {value!r}, expected one of {names}")
        elif isinstance(entry.default, bool):
            if not isinstance(value, bool):
                raise InputError(f"{entry.name}: found {value!r}, expected true or false")
        else:
            _check_number(entry.name, value, isinstance(entry.default, int))


def _check_number(name: str, value: object, is_integer: bool) -> None:
    kind, types = ("an integer", (int,)) if is_integer else ("a number", (int, float))
    may_be_zero = name in MAY_BE_ZERO
    is_number = isinstance(value, types) and not isinstance(value, bool)
    is_positive = is_number and value > 0  # type: ignore[operator]
    if not (is_positive or (is_number and may_be_zero and value == 0)):
        bound = ">= 0" if may_be_zero else "> 0"
        raise InputError(f"{name}: found {value!r}, expected {kind} {bound}")


@dataclass(frozen=True)
class OriginalParameters:
    """Parameters of the original methods, the baseline of the paper: one hierarchy of all motors.

    The paper specifies only "the methods without the enhancement of the proposed approach". The
    defaults extend the hierarchy of its thumb reaching to the other fingers: the palm's
    orientation, then point and normal finger by finger, beginning with the thumb. The projection is
    augmented, and the projectors have the damping of the tasks. The means of this reading are among
    the closest to the printed ones; `studies/table_one.py` measures all readings.

    Attributes:
        steps: Solver of a task: "dls" or "sdls".
        palm_task: True if the estimated palm orientation is the first task.
        order: Order of the contact tasks, see `ORDERS`; the thumb is the first finger.
        projection: Projection that prevents tasks from disturbing those of higher priority, see
            `combine`; "stacked": one problem of all tasks without priorities.
        projectors: Pseudoinverse in the projectors: "exact", or "damped" by `damping`.
        damping: Damping lambda of a task (paper: 1) [mm; rad/rad].
        gamma: SDLS: largest joint change in one step (paper: pi/9) [rad].
        longest_error: SDLS: position errors are shortened to this (paper: 200) [mm].
        widest_error: SDLS: orientation errors are shortened to this (paper: pi/6) [rad].
        palm_error: See `QiuParameters`.
        max_iterations: Maximum number of iterations (paper: 10,000).
    """

    steps: str = "dls"
    palm_task: bool = True
    order: str = "per-finger"
    projection: str = "augmented"
    projectors: str = "damped"
    damping: float = 1.0
    gamma: float = math.pi / 9
    longest_error: float = 200.0
    widest_error: float = math.pi / 6
    palm_error: str = "euler"
    max_iterations: int = 10_000

    def __post_init__(self) -> None:
        _check_fields(self)
        if self.projection == "stacked" and self.steps != "dls":
            raise InputError(f"projection: found 'stacked' with {self.steps}, expected it with dls")


Options = TypeVar("Options", QiuParameters, OriginalParameters)


class QiuStep(Generic[Options]):
    """Base class of the steps of the paper: layouts and parameter values.

    Attributes:
        robot: Description of the robot.
        options: Parameters of the method; numeric ones are parameters of the graph.
        family: Prefix of the name of the graph.
        compilable: False if the graph can only run in CasADi's virtual machine.
        stage: Field of the state with the stage, "" if there is only one.
        state: Layout of the state that an iteration passes to the next.
        parameters: Layout of the target and the numeric parameters.
        record: Layout of the log record of an iteration.
    """

    family: str
    compilable = True
    stage = ""

    def __init__(
        self,
        robot: RobotDescription,
        options: Options,
        state: Sequence[Field],
        numbers: Sequence[Field],
        measurements: Sequence[Field],
    ) -> None:
        """Lay out state, parameters and record.

        Args:
            robot: Description of the robot.
            options: Parameters of the method.
            state: Fields of the state in addition to q.
            numbers: Fields of the parameters in addition to targets and limits.
            measurements: Fields of the record between the errors and the limits.
        """
        limits = Field("enforce_limits", doc="1: q is kept within its limits, 0: it is not")
        self.robot, self.options = robot, options
        self.state = Layout((Field("q", (len(robot.actuators),)), *state))
        self.parameters = Layout((*target_fields(robot), limits, *numbers))
        first, last = (Q, POSITION_ERROR, ANGLE_ERROR), (LIMIT_MASK, PHASE, STATUS)
        fields_of_robot = [[field.for_robot(robot) for field in fields] for fields in (first, last)]
        self.record = Layout.record(*fields_of_robot[0], *measurements, *fields_of_robot[1])

    def graph(self) -> StepGraph:
        """Return the step graph."""
        return StepGraph(
            self._name,
            self._iteration,
            self.state,
            self.parameters,
            self.record,
            self.compilable,
            stage=self.stage,
            recipe=recipe(self._name, self.robot, self.options),
        )

    @property
    def _name(self) -> str:
        return ca.Function.fix_name(f"{self.family}_{self.options.steps}_{self.robot.name}")

    def _iteration(self) -> ca.Function:
        """Return ``(state, parameters) -> (state', record, status)``."""
        raise NotImplementedError

    def first_state(self, starts: Array) -> dict[str, float | Array]:
        """Return the values of all state fields for starts (k, n)."""
        return {"q": starts}

    def parameter_values(self, targets: TargetBatch) -> dict[str, float | list[float] | Array]:
        """Return the values of all parameter fields for a batch."""
        option_names = [name for name in self.parameters.names if hasattr(self.options, name)]
        return {
            **target_values(targets),
            "enforce_limits": float(targets.enforce_limits),
            **{name: float(getattr(self.options, name)) for name in option_names},
        }

    def _inputs(self) -> tuple[ca.SX, ca.SX, dict[str, ca.SX], dict[str, ca.SX]]:
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        return state, parameters, self.state.unpack(state), self.parameters.unpack(parameters)
