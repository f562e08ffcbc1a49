"""The whole arm-hand as one nonlinear program, solved by Ipopt: the slow, trusted reference.

Over the actuator positions q and one slack per residual row::

    minimise    |s|^2 / 2  +  pull |q - start|^2 / 2   (the pull is zero but for warm starts)
    subject to  r(q) - s = 0                  (6 f rows for points and normals)
                lower <= q <= upper
                lower_j <= theta_j(q) <= upper_j   (joints whose limits those of q do not imply)

At s = 0 every contact is met, and Ipopt is stopped once |r| is below `EXACT`; where that cannot
be, q is a local minimiser of the squared errors: the nearest contacts. Eliminating s gives plain
least squares with the same minimisers, but not the same iterations: the slack lets Ipopt satisfy
the contacts by Newton steps on equations, whereas the Hessian of the squared errors is singular
along the arm's self-motion. Measured on 98 targets: 30 iterations instead of 130, and all runs
converged instead of 4 in 10. A start that is nearly a solution is followed with a small barrier
and, since the barrier has no opinion of the self-motion but the middle of the range, with a slight
pull towards the start.

Couplings are inside r and theta, so a four-bar or a lead screw is not a constraint of its own.
The Hessian is exact, by CasADi's differentiation. Nothing here is shared with the other methods
but the kinematics, see `methods.ipopt.contacts`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.kernels.cancellation import interrupt_afterwards, stop_if_cancelled
from casadi_ik.kernels.forks import ForkSafeLock
from casadi_ik.kernels.layout import Layout
from casadi_ik.methods.ipopt.contacts import NlpContacts
from casadi_ik.methods.ipopt.parameters import IpoptParameters
from casadi_ik.methods.ipopt.watch import EXACT, JOINT_SLACK, Watch, within
from casadi_ik.problem.contacts.kinds import Kinds
from casadi_ik.problem.status import Status
from casadi_ik.robots.description import RobotDescription
from casadi_ik.symbolic.couplings import joint_positions

NEAR = 0.1
"""Cost below which a start is taken for a solution nearly there, and Ipopt started warm."""

COLD, WARM = 0.1, 1e-11
"""Barrier parameter mu to begin with."""

PULL = 1e-8
"""Weight of the distance from a warm start: decides only along the arm's self-motion, where the
barrier alone would draw the arm to the middle of its range."""

INSIDE = 1e-8
"""A start at a bound is moved inside by this part of the range (or of its size)."""


@dataclass(frozen=True, eq=False)
class NlpRun:
    """The run from one start; a row per iteration, the start itself first.

    Attributes:
        q: (n,) configuration reached, within its bounds.
        residual: (r,) residual there.
        inside: Whether the coupled joints are within their limits there.
        status: How Ipopt ended: STALLED (at a minimum, whether it meets the contacts or not),
            ITERATION_LIMIT or INVALID.
        path: (rows, n) configurations.
        residuals: (rows, r) residuals there.
        barrier: (rows,) Ipopt's mu; NaN if Ipopt was not needed.
        infeasibility: (rows,) largest violation of a constraint, Ipopt's ``inf_pr``.
        regularization: (rows,) what Ipopt added to the diagonal of the Hessian.
    """

    q: Array
    residual: Array
    inside: bool
    status: Status
    path: Array
    residuals: Array
    barrier: Array
    infeasibility: Array
    regularization: Array

    @property
    def cost(self) -> float:
        """Squared residual at the end."""
        return float(self.residual @ self.residual)


class WholeNlp:
    """The program for one robot; targets, weights and bounds are numbers of a solve.

    Attributes:
        contacts: The contacts' rows.
        parameters: Layout of the targets: points (f, 3) [m], normals (f, 3), what their kinds have
            beside, weights (f, 2), 1 where a point (a normal) counts, 0 where it is free.
        residual: ``(q, parameters) -> r`` (rows, 1).
    """

    def __init__(self, robot: RobotDescription, options: IpoptParameters, kinds: Kinds) -> None:
        """Build the graphs and both solvers, cold and warm."""
        n = len(robot.actuators)
        self.contacts = NlpContacts(kinds)
        self.parameters = Layout(self.contacts.fields)
        self._n, self._rows = n, sum(self.contacts.sizes)
        self._lower = robot.lower
        # Sliders of millimetres and joints of radians move the contacts alike once scaled.
        metres = np.array([actuator.unit == "m" for actuator in robot.actuators])
        self._scale = np.where(metres, robot.upper - robot.lower, 1.0)
        limited = limited_joints(robot)
        self._joint_lower, self._joint_upper = (
            robot.joint_lower[limited],
            robot.joint_upper[limited],
        )

        q, p = ca.SX.sym("q", n), self.parameters.symbols("p")
        residual = self.contacts.residual(robot, q, self.parameters.unpack(p))
        joints = joint_positions(robot, q)[limited]
        self.residual = ca.Function("residual", [q, p], [residual], ["q", "p"], ["r"])
        self._joints = ca.Function("joints", [q], [ca.densify(joints)])

        x, s = ca.SX.sym("x", n), ca.SX.sym("s", self._rows)
        scaled = x * self._scale
        start, pull = ca.SX.sym("start", n), ca.SX.sym("pull")
        rows = ca.vertcat(self.residual(scaled, p) - s, self._joints(scaled))
        self.program = {
            "x": ca.vertcat(x, s),
            "p": ca.vertcat(p, start, pull),
            "f": (ca.sumsqr(s) + pull * ca.sumsqr(x - start)) / 2,
            "g": rows,
        }
        self._watch = Watch(n + self._rows, rows.numel(), self.program["p"].numel())
        self._solvers = {mu: self._solver(mu, options) for mu in (COLD, WARM)}
        # Ipopt's callback hands its rows to this object, so one solve at a time.
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
            "ipopt.bound_mult_init_method": "mu-based" if barrier == WARM else "constant",
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.bound_push": INSIDE,
            "ipopt.bound_frac": INSIDE,
            "ipopt.slack_bound_push": INSIDE,
            "ipopt.slack_bound_frac": INSIDE,
        }
        return ca.nlpsol("whole", "ipopt", self.program, settings)

    def solve(self, start: Array, parameters: Array, lower: Array, upper: Array) -> NlpRun:
        """Run Ipopt from one start.

        Args:
            start: (n,) where to begin.
            parameters: Targets and weights, see `parameters`.
            lower: (n,) bounds of q; below the robot's, limits are ignored, those of joints as well.
            upper: (n,) bounds of q.

        Raises:
            KeyboardInterrupt: Ctrl-C while Ipopt was at work.
            CancelledError: This thread has been told to stop.
        """
        stop_if_cancelled()
        enforced = bool(np.all(lower >= self._lower))
        joints = (self._joint_lower, self._joint_upper)
        if not enforced:
            joints = (np.full_like(joints[0], -np.inf), np.full_like(joints[1], np.inf))
        first = self._residual(start, parameters)
        cost = float(first @ first)
        if cost < EXACT**2 and self._within(start, joints):
            return self._unmoved(start, first, Status.STALLED)
        free, zero = np.full(self._rows, np.inf), np.zeros(self._rows)
        with self._lock, interrupt_afterwards():
            self._watch.begin(self._rows, joints)
            begin, near = start / self._scale, cost < NEAR
            solver = self._solvers[WARM if near else COLD]
            answer = solver(
                x0=np.concatenate([begin, first]),
                p=np.concatenate([parameters, begin, [PULL if near else 0.0]]),
                lbx=np.concatenate([lower / self._scale, -free]),
                ubx=np.concatenate([upper / self._scale, free]),
                lbg=np.concatenate([zero, joints[0]]),
                ubg=np.concatenate([zero, joints[1]]),
            )
            path, rows = self._watch.end()
            stats: dict[str, Any] = solver.stats()
        if not len(path):  # Ipopt could not evaluate the start
            return self._unmoved(start, first, Status.INVALID)
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
            inside=self._within(q, joints),
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

    def _unmoved(self, q: Array, residual: Array, status: Status) -> NlpRun:
        """A run without Ipopt: one row."""
        nothing = np.full(1, np.nan)
        return NlpRun(q, residual, True, status, q[None], residual[None], nothing, nothing, nothing)


_ENDINGS = {
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Invalid_Number_Detected": Status.INVALID,
}
"""What Ipopt's endings mean; all others leave it standing at a point."""


