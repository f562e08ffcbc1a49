"""The shape of some contacts: what does not change when all are moved as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import casadi as ca
from numpy.typing import NDArray

from casadi_ik.kernels.graphs import FunctionGraph, recipe
from casadi_ik.problem.contacts import LENGTH


def contact_shape(f: int, scales: Sequence[float] | NDArray = ()) -> FunctionGraph:
    """Invariants of contacts under rigid motions, NaN where something is free (and for f = 1).

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
