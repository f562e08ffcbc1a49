"""Wording of names, numbers and errors in texts about logs."""

from __future__ import annotations

import math
from collections.abc import Sequence


def plain_name(name: str) -> str:
    """Return an identifier as words: "closed chain" for ``closed_chain``."""
    return name.replace("_", " ").replace("-", " ")


def format_number(value: float) -> str:
    """Format a number with three significant digits."""
    return f"{value:.3g}"


def format_quantity(value: float, unit: str) -> str:
    """Format a value with its unit: angles in degrees, lengths in millimetres."""
    if unit == "rad":
        return f"{math.degrees(value):.4g} deg"
    return f"{1e3 * value:.4g} mm" if unit == "m" else format_number(value)


def counted_noun(count: int, noun: str) -> str:
    """Return a count with its noun: "1 restart", "2 restarts"."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


MAX_NAMES = 4
"""Maximum number of names in a sentence."""


def joined_names(names: Sequence[str]) -> str:
    """Join the first names with commas and count the remaining ones."""
    text = ", ".join(names[:MAX_NAMES])
    return text if len(names) <= MAX_NAMES else f"{text} and {len(names) - MAX_NAMES} more"


def errors_text(position: float, angle: float) -> str:
    """Format the errors of a contact; free components (NaN) are omitted.

    Args:
        position: Position error [m].
        angle: Angle error [rad].
    """
    parts = [] if math.isnan(position) else [f"{1e3 * position:.2f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.2f} deg"]
    return " and ".join(parts) or "free"
