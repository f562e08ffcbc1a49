"""Table of hand postures, ranked by the similarity of the shape of their contacts to a target.

Distances between contact points and angles between normals are invariant under rigid motions of the
hand. The invariants of a target are compared with those of many postures, so that the hand stage
starts from postures that nearly fit for any pose of the palm.
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
    """Return the graph of invariants of contacts under rigid motions; NaN if free, and for f = 1.

    The invariants are the distances of the points, the cosines between the normals, the components
    of the normals along the lines between the points, and those along the normals of the planes
    through three points.

    Args:
        f: Number of fingers.
        scales: Factors of the entries of an optional third input (len(scales), 1), which are
            appended to the invariants.

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
        edges = points[j, :] - points[i, :], points[m, :] - points[i, :]
        lengths = ca.norm_2(edges[0]) * ca.norm_2(edges[1])
        plane_normal = ca.cross(*edges) / ca.fmax(lengths, 1e-12)
        values += [ca.dot(plane_normal, normals[k, :]) for k in (i, j, m)]
    invariants = ca.vertcat(*values) if values else ca.SX(float("nan"))
    if not factors:
        return ca.Function(name, [points, normals], [invariants])
    posture = ca.SX.sym("near", len(factors))
    outputs = [ca.vertcat(invariants, posture * ca.DM(factors))]
    return ca.Function(name, [points, normals, posture], outputs)


class PostureTable:
    """Hand postures of a low-discrepancy sequence within the limits.

    Attributes:
        postures: (t, k) positions of the hand's actuators.
        ranges: (k,) ranges of the actuators.
        lookup: Search for the nearest rows.
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
            hand: Indices in q of the hand's actuators.
            size: Number of postures.
            at_limits: Fraction of the samples [0, 1) that is moved to the limits, because hands are
                at their limits more often than uniform samples.
            pull: Weight of the distance from a reference posture in addition to the shape of the
                contacts, because different postures may have contacts of nearly the same shape.
            compiled: False searches without compiled code.
            bounds: Lower and upper bounds (n,); None: limits of the robot.
        """
        columns = list(hand)
        self._lower, upper = (limits[columns] for limits in bounds or (robot.lower, robot.upper))
        self.ranges = upper - self._lower
        self._squeeze = 1 - at_limits
        q = np.tile(robot.home, (size, 1))
        q[:, columns] = self.postures = self.samples(0, size)
        self._pulled = pull > 0
        half_ranges = self.ranges / 2
        scales = np.sqrt(pull / max(len(columns), 1)) / half_ranges
        key = contact_shape(len(robot.fingers), scales if self._pulled else ())
        contacts = robot.contacts(q)
        rows = (*contacts, self.postures) if self._pulled else contacts
        self.lookup = LookupKernel(key, rows, compiled)

    def samples(self, first: int, count: int) -> Array:
        """Return postures (count, k) of the table's sequence, starting at index `first`."""
        samples = (spread_points(count, len(self.ranges), first) - 0.5) / self._squeeze + 0.5
        return self._lower + np.clip(samples, 0.0, 1.0) * self.ranges

    def nearest(
        self, points: Array, normals: Array, count: int, reference: Array | None = None
    ) -> Array:
        """Return the postures whose contacts are most similar in shape to the targets, best first.

        Args:
            points: (k, f, 3) contact points, NaN if free [m].
            normals: (k, f, 3) contact normals, NaN if free.
            count: Number of postures per target, at most the size of the table.
            reference: (k, hand) reference postures; required by a table with a pull.

        Returns:
            (k, count, hand) postures.
        """
        query = (points, normals, reference) if self._pulled else (points, normals)
        return self.postures[self.lookup(count, *query)]
