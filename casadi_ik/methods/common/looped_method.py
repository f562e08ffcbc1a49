"""A method that is one step graph: started, run to its end in compiled code, stepped by hand."""

from __future__ import annotations

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array, Counts
from casadi_ik.errors import RowError, UnsupportedError
from casadi_ik.kernels import LoopKernel, LoopResult, StepGraph
from casadi_ik.kernels.rows import opaque
from casadi_ik.kernels.stepper import Stepper
from casadi_ik.problem.contacts.kinds import Kinds
from casadi_ik.problem.jacobian_measures import JacobianMeasures
from casadi_ik.problem.method import Method, Outcome
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trace import RecordedJacobian, TraceFormat, trace_format
from casadi_ik.robots.description import RobotDescription

Start = tuple[Array, Array]
"""First states (k, ns) and parameters (k, np) of a step graph."""


class LoopedMethod(ABC):
    """A method that is one step graph run to its end, in one or several rounds.

    What a method of this kind has to say of itself are `step_graph` (the iteration, with the
    layouts of its state, parameters and record), `begin` (where solves start) and `phase_counts`
    (what the iterations were spent on). Batches, steps by hand and traces follow from these.

    The state has a field "q" (n,), the configuration to return; the record has the fields that
    `trace_format` names. The step ends a solve with a code of `Status`.

    Attributes:
        name: Name of the method.
        robot: The robot.
        options: Its parameter record, a dataclass.
    """

    name: str

    phases_without_arm: tuple[Phase, ...] = ()
    """Phases in which the arm's part of q means nothing yet: its Jacobian is not measured there."""

    follows_closed_chain: bool = False
    """Whether a log measures the closed chain of arm and thumb, since the method moves along it."""

    max_iterations: int = 100_000
    """Budget of a round. This one is far above what steps allow themselves that end by a status of
    their own."""

    rounds: int = 1
    """How often a solve that has failed is begun again, the first time included."""

    takes_free_contacts: bool = False
    """Whether a finger or its normal may be left free."""

    takes_fixed_actuators: bool = False
    """Whether actuators may be fixed."""

    def __init__(self, robot: RobotDescription, options: Any, compiled: bool = True) -> None:
        """Remember what the method is made of; its loop is built when first needed.

        Args:
            robot: The robot.
            options: The parameter record, a dataclass.
            compiled: False keeps to CasADi's virtual machine.
        """
        self.robot = robot
        self.options = options
        self._compiled = compiled

    @abstractmethod
    def step_graph(self) -> StepGraph:
        """The whole iteration."""

    @abstractmethod
    def begin(
        self, problems: Problems, q0: Array, number: int = 0, last: Array | None = None
    ) -> Start:
        """Where the solves of a batch begin; `Layout.pack_rows` lays it out.

        Args:
            problems: k targets.
            q0: (k, n) configurations to start from.
            number: Of the round, from 0.
            last: (k, ns) states in which the round before ended; None in the first of all. Of a
                later search (see `searches`) round 0 has them too.
        """

    def searches(self, problems: Problems) -> tuple[Problems, ...]:
        """What is asked one after the other of targets that are not solved before: all rounds each.

        A preference orders answers; whether there is one it does not decide.
        """
        return (problems,)

    def rounds_for(self, problems: Problems) -> int:
        """How often solves of targets are begun in one search, the first time included."""
        del problems
        return self.rounds

    def reachable(self, problems: Problems) -> NDArray[np.bool_] | None:
        """(k,) which targets may be reached, where that is easily told; None: all may.

        The others get a first round, which leads near them.
        """
        del problems
        return None

    def hopeful(self, states: Array, number: int) -> NDArray[np.bool_]:
        """(k,) whether failed solves take part in a round after the first.

        Args:
            states: (k, ns) in which they ended.
            number: Of the round.
        """
        del number
        return np.ones(len(states), dtype=bool)

    @abstractmethod
    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Iterations by phase.

        Args:
            states: (k, ns) last states.
            iterations: (k,) iterations of all rounds.
        """

    def finish(
        self, problems: Problems, q0: Array, last: LoopResult, number: int, rounds: int
    ) -> LoopResult | None:
        """All rounds from one on for targets that are not solved, if there is a shorter way.

        Searches that follow are made, too.

        Args:
            problems: k targets.
            q0: (k, n).
            last: How the rounds before ended, its statuses codes of `Status`.
            number: The first of the rounds.
            rounds: How many there are with those before.

        Returns:
            How they end, likewise, with the iterations and seconds of these rounds alone; None:
            they are made one after the other, for all targets at once.
        """
        del problems, q0, last, number, rounds
        return None

    def restarts(self, states: Array) -> Counts:
        """(k,) how often the solves began anew, from their last states (k, ns)."""
        return np.zeros(len(states), dtype=np.int64)

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """The Jacobians in the record, as in `TraceFormat`."""
        return {}

    @cached_property
    def graph(self) -> StepGraph:
        """The step graph, made once."""
        return self.step_graph()

    @cached_property
    def kernel(self) -> LoopKernel:
        """The compiled loop; the virtual machine for a step that has no C code."""
        return LoopKernel(self.graph, self._compiled)

    @cached_property
    def _measures(self) -> JacobianMeasures:
        return JacobianMeasures(
            self.robot,
            without_arm=self.phases_without_arm,
            closed_chain=self.follows_closed_chain,
            compiled=self._compiled,
        )

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        return trace_format(self.graph.record, self.robot, self.jacobians, self._measures)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def prepare(self) -> None:
        """Build and compile the loop."""
        _ = self.kernel

    def for_kinds(self, kinds: Kinds) -> Method:
        """Itself: a method that knows points with normals only refuses all else in `run`."""
        del kinds
        return self

    def stepper(self, problems: Problems, q0: Array) -> Stepper:
        """One target, one iteration at a time; see `Method.stepper`."""
        self._check(problems)
        rounds = product(self.searches(problems), range(self.rounds_for(problems)))
        first, _ = next(rounds)

        def next_round(status: int, state: Array) -> Start | None:
            if status == Status.SOLVED:
                return None
            for asked, number in rounds:
                if self.hopeful(state[None], number)[0]:
                    states, parameters = self.begin(asked, q0[None], number, state[None])
                    return states[0], parameters[0]
            return None

        states, parameters = self.begin(first, q0[None])
        return Stepper(self.graph, states[0], parameters[0], next_round)

    def run(
        self, problems: Problems, q0: Array, seed: int, trace: bool, rounds: int | None = None
    ) -> Outcome:
        """Solve a batch; see `Method.run`. No random numbers are drawn.

        `rounds` are so many of each search at most instead of all.
        """
        del seed
        self._check(problems)
        count = len(problems)
        iterations, seconds = np.zeros(count, dtype=np.int64), np.zeros(count)
        records = _Records(count)
        states = np.empty((count, self.graph.state.size))
        status = np.empty(count, dtype=np.int64)
        left, some, here, last = np.arange(count), problems, q0, None
        every = self.rounds_for(problems)
        every = every if rounds is None else min(every, rounds)
        possible: NDArray[np.bool_] | None = None
        for place, (asked, number) in enumerate(product(self.searches(problems), range(every))):
            if place:
                left = np.flatnonzero(status != Status.SOLVED)
                if place == 1 and len(left):
                    possible = self.reachable(problems)
                left = left if possible is None else left[possible[left]]
                if not len(left):
                    break
                if number and not trace:
                    codes = status[left].astype(np.int32)
                    before = LoopResult(states[left], iterations[left], codes, seconds[left])
                    ends = self.finish(asked.rows(left), q0[left], before, number, every)
                    if ends is not None:
                        states[left], status[left] = ends.states, ends.status
                        iterations[left] += ends.iterations
                        seconds[left] += ends.time
                        break
                left = left[self.hopeful(states[left], number)]
                if not len(left):
                    continue
                some, here, last = asked.rows(left), q0[left], states[left]
            begun = time.perf_counter()
            first, parameters = self.begin(some, here, number, last)
            result = self.kernel.run(first, parameters, self.max_iterations, trace)
            ended = Status.from_loop(result.status)
            outside = time.perf_counter() - begun - result.time.sum()
            if last is None:
                states, status = result.states, ended
            else:
                states[left], status[left] = result.states, ended
            iterations[left] += result.iterations
            # What is done for all solves at once counts for each of them alike.
            seconds[left] += result.time + max(outside, 0.0) / max(len(left), 1)
            if result.rows is not None:
                records.add(left, result.iterations, result.rows)
        counts = self.phase_counts(states, iterations)
        return Outcome(
            # A copy: the states are much larger and need not stay.
            q=states[:, self.graph.state.slice("q")].copy(),
            status=status,
            iterations=iterations,
            restarts=self.restarts(states),
            time=seconds,
            phases={phase.label: spent for phase, spent in counts.items()},
            rows=records.by_target() if trace else None,
        )

    def _check(self, problems: Problems) -> None:
        if problems.fixed is not None and not self.takes_fixed_actuators:
            raise UnsupportedError(f"method {self.name!r} cannot keep actuators fixed")
        if self.takes_free_contacts:
            return
        for name, array in problems.more.items():
            given = np.argwhere(~np.isnan(array[..., 0]))
            if len(given):
                row, finger = problems.number(int(given[0, 0])), given[0, 1]
                raise RowError(
                    f"method {self.name!r} needs point and normal of every finger and knows no "
                    f"{name}; row {row} has one for {self.robot.finger_names[finger]!r}",
                    row,
                )
        for name, array in (("contact", problems.points), ("normal", problems.normals)):
            free = np.argwhere(np.isnan(array[..., 0]))
            if len(free):
                row, finger = problems.number(int(free[0, 0])), free[0, 1]
                raise RowError(
                    f"method {self.name!r} needs a {name} for every finger; row {row} has none for "
                    f"{self.robot.finger_names[finger]!r}",
                    row,
                )


class _Records:
    """The records of a batch whose targets may take several rounds."""

    def __init__(self, count: int) -> None:
        self._rounds: list[tuple[NDArray[np.intp], Counts, NDArray[Any]]] = []
        self._counts = np.zeros(count, dtype=np.int64)

    def add(self, targets: NDArray[np.intp], iterations: Counts, rows: NDArray[Any]) -> None:
        """Add a round: the rows of some targets, (sum of their iterations,)."""
        self._rounds.append((targets, iterations, rows))
        self._counts[targets] += iterations

    def by_target(self) -> NDArray[Any]:
        """The rows of all rounds, target by target."""
        first = self._rounds[0][2]
        if len(self._rounds) == 1:
            return first
        ordered = np.empty(int(self._counts.sum()), first.dtype)
        free = np.cumsum(self._counts) - self._counts
        for targets, iterations, rows in self._rounds:
            begins = np.cumsum(iterations) - iterations
            places = np.arange(len(rows)) + np.repeat(free[targets] - begins, iterations)
            opaque(ordered)[places] = opaque(rows)
            free[targets] += iterations
        return ordered
