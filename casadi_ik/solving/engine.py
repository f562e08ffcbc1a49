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
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.problem.diagnosis import Reason
from casadi_ik.problem.method import Method, Outcome, QuickMethod
from casadi_ik.problem.problems import Array, Problems
from casadi_ik.problem.recorder import Recorder, SolveBlock
from casadi_ik.problem.solution import BatchSolution, Solution
from casadi_ik.problem.status import Status
from casadi_ik.problem.verdict import judge, judge_one
from casadi_ik.solving.alternatives.finder import AlternativeFinder
from casadi_ik.solving.alternatives.tracking import Tracker
from casadi_ik.solving.diagnosis.diagnostician import Diagnostician
from casadi_ik.solving.parts import Parts

MANIPULABILITY = "manipulability"
"""The preference that is seen to after the solve."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A part of a batch, solved: when it was begun [ns], and what it came to."""

    problems: Problems
    starts: Array
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
    def _quick(self) -> QuickMethod | None:
        return self.method if isinstance(self.method, QuickMethod) else None

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

    def quick(self, problems: Problems, q0: ArrayLike | None, seed: int) -> Solution | None:
        """The answer to one target if it is solved at once, by the shortest way; None: `solve` it.

        Args:
            problems: One target.
            q0: (n,) start; None is the robot's home.
            seed: As for `solve`, which draws numbers for hard targets only.

        Raises:
            InputError: Bad q0 or seed.
        """
        method, robot = self._quick, self.robot
        if method is None or problems.prefer == MANIPULABILITY:
            return None
        start = robot.configuration(q0, "q0")
        _whole("seed", seed, 0)
        if start.ndim != 1:
            return None
        self.method.prepare()
        begin = time.perf_counter()
        found = method.quick(problems, start)
        seconds = time.perf_counter() - begin
        if found is None:
            return None
        verdict = judge_one(robot, problems, found.q)
        if verdict is None:
            return None
        return Solution(
            success=True,
            status=Status.SOLVED,
            q=found.q,
            iterations=found.iterations,
            restarts=found.restarts,
            time=seconds,
            contacts=dict(zip(robot.fingers, verdict.contacts, strict=True)),
            phases=found.phases,
            limits_ok=verdict.limits_ok,
            method=self.method.name,
            robot=robot.name,
            actuators=robot.actuators,
        )

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
        _whole("jobs", jobs, 1)
        _whole("seed", seed, 0)
        # Built before the clock and the threads start: no work of a solve, nor for several at once.
        self.method.prepare()
        batches = []
        for part in self._parts(problems, starts, int(seed), int(jobs), recorder, diagnose):
            if recorder is not None and part.outcome.rows is not None:
                recorder.record(self._block(part, int(seed), part.outcome.rows))
            batches.append(part.batch)
        return BatchSolution.joined(batches)

    def _starts(self, q0: ArrayLike | None, count: int) -> Array:
        start = self.robot.configuration(q0, "q0")
        if start.ndim == 1:
            return np.repeat(start[None], count, axis=0)
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
            if problems.prefer == MANIPULABILITY:
                outcome = self._most_manipulable(asked, starts[rows], seed, outcome)
            batch = self._judged(asked, outcome)
            if diagnose:
                batch = self._diagnosed(asked, starts[rows], outcome, batch)
            return _Part(asked, starts[rows], started, outcome, batch)

        if diagnose:
            _ = self.diagnostician
        if problems.prefer == MANIPULABILITY:
            _ = self.finder
        if jobs == 1 and not trace:
            yield run(slice(0, len(problems)))
            return
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

    def _most_manipulable(
        self, problems: Problems, starts: Array, seed: int, outcome: Outcome
    ) -> Outcome:
        """Every hand where it is, held by the arm of the best measure."""
        begin, q = time.perf_counter(), outcome.q.copy()
        rows = np.flatnonzero(outcome.status == Status.SOLVED)
        for row in rows:
            one = problems.rows(slice(row, row + 1))
            q[row] = self.finder.best_arm(one, q[row], starts[row], seed, MANIPULABILITY)
        seconds = outcome.time.copy()
        seconds[rows] += (time.perf_counter() - begin) / max(len(rows), 1)
        return replace(outcome, q=q, time=seconds)

    def _judged(self, problems: Problems, outcome: Outcome) -> BatchSolution:
        verdict = judge(self.robot, problems, outcome.q)
        success = verdict.solved(problems.enforce_limits)
        status, content = outcome.status, outcome.status == Status.SOLVED
        if (content != success).any():
            # A method that is content with what the verdict refuses has come to a standstill.
            status = np.where(content, int(Status.STALLED), status)
            status[success] = Status.SOLVED
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
        unbiased = replace(problems.rows(rows), prefer="limits")
        diagnoses = self.diagnostician.diagnose(unbiased, starts[rows], q[rows] if own else None)
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

    def _block(self, part: _Part, seed: int, rows: NDArray[Any]) -> SolveBlock:
        batch = part.batch
        before = np.concatenate([[0.0], np.cumsum(batch.time)[:-1]])[: len(batch)]
        return SolveBlock(
            method=self.method.name,
            robot=self.robot.name,
            fingers=self.robot.fingers,
            format=self.method.trace_format,
            first=part.problems.first_row,
            problems=part.problems,
            starts=part.starts,
            seed=seed,
            batch=batch,
            rows=rows,
            started=part.started + (before * 1e9).astype(np.int64),
        )


def _whole(name: str, value: object, least: int) -> None:
    if not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name}: found {value!r}, expected an integer >= {least}")
