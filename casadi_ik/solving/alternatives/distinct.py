"""Which of several configurations count as different."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError


def distinct(parts: Array, apart: float, limit: int | None = None) -> list[int]:
    """Rows of parts (k, n) that differ from all chosen before them, in their order."""
    kept: list[int] = []
    for i in range(len(parts)):
        if len(kept) == limit:
            break
        if (np.abs(parts[i] - parts[kept]).max(axis=1, initial=0.0) >= apart).all():
            kept.append(i)
    return kept


def checked_distance(apart: float) -> float:
    """A least difference of configurations.

    Raises:
        InputError: It is none.
    """
    number = isinstance(apart, (int, float, np.integer, np.floating))
    if not number or isinstance(apart, bool) or not 0 <= apart <= 1:
        raise InputError(f"apart: found {apart!r}, expected a number from 0 to 1")
    return float(apart)
