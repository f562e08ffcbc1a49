"""What a control law made of a target: every step of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.problem.status import Status


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What the control law made of one target; s steps were made.

    Attributes:
        times: (s + 1,) [s], the start first.
        q: (s + 1, n) actuator positions [rad or m].
        points: (s + 1, 3) contact point in the frame of the target [m].
        error: (s + 1, m) rows of the task, desired minus current [m, rad].
        error_norm: (s + 1,) their norm; of a pose the screw error norm of Chandra eq. (17).
        sigma: (s + 1,) smallest singular value of the Jacobian over half ranges.
        status: `SOLVED` if the error norm fell below the tolerance, else `ITERATION_LIMIT`, or
            `INVALID`.

    Example:
        >>> ar10 = ik.load_robot("ar10")
        >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"))
        >>> run = control.run(ar10.home, control.target(ar10.home), steps=3)
        >>> run.q.shape, bool(run.error_norm[-1] < 1e-9)
        ((4, 10), True)
    """

    times: Array
    q: Array
    points: Array
    error: Array
    error_norm: Array
    sigma: Array
    status: Status

    def rate(self, floor: float = 1e-9) -> float:
        """Exponential rate [1/s] fitted to the error norm: -slope of its logarithm over time.

        Args:
            floor: Norms at or below it are rounding and left out.

        Returns:
            The rate, NaN if fewer than two norms are above the floor.
        """
        rows = self.error_norm > floor
        if rows.sum() < 2:
            return math.nan
        return -float(np.polyfit(self.times[rows], np.log(self.error_norm[rows]), 1)[0])
