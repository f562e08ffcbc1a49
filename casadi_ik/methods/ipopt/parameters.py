"""Numbers of the method `ipopt`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from casadi_ik.errors import InputError


@dataclass(frozen=True)
class IpoptParameters:
    """Parameters of the method.

    Attributes:
        restarts: Starts drawn at random within the limits after the one from q0; 0 for none. Of
            150 targets with every joint within 1 deg of a limit, 10 restarts missed 11 (local
            minima), 30 one, 46 none; of 750 others 9 were enough.
        max_iterations: Budget of Ipopt's iterations, each start anew.
        optimality: Ipopt's own tolerance (``tol``) on its scaled optimality error. The contacts
            end up off by about its root where a coordinate stands at a bound.
    """

    restarts: int = 50
    max_iterations: int = 300
    optimality: float = 1e-14

    def __post_init__(self) -> None:
        for name, least in (("restarts", 0), ("max_iterations", 1)):
            value = getattr(self, name)
            if not (isinstance(value, int) and not isinstance(value, bool) and value >= least):
                raise InputError(f"{name}: found {value!r}, expected a whole number >= {least}")
        value = self.optimality
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and value > 0):
            raise InputError(f"optimality: found {value!r}, expected a number > 0")
