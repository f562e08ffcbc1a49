"""The arrays that pass between the parts of the package: their names, and points spread evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
"""Numbers: coordinates, vectors, matrices."""

Counts = NDArray[np.int64]
"""Whole numbers that count: iterations, restarts, solves."""

Bools = NDArray[np.bool_]
"""What holds and what does not."""

Rows = NDArray[np.intp]
"""Positions in another array."""


def read_only(values: ArrayLike) -> Array:
    """Numbers as an array that cannot be changed."""
    array = np.asarray(values, dtype=float)
    array.flags.writeable = False
    return array


def spread_points(count: int, dimensions: int, first: int = 0) -> Array:
    """(count, dimensions) points of an additive recurrence, evenly spread over the unit cube.

    From one on, counted from 0: with all before they are spread evenly as well.

    Roberts' generalised golden ratio: the root of x^(d+1) = x + 1 gives the increments.
    """
    return (0.5 + np.arange(first + 1, first + count + 1)[:, None] * spread_steps(dimensions)) % 1.0


def spread_steps(dimensions: int) -> Array:
    """(dimensions,) from one point of an even spread to the next."""
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return ratio ** -np.arange(1.0, dimensions + 1)
