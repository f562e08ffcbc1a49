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
from casadi_ik.solve.limits import coupling_jacobian
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
        error_norm: (s + 1,) their norm; of a pose the screw error norm of Chandra eq. (17).
        sigma: (s + 1,) smallest singular value of the Jacobian over half ranges.
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
            floor: Norms at or below it are rounding and left out.

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
        task: What the fingertip is to do.
        gain: [1/s]; `gain * period` of the error is removed in a step.
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
            robot: From `load_robot`.
            task: What the fingertip is to do.
            gain: [1/s], with 0 < gain * period < 2.
            period: Time between two steps [s].
            centring: Part of its way back to mid-range that each actuator goes per step, as far
                as the task leaves it free; 0 keeps still what the task does not move.
            damping: Of the least squares [unit of a singular value of J over half ranges].
            length: Length that counts as much as a radian [m]; it matters only where a task cannot
                be fulfilled. The paper adds m and rad as they are: 1.
            speed: Fastest motion of an actuator, () or (n,) [unit/s]; None is unlimited.
            resolution: Steps in which an actuator can be commanded, () or (n,) [rad or m], counted
                from its lower limit; None or 0 is continuous.
            compiled: False keeps to CasADi's virtual machine: the same iterates up to rounding,
                slower.

        Raises:
            UnknownNameError: The task names a finger that the robot does not have.
            InputError: A number that cannot be.
        """
        if not isinstance(robot, ArmHand):
            raise InputError(f"robot: found {robot!r}, expected what load_robot returns")
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
            "centring": _number("centring", centring, least=0.0, most=1.0),
            "length": _number("length", length, above=0.0),
            "largest_step": np.minimum(_each("speed", fastest, n) * self.period, UNLIMITED),
            "resolution": _each("resolution", 0.0 if resolution is None else resolution, n),
        }
        task.chain(robot.description)  # refuses unknown fingers now, not at the run
        self._step = _step(robot.description, task)
        self._compiled = compiled

    @property
    def kernel(self) -> LoopKernel:
        """Compiled loop, shared by all gains."""
        return _kernel(self._step, self._compiled)

    @property
    def parameters(self) -> dict[str, Any]:
        """Settings of a run except target and start, as stored in the log."""
        task = {"kind": self.task.kind, "finger": self.task.finger}
        task |= {"relative_to": self.task.relative_to, "axis": self.task.axis}
        numbers = {name: np.asarray(value).tolist() for name, value in self._numbers.items()}
        return {"method": "screw-control", "task": task, "period": self.period, **numbers}

    def target(self, q: ArrayLike) -> dict[str, Array]:
        """Return the target that a posture meets.

        Args:
            q: (n,) actuator positions [rad or m].

        Raises:
            InputError: Wrong shape or numbers.

        Example:
            >>> ar10 = ik.load_robot("ar10")
            >>> control = ik.papers.ScrewControl(ar10, ik.papers.ScrewTask("pose", "index"))
            >>> {name: value.shape for name, value in control.target(ar10.home).items()}
            {'pose': (8,)}
        """
        fulfilled = _target_kernel(self._step, self._compiled)(self._posture(q, "q"))
        names = [field.name for field in self.task.target_fields]
        return dict(zip(names, fulfilled, strict=True))

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
            q0: (n,) start [rad or m], moved into the limits; None is `robot.home`.
            target: By name: "pose" as a (4, 4) matrix or an (8,) unit dual quaternion, "point"
                (3,) [m], "normal" (3,), "distance" [m], as the task needs them; in the base frame,
                or in the contact frame of the task's `relative_to`.
            steps: How many steps to make at most; a run that comes to stand still for ever ends.
            tolerance: Error norm at which the run ends; 0: none.
            log: Path of an MCAP file to write every step to.

        Raises:
            InputError: Bad start or target.
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
            "tolerance": _number("tolerance", tolerance, least=0.0),
        }
        asked = self._checked(target)
        began = time.time_ns()
        # A row tells of the state before its step: one more shows where the last step led.
        result = self.kernel.run(
            start[None], self._step.parameter_vector(asked, numbers), int(steps) + 1, trace=True
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
            self._write(log, parameters, began, float(result.time[0]), trajectory, rows)
        return trajectory

    def stepper(self, q0: ArrayLike | None, target: Mapping[str, ArrayLike]) -> Stepper:
        """Return an iterator over single steps of the law; arguments and errors as in `run`."""
        start = np.clip(self._posture(q0, "q0"), self.robot.lower, self.robot.upper)
        numbers = {**self._numbers, "tolerance": 0.0}
        vector = self._step.parameter_vector(self._checked(target), numbers)
        return Stepper(self.kernel, start, vector)

    def _posture(self, q: ArrayLike | None, name: str) -> Array:
        array = self.robot.configuration(q, name)
        if array.ndim != 1:
            raise InputError(f"{name}: found shape {array.shape}, expected ({array.shape[1]},)")
        return array

    def _checked(self, target: Mapping[str, ArrayLike]) -> dict[str, Array]:
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
                    raise InputError(f"target: {name}: is zero, expected a unit")
                value = value / length
            checked[name] = value
        return checked

    def _write(
        self,
        path: str | PathLike[str],
        parameters: dict[str, Any],
        began: int,
        seconds: float,
        trajectory: Trajectory,
        rows: NDArray[Any],
    ) -> None:
        """Return a run as one solve of a log, with free contacts."""
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
            targets=TargetBatch(free, free, Tolerance(), enforce_limits=True),
            starts=trajectory.q[:1],
            seed=0,
            batch=batch,
            rows=rows,
            started=np.array([began]),
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
    name: str, value: Any, *, above: float = -math.inf, least: float = -math.inf, most=math.inf
) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if math.isfinite(number) and number > above and least <= number <= most:
        return number
    bounds = f" > {above}" if above > -math.inf else f" from {least} to {most}"
    raise InputError(f"{name}: found {value!r}, expected a number{bounds}")


def _each(name: str, value: ArrayLike, n: int) -> Array:
    """Return a checked non-negative value per actuator."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (n,)) or np.isnan(array).any() or (array < 0).any():
        raise InputError(f"{name}: found {value!r}, expected () or ({n},) numbers >= 0")
    return np.broadcast_to(array, (n,)).astype(float)
