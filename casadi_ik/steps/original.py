"""The original methods of Qiu & Kermani 2021's comparison: all contacts in one hierarchy."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.kernels.step_graph import StepGraph
from casadi_ik.robots.description import Array, RobotDescription
from casadi_ik.steps.hierarchy import combine
from casadi_ik.steps.limits import kept_within, limit_mask
from casadi_ik.steps.palm_estimate import palm_orientation, thumb_first
from casadi_ik.steps.qiu_parameters import OriginalParameters
from casadi_ik.steps.status import Phase, Status
from casadi_ik.steps.targets import contact_errors, target_fields, targets, within_tolerance
from casadi_ik.steps.tasks import (
    Task,
    TaskSolver,
    contact_tasks,
    damped,
    palm_orientation_task,
    selective,
)
from casadi_ik.symbolic.actuated import ActuatedKinematics, actuated
from casadi_ik.symbolic.subexpressions import shared


class OriginalStep:
    """Builds the step graph of an original method for one robot.

    Attributes:
        options: The structural choices; numbers are parameters of the graph.
        state: Layout of the state.
        parameters: Layout of the parameters.
        record: Layout of the record: q and its errors before the step.
    """

    def __init__(self, robot: RobotDescription, options: OriginalParameters) -> None:
        """Lay out state, parameters and record."""
        n, f = len(robot.actuators), len(robot.fingers)
        self.robot = robot
        self.options = options
        self.state = Layout((Field("q", (n,)), Field("waited", doc="iterations standing still")))
        self.parameters = Layout(
            (
                *target_fields(robot),
                Field("enforce_limits", doc="1: q is kept within its limits, 0: it is not"),
                Field("damping"),
                Field("gamma"),
                Field("longest_error", unit="mm"),
                Field("widest_error", unit="rad"),
                Field("stall_step"),
                Field("stall_patience"),
            )
        )
        self.record = Layout.record(
            Field("q", (n,), "f8", "rad or m", "actuator positions"),
            Field("position_error", (f,), "f4", "m", "distance of every finger from its contact"),
            Field("angle_error", (f,), "f4", "rad", "angle of every finger from its normal"),
            Field("step_size", (), "f4", "rad or m", "largest motor change of this iteration"),
            Field("limit_mask", (), "u4", "", "bit i: actuator i at or beyond a limit"),
            Field("phase", (), "u1"),
            Field("status", (), "u1", "", "0 running, else the final status"),
        )

    def graph(self) -> StepGraph:
        """The whole iteration."""
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self.parameters.unpack(parameters)
        robot, q = self.robot, s["q"]
        body, goals = actuated(robot, q), targets(robot, p)
        positions, angles = contact_errors(body.kinematics, goals, robot.finger_names)
        solved = within_tolerance(positions, angles, p)
        step = combine(self._tasks(body, p), self._solver(p), self.options.projection)
        q_next = kept_within(robot, q + step, p["enforce_limits"])
        size = ca.mmax(ca.fabs(q_next - q))
        waited = ca.if_else(size < p["stall_step"], s["waited"] + 1, 0.0)
        still = ca.if_else(
            waited >= p["stall_patience"], float(Status.STALLED), float(Status.RUNNING)
        )
        status = ca.if_else(solved, float(Status.SOLVED), still)
        after = self.state.pack(
            {"q": ca.if_else(status == Status.RUNNING, q_next, q), "waited": waited}
        )
        record = self.record.pack(
            {
                "q": q,
                "position_error": positions,
                "angle_error": angles,
                "step_size": size,
                "limit_mask": limit_mask(robot, q),
                "phase": float(Phase.HIERARCHY),
                "status": status,
            }
        )
        name = ca.Function.fix_name(f"original_{self.options.steps}_{robot.name}")
        function = ca.Function(name, [state, parameters], shared(after, record, status))
        return StepGraph(name, function, self.state, self.parameters, self.record)

    def parameter_values(
        self, position_tolerance: Array, angle_tolerance: Array, enforce_limits: bool
    ) -> dict[str, float | Array]:
        """Values of all parameter fields but the targets."""
        options = self.options
        return {
            "position_tolerance": position_tolerance,
            "angle_tolerance": angle_tolerance,
            "enforce_limits": float(enforce_limits),
            "damping": options.damping,
            "gamma": options.gamma,
            "longest_error": options.longest_error,
            "widest_error": options.widest_error,
            "stall_step": options.stall_step,
            "stall_patience": float(options.stall_patience),
        }

    def first_state(self) -> dict[str, float]:
        """Values of all state fields but q."""
        return {"waited": 0.0}

    def phase_counts(
        self, states: Array, iterations: NDArray[np.int64]
    ) -> dict[Phase, NDArray[np.int64]]:
        """Iterations by phase (k,): there is but one."""
        del states
        return {Phase.HIERARCHY: iterations}

    def _tasks(self, body: ActuatedKinematics, p: dict[str, ca.SX]) -> list[Task]:
        """From the highest priority to the lowest."""
        robot, goals = self.robot, targets(self.robot, p)
        every = tuple(range(len(robot.actuators)))
        pairs = [contact_tasks(body, name, goals[name], every) for name in thumb_first(robot)]
        if self.options.order == "per-finger":
            tasks = [task for pair in pairs for task in pair]
        else:
            tasks = [point for point, _ in pairs] + [normal for _, normal in pairs]
        if self.options.palm_task:
            euler = self.options.palm_error == "euler"
            desired = palm_orientation(robot, goals)
            tasks.insert(0, palm_orientation_task(body, desired, every, euler))
        return tasks

    def _solver(self, p: dict[str, ca.SX]) -> TaskSolver:
        if self.options.steps == "dls":
            return damped(p["damping"])
        return selective(p["gamma"], p["longest_error"], p["widest_error"])
