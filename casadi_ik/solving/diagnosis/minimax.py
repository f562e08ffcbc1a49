"""The nearest contacts, and a bound below which no configuration near them can miss.

With weights w_i >= 0 the smallest ``sum w_i e_i^2`` of the errors e_i bounds what is possible: if
it exceeds ``sum w_i t_i^2`` the tolerances t_i cannot all be kept. Weights that grow where the
tolerance is exceeded most tighten that bound (Lawson's algorithm), and lead to the configuration
whose largest error, as a part of its tolerance, is smallest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.solving.trials import Descent, Rows, allowed, smallest

ROUNDS = 16
"""Adaptations of the weights, at most."""

SETTLED = 0.01
"""The weights are adapted no further when the bound is this close to what was reached, or when it
says no and a round gains less than this."""

MARGIN = 1.02
"""By which factor the contacts have to be missed for a grasp to count as unreachable."""

LIGHTEST = 1e-4
"""Smallest weight."""


@dataclass(frozen=True, eq=False)
class Closest:
    """What came closest to k targets.

    Attributes:
        q: (k, n) configurations with the smallest squared error.
        fair: (k, n) configurations with the smallest largest error.
        ratio: (k,) by which factor the tolerances would have to grow at least, near any of the
            minima.
    """

    q: Array
    fair: Array
    ratio: Array

    def rows(self, rows: Rows) -> Closest:
        """What came closest to some of the targets."""
        return Closest(self.q[rows], self.fair[rows], self.ratio[rows])

    def put(self, rows: Rows, found: Closest) -> None:
        """Take what came closer to some of the targets."""
        self.q[rows], self.fair[rows], self.ratio[rows] = found.q, found.fair, found.ratio


def closest(descent: Descent, targets: Rows, q: Array, followed: int) -> Closest:
    """Follow the best of some configurations to the end.

    Args:
        descent: Of k targets.
        targets: (m,) which target a configuration is for; every target has one at least.
        q: (m, n).
        followed: How many of a target at most.
    """
    cost = (descent.misses(targets, q) ** 2).sum(axis=(1, 2))
    kept = smallest(targets, cost, followed)
    targets, q = targets[kept], q[kept]
    count, first = len(q), np.searchsorted(targets, np.arange(len(descent.problems)))
    tolerated = allowed(descent.problems)[targets]
    counted = tolerated > 0
    total = (tolerated**2).sum(axis=(1, 2))
    weights = counted.astype(float)
    worst, bound = np.full(count, np.inf), np.zeros(count)
    best = np.full(len(first), np.inf)
    done = np.zeros(len(first), dtype=bool)
    fair, plain, cost = q.copy(), q, np.zeros(count)
    rows = np.arange(count)
    for number in range(ROUNDS):
        here = targets[rows]
        q[rows] = descent.run(here, q[rows], weights=np.sqrt(weights[rows]))
        misses = descent.misses(here, q[rows])
        if number == 0:
            plain, cost = q.copy(), (misses**2).sum(axis=(1, 2))
        parts = np.divide(misses, tolerated[rows], where=counted[rows], out=np.zeros_like(misses))
        largest = parts.max(axis=(1, 2))
        better = rows[largest < worst[rows]]
        fair[better] = q[better]
        worst[rows] = np.minimum(worst[rows], largest)
        squares = (weights[rows] * misses**2).sum(axis=(1, 2))
        bound[rows] = np.maximum(bound[rows], np.sqrt(squares / total[rows]))
        before, best = best, np.minimum.reduceat(worst, first)
        least = np.minimum.reduceat(bound, first)
        stuck = best > (1 - SETTLED) * before
        done |= (best <= 1) | ((least > MARGIN) & stuck) | (least > (1 - SETTLED) * best)
        # A minimum that cannot come closer than another one already has is followed no further.
        going = ~done[here] & (bound[rows] < best[here])
        if not going.any():
            break
        new = np.where(counted[rows], np.maximum(weights[rows] * parts, LIGHTEST), 0.0)
        scale = total[rows] / (new * tolerated[rows] ** 2).sum(axis=(1, 2))
        weights[rows] = new * scale[:, None, None]
        rows = rows[going]
    ratio = np.minimum.reduceat(bound, first)
    return Closest(plain[smallest(targets, cost, 1)], fair[smallest(targets, worst, 1)], ratio)
