"""The hand-first method: lookup of postures, then one compiled loop over all stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.hand_first.body import BodyStep
from casadi_ik.solve.hand_first.driver import Searches, SearchPlan, SearchPool, can_search
from casadi_ik.solve.hand_first.palm_target import PALM_KINDS, palm_contacts, palm_robot
from casadi_ik.solve.hand_first.parameters import HandFirstParameters
from casadi_ik.solve.hand_first.seeds import Seeds
from casadi_ik.solve.hand_first.state import CARRIED, beginning
from casadi_ik.solve.hand_first.step import HandFirstStep
from casadi_ik.solve.limits import coupling_jacobian
from casadi_ik.solve.looped_method import LoopedMethod, Start
from casadi_ik.solve.method import HandSearch, Outcome, SingleOutcome
from casadi_ik.solve.proofs.premises import ArmSpan, arm_span, palms_in_span
from casadi_ik.solve.request import PREFERENCES
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import RecordedJacobian, pack_mask
from casadi_ik.solve.verdict import judge

SideRun = Callable[[TargetBatch, Array], Outcome]
"""Solves the targets of a side from where it is."""


def side_by_side(
    robot: RobotDescription,
    runs: Sequence[SideRun],
    targets: TargetBatch,
    q0: Array,
    phases: Sequence[str],
    record: np.dtype[Any] | None,
) -> Outcome:
    """Solve every side by itself.

    Args:
        robot: The body.
        runs: What solves its sides.
        targets: k targets.
        q0: (k, n) where the robot is, within bounds.
        phases: Names of all phases, in order.
        record: Of the rows of a trace of the body; None: no trace is wanted.
    """
    count, q = len(targets), np.array(q0)
    status = np.full(count, int(Status.SOLVED))
    iterations, restarts = np.zeros((2, count), dtype=np.int64)
    seconds, spent = np.zeros(count), {name: np.zeros(count, dtype=np.int64) for name in phases}
    traces: list[list[NDArray[Any]]] = [[] for _ in range(count)]
    for run, side, (arm, hand) in zip(runs, robot.sides, robot.side_actuators, strict=True):
        motors = sorted((*arm, *hand))
        fingers = [robot.finger_names.index(name) for name in side.fingers]
        known = [targets.points, targets.normals]
        asked = np.any([~np.isnan(one[:, fingers, 0]) for one in known], axis=(0, 2))
        rows = np.flatnonzero(asked)
        if not len(rows):
            continue
        found = run(part_of(targets.rows(rows), fingers, motors), q[rows][:, motors])
        before = q[rows]
        q[rows[:, None], motors] = found.q
        worse = (status[rows] == Status.SOLVED) & (found.status != Status.SOLVED)
        status[rows[worse]] = found.status[worse]
        iterations[rows] += found.iterations
        restarts[rows] += found.restarts
        seconds[rows] += found.time
        for name, numbers in found.phases.items():
            spent[name][rows] += numbers
        if record is not None:
            for row, here, own in zip(rows.tolist(), before, found.trace, strict=True):
                traces[row].append(_of_body(robot, own, here, motors, fingers, record))
    whole = None
    if record is not None:
        every = [part for parts in traces for part in parts]
        whole = np.concatenate([np.empty(0, record), *every])
    return Outcome(q, status, iterations, restarts, seconds, spent, whole)


def part_of(targets: TargetBatch, fingers: Sequence[int], motors: Sequence[int]) -> TargetBatch:
    """The part of targets that is of some fingers, on a robot of some motors."""
    fixed = None if targets.fixed is None else targets.fixed[..., motors]
    return replace(targets.for_fingers(fingers), fixed=fixed)


def _of_body(
    robot: RobotDescription,
    rows: NDArray[Any],
    here: Array,
    motors: Sequence[int],
    fingers: Sequence[int],
    record: np.dtype[Any],
) -> NDArray[Any]:
    """The rows of a side's trace as rows of the body, all other motors at `here` (n,)."""
    found = np.zeros(len(rows), record)
    for name in record.names or ():
        if found[name].dtype.kind == "f":
            found[name] = np.nan
        if name == "q":
            found[name] = here
            found[name][:, motors] = rows[name]
        elif name in ("position_error", "angle_error"):
            found[name][:, fingers] = rows[name]
        elif name != "limit_mask" and name in (rows.dtype.names or ()):
            found[name] = rows[name]
    at_limits = (found["q"] <= robot.lower) | (found["q"] >= robot.upper)
    found["limit_mask"] = pack_mask(at_limits).reshape(found["limit_mask"].shape)
    return found


