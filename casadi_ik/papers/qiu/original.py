"""The original methods of Qiu & Kermani 2021's comparison: all contacts in one hierarchy."""

from __future__ import annotations

from functools import cached_property

import casadi as ca

from casadi_ik.kernels.layout import Field
from casadi_ik.methods.common.limits import kept_within, limit_mask
from casadi_ik.papers.qiu.parameters import OriginalParameters
from casadi_ik.papers.qiu.step import QiuStep
from casadi_ik.papers.qiu.tasks import (
    Task,
    combine,
    contact_tasks,
    damped,
    palm_orientation,
    palm_orientation_task,
    selective,
    thumb_first,
)
from casadi_ik.problem.contacts import contact_errors, goal_contacts, within_tolerance
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trace import STEP_SIZE
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.kinematics import actuated
from casadi_ik.symbolic.linear_algebra import damped_pinv_times
from casadi_ik.symbolic.smooth import shared


class OriginalStep(QiuStep[OriginalParameters]):
    """Builds the step graph of an original method for one robot.

    What repeats, the solving of a task, is a function that is called: written out once per task it
    made the C compiler slow. Only the columns of the actuators that move a task are worked on.
    """

    family = "original"

    def __init__(self, robot: RobotDescription, options: OriginalParameters) -> None:
        """Lay out state, parameters and record."""
        numbers = (
            Field("damping"),
            Field("gamma"),
            Field("longest_error", unit="mm"),
            Field("widest_error", unit="rad"),
        )
        moved = STEP_SIZE.of(robot, "largest motor change of this iteration")
        super().__init__(robot, options, (), numbers, (moved,))

    def _iteration(self) -> ca.Function:
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        errors, *pairs = self._view()(state, parameters)
        if self.options.projection == "stacked":
            step = self._stacked()(parameters, *pairs)
        else:
            # Instruction fetch bounds an iteration: tasks of one size share one function.
            sizes = {len(columns) for _, columns in self._kinds}
            solve = {size: self._solve(size) for size in sorted(sizes)}
            place = self.parameters.slice
            longest = {True: place("longest_error"), False: place("widest_error")}
            steps = [
                solve[len(columns)](parameters, parameters[longest[is_position]], pair)
                for (is_position, columns), pair in zip(self._kinds, pairs, strict=True)
            ]
            step = self._combined()(*pairs, *steps)
        outputs = self._ending()(state, parameters, errors, step)
        return ca.Function(self._name, [state, parameters], list(outputs))

    @cached_property
    def _kinds(self) -> list[tuple[bool, tuple[int, ...]]]:
        """Of every task by priority, whether it is a position, and the actuators that move it."""
        robot, arm = self.robot, self.robot.arm_actuators
        movers = [(*arm, *robot.finger_actuators(name)) for name in thumb_first(robot)]
        if self.options.order == "per-finger":
            kinds = [(kind, columns) for columns in movers for kind in (True, False)]
        else:
            kinds = [(kind, columns) for kind in (True, False) for columns in movers]
        return [(False, arm), *kinds] if self._turns_palm else kinds

    @property
    def _turns_palm(self) -> bool:
        return self.options.palm_task and bool(self.robot.arm_actuators)

    def _view(self) -> ca.Function:
        """Errors (f, 2) of all fingers in point and normal, then all tasks by priority.

        A task is its Jacobian over the actuators that move it, and its error, [J, e] (3, k + 1).
        """
        state, parameters, s, p = self._inputs()
        robot, goals, body = self.robot, goal_contacts(self.robot, p), actuated(self.robot, s["q"])
        arm = robot.arm_actuators
        pairs = [
            contact_tasks(body, name, goals[name], (*arm, *robot.finger_actuators(name)))
            for name in thumb_first(robot)
        ]
        if self.options.order == "per-finger":
            tasks = [task for pair in pairs for task in pair]
        else:
            tasks = [point for point, _ in pairs] + [normal for _, normal in pairs]
        if self._turns_palm:
            euler = self.options.palm_error == "euler"
            desired = palm_orientation(robot, goals)
            tasks.insert(0, palm_orientation_task(body, desired, arm, euler))
        errors = ca.horzcat(*contact_errors(body.kinematics, goals, robot.finger_names))
        seen = [ca.densify(ca.horzcat(task.jacobian, task.error)) for task in tasks]
        return ca.Function("view", [state, parameters], shared(errors, *seen))

    def _solve(self, count: int) -> ca.Function:
        """The step of one task alone over the actuators that move it, errors not above `longest`.

        SDLS needs that, DLS does not look at it.
        """
        _, parameters, _, p = self._inputs()
        longest, pair = ca.SX.sym("longest"), ca.SX.sym("pair", 3, count + 1)
        if self.options.steps == "dls":
            solver = damped(p["damping"])
        else:
            solver = selective(p["gamma"], longest, longest)
        step = solver(Task(pair[:, :-1], pair[:, -1], is_position=True))
        return ca.Function(f"solve_{count}", [parameters, longest, pair], shared(step))

    def _pairs(self) -> tuple[list[ca.SX], list[Task]]:
        """Symbols of all [J, e], and the tasks over all actuators that they stand for."""
        n, pairs, tasks = len(self.robot.actuators), [], []
        for i, (is_position, columns) in enumerate(self._kinds):
            pair = ca.SX.sym(f"pair_{i}", 3, len(columns) + 1)
            pairs.append(pair)
            tasks.append(Task(_spread(pair[:, :-1], columns, n), pair[:, -1], is_position))
        return pairs, tasks

    def _stacked(self) -> ca.Function:
        """One step for all tasks as one, without priorities."""
        _, parameters, _, p = self._inputs()
        pairs, tasks = self._pairs()
        J = ca.vertcat(*(task.jacobian for task in tasks))
        e = ca.vertcat(*(task.error for task in tasks))
        step = damped_pinv_times(ca.densify(J), e, p["damping"])
        return ca.Function("stacked", [parameters, *pairs], shared(step))

    def _combined(self) -> ca.Function:
        """One step from those of all tasks."""
        n, (pairs, tasks) = len(self.robot.actuators), self._pairs()
        given, steps = [], []
        for i, (_, columns) in enumerate(self._kinds):
            given.append(ca.SX.sym(f"step_{i}", len(columns)))
            steps.append(_spread(given[i].T, columns, n).T)
        damping = self.options.damping if self.options.projectors == "damped" else None
        step = ca.densify(combine(tasks, steps, self.options.projection, damping))
        return ca.Function("combined", [*pairs, *given], shared(step))

    def _ending(self) -> ca.Function:
        """Take the step, or end."""
        state, parameters, s, p = self._inputs()
        errors = ca.SX.sym("errors", len(self.robot.fingers), 2)
        step = ca.SX.sym("step", len(self.robot.actuators))
        robot, q, positions, angles = self.robot, s["q"], errors[:, 0], errors[:, 1]
        solved = within_tolerance(positions, angles, p["position_tolerance"], p["angle_tolerance"])
        q_next = kept_within(robot, q + step, p["enforce_limits"])
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        after = self.state.pack({"q": ca.if_else(solved, q, q_next)})
        record = self.record.pack(
            {
                "q": q,
                "position_error": positions,
                "angle_error": angles,
                "step_size": ca.mmax(ca.fabs(q_next - q)),
                "limit_mask": limit_mask(robot, q),
                "phase": float(Phase.HIERARCHY),
                "status": status,
            }
        )
        return ca.Function(
            "ending", [state, parameters, errors, step], shared(after, record, status)
        )


def _spread(matrix: ca.SX, columns: tuple[int, ...], n: int) -> ca.SX:
    """A matrix (r, k) as the given columns of one with n, the others structurally zero."""
    wide = ca.SX(matrix.shape[0], n)
    wide[:, list(columns)] = matrix
    return wide
