"""How an iteration, and with it a solve, can end; and the phases it goes through."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import REPEATED, RUNNING


class Status(IntEnum):
    """How a solve ended. Not converging is a status, never an exception.

    Example:
        >>> ik.Status.SOLVED.name, int(ik.Status.SOLVED)
        ('SOLVED', 1)
    """

    INVALID = -1
    """A number was no longer finite; the last finite configuration is returned."""
    RUNNING = 0
    """Not ended yet (a step's status only)."""
    SOLVED = 1
    """Every contact within tolerance, every actuator and joint within limits if enforced."""
    STALLED = 2
    """The iteration stands still away from the contacts."""
    ITERATION_LIMIT = 3
    """The budget of iterations is used up."""
    UNREACHABLE = 4
    """The contacts cannot be reached: there is a proof, see `Diagnosis.proof`."""
    NOT_FOUND = 5
    """A diagnosis found neither a solution nor a proof that there is none."""
    COLLISION = 6
    """Contacts and limits are met, but something touches, see `Solution.collision`."""

    @classmethod
    def from_loop(cls, codes: NDArray[np.int32]) -> NDArray[np.int64]:
        """How solves ended, from the codes (k,) of `LoopResult.status`.

        A step ends with a status of its own; what the loop itself ends is out of iterations, back
        at an earlier state (and would be there again and again), or no longer finite.
        """
        found = codes.astype(np.int64)
        return np.select(
            [found == RUNNING, found == REPEATED, found < 0],
            [int(cls.ITERATION_LIMIT), int(cls.STALLED), int(cls.INVALID)],
            found,
        )

    @classmethod
    def labels(cls) -> tuple[str, ...]:
        """Names by code from 0 on, for the log."""
        return tuple(cls(code).name for code in range(max(cls) + 1))


class Phase(IntEnum):
    """Phase of an iteration.

    Example:
        >>> ik.solve.Phase.HAND_FIT.label
        'hand-fit'
    """

    THUMB_REACHING = 1
    HAND_ALIGNMENT = 2
    REFINEMENT = 3
    CANDIDATE = 4
    HAND_FIT = 5
    ARM_PLACEMENT = 6
    HIERARCHY = 7
    WHOLE_SYSTEM = 8
    BALANCE = 9
    ARM_CHOICE = 10
    TRUNK = 11

    @property
    def label(self) -> str:
        """The name as it is shown."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def labels(cls) -> tuple[str, ...]:
        """Names by code from 0 on ("" where there is no such phase), for the log."""
        known = {phase.value: phase.label for phase in cls}
        return tuple(known.get(code, "") for code in range(max(cls) + 1))
