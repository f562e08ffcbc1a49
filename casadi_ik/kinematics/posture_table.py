"""Table of hand postures, ranked by the similarity of the shape of their contacts to a target.

Distances between contact points and angles of the normals do not change when the hand is moved as
a whole. These invariants of a target are compared with those of many postures, so that the hand
stage starts from postures that nearly fit, wherever the palm may be.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import LookupKernel
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.files.arrays import Array, spread_points
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import LENGTH


def contact_shape(f: int, scales: Sequence[float] | NDArray = ()) -> FunctionGraph:
    """Return invariants of contacts under rigid motions, NaN where free (and for f = 1).

    Distances of the points, cosines between the normals, slopes of the normals against the lines
    between the points, and the side of the plane of three points that the normals are on.

    Args:
        f: Number of fingers.
        scales: If there are any, a third input (len(scales), 1) follows the invariants, its
            entries multiplied by these.

    Returns:
        points (f, 3) [m] and normals (f, 3) -> values (s, 1).
    """
    factors = tuple(map(float, scales))
    name = f"contact_shape_{f}_near" if factors else f"contact_shape_{f}"
    inputs = {"points": (f, 3), "normals": (f, 3)}
    if factors:
        inputs["near"] = (len(factors), 1)
    count = max(f * (f - 1) * 2 + f * (f - 1) * (f - 2) // 2, 1) + len(factors)
    return FunctionGraph(
        name, lambda: _build(name, f, factors), inputs, ((count, 1),), recipe(name, factors)
    )


def _build(name: str, f: int, factors: tuple[float, ...]) -> ca.Function:
    points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
    values = []
    for i, j in combinations(range(f), 2):
        values.append(ca.norm_2(points[i, :] - points[j, :]) / LENGTH)
        values.append(ca.dot(normals[i, :], normals[j, :]))
    for i, j in permutations(range(f), 2):
        values.append(ca.dot(points[j, :] - points[i, :], normals[i, :]) / LENGTH)
    for i, j, m in combinations(range(f), 3):
        one, other = points[j, :] - points[i, :], points[m, :] - points[i, :]
        across = ca.cross(one, other) / ca.fmax(ca.norm_2(one) * ca.norm_2(other), 1e-12)
        values += [ca.dot(across, normals[k, :]) for k in (i, j, m)]
    invariants = ca.vertcat(*values) if values else ca.SX(float("nan"))
    if not factors:
        return ca.Function(name, [points, normals], [invariants])
    near = ca.SX.sym("near", len(factors))
    outputs = [ca.vertcat(invariants, near * ca.DM(factors))]
    return ca.Function(name, [points, normals, near], outputs)


class PostureTable:
    """Hand postures of a low-discrepancy sequence within the limits.

    Attributes:
        postures: (t, k) positions of the hand's actuators.
        ranges: (k,) between which they are spread.
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
        bounds: tuple[Array, Array] | None = None,
    ) -> None:
        """Compute the postures and the invariants of their contacts.

        Args:
            robot: The robot.
            hand: Positions in q of the hand's actuators.
            size: Number of postures.
            at_limits: Part of the range [0, 1) that is moved to the limits, half to either: hands
                stand at their limits more often than an even spread would.
            pull: How much the distance from a given posture counts along with the contacts' shape:
                different hands may have contacts of nearly the same shape.
            compiled: Whether lookups run in compiled code.
            bounds: (n,) lower and upper, the robot's limits unless given.
        """
        columns = list(hand)
        self._lower, upper = (ends[columns] for ends in bounds or (robot.lower, robot.upper))
        self.ranges = upper - self._lower
        self._squeeze = 1 - at_limits
        q = np.tile(robot.home, (size, 1))
        q[:, columns] = self.postures = self.spread(0, size)
        self._pulled = pull > 0
        half_ranges = self.ranges / 2
        scales = np.sqrt(pull / max(len(columns), 1)) / half_ranges
        key = contact_shape(len(robot.fingers), scales if self._pulled else ())
        contacts = robot.contacts(q)
        rows = (*contacts, self.postures) if self._pulled else contacts
        self.lookup = LookupKernel(key, rows, compiled)

    def spread(self, first: int, count: int) -> Array:
        """Return postures (count, k) of the sequence of the table, from any index on."""
        spread = (spread_points(count, len(self.ranges), first) - 0.5) / self._squeeze + 0.5
        return self._lower + np.clip(spread, 0.0, 1.0) * self.ranges

    def nearest(
        self, points: Array, normals: Array, count: int, near: Array | None = None
    ) -> Array:
        """Return the postures whose contacts are shaped most like the targets, best first.

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
