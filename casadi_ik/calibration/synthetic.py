"""Measurements as a camera would make them, of a hand whose true dimensions are known."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.calibration.measurements import Measurements
from casadi_ik.calibration.model import HandModel
from casadi_ik.kernels import FunctionKernel
from casadi_ik.symbolic import dual_quaternion as dq
from casadi_ik.symbolic.tip_motion import finger_chain


def true_values(model: HandModel, rng: np.random.Generator) -> Array:
    """(k,) parameters of a hand that the description's priors could mean.

    Args:
        model: The model; deviations are normal with its priors, cut at 2.5 of them.
        rng: Source of the deviations.
    """
    deviations = np.clip(rng.standard_normal(len(model.prior)), -2.5, 2.5)
    return model.nominal + model.prior * deviations


def simulate(
    model: HandModel,
    values: Array,
    finger: str,
    count: int,
    rng: np.random.Generator,
    *,
    noise: tuple[float, float] = (2e-4, np.deg2rad(0.5)),
    outliers: float = 0.0,
    factor: float = 20.0,
) -> Measurements:
    """Poses of a fingertip at random actuator positions, with noise.

    Args:
        model: The model.
        values: (k,) its true parameters.
        finger: The finger that is measured.
        count: How many poses.
        rng: Source of positions and noise.
        noise: Standard deviations of a coordinate [m] and of an angle [rad].
        outliers: Part of the poses whose noise is `factor` times as large.
        factor: See `outliers`.
    """
    robot = model.robot
    columns = list(finger_chain(robot, finger).actuators)
    q = np.tile(robot.home, (count, 1))
    q[:, columns] = rng.uniform(robot.lower[columns], robot.upper[columns], (count, len(columns)))
    scale = np.where(rng.random(count) < outliers, factor, 1.0)[:, None]
    shifts = noise[0] * scale * rng.standard_normal((count, 3))
    turns = noise[1] * scale * rng.standard_normal((count, 3))
    (seen,) = _displaced()(model.poses(finger, q, values), turns, shifts)
    return Measurements((finger,) * count, q, seen, np.ones(count, dtype=bool))


@cache
def _displaced() -> FunctionKernel:
    """A pose turned about its own point and shifted, both in the base frame."""
    pose, turn, shift = ca.SX.sym("pose", 8), ca.SX.sym("turn", 3), ca.SX.sym("shift", 3)
    turned = dq.quaternion_multiply(dq.exp(turn, ca.DM.zeros(3, 1))[:4], pose[:4])
    moved = dq.from_quaternion(turned, dq.translation(pose) + shift)
    return FunctionKernel(ca.Function("displaced_pose", [pose, turn, shift], [moved]))
