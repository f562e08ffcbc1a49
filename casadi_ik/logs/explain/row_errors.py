"""How far every finger is off in every row of a solve."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.logs.read.one_solve import OneSolve


def within(solve: OneSolve) -> NDArray[np.bool_]:
    """Whether each finger is within tolerance in each row, (k, f).

    What is free always is; what was not yet measured is not.
    """
    position, angle = errors_of(solve)
    near = (position <= solve.position_tolerance) | np.isnan(solve.position_error)
    return near & ((angle <= solve.angle_tolerance) | np.isnan(solve.angle_error))


def worst(solve: OneSolve) -> Array:
    """Error of the worst finger in multiples of its tolerance, (k,); inf if not yet measured."""
    position, angle = errors_of(solve)
    share = np.fmax(
        np.nanmax(position / solve.position_tolerance, axis=1, initial=0.0),
        np.nanmax(angle / solve.angle_tolerance, axis=1, initial=0.0),
    )
    share[np.isnan(np.hstack([position, angle])).all(axis=1)] = np.inf
    return share


def errors_of(solve: OneSolve) -> tuple[Array, Array]:
    """Distances [m] and angles [rad] of all fingers in each row, (k, f) each.

    A row in which they were not measured (NaN) has those of the row before; what is free is NaN.
    """
    position, angle = solve.columns("position_error"), solve.columns("angle_error")
    position[:, np.isnan(solve.position_error)] = np.nan
    angle[:, np.isnan(solve.angle_error)] = np.nan
    return _filled(position), _filled(angle)


def _filled(matrix: Array) -> Array:
    rows = np.arange(len(matrix))[:, None]
    last = np.maximum.accumulate(np.where(np.isnan(matrix), 0, rows), axis=0)
    return np.take_along_axis(matrix, last, axis=0)
