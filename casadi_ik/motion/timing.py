"""When a robot is where on a path: as fast as velocities and accelerations permit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import MissingExtraError
from casadi_ik.motion.rates import Rates, shares

SAME = 1e-9
"""A shorter way is none [rad or m]."""

TINY = 1e-6
"""A posture is left out that is nearer to the next than this part of the whole way."""

GRID = 200
"""Places of a path at which its speed is found, at least."""

SPARE = 0.99
"""Part of the limits that the speed is found for: between the places it is a little higher."""

BEFORE = 0.1
"""How far before a posture the speed is found, too, as a part of the way from the place before."""


def timed(path: Array, rates: Rates, period: float) -> Array:
    """A path from rest to rest, by TOPP-RA (Pham & Pham 2018).

    The curve through the postures is cubic between each two and never leaves what lies between them
    (Fritsch & Carlson 1980), so that it keeps to limits that the postures keep to. Its second
    derivative is a straight line from posture to posture and leaps there: the acceleration limits
    are asked for at both ends of every stretch between the places where the speed is found, and
    these are before, at and between postures. What counts in the end is what is sent: where the
    first and second differences of the samples take more than the limits, the whole is slower.

    Args:
        path: (k, n) postures, passed on a smooth curve.
        rates: The limits.
        period: Time between two samples [s].

    Returns:
        (m, n) where the motors are, one period after the other; both ends are those of the path.

    Raises:
        MissingExtraError: toppra is not installed.
    """
    try:
        import toppra
        from scipy.interpolate import PchipInterpolator
        from toppra import algorithm, constraint
        from toppra.simplepath import SimplePath
    except ImportError as error:
        raise MissingExtraError(
            "timing needs toppra, which is not installed: pip install casadi-ik[motion]"
        ) from error
    lengths = np.abs(np.diff(path, axis=0)).sum(axis=0)
    if not lengths.max(initial=0.0) > SAME:
        return path[:1]
    toppra.setup_logging("ERROR")
    # In units of what it may take and what a motor goes in it at full acceleration: near one.
    takes = max(lengths / rates.velocity) + math.sqrt(max(lengths / rates.acceleration))
    unit = rates.acceleration * takes**2
    ways = np.linalg.norm(np.diff(path / unit, axis=0), axis=1)
    kept = path[np.append(ways > TINY * ways.sum(), True)] / unit
    ways = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    along = np.append(0.0, np.cumsum(ways))
    along /= along[-1]
    slopes = PchipInterpolator(along, kept).derivative()(along)
    fastest, strongest = SPARE * rates.velocity * takes / unit, np.full(len(unit), SPARE)
    both_ends = constraint.DiscretizationType.Interpolation
    asked = [
        constraint.JointVelocityConstraint(np.stack([-fastest, fastest], axis=1)),
        constraint.JointAccelerationConstraint(
            np.stack([-strongest, strongest], axis=1), discretization_scheme=both_ends
        ),
    ]
    cuts = max(2, math.ceil(GRID / (len(kept) - 1)))
    parts = np.linspace(0.0, 1.0, cuts, endpoint=False)
    way: Any = None
    # The short stretches before postures are sometimes too short for its linear programs.
    for some in (np.append(parts, 1.0 - BEFORE / cuts), parts):
        grid = np.append((along[:-1, None] + np.diff(along)[:, None] * some).ravel(), 1.0)
        way = algorithm.TOPPRA(
            asked,
            SimplePath(along, kept, slopes),
            gridpoints=grid,
            parametrizer="ParametrizeConstAccel",
        ).compute_trajectory()
        if way is not None:
            break
    assert way is not None
    count = math.ceil(takes * way.duration / period)
    while True:
        q = unit * way(np.linspace(0.0, way.duration, count + 1))
        q = np.clip(q, path.min(axis=0), path.max(axis=0))  # of rounding
        q[0], q[-1] = path[0], path[-1]
        velocity, acceleration = shares(q, period, rates)
        over = max(velocity, math.sqrt(acceleration))
        if over <= 1.0:
            return q
        count = max(count + 1, math.ceil(count * over))
