"""Checks of single numbers as arguments: other types and values raise an InputError."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

from casadi_ik.errors import InputError


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
