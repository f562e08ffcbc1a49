"""The nearest contacts, and a bound below which no configuration near them can miss.

With weights w_i >= 0 the smallest ``sum w_i e_i^2`` of the errors e_i bounds what is possible: if
it exceeds ``sum w_i t_i^2`` the tolerances t_i cannot all be kept. Weights that grow where the
tolerance is exceeded most tighten that bound (Lawson's algorithm), and lead to the configuration
whose largest error, as a part of its tolerance, is smallest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.solvers.trials import Bounds, Descent, Trials, allowed, repeated

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
    """What came closest.

    Attributes:
        q: (n,) configuration with the smallest squared error.
        fair: (n,) configuration with the smallest largest error.
        ratio: By which factor the tolerances would have to grow at least, near any of the minima.
    """

    q: Array
    fair: Array
    ratio: float


def closest(trials: Trials, problems: Problems, q: Array, limits: Bounds, followed: int) -> Closest:
    """Follow the best of some configurations of one target.

    Args:
        trials: The loop.
        problems: One target.
        q: (k, n).
        limits: To keep to.
        followed: How many at most.
    """
    tolerated = allowed(problems)
    counted = tolerated > 0
    cost = (trials.misses(repeated(problems, len(q)), q) ** 2).sum(axis=(1, 2))
    q = q[_distinct(cost, followed)]
    count = len(q)
    descent = Descent(trials, repeated(problems, count))
    total = float((tolerated**2).sum())
    weights = np.tile(counted.astype(float), (count, 1, 1))
    worst, bound = np.full(count, np.inf), np.zeros(count)
    fair, plain = q.copy(), q.copy()
    # Twice: the loop gives up where it gains little, which need not be at the minimum.
    q = descent.run(descent.run(q, limits), limits)
    rows, best = np.arange(count), np.inf
    for number in range(ROUNDS):
        q[rows] = descent.run(q[rows], limits, np.sqrt(weights[rows]), rows)
        misses = trials.misses(repeated(problems, len(rows)), q[rows])
        if number == 0:
            plain, cost = q.copy(), (misses**2).sum(axis=(1, 2))
        parts = np.where(counted, misses / np.where(counted, tolerated, 1.0), 0.0)
        largest = parts.max(axis=(1, 2))
        better = rows[largest < worst[rows]]
        fair[better] = q[better]
        worst[rows] = np.minimum(worst[rows], largest)
        squares = (weights[rows] * misses**2).sum(axis=(1, 2))
        bound[rows] = np.maximum(bound[rows], np.sqrt(squares / total))
        before, best = best, worst.min()
        stuck = best > (1 - SETTLED) * before
        if best <= 1 or (bound.min() > MARGIN and stuck) or bound.min() > (1 - SETTLED) * best:
            break
        # A minimum that cannot come closer than another one already has is followed no further.
        going = bound[rows] < best
        new = np.where(counted, np.maximum(weights[rows] * parts, LIGHTEST), 0.0)
        weights[rows] = new * (total / (new * tolerated**2).sum(axis=(1, 2)))[:, None, None]
        rows = rows[going]
    return Closest(plain[cost.argmin()], fair[worst.argmin()], float(bound.min()))


def _distinct(cost: Array, most: int) -> list[int]:
    """Indices of the smallest costs that differ, best first."""
    chosen: list[int] = []
    for i in np.argsort(cost):
        if not chosen or cost[i] > cost[chosen[-1]] * 1.001:
            chosen.append(int(i))
        if len(chosen) == most:
            break
    return chosen
