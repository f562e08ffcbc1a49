"""All arms of a closed form for a palm pose, and the positions of its swept joint they allow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.methods.common.arm_branches import form_at, rows_of
from casadi_ik.methods.common.arm_placement import ALLOWED
from casadi_ik.solving.alternatives.branches import ArmBranch
from casadi_ik.symbolic.closed_arms.form import SIGNS, ClosedForm

POSITIONS = 361
"""Positions of the swept joint looked at along its range."""

PEAKS = 12
"""Thirds that the neighbourhood of a position is cut down by, to find a short stretch within."""

HALVINGS = 45
"""Of a step between two positions, to find the end of a stretch."""


class FormBranches:
    """Enumerates the arms of a closed form."""

    def __init__(self, form: ClosedForm, compiled: bool = True) -> None:
        """Compile the function of the arm or load it from the cache."""
        self._form = form
        self._at = FunctionKernel(form_at(form), compiled)

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every stretch of every branch, its ends as exact as the margins are.

        The margin (the least distance of a joint from its bounds) is looked at all along the swept
        joint's range, and closer wherever it is largest: a stretch between two positions is found
        by its peak. Of a joint that turns more than once the middle turn is taken.
        """
        joint = self._form.swept_joint
        if joint is None:
            margins = self._margins(palm, np.zeros(1), lower, upper)[0]
            return [self._branch(i, None) for i in np.flatnonzero(margins >= ALLOWED).tolist()]
        middle, half = (lower[joint] + upper[joint]) / 2, (upper[joint] - lower[joint]) / 2
        half = min(half, np.pi)
        grid = np.linspace(middle - half, middle + half, POSITIONS)
        margins = self._margins(palm, grid, lower, upper)
        found = []
        for side in range(rows_of(self._form)):

            def inside(positions: Array, side: int = side) -> NDArray[np.bool_]:
                return self._margins(palm, positions, lower, upper)[:, side] >= ALLOWED

            peaks = self._peaks(palm, grid, margins[:, side], side, lower, upper)
            positions = np.unique(np.concatenate([grid, peaks]))
            allowed = inside(positions)
            edges = np.flatnonzero(allowed[1:] != allowed[:-1])
            crossed = _crossings(positions[edges], positions[edges + 1], allowed[edges], inside)
            starts = [*positions[:1][allowed[:1]], *crossed[~allowed[edges]]]
            stops = [*crossed[allowed[edges]], *positions[-1:][allowed[-1:]]]
            found += [
                self._branch(side, (float(start), float(stop)))
                for start, stop in zip(starts, stops, strict=True)
            ]
        return found

    def arms(self, palm: Array, branch: ArmBranch, swivels: Array) -> Array:
        """Configurations (k, n) [rad] of a branch at positions (k,) of the swept joint."""
        signs = tuple(getattr(branch, part) for part in self._form.parts)
        arms, _ = self._at(palm[:3, :3], palm[:3, 3], swivels)
        return arms[:, SIGNS.index(signs) * self._roots + branch.root]

    def _branch(self, side: int, stretch: tuple[float, float] | None) -> ArmBranch:
        number, root = divmod(side, self._roots)
        signs = dict(zip(self._form.parts, SIGNS[number], strict=True))
        return ArmBranch(**signs, swivel=stretch, root=root)

    @property
    def _roots(self) -> int:
        return rows_of(self._form) // len(SIGNS)

    def _margins(self, palm: Array, positions: Array, lower: Array, upper: Array) -> Array:
        """(k, 8) or more, of every branch; the slack where it is out of reach."""
        arms, slack = self._at(palm[:3, :3], palm[:3, 3], positions)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        slack = slack.reshape(margin.shape)
        return np.where(slack < 0, np.minimum(margin, slack), margin)

    def _peaks(
        self, palm: Array, grid: Array, margin: Array, side: int, lower: Array, upper: Array
    ) -> Array:
        """Where the margin is largest between positions that are all outside."""
        padded = np.concatenate([[-np.inf], margin, [-np.inf]])
        top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]) & (margin < ALLOWED)
        step = grid[1] - grid[0]
        first = np.maximum(grid[top] - step, grid[0])
        last = np.minimum(grid[top] + step, grid[-1])
        for _ in range(PEAKS):
            if not len(first):
                break
            near, far = first + (last - first) / 3, last - (last - first) / 3
            tried = self._margins(palm, np.concatenate([near, far]), lower, upper)[:, side]
            low, high = np.split(tried, 2)
            first, last = np.where(low < high, near, first), np.where(low < high, last, far)
        return (first + last) / 2


def _crossings(
    first: Array,
    last: Array,
    begins: NDArray[np.bool_],
    inside: Callable[[Array], NDArray[np.bool_]],
) -> Array:
    """Where being inside changes between positions; the inner side of it."""
    for _ in range(HALVINGS if len(first) else 0):
        middle = (first + last) / 2
        same = inside(middle) == begins
        first, last = np.where(same, middle, first), np.where(same, last, middle)
    return np.where(begins, first, last)
