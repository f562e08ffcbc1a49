"""The preferred arms that hold hands where they are and touch nothing, for many hands at once.

All branches at some values of the redundancy are put in the asked order and checked until one is
free; see runtime/arm_search.c.
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

from casadi_ik.collision.clearance import ROUNDING, CollisionQuery
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
from casadi_ik.solve.request import CLEARANCE

SYMBOL = "casadi_ik_arm_search"

TURN = 2 * np.pi

Preference: TypeAlias = str | Callable[[Array], Array]
"""One of `PREFERENCES`, or what gives configurations (m, n) their scores (m,)."""


class Order(IntEnum):
    """What is preferred, as drivers/arm_search.c has it."""

    LIMITS = 0
    NEAREST = 1
    MEASURED = 2
    CLEAREST = 3


ORDERS = {
    "limits": Order.LIMITS,
    "q0": Order.NEAREST,
    "manipulability": Order.MEASURED,
    CLEARANCE: Order.CLEAREST,
}


@dataclass(frozen=True)
class FreeArmParameters:
    """Where arms that touch nothing are looked for.

    Attributes:
        values: Of the last number of a redundancy, all around.
        locked: Angles of each locked joint: where these are all the redundancy, where not.
        closer: Values around the one that was taken.
        at_once: Hands of one call, after which Python gets a look at its signals.
    """

    values: int = 12
    locked: tuple[int, int] = (5, 3)
    closer: int = 13
    at_once: int = 512


SEARCH = FreeArmParameters()


@dataclass(frozen=True, eq=False)
class SearchValues:
    """The values of its redundancy at which the arms of a robot are looked at.

    Attributes:
        levels: Values (s, r) to look at, and those where nothing is found; the last of the r
            numbers may be varied.
        closer: (c,) by how much, about a value where something was found.
    """

    levels: tuple[Array, Array]
    closer: Array

    @classmethod
    def of(cls, family: ArmFamily, lower: Array, upper: Array) -> SearchValues:
        """A grid over the bounds (a,) of an arm; where nothing is found, what is between."""
        locked, size = len(family.locked), len(family.redundancy)
        if not size:
            return cls((np.zeros((1, 1)), np.zeros((0, 1))), np.zeros(0))
        counts = [SEARCH.locked[size > locked]] * locked + [SEARCH.values] * (size - locked)
        ends = [one.bounds(lower, upper) for one in family.redundancy]
        low, high = (np.array([float(end[i]) for end in ends]) for i in (0, 1))
        axes = np.meshgrid(*((np.arange(c) + 0.5) / c for c in counts), indexing="ij")
        grid = np.stack([axis.ravel() for axis in axes], axis=1)
        between = spread_points(2 * len(grid), size) if locked else grid + 0.5 / SEARCH.values
        levels = low + (high - low) * grid, low + (high - low) * between
        step = (high[-1] - low[-1]) / counts[-1]
        return cls(levels, step * np.linspace(-1, 1, SEARCH.closer + 2)[1:-1])


@dataclass(frozen=True, eq=False)
class ArmCandidates:
    """Arms of k hands.

    Attributes:
        q: (m, n) configurations within the bounds.
        owner: (m,) number of the hand.
        tried: (k,) arms of each hand that were within bounds.
    """

    q: Array
    owner: NDArray[np.intp]
    tried: NDArray[np.int64]


ArmSearchJob = c_struct("arm_search_job", {"LEVELS": 2}, "arm_search")


class ArmSearch:
    """The search for one robot; threads may share it."""

    def __init__(
        self,
        robot: ArmHand,
        family: ArmFamily,
        scores: Callable[[Array, Array, Preference], Array],
        manipulability: Callable[[], FunctionKernel],
        compiled: bool = True,
        side: int | None = None,
    ) -> None:
        """Compile the function of the arm and the driver, or load them from the cache.

        Args:
            robot: The robot.
            family: The arm's.
            scores: Of configurations (m, n), starts (m, n) and what is preferred: the order (m,)
                of arms of the same hand, higher is better.
            manipulability: Gives that of the arm as a function of q.
            compiled: False keeps to the virtual machine and numpy.
            side: Number of the side of a body whose arm it is; the trunk stays.
        """
        self._robot, self._family = robot, family
        self.scores, self._manipulability = scores, manipulability
        body, self._side = robot.description, side
        arm = body.arm_actuators if side is None else body.side_actuators[side][0]
        self._columns = np.array(arm, dtype=np.int64)
        lower, upper = robot.lower[self._columns], robot.upper[self._columns]
        self._low, self._range = doubles(lower), doubles(upper - lower)
        # Of the very limits, as exports have them: the sum of low and range may differ from high.
        self.values = SearchValues.of(family, lower, upper)
        alone = body if side is None else body.side(body.sides[side].name)
        name = ca.Function.fix_name(f"{alone.name}_all_arms")
        arms = arms_graph(family, name, recipe(name, alone))
        self._arms = FunctionKernel(arms, compiled, in_lanes=True)
        self._lanes = machine_lanes() if compiled else 0
        self._run: Any = self._load() if self._lanes else None
        self._tables = tuple(map(doubles, (*self.values.levels, self.values.closer)))

    @property
    def exact(self) -> bool:
        """Whether the arms that are found carry their palms exactly."""
        return self._family.is_exact

    def _load(self) -> Any:
        parts = map(driver_text, ("map_job", "clearance_job", "arm_search"))
        driver = "".join(("#include <stdint.h>\n", *parts))
        library = load_library("arm_search", lambda: driver, SYMBOL, driver)
        return None if library is None else library[SYMBOL]

    def choose(
        self,
        q: Array,
        starts: Array,
        bounds: tuple[Array, Array],
        prefer: Preference,
        query: CollisionQuery | None,
        surplus: Array,
        branches: bool = False,
        closer: bool = True,
        of_one: NDArray[np.intp] | None = None,
    ) -> ArmCandidates:
        """The preferred arm that touches nothing, of every hand that has one.

        Args:
            q: (k, n) configurations of hands that touch nothing themselves, with an arm for each.
            starts: (k, n) where the robot is.
            bounds: (n,) and (n,).
            prefer: What is preferred.
            query: Pairs that this arm decides, none of which may touch; None: nothing is checked.
            surplus: (k,) of what the hand alone decides [m], which no arm can exceed.
            branches: Whether to give the preferred arm of every branch, and the given one, instead
                of one.
            closer: Whether to look about the values at which they were found.
            of_one: (k,) whose each hand is, one's hands together: those behind the first that has
                an arm are left out. None: none is.

        Returns:
            The arms; with "clearance" those with most room, free or not.
        """
        if not len(q):
            return ArmCandidates(q, np.zeros(0, np.intp), np.zeros(0, np.int64))
        inside = bounds[0][self._columns], bounds[1][self._columns]
        asked = _Asked(q, self._palm(q), starts, inside, prefer, query, surplus)
        groups = self._family.rows + 1 if branches else 1
        measure = _Measure(self, prefer)
        entries = [self._run, self._arms.entry]
        entries += [] if query is None else [query.kernel.entry]
        entries += [measure.address] if asked.order is Order.MEASURED else []
        if any(entry is None for entry in entries):
            return self._plain(asked, groups, of_one)
        arms, score, tried = self._compiled(asked, measure, groups, closer, of_one)
        owner, group = np.nonzero(score > -np.inf)
        found = q[owner]
        found[:, self._columns] = arms[owner, group]
        return ArmCandidates(found, owner, tried)

    def _palm(self, q: Array) -> Array:
        """(k, 4, 4) the palm as the arm's base sees it."""
        if self._side is None:
            return self._robot.palm(q)
        body = self._robot.description
        base = np.broadcast_to(self._robot.links(q)[body.trunk_link], (len(q), 4, 4))
        palm = self._robot.palm(q, body.sides[self._side].name)
        return np.asarray(np.linalg.solve(base, palm), dtype=float)

    def _compiled(
        self,
        asked: _Asked,
        measure: _Measure,
        groups: int,
        closer: bool,
        of_one: NDArray[np.intp] | None,
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """(k, g, a) arms, (k, g) their scores or -inf for none, (k,) how many were tried."""
        count, n_arm = len(asked.q), len(self._columns)
        chosen, score = np.zeros((count, groups, n_arm)), np.empty((count, groups))
        tried = np.zeros(count, dtype=np.int64)
        given = (asked.q, asked.palms, asked.starts, *asked.bounds, asked.surplus)
        q, palms, starts, lower, upper, surplus = map(doubles, given)
        whose = None if of_one is None else np.ascontiguousarray(of_one, dtype=np.int64)
        for rows in _slices(count, whose):
            job = ArmSearchJob(
                arms=_address(self._arms.entry),
                measure=measure.address,
                lanes=self._lanes,
                order=int(asked.order),
                n_q=q.shape[1],
                n_arm=n_arm,
                n_redundancy=self._tables[0].shape[1],
                n_rows=self._family.rows,
                n_groups=groups,
                n_places=(ctypes.c_int64 * 2)(*map(len, self._tables[:2])),
                n_closer=len(self._tables[2]) if closer else 0,
                places=(ctypes.c_void_p * 2)(*(t.ctypes.data for t in self._tables[:2])),
                closer=self._tables[2].ctypes.data,
                columns=self._columns.ctypes.data,
                lower=lower.ctypes.data,
                upper=upper.ctypes.data,
                low=self._low.ctypes.data,
                range=self._range.ctypes.data,
                q=q[rows].ctypes.data,
                palms=palms[rows].ctypes.data,
                starts=starts[rows].ctypes.data,
                owner=None if whose is None else whose[rows].ctypes.data,
                allowed=ARM_SEARCH.tolerance,
                count=rows.stop - rows.start,
                chosen=memory(chosen[rows]),
                score=memory(score[rows]),
                tried=memory(tried[rows]),
            )
            query, kept = asked.query, None
            if query is not None and len(query.table.pairs):
                poses = query.poses[rows] if query.poses.ndim == 3 else query.poses
                kernel, table = query.kernel, query.table
                clear, *kept = kernel.job(np.zeros((1, 1)), poses, table, 0.0, 0.0)
                job.check, job.clear = _address(kernel.entry), ctypes.addressof(clear)
                job.poses, job.pose_step = clear.poses, clear.pose_step
                job.margin, job.rounding = query.margin, ROUNDING
                job.caps = surplus[rows].ctypes.data
            code = self._run(ctypes.byref(job))
            del kept
            measure.reraise()
            if code != DriverCode.DONE:
                check("arm_search", code)
        return chosen, score, tried

    def _plain(self, asked: _Asked, groups: int, of_one: NDArray[np.intp] | None) -> ArmCandidates:
        """The same in numpy, without a closer look: where something is not compiled."""
        values = np.concatenate(self.values.levels)
        kept, owners, tried = [], [], np.zeros(len(asked.q), dtype=np.int64)
        answered: set[int] = set()
        for hand, own in enumerate(asked.q):
            if of_one is not None and int(of_one[hand]) in answered:
                continue
            q, group = self._within(asked, hand, own, values)
            tried[hand] = len(q)
            score = asked.scores(self, q, np.full(len(q), hand))
            # The first of those with the highest score of each group.
            order = np.lexsort((-np.arange(len(q)), score, group * (groups > 1)))
            group = (group * (groups > 1))[order]
            last = order[np.append(group[1:] != group[:-1], True)] if len(q) else order
            found = q[last[score[last] > -np.inf]]
            if len(found) and of_one is not None:
                answered.add(int(of_one[hand]))
            kept.append(found)
            owners.append(np.full(len(found), hand))
        return ArmCandidates(np.concatenate(kept), np.concatenate(owners), tried)

    def _within(
        self, asked: _Asked, hand: int, own: Array, values: Array
    ) -> tuple[Array, NDArray[np.intp]]:
        """All arms (m, n) of a hand within bounds, the given one last, and their branches."""
        rows, n = self._family.rows, len(self._columns)
        palm, (lower, upper) = asked.palms[hand], asked.bounds
        pose = np.tile(np.append(palm[:3, :3], palm[:3, 3]), (len(values), 1))
        (found,) = self._arms(np.hstack([pose, values]))
        reached = np.append(found[:, rows * n :].ravel() >= 0, True)
        arms = np.concatenate([found[:, : rows * n].reshape(-1, n), own[None, self._columns]])
        held = arms + TURN * np.floor((lower - arms) / TURN + 0.5)
        arms = np.where(lower < upper, arms, held)
        if asked.prefer == "q0":
            start = asked.starts[hand, self._columns]
            turned = arms + TURN * np.floor((start - arms) / TURN + 0.5)
            arms = np.where((turned >= lower) & (turned <= upper), turned, arms)
        margin = np.minimum(arms - lower, upper - arms).min(axis=1)
        inside = np.flatnonzero(reached & (margin >= ARM_SEARCH.tolerance))
        q = np.tile(own, (len(inside), 1))
        q[:, self._columns] = np.clip(arms[inside], lower, upper)
        return q, np.append(np.tile(np.arange(rows), len(values)), rows)[inside]


@dataclass(frozen=True, eq=False)
class _Asked:
    """What arms are asked for; k hands."""

    q: Array
    palms: Array
    starts: Array
    bounds: tuple[Array, Array]
    prefer: Preference
    query: CollisionQuery | None
    surplus: Array

    @property
    def order(self) -> Order:
        return Order.MEASURED if callable(self.prefer) else ORDERS[self.prefer]

    def scores(self, search: ArmSearch, q: Array, hand: NDArray[np.intp]) -> Array:
        """(m,) of configurations of hands (m,); -inf where they touch something."""
        if not len(q):
            return np.zeros(0)
        if self.query is None:
            return search.scores(q, self.starts[hand], self.prefer)
        query = self.query.rows(hand)
        if self.prefer == CLEARANCE:
            return np.minimum(query.check(q).surplus, self.surplus[hand])
        return np.where(query.free(q), search.scores(q, self.starts[hand], self.prefer), -np.inf)


class _Measure:
    """A score of q for the driver, which calls it like a compiled map of many rows."""

    def __init__(self, search: ArmSearch, prefer: Preference) -> None:
        self.address: int | None = None
        self._error: BaseException | None = None
        if callable(prefer):
            self._call = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(MapJob))(self._scored)
            self._prefer, self.address = prefer, _address(self._call)
            self._size = len(search._robot.lower)
        elif prefer == "manipulability":
            kernel = search._manipulability()
            self.address = None if kernel.entry is None else _address(kernel.entry)

    def reraise(self) -> None:
        """Raise what a preference of one's own raised."""
        if self._error is not None:
            raise self._error

    def _scored(self, job: Any) -> int:
        """Like a map kernel: `count` rows of its only input to its only output."""
        map_job = job.contents
        try:
            given, wanted = (
                ctypes.cast(each, ctypes.POINTER(ctypes.POINTER(ctypes.c_double)))[0]
                for each in (map_job.inputs, map_job.outputs)
            )
            q = np.ctypeslib.as_array(given, (map_job.count, self._size))
            np.ctypeslib.as_array(wanted, (map_job.count,))[:] = self._prefer(q.copy())
        except BaseException as error:
            self._error = error
            return int(DriverCode.NO_MEMORY)
        return int(DriverCode.DONE)


def _slices(count: int, owner: NDArray[np.int64] | None) -> Iterator[slice]:
    """Hands of one call each, those of an owner together."""
    first = 0
    while first < count:
        last = min(first + SEARCH.at_once, count)
        while owner is not None and last < count and owner[last] == owner[last - 1]:
            last += 1
        yield slice(first, last)
        first = last


def _address(entry: Any) -> int | None:
    return ctypes.cast(entry, ctypes.c_void_p).value
