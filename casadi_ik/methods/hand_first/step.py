"""The hand-first method as one step graph: the hand is fitted, then the arm follows.

The contacts fix palm pose and hand posture without the arm; the arm then has a closed form. One
iteration is one evaluation of whichever stage the solve is in:

candidate   take the next hand posture of the list and the palm pose that suits it best;
hand fit    one damped step of palm pose and hand posture;
placement   try some arms for that palm pose;
refinement  one damped step of all motors, from the least violating arm, where the arm cannot
            follow exactly or has no closed form;
choice      some arms in closed form, the nearest to where the robot is, if that is wanted; such a
            solve begins with a refinement of the whole configuration if it nearly solves already,
            and with the hand as it is;
balance     one step of all motors towards the smallest largest error, where least squares misses
            the tolerances by little.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import PARAMETERS
from casadi_ik.kernels.graphs import StepGraph, recipe
from casadi_ik.methods.common.contact_fit import (
    BALANCE,
    Judged,
    Tried,
    WholeStep,
    balanced,
    differs,
    fresh_fit,
    judge_contacts,
    near_tolerance,
)
from casadi_ik.methods.common.palm_fit import best_palm, hand_contacts
from casadi_ik.methods.hand_first.choice_stage import choice_stage
from casadi_ik.methods.hand_first.hand_fit import PalmAndHand, fit_step
from casadi_ik.methods.hand_first.numeric_stage import numeric_stage
from casadi_ik.methods.hand_first.placement_stage import placement_stage
from casadi_ik.methods.hand_first.state import STAGES, HandFirstLayouts, with_rows
from casadi_ik.problem.contacts import Kinds, chord, suffix, within_tolerance
from casadi_ik.problem.status import Phase, Status
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.smooth import Expr, shared

OWN_HAND = 0.5
"""Cost, with the best palm, up to which the hand as it is is fitted before other hands."""

BEFORE_THE_ARM = 0.999
"""Part of the tolerances that a hand is fitted to: the arm that follows it adds its rounding, which
at 1e-6 has made an answer of 1.0000006e-6."""


class HandFirstStep:
    """Builds the step graph for one robot.

    Attributes:
        layouts: State, parameters and record.
        arm: The family of the robot's arm, or None: then it is searched.
    """

    def __init__(
        self,
        robot: RobotDescription,
        arm: ArmFamily | None,
        candidates: int,
        kinds: Kinds,
    ) -> None:
        """Remember what the graph is made of.

        Args:
            robot: The description.
            arm: The family of its arm, or None: then it is searched.
            candidates: Hand postures a solve may start from.
            kinds: Of the contacts, by finger.
        """
        self.robot = robot
        self.arm = arm
        self.layouts = HandFirstLayouts(robot, candidates, kinds)

    def graph(self) -> StepGraph:
        """The whole iteration."""
        layouts = self.layouts
        return StepGraph(
            self._name,
            self._iteration,
            layouts.state,
            layouts.parameters,
            layouts.record,
            stage="phase",
            recipe=recipe(self._name, self.robot, layouts.candidates, layouts.kinds),
        )

    @property
    def _name(self) -> str:
        return ca.Function.fix_name(f"hand_first_{self.robot.name}{suffix(self.layouts.kinds)}")

    def _iteration(self) -> ca.Function:
        layouts = self.layouts
        state = ca.MX.sym("state", layouts.state.size)
        parameters = ca.MX.sym("parameters", layouts.parameters.size)
        stages = {
            Phase.REFINEMENT: self._start_or_refinement(),
            Phase.CANDIDATE: self._candidate(),
            Phase.BALANCE: balance_stage(layouts),
        }
        if self.robot.arm_actuators:
            stages[Phase.HAND_FIT] = self._hand_fit()
            stages[Phase.ARM_PLACEMENT] = self._placement()
        if self.arm is not None and not self._searched_if_near:
            stages[Phase.ARM_CHOICE] = choice_stage(layouts, self.arm)
        phases = [phase for phase in STAGES if phase in stages]
        cases = [stages[phase] for phase in phases]
        choose = ca.Function.conditional("stage", cases[:-1], cases[-1])
        phase = state[layouts.state.slice("phase")]
        number = sum((i * (phase == float(stage)) for i, stage in enumerate(phases)), ca.MX(0))
        outputs = choose(number, state, parameters)
        return ca.Function(self._name, [state, parameters], list(outputs))

    def _placement(self) -> ca.Function:
        layouts, arm = self.layouts, self.arm
        if arm is None:
            return numeric_stage(layouts)
        if arm.complete:
            return placement_stage(layouts, arm)
        # What no place of the locked joints brought within limits is searched in later rounds, and
        # so is what Newton's steps did not lead to from the nominal arm: near a singularity they
        # lead nowhere near.
        state = ca.MX.sym("state", layouts.state.size)
        parameters = ca.MX.sym("parameters", layouts.parameters.size)
        later = layouts.state.unpack(state)["earlier"] > 0
        if self._searched_if_near:
            later = ca.logic_or(later, layouts.parameters.unpack(parameters)["nearest"])
        stages = numeric_stage(layouts), placement_stage(layouts, arm)
        outputs = ca.Function.if_else("placed_or_searched", *stages)(later, state, parameters)
        return ca.Function("placement", [state, parameters], list(outputs))

    def _inputs(self) -> tuple[ca.SX, ca.SX, dict[str, ca.SX], dict[str, ca.SX]]:
        state = self.layouts.state.symbols("state")
        parameters = self.layouts.parameters.symbols("parameters")
        return (
            state,
            parameters,
            self.layouts.state.unpack(state),
            self.layouts.parameters.unpack(parameters),
        )

    def _candidate(self) -> ca.Function:
        """Take the next posture; after the last one the solve ends with the best it found."""
        state, parameters, s, p = self._inputs()
        layouts, count = self.layouts, self.layouts.candidates
        hand = sum(
            (ca.if_else(s["candidate"] == i, p["postures"][i, :].T, 0.0) for i in range(count)),
            ca.SX.zeros(len(self.robot.hand_actuators), 1),
        )
        exhausted = s["candidate"] >= count
        q = self._with_hand(p["start"], hand)
        contacts = hand_contacts(self.robot, hand, self.robot.hand_actuators)
        number = ca.fmax(s["candidate"] + s["earlier"], 0.0) + s["turn"]
        rotation, origin = best_palm(contacts, layouts.contacts, p, number)
        after = layouts.state.pack(
            self.layouts.counted(s, Phase.CANDIDATE)
            | {
                "q": ca.if_else(exhausted, s["best_q"], q),
                "palm_rotation": rotation,
                "palm_origin": origin,
                "phase": float(self._after_candidate),
                "cost": 0.0,
                "margin": PARAMETERS.no_margin,
                "starts": 0.0,
            }
            | fresh_fit()
        )
        status = ca.if_else(exhausted, float(Status.STALLED), float(Status.RUNNING))
        record = self.layouts.row(s, p, q, Phase.CANDIDATE, status)
        return ca.Function("candidate", [state, parameters], shared(after, record, status))

    @property
    def _after_candidate(self) -> Phase:
        """A hand on a fixed base has no palm pose to fit."""
        return Phase.HAND_FIT if self.robot.arm_actuators else Phase.REFINEMENT

    def _hand_fit(self) -> ca.Function:
        state, parameters, s, p = self._inputs()
        columns = list(self.robot.hand_actuators)
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], s["q"][columns])
        tried = fit_step(self.layouts, self.arm, x, s["damping"], p, s["q"])
        contacts = self.layouts.contacts
        judged = judge_contacts(s, p, tried, contacts, BEFORE_THE_ARM)
        keep, reached = judged.accepted, tried.reached
        # The last candidate goes on to the arm even if it does not fit: its arm and hand are the
        # nearest there is, and refinement starts from them.
        last = s["candidate"] + 1 >= self.layouts.candidates
        onwards = ca.logic_or(judged.within, last)
        ended = ca.logic_and(judged.settled, ca.logic_and(onwards, p["alone"] > 0))
        # Nor does one that fits nearly have to fit: it is balanced with the arm.
        missed = ca.logic_and(judged.settled, ca.logic_not(judged.within))
        near = ca.logic_and(missed, near_tolerance(self._left(judged, tried), contacts, p))
        other = differs(judged.cost, s["near"])
        returned = ca.logic_and(near, ca.logic_not(other))
        near = ca.logic_and(ca.logic_and(near, other), ca.logic_not(p["alone"]))
        onwards = ca.logic_or(onwards, near)
        # The hand as it is is only worth a fit if its contacts are shaped a little like these.
        skipped = ca.logic_and(self._is_own(s, p), ca.sumsqr(tried.before) > OWN_HAND)
        leave = ca.logic_or(skipped, ca.logic_and(judged.settled, ca.logic_not(onwards)))
        after = self.layouts.state.pack(
            self.layouts.counted(s, Phase.HAND_FIT)
            | {
                "q": self._with_hand(s["q"], ca.if_else(keep, reached.hand, x.hand)),
                "palm_rotation": ca.if_else(keep, reached.rotation, x.rotation),
                "palm_origin": ca.if_else(keep, reached.origin, x.origin),
                "phase": ca.if_else(
                    leave,
                    float(Phase.CANDIDATE),
                    ca.if_else(judged.settled, self._arm_stage(p), float(Phase.HAND_FIT)),
                ),
                "candidate": s["candidate"] + leave,
                "fits": judged.within,
                "near": ca.if_else(near, judged.cost, s["near"]),
                "returns": s["returns"] + returned,
            }
            | judged.fit
        )
        fitted = ca.if_else(judged.within, float(Status.SOLVED), float(Status.STALLED))
        status = ca.if_else(ended, fitted, float(Status.RUNNING))
        record = self.layouts.row(s, p, s["q"], Phase.HAND_FIT, status, tried, judged.accepted)
        return ca.Function("hand_fit", [state, parameters], shared(after, record, status))

    def _is_own(self, s: dict[str, Expr], p: dict[str, Expr]) -> Expr:
        """Whether a fit begins with the hand as it is, the first of the first round."""
        if self.layouts.candidates == 1:
            return ca.SX(0)
        first = ca.logic_and(s["candidate"] + s["earlier"] <= 0, s["spent"] < 1)
        return ca.logic_and(first, p["nearest"])

    @property
    def _searched_if_near(self) -> bool:
        """Whether what is near is searched from there: a search over two joints passes it by."""
        return self.arm is not None and self.arm.is_iterative

    def _arm_stage(self, p: dict[str, Expr]) -> Expr:
        if self.arm is None or self._searched_if_near:
            return ca.SX(float(Phase.ARM_PLACEMENT))
        return ca.if_else(p["nearest"], float(Phase.ARM_CHOICE), float(Phase.ARM_PLACEMENT))

    def _start_or_refinement(self) -> ca.Function:
        state = ca.MX.sym("state", self.layouts.state.size)
        parameters = ca.MX.sym("parameters", self.layouts.parameters.size)
        stages = start_stage(self.layouts), self._refinement()
        choose = ca.Function.if_else("whole", *stages)
        begins = at_start(self.layouts.state.unpack(state))
        outputs = choose(begins, state, parameters)
        return ca.Function("start_or_refinement", [state, parameters], list(outputs))

    def _refinement(self) -> ca.Function:
        layouts = self.layouts
        state = ca.MX.sym("state", layouts.state.size)
        parameters = ca.MX.sym("parameters", layouts.parameters.size)
        s = layouts.state.unpack(state)
        step = layouts.whole.fitted(s["q"], s["damping"], parameters)
        outputs = self._refined(step)(state, parameters, *step.parts)
        return ca.Function("refinement", [state, parameters], list(outputs))

    def _refined(self, step: WholeStep) -> ca.Function:
        """Go on from where a step leads if it gained."""
        state, parameters, s, p = self._inputs()
        contacts = self.layouts.contacts
        given, symbols = step.as_inputs()
        tried = given.tried(s["q"])
        judged = judge_contacts(s, p, tried, contacts)
        q = ca.if_else(judged.accepted, tried.reached, s["q"])
        solved = ca.logic_and(judged.settled, judged.within)
        unsolved = ca.logic_and(judged.settled, ca.logic_not(judged.within))
        near = ca.logic_and(unsolved, near_tolerance(self._left(judged, tried), contacts, p))
        other = differs(judged.cost, s["balanced"])
        returned = ca.logic_and(near, ca.logic_not(other))
        near = ca.logic_and(near, other)
        failed = ca.logic_and(unsolved, ca.logic_not(near))
        better = judged.cost < s["best_cost"]
        after = self.layouts.state.pack(
            self.layouts.counted(s, Phase.REFINEMENT)
            | {
                "q": q,
                "phase": ca.if_else(
                    near,
                    float(Phase.BALANCE),
                    ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.REFINEMENT)),
                ),
                "candidate": s["candidate"] + ca.if_else(failed, 1.0, 0.0),
                "balanced": ca.if_else(near, judged.cost, s["balanced"]),
                "returns": s["returns"] + returned,
                "best_cost": ca.if_else(better, judged.cost, s["best_cost"]),
                "best_q": ca.if_else(better, q, s["best_q"]),
            }
            | judged.fit
        )
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        record = self.layouts.row(s, p, s["q"], Phase.REFINEMENT, status, tried, judged.accepted)
        inputs = [state, parameters, *symbols]
        return ca.Function("refined", inputs, shared(after, record, status))

    def _left(self, judged: Judged, tried: Tried) -> Expr:
        """Residual of the contacts after a step was judged."""
        left = ca.if_else(judged.accepted, tried.there, tried.before)
        return left[: self.layouts.contacts.size]

    def _with_hand(self, q: Expr, hand: Expr) -> Expr:
        return with_rows(q, self.robot.hand_actuators, hand)


WHOLE = 0.5
"""Cost up to which a start is refined as a whole (three contacts off by 4 cm each)."""


def at_start(s: dict[str, Expr]) -> Expr:
    """Whether a solve that wants what is near is at its beginning."""
    return ca.logic_and(s["candidate"] < 0, s["spent"] < 1)


def start_stage(layouts: HandFirstLayouts) -> ca.Function:
    """A look at the contacts where the robot is; nothing moves.

    It ends with a solution, with the refinement of the whole from there, or with hand postures. A
    hand without an arm is refined in any case.
    """
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    residual = layouts.whole.residual(layouts.state.unpack(state)["q"], parameters)
    outputs = _looked(layouts)(state, parameters, residual)
    return ca.Function("start", [state, parameters], list(outputs))


def _looked(layouts: HandFirstLayouts) -> ca.Function:
    """What follows from the residual of the contacts where the robot is."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    contacts = layouts.contacts
    residual = ca.SX.sym("residual", contacts.size)
    cost = ca.sumsqr(residual)
    tolerances = p["position_tolerance"], chord(p["angle_tolerance"])
    met = within_tolerance(*contacts.errors(residual), *tolerances)
    far = cost > WHOLE if layouts.robot.arm_actuators else ca.SX(0)
    after = layouts.state.pack(
        layouts.counted(s, Phase.REFINEMENT)
        | {
            "phase": ca.if_else(far, float(Phase.CANDIDATE), float(Phase.REFINEMENT)),
            "candidate": s["candidate"] + far,
            "spent": 1.0,
            "best_cost": ca.fmin(cost, s["best_cost"]),
        }
    )
    status = ca.if_else(met, float(Status.SOLVED), float(Status.RUNNING))
    looked = Tried(s["q"], residual, residual, ca.SX(0), ca.SX(0))
    record = layouts.row(s, p, s["q"], Phase.REFINEMENT, status, looked)
    return ca.Function("looked", [state, parameters, residual], shared(after, record, status))


