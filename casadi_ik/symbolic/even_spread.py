"""Points spread evenly over a cube, the same every time."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array


def evenly(count: int, dimensions: int, first: int = 0) -> Array:
    """(count, dimensions) points of an additive recurrence, evenly spread over the unit cube.

    From one on, counted from 0: with all before they are spread evenly as well.

    Roberts' generalised golden ratio: the root of x^(d+1) = x + 1 gives the increments.
    """
    return (0.5 + np.arange(first + 1, first + count + 1)[:, None] * even_steps(dimensions)) % 1.0


def even_steps(dimensions: int) -> Array:
    """(dimensions,) from one point of an even spread to the next."""
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    return ratio ** -np.arange(1.0, dimensions + 1)
