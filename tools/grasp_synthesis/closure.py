"""Friction that a three-finger grasp needs; numpy only."""

from __future__ import annotations

import numpy as np

from casadi_ik.files.arrays import Array


def friction_needed(points: Array, normals: Array) -> float:
    """Smallest friction coefficient at which three point contacts can squeeze in equilibrium.

    Three forces in equilibrium are tensions t_ij along the triangle's sides, so every squeeze is
    f_i = sum_j t_ij (p_j - p_i): two numbers up to scale. Above the coefficient returned the
    equilibrium lies inside all cones, and since the contacts are not collinear the grasp then has
    force closure (hard fingers with friction).

    Args:
        points: (3, 3) contact points [m].
        normals: (3, 3) unit normals into the object.

    Returns:
        tan of the largest angle between a contact's force and its normal at the best squeeze.
    """
    sides = [points[1] - points[0], points[2] - points[0], points[2] - points[1]]

    def worst(tensions: Array) -> Array:
        t = tensions[..., None]
        forces = [
            t[..., 0, :] * sides[0] + t[..., 1, :] * sides[1],
            -t[..., 0, :] * sides[0] + t[..., 2, :] * sides[2],
            -t[..., 1, :] * sides[1] - t[..., 2, :] * sides[2],
        ]
        cosines = [
            f @ n / np.maximum(np.linalg.norm(f, axis=-1), 1e-12)
            for f, n in zip(forces, normals, strict=True)
        ]
        return np.min(cosines, axis=0)

    # Two of the tensions squeeze thumb against fingers (1 + a, 1 - a), the third is b.
    centre, width, best = np.zeros(2), np.array([1.0, 6.0]), -1.0
    grid = np.linspace(-1, 1, 61)
    for _ in range(25):
        a, b = np.meshgrid(centre[0] + width[0] * grid, centre[1] + width[1] * grid, indexing="ij")
        value = worst(np.stack([1 + a, 1 - a, b], axis=-1))
        index = np.unravel_index(np.argmax(value), value.shape)
        centre, best = np.array([a[index], b[index]]), float(value[index])
        width = width * 0.4
    return float(np.tan(np.arccos(np.clip(best, -1, 1)))) if best > 0 else np.inf
