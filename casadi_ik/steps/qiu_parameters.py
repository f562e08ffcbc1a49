"""Every number and every open choice of Qiu & Kermani 2021 in one record."""

from __future__ import annotations

from dataclasses import dataclass, fields

from casadi_ik.errors import InputError

FINGER_STEPS = ("ipopt", "closed-form")
PALM_ERRORS = ("euler", "rotation-vector")
PLATFORMS = ("arm-leg", "palm")
CHOICES = {"finger_step": FINGER_STEPS, "palm_error": PALM_ERRORS, "platform": PLATFORMS}
MAY_BE_ZERO = ("borrowed", "stall_step")


@dataclass(frozen=True)
class QiuParameters:
    """Parameters of the paper's methods; the defaults are the paper's where it gives them.

    Lengths inside the solver are millimetres, angles radians: the paper gives its damping
    factors as bare numbers, and only in these units do they do what it describes (lambda = 150
    "considerably large").

    Attributes:
        reaching_damping: lambda of thumb reaching (paper: 1), squared in the normal matrix.
            [mm] in the position task, [rad/rad] in the orientation tasks.
        chain_damping: lambda of the closed chain (paper: 150), squared in the normal matrix.
            Read as 150 rather than 150^2 in the matrix, the success falls by 20 points.
        virtual_weight: Weight of the virtual joint in the closed chain (paper: 10).
        joint_weight: Weight of the other active joints (paper: 1).
        palm_error: "euler": differences of Euler angles as the paper writes; it names no
            convention, taken is ZYX, each difference wrapped to (-pi, pi]. "rotation-vector":
            rotation logarithm and geometric Jacobian, free of the Euler singularity.
        platform: Whose twist J_cc of eq. (8) is: "arm-leg" as printed (the arm's last joint is
            left out), "palm" with it.
        borrowed: Arm joints counted to the reversed thumb (paper: 1, the 7th).
        finger_step: Solver of eq. (5): "ipopt" (the paper: fmincon) or "closed-form" (the same
            answer, much faster).
        reaching_patience: Thumb reaching ends when palm and thumb are within tolerance. The
            paper does not say what happens when the tasks conflict and they never are: here it
            also ends after this many iterations without a gain of 1 % in the summed errors.
        reaching_iterations: ... and after this many iterations in any case.
        step_cap: Longest change of any motor in one iteration [rad or m]. Not in the paper: none.
        max_iterations: Budget of a solve, both phases together (paper: 10,000).
        stall_step: A solve ends as STALLED when the largest motor change stays below this
            [rad or m] for `stall_patience` iterations: a fixed point, from which counting on to
            the budget would change no verdict.
        stall_patience: See `stall_step`.
    """

    reaching_damping: float = 1.0
    chain_damping: float = 150.0
    virtual_weight: float = 10.0
    joint_weight: float = 1.0
    palm_error: str = "euler"
    platform: str = "arm-leg"
    borrowed: int = 1
    finger_step: str = "ipopt"
    reaching_patience: int = 10
    reaching_iterations: int = 100
    step_cap: float = 1e9
    max_iterations: int = 10_000
    stall_step: float = 1e-10
    stall_patience: int = 5

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in CHOICES:
                if value not in CHOICES[entry.name]:
                    known = ", ".join(CHOICES[entry.name])
                    raise InputError(f"{entry.name}: found {value!r}, expected one of {known}")
            else:
                _check_number(entry.name, value, isinstance(entry.default, int))


def _check_number(name: str, value: object, whole: bool) -> None:
    kind, types = ("an integer", (int,)) if whole else ("a number", (int, float))
    zero = name in MAY_BE_ZERO
    number = isinstance(value, types) and not isinstance(value, bool)
    if not (number and (value > 0 or (zero and value == 0))):  # type: ignore[operator]
        bound = ">= 0" if zero else "> 0"
        raise InputError(f"{name}: found {value!r}, expected {kind} {bound}")
