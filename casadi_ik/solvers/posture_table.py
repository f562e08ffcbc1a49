"""Which hand postures look like a grasp: a table of them, ranked by the shape of their contacts.

Distances between contact points and angles of the normals do not change when the hand is moved as
a whole. These invariants of a target are compared with those of many postures, so that the hand
stage starts from postures that nearly fit, wherever the palm may be.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.solvers.problem import Array

LENGTH = 0.1
"""Distances are divided by this [m], so that they weigh like the cosines."""

CHUNK = 2048
"""Targets compared at once."""


class PostureTable:
    """Hand postures spread evenly over the limits.

    Attributes:
        postures: (t, k) positions of the hand's actuators.
    """

    def __init__(self, robot: ArmHand, hand: tuple[int, ...], size: int) -> None:
        """Spread the postures and note the shape of their contacts.

        Args:
            robot: The robot.
            hand: Positions in q of the hand's actuators.
            size: Number of postures.
        """
        columns = list(hand)
        q = np.tile(robot.home, (size, 1))
        spread = evenly(size, len(columns))
        q[:, columns] = robot.lower[columns] + spread * (robot.upper - robot.lower)[columns]
        self.postures = q[:, columns]
        values, _ = shape(*robot.contacts(q))
        self._values = values.astype(np.float32)
        self._squares = (values**2).astype(np.float32)

    def nearest(self, points: Array, normals: Array, count: int) -> Array:
        """The postures whose contacts are shaped most like the targets, best first.

        Args:
            points: (k, f, 3) [m], NaN where free.
            normals: (k, f, 3), NaN where free.
            count: How many, at most the size of the table.

        Returns:
            (k, count, hand) postures.
        """
        rows = np.empty((len(points), count), dtype=np.intp)
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            values, known = shape(points[part], normals[part])
            wanted = values.astype(np.float32)
            # |known * (table - wanted)|^2 without the part that all rows share.
            distance = known.astype(np.float32) @ self._squares.T
            distance -= 2 * (wanted @ self._values.T)
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
    f = points.shape[1]
    columns = []
    for i, j in combinations(range(f), 2):
        columns.append(np.linalg.norm(points[:, i] - points[:, j], axis=1) / LENGTH)
        columns.append(np.einsum("ki,ki->k", normals[:, i], normals[:, j]))
    for i, j in permutations(range(f), 2):
        line = (points[:, j] - points[:, i]) / LENGTH
        columns.append(np.einsum("ki,ki->k", line, normals[:, i]))
    for i, j, m in combinations(range(f), 3):
        across = np.cross(points[:, j] - points[:, i], points[:, m] - points[:, i]) / LENGTH**2
        columns += [np.einsum("ki,ki->k", across, normals[:, k]) for k in (i, j, m)]
    if not columns:
        return np.zeros((len(points), 1)), np.zeros((len(points), 1), dtype=bool)
    values = np.stack(columns, axis=1)
    known = ~np.isnan(values)
    return np.where(known, values, 0.0), known


def evenly(count: int, dimensions: int) -> Array:
    """(count, dimensions) points of an additive recurrence, evenly spread over the unit cube.

    Roberts' generalised golden ratio: the root of x^(d+1) = x + 1 gives the increments.
    """
    ratio = 2.0
    for _ in range(64):
        ratio = (1 + ratio) ** (1 / (dimensions + 1))
    steps = ratio ** -np.arange(1.0, dimensions + 1)
    return (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0


def _smallest(distance: NDArray[np.float32], count: int) -> NDArray[np.intp]:
    """Columns of the smallest entries of each row, in order."""
    if count == 1:
        return distance.argmin(axis=1)[:, None]
    if count < distance.shape[1]:
        rows = np.argpartition(distance, count - 1, axis=1)[:, :count]
    else:
        rows = np.tile(np.arange(count), (len(distance), 1))
    order = np.take_along_axis(distance, rows, axis=1).argsort(axis=1, kind="stable")
    return np.take_along_axis(rows, order, axis=1)
