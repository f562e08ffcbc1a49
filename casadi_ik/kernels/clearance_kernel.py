"""Least distances of a robot's shapes for batches of configurations, some at a time."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import Table, nearest
from casadi_ik.collision.model import placed, size_of
from casadi_ik.collision.solids import C_NAMES
from casadi_ik.errors import InputError
from casadi_ik.kernels.cancellation import SLICE, check, drive
from casadi_ik.kernels.codegen import c_struct, define, driver_text
from casadi_ik.kernels.function_kernel import FunctionKernel, doubles, machine_lanes, memory
from casadi_ik.kernels.graphs import FunctionGraph, recipe
from casadi_ik.kernels.libraries import load_function
from casadi_ik.robots import RobotDescription

SYMBOL = "casadi_ik_clearance"

RECENT = 8
"""Pairs that the driver looks at first: those that were in the way last."""

BLOCK = 1024
"""Configurations that numpy works on at a time where there is no compiled driver."""


ClearanceJob = c_struct("clearance_job", {"RECENT": RECENT})


@dataclass(frozen=True)
class Watching:
    """How distances are kept from call to call.

    Attributes:
        worn: So far [m] shapes may be from where all pairs were looked at until they are again.
        horizon: Distances [m] up to which pairs are told apart then.
    """

    worn: float = 0.02
    horizon: float = 0.3


WATCHING = Watching()


class Watch:
    """Distances of configurations near those of the call before; not to be shared by threads.

    What two shapes are apart changes by no more than they move. So of pairs that were far apart
    where all were looked at last nothing has to be worked out until shapes are far from there.

    Attributes:
        q: (k, n) configurations; write into it. Where the first is, all pairs are looked at.
        least: (k,) the smallest distance of each [m] after a call, `most` where none is below it.
        nearest: (few,) numbers of the pairs nearest to each other where the first configuration is,
            the nearest first; -1 where no other is below `most`.
        near: (few,) their distances [m], at most `most`.
        every: (k, p) distances of all pairs [m] where no `most` is given.
    """

    def __init__(
        self,
        kernel: ClearanceKernel,
        q: Array,
        poses: Array,
        table: Table,
        most: float = math.inf,
        enough: float = -math.inf,
        few: int = 0,
        way: bool = False,
    ) -> None:
        """Lay the memory out.

        Args:
            kernel: Of the robot.
            q: (k, n) aligned doubles, which are kept.
            poses: (m, 12) of the scene's solids.
            table: The pairs.
            most: As for `ClearanceKernel.least`.
            enough: As for `ClearanceKernel.least`.
            few: So many nearest pairs are told.
            way: Whether all configurations but the first are places on a way, evenly spaced in
                time: their distances are less by what these bend by on the way.
        """
        self.q, self.least = q, np.full(len(q), most)
        self.every = np.empty((len(q), len(table.pairs) if math.isinf(most) else 0))
        self.nearest, self.near = np.full(few, -1, dtype=np.int64), np.full(few, most)
        # Of its own: what stands about the robot may move.
        poses = np.array(poses)
        self._kernel, self._given = kernel, (poses, table, most, enough)
        self._where = np.full(kernel.size, math.nan)
        if kernel.entry is None or not len(table.pairs):
            return
        self._job, self._kept = kernel.job(q, poses, table, most, enough)
        self._closest = np.empty(len(q), dtype=np.int64)
        self._known = np.empty(len(table.pairs))
        job = self._job
        job.least, job.closest = memory(self.least), memory(self._closest)
        job.way, job.few, job.nearest, job.near = way, few, memory(self.nearest), memory(self.near)
        if math.isinf(most):
            job.every = memory(self.every)
        else:
            job.known, job.reference = memory(self._known), memory(self._where)
            job.worn, job.horizon = WATCHING.worn, most + WATCHING.horizon
        self._reference = ctypes.byref(job)

    def surround(self, poses: Array) -> None:
        """Take the scene's solids to be elsewhere, (m, 12)."""
        self._given[0][...] = poses
        self._where[:] = math.nan

    def __call__(self) -> None:
        """Work the distances out."""
        poses, table, most, enough = self._given
        if not len(table.pairs):
            return
        if self._kernel.entry is None:
            self.least[:], _ = self._kernel.least(self.q, poses, table, most, enough)
            if self.every.size:
                self.every[:] = self._kernel.every(self.q, poses, table)
            if len(self.nearest):
                (every,) = self._kernel.every(self.q[:1], poses, table)
                order = np.argsort(every, kind="stable")[: len(self.nearest)]
                found = every[order] < most
                self.nearest[:], self.near[:] = -1, most
                self.nearest[: len(order)][found] = order[found]
                self.near[: len(order)][found] = every[order[found]]
            return
        self._job.next = 0
        while code := self._kernel.entry(self._reference):
            check(self._kernel.name, code)


