"""Status of a solve and phase of an iteration."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import REPEATED, RUNNING


class Status(IntEnum):
    """Status of a solve; failure to converge is a status, never an exception.

    Example:
        >>> ik.Status.SOLVED.name, int(ik.Status.SOLVED)
        ('SOLVED', 1)
    """

    INVALID = -1
    """A value became non-finite, or the target is malformed; q is the last finite configuration."""
    RUNNING = 0
    """The solve continues (only as the status of a step)."""
    SOLVED = 1
    """The contacts are within tolerance, and q is within the limits if these are enforced."""
    STALLED = 2
    """The cost no longer decreases, but a contact is not within tolerance."""
    ITERATION_LIMIT = 3
    """The maximum number of iterations is reached."""
    UNREACHABLE = 4
    """A proof shows that the contacts cannot be reached, see `Diagnosis.proof`."""
    NOT_FOUND = 5
    """The diagnosis found neither a solution nor a proof that there is none."""
    COLLISION = 6
    """Contacts and limits are met, but the robot is in collision, see `Solution.collision`."""
    NEAREST = 7
    """A solution was not found; q is the nearest configuration, as `best_effort` requests."""

    @classmethod
    def from_loop(cls, codes: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the statuses of solves from the codes (k,) of `LoopResult.status`.

        A step ends a solve with a status. The loop ends a solve that has reached the maximum
        number of iterations, has returned to an earlier state, or is no longer finite.
        """
        status = codes.astype(np.int64)
        return np.select(
            [status == RUNNING, status == REPEATED, status < 0],
            [int(cls.ITERATION_LIMIT), int(cls.STALLED), int(cls.INVALID)],
            status,
        )

    @classmethod
    def labels(cls) -> tuple[str, ...]:
        """Return the names of the codes 0, 1, ..., for the log."""
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
        """Name in logs and tables."""
        return self.name.lower().replace("_", "-")

    @classmethod
    def labels(cls) -> tuple[str, ...]:
        """Return the names of the codes 0, 1, ..., "" for unused codes, for the log."""
        label_by_code = {phase.value: phase.label for phase in cls}
        return tuple(label_by_code.get(code, "") for code in range(max(cls) + 1))
