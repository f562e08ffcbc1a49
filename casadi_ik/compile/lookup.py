"""Nearest-neighbour lookup in a table, with keys computed by a CasADi Function."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import SLICE, run_cancellable, stop_if_cancelled
from casadi_ik.compile.codegen import c_struct, define, driver_text
from casadi_ik.compile.function_kernel import FunctionKernel, machine_lanes, memory
from casadi_ik.compile.graphs import FunctionGraph

LOOKUP_SYMBOL = "casadi_ik_lookup"

STEPS_PER_UNIT = 64
"""Resolution of keys [steps per unit]. Compiled code compares them as 16-bit integers, NumPy
without rounding errors in single precision; both find the same rows."""

MAX_STEPS = 8 * STEPS_PER_UNIT
"""Saturation of the entries of a key [steps]."""

TILE = 16
"""Number of rows that compiled code compares at once, with sums in registers."""

CHUNK = 256
"""Number of samples that NumPy compares at once, so that they fit into the cache."""


LookupJob = c_struct("lookup_job", driver="jobs")


class LookupKernel:
    """Lookup of the nearest rows of one table; several threads may use it at once.

    Attributes:
        key: Function that computes keys.
        constants: Constants of the runtime that do not depend on the machine.
        compiled: True if calls run in compiled code; NumPy finds the same rows.
        tiles: (tiles, pairs of entries, TILE, 2) keys of the table [steps], for compiled code.
        entry: The compiled function; None if there is none.
    """

    def __init__(
        self, key: ca.Function | FunctionGraph, rows: Sequence[Any], compiled: bool = True
    ) -> None:
        """Compile the lookup or load it from the cache, and compute the keys of the table.

        Args:
            key: Function of any inputs with output (s, 1); NaN marks an unknown entry, which is
                ignored.
            rows: Inputs of the table's rows, each with a leading dimension t.
            compiled: False uses the virtual machine and NumPy.

        Raises:
            KernelError: The function has no C code, or compiling failed.
        """
        graph = key if isinstance(key, FunctionGraph) else FunctionGraph.from_function(key)
        self.constants = {
            "N_KEY": graph.outputs[0][0],
            "TILE": TILE,
            "STEPS": STEPS_PER_UNIT,
            "LARGEST": MAX_STEPS,
        }
        self.key = FunctionKernel(graph, compiled, driver=self._driver() if compiled else "")
        (keys,) = self.key(*rows)
        self._keys = _rounded(np.nan_to_num(keys).reshape(len(keys), -1))
        # Pairs of entries, tile by tile in the order of reading: columns at distances that are a
        # power of two would evict each other from the cache.
        width = self._keys.shape[1]
        padded = np.pad(self._keys, ((0, -len(keys) % TILE), (0, width % 2))).astype(np.int16)
        self.tiles = padded.reshape(-1, TILE, (width + 1) // 2, 2).transpose(0, 2, 1, 3).copy()
        self.compiled = self.key.compiled
        self.entry: Any = self.key.library[LOOKUP_SYMBOL] if self.compiled else None

    def _driver(self) -> str:
        constants = define(self.constants | {"REGISTER_BYTES": 8 * machine_lanes()})
        return constants + driver_text("lookup")

    def __call__(self, count: int, *inputs: Any) -> NDArray[np.int64]:
        """Find the nearest rows.

        Args:
            count: Number of rows to find, at most the length of the table.
            inputs: Inputs of the function; at least one has a leading batch dimension k.

        Returns:
            (k, count) row numbers, nearest first; ties in the order of the table.

        Raises:
            InputError: An input is invalid, see `FunctionKernel`.
        """
        arrays, steps, samples = self.key.checked(inputs)
        rows = np.empty((samples or 0, count), dtype=np.int64)
        if self.compiled:
            self._run_compiled(arrays, steps, rows)
        else:
            self._run_numpy(arrays, rows)
        return rows

    def _run_compiled(
        self, arrays: list[NDArray[np.float64]], steps: list[int], rows: NDArray[np.int64]
    ) -> None:
        # The arrays of addresses must stay alive with the job.
        sources = (ctypes.c_void_p * len(arrays))(*map(memory, arrays))
        strides = (ctypes.c_int64 * len(arrays))(*steps)
        job = LookupJob(
            inputs=ctypes.addressof(sources),
            input_steps=ctypes.addressof(strides),
            tiles=memory(self.tiles),
            nearest_rows=memory(rows),
            rows=len(self._keys),
            n_nearest=rows.shape[1],
            count=len(rows),
            slice=SLICE,
        )
        run_cancellable(self.key.name, self.entry, job)

    def _run_numpy(self, arrays: list[NDArray[np.float64]], rows: NDArray[np.int64]) -> None:
        (keys,) = self.key(*arrays)
        keys = keys.reshape(len(rows), self._keys.shape[1])  # also a single entry
        for start in range(0, len(keys), CHUNK):
            stop_if_cancelled()
            part = keys[start : start + CHUNK]
            is_known = ~np.isnan(part)
            targets = 2 * _rounded(np.where(is_known, part, 0.0))
            # |row - key|^2 over known entries, without the term that all rows share.
            distance = is_known.astype(np.float32) @ self._keys.T**2 - targets @ self._keys.T
            order = distance.argsort(axis=1, kind="stable")
            rows[start : start + CHUNK] = order[:, : rows.shape[1]]


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.rint(values * STEPS_PER_UNIT).clip(-MAX_STEPS, MAX_STEPS).astype(np.float32)
