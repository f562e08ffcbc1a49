"""The methods of Qiu & Kermani 2021, each one compiled loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.errors import RowError, UnsupportedError
from casadi_ik.kernels import REPEATED, LoopKernel
from casadi_ik.methods.qiu.enhanced import EnhancedStep
from casadi_ik.methods.qiu.original import OriginalStep
from casadi_ik.methods.qiu.parameters import OriginalParameters, QiuParameters
from casadi_ik.problem.jacobian_measures import JacobianMeasures
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.problems import Array, Problems
from casadi_ik.problem.status import Status
from casadi_ik.problem.trace import TraceFormat, trace_format
from casadi_ik.robots.description import RobotDescription


class QiuMethod:
    """A method of the paper: one step graph, one start, run to its end.

    Attributes:
        name: Name of the method.
        step: Its step for this robot.
    """

    def __init__(self, name: str, step: EnhancedStep | OriginalStep, compiled: bool = True) -> None:
        """Take a step; its graph is built and compiled when first needed."""
        self.name = name
        self.step = step
        self._compiled = compiled

    @property
    def options(self) -> QiuParameters | OriginalParameters:
        """Every choice and number, the paper's by default."""
        return self.step.options

    @property
    def _robot(self) -> RobotDescription:
        return self.step.robot

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop; the virtual machine if the finger step is Ipopt's."""
        return LoopKernel(self.step.graph(), self._compiled)

    @cached_property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        measures = JacobianMeasures(self._robot, compiled=self._compiled)
        return trace_format(self.step.record, self._robot, self.step.jacobians, measures)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def prepare(self) -> None:
        """Build and compile the loop."""
        _ = self.kernel

    def start(self, problems: Problems, q0: Array) -> tuple[Array, Array]:
        """First states (k, ns) and parameters (k, np) of the step graph for a batch.

        Args:
            problems: The targets.
            q0: (k, n) configurations to start from; beyond limits that are enforced, they are
                moved to them.

        Raises:
            RowError: A free finger or a free normal.
            UnsupportedError: A fixed actuator.
        """
        self._check(problems)
        count = len(problems)
        values = self.step.parameter_values(
            problems.position_tolerance, problems.angle_tolerance, problems.enforce_limits
        )
        parameters = np.empty((count, self.step.parameters.size))
        nowhere = np.zeros(problems.points.shape[1:])
        parameters[:] = self.step.parameters.pack({"points": nowhere, "normals": nowhere, **values})
        points = self.step.parameters.slice("points")
        normals = self.step.parameters.slice("normals")
        parameters[:, points] = problems.points.reshape(count, points.stop - points.start)
        parameters[:, normals] = problems.normals.reshape(count, normals.stop - normals.start)
        limits = (self._robot.lower, self._robot.upper)
        starts = np.clip(q0, *limits) if problems.enforce_limits else q0
        first = {"q": np.zeros(q0.shape[1]), **self.step.first_state()}
        states = np.tile(self.step.state.pack(first), (count, 1))
        states[:, self.step.state.slice("q")] = starts
        return states, parameters

    def run(self, problems: Problems, q0: Array, seed: int, trace: bool) -> Outcome:  # noqa: ARG002
        """Solve a batch from one start each; see `Method.run`.

        No random numbers are drawn. A start beyond limits that are enforced is moved to them.
        """
        states, parameters = self.start(problems, q0)
        count = len(problems)
        result = self.kernel.run(states, parameters, self.options.max_iterations, trace)

        status = result.status.astype(np.int64)
        status[result.status == Status.RUNNING] = Status.ITERATION_LIMIT
        status[result.status < 0] = Status.INVALID
        status[result.status == REPEATED] = Status.STALLED
        return Outcome(
            q=result.states[:, self.step.state.slice("q")],
            status=status,
            iterations=result.iterations,
            restarts=np.zeros(count, dtype=np.int64),
            time=result.time,
            phases={
                phase.label: counts
                for phase, counts in self.step.phase_counts(
                    result.states, result.iterations
                ).items()
            },
            rows=result.rows,
        )

    def _check(self, problems: Problems) -> None:
        if problems.fixed is not None:
            raise UnsupportedError(f"method {self.name!r} cannot keep actuators fixed")
        for name, array in (("contact", problems.points), ("normal", problems.normals)):
            free = np.argwhere(np.isnan(array[..., 0]))
            if len(free):
                row, finger = problems.first_row + int(free[0, 0]), free[0, 1]
                raise RowError(
                    f"method {self.name!r} needs a {name} for every finger; row {row} has none for "
                    f"{self._robot.finger_names[finger]!r}",
                    row,
                )
