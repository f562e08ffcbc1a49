"""State, parameters and record of the enhanced methods, and the numbers that go in and come out."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.methods.common.limits import limit_mask
from casadi_ik.methods.qiu.finger_step import planar_fingers
from casadi_ik.methods.qiu.parameters import QiuParameters
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Phase
from casadi_ik.problem.target import target_fields, target_values
from casadi_ik.problem.trace import (
    ANGLE_ERROR,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    STATUS,
    STEP_SIZE,
    Q,
    RecordedJacobian,
)
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.closed_chain import VIRTUAL, split
from casadi_ik.symbolic.smooth import Expr

NOT_MEASURED = float("nan")


class EnhancedLayouts:
    """The three layouts for one robot.

    Attributes:
        robot: The description.
        options: The structural choices and the numbers.
        chain: Active and passive joints of the closed chain.
        state: What an iteration hands to the next.
        parameters: The problem and the numbers of the method.
        record: What is logged of an iteration.
    """

    def __init__(self, robot: RobotDescription, options: QiuParameters) -> None:
        """Lay out state, parameters and record.

        Args:
            robot: The description.
            options: The structural choices; numbers are parameters of the graph.

        Raises:
            UnsupportedError: The robot is not of the kind the method needs.
        """
        n = len(robot.actuators)
        self.robot = robot
        self.options = options
        self.chain = split(robot, options.borrowed)
        planar_fingers(robot)  # refused now rather than when the graph is built
        self.state = Layout(
            (
                Field("q", (n,)),
                Field("phase"),
                Field("best", doc="smallest summed error of thumb reaching so far"),
                Field("waited", doc="iterations since `best` fell"),
                Field("reached", doc="iterations spent in thumb reaching"),
            )
        )
        self.parameters = Layout(
            (
                *target_fields(robot),
                Field("enforce_limits", doc="1: q is kept within its limits, 0: it is not"),
                Field("reaching_damping"),
                Field("chain_damping"),
                Field("chain_lever", unit="mm"),
                Field("reaching_gamma"),
                Field("chain_gamma"),
                Field("longest_error", unit="mm"),
                Field("widest_error", unit="rad"),
                Field("weights", (len(self.chain.active),)),
                Field("reaching_patience"),
                Field("reaching_iterations"),
                Field("step_cap"),
            )
        )
        self.record = Layout.record(
            Q.of(robot),
            POSITION_ERROR.of(robot),
            ANGLE_ERROR.of(robot),
            Field("palm_error", (), "f4", "rad", "palm orientation task error (phase 1)"),
            Field("palm_motion", (2,), "f4", "mm, rad", "palm motion demanded (phase 2)"),
            STEP_SIZE.of(robot, "largest motor change of this iteration"),
            Field("sigma_thumb", (), "f4", "m", "smallest singular value, thumb point Jacobian"),
            Field("sigma_palm", (), "f4", "", "smallest singular value, palm task (phase 1)"),
            Field("sigma_closed_chain", (), "f4", "", "smallest singular value of H_p (phase 2)"),
            Field("condition_closed_chain", (), "f4", "", "condition number of H_p (phase 2)"),
            LIMIT_MASK.of(robot),
            PHASE.of(robot),
            STATUS.of(robot),
        )

    @property
    def jacobians(self) -> dict[str, RecordedJacobian]:
        """The Jacobians in the record.

        The paper names no thresholds; these are ours. A metre of the thumb's tip asks for more
        than 20 rad of some joint, a rad of the palm for more than 2 rad, the platform for passive
        joints that move 100 times as far as it turns. H_p has lengths in millimetres: its condition
        number is above 400 everywhere.
        """
        names = self.robot.actuator_names
        arm = tuple(names[i] for i in self.robot.arm_actuators)
        thumb = tuple(names[i] for i in self.robot.finger_actuators(self.robot.thumb))
        passive = tuple(names[i] for i in self.chain.passive if i != VIRTUAL)
        return {
            "thumb": RecordedJacobian(arm + thumb, singular=0.05),
            "palm": RecordedJacobian(arm, singular=0.5),
            "closed_chain": RecordedJacobian(passive, singular=0.01, condition=1e5),
        }

    def parameter_values(self, problems: Problems) -> dict[str, float | list[float] | Array]:
        """Values of all parameter fields for a batch."""
        options = self.options
        named = (name for name in self.parameters.names if hasattr(options, name))
        return {
            **target_values(problems),
            "enforce_limits": float(problems.enforce_limits),
            "weights": [
                options.virtual_weight if column == VIRTUAL else options.joint_weight
                for column in self.chain.active
            ],
            **{name: float(getattr(options, name)) for name in named},
        }

    def first_state(self, starts: Array) -> dict[str, float | Array]:
        """Values of all state fields for starts (k, n)."""
        return {
            "q": starts,
            "phase": float(Phase.THUMB_REACHING),
            "best": float(np.finfo(float).max),
            "waited": 0.0,
            "reached": 0.0,
        }

    def row(
        self, q: Expr, positions: Expr, angles: Expr, *, phase: Phase, **measured: Expr
    ) -> ca.SX:
        """What is logged of an iteration.

        Args:
            q: (n, 1) the configuration the row describes.
            positions: (f, 1) its errors [m].
            angles: (f, 1) [rad].
            phase: The phase.
            measured: The other fields; those that the phase does not have are left out.
        """
        values: dict[str, Expr] = {
            "q": q,
            "position_error": positions,
            "angle_error": angles,
            "palm_error": NOT_MEASURED,
            "palm_motion": [NOT_MEASURED, NOT_MEASURED],
            "sigma_palm": NOT_MEASURED,
            "sigma_closed_chain": NOT_MEASURED,
            "condition_closed_chain": NOT_MEASURED,
            "limit_mask": limit_mask(self.robot, q),
            "phase": float(phase),
        }
        return self.record.pack(values | measured)
