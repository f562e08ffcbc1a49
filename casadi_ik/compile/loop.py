"""The loop that runs a step to its end, in compiled code or in CasADi's virtual machine.

It can record every iteration, and `Stepper` makes one iteration at a time.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import SLICE, DriverCode, cached_only, check, stop_if_cancelled
from casadi_ik.compile.codegen import c_struct, define, driver_text, row_major
from casadi_ik.compile.function_kernel import BufferedFunction, doubles, machine_lanes, memory
from casadi_ik.compile.graphs import RUNNING, StepGraph
from casadi_ik.compile.layout import opaque, row_driver, split_rows, store_rows
from casadi_ik.compile.libraries import NotCachedError, load_function
from casadi_ik.errors import InputError, KernelError

NON_FINITE = -1
"""Status of a solve whose state or status became NaN or infinite; it keeps the last finite
state."""

FAILED = -2
"""Status of a solve whose step reported a failure; it keeps the state before that step."""

REPEATED = -3
"""Status of a solve that returned to an earlier state bit for bit and would cycle."""

UNBEGUN = -4
"""Status of a solve that has not started."""

FIRST_ROWS = 256
"""Minimum initial capacity of a trace [rows]; the capacity doubles when it is full."""

FIRST_MARK = 16
"""First iteration (a power of two) whose state is compared with later ones to detect cycles."""

CODE_LIMIT = 2**31 - 1
"""Bound of a status, which is stored as int32."""


@dataclass(frozen=True, eq=False)
class LoopResult:
    """Results of a batch of k solves.

    Attributes:
        states: Last states, shape (k, ns).
        iterations: Number of steps, shape (k,), including a step that became non-finite.
        status: Shape (k,): the step's status, `RUNNING` if the iterations ran out, `NON_FINITE`,
            `FAILED` or `REPEATED`.
        time: Seconds inside the loop, shape (k,); solves in lanes share them.
        rows: Records of all iterations, solve by solve, shape (sum of iterations,), of the record
            layout's dtype; None without a trace.
    """

    states: NDArray[np.float64]
    iterations: NDArray[np.int64]
    status: NDArray[np.int32]
    time: NDArray[np.float64]
    rows: NDArray[Any] | None = None

    @cached_property
    def trace(self) -> tuple[NDArray[Any], ...]:
        """Rows of each solve as views into `rows`; empty without a trace."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)


def run_vm(
    kernel: LoopKernel,
    result: LoopResult,
    parameters: NDArray[np.float64],
    max_iterations: int,
) -> None:
    """Solve a batch in the virtual machine; `result` has the first states and receives the rest.

    Args:
        kernel: Loop of the step.
        result: Result with the first states.
        parameters: Shape (k, np) or (np,).
        max_iterations: Maximum number of iterations of each solve.
    """
    step = kernel.step
    step_call: Any = step.virtual() if step.virtual else BufferedFunction(kernel.function)
    state, constants = step_call.inputs
    new_state, record, code = step_call.outputs
    records = None if result.rows is None else _Records(step, result.rows)
    for i, row in enumerate(np.broadcast_to(parameters, (len(result.states), constants.size))):
        started = perf_counter()
        state[:] = result.states[i]
        constants[:] = row
        status, iteration, compared_state = RUNNING, 0, b""
        while status == RUNNING and iteration < max_iterations:
            stop_if_cancelled()
            if not step_call():
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
                current = state.tobytes()
                if status == RUNNING and current == compared_state:
                    status = REPEATED
                if iteration >= FIRST_MARK and iteration & (iteration - 1) == 0:
                    compared_state = current
        result.states[i] = state
        result.iterations[i] = iteration
        result.status[i] = status
        result.time[i] = perf_counter() - started
    if records is not None:
        records.flush()
        records.trim()


class _Records:
    """Buffer of record vectors, which are converted to rows in blocks."""

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
        """Release unused capacity."""
        self._rows.resize(self._written, refcheck=False)


LOOP_SYMBOL = "casadi_ik_loop"

SLOTS = 32
"""Number of slots, which hold the solves in progress; four or eight of them are in the lanes."""

MIN_SOLVES_IN_LANES = 4
"""Minimum number of solves for which lanes are used."""

NO_LIMIT = 2**62
"""Number of steps of a call without a bound."""

