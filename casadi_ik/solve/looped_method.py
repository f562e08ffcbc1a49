"""Base class of methods that iterate a single step graph, and the limits inside such a step."""

from __future__ import annotations

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile import LoopKernel, StepGraph
from casadi_ik.compile.layout import Field
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import RowError, UnsupportedError
from casadi_ik.files.arrays import Array, Counts
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.kinematics.couplings import has_toggle, toggle_margins
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.method import HandSearch, Method, Outcome
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import (
    WORD_BITS,
    JacobianMeasures,
    RecordedJacobian,
    TraceFormat,
    trace_format,
)

Start = tuple[Array, Array]
"""Initial states (k, ns) and parameters (k, np) of a step graph."""


class LoopedMethod(ABC):
    """Base class of methods that iterate a single step graph.

    A subclass defines `step_graph` (the iteration, with the layouts of its state, parameters and
    record), `begin` (initial states) and `phase_counts` (iterations by phase). Batches, steppers
    and traces follow from these.

    The state has a field "q" (n,), the configuration to return; the record has the fields that
    `trace_format` names. The step ends a solve with a code of `Status`.

    Attributes:
        name: Name of the method.
        robot: Robot that the method is built for.
        options: Parameter record, a dataclass.
    """

    name: str

    preferences: tuple[str, ...] = ()
    """Preferences that the method supports, see `Method.preferences`."""

    phases_without_arm: tuple[Phase, ...] = ()
    """Phases in which the arm's part of q is undefined; the arm Jacobian is not measured there."""

    follows_closed_chain: bool = False
    """True if the method moves along the closed chain of arm and thumb; a log then measures it."""

    max_iterations: int = 100_000
    """Maximum number of iterations of a start. The default exceeds the iterations of any step
    with a stopping rule."""

    takes_free_contacts: bool = False
    """True if a finger or its normal may be free."""

    takes_fixed_actuators: bool = False
    """True if actuators may be fixed."""

    def __init__(self, robot: RobotDescription, options: Any, compiled: bool = True) -> None:
        """Store the arguments; the loop is built when first needed.

        Args:
            robot: The robot.
            options: Parameter record, a dataclass.
            compiled: False: use CasADi's virtual machine.
        """
        self.robot = robot
        self.options = options
        self._compiled = compiled

    @abstractmethod
    def step_graph(self) -> StepGraph:
        """Build the graph of an iteration."""

    @abstractmethod
    def begin(self, targets: TargetBatch) -> Start:
        """Return the initial states and parameters of k targets, see `Layout.pack_rows`."""

    @abstractmethod
    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Return the number of iterations by phase.

        Args:
            states: (k, ns) final states.
            iterations: (k,) iterations.
        """

    def restarts(self, states: Array) -> Counts:
        """Return the number of restarts (k,) of solves with these final states (k, ns)."""
        return np.zeros(len(states), dtype=np.int64)

    @property
    def hand_search(self) -> HandSearch | None:
        """Hand search of the method; None, because it is a black box. See `Method.hand_search`."""
        return None

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Jacobians in the record, as in `TraceFormat`."""
        return {}

    @cached_property
    def graph(self) -> StepGraph:
        """Step graph, built once."""
        return self.step_graph()

    @cached_property
    def kernel(self) -> LoopKernel:
        """Compiled loop; CasADi's virtual machine for a step that cannot be compiled."""
        return LoopKernel(self.graph, self._compiled)

    @cached_property
    def _measures(self) -> JacobianMeasures:
        return JacobianMeasures(
            self.robot,
            without_arm=self.phases_without_arm,
            closed_chain=self.follows_closed_chain,
            compiled=self._compiled,
        )

    @property
    def trace_format(self) -> TraceFormat:
        """Layout and labels of the rows of a trace."""
        return trace_format(self.graph.record, self.robot, self.jacobians, self._measures)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Fields of the parameter record by name."""
        return dataclasses.asdict(self.options)

    def prepare(self) -> None:
        """Build and compile the loop."""
        _ = self.kernel

    def for_kinds(self, kinds: Kinds) -> Method:
        """Return the method itself; `run` refuses contacts other than points with normals."""
        del kinds
        return self

    def stepper(self, targets: TargetBatch) -> Stepper:
        """Return a stepper of one target, see `Method.stepper`."""
        self._check(targets)
        states, parameters = self.begin(targets)
        return Stepper(self.kernel, states[0], parameters[0])

    def run(self, targets: TargetBatch, trace: bool = False) -> Outcome:
        """Solve a batch, see `Method.run`; no random numbers are drawn."""
        self._check(targets)
        started = time.perf_counter()
        states, parameters = self.begin(targets)
        result = self.kernel.run(states, parameters, self.max_iterations, trace)
        # Time spent on the batch as a whole is divided equally among its solves.
        overhead = max(time.perf_counter() - started - result.time.sum(), 0.0)
        counts = self.phase_counts(result.states, result.iterations)
        return Outcome(
            # A copy releases the states, which are much larger.
            q=result.states[:, self.graph.state.slice("q")].copy(),
            status=Status.from_loop(result.status),
            iterations=result.iterations,
            restarts=self.restarts(result.states),
            time=result.time + overhead / max(len(targets), 1),
            phases={phase.label: count for phase, count in counts.items()},
            rows=result.rows,
        )

    def _check(self, targets: TargetBatch) -> None:
        """Check that the method supports the targets.

        Raises:
            UnsupportedError: Actuators are fixed.
            RowError: A contact has a vector that the method does not support, or lacks one.
        """
        if targets.fixed is not None and not self.takes_fixed_actuators:
            raise UnsupportedError(f"fixed: method {self.name!r} cannot keep actuators fixed")
        if self.takes_free_contacts:
            return
        for name, array in targets.extra_vectors.items():
            present = np.argwhere(~np.isnan(array[..., 0]))
            if len(present):
                row, finger = targets.row_number(int(present[0, 0])), present[0, 1]
                raise RowError(
                    f"{name}: row {row} has a value for {self.robot.finger_names[finger]!r}, which "
                    f"method {self.name!r} does not support; expected point and normal only",
                    row,
                )
        for name, array in (("points", targets.points), ("normals", targets.normals)):
            free = np.argwhere(np.isnan(array[..., 0]))
            if len(free):
                row, finger = targets.row_number(int(free[0, 0])), free[0, 1]
                raise RowError(
                    f"{name}: row {row} has no value for {self.robot.finger_names[finger]!r}; "
                    f"method {self.name!r} expects a point and a normal for every finger",
                    row,
                )


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
