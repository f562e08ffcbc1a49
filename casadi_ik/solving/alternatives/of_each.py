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
        self._rows = np.full((count, 1, size), np.nan)
        self._had = np.zeros(count, dtype=np.int64)
        self._apart = apart

    def add(self, rows: Array, owner: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Take rows (m, size) in; (m,) whether each is unlike all before it."""
        fresh = np.zeros(len(rows), dtype=bool)
        order = np.argsort(owner, kind="stable")
        mine = owner[order]
        rank = np.arange(len(order)) - np.searchsorted(mine, mine)
        for place in range(int(rank.max(initial=-1)) + 1):
            now = order[rank == place]
            whose = owner[now]
            # Of rows that are not there the distance is NaN, which is not near.
            off = np.abs(self._rows[whose] - rows[now, None]).max(axis=2)
            new = ~(off < self._apart).any(axis=1)
            fresh[now] = new
            now, whose = now[new], whose[new]
            if len(whose) and self._had[whose].max() == self._rows.shape[1]:
                self._rows = np.concatenate([self._rows, np.full_like(self._rows, np.nan)], axis=1)
            self._rows[whose, self._had[whose]] = rows[now]
            self._had[whose] += 1
        return fresh
