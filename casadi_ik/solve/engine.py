"""The engine: runs a method on targets, checks the results, and records the iterations."""

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
from casadi_ik.files.progress import is_interactive, progress
from casadi_ik.files.writing import BackgroundWriter
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import Kinds, group_by_kinds, point_normal_kinds
from casadi_ik.model.grasp import Tolerance
from casadi_ik.model.targets import MANIPULABILITY, TargetBatch
from casadi_ik.solve.alternatives import AlternativeFinder
from casadi_ik.solve.batches import BatchParts, SolvedPart, judge_outcome, map_ordered
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.best_effort_run import BestEffortRun
from casadi_ik.solve.collision_free import RANKING_PREFERENCES, resolve_collisions, resolve_single
from casadi_ik.solve.diagnosis import Diagnosis, Reason
from casadi_ik.solve.diagnostician import Diagnostician
from casadi_ik.solve.first_answer import InterimSolver
from casadi_ik.solve.hand_first.method import HandFirstMethod
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.method import HandSearch, Method, Outcome, SingleOutcome
from casadi_ik.solve.nearest import NearestSearch
from casadi_ik.solve.recorder import Recorder
from casadi_ik.solve.remedies import add_collision_remedies
from casadi_ik.solve.sensitivity import SensitivityKernel
from casadi_ik.solve.solution import BatchSolution, Solution
from casadi_ik.solve.status import Status
from casadi_ik.solve.subproblems import SubproblemSolver
from casadi_ik.solve.turns import in_nearest_turns, with_search_starts
from casadi_ik.solve.verdict import contact_verdicts


@dataclass(slots=True, eq=False)
class SolveOptions:
    """Options of a solve that do not change the solutions of its targets, except `best_effort`.

    Attributes:
        jobs: Number of threads, at least 1; compiled loops run concurrently.
        recorder: Recorder of the iterations; None: they are not recorded.
        diagnose: Whether to diagnose targets that are not solved.
        best_effort: Whether to return the nearest configuration of targets that are not solved, or
            its options, see `BestEffort.from_argument`.
        show_progress: Whether to show a progress bar on an interactive terminal.
    """

    jobs: int = 1
    recorder: Recorder | None = None
    diagnose: bool = False
    show_progress: bool = False
    best_effort: bool | str | BestEffort = False

    def __post_init__(self) -> None:
        if self.best_effort is not False:
            BestEffort.from_argument(self.best_effort)
        if not isinstance(self.jobs, (int, np.integer)) or self.jobs < 1:
            raise InputError(f"jobs: found {self.jobs!r}, expected an integer >= 1")
        self.jobs = int(self.jobs)

    def check(self, robot: ArmHand) -> None:
        """Check that the options fit a robot.

        Raises:
            UnknownNameError: The robot does not have a finger with weights.
            InputError: The posture has another number of motors.
        """
        if isinstance(self.best_effort, BestEffort):
            self.best_effort.check(robot.fingers, len(robot.actuators))


REQUIRED_ARRAYS = ("points", "normals")
"""Arrays that every block of targets has."""

TargetArrays = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike]
"""Points and normals (k, f, 3) of a block of targets; or all of its arrays by name."""


@dataclass(frozen=True, eq=False)
class SolvedBlock:
    """The solutions of a block of targets.

    Attributes:
        first_row: Number of the first target of the block among all targets.
        solution: A row per target; malformed targets are INVALID, with NaN for q and errors.
        faults: Error messages of malformed targets, by target number.
    """

    first_row: int
    solution: BatchSolution
    faults: Mapping[int, str]


