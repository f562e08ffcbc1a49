"""The one way a batch is solved: checked, run (in parallel if asked), judged, recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.clearance import CollisionQuery, SceneCheck
from casadi_ik.errors import InputError, RowError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.progress import is_interactive, progress
from casadi_ik.files.writing import BackgroundWriter
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import Kinds, group_by_kinds, point_normal_kinds
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.alternatives import AlternativeFinder
from casadi_ik.solve.batches import BatchParts, SolvedPart, in_order, judged
from casadi_ik.solve.collision_free import RANKED, resolve_at_once, resolve_collisions
from casadi_ik.solve.diagnosis import Diagnosis, Reason
from casadi_ik.solve.diagnostician import Diagnostician
from casadi_ik.solve.first_answer import FirstAnswers
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.method import Method, Outcome, Quick
from casadi_ik.solve.recorder import Recorder
from casadi_ik.solve.remedies import with_way_out
from casadi_ik.solve.request import CLEARANCE, NO_PREFERENCE, preference
from casadi_ik.solve.sensitivity import SensitivityKernel
from casadi_ik.solve.solution import BatchSolution, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.turns import in_nearest_turns, search_start
from casadi_ik.solve.verdict import judge_errors, judge_one, made

MANIPULABILITY = "manipulability"
"""The preference that is seen to after the solve."""


@dataclass(frozen=True, eq=False)
class Run:
    """How targets are solved.

    Attributes:
        q0: (n,) start, or (k, n) for k targets; None is the robot's home.
        seed: Of all random numbers, >= 0.
        jobs: Threads, at least 1; compiled loops run side by side.
        recorder: Keeps the iterations; None: they are not kept.
        diagnose: Whether to find the reason where a target is not solved.
        shown: Whether to show how far it is, where someone looks on.
    """

    q0: ArrayLike | None = None
    seed: int = 0
    jobs: int = 1
    recorder: Recorder | None = None
    diagnose: bool = False
    shown: bool = False

    def __post_init__(self) -> None:
        for name, least in (("jobs", 1), ("seed", 0)):
            value = getattr(self, name)
            if type(value) is int and value >= least:
                continue
            if not isinstance(value, (int, np.integer)) or value < least:
                raise InputError(f"{name}: found {value!r}, expected an integer >= {least}")
            object.__setattr__(self, name, int(value))

    def starts(self, robot: ArmHand, count: int) -> Array:
        """(count, n) where each solve begins.

        Raises:
            InputError: Wrong shape or numbers, or not as many as targets.
        """
        start = robot.start(self.q0)
        if start.ndim == 1:
            return np.repeat(start[None], count, axis=0)
        if len(start) != count:
            raise InputError(
                f"q0: found {len(start)} rows for {count} targets, expected as many, or one (n,)"
            )
        return start


REQUIRED = ("points", "normals")
"""What every target is told by."""

Block = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike]
"""Points and normals (k, f, 3) of some targets; or these and more by name."""


@dataclass(frozen=True, eq=False)
class SolvedBlock:
    """The answers to a block.

    Attributes:
        first_row: Number of its first target among all.
        solution: A row per target; those with a fault are INVALID, with NaN for q and errors.
        faults: What is wrong with a target, by its number among all.
    """

    first_row: int
    solution: BatchSolution
    faults: Mapping[int, str]


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

    _others: dict[Kinds, Engine] = field(default_factory=dict, init=False, repr=False)
    _lock: Lock = field(default_factory=Lock, init=False, repr=False)

    def of_kinds(self, kinds: Kinds) -> Engine:
        """The engine for targets whose contacts are of these kinds; threads may share it."""
        if kinds == (self.kinds or point_normal_kinds(len(kinds))):
            return self
        with self._lock:
            if kinds not in self._others:
                method = self.method.for_kinds(kinds)
                self._others[kinds] = replace(self, method=method, kinds=kinds)
            return self._others[kinds]

    def parted(self, targets: TargetBatch) -> Iterator[tuple[Engine, Any, TargetBatch]]:
        """Engines for targets of any kinds, with the rows and the targets of each."""
        for kinds, rows, some in group_by_kinds(targets):
            yield self.of_kinds(kinds), rows, some

    def kinds_of(self, targets: TargetBatch) -> Engine:
        """The engine for targets that are all of the same kinds.

        Raises:
            InputError: They are of several.
        """
        first, *others = (engine for engine, _, _ in self.parted(targets))
        if others:
            raise InputError("grasps: found contacts of several kinds, expected the same in all")
        return first

    @cached_property
    def hand_first(self) -> HandFirstMethod | None:
        """The method, if its hands and arms can be tried one by one."""
        method: Any = self.method
        return method if hasattr(method, "postures") else None

    @cached_property
    def _first(self) -> FirstAnswers:
        return FirstAnswers(self.hand_first if self.compiled else None)

    @cached_property
    def diagnostician(self) -> Diagnostician:
        """Finds why a target was not solved, with hand-first where the method cannot."""
        method = self.hand_first or HandFirstMethod(
            self.robot.description, HandFirstParameters(), self.compiled, self.kinds
        )
        return Diagnostician(self.robot, method, self.compiled)

    @property
    def _several(self) -> HandFirstMethod:
        method = self.hand_first
        if method is None:
            raise UnsupportedError(
                f"method {self.method.name!r} gives one solution; several need "
                f"{HandFirstMethod.name!r}"
            )
        method.prepare()
        return method

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
        kinds = self.kinds or point_normal_kinds(len(self.robot.fingers))
        return SensitivityKernel(self.robot.description, kinds, self.compiled)

    def about(self, check: SceneCheck) -> Engine:
        """The engine with another scene; all that was worked out for the robot stays."""
        other = copy(self)
        with self._lock:
            others = {kinds: one.about(check) for kinds, one in self._others.items()}
        vars(other).update(check=check, _others=others, _lock=Lock())
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
        if known := getattr(method, "preferences", ()):
            if asked in known:
                return asked
            raise UnsupportedError(
                f"prefer: method {method.name!r} knows {', '.join(known)}, found {asked!r}"
            )
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
        if targets.more and (other := self.kinds_of(targets)) is not self:
            return other.solve_one(targets, run)
        method, start, known = self.hand_first, self.robot.start(run.q0), None
        plain = targets.palms is None and targets.prefer not in RANKED and start.ndim == 1
        if method is not None and plain and run.recorder is None:
            if (early := self._first.answer(targets, start, self.check)) is not None:
                return early
            method.prepare()
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
                near = search_start(robot.description, start)
                if (other := resolve_at_once(self.finder, targets, query, q, near)) is None:
                    return None
                q, verdict, clear = other
                q = in_nearest_turns(robot.description, targets, q, start)
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
        ranked = targets.prefer == MANIPULABILITY or self.check is not None
        for engine, _, _ in self.parted(targets):
            engine.method.prepare()
            if run.diagnose:
                _ = engine.diagnostician
            if ranked and engine.hand_first is not None:
                _ = engine.finder
        form = self.method.trace_format
        if recorder is not None and form.measures is not None:
            form.measures.prepare()
        batches = []
        with BackgroundWriter() as background, progress(len(targets), run.shown) as show:
            for part in self._parts(targets, starts, run, known):
                show(len(part.batch))
                if recorder is not None:
                    background.do(partial(part.record, recorder, form, run.seed))
                batches.append(part.batch)
        return BatchSolution.joined(batches)

    def solve_blocks(
        self,
        blocks: Iterable[Block],
        ask: Callable[[Mapping[str, np.ndarray], int], TargetBatch],
        tolerances: tuple[Tolerance, ...],
        run: Run,
        first_row: int = 0,
    ) -> Iterator[SolvedBlock]:
        """Solve one block after the other; a target's numbers do not depend on the blocks.

        Args:
            blocks: Arrays of targets.
            ask: Arrays by name and the number of the first target as a checked question.
            tolerances: When a contact counts as reached, by finger.
            run: How targets are solved; one start (n,) for all of them.
            first_row: Number of the first target.

        Raises:
            InputError: Bad q0, or a block of the wrong shape.
        """
        if self.robot.start(run.q0).ndim != 1:
            raise InputError("q0: found several, expected one start for all targets")
        none = self.method.name, self.robot, tolerances, run.diagnose, self.check is not None
        for given in blocks:
            named = given if isinstance(given, Mapping) else dict(zip(REQUIRED, given, strict=True))
            arrays = {name: np.asanyarray(array) for name, array in named.items()}
            count = len(arrays[REQUIRED[0]])
            for name, array in arrays.items():
                if len(array) != count:
                    raise InputError(
                        f"{REQUIRED[0]} and {name}: found {count} and {len(array)} rows, expected "
                        "as many"
                    )
            parts: dict[int, BatchSolution] = {}
            faults: dict[int, str] = {}
            waiting = [(0, count)]
            while waiting:
                start, stop = waiting.pop()
                some = {name: array[start:stop] for name, array in arrays.items()}
                try:
                    parts[start] = self.solve(ask(some, first_row + start), run)
                except RowError as error:
                    # A row with a fault parts those before it from those after it.
                    row = error.row - first_row
                    faults[error.row] = str(error)
                    parts[row] = BatchSolution.invalid(1, *none)
                    both = (row + 1, stop), (start, row)
                    waiting += [part for part in both if part[0] < part[1]]
            solution = BatchSolution.joined([parts[start] for start in sorted(parts)])
            yield SolvedBlock(first_row, solution, dict(sorted(faults.items())))
            first_row += count

    def _parts(
        self, targets: TargetBatch, starts: Array, run: Run, known: Outcome | None
    ) -> Iterator[SolvedPart]:
        """Parts of the batch in order, solved, judged and diagnosed side by side."""
        trace = run.recorder is not None
        parts = BatchParts(len(targets), run.jobs, trace, run.shown and is_interactive())

        def solve(rows: slice) -> SolvedPart:
            started, asked, q0 = time.time_ns(), targets.rows(rows), starts[rows]
            near = search_start(self.robot.description, q0)
            outcome = known or self._run(asked, near, run.seed, trace)
            if outcome.rows is not None:
                parts.learn(len(outcome.q), outcome.rows.nbytes)
            query = self.collision_query(asked)
            if query is None and targets.prefer == MANIPULABILITY:
                outcome = self._most_manipulable(asked, near, run.seed, outcome)
            batch = judged(self.robot, self.method.name, asked, outcome, query)
            if query is not None and self.hand_first is not None:
                batch = resolve_collisions(
                    lambda some: self.kinds_of(some).finder,
                    asked,
                    query,
                    near,
                    run.seed,
                    outcome,
                    batch,
                    run.diagnose,
                )
                outcome = replace(outcome, q=batch.q, time=batch.time)
            if run.diagnose:
                batch = self._diagnosed(asked, near, outcome, batch)
                if self.check is not None and len(targets) == 1:
                    again = Run(starts[0], run.seed)
                    batch = with_way_out(
                        lambda some: self.solve(some, again).success, self.check, asked, batch
                    )
            q = in_nearest_turns(self.robot.description, asked, batch.q, q0)
            batch = replace(batch, q=q)
            parts.pace(1e-9 * (time.time_ns() - started))
            return SolvedPart(asked, q0, started, outcome, batch, query)

        return in_order(solve, parts, run.jobs)

    def _run(self, targets: TargetBatch, starts: Array, seed: int, trace: bool) -> Outcome:
        """Solve targets of any kinds, each by the method for its kinds."""
        groups, outcomes = [], []
        for engine, rows, some in self.parted(targets):
            groups.append(rows)
            outcomes.append(engine.method.run(some, starts[rows], seed, trace))
        return outcomes[0] if len(outcomes) == 1 else Outcome.interleaved(groups, outcomes)

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
        own = self.hand_first is not None
        q, seconds = outcome.q.copy(), outcome.time.copy()
        rows = np.flatnonzero(~batch.success & (batch.status != Status.COLLISION))
        if not len(rows):
            return replace(batch, diagnoses=(None,) * len(batch))
        found: dict[int, Diagnosis] = {}
        # Why there is no solution does not depend on which is preferred.
        for engine, of_kinds, some in self.parted(replace(targets.rows(rows), prefer="limits")):
            chosen = rows[of_kinds]
            ends = q[chosen] if own else None
            diagnoses = engine.diagnostician.diagnose(some, starts[chosen], ends)
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
