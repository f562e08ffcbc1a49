"""`ScrewControl`: iterative control of a fingertip towards a target, as on a real hand."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_ik.compile import FunctionKernel, LoopKernel
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import InputError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics import dual_quaternion as dq
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs import McapRecorder
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch, Tolerance
from casadi_ik.papers.chandra.screw_tasks import ScrewControlStep, ScrewTask
from casadi_ik.solve.looped_method import coupling_jacobian
from casadi_ik.solve.recorder import SolveBlock
from casadi_ik.solve.solution import BatchSolution
from casadi_ik.solve.status import Status
from casadi_ik.solve.trace import TraceFormat

UNLIMITED = 1e9
"""Step length that no actuator reaches [rad or m]."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Trajectory of the control law for one target, in s steps.

    Attributes:
        times: (s + 1,) [s], the start first.
        q: (s + 1, n) actuator positions [rad or m].
        points: (s + 1, 3) contact point in the frame of the target [m].
        error: (s + 1, m) rows of the task, desired minus current [m, rad].
        error_norm: (s + 1,) norm of these rows; for a pose the screw error norm, Chandra eq. (17).
        sigma: (s + 1,) smallest singular value of the scaled Jacobian: columns times half the
            ranges of the actuators, position rows divided by `length`.
        status: `SOLVED` if the error norm fell below the tolerance, else `ITERATION_LIMIT`, or
            `INVALID`.

    Example:
        >>> ar10 = ik.load_robot("ar10")
        >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"))
        >>> run = control.run(ar10.home, control.target(ar10.home), steps=3)
        >>> run.q.shape, bool(run.error_norm[-1] < 1e-9)
        ((4, 10), True)
    """

    times: Array
    q: Array
    points: Array
    error: Array
    error_norm: Array
    sigma: Array
    status: Status

    def rate(self, floor: float = 1e-9) -> float:
        """Return the exponential rate [1/s] of the error norm: minus the slope of its logarithm.

        Args:
            floor: Norms up to this are rounding errors and are excluded.

        Returns:
            The rate, NaN if fewer than two norms are above the floor.
        """
        rows = self.error_norm > floor
        if rows.sum() < 2:
            return math.nan
        return -float(np.polyfit(self.times[rows], np.log(self.error_norm[rows]), 1)[0])


class ScrewControl:
    """Screw control law of Chandra et al. 2019, eq. (14), for full poses and parts of them.

    Attributes:
        robot: The robot.
        task: Task of the fingertip.
        gain: Gain [1/s]; a step removes the fraction `gain * period` of the error.
        period: Time between two steps [s].

    Example:
        >>> ar10 = ik.load_robot("ar10")  # sliders in metres
        >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"), gain=0.5)
        >>> goal = control.target(ar10.home + 0.001)
        >>> run = control.run(ar10.home, goal, steps=30)
        >>> bool(run.error_norm[-1] < 1e-3 * run.error_norm[0])
        True
    """

    def __init__(
        self,
        robot: ArmHand,
        task: ScrewTask,
        gain: float = 0.5,
        *,
        period: float = 1.0,
        centring: float = 0.0,
        damping: float = 1e-5,
        length: float = 1.0,
        speed: ArrayLike | None = None,
        resolution: ArrayLike | None = None,
        compiled: bool = True,
    ) -> None:
        """Build the control law; its step is compiled at the first run and cached on the machine.

        Args:
            robot: Robot from `load_robot`.
            task: Task of the fingertip.
            gain: Gain with 0 < gain * period < 2 [1/s].
            period: Time between two steps [s].
            centring: Fraction of the distance to mid-range that each actuator moves per step, as
                far as the task permits; 0: actuators that do not serve the task do not move.
            damping: Damping of the least squares [unit of `Trajectory.sigma`].
            length: Length that weighs as much as a radian [m]. It matters only for tasks that
                cannot be met exactly. The paper adds m and rad without weights: 1.
            speed: Largest speed of an actuator, () or (n,) [rad/s or m/s]; None: unlimited.
            resolution: Increments of actuator commands, () or (n,), counted from the lower limit
                [rad or m]; None or 0: continuous.
            compiled: False uses CasADi's virtual machine, which is slower and gives the same
                iterates up to rounding.

        Raises:
            UnknownNameError: The robot does not have the finger of the task.
            InputError: A number is out of range.
        """
        if not isinstance(robot, ArmHand):
            raise InputError(f"robot: found {robot!r}, expected an ArmHand")
        if not isinstance(task, ScrewTask):
            raise InputError(f"task: found {task!r}, expected a ScrewTask")
        self.robot, self.task = robot, task
        self.period = _number("period", period, above=0.0)
        self.gain = _number("gain", gain, above=0.0)
        if not self.gain * self.period < 2:
            raise InputError(f"gain: found {gain} with period {period}, expected a product below 2")
        n = len(robot.actuators)
        fastest = np.inf if speed is None else speed
        self._numbers = {
            "gain": self.gain * self.period,
            "damping": _number("damping", damping, above=0.0),
            "centring": _number("centring", centring, lower=0.0, upper=1.0),
            "length": _number("length", length, above=0.0),
            "largest_step": np.minimum(_per_actuator("speed", fastest, n) * self.period, UNLIMITED),
            "resolution": _per_actuator("resolution", 0.0 if resolution is None else resolution, n),
        }
        task.chain(robot.description)  # raises an error for an unknown finger
        self._step = _step(robot.description, task)
        self._compiled = compiled

    @property
    def kernel(self) -> LoopKernel:
        """Compiled loop, shared by all gains."""
        return _kernel(self._step, self._compiled)

    @property
    def parameters(self) -> dict[str, Any]:
        """Settings of a run except target, start and tolerance, as stored in the log."""
        task = {"kind": self.task.kind, "finger": self.task.finger}
        task |= {"relative_to": self.task.relative_to, "axis": self.task.axis}
        numbers = {name: np.asarray(value).tolist() for name, value in self._numbers.items()}
        return {"method": "screw-control", "task": task, "period": self.period, **numbers}

    def target(self, q: ArrayLike) -> dict[str, Array]:
        """Return the target that a configuration meets.

        Args:
            q: (n,) actuator positions [rad or m].

        Raises:
            InputError: Shape or values of q are invalid.

        Example:
            >>> ar10 = ik.load_robot("ar10")
            >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"))
            >>> {name: value.shape for name, value in control.target(ar10.home).items()}
            {'pose': (8,)}
        """
        values = _target_kernel(self._step, self._compiled)(self._posture(q, "q"))
        names = [field.name for field in self.task.target_fields]
        return dict(zip(names, values, strict=True))

    def run(
        self,
        q0: ArrayLike | None,
        target: Mapping[str, ArrayLike],
        steps: int = 100,
        *,
        tolerance: float = 0.0,
        log: str | PathLike[str] | None = None,
    ) -> Trajectory:
        """Run the control law.

        Args:
            q0: (n,) start configuration, clipped to the limits [rad or m]; None: `robot.home`.
            target: Values of the task's target by name: "pose" as a (4, 4) matrix or an (8,) unit
                dual quaternion, "point" (3,) [m], "normal" (3,), "distance" [m]; in the base frame,
                or in the contact frame of the task's `relative_to`.
            steps: Maximum number of steps; a run ends earlier if the actuators no longer move.
            tolerance: Error norm at which the run ends; 0: never.
            log: Path of an MCAP file for all steps.

        Raises:
            InputError: Start or target is invalid.
            LogError: The log cannot be written.

        Example:
            >>> ar10 = ik.load_robot("ar10")
            >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"))
            >>> control.run(ar10.home, control.target(ar10.home), steps=5).times.shape
            (6,)
        """
        if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
            raise InputError(f"steps: found {steps!r}, expected an integer >= 1")
        start = np.clip(self._posture(q0, "q0"), self.robot.lower, self.robot.upper)
        numbers = {
            **self._numbers,
            "tolerance": _number("tolerance", tolerance, lower=0.0),
        }
        target_values = self._checked(target)
        started = time.time_ns()
        # A row describes the state before its step, so one more row shows the last result.
        result = self.kernel.run(
            start[None],
            self._step.parameter_vector(target_values, numbers),
            int(steps) + 1,
            trace=True,
        )
        rows = result.trace[0]
        status = Status(int(Status.from_loop(result.status)[0]))
        trajectory = Trajectory(
            times=self.period * np.arange(len(rows), dtype=np.float64),
            q=rows["q"],
            points=rows["point"],
            error=rows["error"].reshape(len(rows), -1),
            error_norm=rows["error_norm"],
            sigma=rows["sigma_task"].astype(float),
            status=status,
        )
        if log is not None:
            parameters = self.parameters | {"tolerance": {"error_norm": numbers["tolerance"]}}
            self._write(log, parameters, started, float(result.time[0]), trajectory, rows)
        return trajectory

    def stepper(self, q0: ArrayLike | None, target: Mapping[str, ArrayLike]) -> Stepper:
        """Return an iterator over single steps of the law; arguments and errors as in `run`."""
        start = np.clip(self._posture(q0, "q0"), self.robot.lower, self.robot.upper)
        numbers = {**self._numbers, "tolerance": 0.0}
        vector = self._step.parameter_vector(self._checked(target), numbers)
        return Stepper(self.kernel, start, vector)

    def _posture(self, q: ArrayLike | None, name: str) -> Array:
        """Return a checked configuration (n,); None: home."""
        array = self.robot.configuration(q, name)
        if array.ndim != 1:
            raise InputError(f"{name}: found shape {array.shape}, expected ({array.shape[1]},)")
        return array

    def _checked(self, target: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """Return the checked values of a target, with unit normals and unit dual quaternions."""
        expected = {field.name: field.shape for field in self.task.target_fields}
        if set(target) != set(expected):
            raise InputError(
                f"target: found {', '.join(target) or 'nothing'}, "
                f"task {self.task.kind!r} expects {', '.join(expected)}"
            )
        checked = {}
        for name, shape in expected.items():
            value = np.asarray(target[name], dtype=float)
            if name == "pose" and value.shape == (4, 4):
                value = np.array(dq.from_pose(ca.DM(value[:3, :3]), ca.DM(value[:3, 3]))).ravel()
            if value.shape != shape or not np.all(np.isfinite(value)):
                raise InputError(
                    f"target: {name}: found {value.tolist()}, expected finite numbers of shape "
                    f"{shape}"
                )
            if name in ("normal", "pose"):
                length = float(np.linalg.norm(value[:4]))
                if not length > 1e-9:
                    raise InputError(f"target: {name}: found length 0, expected 1")
                value = value / length
            checked[name] = value
        return checked

    def _write(
        self,
        path: str | PathLike[str],
        parameters: dict[str, Any],
        started: int,
        seconds: float,
        trajectory: Trajectory,
        rows: NDArray[Any],
    ) -> None:
        """Write a run to a log as one solve, with free contacts instead of the task's target."""
        n, count = len(self.robot.fingers), np.array([len(rows)])
        free = np.full((1, n, 3), np.nan)
        batch = BatchSolution(
            success=np.array([trajectory.status == Status.SOLVED]),
            status=np.array([trajectory.status], dtype=np.int64),
            q=trajectory.q[-1:],
            iterations=count,
            restarts=np.zeros(1, dtype=np.int64),
            time=np.array([seconds]),
            position_error=free[..., 0],
            angle_error=free[..., 0],
            ok=np.ones((1, n), dtype=bool),
            limits_ok=np.ones(1, dtype=bool),
            phases={"screw-control": count},
            tolerances=(Tolerance(),) * n,
            fingers=self.robot.fingers,
            method="screw-control",
            robot=self.robot.name,
            actuators=self.robot.actuators,
        )
        labels = {
            "q": self.robot.actuators,
            "limit_mask": self.robot.actuators,
            "status": Status.labels(),
        }
        block = SolveBlock(
            format=TraceFormat(
                self._step.record, labels, coupling_jacobian(self.robot.description)
            ),
            first=0,
            targets=TargetBatch(free, free, Tolerance(), enforce_limits=True, q0=trajectory.q[:1]),
            batch=batch,
            rows=rows,
            started=np.array([started]),
        )
        with McapRecorder(
            path,
            robot_name=self.robot.name,
            urdf=self.robot.urdf(),
            parameters=parameters,
            seed=0,
        ) as recorder:
            recorder.record(block)


