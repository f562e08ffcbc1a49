"""One solve out of a log, with all that is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.layout import Layout
from casadi_ik.logs.columns import label_of
from casadi_ik.logs.reader import LogFile
from casadi_ik.solvers import Tolerance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Happening:
    """An event of a solve.

    Attributes:
        iteration: In which iteration, from 0.
        kind: What happened, e.g. "NEAR_SINGULAR".
        jacobian: The Jacobian concerned; "" if none.
        joints: The actuators concerned.
        phase: The phase it happened in; "" without phases.
        value: The number that made it an event.
        threshold: The number it was compared with, or the value before.
    """

    iteration: int
    kind: str
    jacobian: str
    joints: tuple[str, ...]
    phase: str
    value: float
    threshold: float


@dataclass(frozen=True)
class Stretch:
    """Iterations in a row that are in one phase.

    Attributes:
        phase: Its name.
        first: First iteration.
        last: Last iteration.
    """

    phase: str
    first: int
    last: int

    @property
    def rows(self) -> slice:
        """The iterations as rows of the trace."""
        return slice(self.first, self.last + 1)

    def __len__(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True, eq=False)
class OneSolve:
    """A solve; f fingers.

    Attributes:
        method: Name of the method.
        robot: Name of the robot.
        solve_id: Number of the solve.
        started: When it began [ns since the Unix epoch].
        time: How long it took [s].
        status: Name of the status it ended with.
        success: Whether the grasp is solved.
        restarts: How often it began anew.
        iterations: How many iterations it took, kept or not.
        fingers: Finger names, the order of every (f,) array.
        position_error: (f,) [m] at the end; NaN if free.
        angle_error: (f,) [rad] at the end; NaN if free.
        ok: (f,) which contacts are within tolerance.
        target_points: (f, 3) [m] in the base frame; NaN if free.
        target_normals: (f, 3); NaN if free.
        layout: Fields of a row of the trace.
        labels: Names of codes, bits and elements by field.
        rows: The trace, a row per iteration; none if the log has kept the totals only.
        events: What happened, by iteration.
        parameters: What the solver was set to.
    """

    method: str
    robot: str
    solve_id: int
    started: int
    time: float
    status: str
    success: bool
    restarts: int
    iterations: int
    fingers: tuple[str, ...]
    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    target_points: Array
    target_normals: Array
    layout: Layout
    labels: Mapping[str, tuple[str, ...]]
    rows: np.ndarray[Any, np.dtype[Any]]
    events: tuple[Happening, ...]
    parameters: Mapping[str, Any]

    @cached_property
    def tolerance(self) -> Tolerance:
        """What counted as reached."""
        return Tolerance(**self.parameters.get("tolerance", {}))

    @cached_property
    def stretches(self) -> tuple[Stretch, ...]:
        """The phases in the order in which they were gone through; one without phases."""
        count = len(self.rows)
        if count == 0 or "phase" not in self.layout.names:
            return (Stretch("", 0, count - 1),) if count else ()
        codes = self.rows["phase"].astype(int)
        starts = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()]
        ends = [*(start - 1 for start in starts[1:]), count - 1]
        return tuple(
            Stretch(label_of(self.labels, "phase", int(codes[first])), first, last)
            for first, last in zip(starts, ends, strict=True)
        )


def one_solve(log: LogFile, solve_id: int | None = None, method: str | None = None) -> OneSolve:
    """Take one solve out of a log.

    Args:
        log: The log.
        solve_id: Its number; may be left out if the log holds one solve only.
        method: Its method; may be left out if the log holds one method only.

    Raises:
        UnknownNameError: There is no such solve, or it is not said which of several.
        LogError: The log is damaged.
    """
    candidates = [
        each for each in log.solves(method) if solve_id is None or each.solve_id == solve_id
    ]
    summary = candidates[0]
    iterations = log.iterations(summary.method, summary.solve_id)
    return OneSolve(
        method=summary.method,
        robot=summary.robot,
        solve_id=summary.solve_id,
        started=summary.started,
        time=summary.time,
        status=summary.status,
        success=summary.success,
        restarts=summary.restarts,
        iterations=summary.iterations,
        fingers=summary.fingers,
        position_error=summary.position_error,
        angle_error=summary.angle_error,
        ok=summary.ok,
        target_points=summary.target_points,
        target_normals=summary.target_normals,
        layout=iterations.layout,
        labels=iterations.labels,
        rows=iterations.rows,
        events=tuple(
            Happening(
                e.event.iteration,
                e.event.kind.name,
                e.event.subject if e.event.kind.name == "NEAR_SINGULAR" else "",
                (e.event.subject,) if "LIMIT" in e.event.kind.name else (),
                "",
                e.event.value,
                e.event.threshold,
            )
            for e in log.events(summary.method, summary.solve_id)
        ),
        parameters=log.metadata.get("parameters", {}),
    )
