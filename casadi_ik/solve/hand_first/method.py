"""Hand-first: searches from hand postures of tables, in one compiled loop over all stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from itertools import chain, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile import FunctionKernel, LoopResult, StepGraph
from casadi_ik.compile.loop import UNBEGUN, Stepper
from casadi_ik.files.arrays import Array, Counts
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.arms.recognise import arm_family
from casadi_ik.kinematics.contacts import Kinds, point_normal_kinds
from casadi_ik.kinematics.robot_kernels import RobotKernels
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import PREFERENCES, TargetBatch
from casadi_ik.solve.hand_first.driver import Searches, SearchPool
from casadi_ik.solve.hand_first.iteration import iteration_graph
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.robot_parts import (
    PALM_KINDS,
    SideSolver,
    palm_contacts,
    palm_robot,
    robot_trace,
    solve_sides_at_trunk_positions,
    solve_sides_independently,
)
from casadi_ik.solve.hand_first.search_code import SearchPlan, can_search
from casadi_ik.solve.hand_first.seeds import Seeds
from casadi_ik.solve.hand_first.state import KEPT_ACROSS_RESTARTS, first_state_graph
from casadi_ik.solve.hand_first.step import HandFirstStep
from casadi_ik.solve.looped_method import LoopedMethod, Start, coupling_jacobian
from casadi_ik.solve.method import HandSearch, Outcome, SingleOutcome
from casadi_ik.solve.proofs.premises import ArmSpan, arm_span, palms_in_span
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import RecordedJacobian
from casadi_ik.solve.verdict import judge


class HandFirstMethod(LoopedMethod):
    """Method `hand-first`: contacts determine palm and hand, the arm follows in closed form.

    Each restart has other hand postures as seeds; nearly all targets need one restart only. C code
    decides about restarts (restarts.c), for a batch, a single target and a stepper. Without a
    compiler there are table restarts only, in CasADi's virtual machine, and a multi-arm robot is
    solved side by side at sampled positions of its trunk, then as one hand.

    Attributes:
        step: Graphs of the stages for the robot.
        seeds: Tables of hand postures.
        preferences: Supported preferences.
    """

    name = "hand-first"
    preferences: tuple[str, ...] = PREFERENCES
    phases_without_arm = (Phase.CANDIDATE, Phase.HAND_FIT)
    takes_free_contacts = True
    takes_fixed_actuators = True

    def __init__(
        self,
        robot: RobotDescription,
        options: HandFirstParameters,
        compiled: bool = True,
        kinds: Kinds | None = None,
    ) -> None:
        """Recognise the arm, and define the layouts.

        Args:
            robot: Description of the robot.
            options: Parameters of the method.
            compiled: False: use CasADi's virtual machine.
            kinds: Kinds of the contacts, by finger; None: points with normals.
        """
        self._description = robot
        robot = robot if compiled else robot.as_hand
        super().__init__(robot, options, compiled)
        self.options: HandFirstParameters = options
        self._kinds = kinds or point_normal_kinds(len(robot.fingers))
        if robot.sides:
            self.step: HandFirstStep = MultiArmStep(robot, options.candidates, self._kinds)
        else:
            self.step = HandFirstStep(robot, arm_family(robot), options.candidates, self._kinds)
        self.seeds = Seeds(robot, options, compiled)
        self._searches = SearchPool(self.plan)
        self._cached_settings: tuple[Any, Array] | None = None

    def step_graph(self) -> StepGraph:
        """Return the graph of an iteration."""
        return iteration_graph(self.step)

    def for_kinds(self, kinds: Kinds) -> HandFirstMethod:
        """Return the method for contacts of other kinds."""
        if kinds == self._kinds:
            return self
        return HandFirstMethod(self._description, self.options, self._compiled, kinds)

    @cached_property
    def is_compiled(self) -> bool:
        """True if all kernels are compiled; of precompiled kernels some may be missing."""
        if self._has_independent_sides:
            return all(side.is_compiled for side in self._sides)
        return self._is_searchable

    @cached_property
    def _is_searchable(self) -> bool:
        return self.kernel.compiled and can_search(self.plan(enforce_limits=True))

    @property
    def _has_independent_sides(self) -> bool:
        """True for a multi-arm robot without a trunk."""
        return bool(self.robot.sides) and not self.robot.trunk

    @property
    def hand_search(self) -> HandSearch:
        """The method itself."""
        return self

    def in_virtual_machine(self) -> HandFirstMethod:
        """Return the method without compiled code."""
        return HandFirstMethod(self._description, self.options, False, self._kinds)

    def __reduce__(self) -> tuple[type[HandFirstMethod], tuple[Any, ...]]:
        """Return the arguments of the constructor."""
        return HandFirstMethod, (self._description, self.options, self._compiled, self._kinds)

    def prepare(self, batches: bool = False) -> None:
        """Build and compile the kernels of a single target, and fill the table of its seeds.

        Args:
            batches: Whether to also compile the kernels of batches.
        """
        if batches and not self._has_independent_sides:
            _ = self.kernel.lanes
        if self._has_independent_sides:
            for side in self._sides:
                side.prepare(batches)
            return
        _ = self.first
        if not self.robot.sides:
            _ = self.seeds.table
        if self.is_compiled:
            with self._searches.lent(enforce_limits=True):
                pass

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Jacobians of the couplings."""
        return coupling_jacobian(self.robot)

    def plan(self, enforce_limits: bool) -> SearchPlan:
        """Return the ingredients of the C code of a search."""
        kernels = RobotKernels(self.robot)
        return SearchPlan(
            layouts=self.step.layouts,
            options=self.options,
            budget=self.max_iterations,
            seeds=self.seeds,
            enforce_limits=enforce_limits,
            kernel_factories={
                "begin": lambda: self.first,
                "solve": lambda: self.kernel,
                "contacts": lambda: kernels.contacts,
                "judge": lambda: kernels.deviations,
            },
            sides=tuple(side.plan(enforce_limits) for side in self._sides),
        )

    @cached_property
    def _sides(self) -> list[HandFirstMethod]:
        """Methods of the sides of a multi-arm robot."""
        robot = self._description
        return [
            HandFirstMethod(
                robot.side(side.name),
                self.options,
                self._compiled,
                tuple(self._kinds[robot.finger_names.index(name)] for name in side.fingers),
            )
            for side in robot.sides
        ]

    @property
    def rounds(self) -> int:
        """Maximum number of restarts of a search."""
        return self.options.all_rounds(self.robot)

    def run(self, targets: TargetBatch, trace: bool = False, rounds: int | None = None) -> Outcome:
        """Solve a batch with at most `rounds` restarts; see `Method.run`.

        No random numbers are drawn.
        """
        outcome = self._run_contacts(targets, trace, rounds)
        return (
            outcome if targets.palms is None else self._run_palms(targets, outcome, trace, rounds)
        )

    def _run_contacts(self, targets: TargetBatch, trace: bool, rounds: int | None) -> Outcome:
        """Solve a batch by its contacts; see `run`."""
        self._check(targets)
        if not self.is_compiled:
            method = self.in_virtual_machine() if self.robot.sides else self
            return method._run_in_virtual_machine(targets, trace, rounds)
        if self._has_independent_sides:
            return self._run_independent_sides(targets, trace, rounds)
        max_restarts = np.full(len(targets), self._max_restarts(targets))
        if rounds is not None:
            max_restarts = np.minimum(max_restarts, rounds)
        reachable = None if targets.palms is None else palms_in_span(self._span, targets)
        if reachable is not None:
            max_restarts[~reachable] = 0  # the first restart alone ends near unreachable palms
        with self._searches.lent(targets.enforce_limits, len(targets)) as searches:
            return searches.batch(targets, self.settings(targets), max_restarts, trace)

    def _run_palms(
        self, targets: TargetBatch, outcome: Outcome, trace: bool, rounds: int | None
    ) -> Outcome:
        """Search for the palm poses that the search by contacts has missed.

        Args:
            targets: k targets with palm poses.
            outcome: The result of the search by contacts.
            trace: See `run`.
            rounds: See `run`.
        """
        solved = self._meets_palms(targets, outcome.q)
        missed = ~solved
        if (reachable := palms_in_span(self._span, targets)) is not None:
            missed &= reachable
        rows = np.flatnonzero(missed)
        arm = list(self.robot.arm_actuators)
        if len(rows) and arm:
            contacts = palm_contacts(self.robot, targets.rows(rows))
            palms = self._palm_method.run(contacts, trace, rounds)
            q = outcome.q[rows]
            q[:, arm] = palms.q
            met = self._meets_palms(targets.rows(rows), q)
            solved[rows] = met
            outcome = outcome.continued(rows, q, met, palms, self._palm_traces(palms, q, trace))
        has_failed = (outcome.status == Status.SOLVED) & ~solved
        status = np.where(has_failed, int(Status.STALLED), outcome.status)
        status[solved] = Status.SOLVED
        return replace(outcome, status=status)

    def _palm_traces(self, palms: Outcome, q: Array, trace: bool) -> list[NDArray[np.void]] | None:
        """Return traces of the palm search as traces of the arm-hand; None without a trace."""
        if not trace:
            return None
        arm, record = list(self.robot.arm_actuators), self.graph.record.dtype
        return [
            robot_trace(self.robot, rows, row_q, arm, [], record)
            for rows, row_q in zip(palms.trace, q, strict=True)
        ]

    def _meets_palms(self, targets: TargetBatch, q: Array) -> NDArray[np.bool_]:
        """Return for k configurations whether they meet their palm poses."""
        return judge(self._arm_hand, targets, q).solved(targets.enforce_limits)

    @cached_property
    def _arm_hand(self) -> ArmHand:
        return ArmHand(self.robot)

    @cached_property
    def _palm_method(self) -> HandFirstMethod:
        """The method for palm poses; see `palm_robot`."""
        robot = palm_robot(self.robot)
        return HandFirstMethod(robot, self.options, self._compiled, PALM_KINDS)

    def _run_independent_sides(
        self, targets: TargetBatch, trace: bool, rounds: int | None
    ) -> Outcome:
        """Solve a multi-arm robot without a trunk."""
        return solve_sides_independently(
            self.robot,
            self._side_solvers(trace, rounds),
            targets,
            self.step.layouts.labels,
            self.graph.record.dtype if trace else None,
        )

    def _side_solvers(self, trace: bool, rounds: int | None) -> list[SideSolver]:
        """Return the functions that solve the targets of each side."""

        def side_solver(side: HandFirstMethod) -> SideSolver:
            return lambda side_targets: side.run(side_targets, trace, rounds)

        return list(map(side_solver, self._sides))

    def _run_in_virtual_machine(
        self, targets: TargetBatch, trace: bool, rounds: int | None
    ) -> Outcome:
        """Solve a batch without compiled code; several arms side by side, then as one hand."""
        if not self._description.sides:
            return self._run_from_tables(targets, trace, rounds)
        outcome = solve_sides_at_trunk_positions(
            self._description,
            self._arm_hand,
            self._side_solvers(trace, rounds=1 if self._description.trunk else rounds),
            targets,
            self.step.layouts.labels,
            self.graph.record.dtype if trace else None,
            self.rounds if rounds is None else rounds,
        )
        rows = np.flatnonzero(outcome.status != Status.SOLVED)
        if not len(rows):
            return outcome
        second = self._run_from_tables(targets.rows(rows), trace, rounds)
        status = outcome.status.copy()
        status[rows] = second.status
        all_rows = np.ones(len(rows), dtype=bool)
        trace_of_second = second.trace if trace else None
        outcome = outcome.continued(rows, second.q, all_rows, second, trace_of_second)
        return replace(outcome, status=status)

    def solve_single(self, targets: TargetBatch, rounds: int | None = None) -> SingleOutcome | None:
        """Solve one target as `run` does, but faster; None: use `run`."""
        if not self.is_compiled or self._has_independent_sides:
            return None
        max_restarts = self._max_restarts(targets)
        with self._searches.lent(targets.enforce_limits) as search:
            search.set_target(targets, 0, self.settings(targets))
            status = search(max_restarts if rounds is None else min(max_restarts, rounds))
            if status is None:
                return None
            outcome, has_verdict = search.result(status), not search.extra_vectors
        may_be_solved = rounds is None or status == Status.SOLVED
        if may_be_solved and not has_verdict:
            self._judge(targets, outcome)
        return outcome

    def _judge(self, targets: TargetBatch, outcome: SingleOutcome) -> None:
        """Set the verdict of a target whose contact vectors the C code does not judge."""
        verdict = judge(self._arm_hand, targets, outcome.q[None])
        outcome.position_error = verdict.position_error[0].tolist()
        outcome.angle_error = verdict.angle_error[0].tolist()
        outcome.limits_ok = bool(verdict.limits_ok[0])
        if verdict.solved(targets.enforce_limits)[0]:
            outcome.status = Status.SOLVED
        elif outcome.status == Status.SOLVED:
            outcome.status = Status.STALLED

    def new_search(self, enforce_limits: bool) -> Searches | None:
        """Return memory for successive searches; None without a compiler."""
        self.prepare()
        return Searches(self.plan(enforce_limits), 1) if self._is_searchable else None

    def stepper(self, targets: TargetBatch) -> Stepper:
        """Return a stepper of one target, see `Method.stepper`."""
        self._check(targets)
        search, max_restarts = self.new_search(targets.enforce_limits), self._max_restarts(targets)
        if search is None:
            return super().stepper(targets)
        search.set_target(targets, 0, self.settings(targets).reshape(-1))

        def next_restart(status: int, state: Array) -> Start | None:
            search.state[...] = state
            if not search.decide(status, max_restarts):
                return None
            return search.state.copy(), search.parameters.copy()

        search.decide(UNBEGUN, max_restarts)
        return Stepper(self.kernel, search.state, search.parameters, next_restart)

    def postures(self, targets: TargetBatch, number: int) -> Array:
        """Return the seeds (k, candidates, hand) of a table restart [rad or m].

        Args:
            targets: k targets.
            number: Number of the restart, below `options.rounds`.
        """
        count, settings = self.options.candidates, self.settings(targets)
        if not self.is_compiled or not (number or self.robot.sides):
            table, row_count = self.seeds.table, (number + 1) * count
            return table.nearest(targets.points, targets.normals, row_count)[:, -count:]
        settings_by_row = np.broadcast_to(settings, (len(targets), settings.shape[-1]))
        with self._searches.lent(targets.enforce_limits) as search:
            seeds = np.empty((len(targets), *search.postures.shape))
            for row in range(len(targets)):
                search.set_target(targets, row, settings_by_row[row])
                seeds[row] = search.seeds(number)
        return seeds

    def begin(self, targets: TargetBatch, number: int = 0) -> Start:
        """Return states and parameters of a table restart.

        If the preference is q0, the hand of q0 is the first seed of the first restart.
        """
        postures = self.postures(targets, number)
        is_near_q0 = targets.prefers_q0 and not number
        if is_near_q0 and self.robot.arm_actuators and postures.shape[1] > 1:
            starts = np.clip(targets.starts(self.robot), *targets.bounds(self.robot))[:, None]
            hand_of_q0 = starts[:, :, list(self.robot.hand_actuators)]
            postures = np.concatenate([hand_of_q0, postures[:, :-1]], axis=1)
        return self.rows(targets, postures, skip_q0=number > 0)

    def _run_from_tables(self, targets: TargetBatch, trace: bool, rounds: int | None) -> Outcome:
        """Solve a batch in the virtual machine, with table restarts of the unsolved targets."""
        layout, count = self.step.layouts.state, len(targets)
        status, iterations = np.zeros((2, count), dtype=np.int64)
        states, seconds = np.zeros((count, layout.size)), np.zeros(count)
        traces: list[list[NDArray[Any]]] = [[] for _ in range(count)]
        searches = [targets]
        if targets.prefers_q0:
            searches.append(replace(targets, prefer="limits"))
        max_restarts = min(self.rounds, self.options.rounds, rounds or self.rounds)
        for search_targets, number in product(searches, range(max_restarts)):
            unsolved = np.flatnonzero(status != Status.SOLVED)
            if not len(unsolved):
                break
            first, parameters = self.begin(search_targets.rows(unsolved), number)
            if number:
                for name in KEPT_ACROSS_RESTARTS:
                    first[:, layout.slice(name)] = states[unsolved, layout.slice(name)]
                candidates_before = number * self.options.candidates
                first[:, layout.slice("candidates_before")] = candidates_before
            result = self.kernel.run(first, parameters, self.max_iterations, trace)
            states[unsolved], status[unsolved] = result.states, Status.from_loop(result.status)
            iterations[unsolved] += result.iterations
            seconds[unsolved] += result.time
            for target, rows in zip(unsolved.tolist(), result.trace, strict=trace):
                traces[target].append(rows)
        no_rows = np.empty(0, self.graph.record.dtype)
        counts = self.phase_counts(states, iterations)
        return Outcome(
            q=states[:, layout.slice("q")].copy(),
            status=status,
            iterations=iterations,
            restarts=self.restarts(states),
            time=seconds,
            phases={phase.label: count for phase, count in counts.items()},
            rows=np.concatenate([no_rows, *chain.from_iterable(traces)]) if trace else None,
        )

    def _max_restarts(self, targets: TargetBatch) -> int:
        """Return the maximum number of restarts; palm targets get no extra restarts."""
        count = self.rounds
        return count if targets.palms is None else min(count, self.options.first_rugged)

    @cached_property
    def _span(self) -> ArmSpan | None:
        return arm_span(self.robot)

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Return the counts of the states by phase."""
        del iterations
        counts = states[:, self.step.layouts.state.slice("counts")].astype(np.int64)
        return {phase: counts[:, i] for i, phase in enumerate(self.step.layouts.phases)}

    def restarts(self, states: Array) -> Counts:
        """Return the number of hand postures tried after the first."""
        layout = self.step.layouts.state
        candidates_before, candidate = (
            states[:, layout.slice(name).start].astype(np.int64)
            for name in ("candidates_before", "candidate")
        )
        return candidates_before + np.clip(candidate, 0, self.options.candidates - 1)

    def rows(
        self, targets: TargetBatch, postures: Array, skip_q0: bool = False
    ) -> tuple[Array, Array]:
        """Return states and parameters (k, ...) of the loop for `run_rows`.

        Args:
            targets: k targets. Motors that only move free fingers stay at their start.
            postures: (k, candidates, hand) seeds, or (k, 1, hand) [rad or m].
            skip_q0: Whether to skip the search for a solution near q0.
        """
        hand = len(self.step.layouts.robot.hand_actuators)
        seeds = np.broadcast_to(postures, (len(targets), self.options.candidates, hand))
        vectors = (targets.vectors(f"{name}s") for name in self.step.layouts.contacts.data)
        # Kernels take a column as a vector: the seeds of one motor have no second dimension.
        seeds = seeds.reshape(len(targets), *self.first.input_shapes[-1])
        starts = targets.starts(self.robot)
        states, parameters = self.first(*vectors, starts, self.settings(targets), seeds)
        if skip_q0:
            layout = self.step.layouts.state
            states[:, layout.slice("phase")] = float(Phase.CANDIDATE)
            states[:, layout.slice("candidate")] = 0.0
        return states, parameters

    def run_rows(self, states: Array, parameters: Array) -> LoopResult:
        """Run the loop from states and parameters made by `rows`."""
        return self.kernel.run(states, parameters, self.max_iterations)

    def settings(self, targets: TargetBatch) -> Array:
        """Return the settings that targets share, see `settings_layout`.

        They are cached, because their computation takes as long as a solve.
        """
        if targets.fixed is not None:
            return self._compute_settings(targets)
        key = targets.tolerances, targets.enforce_limits, targets.prefer
        cached = self._cached_settings
        if cached is None or cached[0] != key:
            self._cached_settings = cached = key, self._compute_settings(targets)
        return cached[1]

    def _compute_settings(self, targets: TargetBatch) -> Array:
        bounds = targets.bounds(self.robot)
        nearest = np.array([float(targets.prefers_q0)])
        fields = targets.position_tolerance, targets.angle_tolerance, *bounds, nearest
        if bounds[0].ndim == 1:
            return np.concatenate(fields)
        # The bounds differ between targets.
        rows = (np.broadcast_to(field, (len(targets), field.shape[-1])) for field in fields)
        return np.concatenate(list(rows), axis=1)

    @cached_property
    def first(self) -> FunctionKernel:
        """Kernel of the first state and the parameters of a restart."""
        return FunctionKernel(first_state_graph(self.step.layouts), self._compiled)
