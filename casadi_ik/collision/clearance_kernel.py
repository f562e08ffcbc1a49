"""Kernel for the smallest distances of a robot's shapes in batches of configurations."""

from __future__ import annotations

import ctypes
import math
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.distances import PairTable, pair_distances
from casadi_ik.collision.model import shape_pose_size, shape_poses
from casadi_ik.collision.solids import C_NAMES
from casadi_ik.compile.cancellation import SLICE, check, run_cancellable
from casadi_ik.compile.codegen import c_struct, define, driver_text
from casadi_ik.compile.function_kernel import FunctionKernel, doubles, machine_lanes, memory
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.compile.libraries import load_function
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.model.description import RobotDescription

CLEARANCE_SYMBOL = "casadi_ik_clearance"
"""Name of the compiled function."""

RECENT = 8
"""Number of recently critical pairs, which the driver checks first."""

NUMPY_CHUNK_SIZE = 1024
"""Number of configurations per chunk without a compiled driver."""


ClearanceJob = c_struct("clearance_job", {"RECENT": RECENT})


OBSTACLES = 4
"""Maximum number of clearances that a goal configuration takes into account."""

RELIST_MOTION = 0.1
"""Largest motion of shapes after which a guard compares all pairs again [m]."""

NearbyPairs = c_struct("nearby_pairs", driver="guard")
GuardJob = c_struct("guard_job", driver="guard")


class Guarding:
    """Compiled collision checks of a follower and their memory; not thread-safe.

    Attributes:
        poses: (m, 12) poses of the scene's solids; see `surround`.
        goal: (n,) configuration that avoids obstacles; callers write into it.
        lacking: (OBSTACLES,) lacking clearances of the nearest pairs at the goal [m].
        slopes: (OBSTACLES, n) gradients of their distances [m per rad or m].
        q: (n,) positions of the motors; callers write into it, and into the next two.
        last_step: (n,) last step of the motors.
        wanted_step: (n,) next step without obstacles.
        share: (n,) share of that step that is free, by motor; 0 if the motor brakes.
        step: (n,) step from which the motors can stop without collision.
        q_rest: (n,) positions at rest after that step.
    """

    def __init__(
        self,
        kernel: ClearanceKernel,
        poses: Array,
        table: PairTable,
        levers: Array,
        hand: Array,
        side: Array,
        change: Array,
        shares: tuple[float, ...],
        **distances: float,
    ) -> None:
        """Allocate the memory.

        Args:
            kernel: Compiled kernel of the robot.
            poses: (m, 12) poses of the scene's solids.
            table: Pairs of shapes.
            levers: (p, n) levers of the motors, see `collision.distances.levers`.
            hand: (n,) 1 for motors beyond a palm.
            side: (n,) number of a motor's side; -1 for motors that move all palms.
            change: (n,) largest change of a step from cycle to cycle.
            shares: Shares of the wanted step that are tried in turn.
            distances: The scalars `required_distance`, `avoided_distance` and `nudge` of guard_job.
        """
        count, n = levers.shape
        # A copy, because the solids may move.
        self.poses = np.array(poses)
        names = "goal", "q", "last_step", "wanted_step", "share", "step", "q_rest"
        vectors = {name: np.zeros(n) for name in names}
        self.goal, self.q, self.last_step, self.wanted_step, self.share, self.step, self.q_rest = (
            vectors.values()
        )
        self.lacking, self.slopes = np.zeros(OBSTACLES), np.zeros((OBSTACLES, n))
        scene, scene_arrays = kernel.job(self.q, self.poses, table, math.inf, -math.inf)
        self._q_listed, numbers = np.full((2, n), math.nan), np.empty((2, 2, count))
        pair_numbers = np.empty((2, 2, count), dtype=np.int64)
        arrays = vectors | {
            "levers": np.pad(levers, ((0, 0), (0, -n % 8))),
            "hand": doubles(hand),
            "side": doubles(side),
            "max_levers": levers.max(axis=0, initial=0.0),
            "change": doubles(change),
            "shares": doubles(shares),
            "lacking": self.lacking,
            "slopes": self.slopes,
        }
        nearby = [
            NearbyPairs(
                q_listed=memory(q_listed),
                listed=memory(listed),
                distance_bounds=memory(bounds),
                candidates=memory(candidates),
                required=memory(required),
            )
            for q_listed, (listed, candidates), (bounds, required) in zip(
                self._q_listed, pair_numbers, numbers, strict=True
            )
        ]
        self._job = GuardJob(
            scene=ctypes.addressof(scene),
            near_goal=ctypes.addressof(nearby[0]),
            near_path=ctypes.addressof(nearby[1]),
            n_shares=len(shares),
            relist_motion=RELIST_MOTION,
            **{name: memory(array) for name, array in arrays.items()},
            **distances,
        )
        self._referenced = scene, scene_arrays, nearby, pair_numbers, numbers, arrays
        self._name, self._reference = kernel.name, ctypes.byref(self._job)
        self._keep_away, self._stop_in_time = kernel.guards

    def surround(self, poses: Array) -> None:
        """Set the poses (m, 12) of the scene's solids."""
        self.poses[...] = poses
        self._q_listed[...] = math.nan

    def keep_away(self) -> None:
        """Compute the lacking clearances and slopes at the goal."""
        if code := self._keep_away(self._reference):
            check(self._name, code)

    def stop_in_time(self) -> None:
        """Compute the free step."""
        if code := self._stop_in_time(self._reference):
            check(self._name, code)


