"""What an iteration of hand-first computes in each stage, as plain functions.

Each takes state and parameters and gives the state as the stage leaves it, what it says of that
(`SAID`), and the record. Which stage a solve goes to stands in iteration.c, which calls them:

start       a look at the contacts where the robot is, if what is near that is wanted;
candidate   the palm pose that suits the next hand posture;
hand fit    one damped step of palm pose and hand posture;
placement   some arms in closed form for that palm pose;
arm steps   one damped step of the arm towards it, where no closed form helps;
choice      some arms in closed form, near to where the robot is;
refinement  one damped step of all motors, from the least violating arm;
balance     one step of all motors towards the smallest largest error;
tolerant    the steps of hand fit and refinement with errors within tolerance at no cost.

Three contacts with normals fix palm and hand: thirteen unknowns (palm 6, hand 7 for the Barrett)
against fifteen equations. The palm's coordinates are its pose; a step turns and shifts it in its
own frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import casadi as ca

from casadi_ik.compile.codegen import Stages
from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, ArmTrials, Farthest, Nearest, is_allowed
from casadi_ik.kinematics.box_qp import clip
from casadi_ik.kinematics.contact_fit import (
    TrialStep,
    beyond_tolerance,
    evaluate_contact_step,
    evaluate_excess_step,
    evaluate_step,
    initial_lm_state,
    lm_step,
    minimax_step,
    tolerance_ratio,
)
from casadi_ik.kinematics.contacts import (
    LENGTH,
    ContactRows,
    Kinds,
    Vectors,
    chord,
    kinds_suffix,
    within_tolerance,
)
from casadi_ik.kinematics.forward import Pose
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
from casadi_ik.solve.hand_first.iteration import Iteration, text
from casadi_ik.solve.hand_first.parameters import STAGES
from casadi_ik.solve.hand_first.state import SAID, HandFirstLayouts, Stage, with_rows
from casadi_ik.solve.status import Phase


class PalmAndHand(NamedTuple):
    """The unknowns of the hand stage."""

    rotation: Expr
    origin: Expr
    hand: Expr


def fit_residual(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Residual of `ContactRows`, in the palm frame."""
    return rows.residual(contacts.tips, _seen(rows.goals(p), x), p["weights"])


def fit_jacobian(
    contacts: HandContacts, rows: ContactRows, x: PalmAndHand, p: dict[str, Expr]
) -> Expr:
    """Jacobian (size, 6 + k) over palm shift [m], palm turn [rad] (palm frame) and hand.

    Seen from the palm, it is the targets that move when the palm does.
    """
    goals = _seen(rows.goals(p), x)
    k = contacts.jacobians[0]["point"].shape[1]
    tip_rates = [
        {name: ca.horzcat(ca.SX(3, 6), rate) for name, rate in rates.items()}
        for rates in contacts.jacobians
    ]
    goal_rates = [
        {
            name: ca.horzcat(
                -ca.DM.eye(3) if name == "point" else ca.DM(3, 3), skew(seen), ca.DM(3, k)
            )
            for name, seen in goal.items()
        }
        for goal in goals
    ]
    return rows.jacobian(contacts.tips, tip_rates, goals, goal_rates, p["weights"])


def _seen(goals: list[Vectors], x: PalmAndHand) -> list[Vectors]:
    """Targets of the base frame in the palm frame."""
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
    """How far the palm is out of the arm's reach, by `LENGTH`, and its slope (1, 6).

    Where contacts leave the hand a freedom (three parallel fingers), it is spent on bringing the
    wrist where the elbow can follow. Zero, with slope zero, within reach. None: nothing is known.
    """
    shift, turn = ca.SX.sym("shift", 3), ca.SX.sym("turn", 3)
    moved = Pose(
        x.rotation @ (ca.SX.eye(3) + skew(turn)),
        x.origin + x.rotation @ shift,
    )
    bounds = p["lower"][list(columns)], p["upper"][list(columns)]
    beyond = arm.distance_out_of_reach(moved, *bounds)
    if beyond is None:
        return None
    if not arm.is_exact:
        # What the nominal arm cannot reach by so little the real one may.
        error = arm.model_error
        beyond -= ca.fmin(ca.fmax(beyond, -error), error)
    motion = ca.vertcat(shift, turn)
    slope = ca.jacobian(beyond, motion)
    here = ca.substitute([beyond, slope], [motion], [ca.SX.zeros(6, 1)])
    return p["reach"] * here[0] / LENGTH, p["reach"] * here[1] / LENGTH


