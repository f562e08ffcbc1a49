"""Hands drawn from the priors, measured, calibrated, and compared with what they truly are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.calibration import (
    Calibration,
    HandModel,
    Measurements,
    calibrate,
    simulate,
    true_values,
)

FINGER = "index"
NOISE = (2e-4, math.radians(0.5))
"""Of a measured coordinate [m] and angle [rad]: an assumption, of the size of marker tracking."""

POSES = 60
EXACT = (1e-9, 1e-9)


@dataclass(frozen=True, eq=False)
class Trials:
    """Estimates for many hands: h hands, k parameters.

    Attributes:
        deviations: (h, k) estimate minus truth, over the estimated standard deviation.
        misses: (h,) root mean square distance of the estimated tip from the true one [mm].
        described: (h,) the same of the description.
        noise: (h,) estimated noise of a coordinate over the true one.
        converged: (h,) whether the estimate converged.
        last: One of the estimates.
    """

    deviations: Array
    misses: Array
    described: Array
    noise: Array
    converged: NDArray[np.bool_]
    last: Calibration

    def coverage(self, level: float = 1.959964) -> float:
        """Part of the true numbers within so many standard deviations [%]."""
        return 100 * float(np.mean(np.abs(self.deviations) <= level))


def trials(
    model: HandModel,
    hands: int,
    seed: int,
    loss: str,
    outliers: float,
    poses: int = POSES,
    noise: tuple[float, float] = NOISE,
) -> Trials:
    """Calibrate hands drawn from the priors, each with its own data and random numbers."""
    rows = []
    for hand in range(hands):
        rng = np.random.default_rng([seed, hand])
        truth = true_values(model, rng)
        data = simulate(model, truth, FINGER, poses, rng, noise=noise, outliers=outliers)
        found = calibrate(model, data, loss=loss)
        fresh = simulate(model, truth, FINGER, 100, rng, noise=EXACT)
        miss, described = (
            tip_miss(model, values, fresh) for values in (found.values, model.nominal)
        )
        scaled = (found.values - truth) / found.deviation
        rows.append((scaled, miss, described, found.noise[0] / noise[0], found.converged, found))
    scaled, misses, described, ratios, converged, found = zip(*rows, strict=True)
    return Trials(
        np.array(scaled),
        np.array(misses),
        np.array(described),
        np.array(ratios),
        np.array(converged),
        found[-1],
    )


def tip_miss(model: HandModel, values: Array, exact: Measurements) -> float:
    """Root mean square distance of a model's tip from exact measurements [mm]."""
    error, _ = model.misfit(FINGER, exact.q, values, exact.poses)
    return 1e3 * float(np.sqrt((error[:, :3] ** 2).sum(axis=1).mean()))
