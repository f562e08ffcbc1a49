"""The contract between a method's iteration and the loop that runs it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Layout

RUNNING = 0
"""The step's status output while the loop has to go on; any other integer ends it."""


@dataclass(frozen=True)
class StepGraph:
    """One whole iteration of a method as one graph.

    Attributes:
        name: Identifier (letters, digits, underscores), also the kernel's file name.
        source: The function ``(state, parameters) -> (state', record, status)``, or what builds
            it when it is needed; all dense column vectors, status a scalar: `RUNNING` or the code
            with which the loop ends.
        state: Layout of the state, what an iteration hands to the next.
        parameters: Layout of the parameters, constant during one solve (targets, tolerances,
            gains), so that one kernel serves every target.
        record: Layout of what is logged of each iteration.
        compilable: False if the graph holds a node that has no C code (an Ipopt call); such a
            graph runs in CasADi's virtual machine.
        stage: Name of the number in the state by which the step chooses what to do, "" if it does
            the same always. Solves in the same stage are made side by side.
        recipe: See `recipe`; a library of the same recipe is taken without building the function.
    """

    name: str
    source: ca.Function | Callable[[], ca.Function]
    state: Layout
    parameters: Layout
    record: Layout
    compilable: bool = True
    stage: str = ""
    recipe: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.source, ca.Function):
            _ = self.function

    @property
    def stage_place(self) -> int:
        """Where in the state the stage is, -1 if there is none."""
        return self.state.slice(self.stage).start if self.stage else -1

    @cached_property
    def function(self) -> ca.Function:
        """The function, checked against the layouts.

        Raises:
            InputError: Its sizes are others.
        """
        function = self.source if isinstance(self.source, ca.Function) else self.source()
        found = (
            [function.numel_in(i) for i in range(function.n_in())],
            [function.numel_out(i) for i in range(function.n_out())],
        )
        expected = (
            [self.state.size, self.parameters.size],
            [self.state.size, self.record.size, 1],
        )
        if found != expected:
            raise InputError(f"step graph {self.name!r}: sizes {found}, layouts say {expected}")
        return function
