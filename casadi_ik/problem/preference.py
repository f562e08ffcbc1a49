"""Which of several solutions of a grasp is wanted."""

from __future__ import annotations

from casadi_ik.errors import InputError

CLEARANCE = "clearance"
"""The preference for what is far from everything; for solvers with a scene."""

PREFERENCES = ("limits", "manipulability", "q0", CLEARANCE)
"""What may be preferred: distance from the limits, manipulability of the arm, closeness to q0,
clearance."""

NO_PREFERENCE = "none"
"""That of methods that cannot choose: they take the solution they come to."""


def preference(prefer: str | None, started: bool) -> str:
    """The preference that was asked for.

    Args:
        prefer: One of `PREFERENCES`, or None: "q0" if a start was given, else "limits".
        started: Whether one was.

    Raises:
        InputError: No such preference.
    """
    if prefer is None:
        return "q0" if started else "limits"
    if prefer not in PREFERENCES:
        raise InputError(f"prefer: found {prefer!r}, expected one of {', '.join(PREFERENCES)}")
    return prefer
