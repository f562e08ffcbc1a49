"""Events and errors in words, as a person reads them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from casadi_ik.logs.read.one_solve import Happening

SERIOUS = ("NEAR_SINGULAR", "ILL_CONDITIONED", "STALL", "OSCILLATION")
"""Events that may be why a solve fails."""


def plain_name(name: str) -> str:
    """A name of the code as words: ``closed_chain`` is "closed chain"."""
    return name.replace("_", " ").replace("-", " ")


def number(value: float) -> str:
    """Three digits."""
    return f"{value:.3g}"


def listed(names: Sequence[str], most: int = 4) -> str:
    """Names with commas, the first few of many."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


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
    jacobian, joints = plain_name(event.jacobian), listed(event.joints)
    value, threshold = number(event.value), number(event.threshold)
    match event.kind:
        case "NEAR_SINGULAR":
            return f"{jacobian} near singular: smallest singular value {value} (below {threshold})"
        case "ILL_CONDITIONED":
            return f"{jacobian} ill-conditioned: condition number {value} (above {threshold})"
        case "LIMIT_HIT":
            return f"{joints} at its limit ({value})"
        case "LIMIT_LEFT":
            return f"{joints} off its limit ({threshold}), now {value}"
        case "ACTIVATED" | "RELEASED":
            return f"{joints} {event.kind.lower()}: {value} active constraints, {threshold} before"
        case "RESTART":
            return f"restart {value}"
        case "PHASE_CHANGE":
            return f"on to {plain_name(event.phase)}"
        case "STALL":
            return f"{plain_name(event.phase)} stalls: errors change by {value} of themselves"
        case "COLLISION_ENTERED":
            return f"something touches: clearance {1e3 * event.value:.2f} mm"
        case "COLLISION_LEFT":
            return f"nothing touches any more: clearance {1e3 * event.value:.2f} mm"
        case "OSCILLATION":
            return f"{joints} to and fro without progress: steps up to {value}"
        case kind:
            return f"{plain_name(kind.lower())}: {value}"
