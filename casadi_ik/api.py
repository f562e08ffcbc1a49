"""`Solver`, the main class of the package: inverse kinematics of grasps."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Iterable, Mapping
from functools import cached_property, partial
from os import PathLike
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.clearance import Clearances, SceneCheck
from casadi_ik.collision.scene import Scene, grasped_in
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.input_checks import checked_pose, single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs import Compression, Keep
from casadi_ik.logs.writer import recorder_of
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import LIMIT_MODES, Tolerance
from casadi_ik.motion.moving import MovingSolver
from casadi_ik.papers.qiu.step import FINGER_STEPS
from casadi_ik.planning.choose import choose
from casadi_ik.planning.object_pose import solve_with_object
from casadi_ik.planning.reach.compute_map import reach_map
from casadi_ik.planning.reach.place_base import place_base
from casadi_ik.planning.touch.grasps import grasps_of
from casadi_ik.solve.alternatives import DEFAULT_SEPARATION
from casadi_ik.solve.best_effort import BestEffort
from casadi_ik.solve.engine import Engine, SolvedBlock, SolveOptions
from casadi_ik.solve.fast import FastSolver
from casadi_ik.solve.hand_postures import broadcast_postures
from casadi_ik.solve.recorder import Recorder
from casadi_ik.solve.registry import build_method, method_names, with_finger_step
from casadi_ik.solve.sensitivity import Sensitivity
from casadi_ik.solve.solution import Alternative, BatchSolution, Solution
from casadi_ik.solve.target_builder import TargetBuilder, tolerances_by_finger

METHODS = method_names()
"""Names of the shipped methods, the default first."""


class Solver(MovingSolver):
    """Solves grasps of one robot by one method; build it once and use it for every grasp.

    Attributes:
        robot: The robot.
        method: Name of the method.
        tolerances: Tolerance by finger.
        limits: "enforce" or "ignore".
        options: Parameters of the method that differ from their defaults.
        scene: Obstacles that solutions must not touch; None: collisions are not checked.

    Example:
        >>> solver = ik.Solver(robot, tolerance=ik.Tolerance(position=1e-3, angle=np.deg2rad(1)))
        >>> solver.solve(grasp).success
        True
    """

    def __init__(
        self,
        robot: ArmHand,
        method: str = METHODS[0],
        tolerance: Tolerance | Mapping[str, Tolerance] | None = None,
        limits: str = "enforce",
        finger_step: str | None = None,
        options: Mapping[str, Any] | None = None,
        compiled: bool = True,
        scene: Scene | None = None,
    ) -> None:
        """Build the solver; its kernel is compiled at the first solve and cached on the machine.

        Args:
            robot: Robot from `load_robot`.
            method: One of `METHODS`, or a name registered with `register_method`.
            tolerance: Tolerance of all fingers, or by finger name (other fingers keep the
                default); default: 5 mm and 3 deg. A tolerance stated by a contact takes precedence.
            limits: "enforce": a solution has every actuator and joint within its limits.
                "ignore": only the contacts decide (the paper's reading).
            finger_step: Option of this name: "ipopt" (default of the paper's methods) or
                "closed-form" (the same result, much faster). Ignored by methods without it.
            options: Fields of the method's parameter record (`QiuParameters`), by name. For
                hand-first, {"max_rounds": 1} limits the effort, see `HandFirstParameters`.
            compiled: False: use CasADi's virtual machine, which gives the same iterates up to
                rounding and is slower.
            scene: Obstacles around the robot (`load_scene`, `Scene`). A solution then keeps the
                scene's margin to obstacles and between links.

        Raises:
            UnknownNameError: The method or an option does not exist.
            InputError: An argument has an invalid value.
            UnsupportedError: The robot has no motors, the method does not support it, or a scene is
                given and it has no shapes.
            DescriptionError: The scene does not fit the robot.
        """
        if not isinstance(robot, ArmHand):
            raise InputError(f"robot: found {robot!r}, expected what load_robot returns")
        if not robot.actuators:
            raise UnsupportedError(
                f"robot: {robot.name} has no motors; expected one with motors, such as "
                f"load_robot('ur5e+{robot.name}')"
            )
        if limits not in LIMIT_MODES:
            raise InputError(f"limits: found {limits!r}, expected one of {', '.join(LIMIT_MODES)}")
        if scene is not None and not isinstance(scene, Scene):
            raise InputError(f"scene: found {scene!r}, expected a Scene, or None")
        if finger_step is not None and finger_step not in FINGER_STEPS:
            raise InputError(
                f"finger_step: found {finger_step!r}, expected one of {', '.join(FINGER_STEPS)}"
            )
        self._init_args: dict[str, Any] = {
            "robot": robot,
            "method": method,
            "tolerance": tolerance,
            "limits": limits,
            "finger_step": finger_step,
            "options": options,
            "compiled": compiled,
            "scene": scene,
        }
        self.robot = robot
        self.method = method
        self.tolerances = tolerances_by_finger(tolerance, robot.fingers)
        self.limits = limits
        self.options = with_finger_step(method, options or {}, finger_step)
        self.scene = scene
        check = None if scene is None else SceneCheck(robot, scene, compiled)
        built_method = build_method(method, robot.description, self.options, compiled)
        self._engine = Engine(robot, built_method, compiled, check=check)
        self._target_builder = TargetBuilder(
            robot, self.tolerances, limits == "enforce", built_method, has_scene=scene is not None
        )

    @cached_property
    def _single_restart_engine(self) -> Engine:
        """Engine limited to one restart, for screening many targets until one is solved."""
        if self._engine.hand_search is None:
            return self._engine
        method, options = self.method, {**self.options, "max_rounds": 1}
        built_method = build_method(method, self.robot.description, options, self._engine.compiled)
        return Engine(self.robot, built_method, self._engine.compiled, check=self._engine.check)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the init arguments; a copy finds compiled kernels in the cache of its machine."""
        return partial(type(self), **self._init_args), ()

    def __repr__(self) -> str:
        return f"<Solver {self.method} on {self.robot.name}, limits {self.limits}>"

    @property
    def parameters(self) -> dict[str, Any]:
        """Method, tolerances, limits and options of every solve, as in the log.

        Example:
            >>> solver.parameters["method"], solver.parameters["limits"]
            ('hand-first', 'enforce')
        """
        return {
            "method": self.method,
            "tolerance": {
                name: dataclasses.asdict(tolerance) for name, tolerance in self.tolerances.items()
            },
            "limits": self.limits,
            "options": dict(self._engine.method.parameters),
        } | ({} if self.scene is None else {"scene": self.scene.name})

    def solve(
        self,
        grasp: Grasp,
        q0: ArrayLike | None = None,
        seed: int = 0,
        log: str | PathLike[str] | None = None,
        diagnose: bool = True,
        fixed: Mapping[str, float] | None = None,
        prefer: str | None = None,
        best_effort: bool | str | BestEffort = False,
    ) -> Solution:
        """Solve one grasp.

        Args:
            grasp: Contacts by finger, or palm poses with hand postures.
            q0: (n,) start [rad or m]; None: `robot.home`.
            seed: Seed of all random numbers, an integer >= 0.
            log: Path of an MCAP file that records every iteration.
            diagnose: Whether to diagnose an unsolved grasp (`Solution.diagnosis`).
            fixed: Positions of actuators to keep fixed, by name [rad or m].
            prefer: Order among several solutions: "q0" (near it, motors relative to their ranges;
                a start that solves the grasp is returned unchanged), "limits" (far from them),
                "manipulability" (of the arm), "clearance" (from obstacles). None: "q0" if q0 is
                given, else "limits".
            best_effort: Whether to return the nearest configuration found of a grasp that is not
                solved, with status NEAREST: the sum of its squared contact errors, each divided by
                its tolerance, is least. "local": the local minimum that is reached from q0, so that
                a robot that follows a moving target does not jump. `BestEffort`: with weights, or
                the least largest error.

        Returns:
            The solution; failure to converge is a status, never an exception.

        Raises:
            InputError: Bad q0, or a grasp that the robot or the method does not support.
            UnknownNameError: A fixed actuator does not exist.
            UnsupportedError: The method does not support fixed actuators, or this preference.
            LogError: The log cannot be written.

        Example:
            >>> solution = solver.solve(grasp, q0=robot.home)
            >>> solution.status.name, solution.q.shape
            ('SOLVED', (14,))
            >>> solution = solver.solve(grasp, fixed={"lwr_joint_3": 0.2})
            >>> print(round(solution.q[2], 6))
            0.2
        """
        targets = self._target_builder.from_grasps(
            [grasp], fixed=fixed, q0=q0, prefer=prefer, seed=seed, allow_free_pose=True
        )
        if isinstance(grasp.object_pose, Free):
            if log is not None:
                raise InputError("log: a Free object_pose cannot be logged; expected a fixed pose")
            return solve_with_object(
                lambda group, why: self._engine.solve(group, SolveOptions(diagnose=why)),
                lambda group: self._single_restart_engine.solve(group, SolveOptions()),
                lambda group, most: self._engine.diagnostician.prove(group, most),
                targets,
                grasp.object_pose,
                self.robot,
            )
        if log is None:
            options = SolveOptions(diagnose=diagnose, best_effort=best_effort)
            return self._engine.solve_one(targets, options)
        with recorder_of(self, log, seed) as recorder:
            options = SolveOptions(recorder=recorder, diagnose=diagnose, best_effort=best_effort)
            return self._engine.solve(targets, options).solution(0)

    def solve_batch(
        self,
        points: ArrayLike,
        normals: ArrayLike,
        q0: ArrayLike | None = None,
        seed: int = 0,
        jobs: int = 1,
        log: str | PathLike[str] | Recorder | None = None,
        diagnose: bool = False,
        fixed: Mapping[str, float] | None = None,
        keep: Keep | None = None,
        compression: Compression = "zstd",
        prefer: str | None = None,
        object_pose: ArrayLike | None = None,
        best_effort: bool | str | BestEffort = False,
        **extra_vectors: ArrayLike | None,
    ) -> BatchSolution:
        """Solve k targets.

        Args:
            points: (k, f, 3) contact points [m], base frame, fingers in `robot.fingers` order;
                NaN marks a free finger.
            normals: (k, f, 3) outward pad normals, base frame; NaN marks a free normal.
            q0: (n,) or (k, n) start; None: `robot.home`.
            seed: See `solve`.
            jobs: Number of threads, at least 1.
            log: Path of an MCAP file that records every iteration; or an open recorder, which
                stays open, to record several batches in one log.
            diagnose: Whether to diagnose every unsolved target.
            fixed: See `solve`.
            keep: Which solves keep their iterations in the log; None: all.
            compression: Compression of the log: "zstd" (level 1), "lz4" or "none".
            prefer: See `solve`.
            object_pose: (4, 4) or (k, 4, 4) pose of the grasped item of the scene, base frame.
            best_effort: See `solve`.
            extra_vectors: (k, f, 3) further vectors by name, NaN where free: "tangents" (second
                axes of `ArmHand.contact_frames`), "lines" and "planes" (the point may lie anywhere
                on them), "balls" (outward normals of ball pads that touch the points),
                "directions" (directions of fingertips without a point).

        Returns:
            The fields of a `Solution`, as arrays.

        Raises:
            InputError: Bad shapes or values; the message names row and finger. Else as `solve`.

        Example:
            >>> points, normals = robot.contacts(robot.random(np.random.default_rng(0), 1000))
            >>> batch = solver.solve_batch(points, normals)
            >>> batch.q.shape, bool(batch.success.all())
            ((1000, 14), True)
        """
        targets = self._target_builder.from_arrays(
            points, normals, extra_vectors, fixed=fixed, q0=q0, prefer=prefer, seed=seed
        )
        if object_pose is not None:
            targets = targets.holding(grasped_in(self.scene), object_pose)
        with recorder_of(self, log, seed, keep, compression) as recorder:
            options = SolveOptions(
                jobs, recorder, diagnose, show_progress=True, best_effort=best_effort
            )
            return self._engine.solve(targets, options)

    def solve_blocks(
        self,
        blocks: Iterable[tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike]],
        q0: ArrayLike | None = None,
        seed: int = 0,
        jobs: int = 1,
        log: str | PathLike[str] | None = None,
        diagnose: bool = False,
        fixed: Mapping[str, float] | None = None,
        prefer: str | None = None,
        first_row: int = 0,
        best_effort: bool | str | BestEffort = False,
    ) -> Generator[SolvedBlock, None, None]:
        """Solve a stream of targets block by block, in the memory of one block.

        Results do not depend on the division into blocks. A malformed target does not affect the
        others: it is listed in the faults of its block.

        Args:
            blocks: Points and normals of each block, as for `solve_batch`; or all of its arrays
                by name.
            q0: (n,) start of all targets; None: `robot.home`.
            seed: See `solve_batch`.
            jobs: Number of threads, at least 1; blocks of a few thousand targets keep them busy.
            log: Path of an MCAP file that records every iteration; complete after the last block,
                and abandoned if the iterator is closed before.
            diagnose: See `solve_batch`.
            fixed: See `solve_batch`.
            prefer: See `solve_batch`.
            first_row: Number of the first target, if the stream is part of a larger one.
            best_effort: See `solve`.

        Yields:
            The solved blocks.

        Raises:
            InputError: Bad q0, seed or jobs, or a block of the wrong shape; else as `solve_batch`.

        Example:
            >>> rng = np.random.default_rng(0)
            >>> blocks = (robot.contacts(robot.random(rng, 500)) for _ in range(3))
            >>> [int(block.solution.success.sum()) for block in solver.solve_blocks(blocks)]
            [500, 500, 500]
        """
        start = None if q0 is None else self._target_builder.start(q0)
        parse = partial(
            self._target_builder.from_named_arrays,
            fixed=fixed,
            q0=start,
            prefer=prefer,
            seed=seed,
        )
        with recorder_of(self, log, seed) as recorder:
            tolerances = tuple(self.tolerances.values())
            options = SolveOptions(jobs, recorder, diagnose, best_effort=best_effort)
            yield from self._engine.solve_blocks(blocks, parse, tolerances, options, first_row)

    def stepper(self, grasp: Grasp, q0: ArrayLike | None = None) -> Stepper:
        """Return a stepper that solves one grasp iteration by iteration.

        Args:
            grasp: See `solve`.
            q0: See `solve`.

        Raises:
            InputError: As for `solve`.
            UnsupportedError: The method cannot be stepped; the message says why.

        Example:
            >>> stepper = solver.stepper(grasp)
            >>> type(stepper).__name__
            'Stepper'
        """
        start = None if q0 is None else self._target_builder.start(q0)
        targets = self._target_builder.from_grasps([grasp], q0=start)
        return self._engine.engine_for(targets).method.stepper(targets)

    def fast(self) -> FastSolver:
        """Return a solver of single targets for control loops, see `FastSolver`.

        Raises:
            UnsupportedError: The method is not hand-first, or the solver has a scene.

        Example:
            >>> fast = solver.fast()
            >>> points, normals = robot.contacts(robot.home)
            >>> q, status = fast(points, normals, robot.home)
            >>> ik.Status(status).name
            'SOLVED'
        """
        return FastSolver(self._engine, self._target_builder)

    def solve_all(
        self,
        grasp: Grasp,
        limit: int = 16,
        prefer: str = "limits",
        q0: ArrayLike | None = None,
        seed: int = 0,
        fixed: Mapping[str, float] | None = None,
        apart: float = DEFAULT_SEPARATION,
    ) -> tuple[Alternative, ...]:
        """Find different solutions of one grasp, best first.

        For every hand posture that meets the contacts: each branch of an arm with a closed form
        (signs of shoulder, elbow and wrist) with the intervals of its redundancy, see `ArmBranch`,
        at its preferred configuration; for other arms the configurations to which several starts
        converge. Duplicates are removed.

        Args:
            grasp: Contacts by finger; the fingers must be the robot's.
            limit: Maximum number of solutions.
            prefer: Order of the solutions: "limits" (far from its limits), "manipulability" (of
                the arm), "clearance", or "q0" (close to it).
            q0: (n,) current configuration [rad or m]; None: `robot.home`.
            seed: See `solve`.
            fixed: See `solve`.
            apart: Minimum difference of two solutions: one actuator at least differs by this
                fraction of its range, 0 to 1. 0: all solutions.

        Returns:
            The solutions; empty if the grasp cannot be solved (`solve` says why).

        Raises:
            InputError: Bad limit, preference, difference or q0, or an unsupported grasp.

        Example:
            >>> several = solver.solve_all(grasp, limit=4, prefer="manipulability")
            >>> len(several), several[0].manipulability >= several[1].manipulability
            (4, True)
        """
        targets = self._target_builder.from_grasps([grasp], fixed=fixed, seed=seed)
        query = self._engine.collision_query(targets)
        targets = targets.starting_at(self._target_builder.start(q0))
        return self._engine.engine_for(targets).finder.find(targets, limit, prefer, apart, query)

    def solve_palms(
        self,
        palms: ArrayLike,
        postures: Mapping[str, ArrayLike] | ArrayLike,
        q0: ArrayLike | None = None,
        seed: int = 0,
        jobs: int = 1,
        diagnose: bool = False,
        fixed: Mapping[str, float] | None = None,
        prefer: str | None = None,
        best_effort: bool | str | BestEffort = False,
    ) -> BatchSolution:
        """Solve k palm poses with known hand postures: only the arm is unknown.

        Args:
            palms: (k, 4, 4) poses of `robot.palm` in the base frame.
            postures: Positions (k,), or one for all, of every motor that moves a finger, by name
                [rad or m]; or configurations (k, n) or (n,) from which these motors are taken.
            q0: (n,) or (k, n) start; None: `robot.home`.
            seed: See `solve`.
            jobs: Number of threads, at least 1.
            diagnose: See `solve_batch`.
            fixed: See `solve`; for actuators of the arm.
            prefer: See `solve`.
            best_effort: See `solve`; the hands keep their postures.

        Returns:
            As `solve_batch`, with `palm_position_error`, `palm_angle_error` and `palm_ok`.

        Raises:
            InputError: The poses are not rigid, or postures are incomplete or beyond limits.
            UnknownNameError: An actuator does not exist.
            UnsupportedError: The method is not hand-first, or the robot has several arms.

        Example:
            >>> q = robot.random(np.random.default_rng(4), 50)
            >>> hands = dict(zip(robot.actuators[7:], q[:, 7:].T))  # or q itself
            >>> batch = solver.solve_palms(robot.palm(q), hands)
            >>> bool(batch.success.all()), bool(batch.palm_position_error.max() < 1e-3)
            (True, True)
        """
        self.robot.description.require_single_hand("solve_palms")
        poses = checked_pose(palms, "palms")
        if poses.ndim != 3:
            raise InputError(f"palms: found shape {poses.shape}, expected (k, 4, 4)")
        hands = broadcast_postures(self.robot, postures, len(poses))
        targets = self._target_builder.from_palms(
            poses, hands, fixed=fixed, q0=q0, prefer=prefer, seed=seed
        )
        options = SolveOptions(jobs, diagnose=diagnose, show_progress=True, best_effort=best_effort)
        return self._engine.solve(targets, options)

    choose = choose
    reach_map = reach_map
    place_base = place_base
    grasps_of = grasps_of

    def sensitivity(
        self,
        q: ArrayLike,
        points: ArrayLike,
        normals: ArrayLike,
        gradient: ArrayLike | None = None,
        **extra_vectors: ArrayLike | None,
    ) -> Sensitivity:
        """Return the derivatives of solutions by their targets (implicit function theorem).

        Remaining contact errors stay constant in the least-squares sense, motors at a limit stay
        there, and motions that the contacts leave free are zero.

        Args:
            q: (k, n) solutions [rad or m].
            points: (k, f, 3) contact points [m], as for `solve_batch`.
            normals: (k, f, 3) pad normals.
            gradient: (k, n) gradient of a scalar by q [1/rad or 1/m]: the result is its gradient
                by the contacts, which is cheaper. None: the derivatives of q.
            extra_vectors: See `solve_batch`.

        Returns:
            Derivatives (k, n, f, 3) of q by points [rad/m or 1] and by normals [rad or m]; with a
            gradient (k, f, 3).

        Raises:
            InputError: Bad shapes or values, or targets of several contact kinds.

        Example:
            >>> points, normals = robot.contacts(solution.q[None])
            >>> rates = solver.sensitivity(solution.q[None], points, normals)
            >>> rates.points.shape
            (1, 14, 3, 3)
        """
        configurations = self.robot.configuration(q)
        targets = self._target_builder.from_arrays(points, normals, extra_vectors)
        k, n = len(targets), len(self.robot.actuators)
        if configurations.shape != (k, n):
            raise InputError(f"q: found shape {configurations.shape}, expected {(k, n)}")
        kernel = self._engine.engine_for(targets).sensitivity
        if gradient is not None:
            gradients = np.asarray(gradient, dtype=float)
            if gradients.shape != (k, n):
                raise InputError(f"gradient: found shape {gradients.shape}, expected {(k, n)}")
            return kernel(targets, configurations, gradients)
        rows = np.repeat(np.arange(k), n)
        rates = kernel(targets.rows(rows), configurations[rows], np.tile(np.eye(n), (k, 1)))
        f = len(self.robot.fingers)
        return Sensitivity(rates.points.reshape(k, n, f, 3), rates.normals.reshape(k, n, f, 3))

    def moved(self, name: str, pose: ArrayLike) -> Self:
        """Return the solver with an item of its scene at another pose, within a millisecond.

        Args:
            name: Name of the item.
            pose: (4, 4) pose of the item in the base frame.

        Raises:
            InputError: The solver has no scene, or the pose is not rigid.
            UnknownNameError: The scene has no such item.
            DescriptionError: The item would penetrate the robot's base.

        Example:
            >>> lower = np.eye(4)
            >>> lower[2, 3] = -0.3
            >>> at_table = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> at_table.moved("table", lower).solve(grasp).status.name
            'SOLVED'
        """
        check = self._engine.check
        if check is None:
            raise InputError(f"{name}: the solver has no scene; expected one with this item")
        moved_check = check.moved(name, single_pose(pose))
        # `copy` would call `__reduce__`, which builds a new engine.
        solver = object.__new__(type(self))
        solver.__dict__.update(self.__dict__)
        solver.scene, solver._engine = moved_check.scene, self._engine.with_scene(moved_check)
        solver._init_args = {**self._init_args, "scene": moved_check.scene}
        return solver

    @property
    def scene_check(self) -> SceneCheck | None:
        """Collision check of the scene; None without a scene."""
        return self._engine.check

    def check(self, q: ArrayLike, grasp: Grasp) -> Clearances | None:
        """Return the clearances of configurations.

        Args:
            q: (n,) or (k, n) actuator positions [rad or m].
            grasp: Grasp whose fingers may touch the grasped item.

        Returns:
            Clearances of the k configurations (one for a single q); None without a scene.

        Raises:
            InputError: Bad q, or an unsupported grasp.

        Example:
            >>> at_table = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> bool(at_table.check(solution.q, grasp).distance[0] > 0)
            True
        """
        query = self._engine.collision_query(self._target_builder.from_grasps([grasp]))
        return query and query.check(np.atleast_2d(self.robot.configuration(q)))
