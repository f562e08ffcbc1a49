"""The method `ipopt`: the arm-hand as one nonlinear program, a slow reference.

Ipopt solves the program from q0 and then from random starts.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.compile.cancellation import (
    ForkSafeLock,
    interrupt_afterwards,
    is_cancelled,
    stop_if_cancelled,
)
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contact_fit import contact_residual
from casadi_ik.kinematics.contacts import LENGTH, ContactRows, Kinds, point_normal_kinds
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.looped_method import clip_starts
from casadi_ik.solve.method import Method, Outcome
from casadi_ik.solve.status import Phase, Status
from casadi_ik.solve.trace import (
    ANGLE_ERROR,
    COST,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    STATUS,
    STEP_SIZE,
    JacobianMeasures,
    Q,
    TraceFormat,
    pack_mask,
    trace_format,
)


@dataclass(frozen=True)
class IpoptParameters:
    """Parameters of the method `ipopt`.

    Attributes:
        restarts: Maximum number of random starts within the limits after the start from q0.
            Source: of 150 targets with every joint within 1 deg of a limit, 10 restarts missed 11
            (local minima), 30 missed one, 46 none; 9 sufficed for 750 other targets.
        max_iterations: Maximum number of Ipopt iterations per start.
        optimality: Tolerance ``tol`` of Ipopt on its scaled optimality error. The error of the
            contacts is about its square root if a coordinate is at a bound.
    """

    restarts: int = 50
    max_iterations: int = 300
    optimality: float = 1e-14

    def __post_init__(self) -> None:
        for name, smallest in (("restarts", 0), ("max_iterations", 1)):
            value = getattr(self, name)
            if not (isinstance(value, int) and not isinstance(value, bool) and value >= smallest):
                raise InputError(f"{name}: found {value!r}, expected an integer >= {smallest}")
        value = self.optimality
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and value > 0):
            raise InputError(f"optimality: found {value!r}, expected a number > 0")


def contact_errors(contacts: ContactRows, residuals: Array) -> tuple[Array, Array]:
    """Return distances [m] and angles [rad] (k, f) of residuals (k, r); zero where free."""
    parts = [residuals[:, rows] for rows in contacts.slices]
    lengths = np.stack([np.linalg.norm(part, axis=1) for part in parts], axis=1)
    f = len(contacts.kinds)
    return lengths[:, :f] * LENGTH, 2 * np.arcsin(np.minimum(lengths[:, f:] / 2, 1.0))


WARM_START_COST = 0.1
"""Cost below which a start is near a solution, so that Ipopt is warm-started."""

COLD_BARRIER, WARM_BARRIER = 0.1, 1e-11
"""Initial barrier parameters mu of cold and warm starts."""

PROXIMITY_WEIGHT = 1e-8
"""Weight of the distance from a warm start: it acts only along the self-motion of the arm, where
the barrier would otherwise draw the arm to the centre of its range."""

BOUND_PUSH = 1e-8
"""Distance by which a start at a bound is moved inside, relative to the range (or the value)."""


@dataclass(frozen=True, eq=False)
class NlpRun:
    """Run from one start; one row per iteration, the start first.

    Attributes:
        q: (n,) final configuration, within its bounds.
        residual: (r,) residual at q.
        within_limits: True if the coupled joints are within their limits at q.
        status: Result of Ipopt: STALLED (at a minimum, feasible or not), ITERATION_LIMIT or
            INVALID.
        path: (rows, n) configurations.
        residuals: (rows, r) residuals of these configurations.
        barrier: (rows,) barrier parameter mu; NaN if Ipopt was not needed.
        infeasibility: (rows,) largest violation of a constraint, Ipopt's ``inf_pr``.
        regularization: (rows,) regularisation that Ipopt added to the diagonal of the Hessian.
    """

    q: Array
    residual: Array
    within_limits: bool
    status: Status
    path: Array
    residuals: Array
    barrier: Array
    infeasibility: Array
    regularization: Array

    @property
    def cost(self) -> float:
        """Squared norm of the final residual."""
        return float(self.residual @ self.residual)


class WholeNlp:
    """Nonlinear program of one robot; targets, weights and bounds are its parameters.

    Attributes:
        contacts: Rows of the contacts.
        parameters: Layout of the targets: points (f, 3) [m], normals (f, 3), extra vectors of the
            kinds, weights (f, 2), 1 where a point or normal is constrained, 0 where it is free.
        residual: ``(q, parameters) -> r`` (rows, 1).
    """

    def __init__(self, robot: RobotDescription, options: IpoptParameters, kinds: Kinds) -> None:
        """Build the graphs, and the solvers of cold and warm starts."""
        n = len(robot.actuators)
        self.contacts = ContactRows(kinds)
        self.parameters = Layout(self.contacts.fields)
        self._n, self._rows = n, self.contacts.size
        self._lower = robot.lower
        # Scaling gives sliders [m] and joints [rad] similar effects on the contacts.
        metres = np.array([actuator.unit == "m" for actuator in robot.actuators])
        self._scale = np.where(metres, robot.upper - robot.lower, 1.0)
        limited = limited_joints(robot)
        self._joint_lower, self._joint_upper = (
            robot.joint_lower[limited],
            robot.joint_upper[limited],
        )

        q, p = ca.SX.sym("q", n), self.parameters.symbols("p")
        residual = contact_residual(robot, self.contacts, q, self.parameters.unpack(p))
        joints = joint_positions(robot, q)[limited]
        self.residual = ca.Function("residual", [q, p], [residual], ["q", "p"], ["r"])
        self._joints = ca.Function("joints", [q], [ca.densify(joints)])

        x, s = ca.SX.sym("x", n), ca.SX.sym("s", self._rows)
        scaled = x * self._scale
        start, pull = ca.SX.sym("start", n), ca.SX.sym("pull")
        # The slacks s equal the residual, so the cost is a sum of squares of variables.
        rows = ca.vertcat(self.residual(scaled, p) - s, self._joints(scaled))
        self.program = {
            "x": ca.vertcat(x, s),
            "p": ca.vertcat(p, start, pull),
            "f": (ca.sumsqr(s) + pull * ca.sumsqr(x - start)) / 2,
            "g": rows,
        }
        self._watch = Watch(n + self._rows, rows.numel(), self.program["p"].numel())
        self._solvers = {mu: self._solver(mu, options) for mu in (COLD_BARRIER, WARM_BARRIER)}
        # The callback of Ipopt writes to this object, so that solves must not overlap.
        self._lock = ForkSafeLock()

    def _solver(self, barrier: float, options: IpoptParameters) -> ca.Function:
        settings: dict[str, Any] = {
            "iteration_callback": self._watch,
            "error_on_fail": False,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": options.optimality,
            "ipopt.compl_inf_tol": options.optimality,
            "ipopt.acceptable_iter": 0,
            "ipopt.max_iter": options.max_iterations,
            "ipopt.mu_init": barrier,
            "ipopt.bound_mult_init_method": "mu-based" if barrier == WARM_BARRIER else "constant",
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.bound_push": BOUND_PUSH,
            "ipopt.bound_frac": BOUND_PUSH,
            "ipopt.slack_bound_push": BOUND_PUSH,
            "ipopt.slack_bound_frac": BOUND_PUSH,
        }
        return ca.nlpsol("whole", "ipopt", self.program, settings)

    def solve(self, start: Array, parameters: Array, lower: Array, upper: Array) -> NlpRun:
        """Run Ipopt from one start.

        Args:
            start: (n,) start configuration.
            parameters: Targets and weights, see `parameters`.
            lower: (n,) bounds of q; joint limits are ignored if it is below the robot's limits.
            upper: (n,) bounds of q.

        Raises:
            KeyboardInterrupt: Ctrl-C while Ipopt was running.
            CancelledError: This thread has been told to stop.
        """
        stop_if_cancelled()
        enforces_limits = bool(np.all(lower >= self._lower))
        joints = (self._joint_lower, self._joint_upper)
        if not enforces_limits:
            joints = (np.full_like(joints[0], -np.inf), np.full_like(joints[1], np.inf))
        first = self._residual(start, parameters)
        cost = float(first @ first)
        if cost < MAX_SOLVED_RESIDUAL**2 and self._within(start, joints):
            return self._run_without_ipopt(start, first, Status.STALLED)
        unbounded, zero = np.full(self._rows, np.inf), np.zeros(self._rows)
        with self._lock, interrupt_afterwards():
            self._watch.begin(self._rows, joints)
            scaled_start, is_near = start / self._scale, cost < WARM_START_COST
            solver = self._solvers[WARM_BARRIER if is_near else COLD_BARRIER]
            answer = solver(
                x0=np.concatenate([scaled_start, first]),
                p=np.concatenate(
                    [parameters, scaled_start, [PROXIMITY_WEIGHT if is_near else 0.0]]
                ),
                lbx=np.concatenate([lower / self._scale, -unbounded]),
                ubx=np.concatenate([upper / self._scale, unbounded]),
                lbg=np.concatenate([zero, joints[0]]),
                ubg=np.concatenate([zero, joints[1]]),
            )
            path, rows = self._watch.end()
            stats: dict[str, Any] = solver.stats()
        if not len(path):  # Ipopt could not evaluate the start
            return self._run_without_ipopt(start, first, Status.INVALID)
        path = path[:, : self._n] * self._scale
        residuals = rows[:, : self._rows]
        q = np.clip(np.array(answer["x"]).ravel()[: self._n] * self._scale, lower, upper)
        residual = self._residual(q, parameters)
        status = _ENDINGS.get(stats["return_status"], Status.STALLED)
        if not np.all(np.isfinite(residual)):
            status = Status.INVALID
            finite = np.flatnonzero(np.isfinite(residuals).all(axis=1))
            q = np.clip(path[finite[-1]], lower, upper) if len(finite) else start
            residual = self._residual(q, parameters)
        return NlpRun(
            q=q,
            residual=residual,
            within_limits=self._within(q, joints),
            status=status,
            path=path,
            residuals=residuals,
            barrier=_column(stats, "mu", len(path)),
            infeasibility=_column(stats, "inf_pr", len(path)),
            regularization=_column(stats, "regularization_size", len(path)),
        )

    def _residual(self, q: Array, parameters: Array) -> Array:
        return np.array(self.residual(q, parameters)).ravel()

    def _within(self, q: Array, limits: tuple[Array, Array]) -> bool:
        return within(np.array(self._joints(q)).ravel(), limits)

    def _run_without_ipopt(self, q: Array, residual: Array, status: Status) -> NlpRun:
        """Return a run without Ipopt: one row."""
        absent = np.full(1, np.nan)
        return NlpRun(q, residual, True, status, q[None], residual[None], absent, absent, absent)


_ENDINGS = {
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Invalid_Number_Detected": Status.INVALID,
}
"""Status by result of Ipopt; all other results count as STALLED."""


def limited_joints(robot: RobotDescription) -> list[int]:
    """Return the indices in `robot.joint_names` of the joints that need limits besides those of q.

    Every joint depends on one actuator. If all couplings between them are monotone, the joint is
    within its limits everywhere if it is at both ends of the actuator's range.
    """
    q = ca.SX.sym("q", len(robot.actuators))
    theta = ca.Function("theta", [q], [joint_positions(robot, q)])
    end_positions = np.stack([np.array(theta(end)).ravel() for end in (robot.lower, robot.upper)])
    exceeds_limits = (end_positions.min(axis=0) < robot.joint_lower - JOINT_SLACK) | (
        end_positions.max(axis=0) > robot.joint_upper + JOINT_SLACK
    )
    by_name = {joint.name: joint for joint in robot.movable}
    indices = []
    for i, joint in enumerate(robot.movable):
        is_nonmonotone, current = False, joint
        while current is not None and current.coupling is not None:
            is_nonmonotone |= not current.coupling.monotone
            current = by_name.get(current.coupling.of)
        if joint.coupling is not None and (
            is_nonmonotone or exceeds_limits[i] or not np.isfinite(end_positions[:, i]).all()
        ):
            indices.append(i)
    return indices


def _column(stats: dict[str, Any], name: str, rows: int) -> Array:
    """Return a statistic of Ipopt by iteration; NaN in restoration phases."""
    recorded = np.asarray(stats.get("iterations", {}).get(name, []), dtype=float)
    column = np.full(rows, np.nan)
    if len(recorded) == rows:
        column[:] = recorded
    return column


MAX_SOLVED_RESIDUAL = 1e-8
"""Square root of the cost below which contacts are met exactly and Ipopt stops."""

JOINT_SLACK = 1e-9
"""Tolerance of the limits of coupled joints [rad or m]."""


class Watch(ca.Callback):
    """Callback that stores every iterate and stops Ipopt at exact contacts or on cancellation.

    The variables of the program are x = (motors, slacks s), its constraints (r - s, joints). The
    calls of a solve are `begin`, then those of Ipopt, then `end`; solves must not overlap.
    """

    def __init__(self, nx: int, ng: int, parameters: int) -> None:
        """Store the sizes of the program."""
        ca.Callback.__init__(self)
        sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": parameters}
        self._sizes = [sizes[name] for name in ca.nlpsol_out()]
        self._output_indices = [ca.nlpsol_out().index(name) for name in ("x", "g")]
        self._path: list[Array] = []
        self._rows: list[Array] = []
        self._contacts = 0
        self._joints: tuple[Array, Array] = (np.zeros(0), np.zeros(0))
        self.construct("watch", {})

    def begin(self, contacts: int, joints: tuple[Array, Array]) -> None:
        """Reset for a new solve with the number of rows r - s and the limits of the other rows."""
        self._path, self._rows = [], []
        self._contacts, self._joints = contacts, joints

    def end(self) -> tuple[Array, Array]:
        """Return the iterates x (rows, nx), with their residuals and joints (rows, ng)."""
        return np.array(self._path), np.array(self._rows)

    def get_n_in(self) -> int:
        """Return the number of inputs: all outputs of a solver."""
        return len(self._sizes)

    def get_n_out(self) -> int:
        """Return the number of outputs: the stop flag."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return dense columns."""
        return ca.Sparsity.dense(self._sizes[i], 1)

    def has_eval_buffer(self) -> bool:
        """Read the raw buffers, without wrapping them in matrices."""
        return True

    def eval_buffer(self, arg: Any, res: Any) -> int:
        """Store an iterate; Ipopt calls this at the start and after every iteration."""
        x, rows = (np.frombuffer(arg[i], dtype=float).copy() for i in self._output_indices)
        rows[: self._contacts] += x[len(x) - self._contacts :]
        self._path.append(x)
        self._rows.append(rows)
        r, joints = rows[: self._contacts], rows[self._contacts :]
        is_solved = r @ r < MAX_SOLVED_RESIDUAL**2 and within(joints, self._joints)
        np.frombuffer(res[0], dtype=float)[0] = is_solved or is_cancelled()
        return 0


