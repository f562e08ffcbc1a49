"""The compiled loops: what they work on, and how they are called.

`drivers/loop.c` makes one solve after the other, `drivers/loop_lanes.c` four or eight side by side.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.buffered import memory
from casadi_ik.kernels.driver_code import SLICE, DriverCode, check
from casadi_ik.kernels.loop_result import LoopResult
from casadi_ik.kernels.rows import opaque
from casadi_ik.kernels.step_graph import StepGraph

SLOTS = 32
"""Solves under way at once, of which four or eight have the lanes."""

FIRST_MARK = 16
"""Iteration, a power of two, of the first state that later ones are compared with."""


class Job(ctypes.Structure):
    """`loop_job` of drivers/loop_job.c."""

    _fields_ = (
        ("states", ctypes.c_void_p),
        ("parameters", ctypes.c_void_p),
        ("parameter_step", ctypes.c_int64),
        ("iterations", ctypes.c_void_p),
        ("status", ctypes.c_void_p),
        ("seconds", ctypes.c_void_p),
        ("mark", ctypes.c_void_p),
        ("rows", ctypes.c_void_p),
        ("capacity", ctypes.c_int64),
        ("used", ctypes.c_int64),
        ("count", ctypes.c_int64),
        ("solve", ctypes.c_int64),
        ("max_iterations", ctypes.c_int64),
        ("slice", ctypes.c_double),
        ("places", ctypes.c_void_p),
        ("slots", ctypes.c_void_p),
    )


class CompiledBatch:
    """A batch on its way through a compiled loop."""

    def __init__(
        self, step: StepGraph, result: LoopResult, parameters: NDArray[np.float64], budget: int
    ) -> None:
        """Keep the arrays; `result` has the first states and gets everything else.

        Args:
            step: The step.
            result: As `LoopKernel.run` makes it.
            parameters: Shape (k, np), or (np,) for all solves.
            budget: Iterations of each solve.
        """
        self.name = step.name
        self.result = result
        self._parameters = parameters
        self._places = np.empty((0, 2), dtype=np.int64)
        self._mark = np.zeros((SLOTS, step.state.size))
        self.job = Job(
            states=memory(result.states),
            parameters=memory(parameters),
            parameter_step=0 if parameters.ndim == 1 else parameters.shape[1],
            iterations=memory(result.iterations),
            status=memory(result.status),
            seconds=memory(result.time),
            mark=memory(self._mark),
            count=len(result.states),
            max_iterations=budget,
            slice=SLICE,
        )

    def run(self, loop: Any) -> None:
        """One solve after the other.

        Args:
            loop: `casadi_ik_loop` of a library.

        Raises:
            KernelError: No work memory.
        """
        self._run(loop)

    def run_side_by_side(self, loop: Any) -> LoopResult:
        """As many solves at a time as there are lanes.

        Args:
            loop: `casadi_ik_loop_lanes` of a library.

        Returns:
            The result, its rows solve by solve.

        Raises:
            KernelError: No work memory, or the step failed.
        """
        slots = np.full(SLOTS, -1, dtype=np.int64)
        self.job.slots = memory(slots)
        if self.result.rows is not None:
            self._places = np.empty((len(self.result.rows), 2), dtype=np.int64)
        self._run(loop)
        if self.result.rows is None:
            return self.result
        return replace(self.result, rows=self._in_order(self.result.rows))

    def _run(self, loop: Any) -> None:
        if self.result.rows is not None:
            self._rows_to(len(self.result.rows))
        while (code := loop(ctypes.byref(self.job))) != DriverCode.DONE:
            check(self.name, code)
            if code == DriverCode.ROWS_FULL:
                self._rows_to(2 * self.job.capacity)
        self._rows_to(self.job.used)

    def _rows_to(self, count: int) -> None:
        """Make room for so many rows, in place: a long trace is not copied."""
        rows = self.result.rows
        if rows is not None:
            rows.resize(count, refcheck=False)
            self._places.resize((count, 2), refcheck=False)
            self.job.rows, self.job.places = memory(rows), memory(self._places)
            self.job.capacity = count

    def _in_order(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Rows solve by solve, from the order in which they were made."""
        iterations = self.result.iterations
        first = np.cumsum(iterations) - iterations
        solve, iteration = self._places.T
        ordered = np.empty_like(rows)
        opaque(ordered)[first[solve] + iteration] = opaque(rows)
        return ordered
