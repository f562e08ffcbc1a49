"""State, parameters and record of the hand-first method, and the start of a solve."""

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
from casadi_ik.solve.limits import coupling_fields, coupling_values, pack_bits
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

STAGES = (
    *(Phase.REFINEMENT, Phase.CANDIDATE, Phase.HAND_FIT, Phase.ARM_PLACEMENT),
    *(Phase.BALANCE, Phase.ARM_CHOICE),
)
"""The stages of an arm-hand in the order of their codes; a body has `Phase.TRUNK` after them."""


class Stage(IntEnum):
    """What a solve does next, `phase` of the state; where `Phase` has it by its code."""

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


BY_SIDE = 32
"""Offset of stage numbers per side of a multi-arm robot: stage + 32 * side."""


SAID = Layout(
    (
        Field("settled", doc="1 if the fit or the balance has ended"),
        Field("within", doc="1 if contacts are within tolerance; for an arm, within its bounds"),
        Field("near", doc="1 if an arm is the real one; 1 if its steps end near the pose"),
        Field("miss", doc="root mean square error of a fit, relative to the tolerances"),
        Field("cost", doc="cost before a hand fit or of an arm step; largest ratio of a balance"),
        Field("at_end", doc="arm joint, from 1, to move to its opposite limit; 0: none"),
    )
)
"""Outputs of a stage that decide the next stage."""

PLACES = {
    **{stage: i for i, stage in enumerate(STAGES)},
    Stage.TRUNK: len(STAGES),
    Stage.START: STAGES.index(Phase.REFINEMENT),
    Stage.ARM_STEPS: STAGES.index(Phase.ARM_PLACEMENT),
    Stage.TOLERANT_HAND_FIT: STAGES.index(Phase.HAND_FIT),
    Stage.TOLERANT_REFINEMENT: STAGES.index(Phase.REFINEMENT),
}
"""Index of the counter of each stage."""

CARRIED = (
    *("passed", "near", "least_excess", "balanced", "least", "returns"),
    *("best_cost", "best_q", "counts"),
)
"""State fields kept across restarts: the position in the start table of the numeric arm, the minima
that were tried, and the incumbent."""

NOTHING = float("nan")

