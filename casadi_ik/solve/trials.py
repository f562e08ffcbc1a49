"""Runs of the hand-first loop with modified bounds, weights and starts, and helpers for them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.layout import Layout
from casadi_ik.files.arrays import Array, Rows, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.rows import (
    hand_rows,
    palm_rows,
    refinement_rows,
    start_refinement,
)
from casadi_ik.solve.method import HandSearch
from casadi_ik.solve.verdict import deviations, judge

UNREACHABLE_TOLERANCE = 1e-12
"""Tolerance that no configuration meets, so that the loop continues to the minimum."""

TRUNK_STRETCH = 2.0
"""Factor by which every second trunk sample is stretched about the middle of the range, clamped."""

DUPLICATE_FACTOR = 1.001
"""Ratio below which two values of a target count as duplicates."""

PALM_SCALES = np.array([0.1, 0.1, 0.1, 2.0])
"""Scales of rotations [1/rad] and translations [1/m] of a free palm, relative to motor ranges."""


@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of the actuators, (n,) or (k, n)."""

    lower: Array
    upper: Array

    def clip(self, q: Array) -> Array:
        """Return configurations clipped to the bounds."""
        return np.clip(q, self.lower, self.upper)

    def of(self, rows: Rows) -> Bounds:
        """Return the bounds of some targets."""
        return self if self.lower.ndim == 1 else Bounds(self.lower[rows], self.upper[rows])

    @property
    def first(self) -> Bounds:
        """(n,) bounds of the first target; the bounds of the arm are the same for all targets."""
        return self if self.lower.ndim == 1 else Bounds(self.lower[0], self.upper[0])

    def tiled(self, count: int) -> Bounds:
        """Return shared bounds as (k, n)."""
        return Bounds(np.tile(self.lower, (count, 1)), np.tile(self.upper, (count, 1)))

    def beyond(self, q: Array) -> Array:
        """Return signed violations of the bounds: > 0 above, < 0 below, 0 within."""
        return np.maximum(q - self.upper, 0.0) - np.maximum(self.lower - q, 0.0)


