"""The arithmetic of log times: which time belongs to which iteration of which solve."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from casadi_ik.errors import LogError

ITERATION = 1_000_000
"""Log time between two iterations: 1 ms [ns]."""

SLOT = 60_000_000_000
"""Log time between two solves, unless said otherwise: room for 60,000 iterations [ns]."""


@dataclass(frozen=True)
class LogClock:
    """Log times are computed, not measured, so that a solve is a known range of time.

    Attributes:
        t0: Log time of solve 0, iteration 0 [ns since the Unix epoch].
        slot: Log time between two solves [ns].
    """

    t0: int
    slot: int = SLOT

    @classmethod
    def now(cls) -> LogClock:
        """A clock whose solve 0 is at the present full second."""
        return cls(time.time_ns() // 1_000_000_000 * 1_000_000_000)

    def start(self, solve_id: int) -> int:
        """Log time of a solve's first iteration [ns]."""
        return self.t0 + solve_id * self.slot

    def times(self, solve_id: int, iterations: int) -> np.ndarray:
        """Log times of a solve's iterations, (iterations,) uint64 [ns].

        Raises:
            LogError: There are more iterations than the slot has room for, or the solve's number is
                negative or beyond what 64-bit nanoseconds can tell.
        """
        if not (solve_id >= 0 and self.start(solve_id + 1) < 2**63):
            raise LogError(f"solve {solve_id}: the log has no time for a solve of this number")
        if iterations * ITERATION > self.slot:
            raise LogError(
                f"solve {solve_id}: {iterations} iterations, the log has room for"
                f" {self.slot // ITERATION} per solve"
            )
        return self.start(solve_id) + np.arange(iterations, dtype=np.uint64) * np.uint64(ITERATION)

    def locate(self, log_times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve and iteration of log times: the inverse of `times`, two int64 arrays."""
        since = log_times.astype(np.int64) - self.t0
        return since // self.slot, since % self.slot // ITERATION
