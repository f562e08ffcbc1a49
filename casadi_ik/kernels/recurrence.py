"""A function whose first result is its next input: ``(state, parameters) -> (state', record)``.

One step at a time in memory made once, or a whole row of steps in one call of compiled code.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import KernelError
from casadi_ik.kernels.buffered import BufferedFunction, doubles, memory
from casadi_ik.kernels.cancellation import stop_if_cancelled
from casadi_ik.kernels.driver_code import SLICE, DriverCode, check
from casadi_ik.kernels.function_kernel import FunctionKernel, MapJob, SingleCall

Array = NDArray[np.float64]


class Recurrence:
    """Steps a function; not to be shared by threads.

    Attributes:
        parameters: Of the next step; write into it.
        record: Of the last step; the next overwrites it.
    """

    def __init__(self, kernel: FunctionKernel) -> None:
        """Lay the memory out.

        Args:
            kernel: Of two inputs and two outputs, the first of each of one size.
        """
        (size,), (count,) = kernel.input_shapes
        _, (told,) = kernel.output_shapes
        self._kernel = kernel
        self.parameters, self.record = np.zeros(count), np.zeros(told)
        # Code of CasADi reads inputs while it writes outputs: state and next state stand apart.
        self._states = np.zeros(size), np.zeros(size)
        self._now = 0
        self._calls: tuple[SingleCall, ...] = ()
        self._slow: BufferedFunction | None = None
        if kernel.compiled:
            self._calls = tuple(
                SingleCall(kernel.name, kernel.entry, [here, self.parameters], [there, self.record])
                for here, there in (self._states, self._states[::-1])
            )
        else:
            self._slow = BufferedFunction(kernel.function)

    @property
    def state(self) -> Array:
        """The state now; write into it to go on from elsewhere."""
        return self._states[self._now]

    @property
    def before(self) -> Array:
        """The state before the last step."""
        return self._states[1 - self._now]

    def step(self) -> Array:
        """Make one step; the new state.

        Raises:
            KernelError: The function itself reports a failure.
        """
        now = self._now
        if self._calls:
            self._calls[now]()
        else:
            self._evaluate(self._states[now], self.parameters, self._states[1 - now], self.record)
        self._now = 1 - now
        return self._states[1 - now]

    def back(self) -> None:
        """Undo the last step, of which one can be undone."""
        self._now = 1 - self._now

    def run(self, state: Array, parameters: Array) -> tuple[Array, Array]:
        """Make a row of steps; the own state stays as it is.

        Args:
            state: Where they begin.
            parameters: (k, p) of each step.

        Returns:
            The states after the steps (k, s), and what they tell (k, r).

        Raises:
            KernelError: The function itself reports a failure.
        """
        asked = doubles(parameters)
        count = len(asked)
        states = np.empty((count + 1, len(state)))
        records = np.empty((count, len(self.record)))
        states[0] = state
        if not self._calls:
            for i in range(count):
                stop_if_cancelled()
                self._evaluate(states[i], asked[i], states[i + 1], records[i])
            return states[1:], records
        if not count:
            return states[1:], records
        # Every sample reads its state where the one before has written it.
        inputs = (ctypes.c_void_p * 2)(memory(states), memory(asked))
        outputs = (ctypes.c_void_p * 2)(memory(states[1:]), memory(records))
        sizes = states.shape[1], asked.shape[1], records.shape[1]
        into, out = (ctypes.c_int64 * 2)(*sizes[:2]), (ctypes.c_int64 * 2)(sizes[0], sizes[2])
        pointers = map(ctypes.addressof, (inputs, into, outputs, out))
        job = MapJob(*pointers, count=count, next=0, slice=SLICE)
        while (code := self._kernel.entry(ctypes.byref(job))) != DriverCode.DONE:
            check(self._kernel.name, code)
        return states[1:], records

    def _evaluate(self, state: Array, parameters: Array, after: Array, record: Array) -> None:
        slow = self._slow
        assert slow is not None
        slow.inputs[0][:], slow.inputs[1][:] = state, parameters
        if not slow():
            raise KernelError(f"{self._kernel.name}: the function reports a failure")
        after[:], record[:] = slow.outputs
