"""CasADi Functions as callables on NumPy arrays: one sample, a batch, a recurrence.

They run in compiled code if there is a compiler, otherwise in CasADi's virtual machine.
"""

from __future__ import annotations

import ctypes
import logging
import os
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import (
    SLICE,
    DriverCode,
    check,
    run_cancellable,
    stop_if_cancelled,
)
from casadi_ik.compile.codegen import c_struct, define, driver_text, row_major
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.compile.libraries import load_function, load_library
from casadi_ik.errors import InputError, KernelError

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_BYTE: Any = ctypes.c_char


class BufferedFunction:
    """A function with buffers for inputs and outputs; not thread-safe.

    Attributes:
        inputs: Flat input buffers; callers write into them.
        outputs: Flat output buffers; a call overwrites them.
    """

    def __init__(self, function: ca.Function) -> None:
        """Allocate the buffers.

        Args:
            function: Dense and row-major (`codegen.row_major`).
        """
        self.inputs = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self.outputs = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        # CasADi's stubs describe the C++ signatures of a buffer, not the Python ones.
        buffer: Any
        buffer, self._evaluate = function.buffer()
        for i, array in enumerate(self.inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self.outputs):
            buffer.set_res(i, array.data)
        self._buffer = buffer
        self._name = function.name()

    def __call__(self) -> bool:
        """Evaluate; return False if the function reports a failure, as generated code would."""
        try:
            self._evaluate()
        except SystemError as error:
            # A buffer reports Ctrl-C inside an evaluation as SystemError.
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from error
            raise
        except RuntimeError as error:
            # Inside Ipopt, Ctrl-C arrives as RuntimeError.
            if str(error) == "KeyboardInterrupt":
                raise KeyboardInterrupt from error
            logger.warning("function %r failed: %s", self._name, error)
            return False
        return self._buffer.ret() == 0


def memory(array: NDArray[Any]) -> int:
    """Return the address of an array's first element."""
    if array.flags.writeable and array.flags.c_contiguous and array.size:
        # Takes a third of the time of array.ctypes, which handles every array.
        return ctypes.addressof(_BYTE.from_buffer(array))
    return array.ctypes.data


def doubles(values: Any) -> NDArray[np.float64]:
    """Return values as an aligned C-contiguous array of doubles; copy only if necessary."""
    array = np.asarray(values, dtype=np.float64, order="C")
    return array if array.flags.aligned else array.copy()


MACHINE_SYMBOL = "casadi_ik_machine_lanes"


def machine_lanes() -> int:
    """Return the number of lanes: 8 if registers hold eight doubles, otherwise 4; 0 without lanes.

    The compiled probe runs on every machine, since several machines may share a cache.
    """
    if configured := os.environ.get("CASADI_IK_LANES"):
        if configured not in ("1", "4", "8"):
            raise KernelError(f"CASADI_IK_LANES={configured[:20]!r}: expected 1, 4 or 8")
        return int(configured) if configured != "1" else 0
    text = driver_text("machine_lanes")
    library = load_library("machine_lanes", lambda: text, MACHINE_SYMBOL, text)
    return 0 if library is None else int(library[MACHINE_SYMBOL]())


MAP_SYMBOL, MAP_LANES_SYMBOL = "casadi_ik_map", "casadi_ik_map_lanes"

MapJob = c_struct("map_job", driver="jobs")


def _map_job(
    inputs: Sequence[NDArray[Any]],
    input_steps: Sequence[int],
    outputs: Sequence[NDArray[Any]],
    output_steps: Sequence[int],
    count: int,
) -> tuple[Any, tuple[Any, ...]]:
    """Return a job of the map runtime, and buffers that must stay alive with it."""
    buffers = tuple(
        (kind * len(values))(*values)
        for arrays, steps in ((inputs, input_steps), (outputs, output_steps))
        for kind, values in (
            (ctypes.c_void_p, [memory(array) for array in arrays]),
            (ctypes.c_int64, steps),
        )
    )
    return MapJob(*map(ctypes.addressof, buffers), count=count, next=0, slice=SLICE), buffers