LOOSE = "1 if the contacts of a side are fewer conditions than palm and hand have motions"


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
        sides = (place for arm, _ in robot.side_actuators for place in arm)
        return tuple(sides) if robot.sides else robot.arm_actuators

    @cached_property
    def stages(self) -> tuple[Phase, ...]:
        """Phases of the solves, in the order of their counters."""
        return (*STAGES, Phase.TRUNK) if self.robot.sides else STAGES

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Names of the phases."""
        return tuple(stage.label for stage in self.stages)

    @cached_property
    def contacts(self) -> ContactRows:
        """Rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """Layout of the state that one iteration passes to the next."""
        n = len(self.robot.actuators)
        sides = (len(self.robot.sides),) if self.robot.sides else ()
        return Layout(
            (
                Field("q", (n,), doc="arm and hand; during a hand fit only the hand is meaningful"),
                Field("palm_rotation", (3, 3)),
                Field("palm_origin", (3,), unit="m"),
                Field("phase"),
                Field("candidate", doc="index of the hand posture; -1: the one of q0"),
                Field("earlier", doc="number of hand postures tried in earlier restarts"),
                Field("turn", doc="index of the first palm rotation where contacts leave it free"),
                Field("damping"),
                Field("growth", doc="factor of the damping if the next step is rejected"),
                Field("cost", doc="cost at q (or at palm and hand)"),
                Field("fits", doc="1 if palm and hand meet the contacts"),
                Field("waited", doc="number of consecutive steps with slow progress"),
                Field("spent", doc="number of steps in this stage"),
                Field("power", doc="number of completed powers of the balance"),
                Field(
                    "near",
                    doc="cost of the last minimum of a hand fit that missed by little, 0: none",
                ),
                Field("least_excess", doc="smallest cost of a tolerant hand fit that failed"),
                Field(
                    "balanced",
                    doc="cost of the last minimum of a refinement that missed by little, 0: none",
                ),
                Field("least", doc="smallest largest tolerance ratio of a balance so far"),
                Field("held", doc="1 if hand or arm has too few free motors"),
                Field(
                    "returns", doc="number of fits and balances that ended at a previous minimum"
                ),
                Field("margin", sides, doc="best margin of the arm so far, negative: a violation"),
                Field("arm", (len(self.arm),), doc="arm with the best margin"),
                Field("swivel", sides, unit="rad", doc="redundancy parameter of that arm"),
                Field("starts", doc="number of starts of the numeric arm stage"),
                Field(
                    "turned", doc="last joint of this start that was moved to its opposite limit"
                ),
                Field("passed", doc="distance of the palm of the last start from the palm pose"),
                Field("best_cost", doc="smallest cost of a whole configuration so far"),
                Field("best_q", (n,), doc="the configuration with that cost"),
                Field("counts", (len(self.stages),), doc="iterations by stage"),
                *(self._of_sides if self.robot.sides else ()),
            )
        )

    @property
    def carried(self) -> tuple[str, ...]:
        """State fields kept across restarts; for a multi-arm robot also the trunk trials."""
        return (*CARRIED, "trunks", "looked", "far") if self.robot.sides else CARRIED

    @property
    def _of_sides(self) -> tuple[Field, ...]:
        """Additional state fields of multi-arm robots."""
        n, sides = len(self.robot.actuators), range(len(self.robot.sides))
        palms = [
            (Field(f"palm_rotation_{i}", (3, 3)), Field(f"palm_origin_{i}", (3,), unit="m"))
            for i in sides
        ]
        return (
            Field("side", doc="index of the side whose hand is fitted"),
            Field("first", doc="index of the first hand posture of every side"),
            Field("farthest", doc="largest index of a hand posture of any side"),
            Field("fitted", (len(sides),), doc="1 if palm and hand meet the contacts, by side"),
            *(field for palm in palms for field in palm),
            Field("palms_least", doc="smallest cost of trunk steps for these palms"),
            Field("palms_best", (n,), doc="the configuration with that cost"),
            Field("again", doc="1 after the arms were placed again at the best trunk"),
            Field("tried", doc="number of trunk trials for these palms"),
            Field("trunks", doc="number of trunk trials for all palms"),
            Field("looked", doc="number of trunk trials for palms of hands that fit"),
            Field("far", doc="smallest cost of trunk steps for such palms"),
            Field("hopeless", doc="1 if the target counts as out of reach"),
        )

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the target and the parameters of the method."""
        n, f = len(self.robot.actuators), len(self.robot.fingers)
        hand = len(self.robot.hand_actuators)
        return Layout(
            (
                *self.contacts.fields,
                Field("position_tolerance", (f,), unit="m"),
                Field("angle_tolerance", (f,), unit="rad"),
                Field("lower", (n,), doc="lower bounds of q"),
                Field("upper", (n,), doc="upper bounds of q"),
                Field("reach", doc="weight of the arm's reach while the hand is fitted"),
                Field("alone", doc="1 if a solve ends with the hand's fit, and the arm stays out"),
                Field("start", (n,), doc="where the robot is, within bounds"),
                Field("nearest", doc="1 if the solution nearest to the start is wanted"),
                *((Field("loose", doc=LOOSE),) if self.robot.sides else ()),
                Field("postures", (self.candidates, hand), doc="hand postures to try"),
            )
        )

    @cached_property
    def whole(self) -> ContactLeastSquares:
        """The contacts as a function of all motors; the stages share its functions."""
        return ContactLeastSquares(self.robot, self.contacts, self.parameters)

    @cached_property
    def record(self) -> Layout:
        """What is logged of an iteration."""
        robot = self.robot
        return Layout.record(
            Q.of(robot, "actuator positions before the step; where the arm is placed, after it"),
            COST.of(robot, "squared residual before the step"),
            POSITION_ERROR.of(robot),
            ANGLE_ERROR.of(robot),
            DAMPING.of(robot, "Levenberg-Marquardt damping of the step"),
            STEP_SIZE.of(robot, "largest motor change of the step tried"),
            Field("margin", (), "f4", "", "best arm margin found (arm placement)"),
            *coupling_fields(robot),
            LIMIT_MASK.of(robot),
            RESTART.of(robot, "hand posture started from, counted from 0"),
            ACCEPTED.of(robot),
            PHASE.of(robot),
            STATUS.of(robot),
        )

    def hand_bounds(self, q: Expr, p: dict[str, Expr], first: int) -> BoxBounds:
        """Bounds of the hand's actuators."""
        rows = list(self.robot.hand_actuators)
        return BoxBounds(q[rows], p["lower"][rows], p["upper"][rows], first)

    def row(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        q: Expr,
        phase: Phase,
        tried: TrialStep | None = None,
        accepted: Expr = 0.0,
        margin: Expr = NOTHING,
    ) -> Expr:
        """What is logged at q (n, 1), but for the status.

        Args:
            s: State before the iteration.
            p: Parameters.
            q: The configuration.
            phase: The stage.
            tried: The damped step, if the stage makes one.
            accepted: Whether it was taken.
            margin: Of the arm, if the stage places it.
        """
        residual, cost, size = ca.SX.nan(self.contacts.size), NOTHING, NOTHING
        if tried is not None:
            residual = tried.residual_before[: self.contacts.size]
            cost, size = ca.sumsqr(tried.residual_before), tried.max_change
        restart = s["earlier"] + ca.fmax(s["candidate"], 0.0)
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
        # A least number is never NaN; the cost is where the residual is.
        known = ca.logic_and(weights[:, 1] > 0, numbers["cost"] >= 0)
        row = self.record.pack(
            {
                "q": q,
                **numbers,
                "position_error": ca.if_else(weights[:, 0] > 0, positions, NOTHING),
                "angle_error": ca.if_else(known, angles, NOTHING),
                **coupling_values(robot, q),
                "limit_mask": pack_bits(ca.logic_or(q <= lower, q >= upper)),
                "status": 0.0,  # filled in by the iteration
            }
        )
        return call_function("row", [q, residual, *numbers.values(), weights, lower, upper], [row])