NEAREST = "q0"
"""The preference for what is near the start."""


class HandFirstMethod(LoopedMethod):
    """`hand-first`: contacts fix palm and hand, the arm follows in closed form.

    Rounds begin from other hand postures each; nearly all targets need one round only. What follows
    a round is said in C (hand_first.c), for a batch, one target and a solve by steps alike. Without
    a compiler there are the rounds from tables only, in CasADi's virtual machine.

    Attributes:
        step: Its step for this robot.
        preferences: What it can prefer.
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
        """Recognise the arm and lay out the step; point and normal if no kinds are given."""
        robot = robot if compiled else robot.as_hand
        super().__init__(robot, options, compiled)
        self.options: HandFirstParameters = options
        self._kinds = kinds or point_normal_kinds(len(robot.fingers))
        if robot.sides:
            self.step: HandFirstStep = BodyStep(robot, options.candidates, self._kinds)
        else:
            self.step = HandFirstStep(robot, arm_family(robot), options.candidates, self._kinds)
        self.seeds = Seeds(robot, options, compiled)
        self._searches = SearchPool(self.plan)
        self._kept: tuple[Any, Array] | None = None

    def step_graph(self) -> StepGraph:
        """The whole iteration."""
        return self.step.graph()

    def for_kinds(self, kinds: Kinds) -> HandFirstMethod:
        """The same for contacts of other kinds."""
        if kinds == self._kinds:
            return self
        return HandFirstMethod(self.robot, self.options, self._compiled, kinds)

    @cached_property
    def is_compiled(self) -> bool:
        """Whether all that solves call is compiled: made ahead some may be missing."""
        if self._is_apart:
            return all(side.is_compiled for side in self._sides)
        return self._is_searchable

    @cached_property
    def _is_searchable(self) -> bool:
        return self.kernel.compiled and can_search(self.plan(enforce_limits=True))

    @property
    def _is_apart(self) -> bool:
        """Whether the robot is a body whose sides know nothing of each other."""
        return bool(self.robot.sides) and not self.robot.trunk

    @property
    def hand_search(self) -> HandSearch:
        """The method itself."""
        return self

    def in_virtual_machine(self) -> HandFirstMethod:
        """The same, never compiled; a body is one hand with all motors there."""
        return HandFirstMethod(self.robot.as_hand, self.options, False, self._kinds)

    def __reduce__(self) -> tuple[type[HandFirstMethod], tuple[Any, ...]]:
        """What it was made from."""
        return HandFirstMethod, (self.robot, self.options, self._compiled, self._kinds)

    def prepare(self, batches: bool = False) -> None:
        """Build and compile what one target takes, and fill the table of the first round.

        Args:
            batches: Whether to compile what many targets take, too.
        """
        if batches and not self._is_apart:
            _ = self.kernel.lanes
        if self._is_apart:
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
        """Those of the couplings."""
        return coupling_jacobian(self.robot)

    def plan(self, enforce_limits: bool) -> SearchPlan:
        """What the C of its driver is made of."""
        kernels = RobotKernels(self.robot)
        return SearchPlan(
            layouts=self.step.layouts,
            options=self.options,
            budget=self.max_iterations,
            seeds=self.seeds,
            enforce_limits=enforce_limits,
            made={
                "begin": lambda: self.first,
                "solve": lambda: self.kernel,
                "contacts": lambda: kernels.contacts,
                "judge": lambda: kernels.deviations,
            },
            sides=tuple(side.plan(enforce_limits) for side in self._sides),
        )

    @cached_property
    def _sides(self) -> list[HandFirstMethod]:
        """The same for every side of a body by itself."""
        robot = self.robot
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
        """How many a search has at most."""
        return self.options.all_rounds(self.robot)

    def run(
        self, targets: TargetBatch, q0: Array, seed: int, trace: bool, rounds: int | None = None
    ) -> Outcome:
        """Solve a batch; see `Method.run`. No random numbers are drawn.

        `rounds` are so many of each search at most instead of all.
        """
        outcome = self._run_contacts(targets, q0, seed, trace, rounds)
        if targets.palms is None:
            return outcome
        return self._run_palms(targets, q0, outcome, seed, trace, rounds)

    def _run_contacts(
        self, targets: TargetBatch, q0: Array, seed: int, trace: bool, rounds: int | None
    ) -> Outcome:
        """Solve a batch by its contacts; see `run`."""
        self._check(targets)
        if not self.is_compiled:
            method = self.in_virtual_machine() if self.robot.sides else self
            return method._run_from_tables(targets, q0, trace, rounds)
        if self._is_apart:
            return self._side_by_side(targets, q0, seed, trace, rounds)
        most = np.full(len(targets), self._rounds_for(targets))
        if rounds is not None:
            most = np.minimum(most, rounds)
        reachable = None if targets.palms is None else palms_in_span(self._span, targets)
        if reachable is not None:
            most[~reachable] = 0  # a first round leads near what the arm cannot reach
        with self._searches.lent(targets.enforce_limits, len(targets)) as searches:
            return searches.batch(targets, q0, self.terms(targets), most, trace)

    def _run_palms(
        self,
        targets: TargetBatch,
        q0: Array,
        outcome: Outcome,
        seed: int,
        trace: bool,
        rounds: int | None,
    ) -> Outcome:
        """Search for the palm poses that the search by contacts has missed.

        Args:
            targets: k targets with palm poses.
            q0: (k, n) starts.
            outcome: The result of the search by contacts.
            seed: See `run`.
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
            palms = self._palm_method.run(contacts, q0[rows][:, arm], seed, trace, rounds)
            q = outcome.q[rows]
            q[:, arm] = palms.q
            met = self._meets_palms(targets.rows(rows), q)
            solved[rows] = met
            outcome = outcome.continued(rows, q, met, palms, self._of_hand(palms, q, trace))
        content = outcome.status == Status.SOLVED
        status = np.where(content & ~solved, int(Status.STALLED), outcome.status)
        status[solved] = Status.SOLVED
        return replace(outcome, status=status)

    def _of_hand(self, palms: Outcome, q: Array, trace: bool) -> list[NDArray[np.void]] | None:
        """Return traces of the palm search as traces of the arm-hand; None without a trace."""
        if not trace:
            return None
        arm, record = list(self.robot.arm_actuators), self.graph.record.dtype
        return [
            _of_body(self.robot, rows, at, arm, [], record)
            for rows, at in zip(palms.trace, q, strict=True)
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

    def _side_by_side(
        self, targets: TargetBatch, q0: Array, seed: int, trace: bool, rounds: int | None
    ) -> Outcome:
        """Solve a body whose sides know nothing of each other."""

        def runs(side: HandFirstMethod) -> SideRun:
            return lambda part, here: side.run(part, here, seed, trace, rounds)

        return side_by_side(
            self.robot,
            list(map(runs, self._sides)),
            targets,
            np.where(self.robot.continuous, q0, np.clip(q0, *targets.bounds(self.robot))),
            self.step.layouts.labels,
            self.graph.record.dtype if trace else None,
        )

    def quick(self, targets: TargetBatch, q0: Array) -> SingleOutcome | None:
        """What `run` would find for one target from q0 (n,), sooner; None: ask `run`."""
        if not self.is_compiled or self._is_apart:
            return None
        with self._searches.lent(targets.enforce_limits) as search:
            search.ask(targets, 0, q0, self.terms(targets))
            status = search(self._rounds_for(targets))
            return None if status is None else search.answer(status)

    def alone(self, enforce_limits: bool) -> Searches | None:
        """Memory for one search after the other; None without a compiler."""
        self.prepare()
        return Searches(self.plan(enforce_limits), 1) if self._is_searchable else None

    def stepper(self, targets: TargetBatch, q0: Array) -> Stepper:
        """One target, one iteration at a time; see `Method.stepper`."""
        self._check(targets)
        search, rounds = self.alone(targets.enforce_limits), self._rounds_for(targets)
        if search is None:
            return super().stepper(targets, q0)
        search.ask(targets, 0, q0, self.terms(targets).reshape(-1))

        def following(status: int, state: Array) -> Start | None:
            search.state[...] = state
            if not search.decide(status, rounds):
                return None
            return search.state.copy(), search.parameters.copy()

        search.decide(UNBEGUN, rounds)
        return Stepper(self.kernel, search.state, search.parameters, following)

    def postures(self, targets: TargetBatch, number: int) -> Array:
        """Candidates (k, candidates, hand) of a round whose postures look like the targets.

        Args:
            targets: The targets.
            number: The round, below `options.rounds`.
        """
        count, terms = self.options.candidates, self.terms(targets)
        if not self.is_compiled or not (number or self.robot.sides):
            table, most = self.seeds.table, (number + 1) * count
            return table.nearest(targets.points, targets.normals, most)[:, -count:]
        every = np.broadcast_to(terms, (len(targets), terms.shape[-1]))
        here = np.zeros(len(self.robot.actuators))
        with self._searches.lent(targets.enforce_limits) as search:
            found = np.empty((len(targets), *search.postures.shape))
            for row in range(len(targets)):
                search.ask(targets, row, here, every[row])
                found[row] = search.hands(number)
        return found

    def begin(self, targets: TargetBatch, q0: Array, number: int = 0) -> Start:
        """A round from a table; where what is near q0 is wanted, its own hand comes first."""
        postures = self.postures(targets, number)
        nearest = targets.prefer == NEAREST and not number
        if nearest and self.robot.arm_actuators and postures.shape[1] > 1:
            own = np.clip(q0, *targets.bounds(self.robot))[:, None]
            own = own[:, :, list(self.robot.hand_actuators)]
            postures = np.concatenate([own, postures[:, :-1]], axis=1)
        return self.rows(targets, q0, postures, begun=number > 0)

    def _run_from_tables(
        self, targets: TargetBatch, q0: Array, trace: bool, rounds: int | None
    ) -> Outcome:
        """Solve a batch in the virtual machine: the next nearest hands for what is left over."""
        layout, count = self.step.layouts.state, len(targets)
        status, iterations = np.zeros((2, count), dtype=np.int64)
        states, seconds = np.zeros((count, layout.size)), np.zeros(count)
        traces: list[list[NDArray[Any]]] = [[] for _ in range(count)]
        searches = [targets]
        if targets.prefer == NEAREST:
            searches.append(replace(targets, prefer="limits"))
        most = min(self.rounds, self.options.rounds, rounds or self.rounds)
        for asked, number in product(searches, range(most)):
            left = np.flatnonzero(status != Status.SOLVED)
            if not len(left):
                break
            first, parameters = self.begin(asked.rows(left), q0[left], number)
            if number:
                for name in CARRIED:
                    first[:, layout.slice(name)] = states[left, layout.slice(name)]
                first[:, layout.slice("earlier")] = number * self.options.candidates
            result = self.kernel.run(first, parameters, self.max_iterations, trace)
            states[left], status[left] = result.states, Status.from_loop(result.status)
            iterations[left] += result.iterations
            seconds[left] += result.time
            for target, rows in zip(left.tolist(), result.trace, strict=trace):
                traces[target].append(rows)
        none, counts = np.empty(0, self.graph.record.dtype), self.phase_counts(states, iterations)
        return Outcome(
            q=states[:, layout.slice("q")].copy(),
            status=status,
            iterations=iterations,
            restarts=self.restarts(states),
            time=seconds,
            phases={phase.label: spent for phase, spent in counts.items()},
            rows=np.concatenate([none, *chain.from_iterable(traces)]) if trace else None,
        )

    def _rounds_for(self, targets: TargetBatch) -> int:
        """So many; of hands that are given none from anywhere but what every target gets."""
        every = self.rounds
        return every if targets.palms is None else min(every, self.options.first_rugged)

    @cached_property
    def _span(self) -> ArmSpan | None:
        return arm_span(self.robot)

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """The step counts them."""
        del iterations
        counts = states[:, self.step.layouts.state.slice("counts")].astype(np.int64)
        return {stage: counts[:, i] for i, stage in enumerate(self.step.layouts.stages)}

    def restarts(self, states: Array) -> Counts:
        """Hand postures tried but the first."""
        layout = self.step.layouts.state
        earlier, candidate = (
            states[:, layout.slice(name).start].astype(np.int64)
            for name in ("earlier", "candidate")
        )
        return earlier + np.clip(candidate, 0, self.options.candidates - 1)

    def rows(
        self, targets: TargetBatch, q0: Array, postures: Array, begun: bool = False
    ) -> tuple[Array, Array]:
        """States and parameters of the loop, to be changed before `run_rows`.

        Args:
            targets: k targets.
            q0: (k, n).
            postures: (k, candidates, hand) hand postures to start from, or (k, 1, hand). Motors
                that move free fingers only stay as in q0.
            begun: Whether a solution near q0 was looked for before, if one is wanted.

        Returns:
            (k, ...) states and parameters.
        """
        hand = len(self.step.layouts.robot.hand_actuators)
        tried = np.broadcast_to(postures, (len(targets), self.options.candidates, hand))
        vectors = (targets.vectors(f"{name}s") for name in self.step.layouts.contacts.data)
        # A kernel's column is a vector: of a hand with one motor there is no second dimension.
        tried = tried.reshape(len(targets), *self.first.input_shapes[-1])
        asked = *vectors, q0, self.terms(targets), tried
        states, parameters = self.first(*asked)
        if begun:
            layout = self.step.layouts.state
            states[:, layout.slice("phase")] = float(Phase.CANDIDATE)
            states[:, layout.slice("candidate")] = 0.0
        return states, parameters

    def run_rows(self, states: Array, parameters: Array) -> LoopResult:
        """Run the compiled loop on rows as made by `rows`."""
        return self.kernel.run(states, parameters, self.max_iterations)

    def terms(self, targets: TargetBatch) -> Array:
        """What `beginning` calls terms; kept, since making them costs as much as a solve."""
        if targets.fixed is not None:
            return self._terms_of(targets)
        asked = targets.tolerances, targets.enforce_limits, targets.prefer
        kept = self._kept
        if kept is None or kept[0] != asked:
            self._kept = kept = asked, self._terms_of(targets)
        return kept[1]

    def _terms_of(self, targets: TargetBatch) -> Array:
        bounds = targets.bounds(self.robot)
        nearest = np.array([float(targets.prefer == NEAREST)])
        every = targets.position_tolerance, targets.angle_tolerance, *bounds, nearest
        if bounds[0].ndim == 1:
            return np.concatenate(every)
        # Each target has bounds of its own.
        rows = (np.broadcast_to(part, (len(targets), part.shape[-1])) for part in every)
        return np.concatenate(list(rows), axis=1)

    @cached_property
    def first(self) -> FunctionKernel:
        """Makes first state and parameters of a round."""
        return FunctionKernel(beginning(self.step.layouts), self._compiled)
