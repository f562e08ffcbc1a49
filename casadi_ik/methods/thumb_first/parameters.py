"""Numbers and choices of the thumb-first method."""

from __future__ import annotations

from dataclasses import dataclass, fields

from casadi_ik.errors import InputError

STEPS = ("freeze", "proxqp")
"""How a step keeps to the limits."""


@dataclass(frozen=True)
class ThumbFirstParameters:
    """Parameters of the method.

    Attributes:
        starts: Palm estimates a solve may begin from, each from another hand posture.
        table: Hand postures that the target's shape is compared with to find them.
        pull: How much a posture's distance from the start's hand counts along with the shape.
        step: "freeze": the joint that violates its limits most is fixed there and the step is
            solved again. "proxqp": the same problem as a quadratic program (ProxQP, Bambade et
            al. 2022), in CasADi's virtual machine; slower.
        damping: Damping [-] of the first step of a start; residuals are in 0.1 m and rad.
        step_cap: Longest change of any motor in one iteration [rad, or part of a slider's range].
    """

    starts: int = 32
    table: int = 8192
    pull: float = 6.0
    step: str = "freeze"
    damping: float = 0.03
    step_cap: float = 0.3

    def __post_init__(self) -> None:
        if self.step not in STEPS:
            known = ", ".join(STEPS)
            raise InputError(f"step: found {self.step!r}, expected one of {known}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type == "int" and not (type(value) is int and value >= 1):
                raise InputError(f"{entry.name}: found {value!r}, expected a whole number >= 1")
            if entry.type == "float" and not (type(value) in (int, float) and value > 0):
                raise InputError(f"{entry.name}: found {value!r}, expected a number > 0")
        if self.starts > self.table:
            raise InputError(f"table: found {self.table}, expected at least starts = {self.starts}")
