"""State, parameters and record of the hand-first method, and the start of a restart.

Hand-first fits palm and hand to the contacts as if the hand were floating, lets the arm carry the
palm there, and refines all motors where the arm cannot follow exactly. `Stage` lists the steps;
`iteration.c`, `one_arm.c` and `multi_arm.c` choose the next one, `step.py` builds their graphs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import casadi as ca

from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.kinematics.box_qp import BoxBounds
from casadi_ik.kinematics.contact_fit import ContactLeastSquares, TrialStep, initial_lm_state
from casadi_ik.kinematics.contacts import ContactRows, Kinds, kinds_suffix, point_normal_kinds
from casadi_ik.kinematics.palm import POSE_DIMENSION
from casadi_ik.kinematics.smooth import Expr, call_function, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.looped_method import coupling_fields, coupling_values, pack_bits
from casadi_ik.solve.status import Phase
from casadi_ik.solve.trace import (
    ACCEPTED,
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

COUNTED_PHASES = (
    *(Phase.REFINEMENT, Phase.CANDIDATE, Phase.HAND_FIT, Phase.ARM_PLACEMENT),
    *(Phase.BALANCE, Phase.ARM_CHOICE),
)
"""Phases with a counter of iterations, in order; multi-arm robots have `Phase.TRUNK` after them."""


class Stage(IntEnum):
    """Stage of the next iteration.

    Several stages can be logged as one `Phase`; a stage that is logged as itself has the code of
    its phase. A tolerant stage continues a fit whose minimum misses the contacts, with errors
    within tolerance at no cost.

    Attributes:
        START: Evaluates q0 if it is preferred.
        REFINEMENT: Damped steps of all motors.
        CANDIDATE: Takes the next hand posture and computes its best palm pose.
        HAND_FIT: Damped steps of palm and hand.
        ARM_PLACEMENT: Arm in closed form for the palm pose.
        BALANCE: Steps of all motors that reduce the largest relative error.
        ARM_CHOICE: Arm in closed form nearest to q0, or farthest from its limits.
        TRUNK: Damped steps of trunk and arms of a multi-arm robot.
        ARM_STEPS: Damped steps of an arm without closed form.
        TOLERANT_HAND_FIT: Tolerant steps of palm and hand.
        TOLERANT_REFINEMENT: Tolerant steps of all motors.
    """

    START = 0
    REFINEMENT = Phase.REFINEMENT
    CANDIDATE = Phase.CANDIDATE
    HAND_FIT = Phase.HAND_FIT
    ARM_PLACEMENT = Phase.ARM_PLACEMENT
    BALANCE = Phase.BALANCE
    ARM_CHOICE = Phase.ARM_CHOICE
    TRUNK = Phase.TRUNK
    ARM_STEPS = max(Phase) + 1
    TOLERANT_HAND_FIT = max(Phase) + 2
    TOLERANT_REFINEMENT = max(Phase) + 3


SIDE_OFFSET = 32
"""Offset of stage codes per side of a multi-arm robot: stage + 32 * side."""


STAGE_RESULT = Layout(
    (
        Field("is_settled", doc="1 if the fit, the steps or the balance have ended"),
        Field("is_within", doc="1 if all contacts are within tolerance"),
        Field("is_idle", doc="candidate: 1 if no finger of the side has a contact"),
        Field("arm_is_allowed", doc="1 if the best arm is within limits, or near q0 if preferred"),
        Field("arm_is_exact", doc="1 if the arm of this trial meets the palm pose"),
        Field("arm_is_close", doc="1 if an arm of few motors is within tolerance of the palm"),
        Field("rms_ratio", doc="root mean square of the errors of a fit, relative to tolerances"),
        Field("cost", doc="hand fit: cost before it; arm or trunk steps: their cost"),
        Field("max_ratio", doc="balance: largest error relative to its tolerance"),
        Field("joint_to_flip", doc="arm joint, from 1, to move to its opposite limit; 0: none"),
    )
)
"""Outputs of a stage that decide the next stage."""

COUNTER_OF_STAGE = {
    **{stage: i for i, stage in enumerate(COUNTED_PHASES)},
    Stage.TRUNK: len(COUNTED_PHASES),
    Stage.START: COUNTED_PHASES.index(Phase.REFINEMENT),
    Stage.ARM_STEPS: COUNTED_PHASES.index(Phase.ARM_PLACEMENT),
    Stage.TOLERANT_HAND_FIT: COUNTED_PHASES.index(Phase.HAND_FIT),
    Stage.TOLERANT_REFINEMENT: COUNTED_PHASES.index(Phase.REFINEMENT),
}
"""Index of the counter of each stage."""

STEP_FIELDS = (
    Field("damping", doc="Levenberg-Marquardt damping of the next step"),
    Field("growth", doc="factor of the damping if the next step is rejected"),
    Field("cost", doc="cost at q, or at palm and hand in a hand fit"),
    Field("slow_steps", doc="number of consecutive steps with slow progress"),
    Field("stage_iterations", doc="iterations of this stage; arm placement: next trial"),
)
"""State of damped steps, which all stages with such steps share; see `initial_lm_state`."""

HAND_FIT_FIELDS = (
    Field(
        "hand_fit_minimum",
        doc="cost of the last minimum of a hand fit that nearly met the contacts, or 0",
    ),
    Field("hand_fit_min_excess", doc="smallest cost of a tolerant hand fit that failed"),
)
"""State of hand fit and tolerant hand fit."""

REFINEMENT_FIELDS = (
    Field(
        "refinement_minimum",
        doc="cost of the last minimum of a refinement that nearly met the contacts, or 0",
    ),
)
"""State of the refinement."""

BALANCE_FIELDS = (
    Field("power", doc="index of the current exponent of the p-norm"),
    Field(
        "balance_min_ratio",
        doc="smallest result of a balance: largest error relative to its tolerance",
    ),
)
"""State of the balance."""

ARM_STEP_FIELDS = (
    Field("arm_starts", doc="number of starts of the arm steps"),
    Field(
        "arm_flipped_joint",
        doc="last arm joint, from 1, moved to its opposite limit at this start; or 0",
    ),
    Field(
        "arm_start_distance",
        doc="distance between the palm pose and that of the last start of the arm",
    ),
)
"""State of the arm steps."""

KEPT_ACROSS_RESTARTS = (
    *("arm_start_distance", "hand_fit_minimum", "hand_fit_min_excess", "refinement_minimum"),
    *("balance_min_ratio", "repeated_minima", "best_cost", "best_q", "counts"),
)
"""State fields kept across restarts: the distance of the last start of the arm, the minima found so
far, and the incumbent."""

TRUNK_KEPT_ACROSS_RESTARTS = (
    "trunk_total_trials",
    "trunk_fitting_trials",
    "trunk_fitting_min_cost",
)
"""State fields of multi-arm robots kept across restarts: the trunk trials."""

NOT_COMPUTED = float("nan")
"""Value of a record field that a stage does not compute."""


@dataclass(frozen=True, eq=False)
class HandFirstLayouts:
    """Layouts of state, parameters and record for one robot.

    Attributes:
        robot: Description of the robot.
        candidates: Maximum number of hand postures of a restart.
        kinds: Kinds of the contacts, by finger.
    """

    robot: RobotDescription
    candidates: int
    kinds: Kinds

    @cached_property
    def arm(self) -> tuple[int, ...]:
        """Indices in q of the motors of the arm, or of all arms of a multi-arm robot."""
        robot = self.robot
        all_arms = (motor for arm, _ in robot.side_actuators for motor in arm)
        return tuple(all_arms) if robot.sides else robot.arm_actuators

    @cached_property
    def phases(self) -> tuple[Phase, ...]:
        """Phases of the solves, in the order of their counters."""
        return (*COUNTED_PHASES, Phase.TRUNK) if self.robot.sides else COUNTED_PHASES

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Names of the phases."""
        return tuple(phase.label for phase in self.phases)

    @cached_property
    def contacts(self) -> ContactRows:
        """Rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """Layout of the state that one iteration passes to the next, a group of fields by stage."""
        groups = (
            *(self._common_fields, STEP_FIELDS, HAND_FIT_FIELDS, REFINEMENT_FIELDS),
            *(BALANCE_FIELDS, self._arm_fields, ARM_STEP_FIELDS),
            *((self._side_fields, self._trunk_fields) if self.robot.sides else ()),
        )
        return Layout(tuple(field for group in groups for field in group))

    @property
    def _common_fields(self) -> tuple[Field, ...]:
        """State of all stages: configuration, palm pose, hand posture, incumbent."""
        n = len(self.robot.actuators)
        return (
            Field("q", (n,), doc="configuration [rad or m]; hand fit: the hand only"),
            Field("palm_rotation", (3, 3), doc="palm orientation of the hand, base frame"),
            Field("palm_origin", (3,), unit="m", doc="palm position of the hand, base frame"),
            Field("phase", doc="`Stage` of the next iteration, + 32 * side"),
            Field("candidate", doc="index of the hand posture; -1: the one of q0"),
            Field("candidates_before", doc="number of hand postures of earlier restarts"),
            Field("palm_number", doc="selects the first palm pose if contacts leave it free"),
            Field("meets_contacts", doc="1 if palm and hand meet the contacts"),
            Field("is_underactuated", doc="1 if hand or arm has too few free motors"),
            Field(
                "repeated_minima", doc="number of fits and balances that end no lower than before"
            ),
            Field("best_cost", doc="smallest cost of a whole configuration"),
            Field("best_q", (n,), doc="configuration of that cost [rad or m]"),
            Field("counts", (len(self.phases),), doc="iterations by phase"),
        )

    @property
    def _arm_fields(self) -> tuple[Field, ...]:
        """State of arm placement and arm choice: the best arm, or that of each side."""
        sides = (len(self.robot.sides),) if self.robot.sides else ()
        return (
            Field("arm_margin", sides, doc="margin of the best arm; negative: outside limits"),
            Field("arm_best", (len(self.arm),), doc="arm with the best margin [rad or m]"),
            Field("arm_redundancy", sides, unit="rad", doc="redundancy parameter of that arm"),
        )

    @property
    def kept_across_restarts(self) -> tuple[str, ...]:
        """State fields kept across restarts."""
        extra = TRUNK_KEPT_ACROSS_RESTARTS if self.robot.sides else ()
        return (*KEPT_ACROSS_RESTARTS, *extra)

    @property
    def _side_fields(self) -> tuple[Field, ...]:
        """State of the hand fits of a multi-arm robot, one side after the other."""
        sides = range(len(self.robot.sides))
        palms = [
            (
                Field(f"palm_rotation_{i}", (3, 3), doc="palm orientation of side, base frame"),
                Field(f"palm_origin_{i}", (3,), unit="m", doc="palm position of side, base frame"),
            )
            for i in sides
        ]
        return (
            Field("side", doc="index of the side whose hand is fitted; after all: their number"),
            Field("first_candidate", doc="index of the hand posture at which every side starts"),
            Field("last_candidate", doc="largest index of a hand posture that a side has reached"),
            Field("side_fits", (len(sides),), doc="1 if palm and hand meet the contacts, by side"),
            *(field for palm in palms for field in palm),
        )

    @property
    def _trunk_fields(self) -> tuple[Field, ...]:
        """State of the search for a trunk position."""
        n = len(self.robot.actuators)
        return (
            Field("trunk_min_cost", doc="smallest cost of trunk steps for these palm poses"),
            Field("trunk_best_q", (n,), doc="configuration of that cost [rad or m]"),
            Field("trunk_arms_placed_again", doc="1 if arms were placed again at this trunk"),
            Field("trunk_trials", doc="number of trunk trials for these palm poses"),
            Field("trunk_total_trials", doc="number of trunk trials of all restarts"),
            Field("trunk_fitting_trials", doc="number of trunk trials with hands that fit"),
            Field("trunk_fitting_min_cost", doc="smallest cost of trials with hands that fit"),
            Field("is_out_of_reach", doc="1 if the target counts as out of reach"),
        )

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the target and of the parameters of the method."""
        n, f = len(self.robot.actuators), len(self.robot.fingers)
        hand = len(self.robot.hand_actuators)
        return Layout(
            (
                *self.contacts.fields,
                Field("position_tolerance", (f,), unit="m", doc="by finger"),
                Field("angle_tolerance", (f,), unit="rad", doc="by finger"),
                Field("lower", (n,), doc="lower bounds of q [rad or m]"),
                Field("upper", (n,), doc="upper bounds of q [rad or m]"),
                Field("reach_weight", doc="weight of the arm's reach in the fit of the hand"),
                Field("hand_only", doc="1 if the solve ends with the hand fit"),
                Field("start", (n,), doc="q0 clipped to the bounds [rad or m]"),
                Field("nearest", doc="1 if the solution nearest to q0 is preferred"),
                *(self._side_parameters if self.robot.sides else ()),
                Field("postures", (self.candidates, hand), doc="hand postures to try [rad or m]"),
            )
        )

    @property
    def _side_parameters(self) -> tuple[Field, ...]:
        """Additional parameters of multi-arm robots."""
        return (
            Field(
                "palms_are_free",
                doc="1 if a side has fewer contact conditions than motions of palm and hand",
            ),
            Field("palms_only", doc="1 if the solve only carries the palms to their poses"),
        )

    @cached_property
    def all_motors(self) -> ContactLeastSquares:
        """Contacts as a function of all motors, whose graphs the stages share."""
        return ContactLeastSquares(self.robot, self.contacts, self.parameters)

    @cached_property
    def record(self) -> Layout:
        """Layout of the logged row of an iteration."""
        robot = self.robot
        return Layout.record(
            Q.for_robot(robot, "actuator positions before the step; arm placement: after it"),
            COST.for_robot(robot, "squared residual before the step"),
            POSITION_ERROR.for_robot(robot),
            ANGLE_ERROR.for_robot(robot),
            DAMPING.for_robot(robot, "Levenberg-Marquardt damping of the step"),
            STEP_SIZE.for_robot(robot, "largest motor change of the step tried"),
            Field("margin", (), "f4", "", "best arm margin found (arm placement)"),
            *coupling_fields(robot),
            LIMIT_MASK.for_robot(robot),
            RESTART.for_robot(robot, "hand posture started from, counted from 0"),
            ACCEPTED.for_robot(robot),
            PHASE.for_robot(robot),
            STATUS.for_robot(robot),
        )

    def hand_bounds(self, q: Expr, p: dict[str, Expr], first: int) -> BoxBounds:
        """Return the bounds of the hand's motors, which begin at row `first` of a step."""
        rows = list(self.robot.hand_actuators)
        return BoxBounds(q[rows], p["lower"][rows], p["upper"][rows], first)

    def row(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        q: Expr,
        phase: Phase,
        trial: TrialStep | None = None,
        accepted: Expr = 0.0,
        margin: Expr = NOT_COMPUTED,
    ) -> Expr:
        """Return the record of an iteration at q (n, 1), except its status.

        Args:
            s: State before the iteration.
            p: Parameters.
            q: Configuration.
            phase: Phase of the iteration.
            trial: Damped step, if the stage makes one.
            accepted: 1 if the step was accepted.
            margin: Margin of the best arm, if the stage places the arm.
        """
        residual, cost, size = ca.SX.nan(self.contacts.size), NOT_COMPUTED, NOT_COMPUTED
        if trial is not None:
            residual = trial.residual_before[: self.contacts.size]
            cost, size = ca.sumsqr(trial.residual_before), trial.max_change
        restart = s["candidates_before"] + ca.fmax(s["candidate"], 0.0)
        numbers = cost, s["damping"], size, margin, restart, accepted, float(phase)
        return self._row(q, residual, *numbers, p["weights"], p["lower"], p["upper"])

    @cached_property
    def _row(self) -> ca.Function:
        """Graph of a record from the results of a stage; a residual of NaN is unknown."""
        robot, n = self.robot, len(self.robot.actuators)
        q, lower, upper = (ca.SX.sym(name, n) for name in ("q", "lower", "upper"))
        residual = ca.SX.sym("residual", self.contacts.size)
        weights = ca.SX.sym("weights", len(robot.fingers), 2)
        names = ("cost", "damping", "step_size", "margin", "restart", "accepted", "phase")
        numbers = {name: ca.SX.sym(name) for name in names}
        positions, chords = self.contacts.errors(residual)
        angles = 2 * ca.asin(ca.fmin(chords / 2, 1.0))
        # `fmin` hides a NaN residual; the cost is NaN then, and `cost >= 0` detects it.
        has_angle = ca.logic_and(weights[:, 1] > 0, numbers["cost"] >= 0)
        row = self.record.pack(
            {
                "q": q,
                **numbers,
                "position_error": ca.if_else(weights[:, 0] > 0, positions, NOT_COMPUTED),
                "angle_error": ca.if_else(has_angle, angles, NOT_COMPUTED),
                **coupling_values(robot, q),
                "limit_mask": pack_bits(ca.logic_or(q <= lower, q >= upper)),
                "status": 0.0,  # set after the choice of the next stage
            }
        )
        return call_function("row", [q, residual, *numbers.values(), weights, lower, upper], [row])


