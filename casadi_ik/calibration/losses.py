"""How much a misfit counts: least squares, or less the further out it lies.

All are functions of rho, the root mean square of a measurement's components over their noise, which
is near 1 where noise is all there is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array

CAUCHY, HUBER = 2.385, 1.345
"""Tuning constants for 95 % efficiency on one normal component (Holland & Welsch 1977)."""


@dataclass(frozen=True)
class Loss:
    """A loss.

    Attributes:
        cost: What a component of a measurement costs.
        weight: Weight of a measurement in the normal equations, cost' / rho.
        slope: Its share in the mean curvature, weight + rho weight' / m over m components.
    """

    cost: Callable[[Array], Array]
    weight: Callable[[Array], Array]
    slope: Callable[[Array, Array], Array]


def _cauchy_cost(rho: Array) -> Array:
    return 0.5 * CAUCHY**2 * np.log1p((rho / CAUCHY) ** 2)


def _cauchy_weight(rho: Array) -> Array:
    return 1 / (1 + (rho / CAUCHY) ** 2)


def _cauchy_slope(rho: Array, m: Array) -> Array:
    weight = _cauchy_weight(rho)
    return weight - 2 * (weight * rho / CAUCHY) ** 2 / m


def _huber_cost(rho: Array) -> Array:
    return np.where(rho <= HUBER, 0.5 * rho**2, HUBER * (rho - 0.5 * HUBER))


def _huber_weight(rho: Array) -> Array:
    return HUBER / np.maximum(rho, HUBER)


def _huber_slope(rho: Array, m: Array) -> Array:
    return np.where(rho <= HUBER, 1.0, _huber_weight(rho) * (1 - 1 / m))


LOSSES = {
    "cauchy": Loss(_cauchy_cost, _cauchy_weight, _cauchy_slope),
    "huber": Loss(_huber_cost, _huber_weight, _huber_slope),
    "squares": Loss(lambda rho: 0.5 * rho**2, np.ones_like, lambda rho, _: np.ones_like(rho)),
}
"""The losses by name."""
