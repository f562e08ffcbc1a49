"""Contacts on the way from one grasp to the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.problems import Problems


def between(problems: Problems, i: int, count: int) -> Problems:
    """Contacts on the way from grasp i - 1 to grasp i, the last of them grasp i itself."""
    share = np.linspace(0, 1, count + 1)[1:, None, None]

    def mixed(values: Array) -> Array:
        # What is free in the grasp before comes from where it is in this one.
        before = np.where(np.isnan(values[i - 1]), values[i], values[i - 1])
        return (1 - share) * before + share * values[i]

    def turned(values: Array) -> Array:
        way = mixed(values)
        return way / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)

    normals, more = turned(problems.normals), {}
    for name, values in problems.more.items():
        way = turned(values)
        if name == "tangents":
            way -= normals * np.sum(normals * way, axis=2, keepdims=True)
            way /= np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-12)
        more[name] = way
    points = mixed(problems.points)
    return replace(problems, points=points, normals=normals, more=more, object_pose=None)
