"""`Solver`: the one object that turns grasps into motor positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from os import PathLike
from typing import Any

from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.grasps import Grasp
from casadi_ik.logs import Compression, Keep, McapRecorder
from casadi_ik.solvers import (
    FINGER_STEPS,
    LIMITS,
    METHODS,
    BatchSolution,
    Engine,
    Problems,
    Recorder,
    Solution,
    SteppedMethod,
    Stepper,
    Tolerance,
    build_method,
    method_options,
    target_arrays,
)


class Solver:
    """A method on a robot, with a tolerance; build it once and use it for every grasp.

    Attributes:
        robot: The robot.
        method: Name of the method.
        tolerance: When a contact counts as reached.
        limits: "enforce" or "ignore".
        options: What was set of the method's own parameters.
    """

    def __init__(
        self,
        robot: ArmHand,
        method: str = METHODS[0],
        tolerance: Tolerance | None = None,
        limits: str = "enforce",
        finger_step: str | None = None,
        options: Mapping[str, Any] | None = None,
        compiled: bool = True,
    ) -> None:
        """Build the solver; its kernel is compiled at the first solve and cached on the machine.

        Args:
            robot: From `load_robot`.
            method: One of `METHODS`.
            tolerance: 5 mm and 3 deg unless said.
            limits: "enforce": being solved includes that every actuator and joint is within its
                limits. "ignore": only the contacts decide (the paper's reading).
            finger_step: "ipopt" (the default of the paper's methods) or "closed-form", the same
                answer, much faster. Methods without a finger step take no notice.
            options: Other fields of the method's parameter record (`QiuParameters`).
            compiled: False keeps to CasADi's virtual machine: the same iterates, slower.

        Raises:
            UnknownNameError: No such method or option.
            InputError: A value that an argument cannot have.
            UnsupportedError: The robot is not of the kind the method needs.
        """
        if not isinstance(robot, ArmHand):
            raise InputError(f"robot: found {robot!r}, expected what load_robot returns")
        if tolerance is not None and not isinstance(tolerance, Tolerance):
            raise InputError(f"tolerance: found {tolerance!r}, expected a Tolerance")
        if limits not in LIMITS:
            raise InputError(f"limits: found {limits!r}, expected one of {', '.join(LIMITS)}")
        self.robot = robot
        self.method = method
        self.tolerance = tolerance or Tolerance()
        self.limits = limits
        self.options = dict(options or {})
        if finger_step is not None and finger_step not in FINGER_STEPS:
            raise InputError(
                f"finger_step: found {finger_step!r}, expected one of {', '.join(FINGER_STEPS)}"
            )
        if finger_step is not None and "finger_step" in method_options(method):
            self.options["finger_step"] = finger_step
        self._engine = Engine(
            robot, build_method(method, robot.description, self.options, compiled), compiled
        )

    def __repr__(self) -> str:
        return f"<Solver {self.method} on {self.robot.name}, limits {self.limits}>"

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything that determines a solve but target, start and seed; as kept in the log."""
        return {
            "method": self.method,
            "tolerance": dataclasses.asdict(self.tolerance),
            "limits": self.limits,
            "options": dict(self._engine.method.parameters),
        }

    def solve(
        self,
        grasp: Grasp,
        q0: ArrayLike | None = None,
        seed: int = 0,
        log: str | PathLike[str] | None = None,
        diagnose: bool = True,
    ) -> Solution:
        """Solve one grasp.

        Args:
            grasp: A contact per finger; its fingers must be the robot's.
            q0: (n,) start [rad or m]; None is `robot.home`.
            seed: Of all random numbers, an integer >= 0.
            log: Path of an MCAP file to write every iteration to.
            diagnose: Whether to find out why, if it is not solved (`Solution.diagnosis`).

        Returns:
            The solution; not converging is its status, never an exception.

        Raises:
            InputError: Bad q0, or a grasp the robot or the method cannot take.
            LogError: The log cannot be written.
        """
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasp: found {type(grasp).__name__}, expected a Grasp")
        points, normals = grasp.arrays(self.robot.fingers)
        batch = self.solve_batch(points[None], normals[None], q0, seed, log=log, diagnose=diagnose)
        return batch.solution(
            0, self.method, self.robot.name, self.robot.actuators, self.robot.fingers
        )

    def solve_batch(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        q0: ArrayLike | None = None,
        seed: int = 0,
        jobs: int = 1,
        log: str | PathLike[str] | Recorder | None = None,
        diagnose: bool = False,
        keep: Keep | None = None,
        compression: Compression = "zstd",
    ) -> BatchSolution:
        """Solve k targets.

        Args:
            points: (k, f, 3) contact points [m], base frame, fingers in `robot.fingers` order;
                NaN marks a free finger.
            normals: (k, f, 3) outward pad normals, base frame; NaN marks a free normal.
            q0: (n,) or (k, n) start; None is `robot.home`.
            seed: Of all random numbers, an integer >= 0.
            jobs: Threads, at least 1.
            log: Path of an MCAP file to write every iteration to; or an open recorder, which
                stays open, for several batches in one log.
            diagnose: Whether to find out why, for every target that is not solved
                (`BatchSolution.diagnoses`).
            keep: Which solves keep their iterations in the log; None: all.
            compression: Of the log: "zstd" (level 1), "lz4" or "none".

        Returns:
            The same fields as a `Solution`, as arrays.

        Raises:
            InputError: Bad shapes or values; the message names row and finger.
            LogError: The log cannot be written.
        """
        p, n = target_arrays(points, normals, len(self.robot.fingers))
        problems = Problems(p, n, self.tolerance, self.limits == "enforce")
        with self._recorder(log, seed, keep, compression) as recorder:
            return self._engine.solve(problems, q0, seed, jobs, recorder, diagnose)

    def stepper(self, grasp: Grasp, q0: ArrayLike | None = None) -> Stepper:
        """Solve one grasp by hand, one iteration at a time.

        Args:
            grasp: A contact per finger; its fingers must be the robot's.
            q0: (n,) start [rad or m]; None is `robot.home`.

        Raises:
            InputError: Bad q0, or a grasp the robot or the method cannot take.
            UnsupportedError: The method is not one step run to its end.
        """
        method = self._engine.method
        if not isinstance(method, SteppedMethod):
            raise UnsupportedError(f"method {self.method!r} cannot be stepped by hand")
        if not isinstance(grasp, Grasp):
            raise InputError(f"grasp: found {type(grasp).__name__}, expected a Grasp")
        points, normals = grasp.arrays(self.robot.fingers)
        targets = target_arrays(points[None], normals[None], len(self.robot.fingers))
        problems = Problems(*targets, self.tolerance, self.limits == "enforce")
        start = self.robot.configuration(q0, "q0")
        if start.ndim != 1:
            raise InputError(f"q0: found shape {start.shape}, expected ({len(start[0])},)")
        states, parameters = method.start(problems, start[None])
        return Stepper(method.kernel.step, states[0], parameters[0])

    def _recorder(
        self,
        log: str | PathLike[str] | Recorder | None,
        seed: int,
        keep: Keep | None,
        compression: Compression,
    ) -> AbstractContextManager[Recorder | None]:
        if not isinstance(log, str | PathLike):
            return nullcontext(log)
        return McapRecorder(
            log,
            robot_name=self.robot.name,
            urdf=self.robot.urdf(),
            parameters=self.parameters,
            seed=seed,
            keep=keep,
            compression=compression,
        )
