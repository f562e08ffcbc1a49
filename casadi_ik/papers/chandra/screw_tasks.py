"""Tasks of a fingertip as residual rows: a full pose, or selected components.

Chandra et al. 2019 control the full pose, six rows for the two to four coordinates of a finger, and
name task-specific Jacobians as future work. Here every task selects its rows from the motion of the
tip relative to the base or to another fingertip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile import Field, Layout, StepGraph
from casadi_ik.errors import InputError, UnknownNameError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.box_qp import BoxBounds, damped_step
from casadi_ik.kinematics.linear_algebra import singular_values
from casadi_ik.kinematics.screws import TipChain, TipMotion, finger_chain, relative_chain
from casadi_ik.kinematics.se3 import normal_error, perpendicular
from casadi_ik.kinematics.smooth import Expr, safe_norm, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.looped_method import (
    clamp_to_limits,
    coupling_fields,
    coupling_values,
    limit_mask,
)
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import LIMIT_MASK, STATUS, STEP_SIZE, Q


@dataclass(frozen=True)
class ScrewTask:
    """Desired motion of a fingertip.

    Attributes:
        kind: "pose", "position", "planar-pose" (position in a plane and angle about its normal),
            "distance" (of the two tips) or "contact" (point and outward pad normal).
        finger: Name of the controlled finger.
        relative_to: Name of the finger whose contact frame expresses the target and which moves
            too (default: the base frame).
        axis: Normal of the plane of "planar-pose", in the frame of the target; None is the axis of
            the finger's last joint, with all joints at zero.

    Example:
        >>> ik.papers.ScrewTask("distance", "thumb", relative_to="finger_2").kind
        'distance'
    """

    kind: str
    finger: str
    relative_to: str | None = None
    axis: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.kind not in OBJECTIVES:
            raise UnknownNameError(
                f"task: unknown kind {self.kind!r}; expected one of {', '.join(OBJECTIVES)}"
            )
        if self.kind == "distance" and self.relative_to is None:
            raise InputError("task 'distance': relative_to: missing, expected the other finger")
        if self.axis is not None and not np.linalg.norm(self.axis) > 0:
            raise InputError(f"task {self.kind!r}: axis: found {self.axis}, expected a direction")

    def chain(self, robot: RobotDescription) -> TipChain:
        """Return the screws between the frame of the target and the tip.

        Raises:
            UnknownNameError: The finger does not exist.
            InputError: The finger is relative to itself.
        """
        if self.relative_to is None:
            return finger_chain(robot, self.finger)
        return relative_chain(robot, self.relative_to, self.finger)

    @property
    def target_fields(self) -> tuple[Field, ...]:
        """Fields of a target."""
        return OBJECTIVES[self.kind].target


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a task at a configuration.

    Attributes:
        error: (m, 1) desired minus current values [m, rad].
        jacobian: (m, k) Jacobian with respect to the k actuators that move the tip.
        linear: Number of leading rows that are lengths [m]; the others are angles [rad].
    """

    error: Expr
    jacobian: Expr
    linear: int


@dataclass(frozen=True, eq=False)
class Tip:
    """Kinematics of a fingertip in the frame of the target.

    Attributes:
        motion: Screws of the tip.
        normal: (3,) outward pad normal in the contact frame.
        axis: (3,) unit normal of the plane, in the frame of the target.
    """

    motion: TipMotion
    normal: ca.DM
    axis: ca.DM

    @property
    def point(self) -> Expr:
        """(3, 1) contact point [m]."""
        return dq.translation(self.motion.pose)

    @property
    def angular(self) -> Expr:
        """(3, k) angular velocity per unit velocity of each actuator."""
        return self.motion.jacobian[3:, :]

    @property
    def linear(self) -> Expr:
        """(3, k) velocity of the contact point per unit velocity of each actuator.

        The screws have the velocity v at the origin and the angular velocity w: v + w x p.
        """
        columns = ca.horzsplit(self.motion.jacobian)
        return ca.horzcat(*(twist[:3] + ca.cross(twist[3:], self.point) for twist in columns))

    @property
    def current_normal(self) -> Expr:
        """(3, 1) pad normal in the frame of the target."""
        return dq.rotate(self.motion.pose, self.normal)


def rows(task: ScrewTask, robot: RobotDescription, q: Expr, target: dict[str, Expr]) -> Rows:
    """Return a task's rows at q (n, 1) for a target given as the task's target fields."""
    return OBJECTIVES[task.kind].rows(tip(task, robot, q), target)