def with_rows(q: Expr, rows: Sequence[int], values: Expr) -> Expr:
    """Return q with the given entries replaced."""
    places = {row: i for i, row in enumerate(rows)}
    return ca.vertcat(*(values[places[i]] if i in places else q[i] for i in range(q.numel())))


def terms(robot: RobotDescription) -> Layout:
    """Return the layout of the parameters that all targets of a batch share."""
    n, f = len(robot.actuators), len(robot.fingers)
    return Layout(
        (
            Field("position_tolerance", (f,), unit="m"),
            Field("angle_tolerance", (f,), unit="rad"),
            Field("lower", (n,), doc="lower bounds of q"),
            Field("upper", (n,), doc="upper bounds of q"),
            Field("nearest", doc="1 if the solution nearest to q0 is preferred"),
        )
    )


def beginning(layouts: HandFirstLayouts) -> FunctionGraph:
    """Return the graph of the first state and the parameters of a restart.

    Hand motors that only move free fingers stay at q0; every start is clipped to the bounds.

    Returns:
        points (f, 3) [m], normals (f, 3) and the contacts' other vectors, NaN where free, where
        the robot is (n, 1), the `terms`, hand postures to try (candidates, hand) -> state,
        parameters.
    """
    robot = layouts.robot
    f, n = len(robot.fingers), len(robot.actuators)
    name = ca.Function.fix_name(f"hand_first_beginning_{robot.name}{kinds_suffix(layouts.kinds)}")
    return FunctionGraph(
        name,
        lambda: _build(name, layouts),
        {
            **{f"{vector}s": (f, 3) for vector in layouts.contacts.data},
            "here": (n, 1),
            "terms": (terms(robot).size, 1),
            "postures": (layouts.candidates, len(layouts.robot.hand_actuators)),
        },
        ((layouts.state.size, 1), (layouts.parameters.size, 1)),
        recipe(name, robot, layouts.candidates, layouts.kinds),
    )