def with_rows(q: Expr, rows: Sequence[int], values: Expr) -> Expr:
    """Return q with the given entries replaced."""
    index = {row: i for i, row in enumerate(rows)}
    return ca.vertcat(*(values[index[i]] if i in index else q[i] for i in range(q.numel())))


def settings_layout(robot: RobotDescription) -> Layout:
    """Return the layout of the settings that targets share: tolerances, bounds and preference."""
    n, f = len(robot.actuators), len(robot.fingers)
    return Layout(
        (
            Field("position_tolerance", (f,), unit="m", doc="by finger"),
            Field("angle_tolerance", (f,), unit="rad", doc="by finger"),
            Field("lower", (n,), doc="lower bounds of q [rad or m]"),
            Field("upper", (n,), doc="upper bounds of q [rad or m]"),
            Field("nearest", doc="1 if the solution nearest to q0 is preferred"),
        )
    )


def first_state_graph(layouts: HandFirstLayouts) -> FunctionGraph:
    """Return the graph that computes the first state and the parameters of a restart.

    Hand motors that only move free fingers stay at q0; every start is clipped to the bounds.

    Returns:
        points (f, 3) [m], normals (f, 3) and the other vectors of the contacts, NaN where free;
        q0 (n, 1), the `settings`, hand postures to try (candidates, hand) -> state, parameters.
    """
    robot = layouts.robot
    f, n = len(robot.fingers), len(robot.actuators)
    name = ca.Function.fix_name(f"hand_first_start_{robot.name}{kinds_suffix(layouts.kinds)}")
    return FunctionGraph(
        name,
        lambda: _build_first_state(name, layouts),
        {
            **{f"{vector}s": (f, 3) for vector in layouts.contacts.data},
            "q0": (n, 1),
            "settings": (settings_layout(robot).size, 1),
            "postures": (layouts.candidates, len(layouts.robot.hand_actuators)),
        },
        ((layouts.state.size, 1), (layouts.parameters.size, 1)),
        recipe(name, robot, layouts.candidates, layouts.kinds),
    )


