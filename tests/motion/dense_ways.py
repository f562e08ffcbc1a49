"""Dense samples of straight paths between postures."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

STRIDE = 0.02
"""Longest step of a motor between two samples, in its units."""


def dense(corners, units):
    """Return postures (k, n) on the straight paths from corner to corner (m, n)."""

    def between(start, end):
        count = max(2, math.ceil(float(np.max(np.abs(end - start) / units)) / STRIDE) + 1)
        return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)

    return np.concatenate([between(*pair) for pair in pairwise(corners)])
