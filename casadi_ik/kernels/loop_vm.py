"""A step run to its end in CasADi's virtual machine: the same iterates up to rounding."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.buffered import BufferedFunction
from casadi_ik.kernels.cancellation import stop_if_cancelled
from casadi_ik.kernels.loop_result import (
    CODE_LIMIT,
    FAILED,
    FIRST_MARK,
    FIRST_ROWS,
    NON_FINITE,
    REPEATED,
    LoopResult,
)
from casadi_ik.kernels.rows import store_rows
from casadi_ik.kernels.step_graph import RUNNING, StepGraph


def run_vm(
    step: StepGraph,
    function: ca.Function,
    result: LoopResult,
    parameters: NDArray[np.float64],
    max_iterations: int,
) -> None:
    """Solve a batch; `result` has the first states and gets everything else.

    Args:
        step: The step.
        function: Its function, row-major.
        result: As `LoopKernel.run` makes it.
        parameters: Shape (k, np) or (np,).
        max_iterations: Budget of each solve.
    """
    call = BufferedFunction(function)
    state, constants = call.inputs
    new_state, record, code = call.outputs
    records = None if result.rows is None else _Records(step, result.rows)
    for i, row in enumerate(np.broadcast_to(parameters, (len(result.states), constants.size))):
        started = perf_counter()
        state[:] = result.states[i]
        constants[:] = row
        status, iteration, mark = RUNNING, 0, b""
        while status == RUNNING and iteration < max_iterations:
            stop_if_cancelled()
            if not call():
                status = FAILED
                break
            iteration += 1
            if records is not None:
                records.add(record)
            if not (abs(code[0]) < CODE_LIMIT and np.isfinite(new_state).all()):
                status = NON_FINITE
            else:
                state[:] = new_state
                status = int(code[0])
                now = state.tobytes()
                if status == RUNNING and now == mark:
                    status = REPEATED
                if iteration >= FIRST_MARK and iteration & (iteration - 1) == 0:
                    mark = now
        result.states[i] = state
        result.iterations[i] = iteration
        result.status[i] = status
        result.time[i] = perf_counter() - started
    if records is not None:
        records.flush()
        records.trim()


class _Records:
    """Collects record vectors in a block, so that many are converted to rows at once."""

    def __init__(self, step: StepGraph, rows: NDArray[Any]) -> None:
        self._layout = step.record
        self._rows = rows
        self._written = 0
        self._block = np.empty((FIRST_ROWS, step.record.size))
        self._filled = 0

    def add(self, record: NDArray[np.float64]) -> None:
        if self._filled == len(self._block):
            self.flush()
        self._block[self._filled] = record
        self._filled += 1

    def flush(self) -> None:
        end = self._written + self._filled
        if end > len(self._rows):
            self._rows.resize(max(end, 2 * len(self._rows)), refcheck=False)
        store_rows(self._layout, self._block[: self._filled], self._rows[self._written : end])
        self._written, self._filled = end, 0

    def trim(self) -> None:
        """Give the room back that was not needed."""
        self._rows.resize(self._written, refcheck=False)
