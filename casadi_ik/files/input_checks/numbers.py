"""Checks of numbers: their types, probable mistakes of units, and times in seconds.

Other types and values raise an `InputError`. A length or an angle in a probable other unit causes a
warning, because a large obstacle or a wide tolerance may be intended.
"""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from casadi_ik.errors import InputError, InputWarning
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit


def checked_number(
    value: Any, location: str, expected: str, low: float = -math.inf, high: float = math.inf
) -> float:
    """Return an argument as a finite number.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        expected: Kind and range of the number, for the message.
        low: Smallest value.
        high: Largest value.

    Raises:
        InputError: The argument is not a number, or out of range.
    """
    is_number = isinstance(value, (int, float, np.integer, np.floating))
    if not is_number or isinstance(value, bool) or not (low <= value <= high):
        raise InputError(f"{location}: found {value!r}, expected {expected}")
    number = float(value) if abs(value) <= 1e300 else math.inf
    if not math.isfinite(number):
        raise InputError(f"{location}: found {value!r}, expected {expected}")
    return number


def checked_mapping(value: Any, location: str, expected: str) -> Mapping[Any, Any]:
    """Return an argument that is a mapping.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        expected: Keys and values of the mapping, for the message.

    Raises:
        InputError: The argument is not a mapping.
    """
    if not isinstance(value, Mapping):
        raise InputError(f"{location}: found {type(value).__name__}, expected a mapping {expected}")
    return value


def checked_integer(value: Any, location: str, minimum: int) -> int:
    """Return an argument as an integer.

    Args:
        value: The argument.
        location: Name of the argument, for the message.
        minimum: Smallest value.

    Raises:
        InputError: The argument is not an integer, or smaller.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = minimum - 1
    if isinstance(value, bool) or number < minimum:
        raise InputError(f"{location}: found {value!r}, expected an integer >= {minimum}")
    return number


MAX_FRAME_INTERVAL = 1.0
"""Median time between frames of a hand at and above which times are not in seconds [s].

Trackers send at least ten frames a second; in milliseconds these are 100 apart, and at 1 kHz they
are 1 apart.
"""

MAX_WAYPOINT_INTERVAL = 5.0
"""Same limit for contacts [s], which may be waypoints of a slow motion."""

MIN_FRAMES = 3
"""Smallest number of frames that is checked; fewer do not determine the unit."""

INTERVAL_UNITS = (
    (1e6, "nanoseconds", 1e-9),
    (1e3, "microseconds", 1e-6),
    (0.0, "milliseconds", 1e-3),
)
"""Median interval from which times are probably in a unit, the unit, and its length [s]."""


def check_time_unit(times: Array, location: str, max_interval: float = MAX_FRAME_INTERVAL) -> None:
    """Refuse times of frames that are probably not in seconds.

    Args:
        times: (k,) increasing numbers.
        location: File and key.
        max_interval: Median interval at and above which they are refused [s].

    Raises:
        InputError: The message names the interval and the likely unit.
    """
    if len(times) < MIN_FRAMES:
        return
    interval = float(np.median(np.diff(times)))
    if interval < max_interval:
        return
    unit, factor = next(
        (name, factor) for start, name, factor in INTERVAL_UNITS if interval >= start
    )
    raise InputError(
        f"{location}: frames are {interval:.4g} s apart; expected seconds, less than "
        f"{max_interval:g} between frames (numbers in {unit}? multiply by {factor:g})"
    )


def cycle_count(seconds: float, period: float, location: str) -> int:
    """Return the number of cycles of a motion, rounded up.

    Args:
        seconds: Duration of the motion [s].
        period: Duration of a cycle [s].
        location: Name of the argument, or file and key.

    Raises:
        InputError: There are more cycles than `FileLimits.stream_cycles`.
    """
    count, max_count = seconds / period, scaled_limit(LIMITS.stream_cycles)
    if not count <= max_count:
        raise InputError(
            f"{location}: {seconds:.4g} s in cycles of {period:.4g} s are {count:.4g} cycles; "
            f"expected at most {max_count:,} {RAISE_HINT}"
        )
    return math.ceil(count)


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

MAX_COORDINATE = 1e9
"""Largest coordinate of a contact [m]: squared errors do not overflow in single precision."""

ROUNDING_MARGIN = 1e-9
"""Relative excess that causes no warning, such as the rounding of 30 deg in radians [-]."""


def _warn(message: str) -> None:
    warnings.warn(message, InputWarning, stacklevel=3)


def check_contact_distances(points: Array, location: str, base_travel: float = 0.0) -> None:
    """Warn of contact points (..., 3) more than `UsualSizes.contact` from the base.

    Args:
        points: Contact points [m]; NaN where free.
        location: Name of the argument, or file and key.
        base_travel: Distance that a mobile base travels [m].

    Raises:
        InputError: A coordinate is larger than `MAX_COORDINATE`.
    """
    max_distance = USUAL_SIZES.contact + base_travel
    is_beyond = np.abs(points) > max_distance  # the test of a box is cheaper than lengths
    if not is_beyond.any():
        return
    largest = float(np.abs(points[is_beyond]).max())
    if largest > MAX_COORDINATE:
        raise InputError(
            f"{location}: found a coordinate of {largest:.4g} m; expected at most "
            f"{MAX_COORDINATE:g} m"
        )
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
