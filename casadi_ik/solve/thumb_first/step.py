"""Step graph of the thumb-first method: arm start, then motion along the closed chain.

The method follows Qiu & Kermani 2021 with two changes: the constraints are the contacts of all
fingers instead of a palm pose averaged over the fingers, and the closed chain is the null space of
the five rows of the thumb instead of a choice of active joints whose complement may be singular. An
iteration is one of:

candidate  select the next hand posture, the palm pose that best fits it to the contacts, and an arm
           configuration for that palm (closed form, or the nearest of a table);
placement  only for arms without a closed form: a damped step towards that palm pose;
alignment  a Gauss-Newton step of the other fingers along the closed chain within limits; accepted
           if it decreases the cost of all contacts, else repeated with more damping;
balance    a minimax step of all motors, for near misses.

If solutions near q0 are preferred, the first start is q0 and the second is the hand of q0 with the
arm configuration nearest to that of q0.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ArmTrials, Farthest, Nearest
from casadi_ik.kinematics.contact_fit import (
    FIT,
    ContactLeastSquares,
    evaluate_step,
    initial_lm_state,
)
from casadi_ik.kinematics.contacts import kinds_suffix, within_tolerance
from casadi_ik.kinematics.forward import Pose, motor_scales
from casadi_ik.kinematics.minimax import MINIMAX, is_new_cost, minimax_step, minimax_trial
from casadi_ik.kinematics.palm import (
    base_rotation,
    best_palm,
    hand_contacts,
    nearest_start,
    pose_step,
)
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.solve.looped_method import pack_bits
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.thumb_first.closed_chain_step import (
    STEP_SOLVERS,
    ContactErrors,
    LinearisedContacts,
    StepLimits,
    evaluate_contacts,
    linearise_contacts,
)
from casadi_ik.solve.thumb_first.state import THUMB_FIRST_STAGES, ThumbFirstLayouts


@dataclass(frozen=True, eq=False)
class ThumbFirstStep(ThumbFirstLayouts):
    """Step graph for one robot.

    Without an arm the palm is fixed and the step moves the fingers only.

    Attributes:
        arm: Family of the arm; None if its start is computed iteratively.
    """

    arm: ArmFamily | None

    def graph(self) -> StepGraph:
        """Return the graph of an iteration; it is compilable unless the step uses ProxQP."""
        return StepGraph(
            self._name,
            self._iteration,
            self.state,
            self.parameters,
            self.record,
            self.options.step != "proxqp",
            stage="phase",
            recipe=recipe(self._name, self.robot, self.options, self.kinds),
        )

    @property
    def _name(self) -> str:
        return ca.Function.fix_name(f"thumb_first_{self.robot.name}{kinds_suffix(self.kinds)}")

    def _iteration(self) -> ca.Function:
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        stages = {Phase.CANDIDATE: self._candidate(), Phase.HAND_ALIGNMENT: self._alignment()}
        # Arms with a closed form skip the placement phase.
        is_iterative = self.arm is None and self.robot.arm_actuators
        stages[Phase.ARM_PLACEMENT] = self._placement() if is_iterative else stages[Phase.CANDIDATE]
        stages[Phase.BALANCE] = minimax_stage(self)
        cases = [stages[phase] for phase in THUMB_FIRST_STAGES]
        stage = sum(
            (
                i * (state[self.state.slice("phase")] == float(phase))
                for i, phase in enumerate(THUMB_FIRST_STAGES)
            ),
            ca.MX(0),
        )
        selected_stage = ca.Function.conditional("stage", cases[:-1], cases[-1])
        outputs = selected_stage(stage, state, parameters)
        return ca.Function(self._name, [state, parameters], list(outputs))

    def _vectors(self, kind: type[ca.SX] | type[ca.MX]) -> tuple[Expr, Expr, dict, dict]:
        state = kind.sym("state", self.state.size)
        parameters = kind.sym("parameters", self.parameters.size)
        return state, parameters, self.state.unpack(state), self.parameters.unpack(parameters)

    def _candidate(self) -> ca.Function:
        """Return the graph of the next start: hand, palm and arm."""
        state, parameters, s, p = self._vectors(ca.MX)
        hand, rotation, origin = self._palm_estimate()(state, parameters)
        columns = list(self.robot.arm_actuators)
        arm, table_distance = s["q"][columns], s["last_start_distance"]
        if self.arm is not None:
            bounds = (p[name][columns] for name in ("start_q", "lower", "upper"))
            arm = self._arm_start(self.arm)(p["prefers_q0"], rotation, origin, *bounds)
        elif columns:
            # Every start uses the next-nearest arm configuration of the table.
            arm, table_distance = nearest_start(self.robot)(rotation, origin, table_distance)
        outputs = self._begin_start()(
            state, parameters, hand, rotation, origin, arm, table_distance
        )
        return ca.Function("candidate", [state, parameters], list(outputs))

    def _arm_start(self, family: ArmFamily) -> ca.Function:
        """Return the graph of the arm farthest from its limits, or nearest to q0.

        The first trials suffice, because the following steps move the arm.

        Returns:
            ``(prefers_q0, rotation, origin, start, lower, upper) -> arm``: 1 for the arm nearest
            to q0, palm pose, arm of q0 (a, 1), bounds (a, 1), arm configuration (a, 1).
        """
        # The annotations of `Pose` do not express that it holds SX or MX.
        rotation: Expr = ca.MX.sym("rotation", 3, 3)
        origin: Expr = ca.MX.sym("origin", 3)
        columns, first_trial = list(self.robot.arm_actuators), ca.MX(0)
        current, lower, upper = (
            ca.MX.sym(name, len(columns)) for name in ("start", "lower", "upper")
        )
        palm, bounds = Pose(rotation, origin), (lower, upper)
        ranges = (self.robot.upper - self.robot.lower)[columns]
        inputs, cases = [rotation, origin, current, lower, upper], []
        for score in (Nearest.by_ranges(ranges), Farthest()):
            search = ArmTrials(family, score)
            arm, value, swivel = search.trial(
                palm, bounds, first_trial, (current, first_trial), first_trial, current
            )
            if search.is_nearest and search.first_local_trial is not None:
                second_trial = ca.MX(search.first_local_trial)
                second_arm, second_value, _ = search.trial(
                    palm, bounds, second_trial, (arm, swivel), first_trial, current
                )
                arm = ca.if_else(second_value > value, second_arm, arm)
            cases.append(ca.Function("nearest_or_farthest", inputs, [arm]))
        return ca.Function.if_else("arm_start", *cases)

    def _palm_estimate(self) -> ca.Function:
        """Return the graph of the hand posture of this start and its best palm pose."""
        state, parameters, s, p = self._vectors(ca.SX)
        hand = sum(
            (
                ca.if_else(s["start"] == i, p["postures"][i, :].T, 0.0)
                for i in range(self.options.starts)
            ),
            ca.SX.zeros(len(self.robot.hand_actuators), 1),
        )
        contacts = hand_contacts(self.robot, hand, self.robot.hand_actuators)
        rotation, origin = best_palm(contacts, self.contacts, p, base=base_rotation(self.robot))
        return ca.Function("palm_estimate", [state, parameters], with_cse(hand, rotation, origin))

    def _begin_start(self) -> ca.Function:
        state, parameters, s, p = self._vectors(ca.SX)
        hand, arm = (
            ca.SX.sym("hand", len(self.robot.hand_actuators)),
            ca.SX.sym("arm", len(self.robot.arm_actuators)),
        )
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        table_distance = ca.SX.sym("last_start_distance")
        is_iterative = self.arm is None and self.robot.arm_actuators
        columns = list(self.robot.arm_actuators)
        # An iteratively placed arm starts at q0 for the first two hand postures.
        keeps_arm = ca.logic_and(p["prefers_q0"], s["start"] <= 1) if is_iterative else ca.SX(0)
        start_q = ca.SX.zeros(s["q"].numel(), 1)
        start_q[list(self.robot.hand_actuators)] = hand
        start_q[columns] = ca.if_else(keeps_arm, p["start_q"][columns], arm)
        start_q = ca.fmin(ca.fmax(start_q, p["lower"]), p["upper"])
        is_exhausted = s["start"] >= p["n_postures"]
        q = ca.if_else(is_exhausted, s["best_q"], start_q)
        next_state = self.next_state(
            s,
            Phase.CANDIDATE,
            initial_lm_state(),
            q=q,
            palm_rotation=rotation,
            palm_origin=origin,
            last_start_distance=ca.if_else(keeps_arm, s["last_start_distance"], table_distance),
            phase=float(Phase.ARM_PLACEMENT if is_iterative else Phase.HAND_ALIGNMENT),
            damping=FIT.damping if is_iterative else p["first_damping"],
        )
        status = ca.if_else(is_exhausted, float(Status.STALLED), float(Status.RUNNING))
        record = self.record_row(
            s, p, q, Phase.CANDIDATE, status, evaluate_contacts(self.robot, self.contacts, q, p)
        )
        inputs = [state, parameters, hand, rotation, origin, arm, table_distance]
        return ca.Function("begin_start", inputs, with_cse(next_state, record, status))

    def _placement(self) -> ca.Function:
        """Return the graph of a step of the arm towards the estimated palm pose."""
        state, parameters, s, p = self._vectors(ca.SX)
        columns = list(self.robot.arm_actuators)
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        trial = pose_step(self.robot, s["q"][columns], palm, s["damping"], p)
        outcome = evaluate_step(s, trial, within=ca.SX(0), exact=ca.SX(0))
        q = ca.SX(s["q"])
        q[columns] = ca.if_else(outcome.accepted, trial.x, s["q"][columns])
        next_state = self.next_state(
            s,
            Phase.ARM_PLACEMENT,
            outcome.lm_state,
            q=q,
            phase=ca.if_else(
                outcome.settled, float(Phase.HAND_ALIGNMENT), float(Phase.ARM_PLACEMENT)
            ),
            damping=ca.if_else(outcome.settled, p["first_damping"], outcome.lm_state["damping"]),
        )
        status = ca.SX(float(Status.RUNNING))
        record = self.record_row(
            s,
            p,
            q,
            Phase.ARM_PLACEMENT,
            status,
            evaluate_contacts(self.robot, self.contacts, q, p),
            damping=s["damping"],
            step_size=trial.max_change,
            accepted=outcome.accepted,
        )
        return ca.Function("placement", [state, parameters], with_cse(next_state, record, status))

    def _alignment(self) -> ca.Function:
        state, parameters, _, _ = self._vectors(ca.MX)
        *problem, lower, upper, damping = self._problem()(state, parameters)
        solve = STEP_SOLVERS[self.options.step]
        step, is_fixed = solve(LinearisedContacts(*problem), StepLimits(lower, upper, damping))
        outputs = self._accept_step()(state, parameters, step, is_fixed)
        return ca.Function("alignment", [state, parameters], list(outputs))

    def _problem(self) -> ca.Function:
        """Return the graph of the Gauss-Newton problem at q, in units of `motor_scales`."""
        state, parameters, s, p = self._vectors(ca.SX)
        linearised = linearise_contacts(self.robot, self.contacts, s["q"], p)
        scales = motor_scales(self.robot)
        lower, upper = (p["lower"] - s["q"]) / scales, (p["upper"] - s["q"]) / scales
        outputs = [
            linearised.thumb,
            linearised.thumb_error,
            linearised.other_fingers,
            linearised.other_fingers_error,
        ]
        outputs += [lower, upper, s["damping"]]
        return ca.Function("problem", [state, parameters], with_cse(*outputs))

    def _accept_step(self) -> ca.Function:
        """Return the graph that accepts or rejects a step and selects the next phase."""
        state, parameters, s, p = self._vectors(ca.SX)
        n = s["q"].numel()
        step, is_fixed = ca.SX.sym("step", n), ca.SX.sym("is_fixed", n)
        largest = ca.mmax(ca.fabs(step))
        capped_step = (
            motor_scales(self.robot) * step * ca.fmin(1.0, p["step_cap"] / ca.fmax(largest, 1e-12))
        )
        trial_q = ca.fmin(ca.fmax(s["q"] + capped_step, p["lower"]), p["upper"])
        errors_before, errors_after = (
            evaluate_contacts(self.robot, self.contacts, q, p) for q in (s["q"], trial_q)
        )
        # Keep a configuration that meets the contacts; skip the start at q0 if q0 is too far.
        is_met, is_skipped = (
            self._is_within(errors_before, p),
            self._is_skipped(errors_before, s, p),
        )
        keeps_q = ca.logic_or(is_met, is_skipped)
        accepted = ca.logic_and(errors_after.cost < errors_before.cost, ca.logic_not(keeps_q))
        q = ca.if_else(accepted, trial_q, s["q"])
        errors = ContactErrors(
            ca.if_else(accepted, errors_after.positions, errors_before.positions),
            ca.if_else(accepted, errors_after.angles, errors_before.angles),
            ca.if_else(accepted, errors_after.cost, errors_before.cost),
        )
        cost = errors.cost
        solved = self._is_within(errors, p)
        slow_steps = ca.if_else(
            cost > self.options.gain * errors_before.cost, s["slow_steps"] + 1, 0.0
        )
        is_stuck = ca.logic_and(ca.logic_not(accepted), s["damping"] > self.options.damping_ceiling)
        is_finished = ca.logic_or(
            slow_steps >= self.options.patience, s["stage_iterations"] + 1 >= self.options.budget
        )
        is_finished = ca.logic_or(ca.logic_or(is_finished, is_stuck), is_skipped)
        starts_minimax = ca.logic_and(
            self._is_within(errors, p, MINIMAX.max_tolerance_ratio),
            is_new_cost(cost, s["last_minimax_cost"]),
        )
        starts_minimax = ca.logic_and(
            ca.logic_and(starts_minimax, is_finished), ca.logic_not(solved)
        )
        has_failed = ca.logic_and(is_finished, ca.logic_not(ca.logic_or(solved, starts_minimax)))
        next_phase = ca.if_else(is_finished, float(Phase.CANDIDATE), float(Phase.HAND_ALIGNMENT))
        factor = ca.if_else(accepted, self.options.damping_decrease, self.options.damping_increase)
        damping = ca.fmax(s["damping"] * factor, self.options.damping_floor)
        is_best = cost < s["best_cost"]
        next_state = self.next_state(
            s,
            Phase.HAND_ALIGNMENT,
            {},
            q=q,
            phase=ca.if_else(starts_minimax, float(Phase.BALANCE), next_phase),
            start=s["start"] + has_failed,
            damping=ca.if_else(starts_minimax, FIT.damping, damping),
            slow_steps=slow_steps,
            stage_iterations=ca.if_else(starts_minimax, 0.0, s["stage_iterations"] + 1),
            power=0.0,
            last_minimax_cost=ca.if_else(starts_minimax, cost, s["last_minimax_cost"]),
            best_cost=ca.if_else(is_best, cost, s["best_cost"]),
            best_q=ca.if_else(is_best, q, s["best_q"]),
        )
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        record = self.record_row(
            s,
            p,
            q,
            Phase.HAND_ALIGNMENT,
            status,
            errors,
            damping=s["damping"],
            step_size=ca.mmax(ca.fabs(trial_q - s["q"])),
            active_mask=pack_bits(is_fixed),
            accepted=accepted,
        )
        inputs = [state, parameters, step, is_fixed]
        return ca.Function("accept_step", inputs, with_cse(next_state, record, status))

    def _is_within(self, errors: ContactErrors, p: dict[str, Expr], factor: float = 1.0) -> Expr:
        """Return 1 if every contact is within `factor` times its tolerance."""
        tolerances = p["position_tolerance"], p["angle_tolerance"]
        return within_tolerance(errors.positions / factor, errors.angles / factor, *tolerances)

    def _is_skipped(self, errors: ContactErrors, s: dict[str, Expr], p: dict[str, Expr]) -> Expr:
        """Return 1 if q0 or its hand posture is too far from the target for a start."""
        if not self.robot.arm_actuators:
            return ca.SX(0)
        is_first = ca.logic_and(s["stage_iterations"] < 1, s["start"] <= 0)
        return ca.logic_and(
            ca.logic_and(p["prefers_q0"], is_first), errors.cost > self.options.max_cost_of_q0
        )


def minimax_stage(layouts: ThumbFirstLayouts) -> ca.Function:
    """Return the graph of a minimax step of all motors, followed by the next start if it fails."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    problem = ContactLeastSquares(layouts.robot, layouts.contacts, layouts.parameters)
    trial = minimax_trial(problem, s["q"], s["damping"], s["power"], parameters)
    outcome = minimax_step(s["q"], trial, layouts.contacts, s, p)
    has_failed = ca.logic_and(outcome.is_finished, ca.logic_not(outcome.within))
    next_state = layouts.next_state(
        s,
        Phase.BALANCE,
        outcome.state,
        q=outcome.q,
        phase=ca.if_else(has_failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
        start=s["start"] + has_failed,
    )
    status = ca.if_else(outcome.within, float(Status.SOLVED), float(Status.RUNNING))
    errors = evaluate_contacts(layouts.robot, layouts.contacts, outcome.q, p)
    record = layouts.record_row(
        s,
        p,
        outcome.q,
        Phase.BALANCE,
        status,
        errors,
        damping=s["damping"],
        step_size=trial.max_change,
        accepted=outcome.accepted,
    )
    return ca.Function("balance", [state, parameters], with_cse(next_state, record, status))
