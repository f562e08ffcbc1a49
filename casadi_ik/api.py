"""`Solver`: the one object that turns grasps into motor positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Generator, Iterable, Mapping
from functools import cached_property
from os import PathLike
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.collision.clearance import Clearances, SceneCheck
from casadi_ik.collision.scene import Scene, grasped_in
from casadi_ik.compile.loop import Stepper
from casadi_ik.errors import InputError
from casadi_ik.files.input_checks.poses import checked_pose, single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.logs import Compression, Keep
from casadi_ik.logs.writer import recorder_of
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import Free
from casadi_ik.model.targets import LIMIT_MODES, TargetBatch, Tolerance
from casadi_ik.motion.moving import MovingSolver
from casadi_ik.papers.qiu.step import FINGER_STEPS
from casadi_ik.planning.choose import choose
from casadi_ik.planning.object_pose import solve_with_object
from casadi_ik.planning.touch.grasps import grasps_of
from casadi_ik.solve.alternatives import APART
from casadi_ik.solve.engine import Engine, Run, SolvedBlock
from casadi_ik.solve.fast import FastSolver
from casadi_ik.solve.recorder import Recorder
from casadi_ik.solve.registry import build_method, method_names, with_finger_step
from casadi_ik.solve.request import Request, hand_postures, tolerances_by_finger
from casadi_ik.solve.sensitivity import Sensitivity
from casadi_ik.solve.solution import Alternative, BatchSolution, Solution

METHODS = method_names()
"""Names of the methods that come with the package, the default first."""


class Solver(MovingSolver):
    """Solves grasps of one robot by one method; build it once and use it for every grasp.

    Attributes:
        robot: The robot.
        method: Name of the method.
        tolerances: When a contact counts as reached, by finger.
        limits: "enforce" or "ignore".
        options: What was set of the method's own parameters.
        scene: What answers must not touch; None: collisions are not checked.

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
            robot: From `load_robot`.
            method: One of `METHODS`, or registered with `register_method`.
            tolerance: 5 mm and 3 deg unless said; one for all fingers, or by finger name (a
                finger left out keeps the default). A contact's own tolerance goes before.
            limits: "enforce": being solved includes that every actuator and joint is within its
                limits. "ignore": only the contacts decide (the paper's reading).
            finger_step: The option of this name: "ipopt" (the default of the paper's methods) or
                "closed-form", the same answer, much faster. Methods without a finger step take no
                notice.
            options: Fields of the method's parameter record (`QiuParameters`), by name. Of
                hand-first {"max_rounds": 1} is the limit of effort: see `HandFirstParameters`.
            compiled: False keeps to CasADi's virtual machine: the same iterates up to rounding,
                slower.
            scene: What stands about the robot (`load_scene`, `Scene`): being solved then includes
                that nothing, links among themselves, is nearer than the scene's margin.

        Raises:
            UnknownNameError: No such method or option.
            InputError: A value that an argument cannot have.
            UnsupportedError: The robot is not of the kind the method needs, or has no shapes.
            DescriptionError: The scene does not fit the robot.
        """
        if not isinstance(robot, ArmHand):
            raise InputError(f"robot: found {robot!r}, expected what load_robot returns")
        if limits not in LIMIT_MODES:
            raise InputError(f"limits: found {limits!r}, expected one of {', '.join(LIMIT_MODES)}")
        if scene is not None and not isinstance(scene, Scene):
            raise InputError(f"scene: found {scene!r}, expected a Scene, or None")
        if finger_step is not None and finger_step not in FINGER_STEPS:
            raise InputError(
                f"finger_step: found {finger_step!r}, expected one of {', '.join(FINGER_STEPS)}"
            )
        self._asked = (robot, method, tolerance, limits, finger_step, options, compiled, scene)
        self.robot = robot
        self.method = method
        self.tolerances = tolerances_by_finger(tolerance, robot.fingers)
        self.limits = limits
        self.options = with_finger_step(method, options or {}, finger_step)
        self._request = Request(robot, self.tolerances, limits == "enforce")
        self.scene = scene
        check = None if scene is None else SceneCheck(robot, scene, compiled)
        built = build_method(method, robot.description, self.options, compiled)
        self._engine = Engine(robot, built, compiled, check=check)

    @cached_property
    def _glance(self) -> Engine:
        """For many targets of which one is enough: a round of hand postures each."""
        if self._engine.hand_first is None:
            return self._engine
        method, options = self.method, {**self.options, "max_rounds": 1}
        built = build_method(method, self.robot.description, options, self._engine.compiled)
        return Engine(self.robot, built, self._engine.compiled, check=self._engine.check)

    def __reduce__(self) -> tuple[type[Solver], tuple[Any, ...]]:
        """What it was made from; a copy finds the compiled kernels on the machine it comes to."""
        return type(self), self._asked

    def __repr__(self) -> str:
        return f"<Solver {self.method} on {self.robot.name}, limits {self.limits}>"

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything that determines a solve but target, start and seed; as kept in the log.

        Example:
            >>> solver.parameters["method"], solver.parameters["limits"]
            ('hand-first', 'enforce')
        """
        return {
            "method": self.method,
            "tolerance": {name: dataclasses.asdict(one) for name, one in self.tolerances.items()},
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
    ) -> Solution:
        """Solve one grasp.

        Args:
            grasp: A contact per finger; its fingers must be the robot's.
            q0: (n,) start [rad or m]; None is `robot.home`.
            seed: Of all random numbers, an integer >= 0.
            log: Path of an MCAP file to write every iteration to.
            diagnose: Whether to find out why, if it is not solved (`Solution.diagnosis`).
            fixed: Positions of actuators that are not to move, by name [rad or m].
            prefer: Which of several solutions: "q0" (near it, motions as parts of motors' ranges;
                what solves is not moved), "limits" (far from them), "manipulability" (of the arm).
                "clearance" (from what may be hit). None: "q0" if q0 is given, else "limits".

        Returns:
            The solution; not converging is its status, never an exception.

        Raises:
            InputError: Bad q0, or a grasp the robot or the method cannot take.
            UnknownNameError: A fixed actuator that the robot does not have.
            UnsupportedError: The method cannot keep actuators fixed, or cannot prefer this.
            LogError: The log cannot be written.

        Example:
            >>> solution = solver.solve(grasp, q0=robot.home)
            >>> solution.status.name, solution.q.shape
            ('SOLVED', (14,))
            >>> held = solver.solve(grasp, fixed={"lwr_joint_3": 0.2})
            >>> print(round(held.q[2], 6))
            0.2
        """
        targets = self._request.of_grasps(
            [grasp], fixed, self._engine.preference(prefer, q0 is not None), free=True
        )
        if isinstance(grasp.object_pose, Free):
            if log is not None:
                raise InputError("log: found beside a Free object_pose, expected one of them")
            start = self.robot.start(q0)
            return solve_with_object(
                lambda some, why: self._engine.solve(some, Run(start, seed, diagnose=why)),
                lambda some: self._glance.solve(some, Run(start, seed)),
                targets,
                grasp.object_pose,
                start,
                self.robot.upper - self.robot.lower,
            )
        if log is None:
            return self._engine.solve_one(targets, Run(q0, seed, diagnose=diagnose))
        with recorder_of(self, log, seed) as recorder:
            run = Run(q0, seed, recorder=recorder, diagnose=diagnose)
            return self._engine.solve(targets, run).solution(0)

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
        **more: ArrayLike | None,
    ) -> BatchSolution:
        """Solve k targets.

        Args:
            points: (k, f, 3) contact points [m], base frame, fingers in `robot.fingers` order;
                NaN marks a free finger.
            normals: (k, f, 3) outward pad normals, base frame; NaN marks a free normal.
            q0: (n,) or (k, n) start; None is `robot.home`.
            seed: As for `solve`.
            jobs: Threads, at least 1.
            log: Path of an MCAP file to write every iteration to; or an open recorder, which
                stays open, for several batches in one log.
            diagnose: Whether to find out why, for every target that is not solved.
            fixed: As for `solve`.
            keep: Which solves keep their iterations in the log; None: all.
            compression: Of the log: "zstd" (level 1), "lz4" or "none".
            prefer: As for `solve`.
            object_pose: (4, 4) or (k, 4, 4) where what the scene calls grasped is, base frame.
            more: (k, f, 3) by name, NaN where free: "tangents" (second axes of
                `ArmHand.contact_frames`), "lines", "planes" (anywhere on that through the point),
                "balls" (outward normals of the pads' balls where they touch the points),
                "directions" (a fingertip without a point faces this way).

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
        held = self._request.held(fixed)
        preferred = self._engine.preference(prefer, q0 is not None)
        targets = self._request.of_arrays(points, normals, held, more=more, prefer=preferred)
        if object_pose is not None:
            targets = targets.holding(grasped_in(self.scene), object_pose)
        with recorder_of(self, log, seed, keep, compression) as recorder:
            return self._engine.solve(targets, Run(q0, seed, jobs, recorder, diagnose, shown=True))

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
    ) -> Generator[SolvedBlock, None, None]:
        """Solve targets that come block by block, in the memory that one block takes.

        A target's answer does not depend on how the targets are cut into blocks. A malformed
        target does not stop the others: it is among the faults of its block.

        Args:
            blocks: Points and normals of some targets each, as for `solve_batch`; or all of its
                arrays by name.
            q0: (n,) start of all; as `seed`, `diagnose`, `fixed` and `prefer` for `solve_batch`.
            seed: See there.
            jobs: Threads, at least 1; a few thousand targets a block keep them busy.
            log: Path of an MCAP file to write every iteration to; complete after the last block,
                and given up if the iterator is closed before.
            diagnose: See there.
            fixed: See there.
            prefer: See there.
            first_row: Number of the first target, where these are a part of more.

        Yields:
            The blocks, solved.

        Raises:
            InputError: Bad q0, seed or jobs, or a block of the wrong shape; else as `solve_batch`.

        Example:
            >>> rng = np.random.default_rng(0)
            >>> blocks = (robot.contacts(robot.random(rng, 500)) for _ in range(3))
            >>> [int(block.solution.success.sum()) for block in solver.solve_blocks(blocks)]
            [500, 500, 500]
        """
        held = self._request.held(fixed)
        preferred = self._engine.preference(prefer, q0 is not None)

        def ask(block: Mapping[str, ArrayLike], first_row: int) -> TargetBatch:
            return self._request.of_named(block, held, first_row, preferred)

        with recorder_of(self, log, seed) as recorder:
            tolerances = tuple(self.tolerances.values())
            run = Run(q0, seed, jobs, recorder, diagnose)
            yield from self._engine.solve_blocks(blocks, ask, tolerances, run, first_row)

    def stepper(self, grasp: Grasp, q0: ArrayLike | None = None) -> Stepper:
        """Solve one grasp by hand, one iteration at a time.

        Args:
            grasp: As for `solve`.
            q0: As for `solve`.

        Raises:
            InputError: As for `solve`.
            UnsupportedError: The method cannot be stepped; the message says why.

        Example:
            >>> stepper = solver.stepper(grasp)
            >>> type(stepper).__name__
            'Stepper'
        """
        preferred = self._engine.preference(None, q0 is not None)
        targets = self._request.of_grasps([grasp], None, preferred)
        return self._engine.kinds_of(targets).method.stepper(targets, self._request.start(q0))

    def fast(self) -> FastSolver:
        """Solve for loops that cannot wait: see `FastSolver`.

        Raises:
            UnsupportedError: The method is not hand-first, or the solver has a scene.

        Example:
            >>> fast = solver.fast()
            >>> points, normals = robot.contacts(robot.home)
            >>> q, status = fast(points, normals, robot.home)
            >>> ik.Status(status).name
            'SOLVED'
        """
        return FastSolver(self._engine, self._request)

    def solve_all(
        self,
        grasp: Grasp,
        limit: int = 16,
        prefer: str = "limits",
        q0: ArrayLike | None = None,
        seed: int = 0,
        fixed: Mapping[str, float] | None = None,
        apart: float = APART,
    ) -> tuple[Alternative, ...]:
        """Find different solutions of one grasp, best first.

        For every hand posture that meets the contacts: of an arm in closed form every branch
        (signs of shoulder, elbow and wrist) with the intervals of its freedom, see `ArmBranch`,
        and the preferred arm of each; of another arm the different configurations that many
        starts lead to. Of two alike, one.

        Args:
            grasp: A contact per finger; its fingers must be the robot's.
            limit: How many at most.
            prefer: What comes first: "limits" (far from its limits), "manipulability" (of the
                arm), "clearance", or "q0" (close to it).
            q0: (n,) where the robot is [rad or m]; None is `robot.home`.
            seed: As for `solve`.
            fixed: As for `solve`.
            apart: How different they are: of any two, at least one actuator differs by this part
                of its range, 0 to 1. 0: all that are found.

        Returns:
            The solutions; none if the grasp cannot be solved (`solve` says why).

        Raises:
            InputError: Bad limit, preference, distance or q0, or a grasp the robot cannot take.

        Example:
            >>> several = solver.solve_all(grasp, limit=4, prefer="manipulability")
            >>> len(several), several[0].manipulability >= several[1].manipulability
            (4, True)
        """
        targets = self._request.of_grasps([grasp], fixed)
        finder = self._engine.kinds_of(targets).finder
        start, query = self._request.start(q0), self._engine.collision_query(targets)
        return finder.find(targets, start, seed, limit, prefer, apart, query)

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
    ) -> BatchSolution:
        """Solve k palms that are given, with hands as they are said: only arms are unknown.

        Args:
            palms: (k, 4, 4) poses of `robot.palm` in the base frame.
            postures: Positions (k,), or one for all, of every motor that moves a finger, by name
                [rad or m]; or configurations (k, n) or (n,) of which these motors are taken.
            q0: (n,) or (k, n) start; None is `robot.home`.
            seed: As for `solve`.
            jobs: Threads, at least 1.
            diagnose: As for `solve_batch`.
            fixed: As for `solve`, for other actuators.
            prefer: As for `solve`.

        Returns:
            As `solve_batch`, with `palm_position_error`, `palm_angle_error` and `palm_ok`.

        Raises:
            InputError: No rigid poses, or postures that are not all there or beyond limits.
            UnknownNameError: No such actuator.
            UnsupportedError: The method is not hand-first, or the robot is a body.

        Example:
            >>> q = robot.random(np.random.default_rng(4), 50)
            >>> hands = dict(zip(robot.actuators[7:], q[:, 7:].T))  # or q itself
            >>> batch = solver.solve_palms(robot.palm(q), hands)
            >>> bool(batch.success.all()), bool(batch.palm_position_error.max() < 1e-3)
            (True, True)
        """
        self.robot.description.one_hand("solve_palms")
        poses = checked_pose(palms, "palms")
        if poses.ndim != 3:
            raise InputError(f"palms: found shape {poses.shape}, expected (k, 4, 4)")
        hands = hand_postures(self._request.robot, postures, len(poses))
        preferred = self._engine.preference(prefer, q0 is not None)
        targets = self._request.of_palms(poses, hands, fixed, preferred)
        return self._engine.solve(targets, Run(q0, seed, jobs, None, diagnose, shown=True))

    choose = choose
    grasps_of = grasps_of

    def sensitivity(
        self,
        q: ArrayLike,
        points: ArrayLike,
        normals: ArrayLike,
        gradient: ArrayLike | None = None,
        **more: ArrayLike | None,
    ) -> Sensitivity:
        """How answers move with their targets, by the implicit function theorem.

        What an answer leaves of its contacts' errors stays, in the sense of least squares; motors
        at a limit stay there; of motions that contacts leave free none is made.

        Args:
            q: (k, n) answers [rad or m].
            points: (k, f, 3) contact points [m], as for `solve_batch`.
            normals: (k, f, 3), likewise.
            gradient: (k, n) of a number by q [1/rad or 1/m]: its derivatives by the contacts are
                found, which takes a part of the time. None: those of q.
            more: As for `solve_batch`.

        Returns:
            Derivatives (k, n, f, 3) of q by points [rad/m or 1] and by normals [rad or m]; with a
            gradient (k, f, 3).

        Raises:
            InputError: Bad shapes or values, or targets of several kinds.

        Example:
            >>> points, normals = robot.contacts(solution.q[None])
            >>> rates = solver.sensitivity(solution.q[None], points, normals)
            >>> rates.points.shape
            (1, 14, 3, 3)
        """
        every = self.robot.configuration(q)
        targets = self._request.of_arrays(points, normals, None, more=more)
        k, n = len(targets), len(self.robot.actuators)
        if every.shape != (k, n):
            raise InputError(f"q: found shape {every.shape}, expected {(k, n)}")
        kernel = self._engine.kinds_of(targets).sensitivity
        if gradient is not None:
            given = np.asarray(gradient, dtype=float)
            if given.shape != every.shape:
                raise InputError(f"gradient: found shape {given.shape}, expected {every.shape}")
            return kernel(targets, every, given)
        rows = np.repeat(np.arange(k), n)
        found = kernel(targets.rows(rows), every[rows], np.tile(np.eye(n), (k, 1)))
        f = len(self.robot.fingers)
        return Sensitivity(found.points.reshape(k, n, f, 3), found.normals.reshape(k, n, f, 3))

    def moved(self, name: str, pose: ArrayLike) -> Self:
        """The same solver with something in its scene elsewhere, in less than a millisecond.

        Args:
            name: Of an item of the scene.
            pose: (4, 4) of it in the base frame.

        Raises:
            InputError: The solver has no scene, or this is no pose.
            UnknownNameError: The scene has no such item.
            DescriptionError: It would stand in the robot's base.

        Example:
            >>> lower = np.eye(4)
            >>> lower[2, 3] = -0.3
            >>> among = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> among.moved("table", lower).solve(grasp).status.name
            'SOLVED'
        """
        check = self._engine.check
        if check is None:
            raise InputError(f"{name!r} cannot be moved: the solver has no scene")
        # Not `copy`, which builds what is unpickled anew.
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        moved = check.moved(name, single_pose(pose))
        other.scene, other._engine = moved.scene, self._engine.about(moved)
        other._asked = (*self._asked[:-1], moved.scene)
        return other

    @property
    def scene_check(self) -> SceneCheck | None:
        """What tells whether configurations touch anything; None without a scene."""
        return self._engine.check

    def check(self, q: ArrayLike, grasp: Grasp) -> Clearances | None:
        """How far configurations are from touching anything they must not touch.

        Args:
            q: (n,) or (k, n) actuator positions [rad or m].
            grasp: Its fingers may touch what is grasped.

        Returns:
            Clearances of the k configurations (one for a single q); None without a scene.

        Raises:
            InputError: Bad q, or a grasp that the robot cannot take.

        Example:
            >>> among = ik.Solver(robot, scene=ik.load_scene("table"))
            >>> bool(among.check(solution.q, grasp).distance[0] > 0)
            True
        """
        targets = self._request.of_grasps([grasp], None)
        query = self._engine.collision_query(targets)
        return query and query.check(np.atleast_2d(self.robot.configuration(q)))
