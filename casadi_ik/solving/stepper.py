"""A solve one iteration at a time, for looking on; the loop in compiled code is the fast way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels import LoopKernel
from casadi_ik.kernels.step_graph import RUNNING, StepGraph
from casadi_ik.problem.problems import Array, Problems


@runtime_checkable
class SteppedMethod(Protocol):
    """A method that is one step graph run to its end."""

    @property
    def kernel(self) -> LoopKernel:
        """The loop around its step."""
        ...

    def start(self, problems: Problems, q0: Array) -> tuple[Array, Array]:
        """First states (k, ns) and parameters (k, np) of the step graph for a batch."""
        ...


class Stepper:
    """Runs a step graph in CasADi's virtual machine, with the iterates of the compiled loop.

    Iterating over it steps until the method ends, however long that takes; a budget is the
    caller's.

    Attributes:
        graph: The step.
        iteration: Steps made so far.
        status: 0 while running, else the code with which the step ended.
    """

    def __init__(self, graph: StepGraph, state: Array, parameters: Array) -> None:
        """Start.

        Args:
            graph: The step.
            state: (ns,) the first state.
            parameters: (np,) targets, tolerances, gains.
        """
        self.graph = graph
        self.iteration = 0
        self.status = RUNNING
        self._state = np.array(state, dtype=float)
        self._parameters = np.array(parameters, dtype=float)

    @property
    def state(self) -> dict[str, Any]:
        """What the next step starts from, by name."""
        return self.graph.state.unpack(self._state.copy())

    @property
    def parameters(self) -> dict[str, Any]:
        """What is constant during the solve, by name."""
        return self.graph.parameters.unpack(self._parameters.copy())

    def step(self) -> dict[str, Any]:
        """Make one iteration.

        Returns:
            What is logged of it, by name: the fields of `StepGraph.record`. After the end it
            steps on from where the solve ended.
        """
        state, record, status = self.graph.function(self._state, self._parameters)
        self._state = _flat(state)
        self.status = int(status)
        self.iteration += 1
        values = self.graph.record.unpack(_flat(record))
        return {
            field.name: values[field.name].astype(field.dtype)[()] for field in self.graph.record
        }

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The records from here to the end."""
        while self.status == RUNNING:
            yield self.step()


def _flat(vector: Any) -> NDArray[np.float64]:
    return np.array(vector, dtype=float).reshape(-1)
