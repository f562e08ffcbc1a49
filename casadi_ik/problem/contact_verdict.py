"""How well one finger meets its contact."""

from __future__ import annotations

from dataclasses import dataclass

from casadi_ik.grasps import Tolerance


@dataclass(frozen=True)
class ContactVerdict:
    """How well one finger meets its contact.

    Attributes:
        position_error: Distance from the contact point [m]; NaN if the finger is free.
        angle_error: Angle from the normal [rad]; NaN if it is free.
        ok: Within tolerance (what is free is).
        tolerance: What it was compared with.

    Example:
        >>> verdict = solution.contacts["thumb"]
        >>> verdict.ok, verdict.position_error < verdict.tolerance.position
        (True, True)
    """

    position_error: float
    angle_error: float
    ok: bool
    tolerance: Tolerance
