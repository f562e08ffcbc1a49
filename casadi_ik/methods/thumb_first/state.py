"""State, parameters and record of the thumb-first method, and its numbers."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import casadi as ca

from casadi_ik.errors import InputError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.methods.common.limits import bits
from casadi_ik.methods.thumb_first.closed_chain_step import Merit
from casadi_ik.problem.contacts import ContactRows, Kinds
from casadi_ik.problem.status import Phase
from casadi_ik.problem.trace import (
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
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.smooth import Expr

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
            "limit_mask": bits(ca.logic_or(q <= p["lower"], q >= p["upper"])),
            "restart": ca.fmax(s["start"], 0.0),
            "accepted": 0.0,
            "phase": float(phase),
            "status": status,
        }
        return self.record.pack(values | measured)