class ClearanceKernel:
    """The distance kernel of a robot; threads may share it.

    Attributes:
        name: Name of the kernel.
        size: Number of values of `shape_poses`.
        entry: The compiled driver; None: distances are computed in numpy.
        guards: The functions of `Guarding`, compiled in the same library.
    """

    def __init__(self, robot: RobotDescription, compiled: bool = True) -> None:
        """Compile the poses of the shapes with the driver, or load them from the cache.

        Args:
            robot: A robot with collision shapes.
            compiled: Use the compiled driver; False: the virtual machine and numpy.
        """
        n, size = len(robot.actuators), shape_pose_size(robot)
        name = ca.Function.fix_name(f"{robot.name}_shapes")

        def build() -> ca.Function:
            q = ca.SX.sym("q", n)
            return ca.Function(name, [q], [shape_poses(robot, q)], ["q"], ["shapes"])

        key = recipe(name, robot)
        self._graph = FunctionGraph(name, build, {"q": (n, 1)}, ((size, 1),), key)
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
        names = "clearance_job", "clearance", "guard"
        library = load_function(
            f"{self.name}_lanes{lanes}",
            lambda: self._graph.function,
            define(constants) + "".join(map(driver_text, names)),
            CLEARANCE_SYMBOL,
            self._graph.recipe,
            lanes,
        )
        if library is None:
            return None
        self.guards = library["casadi_ik_keep_away"], library["casadi_ik_stop_in_time"]
        return library[CLEARANCE_SYMBOL]

    @cached_property
    def shape_poses(self) -> FunctionKernel:
        """Function from q to the poses of the shapes, see `collision.model.shape_poses`."""
        return FunctionKernel(self._graph, self._compiled)

    def min_distances(
        self,
        q: Array,
        poses: Array,
        table: PairTable,
        max_distance: float = math.inf,
        stop_below: float = -math.inf,
    ) -> tuple[Array, NDArray[np.int64]]:
        """Compute the smallest distance of each configuration.

        Args:
            q: (k, n) configurations.
            poses: (m, 12) poses of the scene's solids, or (k, m, 12).
            table: The pairs.
            max_distance: Upper bound of the reported distances; larger ones are not computed.
            stop_below: Distances below this are reported as any value below it.

        Returns:
            (k,) distances minus the offsets of the pairs [m], and (k,) indices of the pairs; -1 if
            no distance is below `max_distance`.
        """
        return self._distances(q, poses, table, max_distance, None, stop_below)

    def all_distances(self, q: Array, poses: Array, table: PairTable) -> Array:
        """Compute the distances (k, p) of all pairs [m], see `min_distances`."""
        distances = np.empty((len(q), len(table.pairs)))
        self._distances(q, poses, table, math.inf, distances)
        return distances

    def job(
        self, q: Array, poses: Array, table: PairTable, max_distance: float, stop_below: float
    ) -> tuple[Any, tuple[Any, ...]]:
        """Return the arguments of the driver without memory for results.

        Args:
            q: (k, n), aligned doubles.
            poses: As for `min_distances`.
            table: As for `min_distances`.
            max_distance: As for `min_distances`.
            stop_below: As for `min_distances`.

        Returns:
            The job, and the objects that must outlive it.
        """
        solids, planes = table.driver_arrays
        solid_poses = doubles(poses)
        radii, halves, offsets = map(doubles, (table.radii, table.half_lengths, table.offsets))
        job = ClearanceJob(
            q=memory(q),
            poses=solid_poses.ctypes.data,
            pose_step=solid_poses[0].size if solid_poses.ndim == 3 else 0,
            n_solids=len(solids) - table.n_robot_solids,
            solids=solids.ctypes.data,
            planes=planes.ctypes.data,
            radii=memory(radii),
            halves=memory(halves),
            pairs=table.pairs.ctypes.data,
            offsets=memory(offsets),
            n_pairs=len(table.pairs),
            recent=(ctypes.c_int64 * RECENT)(*[-1] * RECENT),
            max_distance=max_distance,
            stop_below=stop_below,
            count=len(q),
            slice=SLICE,
        )
        return job, (q, solid_poses, radii, halves, offsets, table)

    def _distances(
        self,
        q: Array,
        poses: Array,
        table: PairTable,
        max_distance: float,
        all_distances: Array | None,
        stop_below: float = -math.inf,
    ) -> tuple[Array, NDArray[np.int64]]:
        q = doubles(q)
        if poses.ndim == 3 and len(poses) == 1:
            poses = poses[0]
        if poses.ndim == 3 and len(poses) != len(q):
            raise InputError(f"{self.name}: {len(poses)} poses for {len(q)} configurations")
        distances, pairs = np.full(len(q), max_distance), np.full(len(q), -1, dtype=np.int64)
        if not len(q) or not len(table.pairs):
            return distances, pairs
        if self.entry is None:
            self._compute_in_numpy(q, poses, table, distances, pairs, all_distances)
            return distances, pairs
        job, _buffers = self.job(q, poses, table, max_distance, stop_below)
        job.distances, job.closest_pairs = memory(distances), memory(pairs)
        job.all_distances = None if all_distances is None else memory(all_distances)
        run_cancellable(self.name, self.entry, job)
        return distances, pairs

    def _compute_in_numpy(
        self,
        q: Array,
        poses: Array,
        table: PairTable,
        distances: Array,
        pairs: NDArray[np.int64],
        all_distances: Array | None,
    ) -> None:
        for first in range(0, len(q), NUMPY_CHUNK_SIZE):
            rows = slice(first, first + NUMPY_CHUNK_SIZE)
            (shapes,) = self.shape_poses(q[rows])
            solid_poses = poses[rows] if poses.ndim == 3 else poses
            distance, _ = pair_distances(shapes, solid_poses, table)
            if all_distances is not None:
                all_distances[rows] = distance
            closest = distance.argmin(axis=1)
            smallest = distance[np.arange(len(closest)), closest]
            is_below = smallest < distances[rows]
            distances[rows] = np.where(is_below, smallest, distances[rows])
            pairs[rows] = np.where(is_below, closest, -1)
