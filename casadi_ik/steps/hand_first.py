"""The hand-first method as one step graph: the hand is fitted, then the arm follows.

The contacts fix palm pose and hand posture without the arm; the arm then has a closed form. One
iteration is one evaluation of whichever stage the solve is in:

candidate   take the next hand posture of the list and the palm pose that suits it best;
hand fit    one damped step of palm pose and hand posture;
placement   try some swivels of the arm for that palm pose;
refinement  one damped step of all motors, from the least violating arm, where the arm cannot
            follow exactly or has no closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.kernels.step_graph import StepGraph
from casadi_ik.robots.description import RobotDescription
from casadi_ik.steps.arm_placement import ALLOWED, ITERATIONS, place_arm
from casadi_ik.steps.contact_fit import (
    DAMPING_DOWN,
    DAMPING_FLOOR,
    DAMPING_START,
    DAMPING_UP,
)
from casadi_ik.steps.hand_first_state import (
    EXACT,
    STAGES,
    HandFirstLayouts,
    errors,
    within_tolerance,
)
from casadi_ik.steps.hand_fit import PalmAndHand, best_palm, fit_step, hand_contacts
from casadi_ik.steps.status import Phase, Status
from casadi_ik.steps.whole_fit import whole_step
from casadi_ik.symbolic.kinematics import Pose
from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.srs_arm import SrsArm
from casadi_ik.symbolic.subexpressions import shared

SLOW = 0.9
"""A step that leaves more than this part of the cost gained little."""

QUADRATIC = 0.1
"""A step that leaves less than this part is converging fast: worth another one."""

PATIENCE, BUDGET = 3, 15
"""Evaluations with little gain, and evaluations in all, before a fit is given up."""

PROMISING = 1e-3
"""Cost below which a fit is close enough to be worth `PERSISTENCE` times as much."""

PERSISTENCE = 3
NOTHING = float("nan")


@dataclass(frozen=True, eq=False)
class Judged:
    """A damped step after it was judged by its cost."""

    accepted: Expr
    cost: Expr
    damping: Expr
    waited: Expr
    spent: Expr
    within: Expr
    settled: Expr
    before: Expr
    step_size: Expr


class HandFirstStep:
    """Builds the step graph for one robot.

    Attributes:
        layouts: State, parameters and record.
    """

    def __init__(self, robot: RobotDescription, arm: SrsArm | None, candidates: int) -> None:
        """Remember what the graph is made of.

        Args:
            robot: The description.
            arm: Constants of an S-R-S arm, or None: then refinement does the arm's work.
            candidates: Hand postures a solve may start from.
        """
        self.robot = robot
        self.arm = arm
        self.layouts = HandFirstLayouts(robot, candidates)

    def graph(self) -> StepGraph:
        """The whole iteration."""
        layouts = self.layouts
        state = ca.MX.sym("state", layouts.state.size)
        parameters = ca.MX.sym("parameters", layouts.parameters.size)
        stages = {
            Phase.CANDIDATE: self._candidate(),
            Phase.HAND_FIT: self._hand_fit(),
            Phase.ARM_PLACEMENT: self._placement(),
            Phase.REFINEMENT: self._refinement(),
        }
        cases = [stages[phase] for phase in STAGES]
        choose = ca.Function.conditional("stage", cases[:-1], cases[-1])
        phase = state[layouts.state.slice("phase")]
        outputs = choose(phase - float(STAGES[0]), state, parameters)
        name = f"hand_first_{self.robot.name}"
        function = ca.Function(name, [state, parameters], list(outputs))
        return StepGraph(name, function, layouts.state, layouts.parameters, layouts.record)

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
            ca.SX.zeros(len(layouts.hand), 1),
        )
        exhausted = s["candidate"] >= count
        q = self._with_hand(p["start"], hand)
        rotation, origin = best_palm(hand_contacts(self.robot, hand, layouts.hand), p)
        after = layouts.state.pack(
            self._counted(s, Phase.CANDIDATE)
            | {
                "q": ca.if_else(exhausted, s["best_q"], q),
                "palm_rotation": rotation,
                "palm_origin": origin,
                "phase": float(self._after_candidate),
                "damping": DAMPING_START,
                "cost": 0.0,
                "waited": 0.0,
                "spent": 0.0,
                "margin": -1e9,
            }
        )
        status = ca.if_else(exhausted, float(Status.STALLED), float(Status.RUNNING))
        record = self._row(s, p, q, Phase.CANDIDATE, status)
        return ca.Function("candidate", [state, parameters], shared(after, record, status))

    @property
    def _after_candidate(self) -> Phase:
        """A hand on a fixed base has no palm pose to fit."""
        return Phase.HAND_FIT if self.robot.arm_actuators else Phase.REFINEMENT

    def _hand_fit(self) -> ca.Function:
        state, parameters, s, p = self._inputs()
        columns = list(self.layouts.hand)
        x = PalmAndHand(s["palm_rotation"], s["palm_origin"], s["q"][columns])
        reached, before, there = fit_step(self.layouts, x, s["damping"], p, s["q"])
        judged = self._judge(s, p, before, there, reached.hand - x.hand)
        keep = judged.accepted
        # The last candidate goes on to the arm even if it does not fit: its arm and hand are the
        # nearest there is, and refinement starts from them.
        last = s["candidate"] + 1 >= self.layouts.candidates
        onwards = ca.logic_or(judged.within, last)
        following = Phase.ARM_PLACEMENT if self.arm else Phase.REFINEMENT
        after = self.layouts.state.pack(
            self._counted(s, Phase.HAND_FIT)
            | {
                "q": self._with_hand(s["q"], ca.if_else(keep, reached.hand, x.hand)),
                "palm_rotation": ca.if_else(keep, reached.rotation, x.rotation),
                "palm_origin": ca.if_else(keep, reached.origin, x.origin),
                "phase": ca.if_else(
                    judged.settled,
                    ca.if_else(onwards, float(following), float(Phase.CANDIDATE)),
                    float(Phase.HAND_FIT),
                ),
                "candidate": s["candidate"]
                + ca.if_else(ca.logic_and(judged.settled, ca.logic_not(onwards)), 1.0, 0.0),
                "damping": ca.if_else(judged.settled, DAMPING_START, judged.damping),
                "cost": judged.cost,
                "fits": judged.within,
                "waited": ca.if_else(judged.settled, 0.0, judged.waited),
                "spent": ca.if_else(judged.settled, 0.0, judged.spent),
            }
        )
        status = ca.SX(float(Status.RUNNING))
        record = self._row(s, p, s["q"], Phase.HAND_FIT, status, before, judged)
        return ca.Function("hand_fit", [state, parameters], shared(after, record, status))

    def _placement(self) -> ca.Function:
        state = ca.MX.sym("state", self.layouts.state.size)
        parameters = ca.MX.sym("parameters", self.layouts.parameters.size)
        place, decide = self._swivels(), self._place()
        outputs = decide(state, parameters, *place(state, parameters))
        return ca.Function("placement", [state, parameters], list(outputs))

    def _swivels(self) -> ca.Function:
        """The arm's part of an iteration, one of two graphs by the number of the trial."""
        state = ca.MX.sym("state", self.layouts.state.size)
        parameters = ca.MX.sym("parameters", self.layouts.parameters.size)
        if self.arm is None:
            n = len(self.robot.arm_actuators)
            return ca.Function("swivels", [state, parameters], [ca.MX.zeros(n, 1), ca.MX(0.0)])
        s, p = self.layouts.state.unpack(state), self.layouts.parameters.unpack(parameters)
        arm = list(self.robot.arm_actuators)
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        found = place_arm(self.arm, palm, p["lower"][arm], p["upper"][arm], s["spent"])
        return ca.Function("swivels", [state, parameters], list(found))

    def _place(self) -> ca.Function:
        """Keep the best arm so far; take it if it is within limits."""
        state, parameters, s, p = self._inputs()
        n = len(self.robot.arm_actuators)
        arm, margin = ca.SX.sym("arm", n), ca.SX.sym("margin")
        better = margin > s["margin"]
        best, best_margin = ca.if_else(better, arm, s["arm"]), ca.fmax(margin, s["margin"])
        allowed = best_margin >= ALLOWED
        spent = s["spent"] + 1
        over = spent >= ITERATIONS
        q = self._with_arm(s["q"], best)
        q = ca.fmin(ca.fmax(q, p["lower"]), p["upper"])
        # The last candidate is placed even if its hand does not fit.
        solved = ca.logic_and(allowed, s["fits"] > 0)
        leave = ca.logic_or(allowed, over)
        after = self.layouts.state.pack(
            self._counted(s, Phase.ARM_PLACEMENT)
            | {
                "q": ca.if_else(leave, q, s["q"]),
                "phase": ca.if_else(leave, float(Phase.REFINEMENT), float(Phase.ARM_PLACEMENT)),
                "spent": ca.if_else(leave, 0.0, spent),
                "margin": best_margin,
                "arm": best,
            }
        )
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        record = self._row(s, p, q, Phase.ARM_PLACEMENT, status, margin=best_margin)
        return ca.Function("place", [state, parameters, arm, margin], shared(after, record, status))

    def _refinement(self) -> ca.Function:
        state, parameters, s, p = self._inputs()
        reached, before, there = whole_step(self.robot, s["q"], s["damping"], p)
        judged = self._judge(s, p, before, there, reached - s["q"])
        q = ca.if_else(judged.accepted, reached, s["q"])
        solved = ca.logic_and(judged.settled, judged.within)
        failed = ca.logic_and(judged.settled, ca.logic_not(judged.within))
        better = judged.cost < s["best_cost"]
        after = self.layouts.state.pack(
            self._counted(s, Phase.REFINEMENT)
            | {
                "q": q,
                "phase": ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.REFINEMENT)),
                "candidate": s["candidate"] + ca.if_else(failed, 1.0, 0.0),
                "damping": judged.damping,
                "cost": judged.cost,
                "waited": judged.waited,
                "spent": judged.spent,
                "best_cost": ca.if_else(better, judged.cost, s["best_cost"]),
                "best_q": ca.if_else(better, q, s["best_q"]),
            }
        )
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        record = self._row(s, p, s["q"], Phase.REFINEMENT, status, before, judged)
        return ca.Function("refinement", [state, parameters], shared(after, record, status))

    def _judge(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        before: Expr,
        there: Expr,
        step: Expr,
    ) -> Judged:
        """Accept a step that lowers the cost, and decide whether the stage is at its end."""
        f = len(self.robot.fingers)
        cost_before, cost_there = ca.sumsqr(before), ca.sumsqr(there)
        accepted = cost_there < cost_before
        cost = ca.if_else(accepted, cost_there, cost_before)
        positions, chords = errors(ca.if_else(accepted, there, before), f)
        within = within_tolerance(positions, chords, p)
        ratio = cost / ca.fmax(cost_before, 1e-300)
        waited = ca.if_else(ratio > SLOW, s["waited"] + 1, 0.0)
        spent = s["spent"] + 1
        exact = cost < EXACT * EXACT
        worth = ca.if_else(cost < PROMISING, float(PERSISTENCE), 1.0)
        over = ca.logic_or(waited >= PATIENCE * worth, spent >= BUDGET * worth)
        slowing = ca.logic_and(within, ratio > QUADRATIC)
        damping = s["damping"] * ca.if_else(accepted, DAMPING_DOWN, DAMPING_UP)
        return Judged(
            accepted=accepted,
            cost=cost,
            damping=ca.fmax(damping, DAMPING_FLOOR),
            waited=waited,
            spent=spent,
            within=within,
            settled=ca.logic_or(exact, ca.logic_or(over, slowing)),
            before=before,
            step_size=ca.mmax(ca.fabs(step)),
        )

    def _counted(self, s: dict[str, Expr], stage: Phase) -> dict[str, Expr]:
        """The state with one more iteration spent in a stage."""
        one = ca.DM([float(stage == other) for other in STAGES])
        return s | {"counts": s["counts"] + one}

    def _with_hand(self, q: Expr, hand: Expr) -> Expr:
        rows = list(self.layouts.hand)
        return ca.vertcat(*(hand[rows.index(i)] if i in rows else q[i] for i in range(q.numel())))

    def _with_arm(self, q: Expr, arm: Expr) -> Expr:
        rows = list(self.robot.arm_actuators)
        return ca.vertcat(*(arm[rows.index(i)] if i in rows else q[i] for i in range(q.numel())))

    def _row(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        q: Expr,
        phase: Phase,
        status: Expr,
        residual: Expr | None = None,
        judged: Judged | None = None,
        margin: Expr = NOTHING,
    ) -> Expr:
        f = len(self.robot.fingers)
        positions: Expr = [NOTHING] * f
        angles: Expr = [NOTHING] * f
        if residual is not None:
            positions, chords = errors(residual, f)
            angles = 2 * ca.asin(ca.fmin(chords / 2, 1.0))
        at_limit = ca.logic_or(q <= p["lower"], q >= p["upper"])
        bits = ca.DM([2.0**i for i in range(q.numel())])
        return self.layouts.record.pack(
            {
                "q": q,
                "cost": ca.sumsqr(residual) if residual is not None else NOTHING,
                "position_error": positions,
                "angle_error": angles,
                "damping": s["damping"],
                "step_size": judged.step_size if judged else NOTHING,
                "margin": margin,
                "limit_mask": ca.dot(at_limit, bits),
                "candidate": s["candidate"],
                "accepted": judged.accepted if judged else 0.0,
                "phase": float(phase),
                "status": status,
            }
        )