def _build_first_state(name: str, layouts: HandFirstLayouts) -> ca.Function:
    robot, hand = layouts.robot, list(layouts.robot.hand_actuators)
    f, n = len(robot.fingers), len(robot.actuators)
    vectors = {f"{vector}s": ca.SX.sym(f"{vector}s", f, 3) for vector in layouts.contacts.data}
    q0 = ca.SX.sym("q", n)
    settings_vector = settings_layout(robot).symbols("settings")
    t = settings_layout(robot).unpack(settings_vector)
    postures = ca.SX.sym("postures", layouts.candidates, len(hand))

    is_set = {key: _is_number(array[:, 0]) for key, array in vectors.items()}
    weights = ca.horzcat(is_set["points"], is_set["normals"])
    has_contact = ca.logic_or(weights[:, 0], weights[:, 1])
    is_needed = ca.vertcat(*(_moves_contact(robot, motor, has_contact) for motor in hand))
    hand_of_q0 = _clip(q0[hand], t, hand)
    seeds = [
        ca.if_else(is_needed, _clip(postures[i, :].T, t, hand), hand_of_q0)
        for i in range(layouts.candidates)
    ]
    start = _clip(q0, t, list(range(n)))
    parameters = layouts.parameters.pack(
        {
            **{key: _or_zero(array, is_set[key]) for key, array in vectors.items()},
            "weights": weights,
            "reach_weight": 1.0,
            "hand_only": 0.0,
            "start": start,
            **(_side_parameters(layouts, weights) if robot.sides else {}),
            "postures": ca.horzcat(*seeds).T,
            **t,
        }
    )
    zero = {item.name: ca.SX.zeros(item.size) for item in layouts.state}
    state = layouts.state.pack(
        zero
        | {
            "q": start,
            "best_q": q0,
            "best_cost": sys.float_info.max,
            "balance_min_ratio": sys.float_info.max,
            "hand_fit_min_excess": sys.float_info.max,
            "is_underactuated": _is_underactuated(layouts, t),
            "phase": ca.if_else(t["nearest"], float(Stage.START), float(Stage.CANDIDATE)),
            "candidate": -t["nearest"],
        }
        | initial_lm_state()
    )
    inputs = [*vectors.values(), q0, settings_vector, postures]
    return ca.Function(name, inputs, with_cse(state, parameters))


