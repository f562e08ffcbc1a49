"""Branches of an arm with their allowed intervals of the redundancy parameter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.cancellation import stop_if_cancelled
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import SIGNS, ArmFamily, ClosedForm
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.forward import Pose
from casadi_ik.solve.solution import ArmBranch

FULL_TURN = 2 * np.pi
"""Full revolution [rad]."""


@dataclass(frozen=True)
class BranchSampling:
    """Sampling of the redundancy parameter of a branch.

    Attributes:
        samples: Number of samples if the breakpoints of the redundancy parameter are unknown.
        iterative_samples: Number of samples for an iterative family, for which each sample requires
            a search for all roots.
        peak_steps: Number of ternary search steps around a sample that find an allowed interval
            between two samples.
        bisection_steps: Number of bisection steps that find the end of an allowed interval.
        branch_samples: Number of samples of an allowed interval among which its best arm is chosen.
        zooms: Number of refinements around the best sample, each with 1/16 of the spacing.
    """

    samples: int = 361
    iterative_samples: int = 37
    peak_steps: int = 12
    bisection_steps: int = 45
    branch_samples: int = 33
    zooms: int = 2


BRANCH_SAMPLING = BranchSampling()


class ArmBranches:
    """Arms of a family with at most one redundancy parameter."""

    def __init__(self, family: ArmFamily, compiled: bool = True) -> None:
        """Compile the closed form of the arm or load it from the cache."""
        self.family = family
        self._closed_form = FunctionKernel(family.arms(), compiled)
        breakpoints = _breakpoints(family)
        self._breakpoints_kernel = (
            None if breakpoints is None else FunctionKernel(breakpoints, compiled)
        )

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Return every allowed interval of the redundancy parameter of every branch.

        An interval is allowed if the limit margin of the arm is not negative. The margin does not
        change sign between two breakpoints. If the breakpoints are unknown, the margin is sampled;
        a ternary search around its maxima finds intervals between two samples, and bisection finds
        the ends of intervals. Joints of several revolutions are placed in the middle one. Intervals
        of an iterative family end at samples.

        Args:
            palm: (4, 4) palm pose, base frame.
            lower: (n,) lower bounds [rad].
            upper: (n,) upper bounds [rad].
        """

        def margins(values: Array) -> Array:
            return self._limit_margins(palm, values, lower, upper)

        if not self.family.redundancy:
            allowed = margins(np.zeros(1))[0] >= ARM_SEARCH.tolerance
            return [self._branch(int(row), None) for row in np.flatnonzero(allowed)]
        samples = self._samples(palm, lower, upper)
        is_sampled = self._breakpoints_kernel is None and not self.family.is_iterative
        if is_sampled:
            samples = np.unique(np.concatenate([samples, _margin_peaks(samples, margins)]))
        allowed = margins(samples) >= ARM_SEARCH.tolerance
        # With padding every interval has a first and a last sample.
        padded = np.pad(allowed, ((1, 1), (0, 0)))
        rows, first = np.nonzero((padded[1:-1] & ~padded[:-2]).T)
        last = np.nonzero((padded[1:-1] & ~padded[2:]).T)[1]
        starts, stops = samples[first], samples[last]
        if is_sampled:
            outer = np.concatenate(
                [np.maximum(first - 1, 0), np.minimum(last + 1, len(samples) - 1)]
            )
            interval_ends = np.concatenate([starts, stops])
            interval_ends = _bisect_ends(interval_ends, samples[outer], np.tile(rows, 2), margins)
            starts, stops = np.split(interval_ends, 2)
        intervals = list(zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True))
        joined_intervals = self._join_intervals(intervals)
        return [self._branch(row, (first, last)) for row, first, last in joined_intervals]

    def arms(self, palm: Array, branch: ArmBranch, values: Array) -> Array:
        """Return the arms (k, n) [rad] of a branch at values (k,) of the redundancy parameter."""
        arms, _ = self._closed_form(palm[:3, :3], palm[:3, 3], values)
        return arms[:, self._row(branch)]

    def _row(self, branch: ArmBranch) -> int:
        signs = tuple(getattr(branch, name) for name in self.family.sign_names)
        return SIGNS.index(signs) * self.family.roots + branch.root

    def best(
        self,
        palm: Array,
        branches: list[ArmBranch],
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> list[tuple[Array, float | None]]:
        """Return the arm of each branch with the highest score, and its redundancy parameter.

        Args:
            palm: (4, 4) palm pose, base frame.
            branches: Branches with their allowed intervals.
            bounds: (n,) lower and (n,) upper bounds, those of `find`.
            score: Function from arms (k, n) to scores (k,).
        """
        if self.family.redundancy:
            return [self._best(palm, branch, bounds, score) for branch in branches]
        arms, _ = self._closed_form(palm[:3, :3], palm[:3, 3], np.zeros(1))
        return [(arms[0, self._row(branch)], None) for branch in branches]

    def _best(
        self,
        palm: Array,
        branch: ArmBranch,
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> tuple[Array, float | None]:
        """Return the best arm of a branch with an allowed interval, see `best`."""
        stop_if_cancelled()
        assert branch.swivel is not None
        first, last = branch.swivel
        values, zooms = (
            np.linspace(first, last, BRANCH_SAMPLING.branch_samples),
            BRANCH_SAMPLING.zooms,
        )
        if self.family.is_iterative:
            values, zooms = self._samples(palm, *bounds), 0
            values = values[(values >= first) & (values <= last)]
        for _ in range(zooms):
            i = int(np.argmax(score(self.arms(palm, branch, values))))
            step = values[1] - values[0]
            refined_interval = max(first, values[i] - step), min(last, values[i] + step)
            values = np.linspace(*refined_interval, BRANCH_SAMPLING.branch_samples)
        arms = self.arms(palm, branch, values)
        i = int(np.argmax(score(arms)))
        return arms[i], float(values[i])

    def _samples(self, palm: Array, lower: Array, upper: Array) -> Array:
        """Return the sorted values of the redundancy parameter at which arms are computed."""
        low, high = (float(bound) for bound in self.family.redundancy[0].bounds(lower, upper))
        if self._breakpoints_kernel is not None:
            signs = np.array([1.0, -1.0])
            (breakpoints,) = self._breakpoints_kernel(
                palm[:3, :3], palm[:3, 3], signs, lower, upper
            )
            breakpoints = np.mod(breakpoints.ravel() - low, FULL_TURN) + low
            breakpoints = np.unique(np.append(breakpoints, [low, high]))
            return np.unique(
                np.concatenate([breakpoints, (breakpoints[1:] + breakpoints[:-1]) / 2])
            )
        if self.family.is_iterative:
            # Within the bounds of the sampled joint, other joints limit the allowed intervals.
            count = BRANCH_SAMPLING.iterative_samples
            return low + (high - low) * (np.arange(count) + 0.5) / count
        return np.linspace(low, high, BRANCH_SAMPLING.samples)

    def _limit_margins(self, palm: Array, values: Array, lower: Array, upper: Array) -> Array:
        """Return the limit margins (k, rows) of all branches; the reach margin if negative."""
        arms, reach_margin = self._closed_form(palm[:3, :3], palm[:3, 3], values)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        reach_margin = reach_margin.reshape(margin.shape)
        return np.where(reach_margin < 0, np.minimum(margin, reach_margin), margin)

    def _join_intervals(
        self, intervals: list[tuple[int, float, float]]
    ) -> list[tuple[int, float, float]]:
        """Join the intervals of an unbounded angle across +-pi."""
        if self.family.redundancy[0].joint is not None:
            return intervals
        joined_intervals = []
        for row in sorted({row for row, *_ in intervals}):
            row_intervals = [interval for interval in intervals if interval[0] == row]
            first, last = row_intervals[0], row_intervals[-1]
            if len(row_intervals) > 1 and first[1] <= -np.pi and last[2] >= np.pi:
                row_intervals = [*row_intervals[1:-1], (row, last[1], first[2] + FULL_TURN)]
            joined_intervals += row_intervals
        return joined_intervals

    def _branch(self, row: int, interval: tuple[float, float] | None) -> ArmBranch:
        number, root = divmod(row, self.family.roots)
        signs = dict(zip(self.family.sign_names, SIGNS[number], strict=True))
        return ArmBranch(**signs, swivel=interval, root=root)


def _breakpoints(family: ArmFamily) -> ca.Function | None:
    """Return (rotation, origin, elbow sign, lower, upper) -> parameters with joints at bounds."""
    if not isinstance(family, ClosedForm):
        return None
    n, sign = len(family.screws), ca.SX.sym("sign")
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = ca.SX.sym("lower", n), ca.SX.sym("upper", n)
    values = family.breakpoints(Pose(rotation, origin), (sign,), lower, upper)
    if values is None:
        return None
    return ca.Function("breakpoints", [rotation, origin, sign, lower, upper], [values])


def _margin_peaks(grid: Array, margins: Callable[[Array], Array]) -> Array:
    """Return the maxima of the margins between samples that are not allowed."""
    margin = margins(grid)
    padded = np.pad(margin, ((1, 1), (0, 0)), constant_values=-np.inf)
    is_peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    sample, rows = np.nonzero(is_peak & (margin < ARM_SEARCH.tolerance))
    step, numbers = grid[1] - grid[0], np.arange(len(sample))
    first, last = (
        np.maximum(grid[sample] - step, grid[0]),
        np.minimum(grid[sample] + step, grid[-1]),
    )
    for _ in range(BRANCH_SAMPLING.peak_steps if len(sample) else 0):
        lower_third, upper_third = first + (last - first) / 3, last - (last - first) / 3
        rises = margins(lower_third)[numbers, rows] < margins(upper_third)[numbers, rows]
        first, last = np.where(rises, lower_third, first), np.where(rises, last, upper_third)
    return (first + last) / 2


def _bisect_ends(
    inner: Array, outer: Array, rows: NDArray[np.intp], margins: Callable[[Array], Array]
) -> Array:
    """Return the ends of allowed intervals, between allowed (inner) and other (outer) values."""
    numbers = np.arange(len(inner))
    for _ in range(BRANCH_SAMPLING.bisection_steps if len(inner) else 0):
        middle = (inner + outer) / 2
        allowed = margins(middle)[numbers, rows] >= ARM_SEARCH.tolerance
        inner, outer = np.where(allowed, middle, inner), np.where(allowed, outer, middle)
    return inner