def _build(name: str, layouts: HandFirstLayouts) -> ca.Function:
    robot, hand = layouts.robot, list(layouts.robot.hand_actuators)
    f, n = len(robot.fingers), len(robot.actuators)
    vectors = {f"{vector}s": ca.SX.sym(f"{vector}s", f, 3) for vector in layouts.contacts.data}
    here = ca.SX.sym("q", n)
    common = terms(robot)
    given = common.symbols("terms")
    t = common.unpack(given)
    postures = ca.SX.sym("postures", layouts.candidates, len(hand))

    numbers = {key: _is_number(array[:, 0]) for key, array in vectors.items()}
    known = ca.horzcat(numbers["points"], numbers["normals"])
    asked = ca.logic_or(known[:, 0], known[:, 1])
    needed = ca.vertcat(*(_mover(robot, actuator, asked) for actuator in hand))
    held = _bounded(here[hand], t, hand)
    tried = [
        ca.if_else(needed, _bounded(postures[i, :].T, t, hand), held)
        for i in range(layouts.candidates)
    ]
    start = _bounded(here, t, list(range(n)))
    parameters = layouts.parameters.pack(
        {
            **{key: _or_zero(array, numbers[key]) for key, array in vectors.items()},
            "weights": known,
            "reach": 1.0,
            "alone": 0.0,
            "start": start,
            **({"loose": _is_loose(layouts, known)} if robot.sides else {}),
            "postures": ca.horzcat(*tried).T,
            **t,
        }
    )
    zero = {item.name: ca.SX.zeros(item.size) for item in layouts.state}
    state = layouts.state.pack(
        zero
        | {
            "q": start,
            "best_q": here,
            "best_cost": sys.float_info.max,
            "least": sys.float_info.max,
            "least_excess": sys.float_info.max,
            "held": _is_held(layouts, t),
            "phase": ca.if_else(t["nearest"], float(Stage.START), float(Stage.CANDIDATE)),
            "candidate": -t["nearest"],
        }
        | initial_lm_state()
    )
    inputs = [*vectors.values(), here, given, postures]
    return ca.Function(name, inputs, with_cse(state, parameters))


def _is_held(layouts: HandFirstLayouts, t: dict[str, Expr]) -> Expr:
    """1 if motors of the hand are held, or the arm's free ones cannot take the palm to any pose.

    Fewer than six are too few, be they held, of a short arm or of a hand that stands alone.

    A hand that is held as a whole needs no search.
    """
    hand, arm = list(layouts.robot.hand_actuators), list(layouts.arm)
    free_hand, free_arm = (
        ca.sum1(t["lower"][rows] < t["upper"][rows]) if rows else 0 for rows in (hand, arm)
    )
    less = ca.logic_or(free_hand < len(hand), free_arm < POSE_DIMENSION)
    return ca.logic_and(less, free_hand > 0)


def _is_loose(layouts: HandFirstLayouts, known: Expr) -> Expr:
    """1 if contacts of which `known` (f, 2) are given leave palms of a body a freedom."""
    robot, place = layouts.robot, layouts.robot.finger_names.index
    loose = ca.SX(float(layouts.kinds != point_normal_kinds(len(robot.fingers))))
    for side, (_, hand) in zip(robot.sides, robot.side_actuators, strict=True):
        conditions = ca.sum1(known[list(map(place, side.fingers)), :] @ ca.SX([3, 2]))
        fewer = ca.logic_and(conditions > 0, conditions < POSE_DIMENSION + len(hand))
        loose = ca.logic_or(loose, fewer)
    return loose


def _is_number(x: Expr) -> Expr:
    """Return 1 where x is a number, 0 where NaN, in a form that is not simplified to 1."""
    return ca.logic_or(x <= 0, x > 0)


def _or_zero(x: Expr, known: Expr) -> Expr:
    return ca.if_else(ca.repmat(known, 1, 3), x, 0.0)


def _mover(robot: RobotDescription, actuator: int, known: Expr) -> Expr:
    """Return 1 if an actuator moves a finger that has a contact."""
    moved = [i for i, f in enumerate(robot.finger_names) if actuator in robot.finger_actuators(f)]
    return ca.mmax(ca.vertcat(ca.SX(0), known[moved]))


def _bounded(q: Expr, t: dict[str, Expr], actuators: list[int]) -> Expr:
    return ca.fmin(ca.fmax(q, t["lower"][actuators]), t["upper"][actuators])
