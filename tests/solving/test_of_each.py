"""Rows of several owners."""

from __future__ import annotations

import numpy as np

from casadi_ik.solving.alternatives.of_each import Different, best_of_each, first_of_each


def test_what_is_like_an_earlier_row_of_the_same_owner_is_not_new():
    """As one comparison after the other has it."""
    rng = np.random.default_rng(2)
    kept, seen = Different(5, 3, 0.3), [list[np.ndarray]() for _ in range(5)]
    for count in (9, 0, 14, 30):
        rows, owner = rng.random((count, 3)), rng.integers(0, 5, count)
        expected = []
        for row, one in zip(rows, owner, strict=True):
            new = all(np.abs(row - other).max() >= 0.3 for other in seen[one])
            expected.append(new)
            if new:
                seen[one].append(row)
        np.testing.assert_array_equal(kept.add(rows, owner), np.array(expected, dtype=bool))
    assert sum(map(len, seen)) > 10


def test_the_best_and_the_first_of_each():
    owner, value = np.array([2, 0, 2, 0, 1]), np.array([3.0, 1.0, 5.0, 4.0, 2.0])
    rows = best_of_each(owner, value, np.array([0.0, 7.0, 0.0]))
    assert rows.tolist() == [3, 2]
    order = np.lexsort((-value, owner))
    assert first_of_each(owner, order, 1).tolist() == [3, 4, 2]
