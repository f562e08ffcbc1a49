"""The one way a batch is solved: checked, run (in parallel if asked), judged, recorded."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from casadi_ik.answers.diagnosis import Diagnosis, Reason
from casadi_ik.answers.solution import BatchSolution, Solution
from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.in_background import InBackground
from casadi_ik.made import made
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.problem.clearance import CollisionQuery, SceneCheck
from casadi_ik.problem.contacts import Kinds, by_kinds, usual
from casadi_ik.problem.method import Method, Outcome, PreferringMethod, Quick, QuickMethod
from casadi_ik.problem.request import CLEARANCE, NO_PREFERENCE, preference
from casadi_ik.problem.status import Status
from casadi_ik.problem.targets import TargetBatch
from casadi_ik.problem.verdict import judge_errors, judge_one
from casadi_ik.progress import progress, someone_looks_on
from casadi_ik.solving.alternatives.finder import AlternativeFinder
from casadi_ik.solving.alternatives.free import (
    RANKED,
    resolve_at_once,
    resolve_collisions,
)
from casadi_ik.solving.alternatives.way_out import with_way_out
from casadi_ik.solving.batch_parts import BatchParts, SolvedPart, judged, workers
from casadi_ik.solving.by_kinds import PerKinds
from casadi_ik.solving.by_kinds import run as run_by_kinds
from casadi_ik.solving.diagnosis.diagnostician import Diagnostician
from casadi_ik.solving.first_answer import FirstAnswers
from casadi_ik.solving.run import Run
from casadi_ik.solving.sensitivity import SensitivityKernel
from casadi_ik.solving.trials import HandMethod

MANIPULABILITY = "manipulability"
"""The preference that is seen to after the solve."""


@dataclass(frozen=True, eq=False)
class Engine:
    """A method on a robot.

    Attributes:
        robot: The robot.
        method: The method, built for this robot.
        compiled: Whether the additional graphs of a diagnosis run in compiled code.
        kinds: Of the contacts, by finger; None: point and normal.
        check: The scene about the robot; None: collisions are not checked.
    """

    robot: ArmHand
    method: Method
    compiled: bool = True
    kinds: Kinds | None = None
    check: SceneCheck | None = None

    def of_kinds(self, kinds: Kinds) -> Engine:
        """The engine for targets whose contacts are of these kinds."""
        own = self.kinds or usual(len(kinds))
        return self if kinds == own else self._others.of(kinds)

    @cached_property
    def _others(self) -> PerKinds[Engine]:
        return PerKinds(
            lambda kinds: replace(self, method=self.method.for_kinds(kinds), kinds=kinds)
        )

    @cached_property
    def _first(self) -> FirstAnswers:
        return FirstAnswers(self.method if self.compiled else None)

    @cached_property
    def _own_hands(self) -> HandMethod | None:
        """The method, if its hands can be tried one by one."""
        return self.method if isinstance(self.method, HandMethod) else None

    @cached_property
    def diagnostician(self) -> Diagnostician:
        """Finds why a target was not solved, with hand-first where the method cannot."""
        method = self._own_hands or HandFirstMethod(
            self.robot.description, HandFirstParameters(), self.compiled, self.kinds
        )
        return Diagnostician(self.robot, method, self.compiled)

    @property
    def _several(self) -> HandMethod:
        method = self._own_hands
        if method is None:
            raise UnsupportedError(
                f"method {self.method.name!r} gives one solution; several need "
                f"{HandFirstMethod.name!r}"
            )
        method.prepare()
        return method

    # Whether a method follows a protocol takes 20 us to ask, a fifth of a solve from Python.
    @cached_property
    def _quick(self) -> QuickMethod | None:
        return self.method if isinstance(self.method, QuickMethod) else None

    @cached_property
    def _preferences(self) -> tuple[str, ...]:
        method = self.method
        return method.preferences if isinstance(method, PreferringMethod) else ()

    def kinds_of(self, targets: TargetBatch) -> Engine:
        """The engine for targets that are all of the same kinds.

        Raises:
            InputError: They are of several.
        """
        engines = {self.of_kinds(kinds) for kinds, _, _ in by_kinds(targets)}
        if len(engines) > 1:
            raise InputError("grasps: found contacts of several kinds, expected the same in all")
        return engines.pop()

    @cached_property
    def finder(self) -> AlternativeFinder:
        """Finds several solutions.

        Raises:
            UnsupportedError: The method gives one.
        """
        return AlternativeFinder(self.robot, self._several, self.compiled)

    @cached_property
    def sensitivity(self) -> SensitivityKernel:
        """Derivatives of answers with respect to their contacts."""
        kinds = self.kinds or usual(len(self.robot.fingers))
        return SensitivityKernel(self.robot.description, kinds, self.compiled)

    def about(self, check: SceneCheck) -> Engine:
        """The engine with another scene; all that was worked out for the robot stays."""
        other = copy(self)
        vars(other).update(check=check, _others=type(self)._others.func(other))
        return other

    def collision_query(self, targets: TargetBatch) -> CollisionQuery | None:
        """What targets are checked against; None: nothing."""
        return None if self.check is None else self.check.collision_query(targets)

    def preference(self, prefer: str | None, started: bool) -> str:
        """What is preferred, see `preference`.

        Raises:
            InputError: No such preference.
            UnsupportedError: The method does not know it.
        """
        asked, method = preference(prefer, started), self.method
        if asked == CLEARANCE and self.check is None:
            raise InputError(f"prefer: found {asked!r}, which needs a solver with a scene")
        if self._preferences:
            if asked in self._preferences:
                return asked
            known = ", ".join(self._preferences)
            raise UnsupportedError(f"prefer: method {method.name!r} knows {known}, found {asked!r}")
        if prefer is None:
            return NO_PREFERENCE
        raise UnsupportedError(
            f"prefer: method {method.name!r} cannot choose, it takes the solution it comes to from "
            f"q0; found {prefer!r}"
        )

    def solve_one(self, targets: TargetBatch, run: Run) -> Solution:
        """Solve one target, by the shortest way that the method has.

        Args:
            targets: One target.
            run: How to solve it.

        Raises:
            InputError: Bad q0, or a target the method cannot take.
        """
        if targets.more:
            ((kinds, _, _),) = by_kinds(targets)
            if (other := self.of_kinds(kinds)) is not self:
                return other.solve_one(targets, run)
        method, start, known = self._quick, run.start(self.robot), None
        plain = targets.palms is None and targets.prefer not in RANKED and start.ndim == 1
        if method is not None and plain and run.recorder is None:
            if (early := self._first.answer(targets, start, self.check)) is not None:
                return early
            self.method.prepare()
            begin = time.perf_counter()
            found = method.quick(targets, start)
            if found is not None:
                solution = self._solved(targets, found, start, begin)
                if solution is not None:
                    return solution
                known = found.outcome(time.perf_counter() - begin)
        return self.solve(targets, run, known).solution(0)

    def _solved(
        self, targets: TargetBatch, found: Quick, start: Array, begin: float
    ) -> Solution | None:
        """A single answer with its verdict, begun at a time of the clock, if it is a solution."""
        if found.status != Status.SOLVED:
            return None
        robot, seconds = self.robot, time.perf_counter() - begin
        if found.errors is None:
            verdict = judge_one(robot, targets, found.q)
        else:
            verdict = judge_errors(targets, *found.errors)
        if verdict is None:
            return None
        q, distance, closest = found.q, None, None
        if (query := self.collision_query(targets)) is not None:
            clear = query.check(q[None])
            if not clear.free[0]:
                if (other := resolve_at_once(self.finder, targets, query, q, start)) is None:
                    return None
                q, verdict, clear = other
                seconds = time.perf_counter() - begin
            distance, closest = float(clear.distance[0]), clear.pair(0)
        return made(
            Solution,
            success=True,
            status=Status.SOLVED,
            q=q,
            iterations=found.iterations,
            restarts=found.restarts,
            time=seconds,
            contacts=dict(zip(robot.fingers, verdict.contacts, strict=True)),
            phases=found.phases,
            limits_ok=verdict.limits_ok,
            method=self.method.name,
            robot=robot.name,
            actuators=robot.actuators,
            clearance=distance,
            closest=closest,
            arm_hand=robot,
        )

    def solve(self, targets: TargetBatch, run: Run, known: Outcome | None = None) -> BatchSolution:
        """Solve a batch of k targets.

        Args:
            targets: The targets.
            run: How to solve them.
            known: What the method came to, if it was asked before.

        Raises:
            InputError: Bad q0, or targets the method cannot take.
        """
        if targets.palms is not None:
            _ = self._several  # no other method keeps every target's hand where it is
        starts, recorder = run.starts(self.robot, len(targets)), run.recorder
        # Built before the clock and the threads start: no work of a solve, nor for several at once.
        for kinds, _, _ in by_kinds(targets):
            self.of_kinds(kinds).method.prepare()
        if recorder is not None and (measures := self.method.trace_format.measures) is not None:
            measures.prepare()
        batches = []
        with InBackground() as background, progress(len(targets), run.shown) as show:
            for part in self._parts(targets, starts, run, known):
                show(len(part.batch))
                if recorder is not None:
                    form = self.method.trace_format
                    background.do(partial(part.record, recorder, form, run.seed))
                batches.append(part.batch)
        return BatchSolution.joined(batches)

    def _parts(
        self, targets: TargetBatch, starts: Array, run: Run, known: Outcome | None
    ) -> Iterator[SolvedPart]:
        """Parts of the batch in order, solved, judged and diagnosed side by side."""
        trace, jobs, diagnose = run.recorder is not None, run.jobs, run.diagnose
        parts = BatchParts(len(targets), jobs, trace, run.shown and someone_looks_on())

        def method(kinds: Kinds) -> Method:
            return self.of_kinds(kinds).method

        def finder_of(some: TargetBatch) -> AlternativeFinder:
            return self.kinds_of(some).finder

        def solve(rows: slice) -> SolvedPart:
            started, asked = time.time_ns(), targets.rows(rows)
            outcome = known or run_by_kinds(method, asked, starts[rows], run.seed, trace)
            if outcome.rows is not None:
                parts.learn(len(outcome.q), outcome.rows.nbytes)
            query = self.collision_query(asked)
            if query is None and targets.prefer == MANIPULABILITY:
                outcome = self._most_manipulable(asked, starts[rows], run.seed, outcome)
            batch = judged(self.robot, self.method.name, asked, outcome, query)
            if query is not None and self._own_hands is not None:
                q0, seed = starts[rows], run.seed
                batch = resolve_collisions(
                    finder_of, asked, query, q0, seed, outcome, batch, diagnose
                )
                outcome = replace(outcome, q=batch.q, time=batch.time)
            if diagnose:
                batch = self._diagnosed(asked, starts[rows], outcome, batch)
                if self.check is not None and len(targets) == 1:
                    batch = with_way_out(self.solve, self.check, asked, starts[0], run.seed, batch)
            parts.pace(1e-9 * (time.time_ns() - started))
            return SolvedPart(asked, starts[rows], started, outcome, batch, query)

        if diagnose:
            for kinds, _, _ in by_kinds(targets):
                _ = self.of_kinds(kinds).diagnostician
        if targets.prefer == MANIPULABILITY or self.check is not None:
            for kinds, _, _ in by_kinds(targets):
                if self._own_hands is not None:
                    _ = self.of_kinds(kinds).finder
        if jobs == 1:
            yield from map(solve, parts)
            return
        with workers(jobs) as threads:
            ahead: deque[Future[SolvedPart]] = deque()
            for part in parts:
                ahead.append(threads.submit(solve, part))
                if len(ahead) > jobs:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()

    def _most_manipulable(
        self, targets: TargetBatch, starts: Array, seed: int, outcome: Outcome
    ) -> Outcome:
        """Every hand where it is, held by the arm of the best measure."""
        begin, q = time.perf_counter(), outcome.q.copy()
        rows = np.flatnonzero(outcome.status == Status.SOLVED)
        for row in rows:
            one = targets.rows(slice(row, row + 1))
            finder = self.kinds_of(one).finder
            q[row] = finder.best_arm(one, q[row], starts[row], seed, MANIPULABILITY)
        seconds = outcome.time.copy()
        seconds[rows] += (time.perf_counter() - begin) / max(len(rows), 1)
        return replace(outcome, q=q, time=seconds)

    def _diagnosed(
        self, targets: TargetBatch, starts: Array, outcome: Outcome, batch: BatchSolution
    ) -> BatchSolution:
        """Find the reasons; a solution found by hand-first's own diagnosis is the answer."""
        if batch.success.all():
            return replace(batch, diagnoses=(None,) * len(batch))
        own = self._own_hands is not None
        q, seconds = outcome.q.copy(), outcome.time.copy()
        rows = np.flatnonzero(~batch.success & (batch.status != Status.COLLISION))
        if not len(rows):
            return replace(batch, diagnoses=(None,) * len(batch))
        unbiased = replace(targets.rows(rows), prefer="limits")
        found: dict[int, Diagnosis] = {}
        for kinds, of_kinds, some in by_kinds(unbiased):
            chosen = rows if of_kinds is None else rows[of_kinds]
            ends = q[chosen] if own else None
            diagnoses = self.of_kinds(kinds).diagnostician.diagnose(some, starts[chosen], ends)
            found |= zip(chosen.tolist(), diagnoses, strict=True)
        for row, why in found.items():
            if own and why.reason is Reason.REACHABLE:
                q[row] = why.q
                seconds[row] += why.time
        reports, query = batch.collisions, self.collision_query(targets)
        ended = replace(outcome, q=q, time=seconds)
        batch = replace(
            judged(self.robot, self.method.name, targets, ended, query), collisions=reports
        )
        diagnoses = tuple(
            None if solved else found.get(row) for row, solved in enumerate(batch.success)
        )
        status = batch.status.copy()
        for row, why in enumerate(diagnoses):
            if why is not None and why.reason is not Reason.REACHABLE:
                status[row] = Status.UNREACHABLE if why.established else Status.NOT_FOUND
        return replace(batch, status=status, diagnoses=diagnoses)
