"""Where a pad is on the skin of its link, and which way the skin faces there."""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.importing.surfaces import Surface

REACH = 0.06
"""From how far along the normal the skin is looked for [m]."""

NEAR = 0.004
"""What of the skin about a pad says which way it faces [m]."""

ON = 1e-7
"""A point this near to a triangle is on it [m]."""


def on_skin(surface: Surface, point: Array, normal: Array) -> tuple[Array, Array] | None:
    """The point where a pad's normal comes out of the skin, and the skin's normal there.

    Args:
        surface: Of what moves with the pad.
        point: (3,) the pad as it is [m].
        normal: (3,) its normal, unit.

    Returns:
        (3,) and (3,); None: the normal's line does not meet the skin.
    """
    found = surface.hit(point + REACH * normal, -normal)
    if found is None:
        return None
    a, b, c = (surface.points[surface.triangles[:, i]] for i in range(3))
    ways = np.cross(b - a, c - a)
    near = np.linalg.norm((a + b + c) / 3 - found, axis=1) <= NEAR
    # Of large triangles the middle is far from the pad: then it is the one under the pad.
    chosen = near | _holds(a, b, c, ways, found)
    ways = ways[chosen] / np.maximum(np.linalg.norm(ways[chosen], axis=1), 1e-30)[:, None] ** 0.5
    cosines = ways @ normal
    total = (ways * np.sign(cosines)[:, None])[np.abs(cosines) > 0].sum(axis=0)
    length = float(np.linalg.norm(total))
    return found, total / length if length > 0 else normal


def _holds(a: Array, b: Array, c: Array, ways: Array, point: Array) -> Array:
    """(t,) whether a point lies on triangles."""
    areas = np.maximum((ways * ways).sum(axis=1), 1e-30)
    flat = np.abs(((point - a) * ways).sum(axis=1)) <= ON * np.sqrt(areas)
    parts = [
        (np.cross(two - one, point - one) * ways).sum(axis=1) / areas
        for one, two in ((a, b), (b, c), (c, a))
    ]
    return flat & (np.min(parts, axis=0) >= -1e-6)
