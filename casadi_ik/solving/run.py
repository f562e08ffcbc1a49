"""How targets are solved: everything that is asked for but the targets themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.answers.recorder import Recorder
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError


@dataclass(frozen=True, eq=False)
class Run:
    """How targets are solved.

    Attributes:
        q0: (n,) start, or (k, n) for k targets; None is the robot's home.
        seed: Of all random numbers, >= 0.
        jobs: Threads, at least 1; compiled loops run side by side.
        recorder: Keeps the iterations; None: they are not kept.
        diagnose: Whether to find the reason where a target is not solved.
        shown: Whether to show how far it is, where someone looks on.
    """

    q0: ArrayLike | None = None
    seed: int = 0
    jobs: int = 1
    recorder: Recorder | None = None
    diagnose: bool = False
    shown: bool = False

    def __post_init__(self) -> None:
        for name, least in (("jobs", 1), ("seed", 0)):
            value = getattr(self, name)
            if type(value) is int and value >= least:
                continue
            if not isinstance(value, (int, np.integer)) or value < least:
                raise InputError(f"{name}: found {value!r}, expected an integer >= {least}")
            object.__setattr__(self, name, int(value))

    def start(self, robot: ArmHand) -> Array:
        """(n,) or (k, n) where solves of a robot begin.

        Raises:
            InputError: Wrong shape or numbers.
        """
        return robot.start(self.q0)

    def starts(self, robot: ArmHand, count: int) -> Array:
        """(count, n) where each solve begins.

        Raises:
            InputError: Wrong shape or numbers, or not as many as targets.
        """
        start = self.start(robot)
        if start.ndim == 1:
            return np.repeat(start[None], count, axis=0)
        if len(start) != count:
            raise InputError(
                f"q0: found {len(start)} rows for {count} targets, expected as many, or one (n,)"
            )
        return start
