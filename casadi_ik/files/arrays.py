"""Array types of the package, read-only arrays, and low-discrepancy points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
"""Real numbers: coordinates, vectors, matrices."""

Counts = NDArray[np.int64]
"""Integer counts: iterations, restarts, solves."""

Bools = NDArray[np.bool_]
"""Truth values."""

Rows = NDArray[np.intp]
"""Row numbers of another array."""


def read_only(values: ArrayLike) -> Array:
    """Return numbers as an array that cannot be changed."""
    array = np.asarray(values, dtype=float)
    array.flags.writeable = False
    return array


def spread_points(count: int, dimensions: int, first: int = 0) -> Array:
    """Return points of a low-discrepancy sequence in the unit cube, (count, dimensions).

    The sequence is the additive recurrence of Roberts' generalised golden ratio: the root of
    x^(d+1) = x + 1 gives the increments.

    Args:
        count: Number of points.
        dimensions: Dimension of the cube.
        first: Index of the first point; consecutive calls continue the sequence.
    """
    return (0.5 + np.arange(first + 1, first + count + 1)[:, None] * spread_steps(dimensions)) % 1.0


def spread_steps(dimensions: int) -> Array:
    """Return the increments (dimensions,) between consecutive points of `spread_points`."""
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return ratio ** -np.arange(1.0, dimensions + 1)