def fit_step(
    layouts: HandFirstLayouts,
    arm: ArmFamily | None,
    x: PalmAndHand,
    damping: Expr,
    p: dict[str, Expr],
    q: Expr,
    given: Sequence[Expr],
    tolerant: bool = False,
) -> TrialStep:
    """Make one damped step that turns and shifts the palm along one screw.

    With the palm on a screw, a palm that turns about the common axis of several joints while they
    turn back leaves the contacts exactly alone: the long valleys of nearly singular hands are
    straight.

    Args:
        layouts: Of the robot.
        arm: An arm whose reach is to be kept to, if known.
        x: Where the step begins.
        damping: Scalar.
        p: Parameters.
        q: (n, 1) with the hand's part at `x.hand`.
        given: Symbols that the parameters are made of.
        tolerant: Whether only the excess over the tolerances counts, see `beyond_tolerance`.
    """
    bounds = layouts.hand_bounds(q, p, first=6)
    there = PalmAndHand(ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("h", x.hand.numel()))
    seen = hoisted_call_function("fit_at", there, given, _rows(layouts, arm, there, p))

    def moved(step: Expr) -> PalmAndHand:
        rotation, origin = compose((x.rotation, x.origin), exp_se3(step[:6]))
        return PalmAndHand(rotation, origin, clip(x.hand + step[6:], bounds))

    def at(place: PalmAndHand) -> tuple[Expr, Expr]:
        residual, jacobian = seen(*place)
        if not tolerant:
            return residual, jacobian
        return beyond_tolerance(residual, jacobian, layouts.contacts, p)

    return lm_step(at, x, damping, bounds, moved, lambda place: place.hand)


def _rows(
    layouts: HandFirstLayouts, arm: ArmFamily | None, x: PalmAndHand, p: dict[str, Expr]
) -> tuple[Expr, Expr]:
    """Residual and Jacobian of contacts and reach."""
    contacts = hand_contacts(layouts.robot, x.hand, layouts.robot.hand_actuators)
    asked = contacts, layouts.contacts, x, p
    residual, jacobian = fit_residual(*asked), fit_jacobian(*asked)
    row = None if arm is None else reach_row(arm, layouts.robot.arm_actuators, x, p)
    if row is None:
        return residual, jacobian
    beyond, slope = row
    slope = ca.horzcat(slope, ca.SX(1, len(layouts.robot.hand_actuators)))
    return ca.vertcat(residual, beyond), ca.vertcat(jacobian, slope)


