"""Searches of hand-first: their memory, and the calls that run them.

The C code of a search and its memory layout are defined in search_code.py.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import DriverCode, check
from casadi_ik.compile.function_kernel import memory
from casadi_ik.compile.loop import SLOTS, SlotSource
from casadi_ik.errors import KernelError
from casadi_ik.files.arrays import Array
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.search_code import (
    MALFORMED,
    SearchPlan,
    search_dtype,
    search_library,
)
from casadi_ik.solve.method import Outcome, SingleOutcome
from casadi_ik.solve.verdict import LIMIT_SLACK


class Searches:
    """Memory of concurrent searches and the calls that run them; not shared by threads.

    The attributes are views of the first search.

    Attributes:
        points: (f, 3) contact points [m], NaN where free; an input.
        normals: (f, 3) pad normals, NaN where free; an input.
        extra_vectors: Further vectors of the contacts, (f, 3) each; inputs.
        q0: (n,) start configuration [rad or m]; an input.
        settings: Settings that targets share, see `settings_layout`; an input.
        q: (n,) result [rad or m]; a call overwrites it, and all attributes below.
        position_error: (f,) distances [m] of contacts with points and normals only.
        angle_error: (f,) angles [rad] of these contacts.
        state: (ns,) state of the loop.
        parameters: (np,) parameters of the loop.
        postures: (candidates, hand) seeds of a restart [rad or m].
    """

    def __init__(self, plan: SearchPlan, count: int) -> None:
        """Compile the library, and allocate the memory.

        Args:
            plan: Ingredients of the C code; its kernels are compiled.
            count: Number of concurrent searches.

        Raises:
            KernelError: The compiler refused.
        """
        robot = plan.layouts.robot
        self.plan = plan
        self._name, library = search_library(plan)
        if library is None:
            raise KernelError(f"{self._name}: no compiler, and no kernel made ahead")
        self._search: Any = library["casadi_ik_search"]
        self._decide: Any = library["casadi_ik_decide"]
        self._find_postures: Any = library["casadi_ik_postures"]
        self._follow = ctypes.cast(library["casadi_ik_follow"], ctypes.c_void_p).value
        self._memory = searches = np.zeros(count, dtype=search_dtype(plan))
        self._references = _set_kernels(plan, searches, plan.kernels)
        for i, side in enumerate(plan.sides):
            self._references += self._allocate_side(side, i)
        f = len(robot.fingers)
        first = searches[0]
        self.points, self.normals = first["points"].reshape(f, 3), first["normals"].reshape(f, 3)
        self.extra_vectors = list(first["extra_vectors"][:-1].reshape(-1, f, 3))
        self.q0, self.settings, self.q = first["q0"], first["settings"], first["q"]
        self.position_error, self.angle_error = first["position_error"], first["angle_error"]
        self.state, self.parameters = first["state"], first["parameters"]
        shape = plan.options.candidates, plan.sizes["N_HAND"]
        self.postures = first["postures"][: np.prod(shape)].reshape(shape)
        self._first = first
        self._counts = self.state[plan.layouts.state.slice("counts")]
        self._base = memory(searches.view(np.uint8))
        self._address = ctypes.c_void_p(self._base)
        # NumPy takes a tenth of a solve to read an entry of a record; every solve reads these.
        offsets = searches.dtype.fields or {}
        self._max_restarts, self._iterations, self._restarts, self._status, self._paused = (
            ctypes.c_int64.from_address(self._base + offsets[name][1])
            for name in ("max_restarts", "iterations", "restarts", "status", "paused")
        )
        self._limit_violation = ctypes.c_double.from_address(
            self._base + offsets["limit_violation"][1]
        )

    def _allocate_side(self, plan: SearchPlan, side: int) -> tuple[Any, ...]:
        """Allocate the seed searches of a side, one for each search of the multi-arm robot."""
        name, library = search_library(plan)
        if library is None:
            raise KernelError(f"{name}: no compiler, and no kernel made ahead")
        searches = np.zeros(len(self._memory), dtype=search_dtype(plan))
        references = _set_kernels(plan, searches, plan.seed_kernels)
        step = searches.dtype.itemsize
        first = memory(searches.view(np.uint8))
        self._memory["sides"][:, side] = first + step * np.arange(len(searches))
        function: Any = library["casadi_ik_hands"]
        self._memory["hands"][:, side] = ctypes.cast(function, ctypes.c_void_p).value
        return references

    def set_target(self, targets: TargetBatch, row: int, settings: Array) -> None:
        """Write a target to the arrays.

        Args:
            targets: k targets.
            row: Index of the target.
            settings: Settings of the target.
        """
        self.points[...], self.normals[...] = targets.points[row], targets.normals[row]
        self.q0[...], self.settings[...] = targets.starts(self.plan.layouts.robot)[row], settings
        for vectors, name in zip(
            self.extra_vectors, self.plan.layouts.contacts.data[2:], strict=True
        ):
            vectors[...] = targets.vectors(f"{name}s")[row]

    def __call__(self, rounds: int) -> int | None:
        """Search for the target in the arrays.

        Args:
            rounds: Maximum number of restarts.

        Returns:
            Code of `Status`, after the verdict where there is one; None: the target is malformed.

        Raises:
            KernelError: No work memory.
        """
        self._max_restarts.value = rounds
        code = self._search(self._address)
        if code == DriverCode.DONE:
            return self._status.value
        if code == MALFORMED:
            return None
        try:
            while code != DriverCode.DONE:
                check(self._name, code)
                code = self._search(self._address)
        finally:
            self._paused.value = 0
        return self._status.value

    def result(self, status: int) -> SingleOutcome:
        """Return a copy of the last result.

        Args:
            status: Status that the call returned.
        """
        counts = map(int, self._counts.tolist())
        return SingleOutcome(
            q=self.q.copy(),
            status=status,
            iterations=self._iterations.value,
            restarts=self._restarts.value,
            phases=dict(zip(self.plan.layouts.labels, counts, strict=True)),
            position_error=self.position_error.tolist(),
            angle_error=self.angle_error.tolist(),
            limits_ok=self._limit_violation.value <= LIMIT_SLACK,
        )

    def decide(self, status: int, rounds: int) -> bool:
        """Return whether a restart follows; it then begins with `state` and `parameters`.

        Args:
            status: Status with which the loop ended in `state`, or `UNBEGUN`.
            rounds: Maximum number of restarts.
        """
        self._first["loop_status"], self._first["max_restarts"] = status, rounds
        code = self._decide(self._address)
        if code != DriverCode.CONTINUES:
            check(self._name, code)
        return code == DriverCode.CONTINUES

    def seeds(self, number: int) -> Array:
        """Return the seeds (candidates, hand) of a restart for the target in the arrays."""
        # Without a preference, the seeds are not sorted.
        self._first["round"], self.settings[-1] = number, 0.0
        check(self._name, self._find_postures(self._address))
        return self.postures.copy()

    def batch(
        self,
        targets: TargetBatch,
        settings: Array,
        rounds: NDArray[np.int64],
        trace: bool,
    ) -> Outcome:
        """Search for k targets, `SLOTS` of them at a time.

        Args:
            targets: The targets.
            settings: Settings of the targets, (t,) or (k, t).
            rounds: (k,) maximum numbers of restarts.
            trace: Whether to keep every iteration.
        """
        plan, count = self.plan, len(targets)
        q0 = targets.starts(plan.layouts.robot)
        data = plan.layouts.contacts.data
        extra_vectors = [targets.vectors(f"{name}s") for name in data[2:]]
        inputs = [
            *map(np.ascontiguousarray, (targets.points, targets.normals)),
            np.stack(extra_vectors, axis=1) if extra_vectors else np.zeros(1),
            *map(np.ascontiguousarray, (q0, settings)),
            rounds,
        ]
        outputs = [
            np.empty_like(q0, order="C"),
            np.empty((count, len(plan.layouts.phases))),
            np.empty(count, dtype=np.int64),
        ]
        step = 0 if settings.ndim == 1 else settings.shape[1]
        job = (ctypes.c_int64 * 11)(self._base, *map(memory, inputs), step, *map(memory, outputs))
        fields: Any = self._memory.dtype.fields
        result = plan.solve.run_from_slots(
            SlotSource(
                states=self._base + fields["state"][1],
                parameters=self._base + fields["parameters"][1],
                step=self._memory.dtype.itemsize // 8,
                slots=len(self._memory),
                follow=self._follow or 0,
                method=ctypes.addressof(job),
            ),
            count,
            plan.budget,
            trace,
        )
        q, counts, restarts = outputs
        return Outcome(
            q=q,
            status=result.status.astype(np.int64),
            iterations=result.iterations,
            restarts=restarts,
            time=result.time,
            phases=dict(zip(self.plan.layouts.labels, counts.astype(np.int64).T, strict=True)),
            rows=result.rows,
        )


def _set_kernels(
    plan: SearchPlan, searches: NDArray[Any], kernels: dict[str, Any]
) -> tuple[Any, ...]:
    """Store the addresses of kernels in searches; return the objects that must stay alive."""
    tables = plan.seeds.tables(plan.enforce_limits)
    for i, table in enumerate(tables):
        searches["tiles"][:, i] = memory(table.lookup.tiles)
    for name, kernel in kernels.items():
        searches[name] = ctypes.cast(kernel.entry, ctypes.c_void_p).value
    return kernels, tables, searches


class SearchPool:
    """Pool of search memory, which grows with the number of concurrent threads."""

    def __init__(self, plan: Callable[[bool], SearchPlan]) -> None:
        """Store the factory of plans; nothing is compiled yet.

        Args:
            plan: Return the plan with or without enforced limits.
        """
        self._plan = plan
        self._free: dict[tuple[bool, int], list[Searches]] = {}

    @contextmanager
    def lent(self, enforce_limits: bool, count: int = 1) -> Iterator[Searches]:
        """Lend memory for one search, or for `SLOTS` searches if there are several targets."""
        size = SLOTS if count > 1 else 1
        free = self._free.setdefault((enforce_limits, size), [])
        try:
            searches = free.pop()
        except IndexError:
            searches = Searches(self._plan(enforce_limits), size)
        yield searches
        free.append(searches)
