"""The hand-first method: lookup of postures, then one compiled loop over all stages."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels import LoopKernel, LoopResult
from casadi_ik.robots.description import RobotDescription
from casadi_ik.solvers.method import Outcome, TraceFormat, trace_format
from casadi_ik.solvers.posture_table import PostureTable
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.steps.coupling_record import coupling_jacobian
from casadi_ik.steps.hand_first import HandFirstStep
from casadi_ik.steps.hand_first_parameters import HandFirstParameters
from casadi_ik.steps.hand_first_state import STAGES, HandFirstLayouts
from casadi_ik.steps.status import Phase, Status
from casadi_ik.symbolic.srs_arm import SrsArm, srs_arm

UNBOUNDED = 1e3
"""Bounds [rad or m] where limits are ignored."""

AT_LIMITS = 0.5
"""Part of the range that the wide table moves to the limits."""

MAX_ITERATIONS = 100_000
"""Far above what the stages' own budgets allow: the loop always ends by a status."""


class HandFirstMethod:
    """`hand-first`: contacts fix palm and hand, the arm follows in closed form.

    Attributes:
        name: Name of the method.
        options: Its numbers.
    """

    name = "hand-first"

    def __init__(
        self, robot: RobotDescription, options: HandFirstParameters, compiled: bool = True
    ) -> None:
        """Recognise the arm and lay out the step."""
        self.options = options
        self._robot = robot
        self._compiled = compiled
        self.step = HandFirstStep(robot, _closed_form(robot), options.candidates)

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop."""
        return LoopKernel(self.step.graph(), self._compiled)

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures that targets are compared with."""
        return PostureTable(ArmHand(self._robot), self.step.layouts.hand, self.options.table)

    @cached_property
    def wide_table(self) -> PostureTable:
        """Many more postures, a good part of them at limits, for targets the first round misses."""
        robot, options = ArmHand(self._robot), self.options
        return PostureTable(robot, self.step.layouts.hand, options.wide_table, AT_LIMITS)

    def prepare(self) -> None:
        """Build and compile the loop, and fill the table of the first round."""
        _ = self.kernel, self.table

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        return trace_format(self.step.layouts.record, self._robot, coupling_jacobian(self._robot))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def run(self, problems: Problems, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch; see `Method.run`. No random numbers are drawn."""
        del seed
        options, layouts = self.options, self.step.layouts
        count = len(problems)
        outcome = _Collected(count, len(self._robot.actuators), layouts.record.dtype)
        waiting = np.arange(count)
        states = self._states(q0)
        passed = layouts.state.slice("passed")
        for number in range(options.rounds if count else 0):
            begin = time.perf_counter()
            first = number * options.candidates
            chosen = problems.rows(waiting)
            lookup = self.postures(chosen, q0[waiting], number)
            parameters = self._parameters(chosen, q0[waiting], lookup)
            outcome.time[waiting] += (time.perf_counter() - begin) / max(len(waiting), 1)
            result = self.kernel.run(states[waiting], parameters, MAX_ITERATIONS, trace)
            outcome.take(layouts, waiting, result, first)
            # The next round goes on where this one stopped in the numeric arm's list of starts.
            states[waiting, passed] = result.states[:, passed]
            waiting = waiting[result.status != Status.SOLVED]
            if not len(waiting):
                break
        return Outcome(
            q=outcome.q,
            status=outcome.status,
            iterations=outcome.counts.sum(axis=1),
            restarts=outcome.restarts,
            time=outcome.time,
            phases={stage.label: outcome.counts[:, i] for i, stage in enumerate(STAGES)},
            rows=outcome.rows if trace else None,
        )

    def rows(self, problems: Problems, q0: Array, postures: Array) -> tuple[Array, Array]:
        """States and parameters of the loop, to be changed before `run_rows`.

        Args:
            problems: k targets.
            q0: (k, n).
            postures: (k, candidates, hand) hand postures to start from, or (k, 1, hand).

        Returns:
            (k, ...) states and parameters.
        """
        return self._states(q0), self._parameters(problems, q0, postures)

    def run_rows(self, states: Array, parameters: Array, trace: bool = False) -> LoopResult:
        """Run the compiled loop on rows as made by `rows`."""
        return self.kernel.run(states, parameters, MAX_ITERATIONS, trace)

    def postures(self, problems: Problems, q0: Array, number: int) -> Array:
        """Candidates (k, candidates, hand) of a round: first from the table, then the wide one.

        What moves free fingers only stays as in q0.

        Args:
            problems: k targets.
            q0: (k, n).
            number: The round.
        """
        count = self.options.candidates
        table, wanted = (self.wide_table, number * count) if number else (self.table, count)
        found = table.nearest(problems.points, problems.normals, wanted)[:, -count:]
        needed = ~np.isnan(problems.points[..., 0]) @ self._moves
        return np.where(needed[:, None], found, q0[:, None, self.step.layouts.hand])

    def _parameters(self, problems: Problems, q0: Array, postures: Array) -> Array:
        layout = self.step.layouts.parameters
        count = len(problems)
        lower, upper = problems.bounds(self._robot, UNBOUNDED)
        hand = list(self.step.layouts.hand)
        shape = count, self.options.candidates, len(hand)
        inside = np.broadcast_to(np.clip(postures, lower[hand], upper[hand]), shape)
        free_points, free_normals = np.isnan(problems.points), np.isnan(problems.normals)
        counted = ~np.stack([free_points[..., 0], free_normals[..., 0]], axis=2)
        values: dict[str, Any] = {
            "points": np.where(free_points, 0.0, problems.points).reshape(count, -1),
            "normals": np.where(free_normals, 0.0, problems.normals).reshape(count, -1),
            "weights": counted.reshape(count, -1),
            "position_tolerance": problems.position_tolerance,
            "angle_tolerance": problems.angle_tolerance,
            "lower": lower,
            "upper": upper,
            "postures": inside.reshape(count, -1),
            "reach": 1.0,
            "alone": 0.0,
            "start": np.clip(q0, lower, upper),
        }
        parameters = np.empty((count, layout.size))
        for name, value in values.items():
            parameters[:, layout.slice(name)] = value
        return parameters

    @cached_property
    def _moves(self) -> NDArray[np.bool_]:
        """(f, hand) whether a motor of the hand moves a finger."""
        robot, hand = self._robot, self.step.layouts.hand
        return np.array([np.isin(hand, robot.finger_actuators(f)) for f in robot.finger_names])

    def _states(self, q0: Array) -> Array:
        layout = self.step.layouts.state
        states = np.zeros((len(q0), layout.size))
        states[:, layout.slice("q")] = q0
        states[:, layout.slice("best_q")] = q0
        states[:, layout.slice("phase")] = Phase.CANDIDATE
        states[:, layout.slice("best_cost")] = np.finfo(float).max
        return states


class _Collected:
    """Results of a batch whose rows may take several rounds; the best of a row is kept."""

    def __init__(self, count: int, n: int, record: np.dtype[Any]) -> None:
        self.q = np.zeros((count, n))
        self.status = np.full(count, int(Status.STALLED), dtype=np.int64)
        self.restarts = np.zeros(count, dtype=np.int64)
        self.counts = np.zeros((count, len(STAGES)), dtype=np.int64)
        self.time = np.zeros(count)
        self._rounds = [np.zeros(0, record)]
        self._targets = [np.zeros(0, np.intp)]
        self._cost = np.full(count, np.inf)

    def take(
        self, layouts: HandFirstLayouts, rows: NDArray[np.intp], result: LoopResult, before: int
    ) -> None:
        """Take the results of some rows; `before` candidates were tried in earlier rounds."""
        state = layouts.state
        solved = result.status == Status.SOLVED
        cost = result.states[:, state.slice("best_cost")][:, 0]
        better = solved | (cost < self._cost[rows])
        kept = rows[better]
        self.q[kept] = result.states[better][:, state.slice("q")]
        self._cost[kept] = cost[better]
        self.status[rows] = np.where(result.status < 0, int(Status.INVALID), result.status)
        candidate = result.states[:, state.slice("candidate")][:, 0].astype(np.int64)
        self.restarts[rows] = before + np.minimum(candidate, layouts.candidates - 1)
        self.counts[rows] += result.states[:, state.slice("counts")].astype(np.int64)
        self.time[rows] += result.time
        if result.rows is not None:
            result.rows["candidate"] += before
            self._rounds.append(result.rows)
            self._targets.append(np.repeat(rows, result.iterations))

    @property
    def rows(self) -> NDArray[Any]:
        """The records of all rounds, target by target."""
        if len(self._rounds) == 2:
            return self._rounds[1]
        order = np.argsort(np.concatenate(self._targets), kind="stable")
        return np.concatenate(self._rounds)[order]


def _closed_form(robot: RobotDescription) -> SrsArm | None:
    try:
        return srs_arm(robot)
    except UnsupportedError:
        return None