class HandFirstStep:
    """The stages' functions for one robot.

    Attributes:
        layouts: State, parameters and record.
        arm: The family of the robot's arm, or None: then it is searched.
    """

    def __init__(
        self, robot: RobotDescription, arm: ArmFamily | None, candidates: int, kinds: Kinds
    ) -> None:
        """Remember what the functions are made of.

        Args:
            robot: The description.
            arm: The family of its arm, or None: then it is searched.
            candidates: Hand postures a solve may start from.
            kinds: Of the contacts, by finger.
        """
        self.robot = robot
        self.arm = arm
        self.layouts = HandFirstLayouts(robot, candidates, kinds)
        self._built: dict[Any, ca.Function] = {}

    def graph(self) -> StepGraph:
        """The whole iteration."""
        layouts = self.layouts
        name = ca.Function.fix_name(f"hand_first_{self.robot.name}{kinds_suffix(layouts.kinds)}")
        return StepGraph(
            name,
            lambda: Stages({each: self.function(each) for each in self.stages}, text(self)),
            layouts.state,
            layouts.parameters,
            layouts.record,
            stage="phase",
            recipe=recipe(name, self.robot, layouts.candidates, layouts.kinds),
            apart="postures",
            virtual=lambda: Iteration(self),
        )

    @property
    def searched_if_near(self) -> bool:
        """Whether what is near is searched from there: a search over two joints passes it by."""
        return self.arm is not None and self.arm.is_iterative

    @cached_property
    def placements(self) -> ArmTrials | None:
        """The search for an arm far from its limits."""
        return None if self.arm is None else ArmTrials(self.arm, Farthest())

    @cached_property
    def choices(self) -> ArmTrials | None:
        """The search for an arm near to where the robot is."""
        if self.arm is None or self.searched_if_near:
            return None
        columns = list(self.robot.arm_actuators)
        ranges = (self.robot.upper - self.robot.lower)[columns]
        return ArmTrials(self.arm, Nearest.by_ranges(ranges))

    @cached_property
    def trials(self) -> tuple[int, ...]:
        """Trials of a placement, of one in later rounds, of a choice, of one that finds nothing."""
        far, near = self.placements, self.choices
        of_placement = (far.trials, far.all_trials) if far else (0, 0)
        return *of_placement, *((near.trials, near.hopeful_trials) if near else (0, 0))

    @cached_property
    def stages(self) -> dict[Any, Callable[[], ca.Function]]:
        """What builds the functions of the stages that solves of the robot may be in."""
        found: dict[Stage, Callable[[], ca.Function]] = {
            Stage.START: self._start,
            Stage.CANDIDATE: self._candidate,
            Stage.REFINEMENT: self._refinement,
            Stage.TOLERANT_REFINEMENT: self._tolerant_refinement,
            Stage.BALANCE: self._balance,
        }
        if self.robot.arm_actuators:
            found[Stage.HAND_FIT] = self._hand_fit
            found[Stage.TOLERANT_HAND_FIT] = self._tolerant_hand_fit
            # What no place of locked joints brought within limits is searched in later rounds, and
            # so is what Newton's steps did not lead to from the nominal arm: near a singularity
            # they lead nowhere near.
            if self.arm is None or not self.arm.is_complete:
                found[Stage.ARM_STEPS] = self._arm_step
        if self.placements is not None:
            found[Stage.ARM_PLACEMENT] = partial(self._placement, self.placements)
        if self.choices is not None:
            found[Stage.ARM_CHOICE] = partial(self._choice, self.choices)
        return found

    def function(self, stage: Any) -> ca.Function:
        """(state, parameters) -> state, `SAID`, record; a candidate's posture is a third input."""
        if stage not in self._built:
            self._built[stage] = self.stages[stage]()
        return self._built[stage]

    def _vectors(
        self, kind: type[ca.SX] | type[ca.MX] = ca.SX
    ) -> tuple[list[Expr], dict[str, Expr], dict[str, Expr]]:
        """State and parameters as symbols, and their fields by name."""
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
        changed: dict[str, Expr],
        said: dict[str, Expr],
        record: Expr,
    ) -> ca.Function:
        """A stage's function from what it changes in the state and what it says."""
        after = self.layouts.state.pack(s | changed)
        says = SAID.pack({name: ca.SX(0) for name in SAID.names} | said)
        return ca.Function(stage.name.lower(), inputs, with_cse(after, says, record))

    def _with_hand(self, q: Expr, hand: Expr) -> Expr:
        return with_rows(q, self.robot.hand_actuators, hand)

    def _start(self) -> ca.Function:
        """Nothing moves."""
        inputs, s, p = self._vectors()
        contacts = self.layouts.contacts
        residual, _ = self.layouts.whole.linearised(s["q"], inputs[1])
        tolerances = p["position_tolerance"], chord(p["angle_tolerance"])
        met = within_tolerance(*contacts.errors(residual), *tolerances)
        looked = TrialStep(s["q"], residual, residual, ca.SX(0), ca.SX(0))
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, looked)
        said = {"within": met, "cost": ca.sumsqr(residual)}
        return self._function(Stage.START, inputs, s, {"spent": ca.SX(1)}, said, record)

    def _candidate(self) -> ca.Function:
        inputs, s, p = self._vectors()
        hand = ca.SX.sym("hand", len(self.robot.hand_actuators))
        contacts = hand_contacts(self.robot, hand, self.robot.hand_actuators)
        number = ca.fmax(s["candidate"] + s["earlier"], 0.0) + s["turn"]
        rotation, origin = best_palm(
            contacts, self.layouts.contacts, p, number, base_rotation(self.robot)
        )
        q = self._with_hand(p["start"], hand)
        changed = {
            "q": q,
            "palm_rotation": rotation,
            "palm_origin": origin,
            "cost": 0.0,
            "margin": ARM_SEARCH.no_margin,
            "starts": 0.0,
        } | initial_lm_state()
        record = self.layouts.row(s, p, q, Phase.CANDIDATE)
        return self._function(Stage.CANDIDATE, [*inputs, hand], s, changed, {}, record)

    def _hand_fit(self) -> ca.Function:
        inputs, s, p = self._vectors()
        columns = list(self.robot.hand_actuators)
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], s["q"][columns])
        tried = fit_step(self.layouts, self.arm, x, s["damping"], p, s["q"], inputs)
        fine = ca.if_else(s["earlier"] > 0, STAGES.fit_part, STAGES.before_the_arm)
        judged = evaluate_contact_step(
            s, p, tried, self.layouts.contacts, STAGES.before_the_arm, fine
        )
        keep, reached = judged.accepted, tried.x
        changed = {
            "q": self._with_hand(s["q"], ca.if_else(keep, reached.hand, x.hand)),
            "palm_rotation": ca.if_else(keep, reached.rotation, x.rotation),
            "palm_origin": ca.if_else(keep, reached.origin, x.origin),
            "fits": judged.within,
        } | judged.lm_state
        said = {
            "settled": judged.settled,
            "within": judged.within,
            "miss": tolerance_ratio(judged.cost, p),
            "cost": ca.sumsqr(tried.residual_before),
        }
        record = self.layouts.row(s, p, s["q"], Phase.HAND_FIT, tried, keep)
        return self._function(Stage.HAND_FIT, inputs, s, changed, said, record)

    def _tolerant_hand_fit(self) -> ca.Function:
        """Build one damped step of palm and hand that reduces the excess over the tolerances."""
        inputs, s, p = self._vectors()
        columns = list(self.robot.hand_actuators)
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], s["q"][columns])
        tried = fit_step(self.layouts, self.arm, x, s["damping"], p, s["q"], inputs, True)
        rows = self.layouts.contacts
        judged = evaluate_excess_step(s, p, tried, rows, STAGES.before_the_arm)
        keep, reached = judged.accepted, tried.x
        changed = {
            "q": self._with_hand(s["q"], ca.if_else(keep, reached.hand, x.hand)),
            "palm_rotation": ca.if_else(keep, reached.rotation, x.rotation),
            "palm_origin": ca.if_else(keep, reached.origin, x.origin),
            "fits": judged.within,
        } | judged.lm_state
        said = {"settled": judged.settled, "within": judged.within}
        record = self.layouts.row(s, p, s["q"], Phase.HAND_FIT, tried, keep)
        return self._function(Stage.TOLERANT_HAND_FIT, inputs, s, changed, said, record)

    def _placement(self, search: ArmTrials) -> ca.Function:
        inputs, s, p = self._vectors(ca.MX)
        columns = list(self.robot.arm_actuators)
        pose = s["palm_rotation"], s["palm_origin"]
        bounds = p["lower"][columns], p["upper"][columns]
        visit, best = s["candidate"] + s["earlier"], (s["arm"], s["swivel"])
        arm, margin, swivel = search.trial(Pose(*pose), bounds, s["spent"], best, visit)
        hits: Expr = ca.MX(1)
        if not search.family.is_exact:
            polish = newton_polish(self.robot, search.family.model_error)
            arm, hits = polish(arm, *pose, p["lower"], p["upper"])
        outputs = self._kept(Stage.ARM_PLACEMENT, search)(*inputs, arm, margin, swivel, hits)
        return ca.Function("arm_placement", inputs, list(outputs))

    def _choice(self, search: ArmTrials) -> ca.Function:
        inputs, s, p = self._vectors(ca.MX)
        columns = list(self.robot.arm_actuators)
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        bounds = p["lower"][columns], p["upper"][columns]
        best, near = (s["arm"], s["swivel"]), p["start"][columns]
        found = search.trial(palm, bounds, s["spent"], best, s["candidate"], near)
        outputs = self._kept(Stage.ARM_CHOICE, search)(*inputs, *found, ca.MX(1))
        return ca.Function("arm_choice", inputs, list(outputs))

    def _kept(self, stage: Stage, search: ArmTrials) -> ca.Function:
        """Keep the best arm so far; the last input says whether it is the real one."""
        inputs, s, p = self._vectors()
        columns, near = self.robot.arm_actuators, search.is_nearest
        arm = ca.SX.sym("arm", len(columns))
        score, swivel, hits = (ca.SX.sym(name) for name in ("score", "swivel", "hits"))
        # What is looked for in a part of the range is not compared with what was found before.
        begins = ca.SX(0) if near else search.starts_subinterval(s["spent"])
        former = ca.if_else(begins, ARM_SEARCH.no_margin, s["margin"])
        better, best_score = score > former, ca.fmax(score, former)
        allowed = is_allowed(best_score) if near else best_score >= ARM_SEARCH.tolerance
        if not search.family.is_exact and not near:
            # Newton's steps keep within limits, whether or not the nominal arm did.
            better, allowed = ca.logic_or(better, hits), ca.logic_or(allowed, hits)
        best = ca.if_else(better, arm, s["arm"])
        q = with_rows(s["q"], columns, best)
        q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
        changed = {
            "spent": s["spent"] + 1,
            "margin": best_score,
            "arm": best,
            "swivel": ca.if_else(better, swivel, s["swivel"]),
        }
        phase = Phase.ARM_CHOICE if near else Phase.ARM_PLACEMENT
        margin = float("nan") if near else best_score
        record = self.layouts.row(s, p, q, phase, margin=margin)
        said = {"within": allowed, "near": hits}
        given = [*inputs, arm, score, swivel, hits]
        return self._function(stage, given, s, changed, said, record)

    def _arm_step(self) -> ca.Function:
        inputs, s, p = self._vectors()
        rows = list(self.robot.arm_actuators)
        arm = ca.fmin(ca.fmax(s["q"][rows], p["lower"][rows]), p["upper"][rows])
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        tried = pose_step(self.robot, arm, palm, s["damping"], p)
        judged = evaluate_step(s, tried, within=ca.SX(0), exact=ca.SX(0))
        now = ca.if_else(judged.accepted, tried.x, arm)
        margin = -ca.sqrt(judged.cost)
        best_margin, q = ca.fmax(margin, s["margin"]), with_rows(s["q"], rows, now)
        changed = judged.lm_state | {
            "q": q,
            "cost": s["cost"],
            "margin": best_margin,
            "arm": ca.if_else(margin > s["margin"], now, s["arm"]),
        }
        # An arm of too few free motors is as near as can be asked.
        few = ca.sum1(p["lower"][rows] < p["upper"][rows]) < POSE_DIMENSION
        position, angle = p["position_tolerance"] / LENGTH, p["angle_tolerance"]
        allowed = ca.mmax(position) ** 2 + ca.mmax(angle) ** 2
        said = {
            "settled": judged.settled,
            "near": ca.logic_and(
                few, judged.cost < NUMERIC_ARM_PARAMETERS.good_start_cost * allowed
            ),
            "cost": judged.cost,
            "at_end": next_joint_at_limit(self.robot, now, s["turned"], p),
        }
        record = self.layouts.row(s, p, q, Phase.ARM_PLACEMENT, margin=best_margin)
        return self._function(Stage.ARM_STEPS, inputs, s, changed, said, record)

    def _refinement(self) -> ca.Function:
        inputs, s, p = self._vectors()
        tried = self.layouts.whole.lm_trial(s["q"], s["damping"], inputs[1])
        judged = evaluate_contact_step(s, p, tried, self.layouts.contacts)
        changed = {"q": ca.if_else(judged.accepted, tried.x, s["q"])} | judged.lm_state
        said = {
            "settled": judged.settled,
            "within": judged.within,
            "miss": tolerance_ratio(judged.cost, p),
        }
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, tried, judged.accepted)
        return self._function(Stage.REFINEMENT, inputs, s, changed, said, record)

    def _tolerant_refinement(self) -> ca.Function:
        """Build one damped step of all motors that reduces the excess over the tolerances."""
        inputs, s, p = self._vectors()
        tried = self.layouts.whole.excess_trial(s["q"], s["damping"], inputs[1])
        judged = evaluate_excess_step(s, p, tried, self.layouts.contacts)
        changed = {"q": ca.if_else(judged.accepted, tried.x, s["q"])} | judged.lm_state
        said = {"settled": judged.settled, "within": judged.within}
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, tried, judged.accepted)
        return self._function(Stage.TOLERANT_REFINEMENT, inputs, s, changed, said, record)

    def _balance(self) -> ca.Function:
        inputs, s, p = self._vectors()
        tried = self.layouts.whole.minimax_trial(s["q"], s["damping"], s["power"], inputs[1])
        found = minimax_step(s["q"], tried, self.layouts.contacts, s, p)
        said = {"settled": found.is_finished, "within": found.within, "cost": found.largest}
        record = self.layouts.row(s, p, s["q"], Phase.BALANCE, tried, found.accepted)
        changed = {"q": found.q} | found.state
        return self._function(Stage.BALANCE, inputs, s, changed, said, record)
