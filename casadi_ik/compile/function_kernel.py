"""A CasADi Function as a fast callable on numpy arrays: one sample, a batch, step by step.

Compiled if the machine can, otherwise in CasADi's virtual machine.
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

from casadi_ik.compile.cancellation import SLICE, DriverCode, check, drive, stop_if_cancelled
from casadi_ik.compile.codegen import c_struct, define, driver_text, row_major
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.compile.libraries import load_function, load_library
from casadi_ik.errors import InputError, KernelError

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_BYTE: Any = ctypes.c_char


class BufferedFunction:
    """One function with its own input and output arrays; not to be shared by threads.

    Attributes:
        inputs: Flat arrays of the inputs' memory; write into them.
        outputs: Flat arrays of the outputs' memory; a call overwrites them.
    """

    def __init__(self, function: ca.Function) -> None:
        """Make the arrays.

        Args:
            function: Dense and row-major (`codegen.row_major`).
        """
        self.inputs = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self.outputs = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        # The stubs of CasADi describe the C++ signatures of a buffer, not Python's.
        buffer: Any
        buffer, self._evaluate = function.buffer()
        for i, array in enumerate(self.inputs):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self.outputs):
            buffer.set_res(i, array.data)
        self._buffer = buffer
        self._name = function.name()

    def __call__(self) -> bool:
        """Evaluate; False if the function itself reports a failure, as generated code would."""
        try:
            self._evaluate()
        except SystemError as error:
            # A buffer reports Ctrl-C inside an evaluation as this.
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from error
            raise
        except RuntimeError as error:
            # ... or, if it came while Ipopt was at work, as that.
            if str(error) == "KeyboardInterrupt":
                raise KeyboardInterrupt from error
            logger.warning("function %r failed: %s", self._name, error)
            return False
        return self._buffer.ret() == 0


def memory(array: NDArray[Any]) -> int:
    """The address of an array's first element."""
    if array.flags.writeable and array.flags.c_contiguous and array.size:
        # A third of the time of the way below, which knows every array.
        return ctypes.addressof(_BYTE.from_buffer(array))
    return array.ctypes.data


def doubles(values: Any) -> NDArray[np.float64]:
    """The values as an aligned C-contiguous array of doubles, copied only if they are not."""
    array = np.asarray(values, dtype=np.float64, order="C")
    return array if array.flags.aligned else array.copy()


SYMBOL_MACHINE = "casadi_ik_machine_lanes"


def machine_lanes() -> int:
    """Eight where registers hold eight doubles, else four; 0: one solve at a time.

    The compiled answer is asked on every machine anew, since several may share a cache.
    """
    if asked := os.environ.get("CASADI_IK_LANES"):
        if asked not in ("1", "4", "8"):
            raise KernelError(f"CASADI_IK_LANES={asked[:20]!r}: expected 1, 4 or 8")
        return int(asked) if asked != "1" else 0
    text = driver_text("machine_lanes")
    library = load_library("machine_lanes", lambda: text, SYMBOL_MACHINE, text)
    return 0 if library is None else int(library[SYMBOL_MACHINE]())


SYMBOL, SYMBOL_LANES = "casadi_ik_map", "casadi_ik_map_lanes"

MapJob = c_struct("map_job")


def _map_job(
    inputs: Sequence[NDArray[Any]],
    input_steps: Sequence[int],
    outputs: Sequence[NDArray[Any]],
    output_steps: Sequence[int],
    count: int,
) -> tuple[Any, tuple[Any, ...]]:
    """A job of the map driver, and memory that has to live as long."""
    kept = tuple(
        (kind * len(values))(*values)
        for arrays, steps in ((inputs, input_steps), (outputs, output_steps))
        for kind, values in (
            (ctypes.c_void_p, [memory(array) for array in arrays]),
            (ctypes.c_int64, steps),
        )
    )
    return MapJob(*map(ctypes.addressof, kept), count=count, next=0, slice=SLICE), kept


