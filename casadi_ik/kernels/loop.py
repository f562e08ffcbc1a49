"""A step run to its end: the one loop, in compiled code, with every iteration recorded."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError
from casadi_ik.kernels.buffered import BufferedFunction, doubles, memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.codegen import define, driver_text, row_major
from casadi_ik.kernels.outcome import SLICE, Outcome, check
from casadi_ik.kernels.rows import row_driver, split_rows, store_rows
from casadi_ik.kernels.step_graph import RUNNING, StepGraph

NON_FINITE = -1
"""Status of a solve whose state or status became NaN or infinite; its last finite state stays."""

FAILED = -2
"""Status of a solve whose step reported a failure; the state before that step stays."""

REPEATED = -3
"""Status of a solve that came back to an earlier state bit for bit, and so would for ever."""

FIRST_ROWS = 256
"""Rows a trace starts with; it doubles when they are full."""

CODE_LIMIT = 2**31 - 1
"""A status has to be smaller than this (it is kept as int32)."""

SYMBOL = "casadi_ik_loop"


@dataclass(frozen=True, eq=False)
class LoopResult:
    """What a batch of k solves came to.

    Attributes:
        states: Last states, shape (k, ns).
        iterations: Steps made, shape (k,); the one that became non-finite counts.
        status: Shape (k,): the step's status, `RUNNING` if the iterations ran out, `NON_FINITE`,
            `FAILED` or `REPEATED`.
        time: Seconds inside the loop, shape (k,).
        rows: The records of all iterations of all solves, one after the other, shape
            (sum of iterations,), of the record layout's dtype; None if no trace was asked for.
    """

    states: NDArray[np.float64]
    iterations: NDArray[np.int64]
    status: NDArray[np.int32]
    time: NDArray[np.float64]
    rows: NDArray[Any] | None = None

    @cached_property
    def trace(self) -> tuple[NDArray[Any], ...]:
        """The rows of each solve, views into `rows`; empty if no trace was asked for."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)


class _Job(ctypes.Structure):
    """`loop_job` of drivers/loop.c."""

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
    )


def _job(
    step: StepGraph, result: LoopResult, parameters: NDArray[np.float64], max_iterations: int
) -> tuple[_Job, NDArray[np.float64]]:
    """A job without a trace, and memory that has to live as long."""
    mark = np.empty(step.state.size)
    job = _Job(
        states=memory(result.states),
        parameters=memory(parameters),
        parameter_step=0 if parameters.ndim == 1 else parameters.shape[1],
        iterations=memory(result.iterations),
        status=memory(result.status),
        seconds=memory(result.time),
        mark=memory(mark),
        count=len(result.states),
        max_iterations=max_iterations,
        slice=SLICE,
    )
    return job, mark


class SingleSolve:
    """One compiled solve on fixed arrays, without a trace; not to be shared by threads.

    Attributes:
        parameters: (np,) write into it.
        result: Of a batch of one; write the first state into `states`, a call overwrites all.
    """

    def __init__(self, step: StepGraph, loop: Any) -> None:
        self.parameters = np.zeros(step.parameters.size)
        self.result = LoopResult(
            states=np.zeros((1, step.state.size)),
            iterations=np.zeros(1, dtype=np.int64),
            status=np.zeros(1, dtype=np.int32),
            time=np.zeros(1),
        )
        self._name = step.name
        self._loop = loop
        self._job, self._mark = _job(step, self.result, self.parameters, 0)
        self._reference = ctypes.byref(self._job)

    def __call__(self, max_iterations: int) -> None:
        """Solve, as `LoopKernel.run` does.

        Raises:
            KernelError: No work memory.
        """
        result, job = self.result, self._job
        result.iterations[0], result.status[0], result.time[0] = 0, RUNNING, 0.0
        job.solve, job.max_iterations = 0, max_iterations
        while (code := self._loop(self._reference)) != Outcome.DONE:
            check(self._name, code)


