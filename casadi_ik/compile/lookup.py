"""The rows of a table that are nearest to a key, which a CasADi Function makes of its inputs."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import SLICE, drive, stop_if_cancelled
from casadi_ik.compile.codegen import c_struct, define, driver_text
from casadi_ik.compile.function_kernel import FunctionKernel, machine_lanes, memory
from casadi_ik.compile.graphs import FunctionGraph

SYMBOL = "casadi_ik_lookup"

STEPS = 64
"""Keys are compared in steps of 1 / STEPS: whole numbers of 16 bits in compiled code, without
rounding errors in single precision in numpy. Both find the same rows, alone and in a batch."""

LARGEST = 8 * STEPS
"""Entries of a key beyond this many steps count as this many."""

TILE = 16
"""Rows that compiled code compares at once: their sums stay in registers."""

CHUNK = 256
"""Samples that numpy compares at once: what fits into the cache."""


_Job = c_struct("lookup_job")


class LookupKernel:
    """Finds the nearest rows of one table; several threads may ask at once.

    Attributes:
        key: The function that makes keys.
        constants: What the driver expects, but for the function and the machine.
        compiled: Whether calls run in compiled code; numpy finds the same rows.
        tiles: (tiles, pairs of entries, TILE, 2) keys of the table in steps, for compiled code.
        entry: The compiled function, None if there is none.
    """

    def __init__(
        self, key: ca.Function | FunctionGraph, rows: Sequence[Any], compiled: bool = True
    ) -> None:
        """Compile or load from the cache, and note the keys of the table.

        Args:
            key: Any inputs -> (s, 1); NaN is an entry that is not known and does not count.
            rows: The inputs that belong to the rows, each with a leading dimension t.
            compiled: False keeps to the virtual machine and numpy.

        Raises:
            KernelError: The function has no C code, or the compiler refused it.
        """
        graph = key if isinstance(key, FunctionGraph) else FunctionGraph.of(key)
        self.constants = {
            "N_KEY": graph.outputs[0][0],
            "TILE": TILE,
            "STEPS": STEPS,
            "LARGEST": LARGEST,
        }
        self.key = FunctionKernel(graph, compiled, driver=self._driver() if compiled else "")
        (keys,) = self.key(*rows)
        self._keys = _rounded(np.nan_to_num(keys).reshape(len(keys), -1))
        # Two entries of neighbouring rows side by side, tile by tile in the order of reading: whole
        # columns a power of two apart would fall on each other in the cache.
        width = self._keys.shape[1]
        padded = np.pad(self._keys, ((0, -len(keys) % TILE), (0, width % 2))).astype(np.int16)
        self.tiles = padded.reshape(-1, TILE, (width + 1) // 2, 2).transpose(0, 2, 1, 3).copy()
        self.compiled = self.key.compiled
        self.entry: Any = self.key.library[SYMBOL] if self.compiled else None

    def _driver(self) -> str:
        own = define(self.constants | {"REGISTER_BYTES": 8 * machine_lanes()})
        return own + driver_text("lookup_job") + driver_text("lookup")

    def __call__(self, count: int, *inputs: Any) -> NDArray[np.int64]:
        """Find the nearest rows.

        Args:
            count: How many, at most as many as the table has.
            inputs: Of the function, one at least with a leading batch dimension k.

        Returns:
            (k, count) rows, nearest first; of equally near ones the first of the table.

        Raises:
            InputError: Wrong inputs, see `FunctionKernel`.
        """
        arrays, steps, samples = self.key.checked(inputs)
        found = np.empty((samples or 0, count), dtype=np.int64)
        if self.compiled:
            self._run_compiled(arrays, steps, found)
        else:
            self._run_numpy(arrays, found)
        return found

    def _run_compiled(
        self, arrays: list[NDArray[np.float64]], steps: list[int], found: NDArray[np.int64]
    ) -> None:
        job, _kept = self._job(arrays, found, steps)
        drive(self.key.name, self.entry, job)

    def _job(
        self,
        inputs: Sequence[NDArray[np.float64]],
        found: NDArray[np.int64],
        steps: Sequence[int] = (),
    ) -> tuple[Any, Any]:
        """A job, and memory that has to live as long."""
        sources = (ctypes.c_void_p * len(inputs))(*map(memory, inputs))
        strides = (ctypes.c_int64 * len(inputs))(*steps)
        job = _Job(
            inputs=ctypes.addressof(sources),
            input_steps=ctypes.addressof(strides),
            tiles=memory(self.tiles),
            found=memory(found),
            rows=len(self._keys),
            wanted=found.shape[1],
            count=len(found),
            slice=SLICE,
        )
        return job, (sources, strides)

    def _run_numpy(self, arrays: list[NDArray[np.float64]], found: NDArray[np.int64]) -> None:
        (keys,) = self.key(*arrays)
        keys = keys.reshape(len(found), self._keys.shape[1])  # also a single entry
        for start in range(0, len(keys), CHUNK):
            stop_if_cancelled()
            part = keys[start : start + CHUNK]
            known = ~np.isnan(part)
            wanted = 2 * _rounded(np.where(known, part, 0.0))
            # |row - key|^2 over what is known, without the part that all rows share.
            distance = known.astype(np.float32) @ self._keys.T**2 - wanted @ self._keys.T
            order = distance.argsort(axis=1, kind="stable")
            found[start : start + CHUNK] = order[:, : found.shape[1]]


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.rint(values * STEPS).clip(-LARGEST, LARGEST).astype(np.float32)
