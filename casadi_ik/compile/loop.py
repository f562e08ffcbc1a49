"""A step run to its end: the one loop, in compiled code or in CasADi's virtual machine.

Every iteration may be recorded; a solve may be looked at one iteration at a time.
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
"""Status of a solve whose state or status became NaN or infinite; its last finite state stays."""

FAILED = -2
"""Status of a solve whose step reported a failure; the state before that step stays."""

REPEATED = -3
"""Status of a solve that came back to an earlier state bit for bit, and so would for ever."""

UNBEGUN = -4
"""Status of a solve that a method has not begun yet."""

FIRST_ROWS = 256
"""Rows a trace starts with at least; it doubles when they are full."""

FIRST_MARK = 16
"""Iteration, a power of two, of the first state that later ones are compared with."""

CODE_LIMIT = 2**31 - 1
"""A status has to be smaller than this (it is kept as int32)."""


@dataclass(frozen=True, eq=False)
class LoopResult:
    """What a batch of k solves came to.

    Attributes:
        states: Last states, shape (k, ns).
        iterations: Steps made, shape (k,); the one that became non-finite counts.
        status: Shape (k,): the step's status, `RUNNING` if the iterations ran out, `NON_FINITE`,
            `FAILED` or `REPEATED`.
        time: Seconds inside the loop, shape (k,); solves side by side share them.
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


def run_vm(
    kernel: LoopKernel,
    result: LoopResult,
    parameters: NDArray[np.float64],
    max_iterations: int,
) -> None:
    """Solve a batch; `result` has the first states and gets everything else.

    Args:
        kernel: Of the step.
        result: As `LoopKernel.run` makes it.
        parameters: Shape (k, np) or (np,).
        max_iterations: Budget of each solve.
    """
    step = kernel.step
    call: Any = step.virtual() if step.virtual else BufferedFunction(kernel.function)
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


SYMBOL = "casadi_ik_loop"

SLOTS = 32
"""Solves under way at once, of which four or eight have the lanes."""

FEWEST = 4
"""Solves from which on they are made side by side."""

FOREVER = 2**62
"""Steps of a call that has no bound."""

WORTH = 64
"""Solves from which on a compiler is waited for, if no library that makes them side by side is at
hand. One by one they take a millisecond or two, and the compiler the better part of a minute."""

LOOKED = 1000
"""Solves of small batches after which one looks again for a library that was not at hand."""

SPARE = 1.25
"""How much more room a trace begins with than the last one needed."""

ROOM_BYTES = 2**24
"""What it begins with at most [bytes]."""


Job = c_struct("loop_job")


@dataclass(frozen=True)
class Followed:
    """Where the starts of solves stand, and what writes them.

    Attributes:
        states: Address of the first state.
        parameters: Address of the first parameters.
        step: Doubles from one state to the next.
        slots: Solves under way at a time, at most `SLOTS`.
        parameter_step: The same of parameters, 0: the same for all; None: as of states.
        follow: Address of the function that says what follows, 0: nothing does.
        method: Address of what it works on.
    """

    states: int
    parameters: int
    step: int
    slots: int
    parameter_step: int | None = None
    follow: int = 0
    method: int = 0


class CompiledBatch:
    """A batch on its way through a compiled loop."""

    def __init__(self, step: StepGraph, result: LoopResult, starts: Followed, budget: int) -> None:
        """Keep the arrays; `result` gets everything.

        Args:
            step: The step.
            result: As `LoopKernel.run` makes it.
            starts: Where solves begin.
            budget: Iterations of each start.
        """
        self.name = step.name
        self.result = result
        slots = starts.slots
        self._places = np.empty((0, 2), dtype=np.int64)
        self._slots = np.full(slots, -1, dtype=np.int64)
        self._begun = np.zeros(slots, dtype=np.int64)
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
            begun=memory(self._begun),
            mark=memory(self._mark),
            slot_count=slots,
            count=len(result.status),
            max_iterations=budget,
            left=FOREVER,
            fewest=FEWEST,
            slice=SLICE,
            follow=starts.follow,
            method=starts.method,
        )

    def run(self, several: Any, alone: Any) -> LoopResult:
        """Solve.

        Args:
            several: The loop that makes some solves at a time, None if there is none.
            alone: The loop that makes one after the other: the last few, too.

        Returns:
            The result, its rows solve by solve.

        Raises:
            KernelError: No work memory, or the step failed.
        """
        loop = several or alone
        if self.result.rows is not None:
            self._rows_to(len(self.result.rows))
        while (code := loop(ctypes.byref(self.job))) != DriverCode.DONE:
            check(self.name, code)
            if code == DriverCode.ROWS_FULL:
                self._rows_to(2 * self.job.capacity)
            if code == DriverCode.FEW_LEFT:
                loop = alone
        self._rows_to(self.job.used)
        if self.result.rows is None or self.job.count == 1:
            return self.result
        return replace(self.result, rows=self._in_order(self.result.rows))

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


