"""When a robot is where on a path: as fast as velocities and accelerations permit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import MissingExtraError
from casadi_ik.motion.rates import Rates

SAME = 1e-9
"""Postures nearer to each other than this are one [rad or m]."""

GRID = 200
"""Places of a path at which its speed is found, at least."""

SPARE = 0.99
"""Part of the limits that the speed is found for: between the places it is a little higher."""


@dataclass(frozen=True, eq=False)
class Timed:
    """A path in time: (m,) seconds from 0 on, and (m, n) each."""

    times: Array
    q: Array
    velocity: Array
    acceleration: Array


def timed(path: Array, rates: Rates, period: float) -> Timed:
    """A path from rest to rest, by TOPP-RA (Pham & Pham 2018).

    Args:
        path: (k, n) postures, passed on a smooth curve.
        rates: The limits.
        period: Time between two samples [s].

    Raises:
        MissingExtraError: toppra is not installed.
    """
    try:
        import toppra
        from toppra import algorithm, constraint
    except ImportError as error:
        raise MissingExtraError(
            "timing needs toppra, which is not installed: pip install casadi-ik[motion]"
        ) from error
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    kept = path[np.concatenate([[True], steps > SAME])]
    if len(kept) < 2:
        still = np.zeros((1, path.shape[1]))
        return Timed(np.zeros(1), path[:1], still, still)
    toppra.setup_logging("ERROR")
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(kept, axis=0), axis=1))])
    curve = toppra.SplineInterpolator(along / along[-1], kept)
    both = rates.velocity, rates.acceleration
    fastest, strongest = (SPARE * np.stack([-most, most], axis=1) for most in both)
    asked = [
        constraint.JointVelocityConstraint(fastest),
        constraint.JointAccelerationConstraint(strongest),
    ]
    grid = np.linspace(0.0, 1.0, max(GRID, 4 * len(kept)))
    found = algorithm.TOPPRA(asked, curve, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    way: Any = found.compute_trajectory()
    assert way is not None
    count = max(2, math.ceil(way.duration / period) + 1)
    seconds = np.linspace(0.0, way.duration, count)
    velocity, acceleration = way(seconds, 1), way(seconds, 2)
    stretch = max(
        1.0,
        float((np.abs(velocity) / rates.velocity).max()),
        math.sqrt(float((np.abs(acceleration) / rates.acceleration).max())),
    )
    return Timed(seconds * stretch, way(seconds), velocity / stretch, acceleration / stretch**2)
