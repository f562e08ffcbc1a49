"""The preferred arms that hold hands where they are and touch nothing, for many hands at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import arms_graph
from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.kernels.measure_kernel import MeasureKernel
from casadi_ik.kernels.recipe import recipe
from casadi_ik.kernels.swing_kernel import Checked, Order, SwingKernel
from casadi_ik.problem.clearance import ROUNDING, Surroundings
from casadi_ik.problem.preference import CLEARANCE
from casadi_ik.solving.alternatives.arm_places import arm_places

TURN = 2 * np.pi

ORDERS = {
    "limits": Order.LIMITS,
    "q0": Order.NEAREST,
    "manipulability": Order.MEASURED,
    CLEARANCE: Order.CLEAREST,
}

Preference: TypeAlias = str | Callable[[Array], Array]
"""One of `PREFERENCES`, or what gives configurations (m, n) their scores (m,)."""


@dataclass(frozen=True, eq=False)
class Swung:
    """Arms of k hands.

    Attributes:
        q: (m, n) configurations within the bounds.
        owner: (m,) number of the hand.
        tried: (k,) arms of each hand that were within bounds.
    """

    q: Array
    owner: NDArray[np.intp]
    tried: NDArray[np.int64]


class ArmSwings:
    """The branches and swivels of one arm in closed form.

    A swivel is the angle of an S-R-S arm's elbow, or the position of another arm's swept joint; an
    arm of six joints has none. An arm with a wrist beside these is free in that, too.
    """

    def __init__(
        self,
        robot: ArmHand,
        arm: ArmFamily,
        measure: Callable[[], FunctionKernel],
        compiled: bool = True,
    ) -> None:
        """Compile the function of the arm or load it from the cache.

        Args:
            robot: The robot.
            arm: Its arm.
            measure: Gives the manipulability of the arm as a function of q.
            compiled: False keeps to the virtual machine and numpy.
        """
        self._robot, self._measure = robot, measure
        self._columns = list(robot.description.arm_actuators)
        self.places = places = arm_places(robot, arm)
        name = ca.Function.fix_name(f"{robot.name}_all_arms")
        graph = arms_graph(arm, name, recipe(name, robot.description))
        self._arms = MeasureKernel(graph, compiled)
        self._kernel = SwingKernel(places, self._arms, compiled)

    def choose(
        self,
        q: Array,
        starts: Array,
        bounds: tuple[Array, Array],
        prefer: Preference,
        around: Surroundings | None,
        room: Array,
        branches: bool = False,
        closer: bool = True,
        of_one: NDArray[np.intp] | None = None,
    ) -> Swung:
        """The preferred arm that touches nothing, of every hand that has one.

        Args:
            q: (k, n) configurations of hands that touch nothing themselves, with an arm for each.
            starts: (k, n) where the robot is.
            bounds: (n,) and (n,).
            prefer: What is preferred.
            around: What nothing may touch; None: nothing is checked.
            room: (k,) of what the hand alone decides [m]; infinite where nothing is checked.
            branches: Whether to give the preferred arm of every branch, instead of one.
            closer: Whether to look about the swivels at which they were found.
            of_one: (k,) whose each hand is, one's hands together: those behind the first that has
                an arm are left out. None: none is.

        Returns:
            The arms; with "clearance" those with most room, free or not.
        """
        if not len(q):
            return Swung(q, np.zeros(0, np.intp), np.zeros(0, np.int64))
        palms = self._robot.palm(q)
        inside = bounds[0][self._columns], bounds[1][self._columns]
        checked = None
        if around is not None:
            checked = Checked(
                around.kernel, around.table.swung, around.poses, around.margin, ROUNDING, room
            )
        order = None if callable(prefer) else ORDERS[prefer]
        measure = self._measure() if order is Order.MEASURED else None
        if order is None or not self._kernel.can(checked, measure):
            slow = _Slow(self, palms, q, starts, inside, prefer, around, room, branches, closer)
            return _first_hands(slow.run(), of_one)
        arms, score, tried = self._kernel.choose(
            q, palms, starts, inside, order, checked, branches, closer, of_one, measure
        )
        owner, group = np.nonzero(score > -np.inf)
        found = q[owner]
        found[:, self._columns] = arms[owner, group]
        return Swung(found, owner, tried)

    def rated(self, q: Array, starts: Array, prefer: Preference) -> Array:
        """(m,) the order of arms of the same hand, higher is better."""
        if callable(prefer):
            return np.asarray(prefer(q), dtype=float)
        arm, places = q[:, self._columns], self.places
        ranges = places.high - places.low
        if prefer == "q0":
            away = (arm - starts[:, self._columns]) / ranges
            return -np.square(away).sum(axis=1)
        if prefer == "manipulability":
            return self._measure()(q)[0]
        return (np.minimum(arm - places.low, places.high - arm) / (0.5 * ranges)).min(axis=1)

    def at(
        self, palms: Array, owner: NDArray[np.intp], tried: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Arms (m, sides, a) of hands at places (m, f), and whether each is within reach."""
        turned = palms[owner]
        rotation = turned[:, :3, :3].reshape(-1, 9)
        found = self._arms(np.hstack([rotation, turned[:, :3, 3], tried]))
        sides, a = self.places.sides, len(self._columns)
        arms = found[:, : sides * a].reshape(-1, sides, a)
        return arms, found[:, sides * a :] >= 0


