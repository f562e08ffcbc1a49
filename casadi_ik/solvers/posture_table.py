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

from casadi_ik.arm_hand import ArmHand
from casadi_ik.kernels import LookupKernel
from casadi_ik.solvers.problem import Array
from casadi_ik.steps.even_spread import evenly

LENGTH = 0.1
"""Distances are divided by this [m], so that they weigh like the cosines."""


class PostureTable:
    """Hand postures spread evenly over the limits.

    Attributes:
        postures: (t, k) positions of the hand's actuators.
        lookup: Finds rows of them.
    """

    def __init__(
        self,
        robot: ArmHand,
        hand: tuple[int, ...],
        size: int,
        at_limits: float = 0.0,
        pull: float = 0.0,
        compiled: bool = True,
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
            compiled: Whether lookups run in compiled code.
        """
        columns = list(hand)
        q = np.tile(robot.home, (size, 1))
        spread = (evenly(size, len(columns)) - 0.5) / (1 - at_limits) + 0.5
        spread = np.clip(spread, 0.0, 1.0)
        q[:, columns] = robot.lower[columns] + spread * (robot.upper - robot.lower)[columns]
        self.postures = q[:, columns]
        key = contact_shape(len(robot.fingers))
        self._pulled = pull > 0
        if self._pulled:
            half_ranges = (robot.upper - robot.lower)[columns] / 2
            key = _with_posture(key, np.sqrt(pull / len(columns)) / half_ranges)
        contacts = robot.contacts(q)
        rows = (*contacts, self.postures) if self._pulled else contacts
        self.lookup = LookupKernel(key, rows, compiled)

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
        asked = (points, normals, near) if self._pulled else (points, normals)
        return self.postures[self.lookup(count, *asked)]


@cache
def contact_shape(f: int) -> ca.Function:
    """Invariants of contacts under rigid motions, NaN where something is free (and for f = 1).

    Distances of the points, cosines between the normals, slopes of the normals against the lines
    between the points, and the side of the plane of three points that the normals are on.

    Args:
        f: Number of fingers.

    Returns:
        points (f, 3) [m] and normals (f, 3) -> values (s, 1).
    """
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
    return ca.Function(f"contact_shape_{f}", [points, normals], outputs)


def _with_posture(shape: ca.Function, scales: Array) -> ca.Function:
    """The same with a posture (hand, 1) besides, its entries multiplied by scales."""
    points, normals = (ca.SX.sym(shape.name_in(i), *shape.size_in(i)) for i in range(2))
    near = ca.SX.sym("near", len(scales))
    outputs = [ca.vertcat(shape(points, normals), near * ca.DM(scales))]
    return ca.Function(f"{shape.name()}_near", [points, normals, near], outputs)
