"""How large a file of somebody else may be: each reader has its limits, one factor raises all."""

from __future__ import annotations

import math
import os

from casadi_ik.errors import InputError

VARIABLE = "CASADI_IK_LIMITS"
"""Factor in the environment by which all limits are multiplied."""

RAISED = f"(--size-limits 4, or {VARIABLE}=4 in the environment, allows four times as much)"
"""Said where a limit is met."""


def limit(value: float) -> int:
    """A limit of size, time or memory, times the factor of the environment.

    Raises:
        InputError: The factor is no positive number.
    """
    text = os.environ.get(VARIABLE, "1")
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not 0 < factor < 1e9:
        raise InputError(
            f"{VARIABLE}: found {text!r} in the environment, expected a factor above 0"
        )
    return max(1, int(value * factor))
