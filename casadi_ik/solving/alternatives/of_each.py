"""The best rows of each owner, and those unlike others, where an array has rows of several."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array


def best_of_each(owner: NDArray[np.intp], value: Array, than: Array) -> NDArray[np.intp]:
    """The row of the largest value (m,) of each owner (m,), where it exceeds what that has (k,)."""
    order = np.lexsort((value, owner))
    last = order[np.append(owner[order][1:] != owner[order][:-1], True)]
    return last[value[last] > than[owner[last]]]


def first_of_each(owner: NDArray[np.intp], order: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """So many rows of each owner, the first in an order that goes owner by owner."""
    sorted_owner = owner[order]
    rank = np.arange(len(order)) - np.searchsorted(sorted_owner, sorted_owner)
    return order[rank < count]


class Different:
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
