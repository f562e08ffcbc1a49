"""A method that is one step graph: started, run to its end in compiled code, stepped by hand."""

from __future__ import annotations

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.compile import LoopKernel, StepGraph
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import RowError, UnsupportedError
from casadi_ik.files.arrays import Array, Counts
from casadi_ik.kinematics.contacts import Kinds
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.method import Method, Outcome
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import JacobianMeasures, RecordedJacobian, TraceFormat, trace_format

Start = tuple[Array, Array]
"""First states (k, ns) and parameters (k, np) of a step graph."""


class LoopedMethod(ABC):
    """A method that is one step graph run to its end.

    What a method of this kind has to say of itself are `step_graph` (the iteration, with the
    layouts of its state, parameters and record), `begin` (where solves start) and `phase_counts`
    (what the iterations were spent on). Batches, steps by hand and traces follow from these.

    The state has a field "q" (n,), the configuration to return; the record has the fields that
    `trace_format` names. The step ends a solve with a code of `Status`.

    Attributes:
        name: Name of the method.
        robot: The robot.
        options: Its parameter record, a dataclass.
    """

    name: str

    phases_without_arm: tuple[Phase, ...] = ()
    """Phases in which the arm's part of q means nothing yet: its Jacobian is not measured there."""

    follows_closed_chain: bool = False
    """Whether a log measures the closed chain of arm and thumb, since the method moves along it."""

    max_iterations: int = 100_000
    """Budget of a start. This one is far above what steps allow themselves that end by a status of
    their own."""

    takes_free_contacts: bool = False
    """Whether a finger or its normal may be left free."""

    takes_fixed_actuators: bool = False
    """Whether actuators may be fixed."""

    def __init__(self, robot: RobotDescription, options: Any, compiled: bool = True) -> None:
        """Remember what the method is made of; its loop is built when first needed.

        Args:
            robot: The robot.
            options: The parameter record, a dataclass.
            compiled: False keeps to CasADi's virtual machine.
        """
        self.robot = robot
        self.options = options
        self._compiled = compiled

    @abstractmethod
    def step_graph(self) -> StepGraph:
        """The whole iteration."""

    @abstractmethod
    def begin(self, targets: TargetBatch, q0: Array) -> Start:
        """Where the solves of a batch begin; `Layout.pack_rows` lays it out.

        Args:
            targets: k targets.
            q0: (k, n) configurations to start from.
        """

    @abstractmethod
    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Iterations by phase.

        Args:
            states: (k, ns) last states.
            iterations: (k,) iterations.
        """

    def restarts(self, states: Array) -> Counts:
        """(k,) how often the solves began anew, from their last states (k, ns)."""
        return np.zeros(len(states), dtype=np.int64)

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """The Jacobians in the record, as in `TraceFormat`."""
        return {}

    @cached_property
    def graph(self) -> StepGraph:
        """The step graph, made once."""
        return self.step_graph()

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop; the virtual machine for a step that has no C code."""
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
        """How its traces are to be read."""
        return trace_format(self.graph.record, self.robot, self.jacobians, self._measures)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def prepare(self) -> None:
        """Build and compile the loop."""
        _ = self.kernel

    def for_kinds(self, kinds: Kinds) -> Method:
        """Itself: a method that knows points with normals only refuses all else in `run`."""
        del kinds
        return self

    def stepper(self, targets: TargetBatch, q0: Array) -> Stepper:
        """One target, one iteration at a time; see `Method.stepper`."""
        self._check(targets)
        states, parameters = self.begin(targets, q0[None])
        return Stepper(self.kernel, states[0], parameters[0])

    def run(self, targets: TargetBatch, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch; see `Method.run`. No random numbers are drawn."""
        del seed
        self._check(targets)
        begun = time.perf_counter()
        states, parameters = self.begin(targets, q0)
        result = self.kernel.run(states, parameters, self.max_iterations, trace)
        # What is done for all solves at once counts for each of them alike.
        outside = max(time.perf_counter() - begun - result.time.sum(), 0.0)
        counts = self.phase_counts(result.states, result.iterations)
        return Outcome(
            # A copy: the states are much larger and need not stay.
            q=result.states[:, self.graph.state.slice("q")].copy(),
            status=Status.from_loop(result.status),
            iterations=result.iterations,
            restarts=self.restarts(result.states),
            time=result.time + outside / max(len(targets), 1),
            phases={phase.label: spent for phase, spent in counts.items()},
            rows=result.rows,
        )

    def _check(self, targets: TargetBatch) -> None:
        if targets.fixed is not None and not self.takes_fixed_actuators:
            raise UnsupportedError(f"method {self.name!r} cannot keep actuators fixed")
        if self.takes_free_contacts:
            return
        for name, array in targets.more.items():
            given = np.argwhere(~np.isnan(array[..., 0]))
            if len(given):
                row, finger = targets.number(int(given[0, 0])), given[0, 1]
                raise RowError(
                    f"method {self.name!r} needs point and normal of every finger and knows no "
                    f"{name}; row {row} has one for {self.robot.finger_names[finger]!r}",
                    row,
                )
        for name, array in (("contact", targets.points), ("normal", targets.normals)):
            free = np.argwhere(np.isnan(array[..., 0]))
            if len(free):
                row, finger = targets.number(int(free[0, 0])), free[0, 1]
                raise RowError(
                    f"method {self.name!r} needs a {name} for every finger; row {row} has none for "
                    f"{self.robot.finger_names[finger]!r}",
                    row,
                )
