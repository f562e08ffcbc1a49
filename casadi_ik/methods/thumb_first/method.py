"""The thumb-first method: palm estimates from a table of postures, then one compiled loop."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels import LoopKernel, LoopResult
from casadi_ik.methods.common.posture_table import PostureTable
from casadi_ik.methods.thumb_first.parameters import ThumbFirstParameters
from casadi_ik.methods.thumb_first.state import STAGES
from casadi_ik.methods.thumb_first.step import ThumbFirstStep
from casadi_ik.problem.contacts.kinds import usual
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.problems import Array, Problems
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trace import TraceFormat, trace_format
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.srs_arm import SrsArm, srs_arm

UNBOUNDED = 1e3
"""Bounds [rad or m] where limits are ignored."""

MAX_ITERATIONS = 100_000
"""Far above what the stages' own budgets allow: the loop always ends by a status."""


class ThumbFirstMethod:
    """`thumb-first`: the arm starts at the estimated palm, then the closed chain does the rest.

    Attributes:
        name: Name of the method.
        options: Its numbers and choices.
        step: Its step for this robot.
    """

    name = "thumb-first"

    def __init__(
        self, robot: RobotDescription, options: ThumbFirstParameters, compiled: bool = True
    ) -> None:
        """Recognise the arm and lay out the step."""
        self.options = options
        self.step = ThumbFirstStep(robot, options, usual(len(robot.fingers)), _closed_form(robot))
        self._robot = robot
        self._compiled = compiled

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop; the virtual machine if the step is ProxQP's."""
        return LoopKernel(self.step.graph(), self._compiled)

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures that targets are compared with."""
        robot, options = ArmHand(self._robot), self.options
        return PostureTable(
            robot, self.step.hand, options.table, pull=options.pull, compiled=self._compiled
        )

    def prepare(self) -> None:
        """Build and compile the loop, and fill the table."""
        _ = self.kernel, self.table

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        return trace_format(self.step.record, self._robot)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def start(
        self, problems: Problems, q0: Array, starts: int | None = None
    ) -> tuple[Array, Array]:
        """First states (k, ns) and parameters (k, np) of the step graph for a batch.

        Args:
            problems: The targets.
            q0: (k, n); of hands whose contacts look alike, the one nearest to it is tried first.
            starts: Palm estimates to look up; None: all there may be.
        """
        starts = starts or self.options.starts
        count, layout = len(problems), self.step.parameters
        lower, upper = problems.bounds(self._robot, UNBOUNDED)
        hand = list(self.step.hand)
        found = self.table.nearest(problems.points, problems.normals, starts, q0[:, hand])
        postures = np.zeros((count, self.options.starts, len(hand)))
        postures[:, :starts] = found
        known = [~np.isnan(array[..., 0]) for array in (problems.points, problems.normals)]
        values: dict[str, Any] = {
            "points": np.nan_to_num(problems.points),
            "normals": np.nan_to_num(problems.normals),
            "weights": np.stack(known, axis=2),
            "position_tolerance": problems.position_tolerance,
            "angle_tolerance": problems.angle_tolerance,
            "lower": lower,
            "upper": upper,
            "postures": np.clip(postures, lower[hand], upper[hand]),
            "given": float(starts),
            "first_damping": self.options.damping,
            "step_cap": self.options.step_cap,
        }
        parameters = np.empty((count, layout.size))
        for name, value in values.items():
            rows = np.asarray(value, dtype=float)
            target = parameters[:, layout.slice(name)]
            target[:] = rows.reshape(target.shape) if rows.ndim > 1 else rows
        states = np.zeros((count, self.step.state.size))
        first = {
            "q": q0,
            "passed": -1.0,
            "phase": Phase.CANDIDATE,
            "best_q": q0,
            "best_cost": np.finfo(float).max,
        }
        for name, value in first.items():
            states[:, self.step.state.slice(name)] = value
        return states, parameters

    def run(self, problems: Problems, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch; see `Method.run`. No random numbers are drawn.

        Nearly all targets need one start only, so the others are looked up for those left over.
        """
        del seed
        result, seconds = self._round(problems, q0, 1, None, trace)
        states, status, traces = result.states, result.status.astype(np.int64), list(result.trace)
        left = np.flatnonzero(status != Status.SOLVED)
        if len(left) and self.options.starts > 1:
            some = problems.rows(left)
            again, more = self._round(some, q0[left], self.options.starts, states[left], trace)
            states[left], status[left] = again.states, again.status
            seconds[left] += more
            for row, rows in zip(left, again.trace, strict=False):
                traces[row] = np.concatenate([traces[row], rows])
        last = {name: states[:, self.step.state.slice(name)] for name in ("q", "start", "counts")}
        counts = last["counts"].astype(np.int64)
        return Outcome(
            q=last["q"],
            status=np.where(status < 0, int(Status.INVALID), status),
            iterations=counts.sum(axis=1),
            restarts=np.minimum(last["start"][:, 0], self.options.starts - 1).astype(np.int64),
            time=seconds,
            phases={stage.label: counts[:, i] for i, stage in enumerate(STAGES)},
            rows=np.concatenate(traces) if traces else result.rows,
        )

    def _round(
        self, problems: Problems, q0: Array, starts: int, after: Array | None, trace: bool
    ) -> tuple[LoopResult, Array]:
        """Run the loop with so many starts, on from given states if any; and seconds (k,)."""
        began = time.perf_counter()
        states, parameters = self.start(problems, q0, starts)
        if after is not None:
            states = after.copy()
            states[:, self.step.state.slice("phase")] = Phase.CANDIDATE
        lookup = (time.perf_counter() - began) / max(len(problems), 1)
        result = self.kernel.run(states, parameters, MAX_ITERATIONS, trace)
        return result, result.time + lookup


def _closed_form(robot: RobotDescription) -> SrsArm | None:
    try:
        return srs_arm(robot)
    except UnsupportedError:
        return None