class SingleCall:
    """A compiled call on fixed arrays; not thread-safe.

    Attributes:
        inputs: Input arrays; callers write into them.
        outputs: Output arrays; a call overwrites them.
    """

    def __init__(
        self,
        name: str,
        run: Any,
        inputs: Sequence[NDArray[np.float64]],
        outputs: Sequence[NDArray[np.float64]],
    ) -> None:
        self.inputs = tuple(inputs)
        self.outputs = tuple(outputs)
        self._name = name
        self._run = run
        zeros = [0] * max(len(inputs), len(outputs))
        self._job, self._buffers = _map_job(inputs, zeros, outputs, zeros, 1)
        self._reference = ctypes.byref(self._job)

    def __call__(self) -> None:
        """Evaluate.

        Raises:
            KernelError: The function itself reports a failure.
        """
        self._job.next = 0
        code = self._run(self._reference)
        if code != DriverCode.DONE:
            check(self._name, code)


class FunctionKernel:
    """A Function on NumPy arrays, compiled if possible; several threads may call it at once.

    A scalar has the shape (), a column vector (r,), any other matrix (r, c), row-major.

    Attributes:
        name: The function's name.
        compiled: True if calls run in compiled code; otherwise in CasADi's virtual machine, with
            the same results up to rounding of sines and arcs.
        input_shapes: Shape of one sample of each input.
        output_shapes: Shape of one sample of each output.
        entry: The compiled function; None if there is none.
        library: Its library.
    """

    def __init__(
        self,
        function: ca.Function | FunctionGraph,
        compiled: bool = True,
        in_lanes: bool = False,
        driver: str = "",
    ) -> None:
        """Compile the function or load it from the cache.

        Args:
            function: Any Function; sparse inputs and outputs become dense.
            compiled: False uses the virtual machine.
            in_lanes: True to compute several samples of a batch in lanes; the results are the same
                bit for bit.
            driver: C text of further runtime code in the same library.

        Raises:
            KernelError: The function has no C code, or compiling failed.
        """
        graph = (
            function
            if isinstance(function, FunctionGraph)
            else FunctionGraph.from_function(function)
        )
        self.name = graph.name
        self.input_shapes = tuple(map(_shape, graph.inputs.values()))
        self.output_shapes = tuple(map(_shape, graph.outputs))
        self._graph = graph
        self._names = tuple(graph.inputs)
        self._input_sizes = [rows * columns for rows, columns in graph.inputs.values()]
        self._output_sizes = [rows * columns for rows, columns in graph.outputs]
        self.library: Any = None
        self.entry: Any = self._load(in_lanes, driver) if compiled else None
        self.compiled = self.entry is not None
        self._singles: list[SingleCall] = []

    def _load(self, in_lanes: bool, driver: str = "") -> Any:
        """Return the compiled map; None without a compiler."""
        lanes = machine_lanes() if in_lanes else 0
        text = define({"N_IN": len(self._input_sizes), "N_OUT": len(self._output_sizes)})
        map_text = driver_text("jobs") + driver_text("map")
        if not lanes:
            text += map_text + driver
            return self._map(self.name, text, MAP_SYMBOL)
        text += define({"TOTAL": sum(self._input_sizes) + sum(self._output_sizes)})
        for name, sizes in (("SIZES_IN", self._input_sizes), ("SIZES_OUT", self._output_sizes)):
            text += f"#define {name} {{{', '.join(map(str, sizes))}}}\n"
        try:
            return self._map(f"{self.name}_lanes{lanes}", text + map_text, MAP_LANES_SYMBOL, lanes)
        except KernelError as error:
            logger.warning("%s: one sample at a time: %s", self.name, error)
            return self._load(in_lanes=False)

    def _map(self, name: str, driver: str, symbol: str, lanes: int = 1) -> Any:
        graph = self._graph
        self.library = load_function(
            name, lambda: graph.function, driver, symbol, graph.recipe, lanes
        )
        return None if self.library is None else self.library[symbol]

    @cached_property
    def function(self) -> ca.Function:
        """The function with row-major inputs and outputs."""
        return row_major(self._graph.function)

    def __call__(self, *inputs: Any) -> tuple[NDArray[np.float64], ...]:
        """Evaluate one sample or a batch.

        Args:
            inputs: One array per input, of its shape or with a leading batch dimension k; inputs
                without it are shared by the whole batch.

        Returns:
            One new array per output, of shape (k, *shape), or of its shape if no input has a
            batch dimension.

        Raises:
            InputError: The number of inputs, a shape or the length of a batch is wrong.
            KernelError: The function reports a failure.
        """
        if self.compiled and self._is_one_sample(inputs):
            return self._run_one(inputs, None)
        arrays, steps, count = self.checked(inputs)
        if self.compiled and count in (None, 1):
            return self._run_one(arrays, count)
        lead = () if count is None else (count,)
        outputs = tuple(np.empty((*lead, *shape)) for shape in self.output_shapes)
        run = self._run_compiled if self.compiled else self._run_vm
        run(arrays, steps, outputs, 1 if count is None else count)
        return outputs

    def _single(self) -> SingleCall:
        """Return a reusable call with buffers."""
        inputs, outputs = (
            [np.zeros(shape) for shape in shapes]
            for shapes in (self.input_shapes, self.output_shapes)
        )
        return SingleCall(self.name, self.entry, inputs, outputs)

    def _is_one_sample(self, inputs: Sequence[Any]) -> bool:
        """Return True if no input needs a check or a conversion, which take longer than a call."""
        return len(inputs) == len(self.input_shapes) and all(
            type(array) is np.ndarray and array.shape == shape and array.dtype == np.float64
            for array, shape in zip(inputs, self.input_shapes, strict=True)
        )

    def _run_one(
        self, arrays: Sequence[NDArray[np.float64]], count: int | None
    ) -> tuple[NDArray[np.float64], ...]:
        """Evaluate one sample; reused buffers take half the time of new ones."""
        try:
            single = self._singles.pop()
        except IndexError:
            single = self._single()
        for buffer, array in zip(single.inputs, arrays, strict=True):
            buffer[...] = array
        single()
        outputs = tuple(
            output.copy() if count is None else output[None].copy() for output in single.outputs
        )
        self._singles.append(single)
        return outputs

    def checked(
        self, inputs: Sequence[Any]
    ) -> tuple[list[NDArray[np.float64]], list[int], int | None]:
        """Check and convert the inputs of a call.

        Returns:
            The arrays; the distance between samples of each [doubles], 0 if it is shared by the
            batch; the length of the batch, None without a batch dimension.

        Raises:
            InputError: See `__call__`.
        """
        if len(inputs) != len(self.input_shapes):
            raise InputError(
                f"{self.name}: {len(inputs)} inputs, expected {len(self.input_shapes)} "
                f"({', '.join(self._names)})"
            )
        arrays: list[NDArray[np.float64]] = []
        steps: list[int] = []
        count: int | None = None
        for name, shape, size, values in zip(
            self._names, self.input_shapes, self._input_sizes, inputs, strict=True
        ):
            array = doubles(values)
            if not shape and array.ndim == 2 and array.shape[1] == 1:
                array = array[:, 0]  # vectors of length one
            arrays.append(array)
            if array.shape == shape:
                steps.append(0)
                continue
            if array.shape[1:] != shape or array.ndim != len(shape) + 1:
                raise InputError(
                    f"{self.name}: input {name!r} has shape {array.shape}, "
                    f"expected {shape} or (k, {', '.join(map(str, shape))})"
                )
            if count is not None and count != len(array):
                raise InputError(
                    f"{self.name}: input {name!r} is a batch of {len(array)}, another of {count}"
                )
            count = len(array)
            steps.append(size)
        return arrays, steps, count

    def _run_compiled(
        self,
        arrays: list[NDArray[np.float64]],
        steps: list[int],
        outputs: tuple[NDArray[np.float64], ...],
        count: int,
    ) -> None:
        job, _buffers = _map_job(arrays, steps, outputs, self._output_sizes, count)
        run_cancellable(self.name, self.entry, job)

    def _run_vm(
        self,
        arrays: list[NDArray[np.float64]],
        steps: list[int],
        outputs: tuple[NDArray[np.float64], ...],
        count: int,
    ) -> None:
        call = BufferedFunction(self.function)
        sources = [array.reshape(-1) for array in arrays]
        targets = [output.reshape(-1) for output in outputs]
        for sample in range(count):
            stop_if_cancelled()
            for buffer, source, step in zip(call.inputs, sources, steps, strict=True):
                buffer[:] = source[sample * step : sample * step + buffer.size]
            if not call():
                raise KernelError(f"{self.name}: the function reports a failure")
            for buffer, target in zip(call.outputs, targets, strict=True):
                target[sample * buffer.size : (sample + 1) * buffer.size] = buffer