def balance_stage(layouts: HandFirstLayouts) -> ca.Function:
    """The stage: all motors at once, from where refinement ended.

    It ends with a solution or with the next candidate.
    """
    state = ca.MX.sym("state", layouts.state.size)
    parameters = ca.MX.sym("parameters", layouts.parameters.size)
    s = layouts.state.unpack(state)
    step = layouts.whole.balanced(s["q"], s["damping"], s["power"], parameters)
    outputs = _judged(layouts, step)(state, parameters, *step.parts)
    return ca.Function("balance", [state, parameters], list(outputs))


def _judged(layouts: HandFirstLayouts, step: WholeStep) -> ca.Function:
    """Go on from where a step leads if it gained."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    given, symbols = step.as_inputs()
    found = balanced(s["q"], given.tried(s["q"]), layouts.contacts, s, p)
    failed = ca.logic_and(found.over, ca.logic_not(found.within))
    fit = {
        name: ca.if_else(failed, fresh_fit().get(name, 0.0), found.fit[name]) for name in found.fit
    }
    after = layouts.state.pack(
        layouts.counted(s, Phase.BALANCE)
        | {
            "q": found.q,
            "phase": ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
            "candidate": s["candidate"] + failed,
            "returns": s["returns"]
            + ca.logic_and(failed, found.largest > BALANCE.closer * s["least"]),
            "least": ca.if_else(failed, ca.fmin(found.largest, s["least"]), s["least"]),
        }
        | fit
    )
    status = ca.if_else(found.within, float(Status.SOLVED), float(Status.RUNNING))
    record = layouts.row(s, p, s["q"], Phase.BALANCE, status, found.tried, accepted=found.accepted)
    return ca.Function("balanced", [state, parameters, *symbols], shared(after, record, status))