@lru_cache(maxsize=64)
def _step(robot: RobotDescription, task: ScrewTask) -> ScrewControlStep:
    return ScrewControlStep(robot, task)


@lru_cache(maxsize=64)
def _kernel(step: ScrewControlStep, compiled: bool) -> LoopKernel:
    return LoopKernel(step.graph(), compiled)


@lru_cache(maxsize=64)
def _target_kernel(step: ScrewControlStep, compiled: bool) -> FunctionKernel:
    return FunctionKernel(step.target_function, compiled)


def _number(
    name: str, value: Any, *, above: float = -math.inf, lower: float = -math.inf, upper=math.inf
) -> float:
    """Return a finite number that is > `above` and within [`lower`, `upper`].

    Raises:
        InputError: The value is not such a number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if math.isfinite(number) and number > above and lower <= number <= upper:
        return number
    bounds = f" from {lower} to {upper}" if upper < math.inf else f" >= {lower}"
    bounds = f" > {above}" if above > -math.inf else bounds
    raise InputError(f"{name}: found {value!r}, expected a number{bounds}")


def _per_actuator(name: str, value: ArrayLike, n: int) -> Array:
    """Return a checked non-negative value per actuator."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (n,)) or np.isnan(array).any() or (array < 0).any():
        raise InputError(f"{name}: found {value!r}, expected () or ({n},) numbers >= 0")
    return np.broadcast_to(array, (n,)).astype(float)