def _first_hands(swung: Swung, of_one: NDArray[np.intp] | None) -> Swung:
    """Without the hands behind the first one of each owner that has an arm."""
    if of_one is None or not len(swung.q):
        return swung
    whose = of_one[swung.owner]
    starts = np.flatnonzero(np.append(True, whose[1:] != whose[:-1]))
    first = np.repeat(swung.owner[starts], np.diff(np.append(starts, len(whose))))
    kept = swung.owner == first
    tried = swung.tried.copy()
    for one, hand in zip(whose[starts].tolist(), swung.owner[starts].tolist(), strict=True):
        tried[(of_one == one) & (np.arange(len(tried)) > hand)] = 0
    return Swung(swung.q[kept], swung.owner[kept], tried)


class _Slow:
    """The same choice in numpy: for a preference of one's own, and without a compiler."""

    def __init__(
        self,
        swings: ArmSwings,
        palms: Array,
        q: Array,
        starts: Array,
        bounds: tuple[Array, Array],
        prefer: Preference,
        around: Surroundings | None,
        room: Array,
        branches: bool,
        closer: bool,
    ) -> None:
        self.room = room
        self.swings, self.palms, self.q, self.starts = swings, palms, q, starts
        self.bounds, self.prefer, self.around, self.branches = bounds, prefer, around, branches
        self.places = swings.places
        self.closer = swings.places.closer if closer else np.zeros(0)
        self.groups = self.places.branches + 1 if branches else 1
        self.tried = np.zeros(len(q), dtype=np.int64)

    def run(self) -> Swung:
        """Level by level, until every hand has an arm."""
        count = len(self.q) * self.groups
        best, score = np.empty((count, self.q.shape[1])), np.full(count, -np.inf)
        left = np.arange(len(self.q))
        for level, given in enumerate(self.places.levels):
            if not len(given) or not len(left):
                continue
            of_place = np.repeat(left, len(given))
            found = self._look(of_place, np.tile(given, (len(left), 1)))
            if not level:
                with_own, columns = self.q[left], self.places.columns
                with_own[:, columns] = self._turned(
                    with_own[:, columns], self.starts[left][:, columns]
                )
                none = np.full((len(left), given.shape[1]), np.nan)
                group = np.full(len(left), self.places.branches)
                own: list[NDArray[Any]] = [left, with_own, none, group]
                found = [np.concatenate(both) for both in zip(found, own, strict=True)]
            np.add.at(self.tried, found[0], 1)
            taken = self._take(best, score, *found)
            owner, _, places, branch = (each[taken] for each in found)
            self._refine(best, score, owner, places, branch)
            wanted = np.full(len(self.q), -np.inf)
            if self.prefer == CLEARANCE:
                wanted = np.minimum(-ROUNDING, self.room)
            enough = score.reshape(-1, self.groups).max(axis=1) >= wanted
            done = enough & np.isfinite(score.reshape(-1, self.groups)).any(axis=1)
            left = left[~done[left]]
        rows = np.flatnonzero(score > -np.inf)
        return Swung(best[rows], rows // self.groups, self.tried)

    def _look(self, owner: NDArray[np.intp], places: Array) -> list[NDArray[Any]]:
        """Owner, configuration, place and branch of the arms within bounds at places."""
        swings, columns = self.swings, self.places.columns
        arms, reached = swings.at(self.palms, owner, places)
        lower, upper = self.bounds
        arms = self._turned(arms, self.starts[owner][:, None, columns])
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        rows, side = np.nonzero((margin >= self.places.allowed) & reached)
        found = self.q[owner[rows]]
        found[:, columns] = np.clip(arms[rows, side], lower, upper)
        return [owner[rows], found, places[rows], side]

    def _turned(self, arms: Array, starts: Array) -> Array:
        """Arms in the turn that is nearest to the start, where that is preferred, or held in."""
        lower, upper = self.bounds
        held = arms + TURN * np.floor((lower - arms) / TURN + 0.5)
        arms = np.where(lower < upper, arms, held)
        if self.prefer != "q0":
            return arms
        turned = arms + TURN * np.floor((starts - arms) / TURN + 0.5)
        return np.where((turned >= lower) & (turned <= upper), turned, arms)

    def _take(
        self,
        best: Array,
        score: Array,
        owner: NDArray[np.intp],
        q: Array,
        places: Array,
        branch: NDArray[np.intp],
    ) -> NDArray[np.intp]:
        """Keep the preferred free arm of every hand and branch; the rows that were kept."""
        del places
        if not len(q):
            return np.zeros(0, dtype=np.intp)
        slot = owner * self.groups + (branch if self.branches else 0)
        value = self.swings.rated(q, self.starts[owner], self.prefer)
        if self.around is not None:
            around = self.around.rows(owner)
            around = Surroundings(around.kernel, around.table.swung, around.poses, around.margin)
            if self.prefer == CLEARANCE:
                value = np.minimum(around.check(q).room, self.room[owner])
            else:
                value = np.where(around.free(q), value, -np.inf)
        # Of equals that farthest from limits, of those the first.
        margin = self.swings.rated(q, q, "limits") if self.prefer == CLEARANCE else np.zeros(len(q))
        order = np.lexsort((-np.arange(len(q)), margin, value, slot))
        last = order[np.append(slot[order][1:] != slot[order][:-1], True)]
        better = last[value[last] > score[slot[last]]]
        best[slot[better]], score[slot[better]] = q[better], value[better]
        return better

    def _refine(
        self,
        best: Array,
        score: Array,
        owner: NDArray[np.intp],
        places: Array,
        branch: NDArray[np.intp],
    ) -> None:
        """Places about those of arms that were taken, their branches only."""
        closer = self.closer
        varied = np.flatnonzero(np.isfinite(places[:, 0]))
        if not len(closer) or not len(varied):
            return
        from_row = np.repeat(varied, len(closer))
        near = places[from_row]
        near[:, -1] += np.tile(closer, len(varied))
        # A hand may have several branches: each is looked at as if it were a hand of its own.
        for one in np.unique(branch[varied]):
            mine = branch[from_row] == one
            found = self._look(owner[from_row[mine]], near[mine])
            same = found[3] == one
            self._take(best, score, *(each[same] for each in found))
