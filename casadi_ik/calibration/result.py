"""What a calibration says: the estimates, how certain they are, and what the data cannot know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.calibration.parameters import Parameter

NORMAL_95 = 1.959964
"""95 % of a normal variable lie within so many standard deviations."""

UNKNOWN = 1e-6
"""Singular value, relative to the largest, below which the data say nothing at all."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What the data say about the parameters; m measurements, k parameters.

    Attributes:
        parameters: The parameters.
        values: (k,) estimates.
        covariance: (k, k) of the estimates.
        singular_values: (k,) of the whitened Jacobian in units of the priors, descending.
        directions: (k, k) their directions in units of the priors, one per row.
        weights: (m,) weight of each measurement, 1 where it is taken in full.
        noise: Standard deviations of a measured coordinate [m] and angle [rad]; NaN if no
            orientation was measured.
        noise_estimated: Whether the noise is from the data; with too few it is what was assumed.
        before: (m, 2) misfit of the description: distance [m] and angle [rad, NaN].
        after: (m, 2) the same of the estimate.
        iterations: Gauss-Newton steps.
        converged: Whether the last step was small enough.
    """

    parameters: tuple[Parameter, ...]
    values: Array
    covariance: Array
    singular_values: Array
    directions: Array
    weights: Array
    noise: tuple[float, float]
    noise_estimated: bool
    before: Array
    after: Array
    iterations: int
    converged: bool

    @property
    def deviation(self) -> Array:
        """(k,) standard deviations of the estimates."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def interval(self) -> Array:
        """(k,) half widths of the 95 % intervals."""
        return NORMAL_95 * self.deviation

    @property
    def learned(self) -> Array:
        """(k,) part of the prior's variance that the data took away: 0 nothing, 1 all."""
        prior = np.array([parameter.prior for parameter in self.parameters])
        return np.clip(1 - (self.deviation / prior) ** 2, 0.0, 1.0)

    @property
    def outliers(self) -> NDArray[np.intp]:
        """Rows that count less than a quarter."""
        return np.flatnonzero(self.weights < 0.25)

    def unidentified(self, below: float = 1.0) -> list[tuple[float, dict[str, float]]]:
        """Directions about which the data say less than the priors.

        Args:
            below: Singular value up to which a direction counts.

        Returns:
            Singular value and the larger components by parameter, the worst first.
        """
        found = []
        for value, direction in zip(self.singular_values, self.directions, strict=True):
            if value < below:
                large = np.flatnonzero(np.abs(direction) > 0.3 * np.abs(direction).max())
                order = large[np.argsort(-np.abs(direction[large]))]
                names = {self.parameters[i].name: float(direction[i]) for i in order}
                found.append((float(value), names))
        return found[::-1]

    @property
    def unknown_directions(self) -> int:
        """How many directions the data say nothing at all about."""
        return int(np.sum(self.singular_values < UNKNOWN * self.singular_values[0]))
