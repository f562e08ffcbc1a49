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
from casadi_ik.kernels import FunctionKernel, LoopKernel, LoopResult
from casadi_ik.kernels.rows import opaque
from casadi_ik.methods.common.coupling_record import coupling_jacobian
from casadi_ik.methods.common.posture_table import PostureTable
from casadi_ik.methods.hand_first.beginning import beginning
from casadi_ik.methods.hand_first.first_round import FirstRound
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.state import STAGE_LABELS, HandFirstLayouts
from casadi_ik.methods.hand_first.step import HandFirstStep
from casadi_ik.problem.method import Outcome, Quick
from casadi_ik.problem.preference import PREFERENCES
from casadi_ik.problem.problems import Array, Problems
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trace import RESTART, TraceFormat, trace_format
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.srs_arm import SrsArm, srs_arm

UNBOUNDED = 1e3
"""Bounds [rad or m] where limits are ignored."""

AT_LIMITS = 0.5
"""Part of the range that the wide table moves to the limits."""

NEAREST = "q0"
"""The preference for what is near the start."""

TINY = 1e-9
"""Smallest range [rad or m] a motion is measured by."""

CARRIED = ("passed", "near", "balanced")
"""What a round leaves to the next: how far the numeric arm's list of starts is through, and which
fits were balanced in vain."""

MAX_ITERATIONS = 100_000
"""Far above what the stages' own budgets allow: the loop always ends by a status."""