def _shape(size: tuple[int, int]) -> tuple[int, ...]:
    """Return the NumPy shape of a CasADi matrix: () for a scalar, (r,) for a column."""
    rows, columns = size
    if columns != 1:
        return (rows, columns)
    return () if rows == 1 else (rows,)


class Recurrence:
    """Repeated evaluation of (state, parameters) -> (state, record); not thread-safe.

    Attributes:
        parameters: Parameters of the next step; callers write into it.
        record: Record of the last step; the next step overwrites it.
    """

    def __init__(self, kernel: FunctionKernel) -> None:
        """Allocate the buffers.

        Args:
            kernel: Kernel with two inputs and two outputs; the first of each have the same size.
        """
        (size,), (count,) = kernel.input_shapes
        _, (n_record,) = kernel.output_shapes
        self._kernel = kernel
        self.parameters, self.record = np.zeros(count), np.zeros(n_record)
        # Generated code reads inputs while it writes outputs, so two state buffers alternate.
        self._states = np.zeros(size), np.zeros(size)
        self._current = 0
        self._calls: tuple[SingleCall, ...] = ()
        self._interpreter: BufferedFunction | None = None
        if kernel.compiled:
            self._calls = tuple(
                SingleCall(
                    kernel.name, kernel.entry, [source, self.parameters], [destination, self.record]
                )
                for source, destination in (self._states, self._states[::-1])
            )
        else:
            self._interpreter = BufferedFunction(kernel.function)

    @property
    def state(self) -> Array:
        """The current state; callers may overwrite it."""
        return self._states[self._current]

    @property
    def previous_state(self) -> Array:
        """The state before the last step."""
        return self._states[1 - self._current]

    def step(self) -> Array:
        """Make one step and return the new state.

        Raises:
            KernelError: The function reports a failure.
        """
        current = self._current
        if self._calls:
            self._calls[current]()
        else:
            self._evaluate(
                self._states[current], self.parameters, self._states[1 - current], self.record
            )
        self._current = 1 - current
        return self._states[1 - current]

    def back(self) -> None:
        """Undo the last step; only one step can be undone."""
        self._current = 1 - self._current

    def run(self, state: Array, parameters: Array) -> tuple[Array, Array]:
        """Make several steps from a given state; `self.state` does not change.

        Args:
            state: (s,) first state.
            parameters: (k, p) parameters of each step.

        Returns:
            States after each step (k, s), and records (k, r).

        Raises:
            KernelError: The function reports a failure.
        """
        inputs = doubles(parameters)
        count = len(inputs)
        states = np.empty((count + 1, len(state)))
        records = np.empty((count, len(self.record)))
        states[0] = state
        if not self._calls:
            for i in range(count):
                stop_if_cancelled()
                self._evaluate(states[i], inputs[i], states[i + 1], records[i])
            return states[1:], records
        if not count:
            return states[1:], records
        # Every sample reads its state where the previous one has written it.
        size, n_input, n_record = states.shape[1], inputs.shape[1], records.shape[1]
        arrays = (states, inputs), (size, n_input), (states[1:], records), (size, n_record)
        job, _buffers = _map_job(*arrays, count)
        run_cancellable(self._kernel.name, self._kernel.entry, job)
        return states[1:], records

    def _evaluate(self, state: Array, parameters: Array, next_state: Array, record: Array) -> None:
        interpreter = self._interpreter
        assert interpreter is not None
        interpreter.inputs[0][:], interpreter.inputs[1][:] = state, parameters
        if not interpreter():
            raise KernelError(f"{self._kernel.name}: the function reports a failure")
        next_state[:], record[:] = interpreter.outputs