class ClearanceKernel:
    """Distances of one robot's capsules; tables and poses are parameters, threads may share it.

    Attributes:
        name: What it is called.
        size: Numbers that say where the shapes are.
        entry: The compiled driver; None: numpy works distances out.
    """

    def __init__(self, robot: RobotDescription, compiled: bool = True) -> None:
        """Compile the placing of the capsules with the driver, or load them from the cache.

        Args:
            robot: With shapes.
            compiled: False keeps to the virtual machine and numpy.
        """
        n, size = len(robot.actuators), size_of(robot)
        name = ca.Function.fix_name(f"{robot.name}_shapes")

        def build() -> ca.Function:
            q = ca.SX.sym("q", n)
            return ca.Function(name, [q], [placed(robot, q)], ["q"], ["shapes"])

        known = recipe(name, robot)
        self._graph = FunctionGraph(name, build, {"q": (n, 1)}, ((size, 1),), known)
        self.name, self.size, self._n = name, size, n
        self._robot = robot
        self._compiled = compiled
        self.entry: Any = self._load() if compiled else None

    def _load(self) -> Any:
        lanes = machine_lanes()
        if not lanes:
            return None
        shapes = self._robot.shapes
        constants = {"N_Q": self._n, "N_CAPSULES": len(shapes.capsules)}
        constants |= {"N_OWN": len(shapes.solids), **C_NAMES}
        texts = driver_text("clearance_job") + driver_text("clearance")
        library = load_function(
            f"{self.name}_lanes{lanes}",
            lambda: self._graph.function,
            define(constants) + texts,
            SYMBOL,
            self._graph.recipe,
            lanes,
        )
        return None if library is None else library[SYMBOL]

    @cached_property
    def placed(self) -> FunctionKernel:
        """Where the shapes are for q, see `collision.model.placed`."""
        return FunctionKernel(self._graph, self._compiled)

    def least(
        self,
        q: Array,
        poses: Array,
        table: Table,
        most: float = math.inf,
        enough: float = -math.inf,
    ) -> tuple[Array, NDArray[np.int64]]:
        """The smallest distance of each configuration.

        Args:
            q: (k, n).
            poses: (m, 12) of the scene's solids, or (k, m, 12).
            table: The pairs.
            most: Distances above it are not told apart: they are `most`.
            enough: Distances below it are not told apart either: they are anything below it.

        Returns:
            (k,) [m], offsets taken off, and (k,) the pair; -1 where none is below `most`.
        """
        return self._distances(q, poses, table, most, None, enough)

    def every(self, q: Array, poses: Array, table: Table) -> Array:
        """(k, p) distances of all pairs [m], see `least`."""
        found = np.empty((len(q), len(table.pairs)))
        self._distances(q, poses, table, math.inf, found)
        return found

    def job(
        self, q: Array, poses: Array, table: Table, most: float, enough: float
    ) -> tuple[Any, tuple[Any, ...]]:
        """What the driver works on, without memory for results; and what has to be kept meanwhile.

        Args:
            q: (k, n), aligned doubles.
            poses: As for `least`.
            table: As for `least`.
            most: As for `least`.
            enough: As for `least`.
        """
        solids, planes = table.for_driver
        places = doubles(poses)
        radii, halves, offsets = map(doubles, (table.radii, table.halves, table.offsets))
        job = ClearanceJob(
            q=memory(q),
            poses=places.ctypes.data,
            pose_step=places[0].size if places.ndim == 3 else 0,
            n_solids=len(solids) - table.own,
            solids=solids.ctypes.data,
            planes=planes.ctypes.data,
            radii=memory(radii),
            halves=memory(halves),
            pairs=table.pairs.ctypes.data,
            offsets=memory(offsets),
            n_pairs=len(table.pairs),
            recent=(ctypes.c_int64 * RECENT)(*[-1] * RECENT),
            most=most,
            enough=enough,
            count=len(q),
            slice=SLICE,
        )
        return job, (q, places, radii, halves, offsets, table)

    def _distances(
        self,
        q: Array,
        poses: Array,
        table: Table,
        most: float,
        every: Array | None,
        enough: float = -math.inf,
    ) -> tuple[Array, NDArray[np.int64]]:
        given = doubles(q)
        if poses.ndim == 3 and len(poses) == 1:
            poses = poses[0]
        if poses.ndim == 3 and len(poses) != len(given):
            raise InputError(f"{self.name}: {len(poses)} poses for {len(given)} configurations")
        least, closest = np.full(len(given), most), np.full(len(given), -1, dtype=np.int64)
        if not len(given) or not len(table.pairs):
            return least, closest
        if self.entry is None:
            self._by_numpy(given, poses, table, least, closest, every)
            return least, closest
        job, _kept = self.job(given, poses, table, most, enough)
        job.least, job.closest = memory(least), memory(closest)
        job.every = None if every is None else memory(every)
        drive(self.name, self.entry, job)
        return least, closest

    def _by_numpy(
        self,
        q: Array,
        poses: Array,
        table: Table,
        least: Array,
        closest: NDArray[np.int64],
        every: Array | None,
    ) -> None:
        for first in range(0, len(q), BLOCK):
            rows = slice(first, first + BLOCK)
            (where,) = self.placed(q[rows])
            places = poses[rows] if poses.ndim == 3 else poses
            distance, _ = nearest(where, places, table)
            if every is not None:
                every[rows] = distance
            which = distance.argmin(axis=1)
            found = distance[np.arange(len(which)), which]
            below = found < least[rows]
            least[rows] = np.where(below, found, least[rows])
            closest[rows] = np.where(below, which, -1)
