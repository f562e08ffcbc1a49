"""Which hand postures look like a grasp: a table of them, ranked by the shape of their contacts.

Distances between contact points and angles of the normals do not change when the hand is moved as
a whole. These invariants of a target are compared with those of many postures, so that the hand
stage starts from postures that nearly fit, wherever the palm may be.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations, permutations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.kernels import FunctionKernel
from casadi_ik.solvers.problem import Array
from casadi_ik.steps.even_spread import evenly

LENGTH = 0.1
"""Distances are divided by this [m], so that they weigh like the cosines."""

CHUNK = 256
"""Targets compared at once: what fits into the cache."""

STEPS = 64
"""Values are compared in steps of 1 / STEPS. The products then have no rounding errors in single
precision, so that a target finds the same postures alone and in a batch."""

SEARCHES = 16
"""Up to so many smallest entries are searched for one by one."""


class PostureTable:
    """Hand postures spread evenly over the limits.

    Attributes:
        postures: (t, k) positions of the hand's actuators.
    """

    def __init__(
        self,
        robot: ArmHand,
        hand: tuple[int, ...],
        size: int,
        at_limits: float = 0.0,
        pull: float = 0.0,
    ) -> None:
        """Spread the postures and note the shape of their contacts.

        Args:
            robot: The robot.
            hand: Positions in q of the hand's actuators.
            size: Number of postures.
            at_limits: Part of the range [0, 1) that is moved to the limits, half to either: hands
                stand at their limits more often than an even spread would.
            pull: How much the distance from a given posture counts besides the contacts' shape:
                different hands may have contacts of nearly the same shape.
        """
        columns = list(hand)
        q = np.tile(robot.home, (size, 1))
        spread = (evenly(size, len(columns)) - 0.5) / (1 - at_limits) + 0.5
        spread = np.clip(spread, 0.0, 1.0)
        q[:, columns] = robot.lower[columns] + spread * (robot.upper - robot.lower)[columns]
        self.postures = q[:, columns]
        values, _ = shape(*robot.contacts(q))
        self._pull: Array | None = None
        if pull:
            half_ranges = (robot.upper - robot.lower)[columns] / 2
            scales: Array = np.sqrt(pull / len(columns)) / half_ranges
            values, self._pull = np.hstack([values, self.postures * scales]), scales
        rounded = _rounded(values)
        # Squares last: one product gives |table - wanted|^2 without the part all postures share.
        self._columns = np.hstack([rounded, rounded**2]).T.copy()
        self._complete = np.hstack([rounded, (rounded**2).sum(axis=1, keepdims=True)]).T.copy()

    def nearest(
        self, points: Array, normals: Array, count: int, near: Array | None = None
    ) -> Array:
        """The postures whose contacts are shaped most like the targets, best first.

        Args:
            points: (k, f, 3) [m], NaN where free.
            normals: (k, f, 3), NaN where free.
            count: How many, at most the size of the table.
            near: (k, hand) postures they should be near; needed by a table with a pull.

        Returns:
            (k, count, hand) postures.
        """
        rows = np.empty((len(points), count), dtype=np.intp)
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            values, known = shape(points[part], normals[part])
            if self._pull is not None and near is not None:
                pulled = near[part] * self._pull
                values = np.hstack([values, pulled])
                known = np.hstack([known, np.ones(pulled.shape, dtype=bool)])
            wanted = -2 * _rounded(values)
            if known.all():
                ones = np.ones((len(wanted), 1), dtype=np.float32)
                distance = np.hstack([wanted, ones]) @ self._complete
            else:
                distance = np.hstack([wanted, known.astype(np.float32)]) @ self._columns
            rows[part] = _smallest(distance, count)
        return self.postures[rows]


def shape(points: Array, normals: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Invariants of contacts under rigid motions.

    Distances of the points, cosines between the normals, slopes of the normals against the lines
    between the points, and the side of the plane of three points that the normals are on.

    Args:
        points: (k, f, 3) [m], NaN where free.
        normals: (k, f, 3), NaN where free.

    Returns:
        (k, s) values, 0 where something is free, and (k, s) which of them are known.
    """
    (values,) = _invariants(points.shape[1])(points, normals)
    values = values.reshape(len(points), -1)  # also a single value
    known = ~np.isnan(values)
    return np.where(known, values, 0.0), known


@cache
def _invariants(f: int) -> FunctionKernel:
    """Points and normals (f, 3) -> values (s,), NaN where something is free (and for f = 1)."""
    points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
    values = []
    for i, j in combinations(range(f), 2):
        values.append(ca.norm_2(points[i, :] - points[j, :]) / LENGTH)
        values.append(ca.dot(normals[i, :], normals[j, :]))
    for i, j in permutations(range(f), 2):
        values.append(ca.dot(points[j, :] - points[i, :], normals[i, :]) / LENGTH)
    for i, j, m in combinations(range(f), 3):
        across = ca.cross(points[j, :] - points[i, :], points[m, :] - points[i, :])
        values += [ca.dot(across, normals[k, :]) / LENGTH**2 for k in (i, j, m)]
    outputs = [ca.vertcat(*values) if values else ca.SX(float("nan"))]
    return FunctionKernel(ca.Function(f"contact_shape_{f}", [points, normals], outputs))


def _rounded(values: Array) -> NDArray[np.float32]:
    return np.rint(values * STEPS).clip(-8 * STEPS, 8 * STEPS).astype(np.float32)


def _smallest(distance: NDArray[np.float32], count: int) -> NDArray[np.intp]:
    """Columns of the smallest entries of each row, in order; `distance` is used up."""
    if count > SEARCHES:
        return np.stack([_smallest_of_row(row, count) for row in distance])
    found = np.empty((len(distance), count), dtype=np.intp)
    every = np.arange(len(distance))
    for i in range(count):
        found[:, i] = distance.argmin(axis=1)
        distance[every, found[:, i]] = np.inf
    return found


def _smallest_of_row(distance: NDArray[np.float32], count: int) -> NDArray[np.intp]:
    """The same for one row: only what is as small as the last one wanted has to be sorted."""
    if count >= len(distance):
        return distance.argsort(kind="stable")[:count]
    places = np.flatnonzero(distance <= np.partition(distance, count - 1)[count - 1])
    return places[distance[places].argsort(kind="stable")[:count]]