class SingleCall:
    """One compiled call on fixed arrays; not to be shared by threads.

    Attributes:
        inputs: Arrays of the inputs' shapes; write into them.
        outputs: Arrays of the outputs' shapes; a call overwrites them.
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
        self._job, self._kept = _map_job(inputs, zeros, outputs, zeros, 1)
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
    """Evaluates a Function, compiled to C if the machine can; several threads may call at once.

    A scalar has the shape (), a column vector (r,), any other matrix (r, c), row by row.

    Attributes:
        name: The function's name.
        compiled: Whether calls run in compiled code (otherwise in CasADi's virtual machine, with
            the same results up to the last places of sines and arcs).
        input_shapes: Shape of one sample of each input.
        output_shapes: Shape of one sample of each output.
        entry: The compiled function, None if there is none.
        library: What it is in.
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
            function: Any Function; sparse inputs and outputs are made dense.
            compiled: False keeps to the virtual machine.
            in_lanes: Whether some samples of a batch are computed side by side, where the machine
                has such registers; the results are the same bit for bit.
            driver: C text of another driver of the function in the same library.

        Raises:
            KernelError: The function has no C code, or the compiler refused it.
        """
        graph = function if isinstance(function, FunctionGraph) else FunctionGraph.of(function)
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
        """The compiled map, None if there is none."""
        lanes = machine_lanes() if in_lanes else 0
        text = define({"N_IN": len(self._input_sizes), "N_OUT": len(self._output_sizes)})
        if not lanes:
            text += driver_text("map_job") + driver_text("map") + driver
            return self._map(self.name, text, SYMBOL)
        text += define({"TOTAL": sum(self._input_sizes) + sum(self._output_sizes)})
        for name, sizes in (("SIZES_IN", self._input_sizes), ("SIZES_OUT", self._output_sizes)):
            text += f"#define {name} {{{', '.join(map(str, sizes))}}}\n"
        text += driver_text("map_job") + driver_text("map_lanes")
        try:
            return self._map(f"{self.name}_lanes{lanes}", text, SYMBOL_LANES, lanes)
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
        """The function, row-major."""
        return row_major(self._graph.function)

    def __call__(self, *inputs: Any) -> tuple[NDArray[np.float64], ...]:
        """Evaluate one sample or a batch.

        Args:
            inputs: One array per input, of its shape or with one leading batch dimension k;
                inputs without it are the same for the whole batch.

        Returns:
            One new array per output, of shape (k, *shape), or of its shape if no input has a
            batch dimension.

        Raises:
            InputError: Wrong number of inputs, a wrong shape, or batches of different lengths.
            KernelError: The function itself reports a failure.
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
        """One call with memory of its own, to be made again and again."""
        inputs, outputs = (
            [np.zeros(shape) for shape in shapes]
            for shapes in (self.input_shapes, self.output_shapes)
        )
        return SingleCall(self.name, self.entry, inputs, outputs)

    def _is_one_sample(self, inputs: Sequence[Any]) -> bool:
        """Whether nothing has to be checked or converted: that takes longer than a call."""
        return len(inputs) == len(self.input_shapes) and all(
            type(array) is np.ndarray and array.shape == shape and array.dtype == np.float64
            for array, shape in zip(inputs, self.input_shapes, strict=True)
        )

    def _run_one(
        self, arrays: Sequence[NDArray[np.float64]], count: int | None
    ) -> tuple[NDArray[np.float64], ...]:
        """A single sample: kept memory takes half the time of new memory."""
        try:
            single = self._singles.pop()
        except IndexError:
            single = self._single()
        for kept, array in zip(single.inputs, arrays, strict=True):
            kept[...] = array
        single()
        outputs = tuple(
            output.copy() if count is None else output[None].copy() for output in single.outputs
        )
        self._singles.append(single)
        return outputs

    def checked(
        self, inputs: Sequence[Any]
    ) -> tuple[list[NDArray[np.float64]], list[int], int | None]:
        """Inputs of a call as arrays.

        Returns:
            The arrays; the doubles from one sample to the next of each, 0 where it is the same for
            the whole batch; the length of the batch, None without one.

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
                array = array[:, 0]  # vectors of one number
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
        job, _kept = _map_job(arrays, steps, outputs, self._output_sizes, count)
        drive(self.name, self.entry, job)

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
    """The numpy shape of a CasADi matrix: scalars and columns lose the dimensions of length 1."""
    rows, columns = size
    if columns != 1:
        return (rows, columns)
    return () if rows == 1 else (rows,)


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
        size, given, told = states.shape[1], asked.shape[1], records.shape[1]
        arrays = (states, asked), (size, given), (states[1:], records), (size, told)
        job, _kept = _map_job(*arrays, count)
        drive(self._kernel.name, self._kernel.entry, job)
        return states[1:], records

    def _evaluate(self, state: Array, parameters: Array, after: Array, record: Array) -> None:
        slow = self._slow
        assert slow is not None
        slow.inputs[0][:], slow.inputs[1][:] = state, parameters
        if not slow():
            raise KernelError(f"{self._kernel.name}: the function reports a failure")
        after[:], record[:] = slow.outputs