MIN_BATCH_FOR_LANES = 64
"""Minimum batch size for which the loop with lanes is compiled if it is not in the cache.

Without lanes a solve takes one to two milliseconds; the compilation takes about a minute."""

CACHE_RECHECK_SOLVES = 1000
"""Number of solves in small batches after which the cache is searched again."""

TRACE_GROWTH = 1.25
"""Initial capacity of a trace relative to the size of the previous trace."""

MAX_FIRST_TRACE_BYTES = 2**24
"""Maximum initial capacity of a trace [bytes]."""


Job = c_struct("loop_job", driver="jobs")


@dataclass(frozen=True)
class SlotSource:
    """Memory from which the slots load solves, and the method's callback.

    Attributes:
        states: Address of the first state.
        parameters: Address of the first parameters.
        step: Distance between consecutive states [doubles].
        slots: Number of slots, at most `SLOTS`.
        parameter_step: Distance between consecutive parameters [doubles]; 0: shared by all solves;
            None: `step`.
        follow: Address of the callback for a slot whose solve has ended; 0: none.
        method: Address of the callback's context.
    """

    states: int
    parameters: int
    step: int
    slots: int
    parameter_step: int | None = None
    follow: int = 0
    method: int = 0


class CompiledBatch:
    """Batch of solves, with the memory of a compiled loop."""

    def __init__(
        self, step: StepGraph, result: LoopResult, starts: SlotSource, budget: int
    ) -> None:
        """Allocate the memory of the loop.

        Args:
            step: The step.
            result: Result with the first states; the loop writes its other fields.
            starts: Memory from which the slots load solves.
            budget: Maximum number of iterations of each start.
        """
        self.name = step.name
        self.result = result
        slots = starts.slots
        self._row_owners = np.empty((0, 2), dtype=np.int64)
        self._slots = np.full(slots, -1, dtype=np.int64)
        self._iterations_before = np.zeros(slots, dtype=np.int64)
        self._mark = np.zeros((slots, step.state.size))
        self.job = Job(
            states=starts.states,
            parameters=starts.parameters,
            state_step=starts.step,
            parameter_step=starts.step if starts.parameter_step is None else starts.parameter_step,
            iterations=memory(result.iterations),
            status=memory(result.status),
            seconds=memory(result.time),
            slots=memory(self._slots),
            iterations_before=memory(self._iterations_before),
            mark=memory(self._mark),
            slot_count=slots,
            count=len(result.status),
            max_iterations=budget,
            remaining_steps=NO_LIMIT,
            min_solves=MIN_SOLVES_IN_LANES,
            slice=SLICE,
            follow=starts.follow,
            method=starts.method,
        )

    def run(self, lane_loop: Any, scalar_loop: Any) -> LoopResult:
        """Solve the batch.

        Args:
            lane_loop: The loop with lanes; None if there is none.
            scalar_loop: The loop without lanes, which also computes the last few solves.

        Returns:
            The result, with rows in the order of the solves.

        Raises:
            MemoryError: There is no work memory.
        """
        loop = lane_loop or scalar_loop
        if self.result.rows is not None:
            self._resize_rows(len(self.result.rows))
        while (code := loop(ctypes.byref(self.job))) != DriverCode.DONE:
            check(self.name, code)
            if code == DriverCode.ROWS_FULL:
                self._resize_rows(2 * self.job.capacity)
            if code == DriverCode.FEW_LEFT:
                loop = scalar_loop
        self._resize_rows(self.job.n_rows)
        if self.result.rows is None or self.job.count == 1:
            return self.result
        return replace(self.result, rows=self._rows_by_solve(self.result.rows))

    def _resize_rows(self, count: int) -> None:
        """Resize the rows in place, so that a long trace is not copied."""
        rows = self.result.rows
        if rows is not None:
            rows.resize(count, refcheck=False)
            self._row_owners.resize((count, 2), refcheck=False)
            self.job.rows, self.job.row_owners = memory(rows), memory(self._row_owners)
            self.job.capacity = count

    def _rows_by_solve(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Reorder rows from the order of computation to the order of the solves."""
        iterations = self.result.iterations
        first = np.cumsum(iterations) - iterations
        solve, iteration = self._row_owners.T
        ordered = np.empty_like(rows)
        opaque(ordered)[first[solve] + iteration] = opaque(rows)
        return ordered


class LoopKernel:
    """The loop of one step, for batches of solves; several threads may run it at once.

    Attributes:
        step: The step.
        compiled: True if the loop runs in compiled code. Otherwise the same graph runs in CasADi's
            virtual machine, with the same iterates and records up to rounding of sines and arcs.
        entry: The compiled loop without lanes; None if there is none.
    """

    def __init__(self, step: StepGraph, compiled: bool = True) -> None:
        """Compile the step and its loop, or load them from the cache.

        Args:
            step: One iteration of a method.
            compiled: False uses the virtual machine.

        Raises:
            KernelError: The step is declared compilable but has no C code, or compiling failed.
        """
        self.step = step
        library = self._load() if compiled and step.compilable else None
        self.compiled = library is not None
        self.entry: Any = None if library is None else library[LOOP_SYMBOL]
        self._rows_each = 0.0
        self._solves_until_recheck = 0

    def _load(self, lanes: int = 1) -> ctypes.CDLL | None:
        """Load the library of the loop with a number of lanes."""
        step = self.step
        name = step.name if lanes == 1 else f"{step.name}_lanes{lanes}"
        wide = lanes == 1 and machine_lanes() > 0
        return load_function(
            name, lambda: step.function, self._driver(), LOOP_SYMBOL, step.recipe, lanes, wide
        )

    @property
    def lanes(self) -> int:
        """Number of lanes in which a batch is solved; 1 without lanes."""
        return 1 if self._lane_loop is None else machine_lanes()

    def loop_for(self, count: int) -> Any:
        """Return the loop with lanes if it pays for a batch of this size, otherwise None."""
        if count < MIN_SOLVES_IN_LANES:
            return None
        if count >= MIN_BATCH_FOR_LANES or "_lane_loop" in vars(self):
            return self._lane_loop
        self._solves_until_recheck -= count
        return None if self._solves_until_recheck > 0 else self._cached_lane_loop

    @property
    def _cached_lane_loop(self) -> Any:
        """The loop with lanes if it is in the cache, otherwise None."""
        try:
            with cached_only():
                return self._lane_loop
        except NotCachedError:
            self._solves_until_recheck = CACHE_RECHECK_SOLVES  # a search of the cache takes 1 ms
            return None

    @cached_property
    def _lane_loop(self) -> Any:
        """The loop with lanes; None if there is none."""
        lanes = machine_lanes() if self.compiled else 0
        if not lanes:
            return None
        try:
            library = self._load(lanes)
        except KernelError as error:
            warnings.warn(f"batches run without lanes: {error}", RuntimeWarning, stacklevel=2)
            return None
        return None if library is None else library[LOOP_SYMBOL]

    @property
    def constants(self) -> dict[str, int]:
        """Constants that the runtime needs, except those of `row_driver`."""
        return {
            "N_STATE": self.step.state.size,
            "N_PARAMETERS": self.step.parameters.size,
            "N_LOADED": self.step.loaded_parameters,
            "RUNNING": RUNNING,
            "NON_FINITE": NON_FINITE,
            "REPEATED": REPEATED,
            "CODE_LIMIT": CODE_LIMIT,
            "SLOTS": SLOTS,
            "FIRST_MARK": FIRST_MARK,
            "STAGE": self.step.stage_index,
        }

    def _driver(self) -> str:
        """Return the C text of the loop with its constants."""
        texts = driver_text("jobs"), driver_text("loop")
        return define(self.constants) + row_driver(self.step.record) + "".join(texts)

    @cached_property
    def function(self) -> Any:
        """The step as a row-major Function, or its stages."""
        return row_major(self.step.function)

    def run(
        self, states: Any, parameters: Any, max_iterations: int, trace: bool = False
    ) -> LoopResult:
        """Solve a batch.

        A solve ends when the step's status is not `RUNNING`, when the new state or the status is
        not finite, when the new state repeats an earlier one (runtime/loop.c), or after
        `max_iterations`. The first state and the parameters are not checked, since NaN may have a
        meaning for a step.

        Args:
            states: First states, shape (k, ns); not changed.
            parameters: Shape (k, np), or (np,) for all solves.
            max_iterations: Maximum number of iterations of each solve, >= 0.
            trace: True to keep the record of every iteration.

        Returns:
            Last states, iterations, status, times and, with a trace, the records.

        Raises:
            InputError: A shape or `max_iterations` is wrong.
        """
        stop_if_cancelled()
        first = doubles(states)
        values = doubles(parameters)
        n_state, n_parameters = self.step.state.size, self.step.parameters.size
        if first.ndim != 2 or first.shape[1] != n_state:
            raise InputError(
                f"{self.step.name}: states have shape {first.shape}, expected (k, {n_state})"
            )
        count = len(first)
        if values.shape not in ((n_parameters,), (count, n_parameters)):
            raise InputError(
                f"{self.step.name}: parameters have shape {values.shape}, "
                f"expected ({n_parameters},) or ({count}, {n_parameters})"
            )
        if max_iterations < 0:
            raise InputError(f"{self.step.name}: max_iterations is {max_iterations}, expected >= 0")
        result = self._empty(first.copy(), trace)
        if not self.compiled:
            run_vm(self, result, values, max_iterations)
            return result
        if not max_iterations:
            return replace(result, rows=np.empty(0, self.step.record.dtype) if trace else None)
        source = SlotSource(
            memory(result.states),
            memory(values),
            n_state,
            slots=SLOTS,
            parameter_step=0 if values.ndim == 1 else n_parameters,
        )
        return self._drive(CompiledBatch(self.step, result, source, max_iterations))

    def run_from_slots(
        self, starts: SlotSource, count: int, max_iterations: int, trace: bool
    ) -> LoopResult:
        """Solve a batch whose starts a callback writes; see `follow` in runtime/jobs.c.

        Args:
            starts: Memory of the starts and the callback; compiled code only.
            count: Number of solves.
            max_iterations: Maximum number of iterations of each start, >= 1.
            trace: True to keep the record of every iteration.

        Returns:
            The result of `run` without states.
        """
        stop_if_cancelled()
        result = self._empty(np.empty((count, 0)), trace)
        result.status[...] = UNBEGUN
        return self._drive(CompiledBatch(self.step, result, starts, max_iterations))

    def _empty(self, states: NDArray[np.float64], trace: bool) -> LoopResult:
        count = len(states)
        return LoopResult(
            states=states,
            iterations=np.zeros(count, dtype=np.int64),
            status=np.full(count, RUNNING, dtype=np.int32),
            time=np.zeros(count),
            rows=np.empty(self._first_rows(count), dtype=self.step.record.dtype) if trace else None,
        )

    def _drive(self, batch: CompiledBatch) -> LoopResult:
        count = len(batch.result.status)
        result = batch.run(self.loop_for(count), self.entry)
        if count and result.rows is not None:
            self._rows_each = len(result.rows) / count
        return result

    def _first_rows(self, count: int) -> int:
        """Return the initial capacity of a trace [rows], from the size of the previous trace.

        Growing a trace clears the new memory, which costs more than writing the rows.
        """
        if not self.compiled:
            return 0
        rows = int(TRACE_GROWTH * self._rows_each * count) + FIRST_ROWS
        return min(
            rows, max(MAX_FIRST_TRACE_BYTES // max(self.step.record.dtype.itemsize, 1), FIRST_ROWS)
        )


Vector = NDArray[np.float64]

NextRestart = Callable[[int, Vector], tuple[Vector, Vector] | None]
"""Function from the status and last state of a restart to the state (ns,) and parameters (np,) of
the next restart; None if the solve is finished."""


class Stepper:
    """Execution of a loop in single iterations.

    Iterating over a stepper makes steps until the solve ends; the caller limits their number.

    Attributes:
        graph: The step.
        iteration: Number of steps so far.
        status: 0 while running, otherwise the code with which the solve ended.
    """

    def __init__(
        self,
        loop: LoopKernel,
        state: Vector,
        parameters: Vector,
        next_round: NextRestart | None = None,
    ) -> None:
        """Start a solve.

        Args:
            loop: Loop of the step.
            state: (ns,) the first state.
            parameters: (np,) targets, tolerances, gains.
            next_round: Callback that starts the next restart; None: no restarts.
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
        """Fields of the state from which the next step starts, by name."""
        return self.graph.state.unpack(self._state.copy())

    @property
    def parameters(self) -> dict[str, Any]:
        """Fields of the parameters of the current restart, by name."""
        return self.graph.parameters.unpack(self._parameters.copy())

    def step(self) -> dict[str, Any]:
        """Make one iteration.

        Returns:
            The fields of `StepGraph.record` by name. After the end of a solve it continues from
            the last state.
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
        """Yield the records of all remaining iterations."""
        while self.status == RUNNING:
            yield self.step()
