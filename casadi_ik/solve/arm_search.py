"""Batched search for the preferred collision-free arms at palm poses.

All branches at sampled values of the redundancy parameters are sorted by the preference and checked
until an arm is collision-free; see compile/runtime/arm_search.c.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.collision.clearance import DISTANCE_ROUNDING, CollisionQuery
from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.cancellation import DriverCode, check
from casadi_ik.compile.codegen import c_struct, driver_text
from casadi_ik.compile.function_kernel import MapJob, doubles, machine_lanes, memory
from casadi_ik.compile.graphs import recipe
from casadi_ik.compile.libraries import load_library
from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, arms_graph
from casadi_ik.model.targets import CLEARANCE

ARM_SEARCH_SYMBOL = "casadi_ik_arm_search"

FULL_TURN = 2 * np.pi
"""Full revolution [rad]."""

Preference: TypeAlias = str | Callable[[Array], Array]
"""Name in `PREFERENCES`, or a function from configurations (m, n) to scores (m,)."""


class ArmOrder(IntEnum):
    """Order of arms, with the values of compile/runtime/arm_search.c."""

    LIMITS = 0
    NEAREST = 1
    MEASURED = 2
    CLEAREST = 3


ARM_ORDERS = {
    "limits": ArmOrder.LIMITS,
    "q0": ArmOrder.NEAREST,
    "manipulability": ArmOrder.MEASURED,
    CLEARANCE: ArmOrder.CLEAREST,
}


@dataclass(frozen=True)
class FreeArmParameters:
    """Sampling of the redundancy parameters in the search for collision-free arms.

    Attributes:
        samples: Number of values of the last redundancy parameter.
        locked_samples: Number of angles of each locked joint: without other redundancy parameters,
            and with them.
        local_samples: Number of values around the best value in the refinement.
        chunk_size: Number of hands per call of the driver; Python handles signals between calls.
    """

    samples: int = 12
    locked_samples: tuple[int, int] = (5, 3)
    local_samples: int = 13
    chunk_size: int = 512


FREE_ARM_PARAMETERS = FreeArmParameters()


@dataclass(frozen=True, eq=False)
class RedundancySamples:
    """Values of the redundancy parameters at which the arms of a robot are computed.

    Attributes:
        levels: (s, r) values that are tried first, and (s, r) values for hands without a
            collision-free arm at those. A refinement varies the last of the r parameters.
        offsets: (c,) offsets of that parameter in the refinement.
    """

    levels: tuple[Array, Array]
    offsets: Array

    @classmethod
    def for_family(cls, family: ArmFamily, lower: Array, upper: Array) -> RedundancySamples:
        """Return a grid between the bounds (a,) of an arm, and values between its points."""
        locked, size = len(family.locked), len(family.redundancy)
        if not size:
            return cls((np.zeros((1, 1)), np.zeros((0, 1))), np.zeros(0))
        parameters = FREE_ARM_PARAMETERS
        counts = [parameters.locked_samples[size > locked]] * locked
        counts += [parameters.samples] * (size - locked)
        bounds = [parameter.bounds(lower, upper) for parameter in family.redundancy]
        low, high = (np.array([float(bound[i]) for bound in bounds]) for i in (0, 1))
        axes = np.meshgrid(*((np.arange(c) + 0.5) / c for c in counts), indexing="ij")
        grid = np.stack([axis.ravel() for axis in axes], axis=1)
        further_samples = (
            spread_points(2 * len(grid), size) if locked else grid + 0.5 / parameters.samples
        )
        levels = low + (high - low) * grid, low + (high - low) * further_samples
        step = (high[-1] - low[-1]) / counts[-1]
        return cls(levels, step * np.linspace(-1, 1, parameters.local_samples + 2)[1:-1])


@dataclass(frozen=True, eq=False)
class ArmCandidates:
    """Arms of k hands.

    Attributes:
        q: (m, n) configurations within the bounds.
        hand_index: (m,) index of the hand of each configuration.
        arms_tried: (k,) number of arms of each hand within the bounds.
    """

    q: Array
    hand_index: NDArray[np.intp]
    arms_tried: NDArray[np.int64]


ArmSearchJob = c_struct("arm_search_job", {"LEVELS": 2}, "arm_search")


class ArmSearch:
    """Search for the arms of one robot; threads may share it."""

    def __init__(
        self,
        robot: ArmHand,
        family: ArmFamily,
        scores: Callable[[Array, Array, Preference], Array],
        manipulability: Callable[[], FunctionKernel],
        compiled: bool = True,
        side: int | None = None,
    ) -> None:
        """Compile the closed form of the arm and the driver, or load them from the cache.

        Args:
            robot: The robot.
            family: Family of the arm.
            scores: Function from configurations (m, n), initial configurations (m, n) and a
                preference to scores (m,) of arms of the same hand; higher is better.
            manipulability: Function that returns the kernel of the manipulability of the arm.
            compiled: Use compiled kernels; False: the virtual machine and numpy.
            side: Number of the side of a multi-arm robot whose arm is searched at a fixed trunk;
                None: the arm of a robot with one arm.
        """
        self._robot, self._family = robot, family
        self.scores, self._manipulability = scores, manipulability
        description, self._side = robot.description, side
        arm = description.arm_actuators
        if side is not None:
            arm, _ = description.side_actuators[side]
            description = description.side(description.sides[side].name)
        self._columns = np.array(arm, dtype=np.int64)
        lower, upper = robot.lower[self._columns], robot.upper[self._columns]
        self._low, self._range = doubles(lower), doubles(upper - lower)
        # As in exported code: low + range may differ from high by rounding.
        self.samples = RedundancySamples.for_family(family, lower, upper)
        name = ca.Function.fix_name(f"{description.name}_all_arms")
        arms = arms_graph(family, name, recipe(name, description))
        self._arms = FunctionKernel(arms, compiled, in_lanes=True)
        self._lanes = machine_lanes() if compiled else 0
        self._run: Any = self._load() if self._lanes else None
        self._tables = tuple(map(doubles, (*self.samples.levels, self.samples.offsets)))

    @property
    def is_exact(self) -> bool:
        """True if the closed form meets the palm pose exactly."""
        return self._family.is_exact

    def _load(self) -> Any:
        parts = map(driver_text, ("jobs", "clearance_job", "arm_search"))
        driver = "".join(("#include <stdint.h>\n", *parts))
        library = load_library("arm_search", lambda: driver, ARM_SEARCH_SYMBOL, driver)
        return None if library is None else library[ARM_SEARCH_SYMBOL]

    def choose(
        self,
        q: Array,
        starts: Array,
        bounds: tuple[Array, Array],
        prefer: Preference,
        query: CollisionQuery | None,
        surplus: Array,
        all_branches: bool = False,
        refine: bool = True,
        target_index: NDArray[np.intp] | None = None,
        palms: Array | None = None,
    ) -> ArmCandidates:
        """Return the preferred collision-free arm of every hand that has one.

        Args:
            q: (k, n) configurations whose hands are collision-free, each with an arm.
            starts: (k, n) initial configurations.
            bounds: (n,) and (n,) lower and upper bounds.
            prefer: Preference among arms.
            query: Pairs whose distances this arm changes and that must not collide; None: no check.
            surplus: (k,) clearance of the hand alone beyond the margin [m]; an upper bound of the
                clearance with any arm.
            all_branches: Return the preferred arm of every branch, and the arm in q, instead of one
                arm.
            refine: Sample the redundancy more finely around the best arm.
            target_index: (k,) index of the target of each hand, in contiguous groups: after the
                first hand with an arm the other hands of its target are skipped. None: no hand is
                skipped.
            palms: (k, 4, 4) palm poses, base frame, to which the arms in q do not belong. None: the
                palm poses of q, whose arms are candidates too.

        Returns:
            The arms. With the preference "clearance" they have the largest clearance, and may be in
            collision.
        """
        if not len(q):
            return ArmCandidates(q, np.zeros(0, np.intp), np.zeros(0, np.int64))
        arm_bounds = bounds[0][self._columns], bounds[1][self._columns]
        arm_palms = self._palms_in_arm_base(q, palms)
        if palms is not None:
            q = q.copy()
            q[:, self._columns] = np.nan
        problem = _ArmProblem(q, arm_palms, starts, arm_bounds, prefer, query, surplus)
        groups = self._family.rows + 1 if all_branches else 1
        measure = _Measure(self, prefer)
        entries = [self._run, self._arms.entry]
        entries += [] if query is None else [query.kernel.entry]
        entries += [measure.address] if problem.order is ArmOrder.MEASURED else []
        if any(entry is None for entry in entries):
            return self._choose_numpy(problem, groups, target_index)
        arms, score, arms_tried = self._choose_compiled(
            problem, measure, groups, refine, target_index
        )
        hand_index, group = np.nonzero(score > -np.inf)
        configurations = q[hand_index]
        configurations[:, self._columns] = arms[hand_index, group]
        return ArmCandidates(configurations, hand_index, arms_tried)

    def _palms_in_arm_base(self, q: Array, palms: Array | None) -> Array:
        """Return (k, 4, 4) palm poses in the base frame of the arm; None: those of q."""
        body, side = self._robot.description, self._side
        if palms is None:
            palms = self._robot.palm(q, None if side is None else body.sides[side].name)
        if side is None:
            return palms
        base = np.broadcast_to(self._robot.links(q)[body.trunk_link], (len(q), 4, 4))
        return np.asarray(np.linalg.solve(base, palms), dtype=float)

    def _choose_compiled(
        self,
        problem: _ArmProblem,
        measure: _Measure,
        groups: int,
        refine: bool,
        target_index: NDArray[np.intp] | None,
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Run the compiled driver.

        Returns:
            (k, g, a) arms, (k, g) their scores or -inf for no arm, (k,) number of arms tried.
        """
        count, n_arm = len(problem.q), len(self._columns)
        best_arms, score = np.zeros((count, groups, n_arm)), np.empty((count, groups))
        arms_tried = np.zeros(count, dtype=np.int64)
        inputs = (problem.q, problem.palms, problem.starts, *problem.bounds, problem.surplus)
        q, palms, starts, lower, upper, surplus = map(doubles, inputs)
        owner = None
        if target_index is not None:
            owner = np.ascontiguousarray(target_index, dtype=np.int64)
        for rows in _slices(count, owner):
            job = ArmSearchJob(
                arms=_address(self._arms.entry),
                measure=measure.address,
                lanes=self._lanes,
                order=int(problem.order),
                n_q=q.shape[1],
                n_arm=n_arm,
                n_redundancy=self._tables[0].shape[1],
                n_rows=self._family.rows,
                n_groups=groups,
                n_samples=(ctypes.c_int64 * 2)(*map(len, self._tables[:2])),
                n_offsets=len(self._tables[2]) if refine else 0,
                samples=(ctypes.c_void_p * 2)(*(t.ctypes.data for t in self._tables[:2])),
                offsets=self._tables[2].ctypes.data,
                columns=self._columns.ctypes.data,
                lower=lower.ctypes.data,
                upper=upper.ctypes.data,
                low=self._low.ctypes.data,
                range=self._range.ctypes.data,
                q=q[rows].ctypes.data,
                palms=palms[rows].ctypes.data,
                starts=starts[rows].ctypes.data,
                owner=None if owner is None else owner[rows].ctypes.data,
                min_limit_margin=ARM_SEARCH.tolerance,
                count=rows.stop - rows.start,
                best_arms=memory(best_arms[rows]),
                score=memory(score[rows]),
                arms_tried=memory(arms_tried[rows]),
            )
            query, buffers = problem.query, None
            if query is not None and len(query.table.pairs):
                poses = query.poses[rows] if query.poses.ndim == 3 else query.poses
                kernel, table = query.kernel, query.table
                clearance_job, *buffers = kernel.job(np.zeros((1, 1)), poses, table, 0.0, 0.0)
                job.check = _address(kernel.entry)
                job.clearance = ctypes.addressof(clearance_job)
                job.poses, job.pose_step = clearance_job.poses, clearance_job.pose_step
                job.margin, job.rounding = query.margin, DISTANCE_ROUNDING
                job.clearance_bounds = surplus[rows].ctypes.data
            code = self._run(ctypes.byref(job))
            del buffers  # The driver reads their memory.
            measure.reraise()
            if code != DriverCode.DONE:
                check("arm_search", code)
        return best_arms, score, arms_tried

    def _choose_numpy(
        self, problem: _ArmProblem, groups: int, target_index: NDArray[np.intp] | None
    ) -> ArmCandidates:
        """Search in numpy, without refinement; for kernels that are not compiled."""
        samples = np.concatenate(self.samples.levels)
        results, hand_index, arms_tried = [], [], np.zeros(len(problem.q), dtype=np.int64)
        solved_targets: set[int] = set()
        for hand, configuration in enumerate(problem.q):
            if target_index is not None and int(target_index[hand]) in solved_targets:
                continue
            q, group = self._arms_within_bounds(problem, hand, configuration, samples)
            arms_tried[hand] = len(q)
            score = problem.scores(self, q, np.full(len(q), hand))
            # Select the first of the arms with the highest score of each group.
            order = np.lexsort((-np.arange(len(q)), score, group * (groups > 1)))
            group = (group * (groups > 1))[order]
            last = order[np.append(group[1:] != group[:-1], True)] if len(q) else order
            best_q = q[last[score[last] > -np.inf]]
            if len(best_q) and target_index is not None:
                solved_targets.add(int(target_index[hand]))
            results.append(best_q)
            hand_index.append(np.full(len(best_q), hand))
        return ArmCandidates(np.concatenate(results), np.concatenate(hand_index), arms_tried)

    def _arms_within_bounds(
        self, problem: _ArmProblem, hand: int, configuration: Array, samples: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """Return all arms (m, n) of a hand within the bounds, and their branches (m,).

        The arm of the configuration is the last row, with a branch number after all others.
        """
        n_rows, n = self._family.rows, len(self._columns)
        palm, (lower, upper) = problem.palms[hand], problem.bounds
        pose = np.tile(np.append(palm[:3, :3], palm[:3, 3]), (len(samples), 1))
        (outputs,) = self._arms(np.hstack([pose, samples]))
        reaches = np.append(outputs[:, n_rows * n :].ravel() >= 0, True)
        arms = np.concatenate(
            [outputs[:, : n_rows * n].reshape(-1, n), configuration[None, self._columns]]
        )
        # A joint with equal bounds is fixed, possibly in another revolution.
        at_bound = arms + FULL_TURN * np.floor((lower - arms) / FULL_TURN + 0.5)
        arms = np.where(lower < upper, arms, at_bound)
        if problem.prefer == "q0":
            start = problem.starts[hand, self._columns]
            nearest = arms + FULL_TURN * np.floor((start - arms) / FULL_TURN + 0.5)
            arms = np.where((nearest >= lower) & (nearest <= upper), nearest, arms)
        margin = np.minimum(arms - lower, upper - arms).min(axis=1)
        rows_within_bounds = np.flatnonzero(reaches & (margin >= ARM_SEARCH.tolerance))
        q = np.tile(configuration, (len(rows_within_bounds), 1))
        q[:, self._columns] = np.clip(arms[rows_within_bounds], lower, upper)
        return q, np.append(np.tile(np.arange(n_rows), len(samples)), n_rows)[rows_within_bounds]


@dataclass(frozen=True, eq=False)
class _ArmProblem:
    """Inputs of a search for the arms of k hands, see `ArmSearch.choose`."""

    q: Array
    palms: Array
    starts: Array
    bounds: tuple[Array, Array]
    prefer: Preference
    query: CollisionQuery | None
    surplus: Array

    @property
    def order(self) -> ArmOrder:
        """Order of arms in the driver."""
        return ArmOrder.MEASURED if callable(self.prefer) else ARM_ORDERS[self.prefer]

    def scores(self, search: ArmSearch, q: Array, hand: NDArray[np.intp]) -> Array:
        """Return the scores (m,) of configurations of hands (m,); -inf for a collision."""
        if not len(q):
            return np.zeros(0)
        if self.query is None:
            return search.scores(q, self.starts[hand], self.prefer)
        query = self.query.rows(hand)
        if self.prefer == CLEARANCE:
            return np.minimum(query.check(q).surplus, self.surplus[hand])
        return np.where(query.free(q), search.scores(q, self.starts[hand], self.prefer), -np.inf)


class _Measure:
    """Score of q that the driver calls like a compiled map of many rows."""

    def __init__(self, search: ArmSearch, prefer: Preference) -> None:
        self.address: int | None = None
        self._error: BaseException | None = None
        if callable(prefer):
            self._call = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(MapJob))(self._run_map)
            self._prefer, self.address = prefer, _address(self._call)
            self._size = len(search._robot.lower)
        elif prefer == "manipulability":
            kernel = search._manipulability()
            self.address = None if kernel.entry is None else _address(kernel.entry)

    def reraise(self) -> None:
        """Raise the exception of the user-defined preference, if it raised one."""
        if self._error is not None:
            raise self._error

    def _run_map(self, job: Any) -> int:
        """Map the `count` rows of the only input to the only output, like a map kernel."""
        map_job = job.contents
        try:
            source, destination = (
                ctypes.cast(pointers, ctypes.POINTER(ctypes.POINTER(ctypes.c_double)))[0]
                for pointers in (map_job.inputs, map_job.outputs)
            )
            q = np.ctypeslib.as_array(source, (map_job.count, self._size))
            np.ctypeslib.as_array(destination, (map_job.count,))[:] = self._prefer(q.copy())
        except BaseException as error:
            self._error = error
            return int(DriverCode.NO_MEMORY)
        return int(DriverCode.DONE)


def _slices(count: int, owner: NDArray[np.int64] | None) -> Iterator[slice]:
    """Yield the hands of each call; hands with the same owner are not separated."""
    first = 0
    while first < count:
        last = min(first + FREE_ARM_PARAMETERS.chunk_size, count)
        while owner is not None and last < count and owner[last] == owner[last - 1]:
            last += 1
        yield slice(first, last)
        first = last


def _address(entry: Any) -> int | None:
    return ctypes.cast(entry, ctypes.c_void_p).value
