"""When something in a trace counts as an event."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from casadi_ik.errors import InputError


@dataclass(frozen=True)
class EventRules:
    """When something counts as an event.

    Attributes:
        singular: Smallest singular value below which a Jacobian is near singular, by the name
            behind ``sigma_``, in the unit of that field. One not named here has the threshold
            that its method states (`RecordedJacobian.singular`).
        condition: Condition number above which it is ill-conditioned, by the name behind
            ``condition_``; likewise.
        release: A Jacobian has to rise above this multiple of its threshold (a condition number
            to fall below the threshold by this factor) before it can enter again.
        limit_slack: How far a coordinate has to move from its limit to have left it [rad or m];
            so that a rounding error is not an event.
        stall_window: Iterations over which a stall is judged.
        stall_change: Spread of the error over the window, relative to the error, that counts as
            standing still.
        oscillation_window: Iterations over which an oscillation is judged, at least 3.
        oscillation_step: Shortest step of a coordinate that counts as moving [rad or m].
        oscillation_progress: Relative fall of the error over the window that counts as progress.
        clearance: Clearance below which something is touched [m]; a log with a scene takes the
            scene's margin.

    Example:
        >>> ik.logs.EventRules(release=3.0).release
        3.0
    """

    singular: Mapping[str, float] = field(default_factory=dict)
    condition: Mapping[str, float] = field(default_factory=dict)
    release: float = 1.5
    limit_slack: float = 1e-6
    stall_window: int = 10
    stall_change: float = 1e-4
    oscillation_window: int = 6
    oscillation_step: float = 1e-4
    oscillation_progress: float = 0.05
    clearance: float = 0.0

    def __post_init__(self) -> None:
        if self.stall_window < 1 or self.oscillation_window < 3:
            raise InputError(
                f"event rules: windows {self.stall_window} and {self.oscillation_window},"
                " expected at least 1 (stall) and 3 (oscillation)"
            )
        if self.release < 1:
            raise InputError(f"event rules: release {self.release}, expected at least 1")
