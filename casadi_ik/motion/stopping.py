"""Coming to rest: what `limiter.brake` is the inverse of, in numbers."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array


def stopping_way(moved: Array, change: Array) -> Array:
    """(n,) how far motors go on that come to rest as fast as they may.

    Args:
        moved: (n,) their last steps.
        change: (n,) by how much a step may differ from the last.
    """
    after = np.floor(np.abs(moved) / change)
    return np.sign(moved) * (np.abs(moved) * after - change * after * (after + 1) / 2)


def stopping_path(q: Array, moved: Array, change: Array, count: int) -> Array:
    """Where motors are on the way to rest.

    Args:
        q: (n,) where they are.
        moved: (n,) their last steps.
        change: (n,) by how much a step may differ from the last.
        count: How many places, evenly spaced in time.

    Returns:
        (count, n), q itself the first and the place of rest the last.
    """
    speed = np.abs(moved)
    after = np.floor(speed / change)
    number = np.ceil(np.linspace(0.0, after.max(), count))[:, None]
    steps = np.minimum(number, after)
    return q + np.sign(moved) * (speed * steps - change * steps * (steps + 1) / 2)
