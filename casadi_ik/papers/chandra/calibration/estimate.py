"""Robust maximum-a-posteriori estimate of parameters, and the calibrated description.

The estimate uses Gauss-Newton steps on whitened residuals and priors within bounds, reweighted for
a robust loss (iteratively reweighted least squares). The noise is estimated from the data; the
given standard deviations are initial values. Units are those of the priors: a singular value s of
the whitened Jacobian compares the information of the data about a direction with that of the prior
(s > 1: data dominate, s < 1: prior dominates).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import yaml
from numpy.typing import NDArray

from casadi_ik.errors import InputError, UnknownNameError, optional_import
from casadi_ik.files.arrays import Array
from casadi_ik.files.reading import Frame, frame_matrix, read_yaml
from casadi_ik.files.shipped import resolve_description
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.kinematics.se3 import exp_so3, matrix_to_rpy
from casadi_ik.model.load_robot import load_description
from casadi_ik.papers.chandra.calibration.measurements import Measurements
from casadi_ik.papers.chandra.calibration.model import HandModel, Parameter, tilted

with optional_import("calibration"):
    from scipy.optimize import lsq_linear

CAUCHY, HUBER = 2.385, 1.345
"""Tuning constants for 95 % efficiency on one normal component (Holland & Welsch 1977)."""


@dataclass(frozen=True)
class Loss:
    """A robust loss function.

    Attributes:
        cost: Cost of a component of a measurement.
        weight: Weight of a measurement in the normal equations, cost' / rho.
        slope: Contribution to the mean curvature, weight + rho weight' / m over m components, from
            weight, rho and m.
    """

    cost: Callable[[Array], Array]
    weight: Callable[[Array], Array]
    slope: Callable[[Array, Array, Array], Array]


LOSSES = {
    "cauchy": Loss(
        cost=lambda rho: 0.5 * CAUCHY**2 * np.log1p((rho / CAUCHY) ** 2),
        weight=lambda rho: 1 / (1 + (rho / CAUCHY) ** 2),
        slope=lambda weight, rho, m: weight - 2 * (weight * rho / CAUCHY) ** 2 / m,
    ),
    "huber": Loss(
        cost=lambda rho: np.where(rho <= HUBER, 0.5 * rho**2, HUBER * (rho - 0.5 * HUBER)),
        weight=lambda rho: HUBER / np.maximum(rho, HUBER),
        slope=lambda weight, rho, m: np.where(rho <= HUBER, 1.0, weight * (1 - 1 / m)),
    ),
    "squares": Loss(lambda rho: 0.5 * rho**2, np.ones_like, lambda weight, *_: weight),
}
"""Loss functions by name."""


NORMAL_95 = 1.959964
"""Half width of the central 95 % interval of a normal variable [standard deviations]."""


@dataclass(frozen=True)
class EstimateSettings:
    """Settings of the estimate.

    Attributes:
        min_singular_value: Singular value, relative to the largest, below which the data contain no
            information about a direction.
        min_redundancy: Minimum number of redundant measured values for an estimate of the noise.
        max_iterations: Maximum number of steps.
        smallest_step: Step length at which the iteration ends [prior standard deviations].
    """

    min_singular_value: float = 1e-6
    min_redundancy: int = 12
    max_iterations: int = 60
    smallest_step: float = 1e-7


SETTINGS = EstimateSettings()


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration with m measurements and k parameters.

    Attributes:
        parameters: Estimated parameters.
        values: (k,) estimates.
        covariance: (k, k) covariance of the estimates.
        singular_values: (k,) singular values of the whitened Jacobian in units of the priors, in
            descending order.
        directions: (k, k) right singular vectors in units of the priors, one per row.
        weights: (m,) weight of each measurement, 1 for an inlier.
        noise: Standard deviations of a measured coordinate [m] and angle [rad]; NaN if no
            orientation was measured.
        noise_estimated: True if the noise is estimated, False if it is the assumed noise because of
            too few data.
        before: (m, 2) errors of the initial description: distance [m] and angle [rad, NaN].
        after: (m, 2) errors of the estimate.
        iterations: Number of Gauss-Newton steps.
        converged: True if the last step was small enough.
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
        """Fraction of the variance of the prior that the data remove (k,): 0 none, 1 all."""
        prior = np.array([parameter.prior for parameter in self.parameters])
        return np.clip(1 - (self.deviation / prior) ** 2, 0.0, 1.0)

    @property
    def outliers(self) -> NDArray[np.intp]:
        """Rows with a weight below 0.25."""
        return np.flatnonzero(self.weights < 0.25)

    def unidentified(self, below: float = 1.0) -> list[tuple[float, dict[str, float]]]:
        """Return the directions about which the data contain less information than the priors.

        Args:
            below: Singular value up to which a direction counts.

        Returns:
            Singular value and the larger components by parameter, the worst first.
        """
        directions = []
        for value, direction in zip(self.singular_values, self.directions, strict=True):
            if value < below:
                large = np.flatnonzero(np.abs(direction) > 0.3 * np.abs(direction).max())
                order = large[np.argsort(-np.abs(direction[large]))]
                names = {self.parameters[i].name: float(direction[i]) for i in order}
                directions.append((float(value), names))
        return directions[::-1]

    @property
    def unknown_directions(self) -> int:
        """Number of directions about which the data contain no information."""
        return int(
            np.sum(self.singular_values < SETTINGS.min_singular_value * self.singular_values[0])
        )


CHI_SQUARE_MEDIAN = 2.366
"""Median of the chi-square distribution of 3 degrees of freedom."""


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
        model: Description with free parameters.
        measurements: Measured poses.
        loss: "cauchy" (the default), "huber", or "squares" (not robust).
        sigma_position: Initial value of the noise of a measured coordinate, which is not changed if
            there are too few data to estimate it [m].
        sigma_angle: Initial value of the noise of a measured angle [rad].

    Raises:
        UnknownNameError: The loss does not exist.
        InputError: A standard deviation is not positive.
    """
    if loss not in LOSSES:
        raise UnknownNameError(f"loss: found {loss!r}, expected one of {', '.join(LOSSES)}")
    for name, value in (("sigma_position", sigma_position), ("sigma_angle", sigma_angle)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: found {value!r}, expected a number > 0")
    fit = _Fit(model, measurements, LOSSES[loss])
    noise = np.array([sigma_position, sigma_angle])
    x = np.zeros(len(model.parameters))
    initial_errors, _ = fit.misfit(x)
    estimates_noise = fit.can_estimate_noise()
    converged, steps = False, 0
    while not converged and steps < SETTINGS.max_iterations:
        step = fit.step(x, noise)
        x, previous_noise = x + step, noise
        noise = fit.noise(x, previous_noise) if estimates_noise else previous_noise
        converged = bool(np.abs(step).max() < SETTINGS.smallest_step)
        converged = converged and bool(np.allclose(noise, previous_noise, rtol=1e-4))
        steps += 1
    return fit.result(x, noise, estimates_noise, initial_errors, steps, converged)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Least-squares problem; x are deviations of the parameters in units of the priors."""

    model: HandModel
    measurements: Measurements
    loss: Loss

    def misfit(self, x: Array) -> tuple[Array, Array]:
        """Return errors (m, 6) [m, rad], 0 if not measured, and their Jacobian by x (m, 6, k)."""
        measurements, model = self.measurements, self.model
        values = model.nominal + model.prior * x
        errors = np.zeros((len(measurements), 6))
        jacobians = np.zeros((len(measurements), 6, len(x)))
        for finger in measurements.measured_fingers:
            rows = measurements.rows(finger)
            residuals = model.misfit(finger, measurements.q[rows], values, measurements.poses[rows])
            errors[rows], jacobians[rows] = residuals[0], residuals[1] * model.prior
        errors[~measurements.has_orientation, 3:] = 0.0
        jacobians[~measurements.has_orientation, 3:] = 0.0
        return errors, jacobians

    def step(self, x: Array, noise: Array) -> Array:
        """Return a Gauss-Newton step within the bounds, halved until the cost does not rise."""
        errors, jacobians = self.misfit(x)
        white, rho, _ = self.whitened(errors, noise)
        roots = np.sqrt(self.loss.weight(rho))
        # The rows are stacked: normal equations would square the condition number, which good data
        # make as large as 1e9.
        rows = np.vstack([_stacked(jacobians, noise, roots), np.eye(len(x))])
        right = -np.concatenate([(roots[:, None] * white).ravel(), x])
        lower, upper = self._bounds()
        step = lsq_linear(rows, right, (lower - x, upper - x), method="bvls").x
        start = self._cost(x, noise)
        for _ in range(12):
            if self._cost(x + step, noise) <= start * (1 + 1e-12):
                break
            step = 0.5 * step
        return step

    def whitened(self, errors: Array, noise: Array) -> tuple[Array, Array, Array]:
        """Return errors over the noise (m, 6), their root mean squares (m,) and numbers (m,)."""
        white = errors / _noise_by_component(noise)
        numbers = np.where(self.measurements.has_orientation, 6.0, 3.0)
        return white, np.sqrt((white**2).sum(axis=1) / numbers), numbers

    def can_estimate_noise(self) -> bool:
        """Return True if there are enough redundant measured values to estimate the noise."""
        _, jacobians = self.misfit(np.zeros(len(self.model.parameters)))
        rows = jacobians.reshape(-1, jacobians.shape[2])
        rank = int(np.linalg.matrix_rank(rows, rtol=SETTINGS.min_singular_value))
        return self._rows() - rank >= SETTINGS.min_redundancy

    def noise(self, x: Array, noise: Array) -> Array:
        """Return standard deviations from medians of the errors, which are robust to outliers."""
        errors, jacobians = self.misfit(x)
        _, rho, _ = self.whitened(errors, noise)
        singular_values, _ = self._singular_directions(jacobians, noise, self.loss.weight(rho))
        free = 1 - _effective_parameters(singular_values) / self._rows()
        has_angle = self.measurements.has_orientation
        position = np.median((errors[:, :3] ** 2).sum(axis=1))
        estimate = [math.sqrt(position / CHI_SQUARE_MEDIAN / free), float(noise[1])]
        if has_angle.any():
            angle = np.median((errors[has_angle, 3:] ** 2).sum(axis=1))
            estimate[1] = math.sqrt(angle / CHI_SQUARE_MEDIAN / free)
        # Exact data have no noise but rounding errors.
        return np.maximum(np.array(estimate), 1e-8)

    def _rows(self) -> int:
        """Return the number of measured values."""
        return int(np.where(self.measurements.has_orientation, 6, 3).sum())

    def _singular_directions(
        self, jacobians: Array, noise: Array, weights: Array
    ) -> tuple[Array, Array]:
        """Return singular values (k,) and directions (k, k) of the whitened, weighted Jacobian."""
        rows = _stacked(jacobians, noise, np.sqrt(weights))
        few = len(rows) < rows.shape[1]  # else the directions are complete without the rest of U
        _, singular_values, directions = np.linalg.svd(rows, full_matrices=few)
        return np.concatenate(
            [singular_values, np.zeros(len(directions) - len(singular_values))]
        ), directions

    def result(
        self,
        x: Array,
        noise: Array,
        estimated: bool,
        initial_errors: Array,
        steps: int,
        converged: bool,
    ) -> Calibration:
        """Return the calibration; `estimated` is True if the noise is estimated."""
        errors, jacobians = self.misfit(x)
        _, rho, numbers = self.whitened(errors, noise)
        weights = self.loss.weight(rho)
        eye = np.eye(len(x))

        def information(share: Array) -> Array:
            rows = _stacked(jacobians, noise, np.sqrt(share))
            return rows.T @ rows

        # Sandwich of an M-estimator with a prior: curvature outside, variance of the score inside.
        curved = _stacked(jacobians, noise, np.sqrt(self.loss.slope(weights, rho, numbers)))
        _, sizes, right_vectors = np.linalg.svd(np.vstack([curved, eye]), full_matrices=False)
        outer = (right_vectors.T / sizes**2) @ right_vectors
        singular_values, directions = self._singular_directions(jacobians, noise, weights)
        # With too few data the assumed noise replaces the estimated scatter.
        scatter = (weights * rho) ** 2 / (1 - _effective_parameters(singular_values) / self._rows())
        share = scatter if estimated else self.loss.slope(weights, rho, numbers)
        inner = information(share) + eye
        prior = self.model.prior
        covariance = np.outer(prior, prior) * (outer @ inner @ outer)
        has_angle = self.measurements.has_orientation
        return Calibration(
            parameters=self.model.parameters,
            values=self.model.nominal + prior * x,
            covariance=0.5 * (covariance + covariance.T),
            singular_values=singular_values,
            directions=directions,
            weights=weights,
            noise=(float(noise[0]), float(noise[1]) if has_angle.any() else math.nan),
            noise_estimated=estimated,
            before=_error_norms(initial_errors, has_angle),
            after=_error_norms(errors, has_angle),
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
    """Return whitened Jacobians (m, 6, k), times root weights, as rows (6 m, k)."""
    scaled = jacobians * (roots[:, None] / _noise_by_component(noise))[:, :, None]
    return scaled.reshape(-1, jacobians.shape[2])


def _effective_parameters(singular_values: Array) -> float:
    """Return the effective number of parameters from the singular values."""
    return float((singular_values**2 / (singular_values**2 + 1)).sum())


def _noise_by_component(noise: Array) -> Array:
    return np.repeat(noise, 3)


def _error_norms(errors: Array, has_angle: NDArray[np.bool_]) -> Array:
    angles = np.where(has_angle, np.linalg.norm(errors[:, 3:], axis=1), np.nan)
    return np.column_stack([np.linalg.norm(errors[:, :3], axis=1), angles])


TAG = "calibration"
"""Source tag of estimated values."""

GRID = 201
"""Number of samples per stroke for the range of a coupled joint."""

MARGIN = 1e-3
"""Margin of widened joint limits beyond the range of the strokes [rad]."""


def write_description(
    calibration: Calibration, robot: str | Path, path: Path, origin: str = ""
) -> None:
    """Write the robot with its estimated parameters, with the hand in the same file.

    Joint limits that the calibrated couplings exceed within the stroke of their actuator are
    widened, because such limits follow from the stroke.

    Args:
        calibration: Result of `calibrate`.
        robot: Calibrated robot, a shipped name or a path.
        path: Output file.
        origin: Origin of the data, for the list of sources.

    Raises:
        InputError: The joints of the robot are not described in YAML.
        OSError: The file cannot be written.
    """
    top_path = resolve_description(robot, "arm_hands")
    top = read_yaml(top_path)
    if any(isinstance(part, dict) and "file" in part for part in top.values()):
        raise InputError(
            f"{top_path}: a calibrated robot is written joint by joint, but this one's joints are "
            "in files of others"
        )
    if isinstance(top["hand"], str):
        top["hand"] = read_yaml(resolve_description(top["hand"], "hands", relative_to=top_path))
    if top.get("arm") is not None and Path(top["arm"]).suffix:
        top["arm"] = str(resolve_description(top["arm"], "arms", relative_to=top_path).resolve())
    hand = top["hand"]
    hand["sources"][TAG] = (
        f"Estimated from {len(calibration.weights)} measured fingertip poses{origin and ' in '}"
        f"{origin}."
    )
    values = zip(calibration.parameters, calibration.values.tolist(), strict=True)
    by_owner: dict[tuple[str, str], dict[str, float]] = {}
    for parameter, value in values:
        by_owner.setdefault((parameter.owner, parameter.part), {})[parameter.key] = value
    joints = {joint["name"]: joint for joint in hand["joints"]}
    for (owner, part), numbers in by_owner.items():
        entry = joints[owner] if part in ("coupling", "origin", "axis") else hand["fingers"][owner]
        _PARTS[part](entry, numbers)
        if TAG not in entry["source"].split():
            entry["source"] += f" {TAG}"
    _write(top, path)
    _widen(joints, {owner for (owner, part) in by_owner if part == "coupling"}, path)
    _write(top, path)


def _set_coupling(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["coupling"] |= numbers


def _set_origin(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["origin"] = entry.get("origin", {}) | {"xyz": [numbers[key] for key in "xyz"]}


def _set_axis(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    axis = np.asarray(entry["axis"], dtype=float)
    axis_estimate = tilted(axis / np.linalg.norm(axis), ca.DM([numbers["1"], numbers["2"]]))
    entry["axis"] = np.array(axis_estimate).ravel().tolist()


def _set_tip(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    entry["xyz"] = [numbers[key] for key in "xyz"]


def _set_rotation(entry: dict[str, Any], numbers: dict[str, float]) -> None:
    R_before = frame_matrix(Frame(rpy=tuple(entry.get("rpy", (0.0, 0.0, 0.0)))))[:3, :3]
    R_after = ca.DM(R_before) @ exp_so3(ca.DM([numbers[key] for key in "xyz"]))
    entry["rpy"] = np.array(matrix_to_rpy(R_after)).ravel().tolist()


_PARTS = {
    "coupling": _set_coupling,
    "origin": _set_origin,
    "axis": _set_axis,
    "tip": _set_tip,
    "turn": _set_rotation,
}


def _widen(joints: dict[str, dict[str, Any]], names: set[str], path: Path) -> None:
    """Widen the limits of coupled joints to the range of their actuators' strokes."""
    robot = load_description(path)
    q = ca.SX.sym("q", len(robot.actuators))
    positions = ca.Function("joints", [q], [joint_positions(robot, q)])
    # Every mechanism depends on one actuator, so that all strokes are sampled simultaneously.
    strokes = np.linspace(*robot.actuator_limits, GRID)
    ranges = np.array(positions(strokes.T))
    for joint, values in zip(robot.movable, ranges, strict=True):
        if joint.name in names and joint.coupling is not None and joint.coupling.slope is None:
            low, high = float(values.min()), float(values.max())
            joints[joint.name]["limits"] = [
                joint.lower if low >= joint.lower else low - MARGIN,
                joint.upper if high <= joint.upper else high + MARGIN,
            ]


def _write(data: dict[str, Any], path: Path) -> None:
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    path.write_text(text, encoding="utf-8")
