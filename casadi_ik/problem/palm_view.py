"""Where the palm sees a point of the base, from contacts that are within balls and slopes: numpy.

In the palm frame the wrist stands still, and it is known which way a joint carries what is seen.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.contact_bounds import Balls


def seen_distances(
    found: Balls, asked: tuple[Array, Array], loose: tuple[Array, Array], base: Array, palm: Array
) -> tuple[Array, Array]:
    """Smallest and largest distance (k,) of a point of the base from one of the palm [m].

    The point of the base is a sum of what is asked for, with coefficients; the palm sees the same
    sum of its contacts.

    Args:
        found: The contacts of k boxes, palm frame.
        asked: Points and normals (f, 3), normals NaN where free.
        loose: By how much contacts may be off: (f,) [m], and (f,) chords.
        base: (3,) in the base frame [m].
        palm: (3,) in the palm frame [m].
    """
    points, normals = asked
    known = ~np.isnan(normals[:, 0])
    radius = found.radius + loose[0]
    chord = 2 * np.sin(np.minimum(found.angle, np.pi) / 2) + loose[1]
    goals = np.concatenate([points[1:] - points[0], normals[known]])
    each = np.concatenate([radius[:, 1:] + radius[:, :1], chord[:, known]], axis=1)
    A, across = goals / each[:, :, None], base - points[0]
    normal = np.einsum("kfi,kfj->kij", A, A)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    solved = np.linalg.solve(normal, np.tile(across, (len(A), 1))[:, :, None])[:, :, 0]
    share = np.einsum("kfi,ki->kf", A, solved) / each
    n = len(points) - 1
    p = np.concatenate([1 - share[:, :n].sum(axis=1, keepdims=True), share[:, :n]], axis=1)
    b = np.zeros_like(p)
    b[:, known] = share[:, n:]
    centre = np.einsum("kf,kfi->ki", p, found.points) + np.einsum("kf,kfi->ki", b, found.normals)
    slopes = np.einsum("kf,kfmi->kmi", p, found.slopes) + np.einsum("kf,kfmi->kmi", b, found.turns)
    give = np.linalg.norm(across - share @ goals, axis=1)
    give += (np.abs(p) * (found.bend + loose[0]) + np.abs(b) * (found.curl + loose[1])).sum(axis=1)
    away = centre - palm
    length = np.linalg.norm(away, axis=1)
    line = away / np.maximum(length, 1e-300)[:, None]
    along = np.einsum("kmi,ki->km", slopes, line)
    aside = np.linalg.norm(slopes - along[:, :, None] * line[:, None], axis=2).sum(axis=1)
    ahead = np.abs(along).sum(axis=1)
    return length - ahead - give, np.hypot(length + ahead, aside) + give
