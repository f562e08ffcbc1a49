"""Least distances of a robot's shapes for batches of configurations, some at a time."""

from __future__ import annotations

import ctypes
import math
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import Table, nearest
from casadi_ik.collision.model import placed, size_of
from casadi_ik.collision.solids import C_NAMES
from casadi_ik.compile.cancellation import SLICE, check, run_cancellable
from casadi_ik.compile.codegen import c_struct, define, driver_text
from casadi_ik.compile.function_kernel import FunctionKernel, doubles, machine_lanes, memory
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.compile.libraries import load_function
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription

SYMBOL = "casadi_ik_clearance"

RECENT = 8
"""Pairs that the driver looks at first: those that were in the way last."""

BLOCK = 1024
"""Configurations that numpy works on at a time where there is no compiled driver."""


ClearanceJob = c_struct("clearance_job", {"RECENT": RECENT})


OBSTACLES = 4
"""Clearances that a goal minds at once."""

SPARE = 0.1
"""How far [m] motors may move things, at most, until a guard looks at all pairs again."""

Surroundings = c_struct("surroundings", driver="guard_job")
GuardJob = c_struct("guard_job")


class Guarding:
    """What keeps a follower clear, on memory of its own; not to be shared by threads.

    Attributes:
        poses: (m, 12) of the scene's solids; see `surround`.
        goal: (n,) configuration that keeps away; write into it.
        rooms: (OBSTACLES,) what the nearest pairs lack there [m]; 0: nothing.
        slopes: (OBSTACLES, n) how these distances grow [m per rad or m].
        q: (n,) where the motors are; write into it, as into the next two.
        last: (n,) their last step.
        wanted: (n,) their next.
        part: (n,) the shares of it that are free; 0: the motor brakes.
        step: (n,) the step after which they can come to rest free.
        rest: (n,) where that is.
    """

    def __init__(
        self,
        kernel: ClearanceKernel,
        poses: Array,
        table: Table,
        levers: Array,
        hand: Array,
        side: Array,
        change: Array,
        shares: tuple[float, ...],
        **given: float,
    ) -> None:
        """Lay the memory out.

        Args:
            kernel: Of the robot, compiled.
            poses: (m, 12) of the scene's solids.
            table: The pairs.
            levers: (p, n) see `collision.distances.levers`.
            hand: (n,) 1 for motors beyond a palm.
            side: (n,) number of a motor's side; -1 for motors that move all palms.
            change: (n,) how much a step may differ from the last.
            shares: As in the driver.
            given: Likewise.
        """
        count, n = levers.shape
        # Of its own: what stands about the robot may move.
        self.poses = np.array(poses)
        names = "goal", "q", "last", "wanted", "part", "step", "rest"
        numbers = {name: np.zeros(n) for name in names}
        self.goal, self.q, self.last, self.wanted, self.part, self.step, self.rest = (
            numbers.values()
        )
        self.rooms, self.slopes = np.zeros(OBSTACLES), np.zeros((OBSTACLES, n))
        about, kept = kernel.job(self.q, self.poses, table, math.inf, -math.inf)
        self._at, distances = np.full((2, n), math.nan), np.empty((2, 2, count))
        listed = np.empty((2, 2, count), dtype=np.int64)
        arrays = numbers | {
            "levers": np.pad(levers, ((0, 0), (0, -n % 8))),
            "hand": doubles(hand),
            "side": doubles(side),
            "widest": levers.max(axis=0, initial=0.0),
            "change": doubles(change),
            "shares": doubles(shares),
            "rooms": self.rooms,
            "slopes": self.slopes,
        }
        here = [
            Surroundings(
                at=memory(at),
                near=memory(near),
                known=memory(known),
                close=memory(close),
                limits=memory(limits),
            )
            for at, (near, close), (known, limits) in zip(self._at, listed, distances, strict=True)
        ]
        self._job = GuardJob(
            about=ctypes.addressof(about),
            by_goal=ctypes.addressof(here[0]),
            by_way=ctypes.addressof(here[1]),
            n_shares=len(shares),
            spare=SPARE,
            **{name: memory(array) for name, array in arrays.items()},
            **given,
        )
        self._kept = about, kept, here, listed, distances, arrays
        self._name, self._reference = kernel.name, ctypes.byref(self._job)
        self._keep_away, self._stop_in_time = kernel.guards

    def surround(self, poses: Array) -> None:
        """Take the scene's solids to be elsewhere, (m, 12)."""
        self.poses[...] = poses
        self._at[...] = math.nan

    def keep_away(self) -> None:
        """Work out what the goal has to keep away from."""
        if code := self._keep_away(self._reference):
            check(self._name, code)

    def stop_in_time(self) -> None:
        """Find the step."""
        if code := self._stop_in_time(self._reference):
            check(self._name, code)


class ClearanceKernel:
    """Distances of one robot's capsules; tables and poses are parameters, threads may share it.

    Attributes:
        name: What it is called.
        size: Numbers that say where the shapes are.
        entry: The compiled driver; None: numpy works distances out.
        guards: Those of `Guarding`, compiled with it.
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
        self.guards: tuple[Any, ...] = ()
        self.entry: Any = self._load() if compiled else None

    def _load(self) -> Any:
        lanes = machine_lanes()
        if not lanes:
            return None
        shapes = self._robot.shapes
        constants = {"N_Q": self._n, "N_CAPSULES": len(shapes.capsules)}
        constants |= {"N_OWN": len(shapes.solids), "OBSTACLES": OBSTACLES, **C_NAMES}
        names = "clearance_job", "clearance", "guard_job", "guard"
        library = load_function(
            f"{self.name}_lanes{lanes}",
            lambda: self._graph.function,
            define(constants) + "".join(map(driver_text, names)),
            SYMBOL,
            self._graph.recipe,
            lanes,
        )
        if library is None:
            return None
        self.guards = library["casadi_ik_keep_away"], library["casadi_ik_stop_in_time"]
        return library[SYMBOL]

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
        run_cancellable(self.name, self.entry, job)
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
