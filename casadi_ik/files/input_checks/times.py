"""Checks of times: times are in seconds, and motions have a limited number of cycles."""

from __future__ import annotations

import math

import numpy as np

from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit

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