class HandFirstMethod:
    """`hand-first`: contacts fix palm and hand, the arm follows in closed form.

    Attributes:
        name: Name of the method.
        options: Its numbers.
        preferences: What it can prefer.
    """

    name = "hand-first"
    preferences = PREFERENCES

    def __init__(
        self, robot: RobotDescription, options: HandFirstParameters, compiled: bool = True
    ) -> None:
        """Recognise the arm and lay out the step."""
        self.options = options
        self._robot = robot
        self._compiled = compiled
        self.step = HandFirstStep(robot, _closed_form(robot), options.candidates)
        self._singles: list[FirstRound] = []

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop."""
        return LoopKernel(self.step.graph(), self._compiled)

    @cached_property
    def table(self) -> PostureTable:
        """The hand postures that targets are compared with."""
        return self._table(self.options.table)

    @cached_property
    def wide_table(self) -> PostureTable:
        """Many more postures, a good part of them at limits, for targets the first round misses."""
        return self._table(self.options.wide_table, AT_LIMITS)

    def _table(self, size: int, at_limits: float = 0.0) -> PostureTable:
        hand = self.step.layouts.hand
        return PostureTable(ArmHand(self._robot), hand, size, at_limits, compiled=self._compiled)

    def prepare(self) -> None:
        """Build and compile the loop, and fill the table of the first round."""
        _ = self.kernel, self.table, self._beginning

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
        again = [self.step.layouts.state.slice(name).start for name in ("phase", "candidate")]
        carried = [self.step.layouts.state.slice(name).start for name in CARRIED]
        collected = _Collected(self.step.layouts)
        left, waiting, here = problems, np.arange(len(problems)), q0
        done: Array | None = None
        for number in range(self.options.rounds):
            begin = time.perf_counter()
            postures = self.postures(left, number)
            if left.prefer == NEAREST:
                postures = self.order(postures, here, own=number == 0)
            states, parameters = self.rows(left, here, postures)
            if done is not None:
                states[:, carried] = done
                states[:, again] = Phase.CANDIDATE, 0.0
            result = self.kernel.run(states, parameters, MAX_ITERATIONS, trace)
            besides = time.perf_counter() - begin - result.time.sum()
            collected.take(waiting, result, besides / max(len(left), 1))
            missed = np.flatnonzero(result.status != Status.SOLVED)
            if not len(missed):
                break
            left, waiting, here = left.rows(missed), waiting[missed], here[missed]
            done = result.states[np.ix_(missed, carried)]
        return collected.outcome(trace)

    def quick(self, problems: Problems, q0: Array) -> Quick | None:
        """The first round of one target; see `QuickMethod.quick`."""
        if not self.kernel.compiled:
            return None
        try:
            first = self._singles.pop()
        except IndexError:
            first = FirstRound(
                self.table, self._beginning, self.kernel, self.step.layouts, self.order
            )
        found = first(problems, q0, self._terms(problems), MAX_ITERATIONS)
        self._singles.append(first)
        return found

    def rows(self, problems: Problems, q0: Array, postures: Array) -> tuple[Array, Array]:
        """States and parameters of the loop, to be changed before `run_rows`.

        Args:
            problems: k targets.
            q0: (k, n).
            postures: (k, candidates, hand) hand postures to start from, or (k, 1, hand). Motors
                that move free fingers only stay as in q0.

        Returns:
            (k, ...) states and parameters.
        """
        hand = len(self.step.layouts.hand)
        tried = np.broadcast_to(postures, (len(problems), self.options.candidates, hand))
        asked = problems.points, problems.normals, q0, self._terms(problems), tried
        states, parameters = self._beginning(*asked)
        return states, parameters

    def run_rows(self, states: Array, parameters: Array, trace: bool = False) -> LoopResult:
        """Run the compiled loop on rows as made by `rows`."""
        return self.kernel.run(states, parameters, MAX_ITERATIONS, trace)

    def postures(self, problems: Problems, number: int) -> Array:
        """Candidates (k, candidates, hand) of a round: first from the table, then the wide one.

        Args:
            problems: k targets.
            number: The round.
        """
        count = self.options.candidates
        table, wanted = (self.wide_table, number * count) if number else (self.table, count)
        return table.nearest(problems.points, problems.normals, wanted)[:, -count:]

    def order(self, postures: Array, q0: Array, own: bool) -> Array:
        """Hand postures (k, c, hand), those nearest to q0 (k, n) first.

        Args:
            postures: The postures.
            q0: Where the robot is.
            own: Whether its own posture comes first, instead of the last of them.
        """
        hand = list(self.step.layouts.hand)
        here = q0[:, None, hand]
        if own:
            postures = postures[:, : max(postures.shape[1] - 1, 1)]
        ranges = np.maximum((self._robot.upper - self._robot.lower)[hand], TINY)
        distance = (((postures - here) / ranges) ** 2).sum(axis=2)
        rows = np.argsort(distance, axis=1, kind="stable")[:, :, None]
        ordered = np.take_along_axis(postures, rows, axis=1)
        if not own or self.options.candidates == 1:
            return ordered
        return np.concatenate([here, ordered], axis=1)

    def _terms(self, problems: Problems) -> Array:
        """What `beginning` calls terms."""
        bounds = problems.bounds(self._robot, UNBOUNDED)
        nearest = [float(problems.prefer == NEAREST)]
        tolerances = problems.position_tolerance, problems.angle_tolerance
        return np.concatenate([*tolerances, *bounds, nearest])

    @cached_property
    def _beginning(self) -> FunctionKernel:
        return FunctionKernel(beginning(self.step.layouts), self._compiled)


class _Collected:
    """Results of a batch whose targets may take several rounds; the best of a target is kept."""

    def __init__(self, layouts: HandFirstLayouts) -> None:
        self._layouts = layouts
        self._rounds: list[NDArray[Any]] = []
        self._targets: list[NDArray[np.intp]] = []

    def take(self, targets: NDArray[np.intp], result: LoopResult, share: float) -> None:
        """Take a round of some targets, the first time of all; `share` of them is time besides."""
        state, before = self._layouts.state, self._layouts.candidates * len(self._rounds)
        states = result.states
        q, cost = states[:, state.slice("q")], states[:, state.slice("best_cost").start]
        counts = states[:, state.slice("counts")].astype(np.int64)
        candidate = states[:, state.slice("candidate").start].astype(np.int64)
        restarts = before + np.minimum(candidate, self._layouts.candidates - 1)
        status = result.status.astype(np.int64)
        status[status < 0] = Status.INVALID
        if result.rows is not None:
            result.rows[RESTART.name] += before
        if not self._rounds:
            # A copy: the states are much larger and need not stay.
            self._q, self._cost, self._counts = q.copy(), cost.copy(), counts
            self._restarts, self._status, self._time = restarts, status, result.time + share
        else:
            better = (status == Status.SOLVED) | (cost < self._cost[targets])
            self._q[targets[better]], self._cost[targets[better]] = q[better], cost[better]
            self._counts[targets] += counts
            self._restarts[targets], self._status[targets] = restarts, status
            self._time[targets] += result.time + share
        self._rounds.append(result.rows if result.rows is not None else np.zeros(0))
        self._targets.append(np.repeat(targets, result.iterations))

    def outcome(self, trace: bool) -> Outcome:
        """What became of the batch."""
        return Outcome(
            q=self._q,
            status=self._status,
            iterations=self._counts.sum(axis=1),
            restarts=self._restarts,
            time=self._time,
            phases={label: self._counts[:, i] for i, label in enumerate(STAGE_LABELS)},
            rows=self._rows if trace else None,
        )

    @property
    def _rows(self) -> NDArray[Any]:
        """The records of all rounds, target by target."""
        if len(self._rounds) == 1:
            return self._rounds[0]
        order = np.argsort(np.concatenate(self._targets), kind="stable")
        rows = np.concatenate(list(map(opaque, self._rounds)))
        return np.take(rows, order).view(self._rounds[0].dtype)


def _closed_form(robot: RobotDescription) -> SrsArm | None:
    try:
        return srs_arm(robot)
    except UnsupportedError:
        return None
