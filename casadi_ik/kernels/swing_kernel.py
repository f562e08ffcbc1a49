"""The preferred free arms of hands that stay where they are, in one call of compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.collision.distances import Table
from casadi_ik.kernels.buffered import doubles, memory
from casadi_ik.kernels.cache import load_library
from casadi_ik.kernels.clearance_kernel import ClearanceKernel
from casadi_ik.kernels.codegen import driver_text
from casadi_ik.kernels.driver_code import DriverCode, check
from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.machine_lanes import machine_lanes
from casadi_ik.kernels.measure_kernel import MeasureKernel

SYMBOL = "casadi_ik_swings"

AT_ONCE = 512
"""Hands of one call, after which Python gets a look at its signals."""


class Order(IntEnum):
    """What is preferred, as drivers/swings.c has it."""

    LIMITS = 0
    NEAREST = 1
    MEASURED = 2
    CLEAREST = 3


class SwingsJob(ctypes.Structure):
    """`swings_job` of drivers/swings.c."""

    _fields_ = (
        ("arms", ctypes.c_void_p),
        ("measure", ctypes.c_void_p),
        ("check", ctypes.c_void_p),
        ("clear", ctypes.c_void_p),
        ("lanes", ctypes.c_int64),
        ("order", ctypes.c_int64),
        ("n_q", ctypes.c_int64),
        ("n_arm", ctypes.c_int64),
        ("n_free", ctypes.c_int64),
        ("n_sides", ctypes.c_int64),
        ("n_groups", ctypes.c_int64),
        ("n_places", ctypes.c_int64 * 2),
        ("n_closer", ctypes.c_int64),
        ("places", ctypes.c_void_p * 2),
        ("closer", ctypes.c_void_p),
        ("columns", ctypes.c_void_p),
        ("lower", ctypes.c_void_p),
        ("upper", ctypes.c_void_p),
        ("low", ctypes.c_void_p),
        ("range", ctypes.c_void_p),
        ("q", ctypes.c_void_p),
        ("palms", ctypes.c_void_p),
        ("starts", ctypes.c_void_p),
        ("owner", ctypes.c_void_p),
        ("caps", ctypes.c_void_p),
        ("poses", ctypes.c_void_p),
        ("pose_step", ctypes.c_int64),
        ("margin", ctypes.c_double),
        ("rounding", ctypes.c_double),
        ("allowed", ctypes.c_double),
        ("count", ctypes.c_int64),
        ("chosen", ctypes.c_void_p),
        ("score", ctypes.c_void_p),
        ("tried", ctypes.c_void_p),
    )


@dataclass(frozen=True, eq=False)
class ArmPlaces:
    """Where the arms of a robot are looked at.

    Attributes:
        columns: (a,) of the arm in q.
        low: (a,) limits of the arm.
        high: (a,).
        sides: Arms at each place.
        levels: Places (s, f) to look at, and those to look at where nothing is found; the last of
            the f numbers may be varied.
        closer: (c,) by how much, about a place where something was found.
        allowed: How far a joint may be within its bounds at least: what rounding makes of 0.
    """

    columns: NDArray[np.int64]
    low: Array
    high: Array
    sides: int
    levels: tuple[Array, Array]
    closer: Array
    allowed: float

    @property
    def branches(self) -> int:
        """How many branches there are."""
        return self.sides


@dataclass(frozen=True, eq=False)
class Checked:
    """What arms are checked against.

    Attributes:
        kernel: Distances.
        table: The pairs.
        poses: (m, 12) of the scene's solids, or (k, m, 12).
        margin: Distance to keep [m].
        rounding: What it may be short of that.
        caps: (k,) room [m] of each hand, which no arm of it can exceed.
    """

    kernel: ClearanceKernel
    table: Table
    poses: Array
    margin: float
    rounding: float
    caps: Array


class SwingKernel:
    """The compiled choice for one robot; threads may share it."""

    def __init__(self, places: ArmPlaces, arms: MeasureKernel, compiled: bool = True) -> None:
        """Load the driver, or compile it once for all robots.

        Args:
            places: Where arms are looked at.
            arms: From rotation (9, row by row), origin (3) and place (f) of a palm to the arms of
                all sides and their slacks, which are negative where a palm is out of reach.
            compiled: False: there is none.
        """
        self.places = places
        self._arms = arms
        self._lanes = machine_lanes() if compiled else 0
        self._run: Any = self._load() if self._lanes else None
        self._columns = np.ascontiguousarray(places.columns, dtype=np.int64)
        self._tables = tuple(doubles(level) for level in (*places.levels, places.closer))
        self._range = doubles(places.high - places.low)

    def _load(self) -> Any:
        parts = (
            "#include <stdint.h>\n",
            *map(driver_text, ("map_job", "clearance_job", "swings")),
        )
        driver = "".join(parts)
        library = load_library("arm_swings", _nothing, driver, SYMBOL, write=lambda _, text: text)
        return None if library is None else library[SYMBOL]

    def can(self, checked: Checked | None, measure: FunctionKernel | None) -> bool:
        """Whether everything that is called is compiled."""
        needed = [self._run, self._arms.entry]
        if checked is not None:
            needed.append(checked.kernel.entry)
        if measure is not None:
            needed.append(measure.entry)
        return all(each is not None for each in needed)

    def choose(
        self,
        q: Array,
        palms: Array,
        starts: Array,
        bounds: tuple[Array, Array],
        order: Order,
        checked: Checked | None,
        branches: bool,
        closer: bool,
        owner: NDArray[np.intp] | None = None,
        measure: FunctionKernel | None = None,
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """The preferred arms of hands.

        Args:
            q: (k, n) configurations of the hands, with an arm that holds each.
            palms: (k, 4, 4) their palms.
            starts: (k, n) where the robot is.
            bounds: (a,) and (a,) of the arm.
            order: What is preferred.
            checked: What arms must not touch; None: nothing is checked.
            branches: Whether one arm of every branch is wanted, and the given one; else one arm.
            closer: Whether to look about what was found.
            owner: (k,) whose each hand is, one's hands together: those behind the first for which
                an arm is found are left out. None: none is.
            measure: Of q, for `Order.MEASURED`.

        Returns:
            (k, g, a) arms; (k, g) their scores, -inf where there is none: smallest part of half a
            range to a limit, minus the squared distance in ranges, the measure, or the room [m];
            (k,) how many arms were within bounds.
        """
        places, groups = self.places, self.places.branches + 1 if branches else 1
        count, n_arm = len(q), len(places.columns)
        chosen, score = np.zeros((count, groups, n_arm)), np.empty((count, groups))
        tried = np.zeros(count, dtype=np.int64)
        given = [doubles(each) for each in (q, palms, starts, *bounds, places.low)]
        whole, palm, start, lower, upper, low = given
        whose = None if owner is None else np.ascontiguousarray(owner, dtype=np.int64)
        for rows in _slices(count, whose):
            job = SwingsJob(
                arms=_address(self._arms.entry),
                measure=None if measure is None else _address(measure.entry),
                lanes=self._lanes,
                order=int(order),
                n_q=q.shape[1],
                n_arm=n_arm,
                n_free=places.levels[0].shape[1],
                n_sides=places.sides,
                n_groups=groups,
                n_places=(ctypes.c_int64 * 2)(*map(len, self._tables[:2])),
                n_closer=len(self._tables[2]) if closer else 0,
                places=(ctypes.c_void_p * 2)(*(t.ctypes.data for t in self._tables[:2])),
                closer=self._tables[2].ctypes.data,
                columns=self._columns.ctypes.data,
                lower=lower.ctypes.data,
                upper=upper.ctypes.data,
                low=low.ctypes.data,
                range=self._range.ctypes.data,
                q=whole[rows].ctypes.data,
                palms=palm[rows].ctypes.data,
                starts=start[rows].ctypes.data,
                owner=None if whose is None else whose[rows].ctypes.data,
                allowed=places.allowed,
                count=rows.stop - rows.start,
                chosen=memory(chosen[rows]),
                score=memory(score[rows]),
                tried=memory(tried[rows]),
            )
            kept = _put(job, checked, rows)
            code = self._run(ctypes.byref(job))
            del kept
            if code != DriverCode.DONE:
                check("arm_swings", code)
        return chosen, score, tried


def _slices(count: int, owner: NDArray[np.int64] | None) -> Iterator[slice]:
    """Hands of one call each, those of an owner together."""
    first = 0
    while first < count:
        last = min(first + AT_ONCE, count)
        while owner is not None and last < count and owner[last] == owner[last - 1]:
            last += 1
        yield slice(first, last)
        first = last


def _put(job: SwingsJob, checked: Checked | None, rows: slice) -> Sequence[Any]:
    """What is checked, into a job; what has to be kept meanwhile."""
    if checked is None or not len(checked.table.pairs):
        return ()
    poses = checked.poses[rows] if checked.poses.ndim == 3 else checked.poses
    caps = doubles(checked.caps[rows])
    clear, kept = checked.kernel.job(np.zeros((1, 1)), poses, checked.table, 0.0, 0.0)
    job.check = _address(checked.kernel.entry)
    job.clear = ctypes.addressof(clear)
    job.poses, job.pose_step = clear.poses, clear.pose_step
    job.margin, job.rounding = checked.margin, checked.rounding
    job.caps = caps.ctypes.data
    return clear, kept, caps


def _address(entry: Any) -> int | None:
    return ctypes.cast(entry, ctypes.c_void_p).value


def _nothing() -> ca.Function:
    """The driver calls functions of CasADi, and is none itself."""
    x = ca.SX.sym("x")
    return ca.Function("nothing", [x], [x])
