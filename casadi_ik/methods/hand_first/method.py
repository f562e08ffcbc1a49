"""The hand-first method: lookup of postures, then one compiled loop over all stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arms.recognise import arm_family
from casadi_ik.arrays import Array, Counts
from casadi_ik.kernels import FunctionKernel, LoopResult, StepGraph
from casadi_ik.kernels.robot_kernels import RobotKernels
from casadi_ik.methods.common.contact_fit import fresh_fit
from casadi_ik.methods.common.coupling_record import coupling_jacobian
from casadi_ik.methods.common.looped_method import LoopedMethod, Start
from casadi_ik.methods.common.posture_table import squared_distance
from casadi_ik.methods.hand_first import one_by_one
from casadi_ik.methods.hand_first.beginning import beginning
from casadi_ik.methods.hand_first.going_on import (
    CARRIED,
    COUNTED,
    NEAR_OF_MANY,
    NEAR_SHRINKS,
    RETURNS_OF_MANY,
    SURE,
    TINY,
    VARIED,
    goes_on,
    most_returns,
    near_cost,
)
from casadi_ik.methods.hand_first.one_by_one import OneByOne
from casadi_ik.methods.hand_first.parameters import HandFirstParameters
from casadi_ik.methods.hand_first.restarts import VALLEYS, Restarts, first_rugged, later
from casadi_ik.methods.hand_first.rounds import RoundsPlan
from casadi_ik.methods.hand_first.state import STAGES
from casadi_ik.methods.hand_first.step import HandFirstStep
from casadi_ik.problem.contacts.kinds import Kinds, usual
from casadi_ik.problem.method import Quick
from casadi_ik.problem.preference import PREFERENCES
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Phase
from casadi_ik.problem.trace import RecordedJacobian
from casadi_ik.proofs.premises import ArmSpan, arm_span, palms_in_span
from casadi_ik.robots.description import RobotDescription

UNBOUNDED = 1e3
"""Bounds [rad or m] where limits are ignored."""

NEAREST = "q0"
"""The preference for what is near the start."""


class HandFirstMethod(LoopedMethod):
    """`hand-first`: contacts fix palm and hand, the arm follows in closed form.

    A round takes other hand postures, see `Restarts`; nearly all targets need one round only.

    Attributes:
        step: Its step for this robot.
        preferences: What it can prefer.
    """

    name = "hand-first"
    preferences = PREFERENCES
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
        super().__init__(robot, options, compiled)
        self.options: HandFirstParameters = options
        motors = len(robot.hand_actuators)
        self._rugged = first_rugged(options)
        every = options.rounds + later(motors)
        self.rounds = min(every, options.max_rounds or every)
        self._near, self._returns = near_cost(motors), most_returns(motors)
        self._kinds = kinds or usual(len(robot.fingers))
        self.step = HandFirstStep(robot, arm_family(robot), options.candidates, self._kinds)
        self._alone = OneByOne(self.step.layouts, self.rounds_plan)
        self._kept: tuple[Any, Array] | None = None

    def step_graph(self) -> StepGraph:
        """The whole iteration."""
        return self.step.graph()

    @cached_property
    def hands(self) -> Restarts:
        """The hand postures that rounds begin from."""
        return Restarts(self.robot, self.robot.hand_actuators, self.options, self._compiled)

    def for_kinds(self, kinds: Kinds) -> HandFirstMethod:
        """The same for contacts of other kinds."""
        if kinds == self._kinds:
            return self
        return HandFirstMethod(self.robot, self.options, self._compiled, kinds)

    def prepare(self) -> None:
        """Build and compile the loop, and fill the table of the first round."""
        _ = self.kernel, self.hands.table, self.first

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Those of the couplings."""
        return coupling_jacobian(self.robot)

    def begin(
        self, problems: Problems, q0: Array, number: int = 0, last: Array | None = None
    ) -> Start:
        """Start with the hand postures of the round; what was found before is kept."""
        states, parameters = self._round(problems, q0, number, last if number else None)
        if last is None:
            return states, parameters
        layout = self.step.layouts.state
        for name in CARRIED if number else COUNTED:
            states[:, layout.slice(name)] = last[:, layout.slice(name)]
        if number:
            earlier = layout.slice("earlier")
            states[:, earlier] = last[:, earlier] + self.options.candidates
        return states, parameters

    def searches(self, problems: Problems) -> tuple[Problems, ...]:
        """Near where the robot is, if that is wanted; then anywhere."""
        if problems.prefer != NEAREST:
            return (problems,)
        return problems, replace(problems, prefer="limits")

    def hopeful(self, states: Array, number: int) -> NDArray[np.bool_]:
        """Whether a round may still help: see `most_returns` and `rugged`."""
        layout = self.step.layouts.state
        returns, cost, held = (
            states[:, layout.slice(name).start] for name in ("returns", "best_cost", "held")
        )
        most = np.where(held > 0, RETURNS_OF_MANY, self._returns)
        further = number - self._rugged
        if further >= 0:
            near = np.where(held > 0, NEAR_OF_MANY, self._near)
            return (returns < most) & (cost < np.minimum(near, NEAR_SHRINKS / (further + 1)))
        # No more hands of tables if their fits come back to a minimum that just misses.
        tables = VARIED <= number < self.options.rounds
        return (returns < most) | (cost < SURE) | (not tables)

    def rounds_for(self, problems: Problems) -> int:
        """So many; of hands that are given none from anywhere but what every target gets."""
        return self.rounds if problems.palms is None else min(self.rounds, self._rugged)

    def reachable(self, problems: Problems) -> NDArray[np.bool_] | None:
        """Whether palms that are given are where the arm can hold its wrist."""
        return None if problems.palms is None else palms_in_span(self._span, problems)

    @cached_property
    def _span(self) -> ArmSpan | None:
        return arm_span(self.robot)

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """The step counts them."""
        del iterations
        counts = states[:, self.step.layouts.state.slice("counts")].astype(np.int64)
        return {stage: counts[:, i] for i, stage in enumerate(STAGES)}

    def restarts(self, states: Array) -> Counts:
        """Hand postures tried but the first."""
        layout = self.step.layouts.state
        earlier, candidate = (
            states[:, layout.slice(name).start].astype(np.int64)
            for name in ("earlier", "candidate")
        )
        return earlier + np.clip(candidate, 0, self.options.candidates - 1)

    def quick(self, problems: Problems, q0: Array) -> Quick | None:
        """The first round of one target; see `QuickMethod.quick`."""
        if not self.kernel.compiled:
            return None
        return self._alone.first(problems, q0, self.terms(problems))

    def finish(
        self, problems: Problems, q0: Array, last: LoopResult, number: int, rounds: int
    ) -> LoopResult | None:
        """Few targets are solved one by one in compiled code; see `LoopedMethod.finish`."""
        if not self.kernel.compiled or len(problems) > one_by_one.ALONE:
            return None
        return self._alone.rest(problems, q0, self.terms(problems), last, number, rounds)

    def rounds_plan(self, enforce_limits: bool) -> RoundsPlan:
        """All rounds of one target, as compiled code makes them."""
        kernels = RobotKernels(self.robot)
        return RoundsPlan(
            layouts=self.step.layouts,
            options=self.options,
            rounds=self.rounds,
            budget=self.max_iterations,
            hands=self.hands,
            enforce_limits=enforce_limits,
            begin=self.first,
            solve=self.kernel,
            contacts=kernels.contacts,
            judge=kernels.deviations,
        )

    def rows(
        self, problems: Problems, q0: Array, postures: Array, begun: bool = False
    ) -> tuple[Array, Array]:
        """States and parameters of the loop, to be changed before `run_rows`.

        Args:
            problems: k targets.
            q0: (k, n).
            postures: (k, candidates, hand) hand postures to start from, or (k, 1, hand). Motors
                that move free fingers only stay as in q0.
            begun: Whether a solution near q0 was looked for before, if one is wanted.

        Returns:
            (k, ...) states and parameters.
        """
        hand = len(self.robot.hand_actuators)
        tried = np.broadcast_to(postures, (len(problems), self.options.candidates, hand))
        vectors = (problems.vectors(f"{name}s") for name in self.step.layouts.contacts.data)
        # A kernel's column is a vector: of a hand with one motor there is no second dimension.
        tried = tried.reshape(len(problems), *self.first.input_shapes[-1])
        asked = *vectors, q0, self.terms(problems), tried
        states, parameters = self.first(*asked)
        if begun:
            layout = self.step.layouts.state
            states[:, layout.slice("phase")] = float(Phase.CANDIDATE)
            states[:, layout.slice("candidate")] = 0.0
        return states, parameters

    def run_rows(self, states: Array, parameters: Array, trace: bool = False) -> LoopResult:
        """Run the compiled loop on rows as made by `rows`."""
        return self.kernel.run(states, parameters, self.max_iterations, trace)

    def postures(self, problems: Problems, number: int) -> Array:
        """Candidates (k, candidates, hand) of a round whose postures look like the targets.

        Args:
            problems: k targets.
            number: The round, below `options.rounds`.
        """
        return self.hands.from_tables(problems, number)

    def _round(self, problems: Problems, q0: Array, number: int, last: Array | None) -> Start:
        """What a round begins with, the memory of those before aside."""
        later, layouts = number - self.options.rounds, self.step.layouts
        if later < 0 or last is None:
            postures = self.hands.from_tables(problems, number)
            if problems.prefer == NEAREST:
                postures = self.order(problems, q0, postures, own=last is None)
            return self.rows(problems, q0, postures, begun=last is not None)
        if later < VALLEYS:
            best = last[:, layouts.state.slice("best_q")]
            return self.rows(problems, q0, self.hands.along_valley(problems, best, later), True)
        # The first of them begins as a whole: what stands in the way may be arm and hand together.
        anywhere = self.hands.anywhere(problems, later - VALLEYS)
        whole = np.repeat(anywhere[:1], len(last), axis=0)
        if self.hands.mends(problems):
            hands = self.hands.mended(problems, number)
        else:
            hand = list(self.robot.hand_actuators)
            hands = np.repeat(anywhere[None][:, :, hand], len(last), axis=0)
        if goes_on(later - VALLEYS):
            best, cost = (last[:, layouts.state.slice(name)] for name in ("best_q", "best_cost"))
            flat = np.flatnonzero(cost < SURE)
            which = VALLEYS + (later - VALLEYS) // 2
            if len(flat):
                whole[flat] = best[flat]
                hands[flat] = self.hands.along_valley(problems.rows(flat), best[flat], which)
        states, parameters = self.rows(problems, q0, hands, True)
        lower, upper = (parameters[:, layouts.parameters.slice(end)] for end in ("lower", "upper"))
        states[:, layouts.state.slice("q")] = np.clip(whole, lower, upper)
        states[:, layouts.state.slice("phase")] = float(Phase.REFINEMENT)
        for name, value in fresh_fit().items():
            states[:, layouts.state.slice(name)] = value
        return states, parameters

    def order(self, problems: Problems, q0: Array, postures: Array, own: bool) -> Array:
        """Hand postures (k, c, hand), the nearest first.

        Args:
            problems: The targets.
            q0: (k, n) where the robot is.
            postures: The postures.
            own: Whether its own posture comes first, instead of the last of them.
        """
        hand = list(self.robot.hand_actuators)
        here = np.clip(q0, *problems.bounds(self.robot, UNBOUNDED))[:, None, hand]
        # A hand without an arm has begun there already.
        own = own and bool(self.robot.arm_actuators)
        if own:
            postures = postures[:, : max(postures.shape[1] - 1, 1)]
        ranges = np.maximum((self.robot.upper - self.robot.lower)[hand], TINY)
        distance = squared_distance(postures / ranges, here / ranges)
        rows = np.argsort(distance, axis=1, kind="stable")[:, :, None]
        ordered = np.take_along_axis(postures, rows, axis=1)
        if not own or self.options.candidates == 1:
            return ordered
        return np.concatenate([here, ordered], axis=1)

    def terms(self, problems: Problems) -> Array:
        """What `beginning` calls terms; kept, since making them costs as much as a solve."""
        if problems.fixed is not None:
            return self._terms_of(problems)
        asked = problems.tolerances, problems.enforce_limits, problems.prefer
        kept = self._kept
        if kept is None or kept[0] != asked:
            self._kept = kept = asked, self._terms_of(problems)
        return kept[1]

    def _terms_of(self, problems: Problems) -> Array:
        bounds = problems.bounds(self.robot, UNBOUNDED)
        nearest = np.array([float(problems.prefer == NEAREST)])
        every = problems.position_tolerance, problems.angle_tolerance, *bounds, nearest
        if bounds[0].ndim == 1:
            return np.concatenate(every)
        # Each target has bounds of its own.
        rows = (np.broadcast_to(part, (len(problems), part.shape[-1])) for part in every)
        return np.concatenate(list(rows), axis=1)

    @cached_property
    def first(self) -> FunctionKernel:
        """Makes first state and parameters of a round."""
        return FunctionKernel(beginning(self.step.layouts), self._compiled)