class LoopKernel:
    """Runs a step until it ends, for each solve of a batch; several threads may run it at once.

    Attributes:
        step: The step.
        compiled: Whether the loop runs in compiled code. Otherwise the same graph runs in
            CasADi's virtual machine, with the same iterates and records.
    """

    def __init__(self, step: StepGraph, compiled: bool = True) -> None:
        """Compile the step with its loop or load them from the cache.

        Args:
            step: One iteration of a method.
            compiled: False keeps to the virtual machine.

        Raises:
            KernelError: The step says it is compilable but has no C code, or the compiler
                refused it.
        """
        self.step = step
        library = self._load() if compiled and step.compilable else None
        self.compiled = library is not None
        self._loop: Any = None if library is None else library[SYMBOL]

    def _load(self) -> ctypes.CDLL | None:
        constants = {
            "N_STATE": self.step.state.size,
            "RUNNING": RUNNING,
            "NON_FINITE": NON_FINITE,
            "FAILED": FAILED,
            "REPEATED": REPEATED,
            "CODE_LIMIT": CODE_LIMIT,
        }
        driver = define(constants) + row_driver(self.step.record) + driver_text("loop")
        return load_library(
            self.step.name, lambda: self._function, driver, SYMBOL, self.step.recipe
        )

    @cached_property
    def _function(self) -> ca.Function:
        return row_major(self.step.function)

    def run(
        self, states: Any, parameters: Any, max_iterations: int, trace: bool = False
    ) -> LoopResult:
        """Solve a batch.

        A solve ends when the step's status is not `RUNNING`, when the new state or the status is
        not finite, when the new state is an earlier one once more (drivers/loop.c), or after
        `max_iterations`. Neither the first state nor the parameters are looked at: a step may
        take NaN there to mean something.

        Args:
            states: First states, shape (k, ns); not changed.
            parameters: Shape (k, np), or (np,) for all solves.
            max_iterations: Budget of each solve, >= 0.
            trace: Whether to keep the record of every iteration.

        Returns:
            Last states, counts, status, times and, if asked for, the records.

        Raises:
            InputError: A shape or `max_iterations` is wrong.
        """
        first = doubles(states)
        given = doubles(parameters)
        n_state, n_parameters = self.step.state.size, self.step.parameters.size
        if first.ndim != 2 or first.shape[1] != n_state:
            raise InputError(
                f"{self.step.name}: states have shape {first.shape}, expected (k, {n_state})"
            )
        count = len(first)
        if given.shape not in ((n_parameters,), (count, n_parameters)):
            raise InputError(
                f"{self.step.name}: parameters have shape {given.shape}, "
                f"expected ({n_parameters},) or ({count}, {n_parameters})"
            )
        if max_iterations < 0:
            raise InputError(f"{self.step.name}: max_iterations is {max_iterations}, expected >= 0")
        result = LoopResult(
            states=first.copy(),
            iterations=np.zeros(count, dtype=np.int64),
            status=np.full(count, RUNNING, dtype=np.int32),
            time=np.zeros(count),
            rows=np.empty(min(FIRST_ROWS, count * max_iterations), dtype=self.step.record.dtype)
            if trace
            else None,
        )
        run = self._run_compiled if self.compiled else self._run_vm
        run(result, given, max_iterations)
        if result.rows is not None:
            # In place: the memory of a long trace is handed back, not copied.
            result.rows.resize(int(result.iterations.sum()), refcheck=False)
        return result

    def single(self) -> SingleSolve:
        """One solve with memory of its own, to be made again and again; of compiled loops only."""
        return SingleSolve(self.step, self._loop)

    def _run_compiled(
        self, result: LoopResult, parameters: NDArray[np.float64], max_iterations: int
    ) -> None:
        job, _mark = _job(self.step, result, parameters, max_iterations)
        if result.rows is not None:
            job.rows, job.capacity = memory(result.rows), len(result.rows)
        while (code := self._loop(ctypes.byref(job))) != Outcome.DONE:
            check(self.step.name, code)
            if code == Outcome.ROWS_FULL and result.rows is not None:
                result.rows.resize(2 * len(result.rows), refcheck=False)
                job.rows, job.capacity = memory(result.rows), len(result.rows)

    def _run_vm(
        self, result: LoopResult, parameters: NDArray[np.float64], max_iterations: int
    ) -> None:
        call = BufferedFunction(self._function)
        state, constants = call.inputs
        new_state, record, code = call.outputs
        records = None if result.rows is None else _Records(self.step, result.rows)
        for i, row in enumerate(np.broadcast_to(parameters, (len(result.states), constants.size))):
            started = perf_counter()
            state[:] = result.states[i]
            constants[:] = row
            status, iteration, mark = RUNNING, 0, b""
            while status == RUNNING and iteration < max_iterations:
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
                    if iteration & (iteration - 1) == 0:
                        mark = now
            result.states[i] = state
            result.iterations[i] = iteration
            result.status[i] = status
            result.time[i] = perf_counter() - started
        if records is not None:
            records.flush()


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