def _is_underactuated(layouts: HandFirstLayouts, t: dict[str, Expr]) -> Expr:
    """Return 1 if hand or arm have too few free motors.

    These are hands of which some motors are fixed, and arms with fewer than six free motors, which
    cannot reach every palm pose (also a hand without an arm). The result is 0 if all hand motors
    are fixed, because the hand then needs no search.
    """
    hand, arm = list(layouts.robot.hand_actuators), list(layouts.arm)
    free_hand, free_arm = (
        ca.sum1(t["lower"][rows] < t["upper"][rows]) if rows else 0 for rows in (hand, arm)
    )
    has_too_few = ca.logic_or(free_hand < len(hand), free_arm < POSE_DIMENSION)
    return ca.logic_and(has_too_few, free_hand > 0)


def _side_parameters(layouts: HandFirstLayouts, weights: Expr) -> dict[str, Expr]:
    """Return the additional parameters of a multi-arm robot for contacts with `weights` (f, 2)."""
    return {"palms_are_free": _palms_are_free(layouts, weights), "palms_only": 0.0}


def _palms_are_free(layouts: HandFirstLayouts, weights: Expr) -> Expr:
    """Return 1 if contacts leave palm and hand of a side a free motion.

    A point has three conditions and a normal two; other kinds of contacts count as free.

    Args:
        layouts: Layouts of a multi-arm robot.
        weights: (f, 2) 1 for a point and for a normal that is given.
    """
    robot, finger_index = layouts.robot, layouts.robot.finger_names.index
    is_free = ca.SX(float(layouts.kinds != point_normal_kinds(len(robot.fingers))))
    for side, (_, hand) in zip(robot.sides, robot.side_actuators, strict=True):
        fingers = list(map(finger_index, side.fingers))
        conditions = ca.sum1(weights[fingers, :] @ ca.SX([3, 2]))
        has_fewer = ca.logic_and(conditions > 0, conditions < POSE_DIMENSION + len(hand))
        is_free = ca.logic_or(is_free, has_fewer)
    return is_free


def _is_number(x: Expr) -> Expr:
    """Return 1 where x is a number, 0 where NaN, in a form that is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)


def _or_zero(x: Expr, is_set: Expr) -> Expr:
    return ca.if_else(ca.repmat(is_set, 1, 3), x, 0.0)


def _moves_contact(robot: RobotDescription, actuator: int, has_contact: Expr) -> Expr:
    """Return 1 if an actuator moves a finger that has a contact."""
    fingers = [i for i, f in enumerate(robot.finger_names) if actuator in robot.finger_actuators(f)]
    return ca.mmax(ca.vertcat(ca.SX(0), has_contact[fingers]))


def _clip(q: Expr, t: dict[str, Expr], actuators: list[int]) -> Expr:
    return ca.fmin(ca.fmax(q, t["lower"][actuators]), t["upper"][actuators])