def values(task: ScrewTask, robot: RobotDescription, q: Expr) -> dict[str, Expr]:
    """Return the target that q (n, 1) meets, as the task's target fields."""
    fingertip = tip(task, robot, q)
    all_values = {
        "pose": fingertip.motion.pose,
        "point": fingertip.point,
        "normal": fingertip.current_normal,
        "distance": safe_norm(fingertip.point),
    }
    return {field.name: all_values[field.name] for field in task.target_fields}


def tip(task: ScrewTask, robot: RobotDescription, q: Expr) -> Tip:
    """Return the fingertip of a task with the actuators at q (n, 1)."""
    chain = task.chain(robot)
    axis = chain.chain.screws[-1].direction if task.axis is None else np.asarray(task.axis, float)
    normal = robot.finger(task.finger).normal
    return Tip(
        chain.evaluate(q), ca.DM(normal.tolist()), ca.DM((axis / np.linalg.norm(axis)).tolist())
    )


def _pose(tip: Tip, target: dict[str, Expr]) -> Rows:
    """Return all six rows of the paper: -log of the error, the twist of eq. (14)."""
    w, v = dq.control_twist(dq.error(tip.motion.pose, target["pose"]), 1.0)
    return Rows(ca.vertcat(v, w), tip.motion.jacobian, 3)


def _position(tip: Tip, target: dict[str, Expr]) -> Rows:
    return Rows(target["point"] - tip.point, tip.linear, 3)


def _planar_pose(tip: Tip, target: dict[str, Expr]) -> Rows:
    """Return the two coordinates in the plane and the angle about its normal.

    The row of the angle is exact if the tip rotates only about this normal, as that of a finger
    with parallel axes does; otherwise it is an approximation that vanishes at the target.
    """
    first = perpendicular(tip.axis)
    plane = ca.horzcat(first, ca.cross(tip.axis, first)).T
    w, _ = dq.control_twist(dq.error(tip.motion.pose, target["pose"]), 1.0)
    return Rows(
        ca.vertcat(plane @ (dq.translation(target["pose"]) - tip.point), ca.dot(tip.axis, w)),
        ca.vertcat(plane @ tip.linear, tip.axis.T @ tip.angular),
        2,
    )


def _distance(tip: Tip, target: dict[str, Expr]) -> Rows:
    length = safe_norm(tip.point)
    return Rows(target["distance"] - length, (tip.point / length).T @ tip.linear, 1)


def _contact(tip: Tip, target: dict[str, Expr]) -> Rows:
    """Return point and normal; the rotation about the normal is free."""
    normal = tip.current_normal
    tilting = tip.angular - normal @ (normal.T @ tip.angular)
    return Rows(
        ca.vertcat(target["point"] - tip.point, normal_error(normal, target["normal"])),
        ca.vertcat(tip.linear, tilting),
        3,
    )


@dataclass(frozen=True)
class Objective:
    """Equations of a kind of task.

    Attributes:
        target: Fields of the target.
        rows: Function that returns the rows for a tip and a target.
    """

    target: tuple[Field, ...]
    rows: Callable[[Tip, dict[str, Expr]], Rows]


POSE_FIELD = Field("pose", (8,), doc="desired pose of the tip, unit dual quaternion")
POINT_FIELD = Field("point", (3,), unit="m", doc="desired contact point")
NORMAL_FIELD = Field("normal", (3,), doc="desired outward pad normal, unit")
DISTANCE_FIELD = Field("distance", unit="m", doc="desired distance of the two contact points")

OBJECTIVES = {
    "pose": Objective((POSE_FIELD,), _pose),
    "position": Objective((POINT_FIELD,), _position),
    "planar-pose": Objective((POSE_FIELD,), _planar_pose),
    "distance": Objective((DISTANCE_FIELD,), _distance),
    "contact": Objective((POINT_FIELD, NORMAL_FIELD), _contact),
}
"""Equations by kind of task."""


PASSES = 6
"""Maximum number of changes of the active set; a hand has few sliders."""


