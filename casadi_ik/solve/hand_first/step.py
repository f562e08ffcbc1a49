"""Graphs of the stages of hand-first for one arm with a hand.

A graph takes state and parameters, and returns the state after the iteration, the outputs that
decide the next stage (`STAGE_RESULT`), and the record. iteration.c calls the graphs and chooses the
next stage:

start        errors of the contacts at q0, if the preference is q0;
candidate    best palm pose of the next hand posture;
hand fit     one damped step of palm pose and hand posture;
placement    a trial of arms in closed form for that palm pose, far from their limits;
choice       a trial of arms in closed form, near q0;
arm steps    one damped step of the arm towards the palm pose, where no closed form applies;
refinement   one damped step of all motors;
balance      one step of all motors towards the smallest maximum of the relative errors;
tolerant     the steps of hand fit and refinement with errors within tolerance at no cost.

Three contacts with normals determine palm and hand: thirteen unknowns (palm 6, hand 7 for the
Barrett) and fifteen equations. The palm is represented by its pose, and a step rotates and
translates it in the palm frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import casadi as ca

from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, ArmTrials, Farthest, Nearest, is_allowed
from casadi_ik.kinematics.box_qp import clip
from casadi_ik.kinematics.contact_fit import (
    StepOutcome,
    TrialStep,
    beyond_tolerance,
    evaluate_contact_step,
    evaluate_excess_step,
    evaluate_step,
    initial_lm_state,
    lm_step,
    tolerance_ratio,
)
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    Kinds,
    Vectors,
    chord,
    within_tolerance,
)
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.minimax import minimax_step, minimax_trial
from casadi_ik.kinematics.palm import (
    NUMERIC_ARM_PARAMETERS,
    POSE_DIMENSION,
    HandContacts,
    base_rotation,
    best_palm,
    hand_contacts,
    newton_polish,
    next_joint_at_limit,
    pose_step,
)
from casadi_ik.kinematics.se3 import compose, exp_se3, skew
from casadi_ik.kinematics.smooth import Expr, hoisted_call_function, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.hand_first.parameters import STAGE_PARAMETERS
from casadi_ik.solve.hand_first.state import STAGE_RESULT, HandFirstLayouts, Stage, with_rows
from casadi_ik.solve.status import Phase


class PalmAndHand(NamedTuple):
    """Unknowns of the hand fit.

    Attributes:
        rotation: (3, 3) palm orientation, base frame.
        origin: (3, 1) palm position [m], base frame.
        hand: (h, 1) positions of the hand's motors [rad or m].
    """

    rotation: Expr
    origin: Expr
    hand: Expr


def fit_residual(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Return the residual of `ContactRows`, in the palm frame."""
    return rows.residual(contacts.tips, _goals_in_palm(rows.goals(p), x), p["weights"])


