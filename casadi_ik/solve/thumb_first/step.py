"""The thumb-first method as one step graph: arm start, then along the closed chain.

The idea of Qiu & Kermani 2021 without its two flaws. Not the palm's pose is demanded, averaged
over the fingers, but every finger's own contact; and the closed chain is the null space of the
thumb's five rows, not a choice of active joints whose complement may be singular. One iteration:

candidate  take the next hand posture, the palm pose that brings it closest to the contacts and
           the arm for that palm (in closed form, or the nearest of a table);
placement  arms without a closed form only: a damped step towards that palm pose;
alignment  one Gauss-Newton step of the other fingers along the closed chain, limits kept; taken
           if it lowers the summed squares of all contacts, else tried again with more damping;
balance    one step of all motors towards the smallest largest error, where the contacts are
           missed by little.

If a solution near to where the robot is is wanted, the first start is the robot as it is, the
second its hand with the arm nearest to its own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import casadi as ca

from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ArmTrials, Farthest, Nearest
from casadi_ik.kinematics.contact_fit import (
    FIT,
    MINIMAX,
    ContactLeastSquares,
    evaluate_step,
    initial_lm_state,
    is_new_cost,
    minimax_step,
)
from casadi_ik.kinematics.contacts import ContactRows, Kinds, kinds_suffix, within_tolerance
from casadi_ik.kinematics.forward import Pose, motor_scales
from casadi_ik.kinematics.palm import (
    base_rotation,
    best_palm,
    hand_contacts,
    nearest_start,
    pose_step,
)
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.limits import pack_bits
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.thumb_first.closed_chain_step import (
    STEP_SOLVERS,
    Linear,
    Merit,
    Room,
    linearised,
    merit,
)
from casadi_ik.solve.trace import (
    ACCEPTED,
    ACTIVE_MASK,
    ANGLE_ERROR,
    COST,
    DAMPING,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    STATUS,
    STEP_SIZE,
    Q,
)

STEPS = ("freeze", "proxqp")
"""How a step keeps to the limits."""


@dataclass(frozen=True)
class ThumbFirstParameters:
    """Parameters of the method.

    Attributes:
        starts: Palm estimates a solve may begin from, each from another hand posture.
        table: Hand postures that the target's shape is compared with to find them.
        pull: How much a posture's distance from the start's hand counts along with the shape.
        step: "freeze": the joint that violates its limits most is fixed there and the step is
            solved again. "proxqp": the same problem as a quadratic program (ProxQP, Bambade et
            al. 2022), in CasADi's virtual machine; slower.
        damping: Damping [-] of the first step of a start; residuals are in 0.1 m and rad.
        step_cap: Longest change of any motor in one iteration [rad, or part of a slider's range].
        eased: Factor of the damping after a step that lowered the cost.
        tightened: The same after one that did not.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a step leads nowhere.
        gain: A step that leaves more than this part of the cost gained little.
        patience: Iterations in a row with little gain after which a start is given up.
        budget: Iterations after which it is in any case.
        as_it_is: Summed squares up to which the robot as it is, or its hand, is worth a start.
    """

    starts: int = 32
    table: int = 8192
    pull: float = 6.0
    step: str = "freeze"
    damping: float = 0.03
    step_cap: float = 0.3
    eased: float = 1 / 3
    tightened: float = 4.0
    damping_floor: float = 1e-6
    damping_ceiling: float = 100.0
    gain: float = 0.9
    patience: int = 12
    budget: int = 100
    as_it_is: float = 0.5

    def __post_init__(self) -> None:
        if self.step not in STEPS:
            known = ", ".join(STEPS)
            raise InputError(f"step: found {self.step!r}, expected one of {known}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type == "int" and not (type(value) is int and value >= 1):
                raise InputError(f"{entry.name}: found {value!r}, expected a whole number >= 1")
            if entry.type == "float" and not (type(value) in (int, float) and value > 0):
                raise InputError(f"{entry.name}: found {value!r}, expected a number > 0")
        if self.starts > self.table:
            raise InputError(f"table: found {self.table}, expected at least starts = {self.starts}")


STAGES = (Phase.HAND_ALIGNMENT, Phase.CANDIDATE, Phase.ARM_PLACEMENT, Phase.BALANCE)
"""What an iteration may be, the most frequent first."""

NOTHING = float("nan")


@dataclass(frozen=True, eq=False)
class ThumbFirstLayouts:
    """The three layouts for one robot.

    Attributes:
        robot: The description.
        options: Numbers and choices.
        kinds: Of the contacts, by finger.
    """

    robot: RobotDescription
    options: ThumbFirstParameters
    kinds: Kinds

    @cached_property
    def contacts(self) -> ContactRows:
        """The contacts' rows."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """What an iteration hands to the next."""
        n = len(self.robot.actuators)
        return Layout(
            (
                Field("q", (n,)),
                Field("palm_rotation", (3, 3), doc="estimated palm pose of this start"),
                Field("palm_origin", (3,), unit="m"),
                Field("passed", doc="how far the last arm of the table was from the palm wanted"),
                Field("phase"),
                Field("start", doc="number of the palm estimate begun from; -1: as the robot is"),
                Field("damping"),
                Field("growth", doc="placement: factor of the damping if the next step is vain"),
                Field("cost", doc="placement: squared distance from the palm pose"),
                Field("waited", doc="iterations in a row that gained little"),
                Field("spent", doc="iterations in this phase"),
                Field("power", doc="powers done while the contacts are balanced"),
                Field("balanced", doc="cost at which contacts were last balanced, 0: never"),
                Field("best_cost", doc="smallest summed squares of the contacts so far"),
                Field("best_q", (n,), doc="the configuration it belongs to"),
                Field("counts", (len(STAGES),), doc="iterations by stage, in the order of STAGES"),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """The problem and the numbers of the method."""
        n, f = len(self.robot.actuators), len(self.robot.fingers)
        hand = len(self.robot.hand_actuators)
        return Layout(
            (
                *self.contacts.fields,
                Field("position_tolerance", (f,), unit="m"),
                Field("angle_tolerance", (f,), unit="rad"),
                Field("lower", (n,), doc="lower bounds of q"),
                Field("upper", (n,), doc="upper bounds of q"),
                Field("postures", (self.options.starts, hand), doc="hands to begin with"),
                Field("given", doc="how many of them are there"),
                Field("here", (n,), doc="where the robot is, within bounds"),
                Field("nearest", doc="1 if a solution near to that is wanted"),
                Field("first_damping"),
                Field("step_cap"),
            )
        )

    @cached_property
    def record(self) -> Layout:
        """What is logged of an iteration: where it led, and the step that led there."""
        robot = self.robot
        return Layout.record(
            Q.of(robot, "actuator positions after the iteration"),
            COST.of(robot, "summed squares of all contacts there (0.1 m, rad)"),
            POSITION_ERROR.of(robot),
            ANGLE_ERROR.of(robot),
            DAMPING.of(robot, "damping of the step tried"),
            STEP_SIZE.of(robot, "largest motor change of the step tried"),
            ACTIVE_MASK.of(robot),
            LIMIT_MASK.of(robot),
            RESTART.of(robot, "number of the palm estimate begun from, counted from 0"),
            ACCEPTED.of(robot),
            PHASE.of(robot),
            STATUS.of(robot),
        )

    def after(
        self, s: dict[str, Expr], stage: Phase, fit: dict[str, Expr], **changed: Expr
    ) -> Expr:
        """The state (size, 1) with one more iteration spent in a stage, and with what it changed.

        Args:
            s: State before it.
            stage: What it was.
            fit: Counters and damping.
            changed: Other fields, and those of `fit` that are otherwise.
        """
        one = ca.DM([float(stage == other) for other in STAGES])
        return self.state.pack(s | {"counts": s["counts"] + one} | fit | changed)

    def row(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        q: Expr,
        phase: Phase,
        status: Expr,
        there: Merit,
        **measured: Expr,
    ) -> Expr:
        """What is logged of an iteration.

        Args:
            s: State before it.
            p: Parameters.
            q: (n, 1) where it led.
            phase: What it was.
            status: Whether the solve goes on.
            there: The contacts at q.
            measured: The other fields; those that the phase does not have are left out.
        """
        values: dict[str, Expr] = {
            "q": q,
            "cost": there.cost,
            "position_error": ca.if_else(p["weights"][:, 0] > 0, there.positions, NOTHING),
            "angle_error": ca.if_else(p["weights"][:, 1] > 0, there.angles, NOTHING),
            "damping": NOTHING,
            "step_size": NOTHING,
            "active_mask": ca.DM.zeros(LIMIT_MASK.of(self.robot).size, 1),
            "limit_mask": pack_bits(ca.logic_or(q <= p["lower"], q >= p["upper"])),
            "restart": ca.fmax(s["start"], 0.0),
            "accepted": 0.0,
            "phase": float(phase),
            "status": status,
        }
        return self.record.pack(values | measured)


@dataclass(frozen=True, eq=False)
class ThumbFirstStep(ThumbFirstLayouts):
    """Builds the step graph for one robot.

    Without an arm the palm is fixed: the same step then moves the fingers alone.

    Attributes:
        arm: The family of the arm, or None: then its start is found numerically.
    """

    arm: ArmFamily | None

    def graph(self) -> StepGraph:
        """The whole iteration; compilable unless the step is ProxQP's."""
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
        # Only arms without a closed form are placed step by step; nobody else gets there.
        numeric = self.arm is None and self.robot.arm_actuators
        stages[Phase.ARM_PLACEMENT] = self._placement() if numeric else stages[Phase.CANDIDATE]
        stages[Phase.BALANCE] = balance_stage(self)
        cases = [stages[phase] for phase in STAGES]
        stage = sum(
            (
                i * (state[self.state.slice("phase")] == float(phase))
                for i, phase in enumerate(STAGES)
            ),
            ca.MX(0),
        )
        choose = ca.Function.conditional("stage", cases[:-1], cases[-1])
        outputs = choose(stage, state, parameters)
        return ca.Function(self._name, [state, parameters], list(outputs))

    def _vectors(self, kind: type[ca.SX] | type[ca.MX]) -> tuple[Expr, Expr, dict, dict]:
        state = kind.sym("state", self.state.size)
        parameters = kind.sym("parameters", self.parameters.size)
        return state, parameters, self.state.unpack(state), self.parameters.unpack(parameters)

    def _candidate(self) -> ca.Function:
        """The next start: hand, palm and arm."""
        state, parameters, s, p = self._vectors(ca.MX)
        hand, rotation, origin = self._guess()(state, parameters)
        columns = list(self.robot.arm_actuators)
        arm, passed = s["q"][columns], s["passed"]
        if self.arm is not None:
            given = (p[name][columns] for name in ("here", "lower", "upper"))
            arm = self._arm_start(self.arm)(p["nearest"], rotation, origin, *given)
        elif columns:
            # Another start gets another arm as well: the next nearest of the table.
            arm, passed = nearest_start(self.robot)(rotation, origin, passed)
        outputs = self._begin()(state, parameters, hand, rotation, origin, arm, passed)
        return ca.Function("candidate", [state, parameters], list(outputs))

    def _arm_start(self, family: ArmFamily) -> ca.Function:
        """The arm farthest from its limits, or the one nearest to where the robot is.

        The steps that follow move it anyway: the first arms looked at are close enough.

        Returns:
            ``(nearest, rotation, origin, here, lower, upper) -> arm``, (n, 1) each but the palm's
            pose and whether it is to be the nearest.
        """
        # A pose is of either kind of symbols, which its annotations do not say.
        rotation: Expr = ca.MX.sym("rotation", 3, 3)
        origin: Expr = ca.MX.sym("origin", 3)
        columns, first = list(self.robot.arm_actuators), ca.MX(0)
        here, lower, upper = (ca.MX.sym(name, len(columns)) for name in ("here", "lower", "upper"))
        palm, bounds = Pose(rotation, origin), (lower, upper)
        ranges = (self.robot.upper - self.robot.lower)[columns]
        inputs, cases = [rotation, origin, here, lower, upper], []
        for score in (Nearest.by_ranges(ranges), Farthest()):
            search = ArmTrials(family, score)
            arm, value, swivel = search.trial(palm, bounds, first, (here, first), first, here)
            if search.is_nearest and search.first_local_trial is not None:
                around = ca.MX(search.first_local_trial)
                other, better, _ = search.trial(palm, bounds, around, (arm, swivel), first, here)
                arm = ca.if_else(better > value, other, arm)
            cases.append(ca.Function("near_or_far", inputs, [arm]))
        return ca.Function.if_else("arm_start", *cases)

    def _guess(self) -> ca.Function:
        """Hand posture of this start and the palm pose that brings it closest to the contacts."""
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
        return ca.Function("guess", [state, parameters], with_cse(hand, rotation, origin))

    def _begin(self) -> ca.Function:
        state, parameters, s, p = self._vectors(ca.SX)
        hand, arm = (
            ca.SX.sym("hand", len(self.robot.hand_actuators)),
            ca.SX.sym("arm", len(self.robot.arm_actuators)),
        )
        rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
        passed = ca.SX.sym("passed")
        numeric = self.arm is None and self.robot.arm_actuators
        columns = list(self.robot.arm_actuators)
        # An arm that is found step by step begins as it is, for the first hand and for another.
        as_it_is = ca.logic_and(p["nearest"], s["start"] <= 1) if numeric else ca.SX(0)
        started = ca.SX.zeros(s["q"].numel(), 1)
        started[list(self.robot.hand_actuators)] = hand
        started[columns] = ca.if_else(as_it_is, p["here"][columns], arm)
        started = ca.fmin(ca.fmax(started, p["lower"]), p["upper"])
        exhausted = s["start"] >= p["given"]
        q = ca.if_else(exhausted, s["best_q"], started)
        after = self.after(
            s,
            Phase.CANDIDATE,
            initial_lm_state(),
            q=q,
            palm_rotation=rotation,
            palm_origin=origin,
            passed=ca.if_else(as_it_is, s["passed"], passed),
            phase=float(Phase.ARM_PLACEMENT if numeric else Phase.HAND_ALIGNMENT),
            damping=FIT.damping if numeric else p["first_damping"],
        )
        status = ca.if_else(exhausted, float(Status.STALLED), float(Status.RUNNING))
        record = self.row(s, p, q, Phase.CANDIDATE, status, merit(self.robot, self.contacts, q, p))
        inputs = [state, parameters, hand, rotation, origin, arm, passed]
        return ca.Function("begin", inputs, with_cse(after, record, status))

    def _placement(self) -> ca.Function:
        """A step of the arm alone towards the estimated palm pose."""
        state, parameters, s, p = self._vectors(ca.SX)
        columns = list(self.robot.arm_actuators)
        palm = Pose(s["palm_rotation"], s["palm_origin"])
        tried = pose_step(self.robot, s["q"][columns], palm, s["damping"], p)
        judged = evaluate_step(s, tried, within=ca.SX(0), exact=ca.SX(0))
        q = ca.SX(s["q"])
        q[columns] = ca.if_else(judged.accepted, tried.x, s["q"][columns])
        after = self.after(
            s,
            Phase.ARM_PLACEMENT,
            judged.lm_state,
            q=q,
            phase=ca.if_else(
                judged.settled, float(Phase.HAND_ALIGNMENT), float(Phase.ARM_PLACEMENT)
            ),
            damping=ca.if_else(judged.settled, p["first_damping"], judged.lm_state["damping"]),
        )
        status = ca.SX(float(Status.RUNNING))
        record = self.row(
            s,
            p,
            q,
            Phase.ARM_PLACEMENT,
            status,
            merit(self.robot, self.contacts, q, p),
            damping=s["damping"],
            step_size=tried.max_change,
            accepted=judged.accepted,
        )
        return ca.Function("placement", [state, parameters], with_cse(after, record, status))

    def _alignment(self) -> ca.Function:
        state, parameters, _, _ = self._vectors(ca.MX)
        *problem, lower, upper, damping = self._problem()(state, parameters)
        solve = STEP_SOLVERS[self.options.step]
        step, held = solve(Linear(*problem), Room(lower, upper, damping))
        outputs = self._take()(state, parameters, step, held)
        return ca.Function("alignment", [state, parameters], list(outputs))

    def _problem(self) -> ca.Function:
        """The Gauss-Newton problem at q, in units of `motor_scales`."""
        state, parameters, s, p = self._vectors(ca.SX)
        linear = linearised(self.robot, self.contacts, s["q"], p)
        scales = motor_scales(self.robot)
        lower, upper = (p["lower"] - s["q"]) / scales, (p["upper"] - s["q"]) / scales
        outputs = [linear.thumb, linear.thumb_error, linear.others, linear.others_error]
        outputs += [lower, upper, s["damping"]]
        return ca.Function("problem", [state, parameters], with_cse(*outputs))

    def _take(self) -> ca.Function:
        """Take the step if it lowers the cost; decide whether the solve is at its end."""
        state, parameters, s, p = self._vectors(ca.SX)
        n = s["q"].numel()
        step, held = ca.SX.sym("step", n), ca.SX.sym("held", n)
        size = ca.mmax(ca.fabs(step))
        capped = (
            motor_scales(self.robot) * step * ca.fmin(1.0, p["step_cap"] / ca.fmax(size, 1e-12))
        )
        tried = ca.fmin(ca.fmax(s["q"] + capped, p["lower"]), p["upper"])
        before, there = (merit(self.robot, self.contacts, q, p) for q in (s["q"], tried))
        # What meets the contacts stays; what begins too far away is not worth a start.
        met, skipped = self._met(before, p), self._skipped(before, s, p)
        stays = ca.logic_or(met, skipped)
        accepted = ca.logic_and(there.cost < before.cost, ca.logic_not(stays))
        q = ca.if_else(accepted, tried, s["q"])
        left = Merit(
            ca.if_else(accepted, there.positions, before.positions),
            ca.if_else(accepted, there.angles, before.angles),
            ca.if_else(accepted, there.cost, before.cost),
        )
        cost = left.cost
        solved = self._met(left, p)
        waited = ca.if_else(cost > self.options.gain * before.cost, s["waited"] + 1, 0.0)
        stuck = ca.logic_and(ca.logic_not(accepted), s["damping"] > self.options.damping_ceiling)
        over = ca.logic_or(waited >= self.options.patience, s["spent"] + 1 >= self.options.budget)
        over = ca.logic_or(ca.logic_or(over, stuck), skipped)
        near = ca.logic_and(
            self._met(left, p, MINIMAX.max_tolerance_ratio), is_new_cost(cost, s["balanced"])
        )
        near = ca.logic_and(ca.logic_and(near, over), ca.logic_not(solved))
        failed = ca.logic_and(over, ca.logic_not(ca.logic_or(solved, near)))
        following = ca.if_else(over, float(Phase.CANDIDATE), float(Phase.HAND_ALIGNMENT))
        factor = ca.if_else(accepted, self.options.eased, self.options.tightened)
        eased = ca.fmax(s["damping"] * factor, self.options.damping_floor)
        better = cost < s["best_cost"]
        after = self.after(
            s,
            Phase.HAND_ALIGNMENT,
            {},
            q=q,
            phase=ca.if_else(near, float(Phase.BALANCE), following),
            start=s["start"] + failed,
            damping=ca.if_else(near, FIT.damping, eased),
            waited=waited,
            spent=ca.if_else(near, 0.0, s["spent"] + 1),
            power=0.0,
            balanced=ca.if_else(near, cost, s["balanced"]),
            best_cost=ca.if_else(better, cost, s["best_cost"]),
            best_q=ca.if_else(better, q, s["best_q"]),
        )
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        record = self.row(
            s,
            p,
            q,
            Phase.HAND_ALIGNMENT,
            status,
            left,
            damping=s["damping"],
            step_size=ca.mmax(ca.fabs(tried - s["q"])),
            active_mask=pack_bits(held),
            accepted=accepted,
        )
        inputs = [state, parameters, step, held]
        return ca.Function("take", inputs, with_cse(after, record, status))

    def _met(self, there: Merit, p: dict[str, Expr], times: float = 1.0) -> Expr:
        """Whether every contact is within so many times its tolerance."""
        tolerances = p["position_tolerance"], p["angle_tolerance"]
        return within_tolerance(there.positions / times, there.angles / times, *tolerances)

    def _skipped(self, before: Merit, s: dict[str, Expr], p: dict[str, Expr]) -> Expr:
        """Whether the robot or its hand, as it is, is too far away to begin with."""
        if not self.robot.arm_actuators:
            return ca.SX(0)
        begins = ca.logic_and(s["spent"] < 1, s["start"] <= 0)
        return ca.logic_and(ca.logic_and(p["nearest"], begins), before.cost > self.options.as_it_is)


def balance_stage(layouts: ThumbFirstLayouts) -> ca.Function:
    """One step of all motors; it ends with a solution or with the next start."""
    state, parameters = layouts.state.symbols("state"), layouts.parameters.symbols("parameters")
    s, p = layouts.state.unpack(state), layouts.parameters.unpack(parameters)
    whole = ContactLeastSquares(layouts.robot, layouts.contacts, layouts.parameters)
    tried = whole.minimax_trial(s["q"], s["damping"], s["power"], parameters)
    found = minimax_step(s["q"], tried, layouts.contacts, s, p)
    failed = ca.logic_and(found.is_finished, ca.logic_not(found.within))
    after = layouts.after(
        s,
        Phase.BALANCE,
        found.state,
        q=found.q,
        phase=ca.if_else(failed, float(Phase.CANDIDATE), float(Phase.BALANCE)),
        start=s["start"] + failed,
    )
    status = ca.if_else(found.within, float(Status.SOLVED), float(Status.RUNNING))
    there = merit(layouts.robot, layouts.contacts, found.q, p)
    record = layouts.row(
        s,
        p,
        found.q,
        Phase.BALANCE,
        status,
        there,
        damping=s["damping"],
        step_size=tried.max_change,
        accepted=found.accepted,
    )
    return ca.Function("balance", [state, parameters], with_cse(after, record, status))
