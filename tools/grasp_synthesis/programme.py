"""A nonlinear programme with exact contacts, solved from random starts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array

OPTIONS = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-10,
    "ipopt.constr_viol_tol": 1e-11,
    "ipopt.max_iter": 500,
}


class Minimum(NamedTuple):
    """Unknowns (n,), the value minimised there, and the largest violation of a contact."""

    x: Array
    measure: float
    residual: float


class Programme:
    """Minimise a cost while equalities hold exactly and inequalities are at least zero."""

    def __init__(
        self,
        x: ca.SX,
        cost: ca.SX,
        equalities: ca.SX,
        inequalities: ca.SX,
        low: Array,
        high: Array,
    ) -> None:
        """Build the solver.

        Args:
            x: (n, 1) unknowns.
            cost: What to minimise.
            equalities: Zero at the end, to rounding.
            inequalities: At least zero.
            low: (n,) bounds.
            high: (n,) bounds.
        """
        self.low, self.high = low, high
        problem = {"x": x, "f": cost, "g": ca.vertcat(equalities, inequalities)}
        self._solver = ca.nlpsol("pinch", "ipopt", problem, OPTIONS)
        self._residual = ca.Function("residual", [x], [equalities])
        self._jacobian = ca.Function("jacobian", [x], [ca.jacobian(equalities, x)])
        self._lower = np.zeros(equalities.numel() + inequalities.numel())
        self._upper = np.repeat([0.0, np.inf], [equalities.numel(), inequalities.numel()])

    def minima(self, rng: np.random.Generator, starts: int) -> Iterator[Minimum]:
        """Every local minimum found from random starts within the bounds."""
        for _ in range(starts):
            result = self._solver(
                x0=rng.uniform(self.low, self.high),
                lbx=self.low,
                ubx=self.high,
                lbg=self._lower,
                ubg=self._upper,
            )
            if self._solver.stats()["success"]:
                x = self._polish(np.array(result["x"])[:, 0])
                residual = float(np.abs(np.array(self._residual(x))).max())
                yield Minimum(x, float(result["f"]), residual)

    def _polish(self, x: Array) -> Array:
        """Newton on the contacts alone, by least squares, to rounding; fixed unknowns stay."""
        free = (self.high - self.low > 0) & (x - self.low > 1e-6) & (self.high - x > 1e-6)
        for _ in range(4):
            jacobian = np.array(self._jacobian(x))[:, free]
            step = np.linalg.lstsq(jacobian, np.array(self._residual(x))[:, 0], rcond=1e-9)[0]
            x = x.copy()
            x[free] -= step
        return x
