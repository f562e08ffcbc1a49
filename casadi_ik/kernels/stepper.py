"""A solve one iteration at a time, to look at it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import KernelError
from casadi_ik.kernels.loop import LoopKernel
from casadi_ik.kernels.step_graph import RUNNING

Vector = NDArray[np.float64]

NextRound = Callable[[int, Vector], tuple[Vector, Vector] | None]
"""From the status and the last state of a round to the state (ns,) and the parameters (np,) of the
next one; None if the solve is over."""


class Stepper:
    """Makes the iterations of a loop one by one.

    Iterating over it steps until the solve is over, however long that takes; a budget is the
    caller's.

    Attributes:
        graph: The step.
        iteration: Steps made so far.
        status: 0 while running, else the code with which the solve ended.
    """

    def __init__(
        self,
        loop: LoopKernel,
        state: Vector,
        parameters: Vector,
        next_round: NextRound | None = None,
    ) -> None:
        """Start.

        Args:
            loop: What makes the steps.
            state: (ns,) the first state.
            parameters: (np,) targets, tolerances, gains.
            next_round: How a solve of several rounds goes on; None: there is one round.
        """
        self.graph = loop.step
        self.iteration = 0
        self.status = RUNNING
        self._loop = loop
        self._state = np.array(state, dtype=float)
        self._parameters = np.array(parameters, dtype=float)
        self._next_round = next_round

    @property
    def state(self) -> dict[str, Any]:
        """What the next step starts from, by name."""
        return self.graph.state.unpack(self._state.copy())

    @property
    def parameters(self) -> dict[str, Any]:
        """What is constant during a round, by name."""
        return self.graph.parameters.unpack(self._parameters.copy())

    def step(self) -> dict[str, Any]:
        """Make one iteration.

        Returns:
            What is logged of it, by name: the fields of `StepGraph.record`. After the end it
            steps on from where the solve ended.
        """
        result = self._loop.run(self._state[None], self._parameters[None], 1, trace=True)
        if not len(result.trace[0]):
            raise KernelError(f"{self.graph.name}: the function reports a failure")
        (self._state,), (row,) = result.states, result.trace[0]
        self.status = int(result.status[0])
        self.iteration += 1
        if self.status != RUNNING and self._next_round is not None:
            following = self._next_round(self.status, self._state)
            if following is not None:
                self._state, self._parameters = following
                self.status = RUNNING
        return {field.name: row[field.name] for field in self.graph.record}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """The records from here to the end."""
        while self.status == RUNNING:
            yield self.step()