@dataclass(frozen=True, eq=False)
class ScrewControlStep:
    """Step of a task for a robot.

    Attributes:
        robot: Description of the robot.
        task: The task.
    """

    robot: RobotDescription
    task: ScrewTask

    @cached_property
    def state(self) -> Layout:
        """State that a step passes to the next one."""
        return Layout((Field("q", (len(self.robot.actuators),)),))

    @cached_property
    def parameters(self) -> Layout:
        """Target and settings of the control law."""
        n = len(self.robot.actuators)
        return Layout(
            (
                *self.task.target_fields,
                Field("gain", doc="fraction of the error that a step removes"),
                Field(
                    "damping",
                    doc="damping of the least squares [unit of a singular value of the scaled J]",
                ),
                Field("centring", doc="fraction of the distance to mid-range in the null space"),
                Field("length", unit="m", doc="length with the weight of a radian"),
                Field("largest_step", (n,), unit="rad or m"),
                Field("resolution", (n,), unit="rad or m", doc="0: none"),
                Field("tolerance", doc="error norm below which the loop ends"),
            )
        )

    @cached_property
    def record(self) -> Layout:
        """Logged fields of a step; all values except `step_size` refer to its start."""
        return Layout.record(
            Q.for_robot(self.robot),
            Field("point", (3,), "f8", "m", "contact point in the frame of the target"),
            Field("error", (self._graph_rows,), "f8", "m, rad", "rows of the task"),
            Field("error_norm", (), "f8", "", "norm of the rows; of a pose Chandra eq. (17)"),
            STEP_SIZE.for_robot(self.robot, "largest actuator change of this step"),
            Field("sigma_task", (), "f4", "", "smallest singular value of the scaled Jacobian"),
            *coupling_fields(self.robot),
            LIMIT_MASK.for_robot(self.robot),
            STATUS.for_robot(self.robot),
        )

    @cached_property
    def _graph_rows(self) -> int:
        q, target = self._symbols()
        return rows(self.task, self.robot, q, target).error.numel()

    def _symbols(self) -> tuple[ca.SX, dict[str, ca.SX]]:
        layout = Layout(self.task.target_fields)
        return ca.SX.sym("q", len(self.robot.actuators)), layout.unpack(layout.symbols("target"))

    @cached_property
    def target_function(self) -> ca.Function:
        """Function that maps q to the fields of the target that q meets."""
        q, _ = self._symbols()
        fulfilled = values(self.task, self.robot, q)
        name = ca.Function.fix_name(f"screw_target_{self.robot.name}")
        return ca.Function(name, [q], [ca.densify(value) for value in fulfilled.values()])

    def graph(self) -> StepGraph:
        """Return the step graph."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        q, p = self.state.unpack(state)["q"], self.parameters.unpack(parameters)
        fingertip = tip(self.task, self.robot, q)
        moving = list(fingertip.motion.tip.actuators)
        objective = rows(self.task, self.robot, q, p)

        lower, upper = self.robot.lower[moving], self.robot.upper[moving]
        half_range, middle = ca.DM(0.5 * (upper - lower)), ca.DM(0.5 * (lower + upper))
        count = objective.error.numel()
        linear = objective.linear
        weights = ca.vertcat(*[1 / p["length"]] * linear, *[1.0] * (count - linear))
        jacobian = objective.jacobian * (weights @ half_range.T)
        reach = p["largest_step"][moving]
        low = ca.fmax(ca.DM(lower) - q[moving], -reach) / half_range
        high = ca.fmin(ca.DM(upper) - q[moving], reach) / half_range
        # The step s, relative to half ranges, is as near as possible to the centring step z. The
        # unknown is s - z, which starts at 0, so z must lie in the box.
        z = ca.fmin(ca.fmax(p["centring"] * (middle - q[moving]) / half_range, low), high)
        demand = p["gain"] * weights * objective.error
        box = BoxBounds(z, low, high, first=0)
        step = z + damped_step(jacobian, jacobian @ z - demand, p["damping"] ** 2, box, PASSES).step

        q_free = ca.SX(q)
        q_free[moving] = q[moving] + half_range * step
        grid = p["resolution"]
        spacing = ca.if_else(grid > 0, grid, 1.0)
        start = ca.DM(self.robot.lower.tolist())
        rounded = start + spacing * ca.floor((q_free - start) / spacing + 0.5)
        q_next = clamp_to_limits(self.robot, ca.if_else(grid > 0, rounded, q_free), 1.0)

        error_norm = safe_norm(objective.error)
        is_solved = error_norm <= p["tolerance"]
        status = ca.if_else(is_solved, float(Status.SOLVED), float(Status.RUNNING))
        next_state = self.state.pack({"q": ca.if_else(is_solved, q, q_next)})
        record = self.record.pack(
            {
                "q": q,
                "point": fingertip.point,
                "error": objective.error,
                "error_norm": error_norm,
                "step_size": ca.mmax(ca.fabs(q_next - q)),
                "sigma_task": ca.mmin(singular_values(jacobian)),
                **coupling_values(self.robot, q),
                "limit_mask": limit_mask(self.robot, q),
                "status": status,
            }
        )
        kind = self.task.kind.replace("-", "_")
        name = ca.Function.fix_name(f"screw_control_{kind}_{self.robot.name}")
        function = ca.Function(name, [state, parameters], with_cse(next_state, record, status))
        return StepGraph(name, function, self.state, self.parameters, self.record)

    def parameter_vector(self, target: dict[str, Any], numbers: dict[str, Any]) -> Array:
        """Return the parameter vector of a target and the settings of the control law."""
        return self.parameters.pack({**target, **numbers})
