"""Runs of the hand-first loop with other bounds, weights and starts: what a diagnosis asks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile.layout import Layout
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contact_fit import initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.status import Phase
from casadi_ik.solve.verdict import deviations, judge

UNREACHABLE_TOLERANCE = 1e-12
"""A tolerance that nothing meets: the loop then goes on to the minimum."""

EXHAUSTED = 1e6
"""Trunks tried: none follows the one that a row begins from."""

CARRY_ONLY = {
    "first": EXHAUSTED,
    "farthest": EXHAUSTED,
    "fits": 1.0,
    "fitted": 1.0,
    "tried": EXHAUSTED,
    "again": 1.0,
}
"""What a row says that is to end where trunk and arms carry the palms, or nowhere."""

TRUNK_STRETCH = 2.0
"""Of every second trunk the even spread is stretched by this about its middle, up to the ends."""

DUPLICATE_FACTOR = 1.001
"""Two values of a row that differ by less than this factor count as the same."""

PALM_SCALES = np.array([0.1, 0.1, 0.1, 2.0])
"""What turns [rad] and shifts [m] of a palm that is free count as, beside parts of ranges."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of the actuators, (n,) or (k, n)."""

    lower: Array
    upper: Array

    def clip(self, q: Array) -> Array:
        """Configurations moved into the bounds."""
        return np.clip(q, self.lower, self.upper)

    def of(self, rows: Rows) -> Bounds:
        """Those of some targets; those that all share are of each."""
        return self if self.lower.ndim == 1 else Bounds(self.lower[rows], self.upper[rows])

    @property
    def first(self) -> Bounds:
        """(n,) of the first target; the arm has the same in all."""
        return self if self.lower.ndim == 1 else Bounds(self.lower[0], self.upper[0])

    def tiled(self, count: int) -> Bounds:
        """The same bounds for k configurations."""
        return Bounds(np.tile(self.lower, (count, 1)), np.tile(self.upper, (count, 1)))

    def beyond(self, q: Array) -> Array:
        """Signed distance from the bounds: > 0 above, < 0 below, 0 within."""
        return np.maximum(q - self.upper, 0.0) - np.maximum(self.lower - q, 0.0)


