"""What a method has to offer, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.rows import split_rows
from casadi_ik.kernels.stepper import Stepper
from casadi_ik.problem.problems import Array, Problems
from casadi_ik.problem.trace import TraceFormat


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a method made of a batch of k targets.

    Attributes:
        q: (k, n) configurations reached.
        status: (k,) codes of `Status`.
        iterations: (k,) iterations over all phases and restarts.
        restarts: (k,) how often it began anew.
        time: (k,) seconds per solve.
        phases: (k,) iterations by phase name, in the order of the phases.
        rows: The records of all iterations, one solve after the other, (sum of iterations,); None
            if no trace was asked for.
    """

    q: Array
    status: NDArray[np.int64]
    iterations: NDArray[np.int64]
    restarts: NDArray[np.int64]
    time: Array
    phases: Mapping[str, NDArray[np.int64]]
    rows: NDArray[Any] | None = None

    @property
    def trace(self) -> tuple[NDArray[Any], ...]:
        """The rows of each solve, views into `rows`; empty if no trace was asked for."""
        return () if self.rows is None else split_rows(self.rows, self.iterations)


@dataclass(frozen=True, eq=False)
class Quick:
    """What a method believes to be the solution of one target; fields as in `Outcome`."""

    q: Array
    iterations: int
    restarts: int
    phases: Mapping[str, int]


class Method(Protocol):
    """A named way to solve, built for one robot."""

    name: str

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Every number and choice it works with, for the log."""
        ...

    def prepare(self) -> None:
        """Build and compile what `run` needs; afterwards `run` may be called by several threads."""
        ...

    def stepper(self, problems: Problems, q0: Array) -> Stepper:
        """Solve one target by hand, one iteration at a time.

        Args:
            problems: One target.
            q0: (n,) configuration to start from.

        Raises:
            RowError: The method cannot take the target (for example a free finger).
            UnsupportedError: The method cannot be stepped; the message says why.
        """
        ...

    def run(self, problems: Problems, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch.

        Args:
            problems: The targets.
            q0: (k, n) configurations to start from.
            seed: Of all random numbers; row i of a batch gets the same numbers in any batch.
            trace: Whether to keep every iteration.

        Raises:
            RowError: The method cannot take a target (for example a free finger).
        """
        ...


@runtime_checkable
class PreferringMethod(Protocol):
    """A method that can prefer one of several solutions.

    Attributes:
        preferences: Those of `PREFERENCES` it knows: "q0" it follows itself where `Problems` say
            so, "limits" is what it does else.
    """

    preferences: tuple[str, ...]


@runtime_checkable
class QuickMethod(Protocol):
    """A method with a shorter way to the same answer for one easy target."""

    def quick(self, problems: Problems, q0: Array) -> Quick | None:
        """What `run` would find, if that is a solution found at once; None: ask `run`.

        Args:
            problems: One target.
            q0: (n,) configuration to start from.
        """
        ...