@dataclass(frozen=True, eq=False)
class Subproblems:
    """Runs of the loop of the hand-first method from modified states and parameters.

    Attributes:
        robot: The robot.
        method: The method, built for this robot.
    """

    robot: ArmHand
    method: HandSearch

    @cached_property
    def state(self) -> Layout:
        """Layout of the state of the loop."""
        return self.method.step.layouts.state

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters of the loop."""
        return self.method.step.layouts.parameters

    def limits(self, targets: TargetBatch) -> Bounds:
        """Return the bounds of solutions, (n,) or (k, n), see `TargetBatch.bounds`."""
        return Bounds(*targets.bounds(self.robot.description))

    def search(self, targets: TargetBatch, start: Array, bounds: Bounds) -> Array:
        """Run the first restart of hand-first for each of k targets.

        Args:
            targets: The targets.
            start: (n,) start configuration [rad or m].
            bounds: (k, n) bounds [rad or m].

        Returns:
            (k, n) configurations [rad or m].
        """
        starts = bounds.clip(start)
        postures = self.method.postures(targets, 0)
        states, parameters = self.method.rows(targets, starts, postures)
        self.set_bounds(parameters, bounds)
        return self.run(states, parameters)

    def hand_rows(
        self, targets: TargetBatch, rows: Rows, starts: Array, postures: Array, first: int = 0
    ) -> tuple[Rows, Array, Array]:
        """Return states and parameters for several seeds of some targets.

        Args:
            targets: k targets.
            rows: (c,) indices of the targets.
            starts: (k, n) start configurations of all targets [rad or m].
            postures: (c, p, hand) seeds of the selected targets [rad or m].
            first: Palm number of the first seed, see `rows.hand_rows`.

        Returns:
            Target index of each row, (c p,), states and parameters.
        """
        count = postures.shape[1]
        owner, turns = np.repeat(rows, count), first + np.tile(np.arange(count), len(rows))
        flat = postures.reshape(len(owner), postures.shape[2])
        return owner, *hand_rows(self.method, targets.rows(owner), starts[owner], flat, turns)

    def solved(self, targets: TargetBatch, q: Array, limits: bool) -> NDArray[np.bool_]:
        """Return (k,) whether q solves its targets, within limits if `limits`."""
        return judge(self.robot, targets, q).solved(limits)

    def set_bounds(self, parameters: Array, bounds: Bounds) -> None:
        """Set the bounds in rows of parameters."""
        parameters[:, self.parameters.slice("lower")] = bounds.lower
        parameters[:, self.parameters.slice("upper")] = bounds.upper

    def set_tolerance(self, parameters: Array, tolerance: float) -> None:
        """Set one tolerance [m, rad] of all contacts in rows of parameters."""
        parameters[:, self.parameters.slice("position_tolerance")] = tolerance
        parameters[:, self.parameters.slice("angle_tolerance")] = tolerance

    def run(self, states: Array, parameters: Array) -> Array:
        """Return the final configurations (k, n) of rows."""
        return self.method.run_rows(states, parameters).states[:, self.state.slice("q")]


class LocalRefinement:
    """Refinement of all joints of the robot from given configurations.

    Attributes:
        trials: Runs of the loop.
        targets: k targets.
    """

    def __init__(self, trials: Subproblems, targets: TargetBatch) -> None:
        """Prepare states and parameters of every target, for any number of runs."""
        self.trials = trials
        self.targets = targets
        home = np.tile(trials.robot.home, (len(targets), 1))
        self._states, self._parameters = refinement_rows(trials.method, targets, home)

    def run(
        self, owner: Rows, q: Array, bounds: Bounds | None = None, weights: Array | None = None
    ) -> Array:
        """Refine configurations.

        Args:
            owner: (m,) target index of each row.
            q: (m, n) start configurations [rad or m].
            bounds: (n,) or (m, n) bounds [rad or m]; None: the limits.
            weights: (m, f, 2) weights of points and normals; None: all 1. With weights the loop
                continues beyond the tolerance to the minimum.

        Returns:
            (m, n) configurations [rad or m].
        """
        trials = self.trials
        states, parameters = self._states[owner], self._parameters[owner]
        bounds = bounds or trials.limits(self.targets).of(owner)
        start_refinement(trials.method, states, bounds.clip(q))
        trials.set_bounds(parameters, bounds)
        if weights is not None:
            parameters[:, trials.parameters.slice("weights")] *= weights.reshape(len(q), -1)
            trials.set_tolerance(parameters, UNREACHABLE_TOLERANCE)
        return trials.run(states, parameters)

    def misses(self, owner: Rows, q: Array) -> Array:
        """Return (m, f, 2) residual norms of points [0.1 m] and normals; 0 where free."""
        position, angle, _ = deviations(self.trials.robot, self.targets.rows(owner), q)
        return np.nan_to_num(np.stack([position / LENGTH, 2 * np.sin(angle / 2)], axis=2))


def sample_trunks(
    trials: Subproblems,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    first: int,
    count: int,
) -> tuple[Array, NDArray[np.intp]]:
    """Return configurations with given hands and palm poses, from several trunk postures each.

    Three of four samples place the arms in closed form at the sampled trunk; the fourth moves trunk
    and arms numerically from a sampled posture.

    Args:
        trials: Runs of the loop.
        targets: k targets.
        q: (m, n) configurations that contain the hand postures [rad or m].
        palms: (m, s, 4, 4) palm poses.
        owner: (m,) target index of each configuration.
        first: Number of the first sample.
        count: Number of samples.

    Returns:
        (m count, n) final configurations [rad or m], and the row of q of each.
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
    return carry_palms(trials, targets, begun, palms[of], owner[of], placed), of


def carry_palms(
    trials: Subproblems,
    targets: TargetBatch,
    q: Array,
    palms: Array,
    owner: NDArray[np.intp],
    places_arms: bool | NDArray[np.bool_],
) -> Array:
    """Return configurations (m, n) whose trunk and arms move from q to palm poses (m, s, 4, 4).

    See `rows.palm_rows`.
    """
    rows = palm_rows(trials.method, targets.rows(owner), q, palms, places_arms)
    return trials.run(*rows)


def side_palms(robot: ArmHand, q: Array) -> Array:
    """Return the palm poses (k, s, 4, 4) of a multi-arm robot."""
    return np.stack([robot.palm(q, side.name) for side in robot.description.sides], axis=1)


def repeat_target(targets: TargetBatch, count: int) -> TargetBatch:
    """Return one target repeated."""
    return targets.rows(np.zeros(count, dtype=np.intp))


def residual_tolerances(targets: TargetBatch) -> Array:
    """Return (k, f, 2) residuals at tolerance, see `LocalRefinement.misses`; 0 where free."""
    known = [~np.isnan(targets.points[..., 0]), ~np.isnan(targets.normals[..., 0])]
    tolerated = [targets.position_tolerance / LENGTH, 2 * np.sin(targets.angle_tolerance / 2)]
    return np.stack(known, axis=2) * np.stack(tolerated, axis=1)