@dataclass(frozen=True, eq=False)
class Subproblems:
    """The loop of the hand-first method, asked in other ways.

    Attributes:
        robot: The robot.
        method: The method on that robot.
    """

    robot: ArmHand
    method: HandSearch

    @cached_property
    def state(self) -> Layout:
        """Layout of the loop's state."""
        return self.method.step.layouts.state

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the loop's parameters."""
        return self.method.step.layouts.parameters

    def limits(self, targets: TargetBatch) -> Bounds:
        """The bounds that solutions have to keep, (n,) or (k, n), see `TargetBatch.bounds`."""
        return Bounds(*targets.bounds(self.robot.description))

    def search(self, targets: TargetBatch, start: Array, bounds: Bounds) -> Array:
        """The first round of hand-first for each of k targets.

        Args:
            targets: The targets.
            start: (n,).
            bounds: (k, n).

        Returns:
            (k, n) configurations.
        """
        starts = bounds.clip(start)
        postures = self.method.postures(targets, 0)
        states, parameters = self.method.rows(targets, starts, postures)
        self.set_bounds(parameters, bounds)
        return self.run(states, parameters)

    def posture_rows(
        self, targets: TargetBatch, start: Array, postures: Array, turns: ArrayLike = 0.0
    ) -> tuple[Array, Array]:
        """Rows of the loop that know a single hand posture each.

        Args:
            targets: k targets.
            start: (k, n).
            postures: (k, hand).
            turns: (k,) numbers, another palm for each where contacts leave the palm free.
        """
        states, parameters = self.method.rows(targets, start, postures[:, None], begun=True)
        states[:, self.state.slice("candidate")] = self.method.options.candidates - 1
        if self.robot.description.sides:
            # Every side begins from its part of the posture, and none follows.
            states[:, self.state.slice("first")] = self.method.options.candidates - 1
        states[:, self.state.slice("turn").start] = turns
        return states, parameters

    def hand_rows(
        self, targets: TargetBatch, rows: Rows, starts: Array, postures: Array, first: int = 0
    ) -> tuple[Rows, Array, Array]:
        """Rows of the loop for several hand postures of each of some targets.

        Args:
            targets: k targets.
            rows: (c,) those of them.
            starts: (k, n) of each target.
            postures: (c, p, hand) of those.
            first: Turn of the first posture, see `posture_rows`.

        Returns:
            The target of each row, (c p,), states and parameters.
        """
        count = postures.shape[1]
        owner, turns = np.repeat(rows, count), first + np.tile(np.arange(count), len(rows))
        flat = postures.reshape(len(owner), postures.shape[2])
        return owner, *self.posture_rows(targets.rows(owner), starts[owner], flat, turns)

    def solved(self, targets: TargetBatch, q: Array, limits: bool) -> NDArray[np.bool_]:
        """(k,) whether configurations meet their targets, and if asked the robot's limits."""
        return judge(self.robot, targets, q).solved(limits)

    def set_bounds(self, parameters: Array, bounds: Bounds) -> None:
        """Put bounds into rows of parameters."""
        parameters[:, self.parameters.slice("lower")] = bounds.lower
        parameters[:, self.parameters.slice("upper")] = bounds.upper

    def set_tolerance(self, parameters: Array, tolerance: float) -> None:
        """Put one tolerance [m, rad] of all contacts into rows of parameters."""
        parameters[:, self.parameters.slice("position_tolerance")] = tolerance
        parameters[:, self.parameters.slice("angle_tolerance")] = tolerance

    def run(self, states: Array, parameters: Array) -> Array:
        """(k, n) configurations that rows lead to."""
        return self.method.run_rows(states, parameters).states[:, self.state.slice("q")]


class LocalRefinement:
    """Refinement of the whole arm-hand from given configurations.

    Attributes:
        trials: The loop.
        targets: k targets.
    """

    def __init__(self, trials: Subproblems, targets: TargetBatch) -> None:
        """Lay out a row per target, for any number of runs."""
        self.trials = trials
        self.targets = targets
        self._states, self._parameters = refinement_rows(trials, targets)

    def run(
        self, owner: Rows, q: Array, bounds: Bounds | None = None, weights: Array | None = None
    ) -> Array:
        """Refine.

        Args:
            owner: (m,) number of the target of each row.
            q: (m, n) starts.
            bounds: (n,) or (m, n); None keeps to the limits.
            weights: (m, f, 2) of points and normals; None counts all alike. With weights the loop
                does not stop at the tolerance.

        Returns:
            (m, n) configurations.
        """
        trials = self.trials
        states, parameters = self._states[owner], self._parameters[owner]
        bounds = bounds or trials.limits(self.targets).of(owner)
        start = bounds.clip(q)
        states[:, trials.state.slice("q")] = start
        states[:, trials.state.slice("best_q")] = start
        trials.set_bounds(parameters, bounds)
        if weights is not None:
            parameters[:, trials.parameters.slice("weights")] *= weights.reshape(len(q), -1)
            trials.set_tolerance(parameters, UNREACHABLE_TOLERANCE)
        return trials.run(states, parameters)

    def misses(self, owner: Rows, q: Array) -> Array:
        """(m, f, 2) lengths of the residuals of points [0.1 m] and normals; 0 where free."""
        position, angle, _ = deviations(self.trials.robot, self.targets.rows(owner), q)
        return np.nan_to_num(np.stack([position / LENGTH, 2 * np.sin(angle / 2)], axis=2))