def limited_joints(robot: RobotDescription) -> list[int]:
    """Joints whose limits the bounds of q do not imply: positions in `robot.joint_names`.

    Every joint depends on one actuator, and where all couplings on the way are monotone, the
    ends of the actuator's range tell.
    """
    q = ca.SX.sym("q", len(robot.actuators))
    theta = ca.Function("theta", [q], [joint_positions(robot, q)])
    ends = np.stack([np.array(theta(end)).ravel() for end in (robot.lower, robot.upper)])
    beyond = (ends.min(axis=0) < robot.joint_lower - JOINT_SLACK) | (
        ends.max(axis=0) > robot.joint_upper + JOINT_SLACK
    )
    by_name = {joint.name: joint for joint in robot.movable}
    found = []
    for i, joint in enumerate(robot.movable):
        bent, current = False, joint
        while current is not None and current.coupling is not None:
            bent |= not current.coupling.monotone
            current = by_name.get(current.coupling.of)
        if joint.coupling is not None and (bent or beyond[i] or not np.isfinite(ends[:, i]).all()):
            found.append(i)
    return found


def _column(stats: dict[str, Any], name: str, rows: int) -> Array:
    """A quantity Ipopt keeps by iteration; NaN where it kept none (a restoration phase)."""
    kept = np.asarray(stats.get("iterations", {}).get(name, []), dtype=float)
    column = np.full(rows, np.nan)
    if len(kept) == rows:
        column[:] = kept
    return column