@dataclass(frozen=True, eq=False)
class Engine:
    """A method on a robot, with an optional scene.

    Attributes:
        robot: The robot.
        method: The method, built for this robot.
        compiled: Whether the additional graphs of a diagnosis are compiled.
        kinds: Contact kinds by finger; None: point and normal.
        check: Collision check of the scene; None: collisions are not checked.
    """

    robot: ArmHand
    method: Method
    compiled: bool = True
    kinds: Kinds | None = None
    check: SceneCheck | None = None

    _engines: dict[Kinds, Engine] = field(default_factory=dict, init=False, repr=False)
    _lock: Lock = field(default_factory=Lock, init=False, repr=False)

    def for_kinds(self, kinds: Kinds) -> Engine:
        """Return the engine for these contact kinds; threads may share it."""
        if kinds == (self.kinds or point_normal_kinds(len(kinds))):
            return self
        with self._lock:
            if kinds not in self._engines:
                method = self.method.for_kinds(kinds)
                self._engines[kinds] = replace(self, method=method, kinds=kinds)
            return self._engines[kinds]

    def group_by_contact_kind(
        self, targets: TargetBatch
    ) -> Iterator[tuple[Engine, Any, TargetBatch]]:
        """Yield an engine, row indices and targets for each combination of contact kinds."""
        for kinds, rows, group in group_by_kinds(targets):
            yield self.for_kinds(kinds), rows, group

    def engine_for(self, targets: TargetBatch) -> Engine:
        """Return the engine for targets that share their contact kinds.

        Raises:
            InputError: The targets have several combinations of contact kinds.
        """
        engines = [engine for engine, _, _ in self.group_by_contact_kind(targets)]
        if len(engines) > 1:
            raise InputError("grasps: found contacts of several kinds, expected the same in all")
        return engines[0]

    @property
    def hand_search(self) -> HandSearch | None:
        """The method as a search over hand postures; None if it is a black box."""
        return self.method.hand_search

    @cached_property
    def _interim_solver(self) -> InterimSolver:
        return InterimSolver(self.hand_search if self.compiled else None)

    @cached_property
    def _hand_search_or_hand_first(self) -> HandSearch:
        """The method as a hand search; hand-first if it is a black box."""
        return self.hand_search or HandFirstMethod(
            self.robot.description, HandFirstParameters(), self.compiled, self.kinds
        )

    @cached_property
    def diagnostician(self) -> Diagnostician:
        """Diagnostician of unsolved targets."""
        return Diagnostician(self.robot, self._hand_search_or_hand_first, self.compiled)

    @cached_property
    def nearest_search(self) -> NearestSearch:
        """Search for the configurations nearest to unsolved targets."""
        method = self._hand_search_or_hand_first
        method.prepare()
        kinds = self.kinds or point_normal_kinds(len(self.robot.fingers))
        return NearestSearch(SubproblemSolver(self.robot, method), kinds, self.compiled)

    @cached_property
    def best_effort_run(self) -> BestEffortRun:
        """Method followed by the search for the configurations nearest to unsolved targets."""
        return BestEffortRun(self.robot, self.method, self.nearest_search)

    @cached_property
    def _prepared_hand_search(self) -> HandSearch:
        """The method as a hand search, built and compiled.

        Raises:
            UnsupportedError: The method is a black box.
        """
        method = self.hand_search
        if method is None:
            raise UnsupportedError(
                f"method: {self.method.name!r} finds a single solution; expected "
                f"{HandFirstMethod.name!r}"
            )
        method.prepare()
        return method

    @cached_property
    def finder(self) -> AlternativeFinder:
        """Finder of alternative solutions.

        Raises:
            UnsupportedError: The method finds a single solution.
        """
        return AlternativeFinder(self.robot, self._prepared_hand_search, self.compiled)

    @cached_property
    def sensitivity(self) -> SensitivityKernel:
        """Derivatives of solutions with respect to their contacts."""
        kinds = self.kinds or point_normal_kinds(len(self.robot.fingers))
        return SensitivityKernel(self.robot.description, kinds, self.compiled)

    def with_scene(self, check: SceneCheck) -> Engine:
        """Return the engine with another scene; it shares everything cached for the robot."""
        engine = copy(self)
        with self._lock:
            engines = {kinds: member.with_scene(check) for kinds, member in self._engines.items()}
        vars(engine).update(check=check, _engines=engines, _lock=Lock())
        return engine

    def collision_query(self, targets: TargetBatch) -> CollisionQuery | None:
        """Return the collision query of targets; None without a scene."""
        return None if self.check is None else self.check.collision_query(targets)

    def solve_one(self, targets: TargetBatch, options: SolveOptions) -> Solution:
        """Solve one target with as little overhead as the method allows.

        Args:
            targets: One target.
            options: Options of the solve.

        Raises:
            InputError: The method does not support the target.
            UnknownNameError: See `SolveOptions.check`.
        """
        options.check(self.robot)
        engine = self.engine_for(targets) if targets.extra_vectors else self
        return engine._solve_one_of_kind(targets, options)

    def _solve_one_of_kind(self, targets: TargetBatch, options: SolveOptions) -> Solution:
        """Solve one target of the contact kinds of this engine, see `solve_one`."""
        method, outcome = self.hand_search, None
        is_plain = targets.palms is None and targets.prefer not in RANKING_PREFERENCES
        if method is not None and is_plain and options.recorder is None:
            interim = self._interim_solver.solve(targets, self.check)
            if interim is not None:
                return interim
            method = self._prepared_hand_search
            started = time.perf_counter()
            single = self._solve_single(method, targets, options)
            if single is not None:
                if single.status == Status.SOLVED:
                    solution = self._single_solution(targets, single, started)
                    if solution is not None:
                        return solution
                outcome = single.outcome(time.perf_counter() - started)
                nearest = self._single_nearest(targets, outcome, options)
                if nearest is not None:
                    return nearest
        return self.solve(targets, options, outcome).solution(0)

    def _solve_single(
        self, method: HandSearch, targets: TargetBatch, options: SolveOptions
    ) -> SingleOutcome | None:
        """Solve one target; with `best_effort`, an unsolved one gets the first restarts only."""
        run = self.best_effort_run if options.best_effort else None
        first_targets = None if run is None else run.first_targets(targets)
        if run is None or first_targets is None:
            return method.solve_single(targets)
        single = method.solve_single(first_targets, run.first_restarts)
        if single is not None and single.status == Status.SOLVED and targets.prefers_q0:
            return method.solve_single(targets)
        return single

    def _single_solution(
        self, targets: TargetBatch, outcome: SingleOutcome, started: float
    ) -> Solution | None:
        """Return the solution of one solved target; None if it needs a collision-free search.

        Args:
            targets: One target.
            outcome: Result of the method with status SOLVED.
            started: Start of the solve [s], as `time.perf_counter` counts.
        """
        robot, q, clearances = self.robot, outcome.q, None
        errors = outcome.position_error, outcome.angle_error, (True,) * len(robot.fingers)
        contacts = contact_verdicts(robot.fingers, targets.tolerances, *errors)
        limits_ok = outcome.limits_ok
        if (query := self.collision_query(targets)) is not None:
            clearances = query.check(q[None])
            if not clearances.free[0]:
                search_targets = with_search_starts(robot.description, targets)
                free = resolve_single(self.finder, search_targets, query, q)
                if free is None:
                    return None
                q, verdict, clearances = free
                contacts = verdict.contacts(0, robot.fingers, targets.tolerances)
                limits_ok = bool(verdict.limits_ok[0])
                (q,) = in_nearest_turns(robot.description, targets, q[None])
        return Solution(
            success=True,
            status=Status.SOLVED,
            q=q,
            iterations=outcome.iterations,
            restarts=outcome.restarts,
            time=time.perf_counter() - started,
            contacts=contacts,
            phases=outcome.phases,
            limits_ok=limits_ok,
            method=self.method.name,
            robot=robot.name,
            actuators=robot.actuators,
            clearance=None if clearances is None else float(clearances.distance[0]),
            closest=None if clearances is None else clearances.pair(0),
            arm_hand=robot,
        )

    def _single_nearest(
        self, targets: TargetBatch, outcome: Outcome, options: SolveOptions
    ) -> Solution | None:
        """Return the nearest configuration of a target out of reach; None: use `solve`.

        Args:
            targets: One target.
            outcome: Outcome of the first restarts.
            options: Options of the solve.
        """
        best_effort, robot = BestEffort.from_argument(options.best_effort), self.robot.description
        if best_effort is None or options.diagnose:
            return None
        run, query = self.best_effort_run, self.collision_query(targets)
        if run.first_targets(targets) is None:
            return None
        search_targets, solved = with_search_starts(robot, targets), np.zeros(1, dtype=bool)
        outcome = run.end_early(search_targets, outcome, solved, query, best_effort)
        if outcome.status[0] != Status.NEAREST:
            return None
        outcome = replace(outcome, q=in_nearest_turns(robot, targets, outcome.q))
        return judge_outcome(self.robot, self.method.name, targets, outcome, query).solution(0)

    def solve(
        self, targets: TargetBatch, options: SolveOptions, outcome: Outcome | None = None
    ) -> BatchSolution:
        """Solve a batch of k targets.

        Args:
            targets: The targets.
            options: Options of the solve.
            outcome: Result of the method, if it has run already.

        Raises:
            InputError: The method does not support the targets.
            UnknownNameError: See `SolveOptions.check`.
        """
        options.check(self.robot)
        if targets.palms is not None:
            _ = self._prepared_hand_search  # no other method keeps the hand of each target
        recorder, best_effort = options.recorder, BestEffort.from_argument(options.best_effort)
        # Build before clock and threads start, so that no solve is charged for it.
        needs_finder = targets.prefer == MANIPULABILITY or self.check is not None
        for engine, _, _ in self.group_by_contact_kind(targets):
            engine.method.prepare()
            if best_effort is not None:
                _ = engine.best_effort_run
            if options.diagnose:
                _ = engine.diagnostician
            if needs_finder and engine.hand_search is not None:
                _ = engine.finder
        trace_format = None if recorder is None else self.method.trace_format
        if trace_format is not None and trace_format.measures is not None:
            trace_format.measures.prepare()
        batches = []
        with (
            BackgroundWriter() as background,
            progress(len(targets), options.show_progress) as report_progress,
        ):
            for part in self._parts(targets, options, outcome):
                report_progress(len(part.batch))
                if recorder is not None and trace_format is not None:
                    background.do(partial(part.record, recorder, trace_format))
                batches.append(part.batch)
        return BatchSolution.concatenate(batches)

    def solve_blocks(
        self,
        blocks: Iterable[TargetArrays],
        parse: Callable[[Mapping[str, np.ndarray], int], TargetBatch],
        tolerances: tuple[Tolerance, ...],
        options: SolveOptions,
        first_row: int = 0,
    ) -> Iterator[SolvedBlock]:
        """Solve one block after the other; results do not depend on the division into blocks.

        Args:
            blocks: Arrays of targets.
            parse: Function of arrays by name and the number of the first target that returns
                checked targets.
            tolerances: Tolerance by finger.
            options: Options of the solve.
            first_row: Number of the first target.

        Yields:
            The solved blocks.

        Raises:
            InputError: A block has the wrong shape.
        """
        template = (
            self.method.name,
            self.robot,
            tolerances,
            options.diagnose,
            self.check is not None,
        )
        for block in blocks:
            if not isinstance(block, Mapping):
                block = dict(zip(REQUIRED_ARRAYS, block, strict=True))
            arrays = {name: np.asanyarray(array) for name, array in block.items()}
            count = len(arrays[REQUIRED_ARRAYS[0]])
            for name, array in arrays.items():
                if len(array) != count:
                    raise InputError(
                        f"{REQUIRED_ARRAYS[0]} and {name}: found {count} and {len(array)} rows, "
                        "expected the same number"
                    )
            solutions: dict[int, BatchSolution] = {}
            faults: dict[int, str] = {}
            pending = [(0, count)]
            while pending:
                start, stop = pending.pop()
                piece = {name: array[start:stop] for name, array in arrays.items()}
                try:
                    solutions[start] = self.solve(parse(piece, first_row + start), options)
                except RowError as error:
                    # A malformed target separates the targets before it from those after it.
                    row = error.row - first_row
                    faults[error.row] = str(error)
                    solutions[row] = BatchSolution.invalid(1, *template)
                    ranges = (row + 1, stop), (start, row)
                    pending += [(first, last) for first, last in ranges if first < last]
            solution = BatchSolution.concatenate([solutions[start] for start in sorted(solutions)])
            yield SolvedBlock(first_row, solution, dict(sorted(faults.items())))
            first_row += count

    def _parts(
        self, targets: TargetBatch, options: SolveOptions, first_outcome: Outcome | None
    ) -> Iterator[SolvedPart]:
        """Yield the parts of the batch in order: solved concurrently, checked and diagnosed."""
        trace = options.recorder is not None
        show_progress = options.show_progress and is_interactive()
        parts = BatchParts(len(targets), options.jobs, trace, show_progress)
        best_effort = BestEffort.from_argument(options.best_effort)

        def solve(rows: slice) -> SolvedPart:
            started, part = time.time_ns(), targets.rows(rows)
            search_targets = with_search_starts(self.robot.description, part)
            query = self.collision_query(part)
            if best_effort is not None:
                outcome = self._run_best_effort(
                    search_targets, query, best_effort, trace, first_outcome
                )
            else:
                outcome = first_outcome or self._run(search_targets, trace)
            if outcome.rows is not None:
                parts.adapt_to_memory(len(outcome.q), outcome.rows.nbytes)
            if query is None and targets.prefer == MANIPULABILITY:
                outcome = self._maximise_manipulability(search_targets, outcome)
            batch = judge_outcome(self.robot, self.method.name, part, outcome, query)
            if query is not None and self.hand_search is not None:
                batch = resolve_collisions(
                    lambda group: self.engine_for(group).finder,
                    search_targets,
                    query,
                    outcome,
                    batch,
                    options.diagnose,
                )
                outcome = replace(outcome, q=batch.q, time=batch.time)
            if options.diagnose:
                batch = self._diagnose(search_targets, outcome, batch)
                if self.check is not None and len(targets) == 1:
                    batch = add_collision_remedies(
                        lambda changed: self.solve(changed, SolveOptions()).success,
                        self.check,
                        part,
                        batch,
                    )
            q = in_nearest_turns(self.robot.description, part, batch.q)
            batch = replace(batch, q=q)
            parts.adapt_to_time(1e-9 * (time.time_ns() - started))
            return SolvedPart(part, started, outcome, batch, query)

        return map_ordered(solve, parts, options.jobs)

    def _run(self, targets: TargetBatch, trace: bool) -> Outcome:
        """Run the method on targets of any contact kinds."""
        indices, outcomes = [], []
        for engine, rows, group in self.group_by_contact_kind(targets):
            indices.append(rows)
            outcomes.append(engine.method.run(group, trace))
        return outcomes[0] if len(outcomes) == 1 else Outcome.interleaved(indices, outcomes)

    def _run_best_effort(
        self,
        targets: TargetBatch,
        query: CollisionQuery | None,
        options: BestEffort,
        trace: bool,
        first_outcome: Outcome | None,
    ) -> Outcome:
        """Run the method on targets of any contact kinds, see `BestEffortRun.run`."""
        indices, outcomes = [], []
        for engine, rows, group in self.group_by_contact_kind(targets):
            indices.append(rows)
            group_query = None if query is None else query.rows(rows)
            run = engine.best_effort_run
            outcomes.append(run.run(group, group_query, options, trace, first_outcome))
        return outcomes[0] if len(outcomes) == 1 else Outcome.interleaved(indices, outcomes)

    def _maximise_manipulability(self, targets: TargetBatch, outcome: Outcome) -> Outcome:
        """Replace the arm of each solution by the most manipulable one; the hands stay."""
        started, q = time.perf_counter(), outcome.q.copy()
        rows = np.flatnonzero(outcome.status == Status.SOLVED)
        for row in rows:
            target = targets.rows(slice(row, row + 1))
            finder = self.engine_for(target).finder
            q[row] = finder.best_arm(target, q[row], MANIPULABILITY)
        seconds = outcome.time.copy()
        seconds[rows] += (time.perf_counter() - started) / max(len(rows), 1)
        return replace(outcome, q=q, time=seconds)

    def _diagnose(
        self, targets: TargetBatch, outcome: Outcome, batch: BatchSolution
    ) -> BatchSolution:
        """Add diagnoses of unsolved targets to a batch.

        A solution found by the diagnosis becomes the result if the method is a hand search.
        """
        is_hand_search = self.hand_search is not None
        q, seconds = outcome.q.copy(), outcome.time.copy()
        rows = np.flatnonzero(~batch.success & (batch.status != Status.COLLISION))
        if not len(rows):
            return replace(batch, diagnoses=(None,) * len(batch))
        by_row: dict[int, Diagnosis] = {}
        # The cause does not depend on the preference.
        unsolved = replace(targets.rows(rows), prefer="limits")
        for engine, members, group in self.group_by_contact_kind(unsolved):
            group_rows = rows[members]
            nearest = q[group_rows] if is_hand_search else None
            diagnoses = engine.diagnostician.diagnose(group, nearest)
            by_row |= zip(group_rows.tolist(), diagnoses, strict=True)
        for row, diagnosis in by_row.items():
            if is_hand_search and diagnosis.reason is Reason.REACHABLE:
                q[row] = diagnosis.q
                seconds[row] += diagnosis.time
        reports, query = batch.collisions, self.collision_query(targets)
        outcome = replace(outcome, q=q, time=seconds)
        batch = replace(
            judge_outcome(self.robot, self.method.name, targets, outcome, query),
            collisions=reports,
        )
        diagnoses = tuple(
            None if solved else by_row.get(row) for row, solved in enumerate(batch.success)
        )
        status = batch.status.copy()
        for row, diagnosis in enumerate(diagnoses):
            if diagnosis is None or diagnosis.reason is Reason.REACHABLE:
                continue
            if status[row] != Status.NEAREST:
                status[row] = Status.UNREACHABLE if diagnosis.established else Status.NOT_FOUND
        return replace(batch, status=status, diagnoses=diagnoses)