def refinement_rows(trials: Subproblems, targets: TargetBatch) -> tuple[Array, Array]:
    """States and parameters of the loop that begin with the refinement of the whole arm-hand."""
    count, hand = len(targets), len(trials.robot.description.hand_actuators)
    home = np.tile(trials.robot.home, (count, 1))
    states, parameters = trials.posture_rows(targets, home, np.zeros((count, hand)))
    for name, value in ({"phase": Phase.REFINEMENT} | initial_lm_state()).items():
        states[:, trials.state.slice(name)] = value
    return states, parameters


def sample_trunks(
    trials: Subproblems,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    first: int,
    count: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Configurations with the same hands and palms, from several trunks each.

    By turns the arms are placed at the trunk in closed form, or trunk and arms move from anywhere.

    Args:
        trials: The loop.
        targets: k targets.
        q: (m, n) configurations whose hands are kept.
        palms: (m, s, 4, 4) poses of the palms.
        owner: (m,) the target of each.
        first: Number of the first trunk.
        count: How many.

    Returns:
        (m count, n) where the loop ended, and the place in q of each.
    """
    body = trials.robot.description
    of = np.repeat(np.arange(len(q)), count)
    moving = [*body.trunk_actuators, *(place for arm, _ in body.side_actuators for place in arm)]
    spread = spread_points(first + count, len(moving))[first:]
    spread[1::2] = np.clip((spread[1::2] - 0.5) * TRUNK_STRETCH + 0.5, 0.0, 1.0)
    limits = trials.limits(targets).of(owner[of])
    begun = q[of]
    lower, upper = (np.broadcast_to(ends, begun.shape) for ends in (limits.lower, limits.upper))
    steps = np.tile(spread, (len(q), 1))
    begun[:, moving] = lower[:, moving] + steps * (upper - lower)[:, moving]
    placed = np.tile(np.arange(first, first + count) % 4 != 3, len(q))
    phase = np.where(placed, float(Phase.ARM_PLACEMENT), float(Phase.TRUNK))
    return carry_palms(trials, targets, begun, palms[of], owner[of], phase), of


def carry_palms(
    trials: Subproblems,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    phase: float | Array,
) -> Array:
    """Configurations (m, n) in which trunk and arms, from q on, carry palms (m, s, 4, 4)."""
    robot = trials.robot.description
    hands = q[:, list(robot.hand_actuators)]
    states, parameters = trials.posture_rows(targets.rows(owner), q, hands)
    wanted: dict[str, Array | float] = {
        "q": q,
        "best_q": q,
        "phase": phase,
        "side": len(robot.sides),
        **CARRY_ONLY,
    }
    for place in range(len(robot.sides)):
        wanted[f"palm_rotation_{place}"] = palms[:, place, :3, :3].reshape(-1, 9)
        wanted[f"palm_origin_{place}"] = palms[:, place, :3, 3]
    for name, value in wanted.items():
        numbers = np.asarray(value, dtype=float)
        states[:, trials.state.slice(name)] = numbers[:, None] if numbers.ndim == 1 else numbers
    return trials.run(states, parameters)


def side_palms(robot: ArmHand, q: Array) -> Array:
    """(k, s, 4, 4) poses of the palms of a body."""
    return np.stack([robot.palm(q, side.name) for side in robot.description.sides], axis=1)


def repeat_target(targets: TargetBatch, count: int) -> TargetBatch:
    """One target, several times."""
    return targets.rows(np.zeros(count, dtype=np.intp))


def residual_tolerances(targets: TargetBatch) -> Array:
    """(k, f, 2) the residuals that the tolerances allow, see `LocalRefinement.misses`; 0: free."""
    known = [~np.isnan(targets.points[..., 0]), ~np.isnan(targets.normals[..., 0])]
    tolerated = [targets.position_tolerance / LENGTH, 2 * np.sin(targets.angle_tolerance / 2)]
    return np.stack(known, axis=2) * np.stack(tolerated, axis=1)


def smallest_per_target(owner: Rows, values: Array, most: int) -> Rows:
    """Rows with the smallest values of each target that differ, target by target, best first.

    Args:
        owner: (m,) number of the target of each row.
        values: (m,) >= 0.
        most: How many rows of a target at most.
    """
    order = np.lexsort((values, owner))
    mine, value = owner[order], values[order]
    fresh = np.ones(len(order), dtype=bool)
    fresh[1:] = (mine[1:] != mine[:-1]) | (value[1:] > value[:-1] * DUPLICATE_FACTOR)
    return first_per_owner(owner, order[fresh], most)


def improving_rows(owner: NDArray[np.intp], value: Array, than: Array) -> NDArray[np.intp]:
    """The row of the largest value (m,) of each owner (m,), where it exceeds what that has (k,)."""
    order = np.lexsort((value, owner))
    last = order[np.diff(owner[order], append=-1) != 0]
    return last[value[last] > than[owner[last]]]


def largest_per_owner(owner: NDArray[np.intp], value: Array, count: int) -> NDArray[np.intp]:
    """The rows of so many of the largest values (m,) of each owner (m,), owner by owner."""
    return first_per_owner(owner, np.lexsort((-value, owner)), count)


def first_per_owner(
    owner: NDArray[np.intp], order: NDArray[np.intp], count: int
) -> NDArray[np.intp]:
    """So many rows of each owner, the first in an order that goes owner by owner."""
    sorted_owner = owner[order]
    rank = np.arange(len(order)) - np.searchsorted(sorted_owner, sorted_owner)
    return order[rank < count]


class Deduplicator:
    """The rows that each of k owners has had so far, none like another."""

    def __init__(self, count: int, size: int, apart: float) -> None:
        """Begin with none.

        Args:
            count: Owners.
            size: Numbers of a row.
            apart: Rows all of whose numbers differ by less are alike.
        """
        self._rows = np.full((count, 0, size), np.nan)
        self._apart = apart

    def add(self, rows: Array, owner: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Take rows (m, size) in; (m,) whether each is unlike all before it."""
        order = np.argsort(owner, kind="stable")
        mine = owner[order]
        rank = np.arange(len(order)) - np.searchsorted(mine, mine)
        whose, place = np.unique(mine, return_inverse=True)
        most, before = int(rank.max(initial=-1)) + 1, self._rows.shape[1]
        if not before and most <= 1:
            self._rows = np.full((len(self._rows), most, rows.shape[1]), np.nan)
            self._rows[whose, :1] = rows[order][:, None]
            return np.ones(len(rows), dtype=bool)
        new = np.full((len(whose), most, rows.shape[1]), np.nan)
        new[place, rank] = rows[order]
        every = np.concatenate([self._rows[whose], new], axis=1)
        # Of rows that are not there the distance is NaN, which is not near. Number by number: the
        # largest along a short last axis costs several times as much.
        near = np.ones((len(whose), most, before + most), dtype=bool)
        for one, known in zip(np.moveaxis(new, 2, 0), np.moveaxis(every, 2, 0), strict=True):
            near &= np.abs(one[:, :, None] - known[:, None]) < self._apart
        fresh = np.asarray(~near[:, :, :before].any(axis=2))
        for i in range(1, most):
            fresh[:, i] &= ~(near[:, i, before : before + i] & fresh[:, :i]).any(axis=1)
        added = np.full((len(self._rows), most, rows.shape[1]), np.nan)
        added[whose] = np.where(fresh[:, :, None], new, np.nan)
        self._rows = np.concatenate([self._rows, added], axis=1)
        found = np.zeros(len(rows), dtype=bool)
        found[order] = fresh[place, rank]
        return found


def palm_coordinates(palms: Array) -> Array:
    """(k, 12) what tells poses (k, 4, 4) of palms apart, beside motors as parts of ranges."""
    return (palms[:, :3] * PALM_SCALES).reshape(-1, 12)


def distinct_rows(parts: Array, apart: float) -> list[int]:
    """Rows of parts (k, n) that differ from all chosen before them, in their order."""
    nobody = np.zeros(len(parts), dtype=np.intp)
    return np.flatnonzero(Deduplicator(1, parts.shape[1], apart).add(parts, nobody)).tolist()
