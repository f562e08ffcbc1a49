"""What a loop makes of a batch of solves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.rows import split_rows

NON_FINITE = -1
"""Status of a solve whose state or status became NaN or infinite; its last finite state stays."""

FAILED = -2
"""Status of a solve whose step reported a failure; the state before that step stays."""

REPEATED = -3
"""Status of a solve that came back to an earlier state bit for bit, and so would for ever."""

UNBEGUN = -4
"""Status of a solve that a method has not begun yet."""

FIRST_ROWS = 256
"""Rows a trace starts with at least; it doubles when they are full."""

FIRST_MARK = 16
"""Iteration, a power of two, of the first state that later ones are compared with."""

CODE_LIMIT = 2**31 - 1
"""A status has to be smaller than this (it is kept as int32)."""


@dataclass(frozen=True, eq=False)
class LoopResult:
    """What a batch of k solves came to.

    Attributes:
        states: Last states, shape (k, ns).
        iterations: Steps made, shape (k,); the one that became non-finite counts.
        status: Shape (k,): the step's status, `RUNNING` if the iterations ran out, `NON_FINITE`,
            `FAILED` or `REPEATED`.
        time: Seconds inside the loop, shape (k,); solves side by side share them.
        rows: The records of all iterations of all solves, one after the other, shape
            (sum of iterations,), of the record layout's dtype; None if no trace was asked for.
    """

    states: NDArray[np.float64]
    iterations: NDArray[np.int64]
    status: NDArray[np.int32]
    time: NDArray[np.float64]
    rows: NDArray[Any] | None = None

    @cached_property
    def trace(self) -> tuple[NDArray[Any], ...]:
        """The rows of each solve, views into `rows`; empty if no trace was asked for."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)
