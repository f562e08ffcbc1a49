"""Checks of units: numbers that are probably not in metres or radians cause a warning.

They remain accepted: a large obstacle or a wide tolerance may be intended. Each message names the
value, the limit and the likely mistake.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import InputWarning
from casadi_ik.files.arrays import Array


@dataclass(frozen=True)
class UsualSizes:
    """Largest values that cause no warning.

    Attributes:
        contact: Distance of a contact from the base [m].
        obstacle: Edge or diameter of an obstacle [m].
        obstacle_away: Distance of an obstacle from the base [m].
        mesh: Edge of the box around a mesh [m].
        position: Tolerance of a contact point [m].
        angle: Tolerance of a normal [rad].
    """

    contact: float = 10.0
    obstacle: float = 10.0
    obstacle_away: float = 100.0
    mesh: float = 10.0
    position: float = 0.1
    angle: float = math.radians(30.0)


USUAL_SIZES = UsualSizes()

ROUNDING_MARGIN = 1e-9
"""Relative excess that causes no warning, such as the rounding of 30 deg in radians [-]."""


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=3)


def warn_of_far_contacts(points: Array, location: str, base_travel: float = 0.0) -> None:
    """Warn of contact points (..., 3) that are more than `UsualSizes.contact` from the base.

    Args:
        points: Contact points [m]; NaN where free.
        location: Name of the argument, or file and key.
        base_travel: Distance that a mobile base travels [m].
    """
    max_distance = USUAL_SIZES.contact + base_travel
    is_beyond = np.abs(points) > max_distance  # the test of a box is cheaper than lengths
    if not is_beyond.any():
        return
    distance = float(np.linalg.norm(points[is_beyond.any(axis=-1)][0]))
    _warn(
        f"{location}: a contact is {distance:.4g} m from the robot's base; expected at most "
        f"{max_distance:.4g} m (numbers in mm? 1 mm is 0.001)"
    )


def warn_of_wide_tolerance(position: float, angle: float, location: str = "tolerance") -> None:
    """Warn of a tolerance above `UsualSizes.position` or `UsualSizes.angle`.

    Args:
        position: Largest distance of the contact point [m].
        angle: Largest angle of the normal [rad].
        location: Name of the argument, or file and key.
    """
    if position > USUAL_SIZES.position * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}.position: found {position:g} m; expected at most "
            f"{USUAL_SIZES.position:g} m (a number in mm? 1 mm is 0.001)"
        )
    if angle > USUAL_SIZES.angle * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}.angle: found {angle:g} rad ({math.degrees(angle):.4g} deg); expected "
            f"at most {USUAL_SIZES.angle:.3g} rad (30 deg; a number in degrees? use "
            f"np.deg2rad({angle:g}))"
        )


def warn_of_obstacle(distance: float, size: float, location: str) -> None:
    """Warn of an obstacle that is very large or very far away.

    Args:
        distance: Distance of its origin from the base [m].
        size: Its edge or diameter [m].
        location: Name of the scene or file, and key.
    """
    if size > USUAL_SIZES.obstacle * (1 + ROUNDING_MARGIN):
        problem, bound = f"a solid is {size:.4g} m large", USUAL_SIZES.obstacle
    elif distance > USUAL_SIZES.obstacle_away:
        problem = f"a solid is {distance:.4g} m from the robot's base"
        bound = USUAL_SIZES.obstacle_away
    else:
        return
    _warn(f"{location}: {problem}; expected at most {bound:g} m (numbers in mm? 1 mm is 0.001)")


def warn_of_large_mesh(points: Array, location: str) -> None:
    """Warn of a mesh with corners (k, 3) whose box has an edge above `UsualSizes.mesh`.

    Args:
        points: Corners, scaled [m].
        location: File, or file and key.
    """
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if size > USUAL_SIZES.mesh * (1 + ROUNDING_MARGIN):
        _warn(
            f"{location}: the mesh is {size:.4g} m large; expected at most "
            f"{USUAL_SIZES.mesh:g} m (a mesh in mm? its scale is 0.001)"
        )
