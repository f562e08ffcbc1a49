"""Parameters of the thumb-first method."""

from __future__ import annotations

from dataclasses import dataclass, fields

from casadi_ik.errors import InputError

STEP_METHODS = ("freeze", "proxqp")
"""Names of the solvers that compute a step within the limits."""


@dataclass(frozen=True)
class ThumbFirstParameters:
    """Parameters of the method `thumb-first`.

    Attributes:
        starts: Maximum number of palm estimates per solve, each from a different hand posture.
        table: Number of hand postures in the table of palm estimates.
        pull: Weight of the distance from the reference posture (that of q0, or home) in the choice
            of hand postures, relative to their fit to the contacts.
        step: "freeze" fixes the joint with the largest limit violation and solves the step again.
            "proxqp" solves the same problem as a quadratic program (ProxQP, Bambade et al. 2022)
            in CasADi's virtual machine, which is slower.
        damping: Damping of the first step of a start [-]; residuals are in 0.1 m and rad.
        step_cap: Largest change of a motor per iteration [rad, or fraction of the range of a
            slider].
        eased: Factor of the damping after an accepted step, < 1.
        tightened: Factor of the damping after a rejected step, > 1.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends a start.
        gain: Ratio of costs after and before a step above which progress is slow.
        patience: Number of consecutive iterations with slow progress that ends a start.
        budget: Maximum number of iterations per start.
        as_it_is: Largest cost at q0 for which q0 and its hand posture are used as starts.
    """

    starts: int = 32
    table: int = 8192
    pull: float = 6.0
    step: str = "freeze"
    damping: float = 0.03
    step_cap: float = 0.3
    eased: float = 1 / 3
    tightened: float = 4.0
    damping_floor: float = 1e-6
    damping_ceiling: float = 100.0
    gain: float = 0.9
    patience: int = 12
    budget: int = 100
    as_it_is: float = 0.5

    def __post_init__(self) -> None:
        if self.step not in STEP_METHODS:
            names = ", ".join(STEP_METHODS)
            raise InputError(f"step: found {self.step!r}, expected one of {names}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type == "int" and not (type(value) is int and value >= 1):
                raise InputError(f"{entry.name}: found {value!r}, expected a whole number >= 1")
            if entry.type == "float" and not (type(value) in (int, float) and value > 0):
                raise InputError(f"{entry.name}: found {value!r}, expected a number > 0")
        if self.starts > self.table:
            raise InputError(f"table: found {self.table}, expected at least starts = {self.starts}")
