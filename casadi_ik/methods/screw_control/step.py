"""One step of the screw control law, Chandra et al. 2019, eq. (14), in discrete time.

    q+ = q + gain J^+ e + (I - J^+ J) z,    e = -log(x_c x_d*) or a task's own rows,

as one small least-squares problem in a box: what minimises |J s - gain e|^2 plus a tiny
|s - z|^2, with q + s within the limits and no actuator faster than it can. Inside the box that is
the law above; at its walls the other actuators take over. z leads back to the middle of the ranges
and is all that a task leaves free. Every actuator is measured in halves of its range.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from casadi_ik.arrays import Array
from casadi_ik.kernels import Field, Layout, StepGraph
from casadi_ik.methods.common.bounded_step import Bounded, damped_step
from casadi_ik.methods.common.coupling_record import coupling_fields, coupling_values
from casadi_ik.methods.common.limits import kept_within, limit_mask
from casadi_ik.methods.screw_control.objectives import ScrewTask, rows, tip, values
from casadi_ik.problem.status import Status
from casadi_ik.problem.trace import LIMIT_MASK, STATUS, STEP_SIZE, Q
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.measures import singular_values
from casadi_ik.symbolic.smooth import safe_norm
from casadi_ik.symbolic.subexpressions import shared

PASSES = 6
"""Corrections of the active set; a hand has few sliders."""


@dataclass(frozen=True, eq=False)
class ScrewControlStep:
    """The step of one task on one robot.

    Attributes:
        robot: The description.
        task: What the tip is to do.
    """

    robot: RobotDescription
    task: ScrewTask

    @cached_property
    def state(self) -> Layout:
        """What a step hands to the next."""
        return Layout((Field("q", (len(self.robot.actuators),)),))

    @cached_property
    def parameters(self) -> Layout:
        """Target and numbers of the law."""
        n = len(self.robot.actuators)
        return Layout(
            (
                *self.task.target_fields,
                Field("gain", doc="part of the error that a step is to remove"),
                Field("damping", doc="unit of a singular value of J over half ranges"),
                Field("centring", doc="part of the way to mid-range that z is"),
                Field("length", unit="m", doc="length that counts as much as a radian"),
                Field("largest_step", (n,), unit="rad or m"),
                Field("resolution", (n,), unit="rad or m", doc="0: none"),
                Field("tolerance", doc="error norm below which the loop ends"),
            )
        )

    @cached_property
    def record(self) -> Layout:
        """What is logged of a step; everything but `step_size` is from before it."""
        return Layout.record(
            Q.of(self.robot),
            Field("point", (3,), "f8", "m", "contact point in the frame of the target"),
            Field("error", (self._graph_rows,), "f8", "m, rad", "rows of the task"),
            Field("error_norm", (), "f8", "", "norm of the rows; of a pose Chandra eq. (17)"),
            STEP_SIZE.of(self.robot, "largest actuator change of this step"),
            Field("sigma_task", (), "f4", "", "smallest singular value of the scaled Jacobian"),
            *coupling_fields(self.robot),
            LIMIT_MASK.of(self.robot),
            STATUS.of(self.robot),
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
        """The target that q fulfils: (q) -> fields of the task's target, in order."""
        q, _ = self._symbols()
        fulfilled = values(self.task, self.robot, q)
        name = ca.Function.fix_name(f"screw_target_{self.robot.name}")
        return ca.Function(name, [q], [ca.densify(value) for value in fulfilled.values()])

    def graph(self) -> StepGraph:
        """The whole step."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        q, p = self.state.unpack(state)["q"], self.parameters.unpack(parameters)
        seen = tip(self.task, self.robot, q)
        moving = list(seen.motion.tip.actuators)
        objective = rows(self.task, self.robot, q, p)

        lower, upper = self.robot.lower[moving], self.robot.upper[moving]
        half, middle = ca.DM(0.5 * (upper - lower)), ca.DM(0.5 * (lower + upper))
        count = objective.error.numel()
        linear = objective.linear
        weights = ca.vertcat(*[1 / p["length"]] * linear, *[1.0] * (count - linear))
        jacobian = objective.jacobian * (weights @ half.T)
        reach = p["largest_step"][moving]
        low = ca.fmax(ca.DM(lower) - q[moving], -reach) / half
        high = ca.fmin(ca.DM(upper) - q[moving], reach) / half
        # z itself has to lie in the box: the problem is posed in s - z, which starts at 0.
        z = ca.fmin(ca.fmax(p["centring"] * (middle - q[moving]) / half, low), high)
        demand = p["gain"] * weights * objective.error
        box = Bounded(z, low, high, first=0)
        step = z + damped_step(jacobian, jacobian @ z - demand, p["damping"] ** 2, box, PASSES).step

        moved = ca.SX(q)
        moved[moving] = q[moving] + half * step
        grid = p["resolution"]
        spacing = ca.if_else(grid > 0, grid, 1.0)
        start = ca.DM(self.robot.lower.tolist())
        rounded = start + spacing * ca.floor((moved - start) / spacing + 0.5)
        q_next = kept_within(self.robot, ca.if_else(grid > 0, rounded, moved), 1.0)

        error_norm = safe_norm(objective.error)
        reached = error_norm <= p["tolerance"]
        status = ca.if_else(reached, float(Status.SOLVED), float(Status.RUNNING))
        after = self.state.pack({"q": ca.if_else(reached, q, q_next)})
        record = self.record.pack(
            {
                "q": q,
                "point": seen.point,
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
        function = ca.Function(name, [state, parameters], shared(after, record, status))
        return StepGraph(name, function, self.state, self.parameters, self.record)

    def parameter_vector(self, target: dict[str, Any], numbers: dict[str, Any]) -> Array:
        """Parameters (np,) of a target and the law's numbers."""
        return self.parameters.pack({**target, **numbers})
