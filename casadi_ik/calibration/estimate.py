"""The estimate: maximum a posteriori, robust to outliers, with its covariance.

Gauss-Newton on whitened misfits and priors, reweighted for a robust loss (iteratively reweighted
least squares), the parameters within bounds. The noise is estimated from the data, so the standard
deviations given are only where that begins. Everything is computed in units of the priors: a
singular value s of the whitened Jacobian says how much more (s > 1) or less (s < 1) the data know
about a direction than the prior does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import proxsuite
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.calibration.losses import LOSSES, Loss
from casadi_ik.calibration.measurements import Measurements
from casadi_ik.calibration.model import HandModel
from casadi_ik.calibration.result import UNKNOWN, Calibration
from casadi_ik.errors import InputError, UnknownNameError

CHI_SQUARE_MEDIAN = 2.366
"""Median of the chi-square distribution of 3 degrees of freedom."""

FEWEST = 12
"""Measured numbers beyond those that the parameters can explain, so that noise can be seen."""

MAX_ITERATIONS = 60
SMALLEST_STEP = 1e-7
"""Step at which the iteration ends, in prior standard deviations."""


def calibrate(
    model: HandModel,
    measurements: Measurements,
    *,
    loss: str = "cauchy",
    sigma_position: float = 0.5e-3,
    sigma_angle: float = math.radians(1.0),
) -> Calibration:
    """Estimate the parameters of a model.

    Args:
        model: The description with its free numbers.
        measurements: Measured poses.
        loss: "cauchy" (the default), "huber", or "squares" (not robust).
        sigma_position: Noise of a measured coordinate [m] to begin with; with too few data to
            estimate it, it is taken as it is.
        sigma_angle: The same of a measured angle [rad].

    Raises:
        UnknownNameError: No such loss.
        InputError: A noise that is not positive.
    """
    if loss not in LOSSES:
        raise UnknownNameError(f"loss: found {loss!r}, expected one of {', '.join(LOSSES)}")
    for name, value in (("sigma_position", sigma_position), ("sigma_angle", sigma_angle)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: found {value!r}, expected a number > 0")
    fit = _Fit(model, measurements, LOSSES[loss])
    noise = np.array([sigma_position, sigma_angle])
    x = np.zeros(len(model.parameters))
    before, _ = fit.misfit(x)
    estimated = fit.enough()
    converged, steps = False, 0
    while not converged and steps < MAX_ITERATIONS:
        step = fit.step(x, noise)
        x, last = x + step, noise
        noise = fit.noise(x, last) if estimated else last
        converged = bool(np.abs(step).max() < SMALLEST_STEP)
        converged = converged and bool(np.allclose(noise, last, rtol=1e-4))
        steps += 1
    return fit.result(x, noise, estimated, before, steps, converged)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The least-squares problem; x are the parameters' deviations in units of the priors."""

    model: HandModel
    measurements: Measurements
    loss: Loss

    def misfit(self, x: Array) -> tuple[Array, Array]:
        """Errors (m, 6) [m, rad], 0 where not measured, and their Jacobian (m, 6, k) over x."""
        seen, model = self.measurements, self.model
        values = model.nominal + model.prior * x
        errors = np.zeros((len(seen), 6))
        jacobians = np.zeros((len(seen), 6, len(x)))
        for finger in seen.measured_fingers:
            rows = seen.rows(finger)
            found = model.misfit(finger, seen.q[rows], values, seen.poses[rows])
            errors[rows], jacobians[rows] = found[0], found[1] * model.prior
        errors[~seen.turned, 3:] = 0.0
        jacobians[~seen.turned, 3:] = 0.0
        return errors, jacobians

    def step(self, x: Array, noise: Array) -> Array:
        """A Gauss-Newton step within the bounds, halved until the cost does not rise."""
        errors, jacobians = self.misfit(x)
        white, rho, _ = self.whitened(errors, noise)
        roots = np.sqrt(self.loss.weight(rho))
        # Stacked, not squared: with good data some directions are known a billion times better.
        rows = np.vstack([_stacked(jacobians, noise, roots), np.eye(len(x))])
        right = -np.concatenate([(roots[:, None] * white).ravel(), x])
        lower, upper = self._bounds()
        step = np.asarray(np.linalg.lstsq(rows, right)[0], dtype=float)
        if np.any(x + step < lower) or np.any(x + step > upper):
            step = _in_box(rows.T @ rows, -rows.T @ right, lower - x, upper - x)
        start = self._cost(x, noise)
        for _ in range(12):
            if self._cost(x + step, noise) <= start * (1 + 1e-12):
                break
            step = 0.5 * step
        return step

    def whitened(self, errors: Array, noise: Array) -> tuple[Array, Array, Array]:
        """Errors over the noise (m, 6), their root mean squares (m,) and numbers (m,)."""
        white = errors / _each(noise)
        numbers = np.where(self.measurements.turned, 6.0, 3.0)
        return white, np.sqrt((white**2).sum(axis=1) / numbers), numbers

    def enough(self) -> bool:
        """Whether there are rows enough beyond what the parameters can explain."""
        _, jacobians = self.misfit(np.zeros(len(self.model.parameters)))
        rows = jacobians.reshape(-1, jacobians.shape[2])
        return self._rows() - int(np.linalg.matrix_rank(rows, rtol=UNKNOWN)) >= FEWEST

    def noise(self, x: Array, noise: Array) -> Array:
        """Standard deviations from the medians of the misfits, which outliers hardly move."""
        errors, jacobians = self.misfit(x)
        _, rho, _ = self.whitened(errors, noise)
        known, _ = self._known(jacobians, noise, self.loss.weight(rho))
        free = 1 - _used(known) / self._rows()
        turned = self.measurements.turned
        position = np.median((errors[:, :3] ** 2).sum(axis=1))
        estimate = [math.sqrt(position / CHI_SQUARE_MEDIAN / free), float(noise[1])]
        if turned.any():
            angle = np.median((errors[turned, 3:] ** 2).sum(axis=1))
            estimate[1] = math.sqrt(angle / CHI_SQUARE_MEDIAN / free)
        # Exact data have no noise; what is left of them is rounding.
        return np.maximum(np.array(estimate), 1e-8)

    def _rows(self) -> int:
        """How many numbers were measured."""
        return int(np.where(self.measurements.turned, 6, 3).sum())

    def _known(self, jacobians: Array, noise: Array, weights: Array) -> tuple[Array, Array]:
        """Singular values (k,) and directions (k, k) of the whitened, weighted Jacobian."""
        rows = _stacked(jacobians, noise, np.sqrt(weights))
        few = len(rows) < rows.shape[1]  # else the directions are complete without the rest of U
        _, known, directions = np.linalg.svd(rows, full_matrices=few)
        return np.concatenate([known, np.zeros(len(directions) - len(known))]), directions

    def result(
        self, x: Array, noise: Array, estimated: bool, before: Array, steps: int, converged: bool
    ) -> Calibration:
        """The estimate with all that is said about it; `estimated`: the noise is from the data."""
        errors, jacobians = self.misfit(x)
        _, rho, numbers = self.whitened(errors, noise)
        weights = self.loss.weight(rho)
        eye = np.eye(len(x))

        def information(share: Array) -> Array:
            rows = _stacked(jacobians, noise, np.sqrt(share))
            return rows.T @ rows

        # Sandwich of an M-estimator with a prior: curvature outside, variance of the score inside.
        curved = _stacked(jacobians, noise, np.sqrt(self.loss.slope(rho, numbers)))
        _, sizes, turns = np.linalg.svd(np.vstack([curved, eye]), full_matrices=False)
        outer = (turns.T / sizes**2) @ turns
        known, directions = self._known(jacobians, noise, weights)
        # Where there are too few data to see the scatter, the noise that was assumed stands for it.
        scatter = (weights * rho) ** 2 / (1 - _used(known) / self._rows())
        share = scatter if estimated else self.loss.slope(rho, numbers)
        inner = information(share) + eye
        prior = self.model.prior
        covariance = np.outer(prior, prior) * (outer @ inner @ outer)
        turned = self.measurements.turned
        return Calibration(
            parameters=self.model.parameters,
            values=self.model.nominal + prior * x,
            covariance=0.5 * (covariance + covariance.T),
            singular_values=known,
            directions=directions,
            weights=weights,
            noise=(float(noise[0]), float(noise[1]) if turned.any() else math.nan),
            noise_estimated=estimated,
            before=_sizes(before, turned),
            after=_sizes(errors, turned),
            iterations=steps,
            converged=converged,
        )

    def _cost(self, x: Array, noise: Array) -> float:
        errors, _ = self.misfit(x)
        _, rho, numbers = self.whitened(errors, noise)
        return float((numbers * self.loss.cost(rho)).sum() + 0.5 * x @ x)

    def _bounds(self) -> tuple[Array, Array]:
        bounds = np.array([parameter.bounds for parameter in self.model.parameters])
        scaled = (bounds - self.model.nominal[:, None]) / self.model.prior[:, None]
        return scaled[:, 0], scaled[:, 1]


def _stacked(jacobians: Array, noise: Array, roots: Array) -> Array:
    """Whitened Jacobians (m, 6, k) as rows (6 m, k), each measurement times its root weight."""
    scaled = jacobians * (roots[:, None] / _each(noise))[:, :, None]
    return scaled.reshape(-1, jacobians.shape[2])


def _used(known: Array) -> float:
    """How many of the measured numbers the estimate follows, by its singular values."""
    return float((known**2 / (known**2 + 1)).sum())


def _each(noise: Array) -> Array:
    return np.repeat(noise, 3)


def _sizes(errors: Array, turned: NDArray[np.bool_]) -> Array:
    angles = np.where(turned, np.linalg.norm(errors[:, 3:], axis=1), np.nan)
    return np.column_stack([np.linalg.norm(errors[:, :3], axis=1), angles])


def _in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """Minimiser of x' H x / 2 + g' x within bounds."""
    n = len(gradient)
    result = proxsuite.proxqp.dense.solve(
        hessian, gradient, None, None, np.eye(n), lower, upper, eps_abs=1e-10
    )
    return np.clip(np.array(result.x), lower, upper)
