"""Names of the arrays that pass between the parts of the package."""

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


def frozen(values: ArrayLike) -> Array:
    """Numbers as an array that cannot be changed."""
    array = np.asarray(values, dtype=float)
    array.flags.writeable = False
    return array
