"""Sampled collision checks in numpy.

Phalanges are capsules of 9 mm radius around the lines knuckle - distal joint - {T}; a pad lies
9.5 mm off its line, so a finger that only touches with its pad keeps 0.5 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.objects import GraspObject

PHALANX_RADIUS = 0.009  # [m]
PALM_SURFACE = 0.080  # [m] z in frame W (robots.md, section 2)


@dataclass(frozen=True)
class Clearance:
    """Smallest gaps [m]; negative is penetration.

    Attributes:
        palm: Between the object and the plane of the palm.
        fingers: Between the phalanges and the object.
        between: Between two fingers.
    """

    palm: float
    fingers: float
    between: float


def clearance(item: GraspObject, object_in_palm: Array, lines: Array) -> Clearance:
    """Return the gaps of a grasp.

    Args:
        item: The object.
        object_in_palm: (4, 4) its pose in palm frame W.
        lines: (3, 3, 3) per finger knuckle, distal joint and tip in palm frame W.
    """
    rotation, origin = object_in_palm[:3, :3], object_in_palm[:3, 3]
    vertices = item.mesh(96)[0] @ rotation.T + origin
    samples = [_segment_points(line) for line in lines]
    points_in_object = (np.concatenate(samples) - origin) @ rotation
    gaps = [np.linalg.norm(a[:, None] - b[None], axis=2).min() for a, b in combinations(samples, 2)]
    return Clearance(
        palm=float(vertices[:, 2].min() - PALM_SURFACE),
        fingers=float(item.signed_distance(points_in_object).min() - PHALANX_RADIUS),
        between=float(min(gaps) - 2 * PHALANX_RADIUS),
    )


def _segment_points(line: Array) -> Array:
    t = np.linspace(0, 1, 41)[:, None]
    return np.concatenate([a + t * (b - a) for a, b in pairwise(line)])
