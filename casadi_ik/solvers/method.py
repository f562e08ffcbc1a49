"""What a method has to offer, and what it gives back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.layout import Layout
from casadi_ik.kernels.rows import split_rows
from casadi_ik.robots.description import RobotDescription
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.steps.recorded_jacobian import RecordedJacobian
from casadi_ik.steps.status import Phase, Status


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


@dataclass(frozen=True, eq=False)
class TraceFormat:
    """How to read a trace.

    Attributes:
        layout: Fields of a row.
        labels: Names that make a field readable: of the codes 0, 1, ... of an integer scalar
            ("phase"; "" for a code not used), of the bits of a field ending in "_mask", of the
            elements along the first axis of any other field ("q": actuator names).
        jacobians: What there is to know of the Jacobians in fields ``sigma_<name>`` and
            ``condition_<name>``, by name. One that is not named here is never near singular.
    """

    layout: Layout
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    jacobians: Mapping[str, RecordedJacobian] = field(default_factory=dict)


def trace_format(
    layout: Layout,
    robot: RobotDescription,
    jacobians: Mapping[str, RecordedJacobian] | None = None,
) -> TraceFormat:
    """How to read a trace whose fields have the names all methods use.

    Args:
        layout: Fields of a row: "q", "position_error", "angle_error", "limit_mask", "phase" and
            "status", and whatever else needs no names.
        robot: The robot.
        jacobians: As in `TraceFormat`.
    """
    labels = {
        "q": robot.actuator_names,
        "position_error": robot.finger_names,
        "angle_error": robot.finger_names,
        "limit_mask": robot.actuator_names,
        "phase": Phase.labels(),
        "status": Status.labels(),
    }
    return TraceFormat(layout, labels, jacobians or {})


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
class QuickMethod(Protocol):
    """A method with a shorter way to the same answer for one easy target."""

    def quick(self, problems: Problems, q0: Array) -> Quick | None:
        """What `run` would find, if that is a solution found at once; None: ask `run`.

        Args:
            problems: One target.
            q0: (n,) configuration to start from.
        """
        ...
