"""The one way a batch is solved: checked, run (in parallel if asked), judged, recorded."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.solvers.alternatives import AlternativeFinder
from casadi_ik.solvers.diagnosis import Reason
from casadi_ik.solvers.diagnostician import Diagnostician
from casadi_ik.solvers.hand_first import HandFirstMethod
from casadi_ik.solvers.method import Method, Outcome
from casadi_ik.solvers.parts import Parts
from casadi_ik.solvers.problem import Array, Problems
from casadi_ik.solvers.recorder import Recorder, SolveBlock
from casadi_ik.solvers.solution import BatchSolution
from casadi_ik.solvers.tracking import Tracker
from casadi_ik.solvers.verdict import judge
from casadi_ik.steps.hand_first_parameters import HandFirstParameters
from casadi_ik.steps.status import Status


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of a batch, solved: when it was begun [ns], and what it came to."""

    problems: Problems
    started: int
    outcome: Outcome
    batch: BatchSolution


@dataclass(frozen=True, eq=False)
class Engine:
    """A method on a robot.

    Attributes:
        robot: The robot.
        method: The method, built for this robot.
        compiled: Whether what a diagnosis needs besides runs in compiled code.
    """

    robot: ArmHand
    method: Method
    compiled: bool = True

    @cached_property
    def diagnostician(self) -> Diagnostician:
        """Who says why a target was not solved; asks hand-first, whichever the method is."""
        method = self.method
        if not isinstance(method, HandFirstMethod):
            method = HandFirstMethod(self.robot.description, HandFirstParameters(), self.compiled)
        return Diagnostician(self.robot, method)

    @property
    def _hand_first(self) -> HandFirstMethod:
        method = self.method
        if not isinstance(method, HandFirstMethod):
            raise UnsupportedError(
                f"method {method.name!r} gives one solution; several need {HandFirstMethod.name!r}"
            )
        method.prepare()
        return method

    @cached_property
    def finder(self) -> AlternativeFinder:
        """Who finds several solutions.

        Raises:
            UnsupportedError: The method is not hand-first.
        """
        return AlternativeFinder(self.robot, self._hand_first, self.compiled)

    @cached_property
    def tracker(self) -> Tracker:
        """Who follows moving grasps.

        Raises:
            UnsupportedError: The method is not hand-first.
        """
        return Tracker(self.robot, self._hand_first, self.finder)

    def solve(
        self,
        problems: Problems,
        q0: ArrayLike | None,
        seed: int,
        jobs: int = 1,
        recorder: Recorder | None = None,
        diagnose: bool = False,
    ) -> BatchSolution:
        """Solve a batch of k targets.

        Args:
            problems: The targets.
            q0: (n,) or (k, n) start; None is the robot's home.
            seed: Of all random numbers.
            jobs: Threads; compiled loops run side by side.
            recorder: Who keeps the iterations, if anyone.
            diagnose: Whether to find out why what is not solved is not.

        Raises:
            InputError: Bad q0, seed or jobs, or targets the method cannot take.
        """
        starts = self._starts(q0, len(problems))
        for name, value, least in (("jobs", jobs, 1), ("seed", seed, 0)):
            if not isinstance(value, (int, np.integer)) or value < least:
                raise InputError(f"{name}: found {value!r}, expected an integer >= {least}")
        # Built before the clock and the threads start: no work of a solve, nor for several at once.
        self.method.prepare()
        batches = []
        for part in self._parts(problems, starts, int(seed), int(jobs), recorder, diagnose):
            if recorder is not None and part.outcome.rows is not None:
                recorder.record(self._block(part, part.outcome.rows))
            batches.append(part.batch)
        return BatchSolution.joined(batches)

    def _starts(self, q0: ArrayLike | None, count: int) -> Array:
        start = self.robot.configuration(q0, "q0")
        if start.ndim == 1:
            return np.tile(start, (count, 1))
        if len(start) != count:
            raise InputError(
                f"q0: found {len(start)} rows for {count} targets, expected as many, or one (n,)"
            )
        return start

    def _parts(
        self,
        problems: Problems,
        starts: Array,
        seed: int,
        jobs: int,
        recorder: Recorder | None,
        diagnose: bool,
    ) -> Iterator[_Part]:
        """Parts of the batch in order, solved, judged and diagnosed side by side."""
        trace = recorder is not None

        def run(rows: slice) -> _Part:
            started, asked = time.time_ns(), problems.rows(rows)
            outcome = self.method.run(asked, starts[rows], seed, trace)
            if outcome.rows is not None:
                parts.learn(len(outcome.q), outcome.rows.nbytes)
            batch = self._judged(asked, outcome)
            if diagnose:
                batch = self._diagnosed(asked, starts[rows], outcome, batch)
            return _Part(asked, started, outcome, batch)

        if diagnose:
            _ = self.diagnostician
        parts = Parts(len(problems), jobs, trace)
        if jobs == 1:
            yield from map(run, parts)
            return
        with ThreadPoolExecutor(jobs) as pool:
            ahead: deque[Future[_Part]] = deque()
            for part in parts:
                ahead.append(pool.submit(run, part))
                if len(ahead) > jobs:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def _judged(self, problems: Problems, outcome: Outcome) -> BatchSolution:
        verdict = judge(self.robot, problems, outcome.q)
        success = verdict.solved(problems.enforce_limits)
        status = np.where(success, int(Status.SOLVED), outcome.status)
        # A method that is content with what the verdict refuses has come to a standstill.
        status = np.where(~success & (status == Status.SOLVED), int(Status.STALLED), status)
        return BatchSolution(
            success=success,
            status=status,
            q=outcome.q,
            iterations=outcome.iterations,
            restarts=outcome.restarts,
            time=outcome.time,
            position_error=verdict.position_error,
            angle_error=verdict.angle_error,
            ok=verdict.ok,
            limits_ok=verdict.limits_ok,
            phases=outcome.phases,
            tolerances=problems.tolerances,
        )

    def _diagnosed(
        self, problems: Problems, starts: Array, outcome: Outcome, batch: BatchSolution
    ) -> BatchSolution:
        """Say why; where hand-first's own diagnosis comes upon a solution, that is the answer."""
        if batch.success.all():
            return replace(batch, diagnoses=(None,) * len(batch))
        own = isinstance(self.method, HandFirstMethod)
        q, seconds = outcome.q.copy(), outcome.time.copy()
        rows = np.flatnonzero(~batch.success)
        diagnoses = self.diagnostician.diagnose(
            problems.rows(rows), starts[rows], q[rows] if own else None
        )
        found = dict(zip(rows.tolist(), diagnoses, strict=True))
        for row, why in found.items():
            if own and why.reason is Reason.REACHABLE:
                q[row] = why.q
                seconds[row] += why.time
        batch = self._judged(problems, replace(outcome, q=q, time=seconds))
        diagnoses = tuple(
            None if solved else found[row] for row, solved in enumerate(batch.success)
        )
        status = batch.status.copy()
        unreachable = [why is not None and why.established for why in diagnoses]
        status[unreachable] = Status.UNREACHABLE
        return replace(batch, status=status, diagnoses=diagnoses)

    def _block(self, part: _Part, rows: NDArray[Any]) -> SolveBlock:
        batch = part.batch
        before = np.concatenate([[0.0], np.cumsum(batch.time)[:-1]])[: len(batch)]
        return SolveBlock(
            method=self.method.name,
            robot=self.robot.name,
            fingers=self.robot.fingers,
            format=self.method.trace_format,
            first=part.problems.first_row,
            problems=part.problems,
            batch=batch,
            rows=rows,
            started=part.started + (before * 1e9).astype(np.int64),
        )
