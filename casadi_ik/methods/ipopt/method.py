"""The method `ipopt`: the whole arm-hand as one program, from q0 and then from random starts."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arrays import Array
from casadi_ik.errors import UnsupportedError
from casadi_ik.kernels.layout import Field, Layout
from casadi_ik.kernels.stepper import Stepper
from casadi_ik.methods.ipopt.contacts import NlpContacts
from casadi_ik.methods.ipopt.parameters import IpoptParameters
from casadi_ik.methods.ipopt.whole_nlp import NlpRun, WholeNlp
from casadi_ik.problem.contacts.kinds import Kinds, usual
from casadi_ik.problem.jacobian_measures import JacobianMeasures
from casadi_ik.problem.method import Outcome
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.status import Phase, Status
from casadi_ik.problem.trace import (
    ANGLE_ERROR,
    COST,
    LIMIT_MASK,
    PHASE,
    POSITION_ERROR,
    RESTART,
    STATUS,
    STEP_SIZE,
    Q,
    TraceFormat,
    packed,
    trace_format,
)
from casadi_ik.robots.description import RobotDescription

AT_LIMIT = 1e-6
"""A motor this close to its limit [rad or m] counts as standing there; Ipopt stays inside."""


class IpoptMethod:
    """`ipopt`: one start from q0, then random ones until the contacts are met.

    An iteration is a row of the trace: every start counts its first point and every step of
    Ipopt. Of several starts in vain the one with the smallest cost is returned. Threads take
    turns, since Ipopt's callback serves one solve at a time.

    Attributes:
        name: Name of the method.
        options: Its numbers.
    """

    name = "ipopt"

    def __init__(
        self,
        robot: RobotDescription,
        options: IpoptParameters,
        compiled: bool = True,
        kinds: Kinds | None = None,
    ) -> None:
        """Remember the robot; the program is built when first needed.

        Args:
            robot: The robot.
            options: The numbers.
            compiled: Makes no difference: Ipopt calls its graphs in the virtual machine.
            kinds: Of the contacts, by finger; None: point and normal.
        """
        del compiled
        self._kinds = kinds or usual(len(robot.fingers))
        self.options = options
        self._robot = robot

    @cached_property
    def program(self) -> WholeNlp:
        """The program; it serves every target."""
        return WholeNlp(self._robot, self.options, self._kinds)

    def for_kinds(self, kinds: Kinds) -> IpoptMethod:
        """The same for contacts of other kinds."""
        return self if kinds == self._kinds else IpoptMethod(self._robot, self.options, kinds=kinds)

    def prepare(self) -> None:
        """Build the program."""
        _ = self.program

    @cached_property
    def record(self) -> Layout:
        """What is logged of an iteration."""
        robot = self._robot
        return Layout.record(
            Q.of(robot, "actuator positions before the step"),
            COST.of(robot, "squared residual before the step"),
            Field("barrier", (), "f8", "", "Ipopt's barrier parameter mu"),
            POSITION_ERROR.of(robot),
            ANGLE_ERROR.of(robot),
            Field("infeasibility", (), "f4", "", "largest violation of a constraint (inf_pr)"),
            Field("regularization", (), "f4", "", "added to the diagonal of the Hessian"),
            STEP_SIZE.of(robot, "largest motor change of the step"),
            LIMIT_MASK.of(robot),
            RESTART.of(robot, "number of the start, 0 that from q0"),
            PHASE.of(robot),
            STATUS.of(robot),
        )

    @property
    def trace_format(self) -> TraceFormat:
        """How its traces are to be read."""
        return trace_format(self.record, self._robot, measures=self._measures)

    @cached_property
    def _measures(self) -> JacobianMeasures:
        return JacobianMeasures(self._robot)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameter record as a plain mapping."""
        return dataclasses.asdict(self.options)

    def stepper(self, problems: Problems, q0: Array) -> Stepper:
        """Not to be had.

        Raises:
            UnsupportedError: Always.
        """
        del problems, q0
        raise UnsupportedError(
            f"method {self.name!r} cannot be stepped by hand: Ipopt runs its iterations itself and "
            "only reports them; a log holds them all"
        )

    def run(self, problems: Problems, q0: Array, seed: int, trace: bool) -> Outcome:
        """Solve a batch; see `Method.run`.

        The random numbers of a target are those of the seed and the target's number in the whole
        batch.
        """
        robot, count = self._robot, len(problems)
        q = np.zeros((count, len(robot.actuators)))
        status, iterations, restarts = (np.zeros(count, dtype=np.int64) for _ in range(3))
        elapsed = np.zeros(count)
        traces = [np.zeros(0, self.record.dtype)]
        targets = self._targets(problems)
        starts = np.clip(q0, robot.lower, robot.upper) if problems.enforce_limits else q0
        for row in range(count):
            begin = time.perf_counter()
            sequence = np.random.SeedSequence([seed, problems.number(row)])
            runs = self._runs(starts[row], targets[row], problems, np.random.default_rng(sequence))
            best = min(runs, key=lambda run: run.cost)
            q[row] = best.q
            status[row] = _ending(best, problems, self.program.contacts)
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
        self, start: Array, targets: Array, problems: Problems, rng: np.random.Generator
    ) -> list[NlpRun]:
        """One run after the other, until the contacts are met or the starts are used up."""
        robot, runs = self._robot, []
        lower, upper = problems.bounds(robot, np.inf)
        for _ in range(self.options.restarts + 1):
            runs.append(self.program.solve(start, targets, lower, upper))
            if _ending(runs[-1], problems, self.program.contacts) is Status.SOLVED:
                break
            start = rng.uniform(robot.lower, robot.upper)
        return runs

    def _targets(self, problems: Problems) -> Array:
        """(k, ...) parameters of the program; what is free is zero."""
        layout, count = self.program.parameters, len(problems)
        counts = [~np.isnan(array[..., 0]) for array in (problems.points, problems.normals)]
        values = {
            item.name: np.nan_to_num(problems.vectors(item.name))
            for item in layout
            if item.name != "weights"
        } | {"weights": np.stack(counts, axis=2)}
        targets = np.zeros((count, layout.size))
        for item in layout:
            targets[:, layout.slice(item.name)] = values[item.name].reshape(count, item.size)
        return targets

    def _trace(self, runs: list[NlpRun], status: Status) -> NDArray[Any]:
        rows = np.zeros(sum(len(run.path) for run in runs), dtype=self.record.dtype)
        residuals = np.concatenate([run.residuals for run in runs])
        q = np.concatenate([run.path for run in runs])
        distances, angles = self.program.contacts.errors(residuals)
        at_limit = (q <= self._robot.lower + AT_LIMIT) | (q >= self._robot.upper - AT_LIMIT)
        rows["q"] = q
        rows["cost"] = np.sum(residuals**2, axis=1)
        rows["position_error"], rows["angle_error"] = distances, angles
        for name in ("barrier", "infeasibility", "regularization"):
            rows[name] = np.concatenate([getattr(run, name) for run in runs])
        rows["step_size"] = np.concatenate([_step_sizes(run.path) for run in runs])
        rows["limit_mask"] = packed(at_limit)
        rows["restart"] = np.repeat(np.arange(len(runs)), [len(run.path) for run in runs])
        rows["phase"] = Phase.WHOLE_SYSTEM
        rows["status"][-1:] = max(status, 0)
        return rows


def _step_sizes(path: Array) -> Array:
    """(rows,) largest motor change of the step from every row; none from the last."""
    return np.append(np.abs(np.diff(path, axis=0)).max(axis=1), np.nan)


def _ending(run: NlpRun, problems: Problems, contacts: NlpContacts) -> Status:
    """How a run ended: solved if every contact is within tolerance, whatever Ipopt thinks."""
    distances, angles = contacts.errors(run.residual[None])
    met = np.all(distances <= problems.position_tolerance)
    met = met and np.all(angles <= problems.angle_tolerance)
    return Status.SOLVED if met and run.inside else run.status