def fit_jacobian(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Return the Jacobian (size, 6 + k) over palm translation [m], palm rotation [rad] and hand.

    In the palm frame, in which the palm moves, it is the targets that move.
    """
    goals = _goals_in_palm(rows.goals(p), x)
    k = contacts.jacobians[0]["point"].shape[1]
    tip_rates = [
        {name: ca.horzcat(ca.SX(3, 6), rate) for name, rate in rates.items()}
        for rates in contacts.jacobians
    ]
    goal_rates = [
        {
            name: ca.horzcat(
                -ca.DM.eye(3) if name == "point" else ca.DM(3, 3), skew(vector), ca.DM(3, k)
            )
            for name, vector in goal.items()
        }
        for goal in goals
    ]
    return rows.jacobian(contacts.tips, tip_rates, goals, goal_rates, p["weights"])


def _goals_in_palm(goals: list[Vectors], x: PalmAndHand) -> list[Vectors]:
    """Return targets of the base frame in the palm frame."""
    return [
        {
            name: x.rotation.T @ (vector - x.origin if name == "point" else vector)
            for name, vector in goal.items()
        }
        for goal in goals
    ]


def reach_row(
    arm: ArmFamily, columns: Sequence[int], x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr] | None:
    """Return the distance of the palm from the reach of the arm / `LENGTH`, and its slope (1, 6).

    Where contacts leave the hand a motion (three parallel fingers), it brings the wrist to where
    the elbow can follow. Distance and slope are zero within reach. None: the reach is unknown.
    """
    shift, turn = ca.SX.sym("shift", 3), ca.SX.sym("turn", 3)
    displaced = Pose(
        x.rotation @ (ca.SX.eye(3) + skew(turn)),
        x.origin + x.rotation @ shift,
    )
    bounds = p["lower"][list(columns)], p["upper"][list(columns)]
    distance = arm.distance_out_of_reach(displaced, *bounds)
    if distance is None:
        return None
    if not arm.is_exact:
        # The real arm may reach palms that the nominal arm misses by up to this error.
        error = arm.model_error
        distance -= ca.fmin(ca.fmax(distance, -error), error)
    motion = ca.vertcat(shift, turn)
    slope = ca.jacobian(distance, motion)
    values = ca.substitute([distance, slope], [motion], [ca.SX.zeros(6, 1)])
    return p["reach_weight"] * values[0] / LENGTH, p["reach_weight"] * values[1] / LENGTH


def fit_step(
    layouts: HandFirstLayouts,
    arm: ArmFamily | None,
    x: PalmAndHand,
    damping: Expr,
    p: dict[str, Expr],
    q: Expr,
    symbols: Sequence[Expr],
    tolerant: bool = False,
) -> TrialStep:
    """Make one damped step of the hand, with the palm along a screw.

    A palm that rotates about the common axis of several joints while they rotate back leaves the
    contacts exactly unchanged if it moves along a screw. The long valleys of nearly singular hands
    are therefore straight.

    Args:
        layouts: Layouts of the robot.
        arm: Closed form of an arm whose reach the palm should keep; None: no such arm.
        x: Palm and hand before the step.
        damping: Damping, a scalar.
        p: Parameters.
        q: (n, 1) configuration whose hand is `x.hand`.
        symbols: Symbols on which the parameters depend.
        tolerant: Whether only the excess over the tolerances counts, see `beyond_tolerance`.
    """
    bounds = layouts.hand_bounds(q, p, first=6)
    symbol = PalmAndHand(ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("h", x.hand.numel()))
    residual_rows = _residual_rows(layouts, arm, symbol, p)
    linearisation = hoisted_call_function("fit_at", symbol, symbols, residual_rows)

    def displace(step: Expr) -> PalmAndHand:
        rotation, origin = compose((x.rotation, x.origin), exp_se3(step[:6]))
        return PalmAndHand(rotation, origin, clip(x.hand + step[6:], bounds))

    def linearise(point: PalmAndHand) -> tuple[Expr, Expr]:
        residual, jacobian = linearisation(*point)
        if not tolerant:
            return residual, jacobian
        return beyond_tolerance(residual, jacobian, layouts.contacts, p)

    return lm_step(linearise, x, damping, bounds, displace, lambda point: point.hand)


def _residual_rows(
    layouts: HandFirstLayouts, arm: ArmFamily | None, x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Return residual and Jacobian of the contacts and of the reach."""
    contacts = hand_contacts(layouts.robot, x.hand, layouts.robot.hand_actuators)
    arguments = contacts, layouts.contacts, x, p
    residual, jacobian = fit_residual(*arguments), fit_jacobian(*arguments)
    row = None if arm is None else reach_row(arm, layouts.robot.arm_actuators, x, p)
    if row is None:
        return residual, jacobian
    distance, slope = row
    slope = ca.horzcat(slope, ca.SX(1, len(layouts.robot.hand_actuators)))
    return ca.vertcat(residual, distance), ca.vertcat(jacobian, slope)


class HandFirstStep:
    """Graphs of the stages for one robot.

    Attributes:
        robot: Description of the robot.
        layouts: Layouts of state, parameters and record.
        arm: Closed form of the arm; None: the arm is placed by damped steps.
    """

    def __init__(
        self, robot: RobotDescription, arm: ArmFamily | None, candidates: int, kinds: Kinds
    ) -> None:
        """Store the arguments; graphs are built when first needed.

        Args:
            robot: Description of the robot.
            arm: Closed form of the arm; None: the arm is placed by damped steps.
            candidates: Maximum number of hand postures of a restart.
            kinds: Kinds of the contacts, by finger.
        """
        self.robot = robot
        self.arm = arm
        self.layouts = HandFirstLayouts(robot, candidates, kinds)
        self._graphs: dict[Any, ca.Function] = {}

    @property
    def uses_steps_near_q0(self) -> bool:
        """True if damped steps find arms near q0; a search of two joints would miss them."""
        return self.arm is not None and self.arm.is_iterative

    @cached_property
    def placements(self) -> ArmTrials | None:
        """Search for an arm far from its limits; None without a closed form."""
        return None if self.arm is None else ArmTrials(self.arm, Farthest())

    @cached_property
    def choices(self) -> ArmTrials | None:
        """Search for an arm near q0; None if damped steps search for it."""
        if self.arm is None or self.uses_steps_near_q0:
            return None
        columns = list(self.robot.arm_actuators)
        ranges = (self.robot.upper - self.robot.lower)[columns]
        return ArmTrials(self.arm, Nearest.by_ranges(ranges))

    @cached_property
    def trials(self) -> tuple[int, ...]:
        """Maximum numbers of trials.

        These are of a placement, of a placement in later restarts, of a choice, and of a choice
        without a result.
        """
        placements, choices = self.placements, self.choices
        of_placement = (placements.trials, placements.all_trials) if placements else (0, 0)
        return *of_placement, *((choices.trials, choices.hopeful_trials) if choices else (0, 0))

    @cached_property
    def stages(self) -> dict[Any, Callable[[], ca.Function]]:
        """Factories of the graphs of all stages of the robot."""
        factories: dict[Stage, Callable[[], ca.Function]] = {
            Stage.START: self._start,
            Stage.CANDIDATE: self._candidate,
            Stage.REFINEMENT: self._refinement,
            Stage.TOLERANT_REFINEMENT: self._tolerant_refinement,
            Stage.BALANCE: self._balance,
        }
        if self.robot.arm_actuators:
            factories[Stage.HAND_FIT] = self._hand_fit
            factories[Stage.TOLERANT_HAND_FIT] = partial(self._hand_fit, tolerant=True)
            # Later restarts search numerically where no values of locked joints gave an arm within
            # limits, and where Newton's steps from the nominal arm failed: near a singularity they
            # diverge.
            if self.arm is None or not self.arm.is_complete:
                factories[Stage.ARM_STEPS] = self._arm_step
        if self.placements is not None:
            factories[Stage.ARM_PLACEMENT] = partial(self._placement, self.placements)
        if self.choices is not None:
            factories[Stage.ARM_CHOICE] = partial(self._choice, self.choices)
        return factories

    def function(self, stage: Any) -> ca.Function:
        """Return the graph of a stage: (state, parameters) -> state, `STAGE_RESULT`, record.

        The graph of a candidate has the hand posture as a third input.
        """
        if stage not in self._graphs:
            self._graphs[stage] = self.stages[stage]()
        return self._graphs[stage]

    def _vectors(
        self, kind: type[ca.SX] | type[ca.MX] = ca.SX
    ) -> tuple[list[Expr], dict[str, Expr], dict[str, Expr]]:
        """Return symbols of state and parameters, and their fields by name."""
        layouts = self.layouts
        state = kind.sym("state", layouts.state.size)
        parameters = kind.sym("parameters", layouts.parameters.size)
        return (
            [state, parameters],
            layouts.state.unpack(state),
            layouts.parameters.unpack(parameters),
        )

    def _function(
        self,
        stage: Any,
        inputs: list[Expr],
        s: dict[str, Expr],
        changes: dict[str, Expr],
        results: dict[str, Expr],
        record: Expr,
    ) -> ca.Function:
        """Return the graph of a stage from its changes of the state and its results."""
        next_state = self.layouts.state.pack(s | changes)
        all_results = STAGE_RESULT.pack({name: ca.SX(0) for name in STAGE_RESULT.names} | results)
        return ca.Function(stage.name.lower(), inputs, with_cse(next_state, all_results, record))

    def _with_hand(self, q: Expr, hand: Expr) -> Expr:
        return with_rows(q, self.robot.hand_actuators, hand)

    def _start(self) -> ca.Function:
        """Build the check of the contacts at q0."""
        inputs, s, p = self._vectors()
        contacts = self.layouts.contacts
        residual, _ = self.layouts.all_motors.linearised(s["q"], inputs[1])
        tolerances = p["position_tolerance"], chord(p["angle_tolerance"])
        is_within = within_tolerance(*contacts.errors(residual), *tolerances)
        no_step = TrialStep(s["q"], residual, residual, ca.SX(0), ca.SX(0))
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, no_step)
        results = {"is_within": is_within, "cost": ca.sumsqr(residual)}
        changes = {"stage_iterations": ca.SX(1)}
        return self._function(Stage.START, inputs, s, changes, results, record)

    def _candidate(self) -> ca.Function:
        """Build the best palm pose of a hand posture."""
        inputs, s, p = self._vectors()
        hand = ca.SX.sym("hand", len(self.robot.hand_actuators))
        contacts = hand_contacts(self.robot, hand, self.robot.hand_actuators)
        number = ca.fmax(s["candidate"] + s["candidates_before"], 0.0) + s["palm_number"]
        rotation, origin = best_palm(
            contacts, self.layouts.contacts, p, number, base_rotation(self.robot)
        )
        q = self._with_hand(p["start"], hand)
        changes = {
            "q": q,
            "palm_rotation": rotation,
            "palm_origin": origin,
            "cost": 0.0,
            "arm_margin": ARM_SEARCH.no_margin,
            "arm_starts": 0.0,
        } | initial_lm_state()
        record = self.layouts.row(s, p, q, Phase.CANDIDATE)
        return self._function(Stage.CANDIDATE, [*inputs, hand], s, changes, {}, record)

    def _hand_fit(self, tolerant: bool = False) -> ca.Function:
        """Build one damped step of palm and hand.

        Args:
            tolerant: Whether the step reduces only the excess over the tolerances.
        """
        inputs, s, p = self._vectors()
        columns = list(self.robot.hand_actuators)
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], s["q"][columns])
        trial = fit_step(self.layouts, self.arm, x, s["damping"], p, s["q"], inputs, tolerant)
        rows, fraction = self.layouts.contacts, STAGE_PARAMETERS.fit_fraction
        if tolerant:
            outcome = evaluate_excess_step(s, p, trial, rows, fraction)
            results = {"is_settled": outcome.settled, "is_within": outcome.within}
        else:
            tight = STAGE_PARAMETERS.tight_fit_fraction
            desired = ca.if_else(s["candidates_before"] > 0, tight, fraction)
            outcome = evaluate_contact_step(s, p, trial, rows, fraction, desired)
            results = fit_results(trial, outcome, p)
        accepted, next_x = outcome.accepted, trial.x
        changes = {
            "q": self._with_hand(s["q"], ca.if_else(accepted, next_x.hand, x.hand)),
            "palm_rotation": ca.if_else(accepted, next_x.rotation, x.rotation),
            "palm_origin": ca.if_else(accepted, next_x.origin, x.origin),
            "meets_contacts": outcome.within,
        } | outcome.lm_state
        record = self.layouts.row(s, p, s["q"], Phase.HAND_FIT, trial, accepted)
        stage = Stage.TOLERANT_HAND_FIT if tolerant else Stage.HAND_FIT
        return self._function(stage, inputs, s, changes, results, record)

    def _placement(self, search: ArmTrials) -> ca.Function:
        """Build a trial of arms far from their limits."""
        inputs, s, p = self._vectors(ca.MX)
        columns = list(self.robot.arm_actuators)
        pose = s["palm_rotation"], s["palm_origin"]
        bounds = p["lower"][columns], p["upper"][columns]
        visit, best = s["candidate"] + s["candidates_before"], (s["arm_best"], s["arm_redundancy"])
        trial = s["stage_iterations"]
        arm, margin, redundancy = search.trial(Pose(*pose), bounds, trial, best, visit)
        is_exact: Expr = ca.MX(1)
        if not search.family.is_exact:
            polish = newton_polish(self.robot, search.family.model_error)
            arm, is_exact = polish(arm, *pose, p["lower"], p["upper"])
        update = self._best_arm(Stage.ARM_PLACEMENT, search)
        outputs = update(*inputs, arm, margin, redundancy, is_exact)
        return ca.Function("arm_placement", inputs, list(outputs))

    def _choice(self, search: ArmTrials) -> ca.Function:
        """Build a trial of arms near q0."""
        inputs, s, p = self._vectors(ca.MX)
        columns = list(self.robot.arm_actuators)
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        bounds = p["lower"][columns], p["upper"][columns]
        best, reference = (s["arm_best"], s["arm_redundancy"]), p["start"][columns]
        trial = s["stage_iterations"]
        candidate = search.trial(palm, bounds, trial, best, s["candidate"], reference)
        outputs = self._best_arm(Stage.ARM_CHOICE, search)(*inputs, *candidate, ca.MX(1))
        return ca.Function("arm_choice", inputs, list(outputs))

    def _best_arm(self, stage: Stage, search: ArmTrials) -> ca.Function:
        """Build the update of the best arm; the last input is 1 if the arm meets the palm pose."""
        inputs, s, p = self._vectors()
        columns, is_nearest = self.robot.arm_actuators, search.is_nearest
        arm = ca.SX.sym("arm", len(columns))
        score, redundancy, is_exact = (ca.SX.sym(name) for name in ("score", "swivel", "hits"))
        # Scores of different parts of the range are not compared.
        starts = ca.SX(0) if is_nearest else search.starts_subinterval(s["stage_iterations"])
        previous_score = ca.if_else(starts, ARM_SEARCH.no_margin, s["arm_margin"])
        is_better, best_score = score > previous_score, ca.fmax(score, previous_score)
        if is_nearest:
            is_arm_allowed = is_allowed(best_score)
        else:
            is_arm_allowed = best_score >= ARM_SEARCH.tolerance
        if not search.family.is_exact and not is_nearest:
            # Newton's steps stay within limits even if the nominal arm is outside.
            is_better = ca.logic_or(is_better, is_exact)
            is_arm_allowed = ca.logic_or(is_arm_allowed, is_exact)
        best = ca.if_else(is_better, arm, s["arm_best"])
        q = with_rows(s["q"], columns, best)
        q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
        changes = {
            "stage_iterations": s["stage_iterations"] + 1,
            "arm_margin": best_score,
            "arm_best": best,
            "arm_redundancy": ca.if_else(is_better, redundancy, s["arm_redundancy"]),
        }
        phase = Phase.ARM_CHOICE if is_nearest else Phase.ARM_PLACEMENT
        margin = float("nan") if is_nearest else best_score
        record = self.layouts.row(s, p, q, phase, margin=margin)
        results = {"arm_is_allowed": is_arm_allowed, "arm_is_exact": is_exact}
        all_inputs = [*inputs, arm, score, redundancy, is_exact]
        return self._function(stage, all_inputs, s, changes, results, record)

    def _arm_step(self) -> ca.Function:
        """Build one damped step of the arm towards the palm pose."""
        inputs, s, p = self._vectors()
        rows = list(self.robot.arm_actuators)
        arm = ca.fmin(ca.fmax(s["q"][rows], p["lower"][rows]), p["upper"][rows])
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        trial = pose_step(self.robot, arm, palm, s["damping"], p)
        outcome = evaluate_step(s, trial, within=ca.SX(0), exact=ca.SX(0))
        next_arm = ca.if_else(outcome.accepted, trial.x, arm)
        margin = -ca.sqrt(outcome.cost)
        best_margin, q = ca.fmax(margin, s["arm_margin"]), with_rows(s["q"], rows, next_arm)
        changes = outcome.lm_state | {
            "q": q,
            "cost": s["cost"],
            "arm_margin": best_margin,
            "arm_best": ca.if_else(margin > s["arm_margin"], next_arm, s["arm_best"]),
        }
        # An arm with too few free motors need not meet the palm pose exactly.
        has_few = ca.sum1(p["lower"][rows] < p["upper"][rows]) < POSE_DIMENSION
        position, angle = p["position_tolerance"] / LENGTH, p["angle_tolerance"]
        allowed_cost = ca.mmax(position) ** 2 + ca.mmax(angle) ** 2
        results = {
            "is_settled": outcome.settled,
            "arm_is_close": ca.logic_and(
                has_few, outcome.cost < NUMERIC_ARM_PARAMETERS.good_start_cost * allowed_cost
            ),
            "cost": outcome.cost,
            "joint_to_flip": next_joint_at_limit(self.robot, next_arm, s["arm_flipped_joint"], p),
        }
        record = self.layouts.row(s, p, q, Phase.ARM_PLACEMENT, margin=best_margin)
        return self._function(Stage.ARM_STEPS, inputs, s, changes, results, record)

    def _refinement(self) -> ca.Function:
        """Build one damped step of all motors."""
        inputs, s, p = self._vectors()
        trial = self.layouts.all_motors.lm_trial(s["q"], s["damping"], inputs[1])
        outcome = evaluate_contact_step(s, p, trial, self.layouts.contacts)
        changes = {"q": ca.if_else(outcome.accepted, trial.x, s["q"])} | outcome.lm_state
        results = {
            "is_settled": outcome.settled,
            "is_within": outcome.within,
            "rms_ratio": tolerance_ratio(outcome.cost, p),
        }
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, trial, outcome.accepted)
        return self._function(Stage.REFINEMENT, inputs, s, changes, results, record)

    def _tolerant_refinement(self) -> ca.Function:
        """Build one damped step of all motors that reduces the excess over the tolerances."""
        inputs, s, p = self._vectors()
        trial = self.layouts.all_motors.excess_trial(s["q"], s["damping"], inputs[1])
        outcome = evaluate_excess_step(s, p, trial, self.layouts.contacts)
        changes = {"q": ca.if_else(outcome.accepted, trial.x, s["q"])} | outcome.lm_state
        results = {"is_settled": outcome.settled, "is_within": outcome.within}
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, trial, outcome.accepted)
        return self._function(Stage.TOLERANT_REFINEMENT, inputs, s, changes, results, record)

    def _balance(self) -> ca.Function:
        """Build one minimax step of all motors."""
        inputs, s, p = self._vectors()
        trial = minimax_trial(self.layouts.all_motors, s["q"], s["damping"], s["power"], inputs[1])
        outcome = minimax_step(s["q"], trial, self.layouts.contacts, s, p)
        results = {
            "is_settled": outcome.is_finished,
            "is_within": outcome.within,
            "max_ratio": outcome.largest,
        }
        record = self.layouts.row(s, p, s["q"], Phase.BALANCE, trial, outcome.accepted)
        changes = {"q": outcome.q} | outcome.state
        return self._function(Stage.BALANCE, inputs, s, changes, results, record)


def fit_results(trial: TrialStep, outcome: StepOutcome, p: dict[str, Expr]) -> dict[str, Expr]:
    """Return the results of a step of a hand fit."""
    return {
        "is_settled": outcome.settled,
        "is_within": outcome.within,
        "rms_ratio": tolerance_ratio(outcome.cost, p),
        "cost": ca.sumsqr(trial.residual_before),
    }
