"""Search for the configurations nearest to contacts that are out of reach.

The distance of a configuration from a target is the sum of its squared contact errors, each divided
by its tolerance. Several configurations descend to local minima of this distance, and the nearest
minimum is returned: the start and the end of the failed solve, and seeds from distinct regions of
the joint space (`nearest_seeds`). It is the best minimum found; nothing is proved.

The search is C code (compile/runtime/nearest_search.c), which calls the loop of the descent.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.compile.cancellation import SLICE, DriverCode, run_cancellable
from casadi_ik.compile.codegen import WIDE, c_struct, define, driver_text
from casadi_ik.compile.function_kernel import machine_lanes, memory
from casadi_ik.compile.graphs import recipe
from casadi_ik.compile.libraries import load_library
from casadi_ik.compile.loop import (
    MIN_BATCH_FOR_LANES,
    MIN_SOLVES_IN_LANES,
    NO_LIMIT,
    SLOTS,
    UNBEGUN,
    Job,
    LoopKernel,
)
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH, Kinds
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.closest import find_closest
from casadi_ik.solve.hand_first.search_code import EXPORT
from casadi_ik.solve.nearest_descent import DESCENT, DescentStep
from casadi_ik.solve.nearest_seeds import SEED_SETTINGS, SeedSettings, SeedTable
from casadi_ik.solve.row_selection import smallest_per_owner
from casadi_ik.solve.subproblems import SubproblemSolver, residual_norms, residual_tolerances


@dataclass(frozen=True)
class NearestSettings:
    """Settings of the search for the nearest configurations. Source: ``studies/best_effort.py``.

    Attributes:
        seeds: Settings of the seeds.
        race_steps: Number of steps that all starts make.
        finalists: Number of starts that continue to the minimum, and additional ones per motor.
        duplicate_gap: Relative difference of two distances below which one of two starts continues.
        tie: Relative difference of two minima below which the configuration nearer to the start
            is chosen.
        chunk_size: Number of targets whose starts are in memory at the same time.
    """

    seeds: SeedSettings = SEED_SETTINGS
    race_steps: int = 12
    finalists: tuple[int, int] = (12, 1)
    duplicate_gap: float = 1e-3
    tie: float = 1e-6
    chunk_size: int = 32


NEAREST_SETTINGS = NearestSettings()

UNLIMITED_STEP = 1e3
"""Step of a descent that the limits of the motors alone bound."""

IN_COLLISION = 1e12
"""Factor of the distance of a configuration in collision, larger than any ratio of distances."""

STARTS_WITHOUT_COMPILER = 32
"""Number of spread configurations that descend if there is no compiled code."""

SEARCH_SYMBOL = "casadi_ik_nearest_search"

FINISH_STAGE, CHOICE_STAGE = 2, 3
"""Last stages of a search, see compile/runtime/nearest_search.c."""

SearchJob = c_struct("nearest_search_job")


def search_code() -> str:
    """Return the C code of the search; it requires the macro NEAREST_SEARCH, its declaration."""
    codes = {code.name: int(code) for code in DriverCode}
    texts = map(driver_text, ("nearest_search_job", "loops", "nearest_search"))
    return define(codes | {"UNBEGUN": UNBEGUN}) + "".join(texts)


def _library_text(is_wide: bool) -> str:
    """Return the text of the library of the search."""
    entry = f"#define NEAREST_SEARCH EXPORT int {SEARCH_SYMBOL}(nearest_search_job *job)\n"
    return "".join(
        (
            WIDE if is_wide else "",
            "#include <stdint.h>\n#include <string.h>\n",
            EXPORT,
            entry,
            driver_text("jobs"),
            search_code(),
        )
    )


def _load_search() -> Any:
    """Return the compiled search; None without a compiler."""
    is_wide = machine_lanes() > 0
    key = recipe("nearest_search", is_wide)
    library = load_library("nearest_search", lambda: _library_text(is_wide), SEARCH_SYMBOL, key)
    return None if library is None else library[SEARCH_SYMBOL]


@dataclass(frozen=True, eq=False)
class NearestMinima:
    """Configurations nearest to k targets.

    Attributes:
        q: (k, n) configurations [rad or m].
        mean_square: (k,) mean squares of their contact errors, each divided by its tolerance.
        is_free: (k,) False where all minima of a target are in collision.
    """

    q: Array
    mean_square: Array
    is_free: NDArray[np.bool_]


class SearchMemory:
    """Memory of the search of some targets at a time; not shared by threads.

    Attributes:
        job: Job of the C code, without the data of the targets.
        states: (capacity, starts, ns) states of the descents.
        finalists: (capacity, finalists) rows of `states` that descend to their minimum; -1: none.
    """

    def __init__(
        self, seeds: SeedTable, step: DescentStep, settings: NearestSettings, capacity: int
    ) -> None:
        """Allocate the memory.

        Args:
            seeds: Tables of postures.
            step: Step of the descent.
            settings: Settings of the search.
            capacity: Number of targets.
        """
        tables, robot = seeds.tables, seeds.robot
        n, n_groups = len(robot.actuators), len(tables.groups)
        layout, state = step.parameters, step.state
        n_starts = 2 + tables.n_seeds
        count, count_per_motor = settings.finalists
        n_finalists = min(count + count_per_motor * n, n_starts)
        n_sorted = max(tables.n_candidates, n_starts)
        descents = capacity * n_starts
        loop_arrays = self._loop_arrays = {
            "iterations": np.zeros(descents, dtype=np.int64),
            "status": np.zeros(descents, dtype=np.int32),
            "seconds": np.zeros(descents),
            "slots": np.zeros(SLOTS, dtype=np.int64),
            "iterations_before": np.zeros(SLOTS, dtype=np.int64),
            "mark": np.zeros((SLOTS, state.size)),
        }
        self.loop = Job(
            **{name: memory(array) for name, array in loop_arrays.items()},
            slot_count=SLOTS,
            remaining_steps=NO_LIMIT,
            min_solves=MIN_SOLVES_IN_LANES,
            slice=SLICE,
        )
        self.states = np.zeros((capacity, n_starts, state.size))
        self.finalists = np.zeros((capacity, n_finalists), dtype=np.int64)
        work = self._work = {
            "states": self.states,
            "finalists": self.finalists,
            "slot_memory": np.zeros((SLOTS, state.size + layout.size)),
            "costs": np.zeros(tables.max_rows, dtype=np.float32),
            "coefficients": np.zeros(tables.max_features, dtype=np.float32),
            "sorted_values": np.zeros(n_sorted),
            "sorted": np.zeros(n_sorted, dtype=np.int64),
            "rows": np.zeros((n_sorted, 1 + n_groups), dtype=np.int64),
        }
        self._tables = tables
        has_tangents = "tangents" in layout.names
        self.job = SearchJob(
            **tables.members,
            **{name: memory(array) for name, array in work.items()},
            **{name: layout.slice(name).start for name in ("points", "normals", "weights")},
            **{name: layout.slice(name).start for name in ("lower", "upper")},
            tangents=layout.slice("tangents").start if has_tangents else -1,
            loop=ctypes.addressof(self.loop),
            n_state=state.size,
            n_parameters=layout.size,
            **{f"state_{name}": state.slice(name).start for name in ("q", "damping", "distance")},
            n_starts=n_starts,
            n_finalists=n_finalists,
            race_steps=settings.race_steps,
            max_iterations=DESCENT.max_iterations,
            length=LENGTH,
            damping=DESCENT.damping,
            tie=settings.tie,
            duplicate_gap=settings.duplicate_gap,
        )

    def descents(self, count: int) -> tuple[Rows, Array]:
        """Return target indices (m,) and states (m, ns) of the finalists of `count` targets."""
        finalists = self.finalists[:count]
        owner, _ = np.nonzero(finalists >= 0)
        return owner, self.states.reshape(-1, self.states.shape[2])[finalists[finalists >= 0]]

    def set_distances(self, count: int, distances: Array) -> None:
        """Replace the distances of the finalists, in the order of `descents`."""
        finalists = self.finalists[:count]
        states = self.states.reshape(-1, self.states.shape[2])
        states[finalists[finalists >= 0], self.job.state_distance] = distances


class NearestSearch:
    """Search for the nearest configurations of one robot; threads may share it."""

    def __init__(
        self,
        trials: SubproblemSolver,
        kinds: Kinds,
        compiled: bool = True,
        settings: NearestSettings = NEAREST_SETTINGS,
    ) -> None:
        """Store the runs of the loop; the table is built at the first search."""
        self._trials, self._settings = trials, settings
        self._step = DescentStep(trials.robot.description, kinds)
        self._seeds = SeedTable(trials.robot, settings.seeds)
        self._compiled = compiled
        self._free_memory: dict[int, list[SearchMemory]] = {}

    def with_settings(self, settings: NearestSettings) -> NearestSearch:
        """Return a search with other settings."""
        return NearestSearch(self._trials, self._step.kinds, self._compiled, settings)

    @cached_property
    def _kernel(self) -> LoopKernel:
        return LoopKernel(self._step.graph, self._compiled)

    @cached_property
    def _entry(self) -> Any:
        """The compiled search; None without compiled code."""
        return _load_search() if self._kernel.compiled else None

    def solve(
        self,
        targets: TargetBatch,
        last_q: Array,
        query: CollisionQuery | None,
        options: BestEffort,
    ) -> NearestMinima:
        """Return nearest configurations as options require; for the arguments see `find`."""
        targets = options.start(targets)
        tolerances = options.tolerances(targets, self._trials.robot.fingers)
        if not options.local:
            minima = self.find(targets, last_q, query, tolerances)
            if not options.minimax:
                return minima
            q = minima.q
        else:
            q = self.descend(targets, tolerances=tolerances)
        if options.minimax:
            descents = WeightedDescents(self, targets)
            q = find_closest(descents, np.arange(len(q)), q, 1, tolerances).minimax_q
        is_free = np.ones(len(q), dtype=bool) if query is None else query.check(q).free
        distances = self.distances(targets, np.arange(len(q)), q, tolerances)
        counts = np.maximum((tolerances > 0).sum(axis=(1, 2)), 1)
        return NearestMinima(q, distances / counts, is_free)

    def find(
        self,
        targets: TargetBatch,
        last_q: Array,
        query: CollisionQuery | None = None,
        tolerances: Array | None = None,
    ) -> NearestMinima:
        """Return the nearest configurations found.

        Args:
            targets: k targets of the kinds of contacts of this search; their starts decide between
                equally near configurations.
            last_q: (k, n) configurations at which the solves ended; NaN: none [rad or m].
            query: Collision query of the targets; None: collisions are not checked. If none of a
                target's minima is free of collisions, the nearest one is returned.
            tolerances: (k, f, 2) residuals by which errors are divided, 0 where free; None: those
                at tolerance.
        """
        q0 = np.ascontiguousarray(targets.starts(self._trials.robot.description))
        if tolerances is None:
            tolerances = residual_tolerances(targets)
        parameters = self.parameters(targets, UNLIMITED_STEP, tolerances)
        if self._entry is None:
            q, distances = self._find_without_compiler(parameters, q0, last_q, query)
        else:
            q, distances = self._find_compiled(targets, parameters, q0, last_q, query)
        is_free = distances < IN_COLLISION
        distances = np.where(is_free, distances, distances / IN_COLLISION - 1)
        smallest = np.where(tolerances > 0, tolerances, np.inf).min(axis=(1, 2))
        counts = np.maximum((tolerances > 0).sum(axis=(1, 2)), 1)
        return NearestMinima(q, 2 * distances / (counts * smallest**2), is_free)

    def _find_compiled(
        self,
        targets: TargetBatch,
        parameters: Array,
        q0: Array,
        last_q: Array,
        query: CollisionQuery | None,
    ) -> tuple[Array, Array]:
        """Return the nearest configurations (k, n) and their distances (k,)."""
        last_q = np.ascontiguousarray(last_q)
        lower, upper = targets.bounds(self._trials.robot.description)
        points, axes = self._seeds.rigid_hand(len(q0), lower, upper)
        q, distances = np.empty_like(q0), np.empty(len(q0))
        size = 1 if len(q0) == 1 else self._settings.chunk_size
        free_memory = self._free_memory.setdefault(size, [])
        try:
            search = free_memory.pop()
        except IndexError:
            search = SearchMemory(self._seeds, self._step, self._settings, size)
        job, is_shared = search.job, len(points) == 1
        job.lane_loop = self._lane_loop_address
        job.scalar_loop = ctypes.cast(self._kernel.entry, ctypes.c_void_p).value
        for start in range(0, len(q0), size):
            rows = slice(start, start + size)
            hand_rows = slice(None) if is_shared else rows
            job.count, job.stage, job.rigid_step = len(q0[rows]), 0, 0 if is_shared else 1
            job.rigid_points, job.rigid_axes = memory(points[hand_rows]), memory(axes[hand_rows])
            job.parameters, job.q0 = memory(parameters[rows]), memory(q0[rows])
            job.last_q, job.q = memory(last_q[rows]), memory(q[rows])
            job.distances = memory(distances[rows])
            job.last_stage = CHOICE_STAGE if query is None else FINISH_STAGE
            run_cancellable(self._step.graph.name, self._entry, job)
            if query is not None:
                owner, states = search.descents(job.count)
                weighted_distances = self._free_distances(query.rows(start + owner), states)
                search.set_distances(job.count, weighted_distances)
                job.last_stage = CHOICE_STAGE
                run_cancellable(self._step.graph.name, self._entry, job)
        free_memory.append(search)
        return q, distances

    @property
    def is_compiled(self) -> bool:
        """True if the search runs in compiled code."""
        return self._entry is not None

    @cached_property
    def _lane_loop_address(self) -> int | None:
        """Address of the loop in lanes, which is several times as fast; None without lanes."""
        loop = self._kernel.loop_for(MIN_BATCH_FOR_LANES)
        return None if loop is None else ctypes.cast(loop, ctypes.c_void_p).value

    def _free_distances(self, query: CollisionQuery, states: Array) -> Array:
        """Return the distances of states, which are much larger for configurations in collision."""
        distances = self._distance(states)
        is_free = query.check(self._q(states)).free
        return np.where(is_free, distances, IN_COLLISION * (1 + distances))

    def _find_without_compiler(
        self,
        parameters: Array,
        q0: Array,
        last_q: Array,
        query: CollisionQuery | None,
    ) -> tuple[Array, Array]:
        """Return the nearest minima of descents (k, n) and their distances (k,).

        The descents begin at q0, `last_q` and spread configurations.
        """
        robot, count = self._trials.robot, 2 + STARTS_WITHOUT_COMPILER
        samples = spread_points(STARTS_WITHOUT_COMPILER, len(robot.actuators))
        starts = np.empty((len(q0), count, len(robot.actuators)))
        starts[:, 0], starts[:, 1] = q0, np.where(np.isfinite(last_q), last_q, q0)
        starts[:, 2:] = robot.lower + samples * (robot.upper - robot.lower)
        owner = np.repeat(np.arange(len(q0)), count)
        q = starts.reshape(len(owner), -1)
        states = self._run(self._states(parameters[owner], q), parameters[owner])
        distances = self._distance(states)
        if query is not None:
            distances = self._free_distances(query.rows(owner), states)
        nearest = smallest_per_owner(owner, distances, 1)
        return self._q(states)[nearest], distances[nearest]

    def descend(
        self, targets: TargetBatch, is_local: bool = True, tolerances: Array | None = None
    ) -> Array:
        """Return the local minima (k, n) to which the starts of k targets descend.

        Args:
            targets: k targets of the kinds of contacts of this search.
            is_local: True for short steps, which end at a minimum near the start.
            tolerances: See `find`.
        """
        q = targets.starts(self._trials.robot.description)
        max_step = DESCENT.local_step if is_local else UNLIMITED_STEP
        if tolerances is None:
            tolerances = residual_tolerances(targets)
        return self.descend_from(q, self.parameters(targets, max_step, tolerances))

    def descend_from(self, q: Array, parameters: Array) -> Array:
        """Return the local minima (k, n) to which configurations (k, n) descend."""
        return self._q(self._run(self._states(parameters, q), parameters))

    def with_weights(self, parameters: Array, weights: Array) -> Array:
        """Return parameters (k, np) with other weights (k, f, 2) of residuals."""
        changed = parameters.copy()
        changed[:, self._step.parameters.slice("weights")] = _scaled(weights).reshape(
            len(weights), -1
        )
        return changed

    @property
    def robot(self) -> ArmHand:
        """The robot."""
        return self._trials.robot

    def parameters(self, targets: TargetBatch, max_step: float, tolerances: Array) -> Array:
        """Return the parameters (k, np) of the descent."""
        contacts = self._step.contacts
        vectors = {f"{name}s": targets.vectors(f"{name}s") for name in contacts.data}
        values = {name: np.where(np.isnan(array), 0.0, array) for name, array in vectors.items()}
        lower, upper = targets.bounds(self._trials.robot.description)
        bounds = {"weights": _weights(tolerances), "lower": lower, "upper": upper}
        return self._step.parameters.pack_rows(
            {**values, **bounds, "max_step": max_step}, len(targets)
        )

    def _states(self, parameters: Array, q: Array) -> Array:
        """Return the first states (m, ns) of descents."""
        layout = self._step.parameters
        lower, upper = (parameters[:, layout.slice(name)] for name in ("lower", "upper"))
        start = {"q": np.clip(q, lower, upper), "damping": DESCENT.damping}
        return self._step.state.pack_rows(start | {"is_exact": 0.0, "distance": 0.0}, len(q))

    def _run(self, states: Array, parameters: Array) -> Array:
        """Return the states (m, ns) at the end of descents."""
        return self._kernel.run(states, parameters, DESCENT.max_iterations).states

    def _q(self, states: Array) -> Array:
        return states[:, self._step.state.slice("q")]

    def _distance(self, states: Array) -> Array:
        return states[:, self._step.state.slice("distance")].ravel()

    def distances(
        self, targets: TargetBatch, owner: Rows, q: Array, tolerances: Array | None = None
    ) -> Array:
        """Return the sums (m,) of squared contact errors, each divided by its tolerance.

        Args:
            targets: k targets.
            owner: (m,) target index of each configuration.
            q: (m, n) configurations [rad or m].
            tolerances: See `find`.
        """
        misses = residual_norms(self._trials.robot, targets.rows(owner), q)
        tolerances = (residual_tolerances(targets) if tolerances is None else tolerances)[owner]
        ratios = np.divide(misses, tolerances, where=tolerances > 0, out=np.zeros_like(misses))
        return (ratios**2).sum(axis=(1, 2))


@dataclass(frozen=True, eq=False)
class WeightedDescents:
    """Descents of targets under changing weights.

    Attributes:
        search: The search.
        targets: k targets.
    """

    search: NearestSearch
    targets: TargetBatch

    @cached_property
    def _parameters(self) -> Array:
        return self.search.parameters(
            self.targets, DESCENT.local_step, residual_tolerances(self.targets)
        )

    def run(self, owner: Rows, q: Array, *, weights: Array) -> Array:
        """Return the local minima (m, n) to which configurations descend.

        Args:
            owner: (m,) target index of each row.
            q: (m, n) configurations [rad or m].
            weights: (m, f, 2) weights of residuals.
        """
        return self.search.descend_from(
            q, self.search.with_weights(self._parameters[owner], weights)
        )

    def misses(self, owner: Rows, q: Array) -> Array:
        """Return (m, f, 2) residual norms, see `residual_norms`."""
        return residual_norms(self.search.robot, self.targets.rows(owner), q)


def _weights(tolerances: Array) -> Array:
    """Return (k, f, 2) weights of residuals: inverse tolerances (k, f, 2), the largest is 1."""
    return _scaled(np.divide(1.0, tolerances, where=tolerances > 0, out=np.zeros_like(tolerances)))


def _scaled(weights: Array) -> Array:
    """Return weights (k, f, 2) divided by the largest of each target."""
    largest = weights.max(axis=(1, 2), keepdims=True)
    return weights / np.where(largest > 0, largest, 1.0)
