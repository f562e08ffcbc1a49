"""Selection of rows by owner: smallest, largest, first and distinct rows.

An owner is what several rows belong to, for example the target of several configurations.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.files.arrays import Array, Rows

DUPLICATE_FACTOR = 1.001
"""Ratio below which two values of an owner count as duplicates."""


def smallest_per_owner(owner: Rows, values: Array, count: int) -> Rows:
    """Return the rows with the smallest distinct values of each owner, ordered by owner.

    Args:
        owner: (m,) owner of each row.
        values: (m,) values >= 0.
        count: Maximum number of rows per owner.
    """
    order = np.lexsort((values, owner))
    sorted_owner, value = owner[order], values[order]
    is_distinct = np.ones(len(order), dtype=bool)
    is_distinct[1:] = (sorted_owner[1:] != sorted_owner[:-1]) | (
        value[1:] > value[:-1] * DUPLICATE_FACTOR
    )
    return first_per_owner(owner, order[is_distinct], count)


def improving_rows(owner: NDArray[np.intp], value: Array, threshold: Array) -> NDArray[np.intp]:
    """Return the row with the largest value of each owner, if it exceeds a threshold.

    Args:
        owner: (m,) owner of each row.
        value: (m,) values.
        threshold: (k,) threshold of each owner.
    """
    order = np.lexsort((value, owner))
    last = order[np.diff(owner[order], append=-1) != 0]
    return last[value[last] > threshold[owner[last]]]


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

    def __init__(self, count: int, size: int, min_difference: float) -> None:
        """Start without rows.

        Args:
            count: Number of owners.
            size: Numbers per row.
            min_difference: Rows are duplicates if all of their numbers differ by less than this.
        """
        self._rows = np.full((count, 0, size), np.nan)
        self._min_difference = min_difference

    def add(self, rows: Array, owner: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Add rows (m, size), and return (m,) True where a row differs from all rows before it."""
        order = np.argsort(owner, kind="stable")
        sorted_owner = owner[order]
        rank = np.arange(len(order)) - np.searchsorted(sorted_owner, sorted_owner)
        owners, position = np.unique(sorted_owner, return_inverse=True)
        max_new, previous_count = int(rank.max(initial=-1)) + 1, self._rows.shape[1]
        if not previous_count and max_new <= 1:
            self._rows = np.full((len(self._rows), max_new, rows.shape[1]), np.nan)
            self._rows[owners, :1] = rows[order][:, None]
            return np.ones(len(rows), dtype=bool)
        new = np.full((len(owners), max_new, rows.shape[1]), np.nan)
        new[position, rank] = rows[order]
        compared_rows = np.concatenate([self._rows[owners], new], axis=1)
        # The distance to a missing row is NaN, which does not count as near. The loop over numbers
        # is several times faster than a maximum along a short last axis.
        is_near = np.ones((len(owners), max_new, previous_count + max_new), dtype=bool)
        for new_column, compared_column in zip(
            np.moveaxis(new, 2, 0), np.moveaxis(compared_rows, 2, 0), strict=True
        ):
            is_near &= (
                np.abs(new_column[:, :, None] - compared_column[:, None]) < self._min_difference
            )
        is_new = np.asarray(~is_near[:, :, :previous_count].any(axis=2))
        for i in range(1, max_new):
            is_new[:, i] &= ~(
                is_near[:, i, previous_count : previous_count + i] & is_new[:, :i]
            ).any(axis=1)
        added = np.full((len(self._rows), max_new, rows.shape[1]), np.nan)
        added[owners] = np.where(is_new[:, :, None], new, np.nan)
        self._rows = np.concatenate([self._rows, added], axis=1)
        result = np.zeros(len(rows), dtype=bool)
        result[order] = is_new[position, rank]
        return result


def distinct_rows(rows: Array, min_difference: float) -> list[int]:
    """Return the indices of rows (k, n) that differ from all returned rows before them."""
    single_owner = np.zeros(len(rows), dtype=np.intp)
    duplicates = Deduplicator(1, rows.shape[1], min_difference)
    return np.flatnonzero(duplicates.add(rows, single_owner)).tolist()
