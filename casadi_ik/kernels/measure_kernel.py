"""A function of many samples, some at a time: for what is measured, not for what is solved."""

from __future__ import annotations

import ctypes
import logging
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import KernelError
from casadi_ik.kernels.buffered import doubles, memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.codegen import define, driver_text, library_source, row_major
from casadi_ik.kernels.driver_code import SLICE, DriverCode, check
from casadi_ik.kernels.function_graph import FunctionGraph
from casadi_ik.kernels.function_kernel import FunctionKernel, MapJob
from casadi_ik.kernels.machine_lanes import machine_lanes

logger = logging.getLogger(__name__)

SYMBOL = "casadi_ik_map_lanes"


class MeasureKernel:
    """Evaluates a function of one vector for a batch of them; threads may call it at once."""

    def __init__(self, graph: FunctionGraph, compiled: bool = True) -> None:
        """Keep the function; it is compiled when first needed.

        Args:
            graph: One column in, one column out.
            compiled: False keeps to the virtual machine.
        """
        self._graph = graph
        self._compiled = compiled
        ((self._n_in, _),) = graph.inputs.values()
        ((self._n_out, _),) = graph.outputs

    def prepare(self) -> None:
        """Compile it."""
        if self._map is None:
            _ = self._one_by_one

    @property
    def entry(self) -> Any:
        """The compiled map, with vectors or without; None if there is none."""
        return self._one_by_one.entry if self._map is None else self._map

    @cached_property
    def _one_by_one(self) -> FunctionKernel:
        """For machines without such vectors."""
        return FunctionKernel(self._graph, self._compiled)

    @cached_property
    def _map(self) -> Any:
        lanes = machine_lanes() if self._compiled else 0
        if not lanes:
            return None
        constants = {"N_IN": 1, "N_OUT": 1, "TOTAL": self._n_in + self._n_out}
        sizes = f"#define SIZES_IN {{{self._n_in}}}\n#define SIZES_OUT {{{self._n_out}}}\n"
        driver = define(constants) + sizes + driver_text("map_job") + driver_text("map_lanes")
        try:
            library = load_library(
                f"{self._graph.name}_lanes{lanes}",
                lambda: row_major(self._graph.function),
                driver,
                SYMBOL,
                f"{self._graph.recipe} lanes {lanes}" if self._graph.recipe else "",
                partial(library_source, lanes=lanes),
            )
        except KernelError as error:
            logger.warning("%s: one sample at a time: %s", self._graph.name, error)
            return None
        return None if library is None else library[SYMBOL]

    def __call__(self, samples: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (k, m) for samples (k, n).

        Raises:
            KernelError: The function itself reports a failure.
        """
        given = doubles(samples)
        if self._map is None or not len(given):
            (values,) = self._one_by_one(given)
            return values.reshape(len(given), self._n_out)
        values = np.empty((len(given), self._n_out))
        steps = [(ctypes.c_int64 * 1)(size) for size in (self._n_in, self._n_out)]
        places = [(ctypes.c_void_p * 1)(memory(array)) for array in (given, values)]
        job = MapJob(
            *(ctypes.addressof(item) for pair in zip(places, steps, strict=True) for item in pair),
            len(given),
            0,
            SLICE,
        )
        while (code := self._map(ctypes.byref(job))) != DriverCode.DONE:
            check(self._graph.name, code)
        return values