def within(joints: Array, limits: tuple[Array, Array]) -> bool:
    """Return True if coupled joints are within their lower and upper limits."""
    return bool(
        np.all(joints >= limits[0] - JOINT_SLACK) and np.all(joints <= limits[1] + JOINT_SLACK)
    )


AT_LIMIT = 1e-6
"""Distance at which a motor is at its limit [rad or m]; Ipopt remains inside the bounds."""


class IpoptMethod(Method):
    """Method `ipopt`: a start from q0, then random starts until the contacts are met.

    The trace has a row for the first point and for every step of Ipopt, of each start; a row counts
    as an iteration. If no start meets the contacts, the result with the smallest cost is returned.
    Threads solve one after another, because Ipopt's callback serves one solve at a time.

    Attributes:
        name: Name of the method.
        options: Parameters of the method.
    """

    name = "ipopt"

    def __init__(
        self,
        robot: RobotDescription,
        options: IpoptParameters,
        compiled: bool = True,
        kinds: Kinds | None = None,
    ) -> None:
        """Store the robot; the program is built at the first use.

        Args:
            robot: The robot.
            options: Parameters of the method.
            compiled: Not used, because Ipopt evaluates its graphs in CasADi's virtual machine.
            kinds: Kind of contact by finger; None: point and normal.
        """
        del compiled
        self._kinds = kinds or point_normal_kinds(len(robot.fingers))
        self.options = options
        self._robot = robot

    @cached_property
    def program(self) -> WholeNlp:
        """Nonlinear program, shared by all targets."""
        return WholeNlp(self._robot, self.options, self._kinds)

    def for_kinds(self, kinds: Kinds) -> IpoptMethod:
        """Return this method for contacts of other kinds."""
        return self if kinds == self._kinds else IpoptMethod(self._robot, self.options, kinds=kinds)

    def prepare(self) -> None:
        """Build the program."""
        _ = self.program

    @cached_property
    def record(self) -> Layout:
        """Layout of the log record of an iteration."""
        robot = self._robot
        return Layout.record(
            Q.for_robot(robot, "actuator positions before the step"),
            COST.for_robot(robot, "squared residual before the step"),
            Field("barrier", (), "f8", "", "Ipopt's barrier parameter mu"),
            POSITION_ERROR.for_robot(robot),
            ANGLE_ERROR.for_robot(robot),
            Field("infeasibility", (), "f4", "", "largest violation of a constraint (inf_pr)"),
            Field("regularization", (), "f4", "", "added to the diagonal of the Hessian"),
            STEP_SIZE.for_robot(robot, "largest motor change of the step"),
            LIMIT_MASK.for_robot(robot),
            RESTART.for_robot(robot, "number of the start, 0 that from q0"),
            PHASE.for_robot(robot),
            STATUS.for_robot(robot),
        )

    @property
    def trace_format(self) -> TraceFormat:
        """Format of the traces."""
        return trace_format(self.record, self._robot, measures=self._measures)

    @cached_property
    def _measures(self) -> JacobianMeasures:
        return JacobianMeasures(self._robot)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameter record as a mapping."""
        return dataclasses.asdict(self.options)

    def stepper(self, targets: TargetBatch) -> Stepper:
        """Raise, because this method has no step graph.

        Raises:
            UnsupportedError: Always.
        """
        del targets
        raise UnsupportedError(
            f"method {self.name!r} cannot be stepped by hand: Ipopt runs its iterations itself and "
            "only reports them; a log holds them all"
        )

    def run(self, targets: TargetBatch, trace: bool = False) -> Outcome:
        """Solve a batch; see `Method.run`.

        The random numbers of a target are those of the seed and the target's number in the whole
        batch.
        """
        robot, count = self._robot, len(targets)
        q = np.zeros((count, len(robot.actuators)))
        status, iterations, restarts = (np.zeros(count, dtype=np.int64) for _ in range(3))
        elapsed = np.zeros(count)
        traces = [np.zeros(0, self.record.dtype)]
        goals = self._goals(targets)
        starts = clip_starts(robot, targets)
        for row in range(count):
            begin = time.perf_counter()
            sequence = np.random.SeedSequence([targets.seed, targets.row_number(row)])
            runs = self._runs(starts[row], goals[row], targets, np.random.default_rng(sequence))
            best = min(runs, key=lambda run: run.cost)
            q[row] = best.q
            status[row] = _ending(best, targets, self.program.contacts)
            iterations[row] = sum(len(run.path) for run in runs)
            restarts[row] = len(runs) - 1
            if trace:
                traces.append(self._trace(runs, Status(int(status[row]))))
            elapsed[row] = time.perf_counter() - begin
        return Outcome(
            q=q,
            status=status,
            iterations=iterations,
            restarts=restarts,
            time=elapsed,
            phases={Phase.WHOLE_SYSTEM.label: iterations.copy()},
            rows=np.concatenate(traces) if trace else None,
        )

    def _runs(
        self, start: Array, goals: Array, targets: TargetBatch, rng: np.random.Generator
    ) -> list[NlpRun]:
        """Run Ipopt from successive starts until the contacts are met or no start remains."""
        robot, runs = self._robot, []
        lower, upper = targets.bounds(robot, np.inf)
        for _ in range(self.options.restarts + 1):
            runs.append(self.program.solve(start, goals, lower, upper))
            if _ending(runs[-1], targets, self.program.contacts) is Status.SOLVED:
                break
            start = rng.uniform(robot.lower, robot.upper)
        return runs

    def _goals(self, targets: TargetBatch) -> Array:
        """Return the parameters (k, ...) of the program; free vectors are zero."""
        layout, count = self.program.parameters, len(targets)
        is_set = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
        values = {
            item.name: np.nan_to_num(targets.vectors(item.name))
            for item in layout
            if item.name != "weights"
        } | {"weights": np.stack(is_set, axis=2)}
        goals = np.zeros((count, layout.size))
        for item in layout:
            goals[:, layout.slice(item.name)] = values[item.name].reshape(count, item.size)
        return goals

    def _trace(self, runs: list[NlpRun], status: Status) -> NDArray[Any]:
        rows = np.zeros(sum(len(run.path) for run in runs), dtype=self.record.dtype)
        residuals = np.concatenate([run.residuals for run in runs])
        q = np.concatenate([run.path for run in runs])
        distances, angles = contact_errors(self.program.contacts, residuals)
        at_limit = (q <= self._robot.lower + AT_LIMIT) | (q >= self._robot.upper - AT_LIMIT)
        rows["q"] = q
        rows["cost"] = np.sum(residuals**2, axis=1)
        rows["position_error"], rows["angle_error"] = distances, angles
        for name in ("barrier", "infeasibility", "regularization"):
            rows[name] = np.concatenate([getattr(run, name) for run in runs])
        rows["step_size"] = np.concatenate([_step_sizes(run.path) for run in runs])
        rows["limit_mask"] = pack_mask(at_limit)
        rows["restart"] = np.repeat(np.arange(len(runs)), [len(run.path) for run in runs])
        rows["phase"] = Phase.WHOLE_SYSTEM
        rows["status"][-1:] = max(status, 0)
        return rows


def _step_sizes(path: Array) -> Array:
    """Return the largest motor change (rows,) of the step after every row; NaN for the last."""
    return np.append(np.abs(np.diff(path, axis=0)).max(axis=1), np.nan)


def _ending(run: NlpRun, targets: TargetBatch, contacts: ContactRows) -> Status:
    """Return the status of a run: SOLVED if all contacts are within tolerance, else Ipopt's."""
    distances, angles = contact_errors(contacts, run.residual[None])
    is_met = np.all(distances <= targets.position_tolerance)
    is_met = is_met and np.all(angles <= targets.angle_tolerance)
    return Status.SOLVED if is_met and run.within_limits else run.status
