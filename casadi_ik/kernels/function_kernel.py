"""A CasADi Function as a fast callable on numpy arrays, with or without a batch dimension."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import InputError, KernelError
from casadi_ik.kernels.buffered import BufferedFunction, doubles, memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.cancellation import stop_if_cancelled
from casadi_ik.kernels.codegen import define, driver_text, library_source, row_major
from casadi_ik.kernels.driver_code import SLICE, DriverCode, check
from casadi_ik.kernels.function_graph import FunctionGraph

SYMBOL = "casadi_ik_map"


class MapJob(ctypes.Structure):
    """`map_job` of drivers/map_job.c."""

    _fields_ = (
        ("inputs", ctypes.c_void_p),
        ("input_steps", ctypes.c_void_p),
        ("outputs", ctypes.c_void_p),
        ("output_steps", ctypes.c_void_p),
        ("count", ctypes.c_int64),
        ("next", ctypes.c_int64),
        ("slice", ctypes.c_double),
    )


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
        sources = (ctypes.c_void_p * len(inputs))(*map(memory, inputs))
        targets = (ctypes.c_void_p * len(outputs))(*map(memory, outputs))
        steps = (ctypes.c_int64 * max(len(inputs), len(outputs)))()
        self._kept = sources, targets, steps
        self._job = MapJob(
            *map(ctypes.addressof, (sources, steps, targets, steps)), count=1, next=0, slice=SLICE
        )
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
    """

    def __init__(self, function: ca.Function | FunctionGraph, compiled: bool = True) -> None:
        """Compile the function or load it from the cache.

        Args:
            function: Any Function; sparse inputs and outputs are made dense.
            compiled: False keeps to the virtual machine.

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
        self._output_steps = np.array([r * c for r, c in graph.outputs], dtype=np.int64)
        library = self._load() if compiled else None
        self.compiled = library is not None
        self.entry: Any = None if library is None else library[SYMBOL]
        self._singles: list[SingleCall] = []

    def _load(self) -> ctypes.CDLL | None:
        driver = define(self.constants) + driver_text("map_job") + driver_text("map")
        write = partial(library_source, loops=self._graph.loops)
        build = (self.name, lambda: self.function, driver, SYMBOL, self._graph.recipe)
        return load_library(*build, write)

    @property
    def constants(self) -> dict[str, int]:
        """What the driver expects."""
        return {"N_IN": len(self.input_shapes), "N_OUT": len(self.output_shapes)}

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
        sources = (ctypes.c_void_p * len(arrays))(*map(memory, arrays))
        strides = (ctypes.c_int64 * len(arrays))(*steps)
        targets = (ctypes.c_void_p * len(outputs))(*map(memory, outputs))
        job = MapJob(
            ctypes.addressof(sources),
            ctypes.addressof(strides),
            ctypes.addressof(targets),
            memory(self._output_steps),
            count,
            0,
            SLICE,
        )
        while (code := self.entry(ctypes.byref(job))) != DriverCode.DONE:
            check(self.name, code)

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
