"""Results of commands, and targets for the tests of the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import casadi_ik as ik

FAST = ("--method", "enhanced-dls", "--finger-step", "closed-form")
POSTURE = np.r_[
    [0.3, 0.6, -0.2, -1.5, 0.2, 0.9, 0.4], np.deg2rad([10.0, 80.0, 12.0, 78.0, 12.0, 78.0, 12.0])
]


@dataclass(frozen=True)
class Run:
    """Result of a command."""

    exit: int
    out: str
    err: str

    def fine(self) -> Run:
        """Return the result after checking success and an empty stderr."""
        assert (self.exit, self.err) == (0, ""), self
        return self

    @property
    def error(self) -> str:
        """Message of a refusal, without the name of the program."""
        assert self.exit == 2, self
        assert self.out == ""
        assert self.err.count("\n") == 1, self.err
        assert self.err.endswith("\n")
        start = "casadi-ik: error: "
        assert self.err.startswith(start), self.err
        return self.err.removeprefix(start).rstrip("\n")


Command = Callable[..., Run]


def solvable(robot: ik.ArmHand, count: int) -> tuple[Any, Any]:
    """Return (count, f, 3) points and normals of one reachable configuration, repeated."""
    return robot.contacts(np.tile(POSTURE, (count, 1)))