def smallest_per_target(owner: Rows, values: Array, most: int) -> Rows:
    """Return the rows with the smallest distinct values of each target, ordered by target.

    Args:
        owner: (m,) target index of each row.
        values: (m,) values >= 0.
        most: Maximum number of rows per target.
    """
    order = np.lexsort((values, owner))
    sorted_owner, value = owner[order], values[order]
    is_distinct = np.ones(len(order), dtype=bool)
    is_distinct[1:] = (sorted_owner[1:] != sorted_owner[:-1]) | (
        value[1:] > value[:-1] * DUPLICATE_FACTOR
    )
    return first_per_owner(owner, order[is_distinct], most)


def improving_rows(owner: NDArray[np.intp], value: Array, than: Array) -> NDArray[np.intp]:
    """Return the row with the largest value of each owner, if it exceeds a threshold.

    Args:
        owner: (m,) owner of each row.
        value: (m,) values.
        than: (k,) threshold of each owner.
    """
    order = np.lexsort((value, owner))
    last = order[np.diff(owner[order], append=-1) != 0]
    return last[value[last] > than[owner[last]]]


def largest_per_owner(owner: NDArray[np.intp], value: Array, count: int) -> NDArray[np.intp]:
    """Return the rows of the `count` largest values (m,) of each owner (m,), ordered by owner."""
    return first_per_owner(owner, np.lexsort((-value, owner)), count)


def first_per_owner(
    owner: NDArray[np.intp], order: NDArray[np.intp], count: int
) -> NDArray[np.intp]:
    """Return the first `count` rows of each owner, from an order that is sorted by owner."""
    sorted_owner = owner[order]
    rank = np.arange(len(order)) - np.searchsorted(sorted_owner, sorted_owner)
    return order[rank < count]


class Deduplicator:
    """Filter of duplicate rows for each of k owners."""

    def __init__(self, count: int, size: int, apart: float) -> None:
        """Start without rows.

        Args:
            count: Number of owners.
            size: Numbers per row.
            apart: Rows are duplicates if all of their numbers differ by less than this.
        """
        self._rows = np.full((count, 0, size), np.nan)
        self._apart = apart

    def add(self, rows: Array, owner: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Add rows (m, size), and return (m,) whether each differs from all rows before it."""
        order = np.argsort(owner, kind="stable")
        sorted_owner = owner[order]
        rank = np.arange(len(order)) - np.searchsorted(sorted_owner, sorted_owner)
        owners, position = np.unique(sorted_owner, return_inverse=True)
        largest, before = int(rank.max(initial=-1)) + 1, self._rows.shape[1]
        if not before and largest <= 1:
            self._rows = np.full((len(self._rows), largest, rows.shape[1]), np.nan)
            self._rows[owners, :1] = rows[order][:, None]
            return np.ones(len(rows), dtype=bool)
        new = np.full((len(owners), largest, rows.shape[1]), np.nan)
        new[position, rank] = rows[order]
        known = np.concatenate([self._rows[owners], new], axis=1)
        # The distance to a missing row is NaN, which does not count as near. The loop over numbers
        # is several times faster than a maximum along a short last axis.
        is_near = np.ones((len(owners), largest, before + largest), dtype=bool)
        for new_column, known_column in zip(
            np.moveaxis(new, 2, 0), np.moveaxis(known, 2, 0), strict=True
        ):
            is_near &= np.abs(new_column[:, :, None] - known_column[:, None]) < self._apart
        is_new = np.asarray(~is_near[:, :, :before].any(axis=2))
        for i in range(1, largest):
            is_new[:, i] &= ~(is_near[:, i, before : before + i] & is_new[:, :i]).any(axis=1)
        added = np.full((len(self._rows), largest, rows.shape[1]), np.nan)
        added[owners] = np.where(is_new[:, :, None], new, np.nan)
        self._rows = np.concatenate([self._rows, added], axis=1)
        result = np.zeros(len(rows), dtype=bool)
        result[order] = is_new[position, rank]
        return result


def palm_coordinates(palms: Array) -> Array:
    """Return (k, 12) scaled coordinates of palm poses (k, 4, 4), comparable to motor ranges."""
    return (palms[:, :3] * PALM_SCALES).reshape(-1, 12)


def distinct_rows(parts: Array, apart: float) -> list[int]:
    """Return the indices of rows (k, n) that differ from all returned rows before them."""
    single_owner = np.zeros(len(parts), dtype=np.intp)
    duplicates = Deduplicator(1, parts.shape[1], apart)
    return np.flatnonzero(duplicates.add(parts, single_owner)).tolist()
