"""A step run to its end: the one loop, in compiled code, with every iteration recorded."""

from __future__ import annotations

import ctypes
import logging
import warnings
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.errors import InputError, KernelError
from casadi_ik.kernels.buffered import doubles
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.cancellation import stop_if_cancelled
from casadi_ik.kernels.codegen import define, driver_text, library_source, row_major
from casadi_ik.kernels.lanes import lanes_source
from casadi_ik.kernels.lanes_lines import UnsuitedError
from casadi_ik.kernels.loop_job import FIRST_MARK, SLOTS, CompiledBatch
from casadi_ik.kernels.loop_result import (
    CODE_LIMIT,
    FAILED,
    FIRST_ROWS,
    NON_FINITE,
    REPEATED,
    LoopResult,
)
from casadi_ik.kernels.loop_vm import run_vm
from casadi_ik.kernels.machine_lanes import machine_lanes
from casadi_ik.kernels.rows import row_driver
from casadi_ik.kernels.step_graph import RUNNING, StepGraph

logger = logging.getLogger(__name__)

SYMBOL = "casadi_ik_loop"
SYMBOL_LANES = "casadi_ik_loop_lanes"

FEWEST = 4
"""Solves from which on they are made side by side."""

WORTH = 64
"""Solves from which on a compiler is waited for, if no library that makes them side by side is at
hand. One by one they take a millisecond or two, and the compiler the better part of a minute."""

SPARE = 1.25
"""How much more room a trace begins with than the last one needed."""

ROOM_BYTES = 2**24
"""What it begins with at most [bytes]."""


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

    def _load(self) -> ctypes.CDLL | None:
        wide = machine_lanes() > 0
        return load_library(
            self.step.name,
            lambda: self.function,
            self._driver("loop"),
            SYMBOL,
            f"{self.step.recipe} wide {wide}" if self.step.recipe else "",
            partial(library_source, wide=wide),
        )

    @property
    def lanes(self) -> int:
        """How many solves of a batch are made side by side; 1 where that is not possible."""
        return 1 if self._side_by_side is None else machine_lanes()

    def _for(self, count: int) -> Any:
        """The loop that makes some solves of so many at a time; None: one after the other."""
        if count < FEWEST:
            return None
        return self._at_hand if count < WORTH else self._side_by_side

    @cached_property
    def _at_hand(self) -> Any:
        """The loop that makes some solves at a time, if it need not be compiled."""
        return self._load_lanes(at_hand=True)

    @cached_property
    def _side_by_side(self) -> Any:
        """The loop that makes some solves at a time; None where there is none."""
        self.__dict__["_at_hand"] = found = self._load_lanes()
        return found

    def _load_lanes(self, at_hand: bool = False) -> Any:
        """That loop, or None.

        Args:
            at_hand: Whether it is none, too, where it would have to be compiled.
        """
        lanes = machine_lanes() if self.compiled else 0
        if not lanes:
            return None
        try:
            library = load_library(
                f"{self.step.name}_lanes{lanes}",
                lambda: self.function,
                self._driver("loop_lanes"),
                SYMBOL_LANES,
                f"{self.step.recipe} lanes {lanes}" if self.step.recipe else "",
                partial(lanes_source, lanes=lanes),
                at_hand=at_hand,
            )
        except UnsuitedError as error:
            logger.info("%s: one solve at a time: %s", self.step.name, error)
            return None
        except KernelError as error:
            warnings.warn(f"one solve at a time: {error}", RuntimeWarning, stacklevel=2)
            return None
        return None if library is None else library[SYMBOL_LANES]

    @property
    def constants(self) -> dict[str, int]:
        """What the drivers expect, but what `row_driver` defines."""
        return {
            "N_STATE": self.step.state.size,
            "N_PARAMETERS": self.step.parameters.size,
            "RUNNING": RUNNING,
            "NON_FINITE": NON_FINITE,
            "FAILED": FAILED,
            "REPEATED": REPEATED,
            "CODE_LIMIT": CODE_LIMIT,
            "SLOTS": SLOTS,
            "FIRST_MARK": FIRST_MARK,
            "STAGE": self.step.stage_place,
        }

    def _driver(self, name: str) -> str:
        """C text of one of the two drivers, with its constants."""
        job = driver_text("loop_job") + driver_text("marks")
        return define(self.constants) + row_driver(self.step.record) + job + driver_text(name)

    @cached_property
    def function(self) -> ca.Function:
        """The step, row-major."""
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
        result = LoopResult(
            states=first.copy(),
            iterations=np.zeros(count, dtype=np.int64),
            status=np.full(count, RUNNING, dtype=np.int32),
            time=np.zeros(count),
            rows=np.empty(self._room(count), dtype=self.step.record.dtype) if trace else None,
        )
        if not self.compiled:
            run_vm(self.step, self.function, result, given, max_iterations)
            return result
        batch = CompiledBatch(self.step, result, given, max_iterations)
        several = self._for(count) if max_iterations > 0 else None
        if several is not None:
            result = batch.run_side_by_side(several)
        else:
            batch.run(self.entry)
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
