"""Parameters of the thumb-first method, and the layouts of its state, parameters and log record."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import casadi as ca

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError
from casadi_ik.kinematics.contacts import ContactRows, Kinds
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.looped_method import pack_bits
from casadi_ik.solve.status import Phase
from casadi_ik.solve.thumb_first.closed_chain_step import ContactErrors
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

STEP_METHODS = ("freeze", "proxqp")
"""Names of the solvers that compute a step within the limits."""


@dataclass(frozen=True)
class ThumbFirstParameters:
    """Parameters of the method `thumb-first`.

    Attributes:
        starts: Maximum number of palm estimates per solve, each from a different hand posture.
        table: Number of hand postures in the table of palm estimates.
        pull: Weight of the distance from the reference posture (that of q0, or home) in the choice
            of hand postures, relative to their fit to the contacts.
        step: "freeze" fixes the joint with the largest limit violation and solves the step again.
            "proxqp" solves the same problem as a quadratic program (ProxQP, Bambade et al. 2022)
            in CasADi's virtual machine, which is slower.
        damping: Damping of the first step of a start [-]; residuals are in 0.1 m and rad.
        step_cap: Largest change of a motor per iteration [rad, or fraction of the range of a
            slider].
        damping_decrease: Factor of the damping after an accepted step, < 1.
        damping_increase: Factor of the damping after a rejected step, > 1.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends a start.
        gain: Ratio of costs after and before a step above which progress is slow.
        patience: Number of consecutive iterations with slow progress that ends a start.
        budget: Maximum number of iterations per start.
        max_cost_of_q0: Largest cost at q0 for which q0 and its hand posture are used as starts.
    """

    starts: int = 32
    table: int = 8192
    pull: float = 6.0
    step: str = "freeze"
    damping: float = 0.03
    step_cap: float = 0.3
    damping_decrease: float = 1 / 3
    damping_increase: float = 4.0
    damping_floor: float = 1e-6
    damping_ceiling: float = 100.0
    gain: float = 0.9
    patience: int = 12
    budget: int = 100
    max_cost_of_q0: float = 0.5

    def __post_init__(self) -> None:
        if self.step not in STEP_METHODS:
            names = ", ".join(STEP_METHODS)
            raise InputError(f"step: found {self.step!r}, expected one of {names}")
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.type == "int" and not (type(value) is int and value >= 1):
                raise InputError(f"{entry.name}: found {value!r}, expected a whole number >= 1")
            if entry.type == "float" and not (type(value) in (int, float) and value > 0):
                raise InputError(f"{entry.name}: found {value!r}, expected a number > 0")
        if self.starts > self.table:
            raise InputError(f"table: found {self.table}, expected at least starts = {self.starts}")


THUMB_FIRST_STAGES = (Phase.HAND_ALIGNMENT, Phase.CANDIDATE, Phase.ARM_PLACEMENT, Phase.BALANCE)
"""Phases of an iteration, sorted by decreasing frequency."""

ABSENT = float("nan")
"""Value of a record field that the phase does not define."""


@dataclass(frozen=True, eq=False)
class ThumbFirstLayouts:
    """Layouts of state, parameters and record for one robot.

    Attributes:
        robot: Description of the robot.
        options: Parameters of the method.
        kinds: Kind of contact of each finger.
    """

    robot: RobotDescription
    options: ThumbFirstParameters
    kinds: Kinds

    @cached_property
    def contacts(self) -> ContactRows:
        """Rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """State that an iteration passes to the next iteration."""
        n = len(self.robot.actuators)
        return Layout(
            (
                Field("q", (n,)),
                Field("palm_rotation", (3, 3), doc="estimated palm pose of this start"),
                Field("palm_origin", (3,), unit="m"),
                Field(
                    "last_start_distance",
                    doc="distance of the last arm start of the table from the palm pose",
                ),
                Field("phase"),
                Field("start", doc="index of the palm estimate; -1 for q0"),
                Field("damping"),
                Field("growth", doc="placement: factor of the damping after a rejected step"),
                Field("cost", doc="placement: squared distance from the palm pose"),
                Field("slow_steps", doc="number of consecutive iterations with slow progress"),
                Field("stage_iterations", doc="number of iterations in this phase"),
                Field("power", doc="number of completed powers of the minimax stage"),
                Field(
                    "last_minimax_cost", doc="cost at the last start of the minimax stage; 0: none"
                ),
                Field("best_cost", doc="smallest cost so far"),
                Field("best_q", (n,), doc="configuration of the smallest cost"),
                Field(
                    "counts",
                    (len(THUMB_FIRST_STAGES),),
                    doc="iterations by stage, in the order of THUMB_FIRST_STAGES",
                ),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """Target and parameters of a solve."""
        n, f = len(self.robot.actuators), len(self.robot.fingers)
        hand = len(self.robot.hand_actuators)
        return Layout(
            (
                *self.contacts.fields,
                Field("position_tolerance", (f,), unit="m"),
                Field("angle_tolerance", (f,), unit="rad"),
                Field("lower", (n,), doc="lower bounds of q"),
                Field("upper", (n,), doc="upper bounds of q"),
                Field("postures", (self.options.starts, hand), doc="hand postures to start from"),
                Field("n_postures", doc="number of hand postures"),
                Field("start_q", (n,), doc="q0 clipped to the bounds"),
                Field("prefers_q0", doc="1 if solutions near q0 are preferred"),
                Field("first_damping"),
                Field("step_cap"),
            )
        )

    @cached_property
    def record(self) -> Layout:
        """Log record of an iteration: its step, and the configuration after it."""
        robot = self.robot
        return Layout.record(
            Q.for_robot(robot, "actuator positions after the iteration"),
            COST.for_robot(robot, "summed squares of all contacts there (0.1 m, rad)"),
            POSITION_ERROR.for_robot(robot),
            ANGLE_ERROR.for_robot(robot),
            DAMPING.for_robot(robot, "damping of the step tried"),
            STEP_SIZE.for_robot(robot, "largest motor change of the step tried"),
            ACTIVE_MASK.for_robot(robot),
            LIMIT_MASK.for_robot(robot),
            RESTART.for_robot(robot, "number of the palm estimate begun from, counted from 0"),
            ACCEPTED.for_robot(robot),
            PHASE.for_robot(robot),
            STATUS.for_robot(robot),
        )

    def next_state(
        self, s: dict[str, Expr], stage: Phase, fit_state: dict[str, Expr], **changes: Expr
    ) -> Expr:
        """Return the state (size, 1) after an iteration.

        Args:
            s: State before the iteration.
            stage: Phase of the iteration.
            fit_state: Counters and damping.
            changes: Values of further fields; they take precedence over `fit_state`.
        """
        increment = ca.DM([float(stage == phase) for phase in THUMB_FIRST_STAGES])
        return self.state.pack(s | {"counts": s["counts"] + increment} | fit_state | changes)

    def record_row(
        self,
        s: dict[str, Expr],
        p: dict[str, Expr],
        q: Expr,
        phase: Phase,
        status: Expr,
        errors: ContactErrors,
        **phase_values: Expr,
    ) -> Expr:
        """Return the log record of an iteration.

        Args:
            s: State before the iteration.
            p: Parameters.
            q: (n, 1) configuration after the iteration.
            phase: Phase of the iteration.
            status: Status after the iteration.
            errors: Contact errors at q.
            phase_values: Values of the fields that only this phase defines.
        """
        values: dict[str, Expr] = {
            "q": q,
            "cost": errors.cost,
            "position_error": ca.if_else(p["weights"][:, 0] > 0, errors.positions, ABSENT),
            "angle_error": ca.if_else(p["weights"][:, 1] > 0, errors.angles, ABSENT),
            "damping": ABSENT,
            "step_size": ABSENT,
            "active_mask": ca.DM.zeros(LIMIT_MASK.for_robot(self.robot).size, 1),
            "limit_mask": pack_bits(ca.logic_or(q <= p["lower"], q >= p["upper"])),
            "restart": ca.fmax(s["start"], 0.0),
            "accepted": 0.0,
            "phase": float(phase),
            "status": status,
        }
        return self.record.pack(values | phase_values)