class LoopKernel:
    """Runs a step until it ends, for each solve of a batch; several threads may run it at once.

    Attributes:
        step: The step.
        compiled: Whether the loop runs in compiled code. Otherwise the same graph runs in
            CasADi's virtual machine, with the same iterates and records up to the last places of
            sines and arcs.
        entry: The compiled loop that makes one solve after the other, None if there is none.
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
        self.entry: Any = None if library is None else library[SYMBOL]
        self._rows_each = 0.0
        self._few = 0

    def _load(self, lanes: int = 1) -> ctypes.CDLL | None:
        """The library of the loop that makes so many solves side by side."""
        step = self.step
        name = step.name if lanes == 1 else f"{step.name}_lanes{lanes}"
        wide = lanes == 1 and machine_lanes() > 0
        return load_function(
            name, lambda: step.function, self._driver(), SYMBOL, step.recipe, lanes, wide
        )

    @property
    def lanes(self) -> int:
        """How many solves of a batch are made side by side; 1 where that is not possible."""
        return 1 if self._side_by_side is None else machine_lanes()

    def _for(self, count: int) -> Any:
        """The loop that makes some solves of so many at a time; None: one after the other."""
        if count < FEWEST:
            return None
        if count >= WORTH or "_side_by_side" in vars(self):
            return self._side_by_side
        self._few -= count
        return None if self._few > 0 else self._at_hand

    @property
    def _at_hand(self) -> Any:
        """The loop that makes some solves at a time, if it need not be compiled."""
        try:
            with cached_only():
                return self._side_by_side
        except NotCachedError:
            self._few = LOOKED  # looking takes a millisecond
            return None

    @cached_property
    def _side_by_side(self) -> Any:
        """The loop that makes some solves at a time; None where there is none."""
        lanes = machine_lanes() if self.compiled else 0
        if not lanes:
            return None
        try:
            library = self._load(lanes)
        except KernelError as error:
            warnings.warn(f"one solve at a time: {error}", RuntimeWarning, stacklevel=2)
            return None
        return None if library is None else library[SYMBOL]

    @property
    def constants(self) -> dict[str, int]:
        """What the drivers expect, but what `row_driver` defines."""
        return {
            "N_STATE": self.step.state.size,
            "N_PARAMETERS": self.step.parameters.size,
            "N_SEATED": self.step.seated,
            "RUNNING": RUNNING,
            "NON_FINITE": NON_FINITE,
            "REPEATED": REPEATED,
            "CODE_LIMIT": CODE_LIMIT,
            "SLOTS": SLOTS,
            "FIRST_MARK": FIRST_MARK,
            "STAGE": self.step.stage_place,
        }

    def _driver(self) -> str:
        """C text of the driver, with its constants."""
        texts = driver_text("loop_job"), driver_text("loop")
        return define(self.constants) + row_driver(self.step.record) + "".join(texts)

    @cached_property
    def function(self) -> Any:
        """The step, row-major, or its stages."""
        return row_major(self.step.function)

    def run(
        self, states: Any, parameters: Any, max_iterations: int, trace: bool = False
    ) -> LoopResult:
        """Solve a batch.

        A solve ends when the step's status is not `RUNNING`, when the new state or the status is
        not finite, when the new state is an earlier one once more (runtime/loop.c), or after
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
        stop_if_cancelled()
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
        result = self._empty(first.copy(), trace)
        if not self.compiled:
            run_vm(self, result, given, max_iterations)
            return result
        if not max_iterations:
            return replace(result, rows=np.empty(0, self.step.record.dtype) if trace else None)
        rows = Followed(
            memory(result.states),
            memory(given),
            n_state,
            slots=SLOTS,
            parameter_step=0 if given.ndim == 1 else n_parameters,
        )
        return self._drive(CompiledBatch(self.step, result, rows, max_iterations))

    def run_followed(
        self, starts: Followed, count: int, max_iterations: int, trace: bool
    ) -> LoopResult:
        """Solve a batch whose starts a method writes; see `follow` in runtime/loop_job.c.

        Args:
            starts: Where it writes them, and how it is called; in compiled code only.
            count: Solves.
            max_iterations: Budget of each start, >= 1.
            trace: Whether to keep the record of every iteration.

        Returns:
            As `run`, without states.
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
            rows=np.empty(self._room(count), dtype=self.step.record.dtype) if trace else None,
        )

    def _drive(self, batch: CompiledBatch) -> LoopResult:
        count = len(batch.result.status)
        result = batch.run(self._for(count), self.entry)
        if count and result.rows is not None:
            self._rows_each = len(result.rows) / count
        return result

    def _room(self, count: int) -> int:
        """Rows to begin a trace of so many solves with, by what the last one came to.

        To make room on the way costs more than to write the rows: it is cleared each time.
        """
        if not self.compiled:
            return 0
        rows = int(SPARE * self._rows_each * count) + FIRST_ROWS
        return min(rows, max(ROOM_BYTES // max(self.step.record.dtype.itemsize, 1), FIRST_ROWS))


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
