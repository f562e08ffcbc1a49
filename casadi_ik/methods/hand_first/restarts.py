"""Where the rounds of hand-first begin: hand postures, each round's of another kind.

The first round compares the target with a table of postures. The next ones compare it with a table
many times as large, half of it at limits, and take only postures that differ from each other: the
neighbours of one that failed fail as well. Hands of many motors are mended before, see
`each_finger`. What all of them miss is one of two things. Its fit has come to rest in a long
valley, where the contacts hardly move while the hand does: so the next round begins along it, to
either side of the best fit so far. Or no table holds its like: then postures drawn from anywhere
follow, and a whole configuration of arm and hand; many of them where the fits end somewhere else
each time, as with many joints at their limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.posture_table import PostureTable, differing
from casadi_ik.methods.hand_first.each_finger import each_finger, mends
from casadi_ik.methods.hand_first.going_on import MANY, VARIED, rugged
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.valley import valley
from casadi_ik.problem.contacts.conditions import LENGTH
from casadi_ik.problem.problems import Problems
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.even_spread import evenly

USUAL_FINGERS, FEWER_ROWS = 3, 3 / 8
"""Part of the first table's rows that a hand with few motors and more fingers is compared with: the
shape of its contacts is more telling, and each row costs as much as three of three fingers. Of
4,000 targets of a Panda with a hand of five fingers and six motors 16 instead of 4 need a second
posture, and all of them take an eighth less time."""

AT_LIMITS = 0.5
"""Part of the range that the wide table moves to the limits."""

SIMILAR = 0.25
"""Postures nearer to each other than this [root mean square, of the motors' ranges] are alike."""

POOL = 3
"""From so many times as many postures as are wanted those that differ are taken."""

MENDED = 3
"""The same where they are mended finger by finger before: twice as many take longer than the fits
they save."""

SPREAD, NARROWER, NARROW = 64, 24, 12
"""Postures that are mended for a round after the second, and for one after so many: not those that
look like the target any more, but as many others in every round. What the best of many is not near
in one round it is not in the next, so later rounds take the best of fewer: of 64,000 targets of a
LEAP hand near limits 100 are left after 16 rounds and 8 after 64; with 96 in all rounds 140 and
16. By turns with these there are rounds of postures that are not mended: where mending leads away
from all that fits, they alone get there."""

CHUNK = 256
"""Targets whose postures are compared with each other at once."""

STRIDES = tuple(
    sign * size
    for size in (0.05, 0.1, 0.2, 0.4, 0.03, 0.15, 0.3, 0.8, 0.5, 0.6, 0.7, 0.25, 1.0, 1.2, 1.5, 2.0)
    for sign in (1, -1)
)
"""How far along a valley a hand begins anew [rad of the motor that moves most], round by round."""

AT_END = 1e-6
"""A motor this near to a limit [rad or m] stays there while its hand moves along a valley."""

HELD = 1e6
"""What holds a motor at its limit, in a matrix of squared slopes of order one."""

NUDGE = 1e-6
"""Difference [rad or m] from which slopes are taken."""

VALLEYS = 3
"""Rounds along the directions in which the contacts move least, after those of the tables."""

ANYWHERE = 2
"""Rounds from anywhere that every target gets which is not solved before."""


def later(motors: int) -> int:
    """Rounds after those of the tables, at most, of a hand of so many motors."""
    return VALLEYS + ANYWHERE + rugged(motors)


def first_rugged(options: HandFirstParameters) -> int:
    """Rounds before those from anywhere that not every target gets."""
    return options.rounds + VALLEYS + ANYWHERE


@dataclass(frozen=True, eq=False)
class Spread:
    """How postures of a table are spread.

    Attributes:
        count: How many.
        at_limits: Part of the range that is moved to the limits.
        lower: (n,) from where.
        upper: (n,) to where.
    """

    count: int
    at_limits: float
    lower: Array
    upper: Array


class Restarts:
    """The hand postures that a robot's solves begin from."""

    def __init__(
        self,
        robot: RobotDescription,
        hand: tuple[int, ...],
        options: HandFirstParameters,
        compiled: bool,
    ) -> None:
        """Remember what the tables are made of; they are filled when first asked.

        Args:
            robot: The description.
            hand: Positions in q of the hand's actuators.
            options: How many postures there are.
            compiled: Whether lookups run in compiled code.
        """
        self._robot = ArmHand(robot)
        self._hand = list(hand)
        self._options = options
        self._compiled = compiled

    @property
    def spreads(self) -> tuple[Spread, Spread, Spread]:
        """Those of the three tables."""
        own, options = (self._robot.lower, self._robot.upper), self._options
        return (
            Spread(self._first_rows, 0.0, *own),
            Spread(options.wide_table, AT_LIMITS, *own),
            Spread(options.wide_table, 0.0, *self._everywhere),
        )

    @property
    def _first_rows(self) -> int:
        """Postures of the first table."""
        few, least = len(self._hand) <= MANY, self._options.candidates * self._options.rounds
        if not few or len(self._robot.fingers) <= USUAL_FINGERS:
            return self._options.table
        return max(int(FEWER_ROWS * self._options.table), least)

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures of the first round."""
        return self._table(self.spreads[0])

    @cached_property
    def wide_table(self) -> PostureTable:
        """Many more postures, a good part of them at limits."""
        return self._table(self.spreads[1])

    @cached_property
    def free_table(self) -> PostureTable:
        """As many postures, limits ignored."""
        return self._table(self.spreads[2])

    def tables(self, enforce_limits: bool) -> tuple[PostureTable, ...]:
        """Those that are asked, in the order of `spreads`."""
        own = (self.table, self.wide_table)
        return own if enforce_limits else (*own, self.free_table)

    def from_tables(self, problems: Problems, number: int) -> Array:
        """Postures (k, candidates, hand) of a round whose postures look like the targets.

        Args:
            problems: k targets.
            number: The round, from 0.
        """
        count = self._options.candidates
        points, normals = problems.points, problems.normals
        if not number:
            return self.table.nearest(points, normals, count)
        # Where limits are ignored a hand may stand on either side of them.
        free = not problems.enforce_limits and number % 2
        table = self.free_table if free else self.wide_table
        mend = self.mends(problems)
        if mend and number >= VARIED:
            return self.mended(problems, number)
        wanted = number * count
        pool = min((MENDED if mend else POOL) * wanted, len(table.postures))
        parts = [np.empty((0, count, len(self._hand)))]
        for some, facing in _chunks(points, normals):
            near = table.nearest(some, facing, pool)
            near = self._mended(near, some, facing) if mend else near
            parts.append(differing(near, table.ranges, wanted, SIMILAR)[:, -count:])
        return np.concatenate(parts)

    def mends(self, problems: Problems) -> bool:
        """Whether every finger by itself mends the postures that rounds begin from."""
        return problems.enforce_limits and self.each_finger is not None

    def mended(self, problems: Problems, number: int) -> Array:
        """Mended postures (k, candidates, hand), other ones in every round; see `NARROWER`.

        Args:
            problems: k targets.
            number: The round, from 0.
        """
        table, count = self.wide_table, self._options.candidates
        if number >= NARROW and number % 2:
            plain = table.spread(number * SPREAD, count)
            return np.tile(plain, (len(problems), 1, 1))
        fresh = table.spread(number * SPREAD, SPREAD if number < NARROW else NARROWER)
        parts = [np.empty((0, count, len(self._hand)))]
        for points, normals in _chunks(problems.points, problems.normals):
            near = np.broadcast_to(fresh, (len(points), *fresh.shape))
            better = self._mended(near, points, normals)
            parts.append(differing(better, table.ranges, count, SIMILAR))
        return np.concatenate(parts)

    @cached_property
    def each_finger(self) -> FunctionKernel | None:
        """Mends postures of a hand with many motors, if its fingers have their own."""
        if not mends(self._robot.description):
            return None
        return FunctionKernel(each_finger(self._robot.description), self._compiled)

    @property
    def pool(self) -> int:
        """Postures of which a round's are taken, at most."""
        wanted = self._options.candidates * max(self._options.rounds - 1, 1)
        few = max(MENDED * self._options.candidates, SPREAD)
        return max(POOL * wanted, few if mends(self._robot.description) else 0)

    def _mended(self, near: Array, points: Array, normals: Array) -> Array:
        """Postures (k, pool, hand), their fingers chosen one by one, in order of what is left."""
        kernel, pool = self.each_finger, near.shape[1]
        assert kernel is not None
        asked = (np.repeat(part, pool, axis=0) for part in (points, normals))
        better, left = kernel(*asked, np.ascontiguousarray(near).reshape(-1, near.shape[2]))
        order = np.argsort(left.reshape(-1, pool), axis=1, kind="stable")
        return np.take_along_axis(better.reshape(near.shape), order[:, :, None], axis=1)

    def along_valley(self, problems: Problems, q: Array, which: int) -> Array:
        """Postures (k, candidates, hand) to either side of a fit that came to rest.

        Args:
            problems: k targets.
            q: (k, n) where it did.
            which: The round, from 0. Even ones keep motors at a limit there; odd ones do not.
        """
        columns = self._hand
        if not columns:  # a tool
            return np.empty((len(q), self._options.candidates, 0))
        rigid, slopes = self._slopes(q, problems)
        ends = np.minimum(q - self._robot.lower, self._robot.upper - q)[:, columns]
        held = (ends < AT_END) * HELD if which % 2 == 0 else np.zeros_like(ends)
        # A kernel's column is a vector: of a hand with one motor there is no second dimension.
        shapes = self.valley.input_shapes
        (chosen,) = self.valley(
            rigid, slopes.reshape(len(q), *shapes[1]), held.reshape(len(q), *shapes[2])
        )
        motion = chosen.reshape(ends.shape) * self.size
        return q[:, None, columns] + self.strides(which)[:, None] * motion[:, None]

    def strides(self, which: int) -> Array:
        """(candidates,) how far the hands of a round begin along their valley."""
        first = (which + 1) // 2 * self._options.candidates
        return np.resize(np.roll(STRIDES, -first), self._options.candidates)

    @cached_property
    def valley(self) -> FunctionKernel:
        """Finds the valley, from the contacts' slopes."""
        rows = 6 * len(self._robot.fingers)
        return FunctionKernel(valley(rows, len(self._hand)), self._compiled)

    def anywhere(self, problems: Problems, number: int) -> Array:
        """Whole configurations (candidates, n), evenly spread, other ones in every round."""
        lower, upper = self.anywhere_bounds(problems.enforce_limits)
        count = self._options.candidates
        spread = evenly(count, len(lower), number * count)
        return lower + spread * (upper - lower)

    def anywhere_bounds(self, enforce_limits: bool) -> tuple[Array, Array]:
        """(n,) between which configurations from anywhere are."""
        return (self._robot.lower, self._robot.upper) if enforce_limits else self._everywhere

    def _slopes(self, q: Array, problems: Problems) -> tuple[Array, Array]:
        """How the contacts move with the palm (k, 6, 6 f) and with the hand (k, h, 6 f)."""
        k, size, columns = len(q), self.size, self._hand
        moved = np.repeat(q[:, None], len(columns) + 1, axis=1)
        for place, column in enumerate(columns):
            moved[:, place + 1, column] += NUDGE * size[place]
        points, normals = self._robot.contacts(moved.reshape(-1, q.shape[1]))
        shape = (k, len(columns) + 1, *points.shape[1:])
        points = points.reshape(shape) / LENGTH
        normals = normals.reshape(shape)
        counts = ~np.isnan(np.stack([problems.points, problems.normals], axis=1))
        both = np.stack([points, normals], axis=2)
        slopes = (both[:, 1:] - both[:, :1]) / NUDGE * counts[:, None]
        if not self._robot.description.arm_actuators:
            return np.zeros((k, 6, slopes[0, 0].size)), slopes.reshape(k, len(columns), -1)
        turns = np.cross(np.eye(3)[:, None, None], both[:, None, 0]) * counts[:, None]
        shifts = np.zeros((k, 3, *counts.shape[1:]))
        shifts[:, np.arange(3), 0, :, np.arange(3)] = 1
        rigid = np.concatenate([shifts * counts[:, None], turns], axis=1)
        return rigid.reshape(k, 6, -1), slopes.reshape(k, len(columns), -1)

    @property
    def size(self) -> Array:
        """(hand,) a radian of every motor, or half the range of a slider [m]."""
        units = [self._robot.description.actuators[column].unit for column in self._hand]
        ranges = (self._robot.upper - self._robot.lower)[self._hand]
        return np.where([unit == "rad" for unit in units], 1.0, ranges / 2)

    @property
    def _everywhere(self) -> tuple[Array, Array]:
        """(n,) bounds where limits are ignored: a full turn, or what the mechanisms permit."""
        description = self._robot.description
        middle = (self._robot.lower + self._robot.upper) / 2
        far = np.where([a.unit == "rad" for a in description.actuators], np.pi, 0.0)
        lower = np.minimum(middle - far, self._robot.lower)
        upper = np.maximum(middle + far, self._robot.upper)
        ends = description.mechanical
        return np.maximum(lower, ends[0]), np.minimum(upper, ends[1])

    def _table(self, spread: Spread) -> PostureTable:
        hand, bounds = tuple(self._hand), (spread.lower, spread.upper)
        return PostureTable(
            self._robot,
            hand,
            spread.count,
            spread.at_limits,
            compiled=self._compiled,
            bounds=bounds,
        )


def _chunks(*arrays: Array) -> Iterator[tuple[Array, ...]]:
    """So many targets after the others."""
    for i in range(0, len(arrays[0]), CHUNK):
        yield tuple(array[i : i + CHUNK] for array in arrays)
