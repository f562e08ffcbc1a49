"""The methods of Qiu & Kermani 2021, each as one compiled loop.

The enhanced methods are those that the paper proposes: thumb reaching, then hand alignment. The
original methods are its baseline: all contacts in one hierarchy of tasks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Generic, TypeVar

import casadi as ca
import numpy as np

from casadi_ik.compile import StepGraph
from casadi_ik.compile.layout import Field
from casadi_ik.files.arrays import Array, Counts
from casadi_ik.kinematics.closed_chain import VIRTUAL, closed_chain, split
from casadi_ik.kinematics.contacts import contact_errors, goal_contacts, within_tolerance
from casadi_ik.kinematics.forward import actuated
from casadi_ik.kinematics.linear_algebra import condition_number, damped_pinv_times, singular_values
from casadi_ik.kinematics.smooth import Expr, safe_norm, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.papers.qiu.fingers import finger_step_function, planar_fingers
from casadi_ik.papers.qiu.step import OriginalParameters, QiuParameters, QiuStep
from casadi_ik.papers.qiu.tasks import (
    MILLIMETRE,
    Task,
    TaskSolver,
    combine,
    contact_tasks,
    damped,
    palm_motion,
    palm_orientation,
    palm_orientation_task,
    selective,
    thumb_first,
    weighted,
    weighted_damped,
)
from casadi_ik.solve.looped_method import (
    LoopedMethod,
    Start,
    clamp_to_limits,
    clip_starts,
    limit_mask,
)
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import STEP_SIZE, RecordedJacobian

NOT_MEASURED = float("nan")
"""Value of a measurement in iterations that do not compute it."""


class EnhancedStep(QiuStep[QiuParameters]):
    """Step graph of an enhanced method for one robot.

    Attributes:
        chain: Active and passive joints of the closed chain.
    """

    family, stage = "enhanced", "phase"

    def __init__(self, robot: RobotDescription, options: QiuParameters) -> None:
        """Lay out state, parameters and record.

        Raises:
            UnsupportedError: The robot does not have the structure that the method requires.
        """
        self.chain = split(robot, options.borrowed)
        self.compilable = options.finger_step != "ipopt"
        planar_fingers(robot)  # raises here rather than when the graph is built
        state = (
            Field("phase"),
            Field("least_error", doc="smallest summed error of thumb reaching so far"),
            Field("slow_iterations", doc="iterations since `least_error` decreased by 1 %"),
            Field("n_reaching", doc="number of iterations of thumb reaching"),
        )
        numbers = (
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
        measurements = (
            Field("palm_error", (), "f4", "rad", "palm orientation task error (phase 1)"),
            Field("palm_motion", (2,), "f4", "mm, rad", "palm motion demanded (phase 2)"),
            STEP_SIZE.for_robot(robot, "largest motor change of this iteration"),
            Field("sigma_thumb", (), "f4", "m", "smallest singular value, thumb point Jacobian"),
            Field("sigma_palm", (), "f4", "", "smallest singular value, palm task (phase 1)"),
            Field("sigma_closed_chain", (), "f4", "", "smallest singular value of H_p (phase 2)"),
            Field("condition_closed_chain", (), "f4", "", "condition number of H_p (phase 2)"),
        )
        super().__init__(robot, options, state, numbers, measurements)

    @property
    def jacobians(self) -> dict[str, RecordedJacobian]:
        """Jacobians in the record.

        The thresholds of singularity are not from the paper. Beyond them a metre of the thumb's tip
        requires more than 20 rad of a joint, a radian of the palm more than 2 rad, and a radian of
        the platform more than 100 rad of the passive joints. H_p has lengths in millimetres, so its
        condition number is above 400 everywhere.
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

    def parameter_values(self, targets: TargetBatch) -> dict[str, float | list[float] | Array]:
        """Return the values of all parameter fields for a batch."""
        options = self.options
        weights = [
            options.virtual_weight if column == VIRTUAL else options.joint_weight
            for column in self.chain.active
        ]
        return super().parameter_values(targets) | {"weights": weights}

    def first_state(self, starts: Array) -> dict[str, float | Array]:
        """Return the values of all state fields for starts (k, n)."""
        largest = float(np.finfo(float).max)
        initial = {
            "phase": float(Phase.THUMB_REACHING),
            "least_error": largest,
            "slow_iterations": 0.0,
            "n_reaching": 0.0,
        }
        return super().first_state(starts) | initial

    def row(
        self, q: Expr, positions: Expr, angles: Expr, *, phase: Phase, **measurements: Expr
    ) -> ca.SX:
        """Return the log record of an iteration.

        Args:
            q: (n, 1) configuration that the record describes.
            positions: (f, 1) position errors [m].
            angles: (f, 1) angle errors [rad].
            phase: Phase of the iteration.
            measurements: Further fields that the phase defines.
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
        return self.record.pack(values | measurements)

    def _iteration(self) -> ca.Function:
        """Return the graph of an iteration: the finger step, then the graph of the phase."""
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        fingers = finger_step_function(self.robot, self.options.finger_step)
        palm_targets = self._palm_view()(state, parameters)
        closed = fingers(state[self.state.slice("q")], *palm_targets)
        align = ca.Function(
            "align", [state, parameters], list(self._align()(state, parameters, closed))
        )
        choose = ca.Function.if_else("phase", self._reach(), align)
        in_reaching = state[self.state.slice("phase")] < Phase.HAND_ALIGNMENT
        outputs = choose(in_reaching, state, parameters)
        return ca.Function(self._name, [state, parameters], list(outputs))

    def _palm_view(self) -> ca.Function:
        """Return the graph of the targets of the other fingers in the palm frame, for eq. (5)."""
        state, parameters, s, p = self._inputs()
        palm = actuated(self.robot, s["q"]).kinematics.palm
        goals = [
            goal for name, goal in goal_contacts(self.robot, p).items() if name != self.robot.thumb
        ]
        points = ca.horzcat(*(palm.inverse_apply(goal.point) for goal in goals))
        normals = ca.horzcat(*(palm.rotation.T @ goal.normal for goal in goals))
        return ca.Function("palm_view", [state, parameters], [points, normals])

    def _reach(self) -> ca.Function:
        """Return the graph of thumb reaching (section II-B)."""
        state, parameters, s, p = self._inputs()
        robot, body, goals = self.robot, actuated(self.robot, s["q"]), goal_contacts(self.robot, p)
        columns = robot.arm_actuators + robot.finger_actuators(robot.thumb)
        palm = palm_orientation_task(
            body, palm_orientation(robot, goals), columns, self.options.palm_error == "euler"
        )
        position, normal = contact_tasks(body, robot.thumb, goals[robot.thumb], columns)
        tasks = [palm, position, normal] if self.options.palm_task else [position, normal]
        step = self._expand_step(self._combined(tasks, self._reaching(p)), columns)
        q_next = self._step_within_limits(s["q"], step, p)

        positions, angles = contact_errors(body.kinematics, goals, robot.finger_names)
        thumb = robot.finger_names.index(robot.thumb)
        # In units of the thumb's tolerances, so that they can be summed.
        errors = ca.vertcat(
            positions[thumb] / p["position_tolerance"][thumb],
            angles[thumb] / p["angle_tolerance"][thumb],
        )
        if self.options.palm_task:
            errors = ca.vertcat(errors, safe_norm(palm.error) / p["angle_tolerance"][thumb])
        is_met, summed_error = ca.mmax(errors) <= 1, ca.sum1(errors)
        is_gain = summed_error < 0.99 * s["least_error"]
        slow_iterations = ca.if_else(is_gain, 0.0, s["slow_iterations"] + 1)
        is_limit_reached = ca.logic_or(
            slow_iterations >= p["reaching_patience"],
            s["n_reaching"] + 1 >= p["reaching_iterations"],
        )
        is_finished = ca.logic_or(is_met, is_limit_reached)
        new_state = self.state.pack(
            {
                "q": ca.if_else(is_met, s["q"], q_next),
                "phase": ca.if_else(is_finished, float(Phase.HAND_ALIGNMENT), s["phase"]),
                "least_error": ca.if_else(is_gain, summed_error, s["least_error"]),
                "slow_iterations": ca.if_else(is_finished, 0.0, slow_iterations),
                "n_reaching": s["n_reaching"] + 1,
            }
        )
        status = ca.SX(float(Status.RUNNING))
        record = self.row(
            s["q"],
            positions,
            angles,
            step_size=_largest(q_next - s["q"]),
            status=status,
            phase=Phase.THUMB_REACHING,
            palm_error=safe_norm(palm.error),
            sigma_thumb=_smallest(position.jacobian) * MILLIMETRE,
            sigma_palm=_smallest(palm.jacobian[:, : len(robot.arm_actuators)]),
        )
        return ca.Function("reach", [state, parameters], with_cse(new_state, record, status))

    def _align(self) -> ca.Function:
        """Return the graph of hand alignment (section II-C), after the finger step.

        Its inputs are state, parameters, and the configuration `closed` after the finger step.
        """
        state, parameters, s, p = self._inputs()
        closed = ca.SX.sym("closed", len(self.robot.actuators))
        robot, body, goals = self.robot, actuated(self.robot, closed), goal_contacts(self.robot, p)
        positions, angles = contact_errors(body.kinematics, goals, robot.finger_names)
        solved = within_tolerance(positions, angles, p["position_tolerance"], p["angle_tolerance"])

        other_goals = {name: goal for name, goal in goals.items() if name != robot.thumb}
        translation, rotation = palm_motion(body, other_goals)
        chain = closed_chain(body, self.chain, MILLIMETRE, self.options.platform)
        q_after_chain = closed
        if self.options.closed_chain:
            motion = self._palm_tasks(chain.J_cc, translation, rotation, p)
            active = self._combined(motion, self._chain_solver(p))
            q_after_chain = self._step_within_limits(
                closed, chain.motor_steps(active, closed.numel()), p
            )

        columns = robot.arm_actuators + robot.finger_actuators(robot.thumb)
        # The thumb returns to its contact.
        thumb_tasks = contact_tasks(
            actuated(robot, q_after_chain), robot.thumb, goals[robot.thumb], columns
        )
        step = self._expand_step(self._combined(thumb_tasks, self._reaching(p)), columns)
        q_next = self._step_within_limits(q_after_chain, step, p)

        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        new_state = self.state.pack(s | {"q": ca.if_else(solved, closed, q_next)})
        thumb_linear, _ = body.contact_jacobian(robot.thumb, columns)
        spectrum = singular_values(chain.H_p)
        record = self.row(
            closed,
            positions,
            angles,
            step_size=_largest(q_next - s["q"]),
            status=status,
            phase=Phase.HAND_ALIGNMENT,
            palm_motion=ca.vertcat(safe_norm(translation), safe_norm(rotation)),
            sigma_thumb=_smallest(thumb_linear),
            sigma_closed_chain=ca.mmin(spectrum),
            condition_closed_chain=condition_number(spectrum),
        )
        return ca.Function(
            "align_rest", [state, parameters, closed], with_cse(new_state, record, status)
        )

    def _palm_tasks(
        self, J_cc: ca.SX, translation: ca.SX, rotation: ca.SX, p: dict[str, ca.SX]
    ) -> list[Task]:
        """Return the tasks of the closed chain: position and orientation, or both as one."""
        if self.options.chain_tasks == "successive":
            return [
                Task(J_cc[:3, :], translation, is_position=True),
                Task(J_cc[3:, :], rotation, is_position=False),
            ]
        lever = p["chain_lever"]
        stacked = ca.vertcat(J_cc[:3, :], lever * J_cc[3:, :])
        return [Task(stacked, ca.vertcat(translation, lever * rotation), is_position=True)]

    def _combined(self, tasks: Sequence[Task], solve: TaskSolver) -> ca.SX:
        """Return one step for all tasks by successive projection, as in the paper."""
        return combine(tasks, [solve(task) for task in tasks], "successive")

    def _reaching(self, p: dict[str, ca.SX]) -> TaskSolver:
        """Return the solver of the tasks of the serial chain."""
        if self.options.steps == "dls":
            return damped(p["reaching_damping"])
        return selective(p["reaching_gamma"], p["longest_error"], p["widest_error"])

    def _chain_solver(self, p: dict[str, ca.SX]) -> TaskSolver:
        """Return the weighted solver of the tasks of the closed chain."""
        if self.options.steps == "dls":
            return weighted_damped(p["chain_damping"], p["weights"])
        solver = selective(p["chain_gamma"], p["longest_error"], p["widest_error"])
        return weighted(solver, p["weights"])

    def _expand_step(self, step: ca.SX, columns: tuple[int, ...]) -> ca.SX:
        """Return a step of some actuators as a step of all (n, 1)."""
        full = ca.SX.zeros(len(self.robot.actuators), 1)
        for i, column in enumerate(columns):
            full[column] = step[i]
        return full

    def _step_within_limits(self, q: ca.SX, step: ca.SX, p: dict[str, ca.SX]) -> ca.SX:
        """Return q after a step, capped and clipped to enforced limits."""
        q_next = q + step * ca.fmin(1.0, p["step_cap"] / ca.fmax(_largest(step), 1e-12))
        return clamp_to_limits(self.robot, q_next, p["enforce_limits"])


def _smallest(jacobian: ca.SX) -> ca.SX:
    return ca.mmin(singular_values(jacobian))


def _largest(step: ca.SX) -> ca.SX:
    """Return the largest change of any motor."""
    return ca.mmax(ca.fabs(step))


class OriginalStep(QiuStep[OriginalParameters]):
    """Step graph of an original method for one robot.

    The solution of a task is a called function, because inlined copies slow the C compiler down. It
    operates only on the columns of the actuators that move the task.
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
        step_size = STEP_SIZE.for_robot(robot, "largest motor change of this iteration")
        super().__init__(robot, options, (), numbers, (step_size,))

    def _iteration(self) -> ca.Function:
        state = ca.MX.sym("state", self.state.size)
        parameters = ca.MX.sym("parameters", self.parameters.size)
        errors, *pairs = self._view()(state, parameters)
        if self.options.projection == "stacked":
            step = self._stacked()(parameters, *pairs)
        else:
            # Instruction fetch limits the speed, so tasks of the same size share a function.
            sizes = {len(columns) for _, columns in self._kinds}
            solve = {size: self._solve(size) for size in sorted(sizes)}
            slice_of = self.parameters.slice
            longest = {True: slice_of("longest_error"), False: slice_of("widest_error")}
            steps = [
                solve[len(columns)](parameters, parameters[longest[is_position]], pair)
                for (is_position, columns), pair in zip(self._kinds, pairs, strict=True)
            ]
            step = self._combined()(*pairs, *steps)
        outputs = self._ending()(state, parameters, errors, step)
        return ca.Function(self._name, [state, parameters], list(outputs))

    @cached_property
    def _kinds(self) -> list[tuple[bool, tuple[int, ...]]]:
        """(is a position, actuators that move the task) of each task in order of priority."""
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
        """Return ``(state, parameters) -> (errors, task, task, ...)``.

        The errors (f, 2) are those of points [m] and normals [rad] of all fingers. The tasks follow
        by decreasing priority, each as a pair [J, e] (3, k + 1) of the Jacobian with respect to the
        k actuators that move the task, and its error.
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
        task_pairs = [ca.densify(ca.horzcat(task.jacobian, task.error)) for task in tasks]
        return ca.Function("view", [state, parameters], with_cse(errors, *task_pairs))

    def _solve(self, count: int) -> ca.Function:
        """Return the graph of the step of one task by the actuators that move it.

        SDLS limits errors to `longest`; DLS ignores it.
        """
        _, parameters, _, p = self._inputs()
        longest, pair = ca.SX.sym("longest"), ca.SX.sym("pair", 3, count + 1)
        if self.options.steps == "dls":
            solver = damped(p["damping"])
        else:
            solver = selective(p["gamma"], longest, longest)
        step = solver(Task(pair[:, :-1], pair[:, -1], is_position=True))
        return ca.Function(f"solve_{count}", [parameters, longest, pair], with_cse(step))

    def _pairs(self) -> tuple[list[ca.SX], list[Task]]:
        """Return symbols of all [J, e], and the tasks over all actuators that they define."""
        n, pairs, tasks = len(self.robot.actuators), [], []
        for i, (is_position, columns) in enumerate(self._kinds):
            pair = ca.SX.sym(f"pair_{i}", 3, len(columns) + 1)
            pairs.append(pair)
            tasks.append(Task(_expand_columns(pair[:, :-1], columns, n), pair[:, -1], is_position))
        return pairs, tasks

    def _stacked(self) -> ca.Function:
        """Return the graph of one step for all tasks without priorities."""
        _, parameters, _, p = self._inputs()
        pairs, tasks = self._pairs()
        J = ca.vertcat(*(task.jacobian for task in tasks))
        e = ca.vertcat(*(task.error for task in tasks))
        step = damped_pinv_times(ca.densify(J), e, p["damping"])
        return ca.Function("stacked", [parameters, *pairs], with_cse(step))

    def _combined(self) -> ca.Function:
        """Return the graph that combines the steps of all tasks."""
        n, (pairs, tasks) = len(self.robot.actuators), self._pairs()
        step_symbols, steps = [], []
        for i, (_, columns) in enumerate(self._kinds):
            step_symbols.append(ca.SX.sym(f"step_{i}", len(columns)))
            steps.append(_expand_columns(step_symbols[i].T, columns, n).T)
        damping = self.options.damping if self.options.projectors == "damped" else None
        step = ca.densify(combine(tasks, steps, self.options.projection, damping))
        return ca.Function("combined", [*pairs, *step_symbols], with_cse(step))

    def _ending(self) -> ca.Function:
        """Return the graph that takes the step or ends the solve."""
        state, parameters, s, p = self._inputs()
        errors = ca.SX.sym("errors", len(self.robot.fingers), 2)
        step = ca.SX.sym("step", len(self.robot.actuators))
        robot, q, positions, angles = self.robot, s["q"], errors[:, 0], errors[:, 1]
        solved = within_tolerance(positions, angles, p["position_tolerance"], p["angle_tolerance"])
        q_next = clamp_to_limits(robot, q + step, p["enforce_limits"])
        status = ca.if_else(solved, float(Status.SOLVED), float(Status.RUNNING))
        new_state = self.state.pack({"q": ca.if_else(solved, q, q_next)})
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
            "ending", [state, parameters, errors, step], with_cse(new_state, record, status)
        )


def _expand_columns(matrix: ca.SX, columns: tuple[int, ...], n: int) -> ca.SX:
    """Return a matrix (r, k) as the given columns of one with n, the others structurally zero."""
    wide = ca.SX(matrix.shape[0], n)
    wide[:, list(columns)] = matrix
    return wide


Step = TypeVar("Step", EnhancedStep, OriginalStep)


class _QiuMethod(LoopedMethod, Generic[Step]):
    """Base class of the methods of the paper: one step graph, started at q0.

    Attributes:
        step: Step of this robot.
    """

    step: Step

    def step_graph(self) -> StepGraph:
        """Return the step graph."""
        return self.step.graph()

    def begin(self, targets: TargetBatch) -> Start:
        """Return initial states at the starts, clipped to enforced limits."""
        step, count = self.step, len(targets)
        first = step.first_state(clip_starts(self.robot, targets))
        states = step.state.pack_rows(first, count)
        return states, step.parameters.pack_rows(step.parameter_values(targets), count)


class EnhancedMethod(_QiuMethod[EnhancedStep]):
    """`enhanced-*`: thumb reaching, then hand alignment along the arm-thumb closed chain.

    The step runs in the virtual machine if the finger step uses Ipopt.
    """

    def __init__(
        self, robot: RobotDescription, options: QiuParameters, compiled: bool = True
    ) -> None:
        """Lay out the step and set the maximum number of iterations."""
        super().__init__(robot, options, compiled)
        self.name = f"enhanced-{options.steps}"
        robot.require_single_hand(self.name)
        self.step = EnhancedStep(robot, options)
        self.max_iterations = options.max_iterations

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Return the iterations by phase; those after thumb reaching are hand alignment."""
        reaching_iterations = states[:, self.step.state.slice("n_reaching").start].astype(
            iterations.dtype
        )
        return {
            Phase.THUMB_REACHING: reaching_iterations,
            Phase.HAND_ALIGNMENT: iterations - reaching_iterations,
        }

    @property
    def jacobians(self) -> Mapping[str, RecordedJacobian]:
        """Jacobians of thumb, palm and closed chain."""
        return self.step.jacobians


class OriginalMethod(_QiuMethod[OriginalStep]):
    """`original-*`: all contacts in one hierarchy, the baseline of the paper."""

    def __init__(
        self, robot: RobotDescription, options: OriginalParameters, compiled: bool = True
    ) -> None:
        """Lay out the step and set the maximum number of iterations."""
        super().__init__(robot, options, compiled)
        self.name = f"original-{options.steps}"
        robot.require_single_hand(self.name)
        self.step = OriginalStep(robot, options)
        self.max_iterations = options.max_iterations

    def phase_counts(self, states: Array, iterations: Counts) -> Mapping[Phase, Counts]:
        """Return the iterations of the single phase."""
        del states
        return {Phase.HIERARCHY: iterations.copy()}
