"""What a solver hands over about a solve, and to whom: plain data and one protocol.

The solvers own this contract and know nothing of files; the logs implement it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from casadi_ik.kernels.layout import Layout


class EventKind(IntEnum):
    """What can happen in an iteration that is worth a line of its own."""

    NEAR_SINGULAR = 0
    LIMIT_HIT = 1
    LIMIT_LEFT = 2
    ACTIVE_SET = 3
    RESTART = 4
    PHASE_CHANGE = 5
    STALL = 6
    OSCILLATION = 7


@dataclass(frozen=True)
class Event:
    """Something that happened in one iteration.

    Attributes:
        iteration: Row of the trace, counted from 0.
        kind: What happened.
        subject: The Jacobian, joint, phase or finger concerned, to be read by a person.
        value: The number that made it an event.
        threshold: The number `value` was compared with; for a change, the value before it.
    """

    iteration: int
    kind: EventKind
    subject: str
    value: float
    threshold: float


@dataclass(frozen=True, eq=False)
class SolveSummary:
    """One solve without its iterations; n actuated coordinates, f fingers.

    Attributes:
        solve_id: Number of the solve, unique per method in one log (the index of the target).
        method: Name of the method.
        robot: Name of the robot.
        seed: Seed of the solve's random numbers.
        started: When the solve began [ns since the Unix epoch].
        time: How long it took [s].
        status: Name of the status it ended with.
        success: Whether the grasp is solved.
        iterations: Iterations over all phases and restarts.
        restarts: How often it began anew.
        phase_iterations: Iterations spent in each phase, by name, in the order of the phases.
        q: Actuated coordinates reached, (n,) [rad or m].
        fingers: Finger names, the order of every (f,) array.
        position_error: Distance of each contact point from its target, (f,) [m]; NaN if free.
        angle_error: Angle between each normal and its target, (f,) [rad]; NaN if free.
        ok: Which contacts are within tolerance, (f,) bool.
        target_points: Targets in the base frame, (f, 3) [m]; NaN if free.
        target_normals: Target normals in the base frame, (f, 3); NaN if free.
    """

    solve_id: int
    method: str
    robot: str
    seed: int
    started: int
    time: float
    status: str
    success: bool
    iterations: int
    restarts: int
    phase_iterations: Mapping[str, int]
    q: np.ndarray
    fingers: tuple[str, ...]
    position_error: np.ndarray
    angle_error: np.ndarray
    ok: np.ndarray
    target_points: np.ndarray
    target_normals: np.ndarray


@dataclass(frozen=True, eq=False)
class SolveRecord:
    """One solve with everything that is kept of it.

    Attributes:
        summary: The solve itself.
        layout: Fields of a row of the trace.
        trace: One row per iteration, (iterations,) of `layout.dtype`.
        labels: Names that make a field readable: of the codes 0, 1, ... of an integer scalar
            ("phase"; "" for a code not used), of the bits of a field ending in "_mask", of the
            elements along the first axis of any other field ("q": actuator names).
        events: What the solver itself noticed and the trace does not show.
    """

    summary: SolveSummary
    layout: Layout
    trace: np.ndarray[Any, np.dtype[Any]]
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    events: tuple[Event, ...] = ()


class Recorder(Protocol):
    """Whoever keeps what happened in the solves."""

    def record(self, solve: SolveRecord) -> None:
        """Take one finished solve; the trace may be reused by the caller afterwards."""
        ...

    def close(self) -> None:
        """Nothing more will come; what was taken is now kept for good."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
