"""Ipopt's iterates, one by one, and when to stop it."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.kernels.cancellation import is_cancelled

EXACT = 1e-8
"""Root of the cost at which the contacts count as met exactly: no iteration is spent beyond."""

JOINT_SLACK = 1e-9
"""Rounding allowed at the limit of a coupled joint [rad or m]."""


class Watch(ca.Callback):
    """Keeps every iterate, and stops Ipopt once the contacts are met exactly or nobody waits.

    For a program over x = (motors, slacks s) whose constraints are (r - s, joints). One solve at
    a time: `begin`, then Ipopt, then `end`.
    """

    def __init__(self, nx: int, ng: int, parameters: int) -> None:
        """Remember the sizes of the program."""
        ca.Callback.__init__(self)
        sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": parameters}
        self._sizes = [sizes[name] for name in ca.nlpsol_out()]
        self._wanted = [ca.nlpsol_out().index(name) for name in ("x", "g")]
        self._path: list[Array] = []
        self._rows: list[Array] = []
        self._contacts = 0
        self._joints: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
        self.construct("watch", {})

    def begin(self, contacts: int, joints: tuple[Array, Array]) -> None:
        """A new solve: how many rows of the constraints are r - s, and the limits of the others."""
        self._path, self._rows = [], []
        self._contacts, self._joints = contacts, joints

    def end(self) -> tuple[Array, Array]:
        """(rows, nx) iterates x, and of each r and the joints (rows, ng)."""
        return np.array(self._path), np.array(self._rows)

    def get_n_in(self) -> int:
        """Everything a solver returns."""
        return len(self._sizes)

    def get_n_out(self) -> int:
        """Whether to stop."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Dense columns."""
        return ca.Sparsity.dense(self._sizes[i], 1)

    def has_eval_buffer(self) -> bool:
        """Numbers are taken where they are, without matrices around them."""
        return True

    def eval_buffer(self, arg: Any, res: Any) -> int:
        """Called by Ipopt at the start and after every iteration."""
        x, rows = (np.frombuffer(arg[i], dtype=float).copy() for i in self._wanted)
        rows[: self._contacts] += x[len(x) - self._contacts :]
        self._path.append(x)
        self._rows.append(rows)
        r, joints = rows[: self._contacts], rows[self._contacts :]
        met = r @ r < EXACT**2 and within(joints, self._joints)
        np.frombuffer(res[0], dtype=float)[0] = met or is_cancelled()
        return 0


def within(joints: Array, limits: tuple[Array, Array]) -> bool:
    """Whether coupled joints are within their lower and upper limits."""
    return bool(
        np.all(joints >= limits[0] - JOINT_SLACK) and np.all(joints <= limits[1] + JOINT_SLACK)
    )
