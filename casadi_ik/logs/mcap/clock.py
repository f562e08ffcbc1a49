"""The arithmetic of log times: which time belongs to which iteration of which solve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.errors import LogError

ITERATION = 1_000_000
"""Log time between two iterations: 1 ms [ns]."""

SLOT = 60_000_000_000
"""Log time between two solves, unless said otherwise: room for 60,000 iterations [ns]."""

T0 = 946_684_800_000_000_000
"""Log time of solve 0 unless said otherwise: the first moment of the year 2000 [ns]. The same in
every log, so that the logs of several workers share one time. True times are publish times."""


@dataclass(frozen=True)
class LogClock:
    """Log times are computed, not measured, so that a solve is a known range of time.

    Attributes:
        t0: Log time of solve 0, iteration 0 [ns since the Unix epoch].
        slot: Log time between two solves [ns].

    Example:
        >>> ik.logs.LogClock(t0=0).slot > 0
        True
    """

    t0: int = T0
    slot: int = SLOT

    def start(self, solve_id: int) -> int:
        """Log time of a solve's first iteration [ns]."""
        return self.t0 + solve_id * self.slot

    def check(self, first: int, counts: NDArray[np.int64]) -> None:
        """See to it that there is time for solves from `first` on, of so many iterations (k,).

        Raises:
            LogError: There are more iterations than the slot has room for, or a solve's number is
                negative or beyond what 64-bit nanoseconds can tell.
        """
        last = first + len(counts) - 1
        if not (first >= 0 and last < 2**32 and self.start(last + 1) < 2**63):
            wrong = first if first < 0 else last
            raise LogError(f"solve {wrong}: the log has no time for a solve of this number")
        room = self.slot // ITERATION
        if counts.size and counts.max() > room:
            raise LogError(
                f"solve {first + int(counts.argmax())}: {counts.max()} iterations, the log has room"
                f" for {room} per solve"
            )

    def times(self, solve_id: NDArray[np.int64], iteration: NDArray[np.int64]) -> np.ndarray:
        """Log times of iterations, uint64 [ns]; both arguments of the same shape."""
        return (self.t0 + solve_id * self.slot + iteration * ITERATION).astype(np.uint64)

    def locate(self, log_times: np.ndarray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Solve and iteration of log times: the inverse of `times`, two int64 arrays."""
        since = log_times.astype(np.int64) - self.t0
        solve_id = since // self.slot
        return solve_id, (since - solve_id * self.slot) // ITERATION
