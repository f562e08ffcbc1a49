"""Events and errors in words, as a person reads them."""

from __future__ import annotations

import math

from casadi_ik.logs.one_solve import Happening

SERIOUS = ("NEAR_SINGULAR", "ILL_CONDITIONED", "STALL", "OSCILLATION")
"""Events that may be why a solve fails."""


def plain_name(name: str) -> str:
    """A name of the code as words: ``closed_chain`` is "closed chain"."""
    return name.replace("_", " ").replace("-", " ")


def number(value: float) -> str:
    """Three digits, no exponent where it can be done without."""
    return f"{value:.3g}"


def errors(position: float, angle: float) -> str:
    """Distance and angle to a contact; what is free (NaN) is left out.

    Args:
        position: [m].
        angle: [rad].
    """
    parts = [] if math.isnan(position) else [f"{1e3 * position:.2f} mm"]
    parts += [] if math.isnan(angle) else [f"{math.degrees(angle):.2f} deg"]
    return " and ".join(parts) or "free"


def told(event: Happening) -> str:
    """An event in a few words."""
    subject, value, threshold = event.subject, number(event.value), number(event.threshold)
    match event.kind:
        case "NEAR_SINGULAR":
            return (
                f"{plain_name(subject)} near singular: smallest singular value {value}"
                f" (below {threshold})"
            )
        case "ILL_CONDITIONED":
            return f"{plain_name(subject)} ill-conditioned: condition {value} (above {threshold})"
        case "LIMIT_HIT":
            return f"{subject} at its limit ({value})"
        case "LIMIT_LEFT":
            return f"{subject} off its limit ({threshold}), now {value}"
        case "ACTIVE_SET":
            return f"active constraints: {subject} ({value} in all)"
        case "RESTART":
            return f"restart {value}"
        case "PHASE_CHANGE":
            return f"phase {subject}"
        case "STALL":
            return f"{subject} stalls: errors change by {value} of themselves"
        case "OSCILLATION":
            return f"{subject} to and fro without progress: steps of {value}"
        case _:
            return f"{plain_name(event.kind.lower())}: {subject} {value}"
