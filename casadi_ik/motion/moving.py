"""Motion methods of `Solver`: following, tracking, reaching, placing and moving."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import checked_integer, single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.approach import Approach, ApproachRequest, approach
from casadi_ik.motion.cycle_runner import FollowerConfig
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.motion import direction_vector, length, rates_of, seconds, unbounded
from casadi_ik.motion.reach import CarriedObject, Pace, Reach, ReachRequest, move, place, reach
from casadi_ik.motion.track import PathTracker, Track, track
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.solution import SolvedGrasp
from casadi_ik.solve.target_builder import TargetBuilder
from casadi_ik.solve.verdict import LIMIT_SLACK, judge

SETTLING = 0.1
"""Default time constant of free motions towards their posture [s]."""

FOLLOWING_PULL = 0.1
"""Weight of the anchor of a follower.

Source: 16 random smooth paths of kuka_lwr_barrett at half the velocity limits. With 1e-3 the
follower misses cycles of three paths, with 0.1 of one (3.6 % of the cycles).
"""

PATH_PULL = 1e-5
"""Weight of the anchor along a known path, where steps may be large."""


class MovingSolver:
    """Motion methods of a solver.

    Attributes:
        robot: Robot that moves.
    """

    robot: ArmHand
    _engine: Engine
    _target_builder: TargetBuilder

    def follow(
        self,
        q0: ArrayLike | None = None,
        period: float = 1e-3,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        posture: ArrayLike | None = None,
        settling: float = SETTLING,
    ) -> Follower:
        """Return a follower of moving targets, which is called once per cycle.

        Args:
            q0: (n,) positions of the motors at rest [rad or m]; None: home.
            period: Time from cycle to cycle [s].
            velocity: Velocity limits of the motors, (n,) or a number [rad/s or m/s]; None: the
                limits of the description; for a motor without a limit, its range in one second.
            acceleration: Acceleration limits, (n,) or a number [rad/s^2 or m/s^2]; None: the
                velocity limit is reached from rest in a quarter of a second.
            posture: (n,) posture to which unconstrained motors move; None: q0.
            settling: Time constant of free motions [s].

        Raises:
            InputError: A value is out of range.

        Example:
            >>> follower = solver.follow(q0=solution.q, period=0.001)
            >>> follower(grasp).shape, follower.state.status.name
            ((14,), 'FOLLOWING')
        """
        start = self._target_builder.start(q0)
        rates = rates_of(self.robot, velocity, acceleration)
        free_posture = start if posture is None else self._target_builder.start(posture, "posture")
        return Follower(
            FollowerConfig(
                target_builder=self._target_builder,
                check=self._engine.check,
                compiled=self._engine.compiled,
                q0=start,
                bounds=self._bounds(None),
                period=seconds("period", period),
                rates=rates,
                posture=free_posture,
                settling=seconds("settling", settling),
                pull=FOLLOWING_PULL,
                nearest=self._nearest,
            )
        )

    def track(
        self,
        grasps: Sequence[Grasp],
        q0: ArrayLike | None = None,
        period: float | None = None,
        velocity: ArrayLike | None = None,
        seed: int = 0,
        fixed: Mapping[str, float] | None = None,
    ) -> Track:
        """Track a known path of grasps: every solution continues the previous one.

        The motion begins at a solution of the first grasp from which the path continues without a
        jump between branches. Unavoidable jumps are reported. With a scene the motion stops before
        obstacles.

        Args:
            grasps: Grasps in order; the tolerances are those of the first.
            q0: (n,) motor positions; the motion begins at the nearest solution [rad or m]. None: it
                begins at the solution with the largest limit margin.
            period: Time from one grasp to the next [s]. With a period the velocity limits are kept,
                and grasps that move too fast are tracked with an error.
            velocity: Velocity limits in place of those of the description, (n,) or a number [rad/s
                or m/s].
            seed: See `solve`.
            fixed: See `solve`.

        Raises:
            InputError: There are no grasps, a value is out of range, or a grasp does not fit the
                robot.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> up = np.eye(4)
            >>> up[2, 3] = 0.002
            >>> track = solver.track([grasp, grasp.at(up), grasp.at(up @ up)])
            >>> track.q.shape, bool(track.success.all()), track.jumps
            ((3, 14), True, ())
        """
        if isinstance(grasps, str) or not isinstance(grasps, Iterable):
            raise InputError(f"grasps: found {type(grasps).__name__}, expected a list of grasps")
        grasps = list(grasps)
        if not grasps:
            raise InputError("grasps: found 0 grasps, expected at least one")
        if period is None and velocity is not None:
            raise InputError("velocity: period is missing, expected both or none")
        start = self._target_builder.start(q0)
        targets = self._target_builder.from_grasps(
            grasps, fixed=fixed, q0=None if q0 is None else start, seed=seed
        )
        # Palm poses are tracked by the contacts that follow from them.
        targets = replace(targets, palms=None)
        if targets.fixed is not None and targets.fixed.ndim > 1:
            targets = replace(targets, fixed=self._target_builder.fixed_vector(fixed))
        engine = self._engine.engine_for(targets)
        _ = engine.finder  # raises an error unless the method is hand-first
        ((kinds, _, _),) = group_by_kinds(targets.rows(slice(0, 1)))
        travel = None
        if period is not None:
            travel = rates_of(self.robot, velocity, None).steps(seconds("period", period))[0]
        tracker = PathTracker(self._path_config(start, targets), kinds)
        return track(engine, targets, tracker, travel)

    def reach(
        self,
        grasp: Grasp | SolvedGrasp,
        q0: ArrayLike | None = None,
        opening: float = 0.02,
        distance: float = 0.08,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        period: float = 0.01,
        seed: int = 0,
        limit: int = 8,
        direction: ArrayLike | None = None,
        lift: float = 0.0,
        retreat: float = 0.0,
    ) -> Reach:
        """Plan a timed motion from a configuration to a grasp.

        The robot moves to a pre-grasp with an open hand, approaches straight, and closes the hand.
        The solutions of a grasp are attempted in the order of distance from q0; for a result of
        `choose` (``ranked[0]``) only the configuration of the result is attempted. With a scene the
        motion is checked, also between its samples: the path to the pre-grasp is straight if that
        is free, otherwise OMPL plans it; fingers touch the object only while they close. With
        `lift` or `retreat` the motion continues: the object moves with the palm, and points of its
        surface are checked against the scene.

        Args:
            grasp: Grasp with a contact per finger, or a result of `choose`.
            q0: (n,) positions of the motors at rest [rad or m]; None: home.
            opening: Distance of the fingertips from their contacts before they close [m].
            distance: Length of the straight approach [m].
            velocity: See `follow`.
            acceleration: See `follow`.
            period: Time between two samples of the motion [s].
            seed: Seed of the solver and of the path planner.
            limit: Maximum number of attempted solutions.
            direction: (3,) direction of the approach, base frame: ``[0, 0, -1]`` is from above.
                None: from the pre-grasp of the grasp (`Grasp.pregrasp`), or else from the palm to
                the contacts; if this direction is blocked, from above, between both, or tilted to a
                side.
            lift: Height by which the hand is lifted along z of the base after closing [m].
            retreat: Length of the retreat along the reverse approach after that [m].

        Raises:
            InputError: A value is out of range, or the grasp does not fit the robot.
            MissingExtraError: toppra is not installed (extra `motion`).
            UnsupportedError: The method is not hand-first, or no arm can lift the hand.

        Example:
            >>> found = solver.reach(grasp, q0=robot.home)
            >>> found.status.name, bool(found.motion.times[-1] > 0)
            ('REACHED', True)
            >>> best = solver.choose([grasp])[0]
            >>> found = solver.reach(best, lift=0.05)
            >>> bool((found.motion.q == best.solution.q).all(axis=1).any())
            True
        """
        start = self._target_builder.start(q0)
        lengths = length("lift", lift), length("retreat", retreat)
        if any(lengths) and not (
            self.robot.description.arm_actuators or self.robot.description.sides
        ):
            raise UnsupportedError(f"lift: {self.robot.name!r} has no arm that moves its palm")
        pace = self._pace(velocity, acceleration, period)
        approach_request = self._approach_request(grasp, start, opening, distance, direction)
        request = ReachRequest(
            approach_request,
            pace,
            checked_integer(seed, "seed", 0),
            np.clip(start, *approach_request.config.bounds),
        )
        solutions = self._solutions(grasp, approach_request.problem, start, seed, limit)
        return reach(request, *solutions, *lengths)

    def place(
        self,
        held: SolvedGrasp,
        pose: ArrayLike,
        q0: ArrayLike,
        lower: float = 0.05,
        opening: float = 0.02,
        distance: float = 0.08,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        period: float = 0.01,
        seed: int = 0,
        limit: int = 4,
        direction: ArrayLike | None = None,
    ) -> Reach:
        """Plan a timed motion that places the object in the hand at a pose.

        The object is carried above the pose, straight or around obstacles, and lowered straight;
        the hand opens and retreats straight. With a scene the motion is checked: the object against
        the scene while it is carried, the hand against both afterwards.

        Args:
            held: Grasp that the hand holds: a result of `choose` or `grasps_of` whose grasp has an
                object pose.
            pose: (4, 4) target pose of the object, base frame.
            q0: (n,) positions of the motors at rest, for example the end of `reach` [rad or m].
            lower: Height from which the object is lowered straight [m].
            opening: Distance of the fingertips from their contacts before the hand retreats [m].
            distance: Length of the straight retreat [m].
            velocity: See `follow`.
            acceleration: See `follow`.
            period: Time between two samples of the motion [s].
            seed: Seed of the solver and of the path planner.
            limit: Maximum number of attempted solutions.
            direction: (3,) reverse direction of the retreat, see `reach`.

        Returns:
            Motion with the parts "carrying", "lowering", "opening" and "leaving"; its `q` is the
            configuration at the target pose before the hand opens.

        Raises:
            InputError: A value is out of range, or the grasp has no object pose.
            MissingExtraError: toppra is not installed (extra `motion`).
            UnsupportedError: The method is not hand-first, no arm moves the palm, or the robot has
                several arms.

        Example:
            >>> best = solver.choose([grasp])[0]
            >>> up = solver.reach(best, lift=0.05)
            >>> beside = grasp.object_pose.copy()
            >>> beside[1, 3] += 0.05
            >>> down = solver.place(best, beside, up.motion.q[-1])
            >>> down.status.name, down.motion.notes["part"][-1].item()
            ('REACHED', 'leaving')
        """
        grasp = getattr(held, "grasp", None)
        if not isinstance(grasp, Grasp) or not hasattr(held, "q"):
            raise InputError(
                f"held: found {type(held).__name__}, expected a result of choose or grasps_of with"
                " grasp and q"
            )
        start, target = self._target_builder.start(q0), single_pose(pose)
        if grasp.known_pose is None:
            raise InputError("held: object_pose of the grasp is missing, expected a pose")
        self.robot.description.require_single_hand("place")
        if not self.robot.description.arm_actuators:
            raise UnsupportedError(f"place: {self.robot.name!r} has no arm that moves its palm")
        # Motion of the object in the base frame, from its pose in the grasp to the target pose.
        motion = target @ inverse(grasp.known_pose)
        q = self._target_builder.start(held.q, "q")
        motors = self.robot.description.finger_motors
        hand = {name: float(q[self.robot.actuators.index(name)]) for name in motors}
        palm = Grasp(robot=grasp.robot, palm=motion @ self.robot.palm(q), posture=hand)
        target_grasp = replace(grasp.at(motion), pregrasp=None)
        approach_request = self._approach_request(target_grasp, start, opening, distance, direction)
        carried_object = None
        if self._engine.check is not None:
            held_target = self._target_builder.from_grasps([grasp])
            carried_object = CarriedObject(self._engine.check, held_target, q)
        pace, height = self._pace(velocity, acceleration, period), length("lower", lower)
        request = ReachRequest(
            approach_request,
            pace,
            checked_integer(seed, "seed", 0),
            np.clip(start, *approach_request.config.bounds),
        )
        problem = self._target_builder.from_grasps([palm])
        solutions = self._solutions(palm, problem, start, seed, limit)
        return place(request, *solutions, carried_object, height)

    def move(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        period: float = 0.01,
        seed: int = 0,
    ) -> Reach:
        """Plan a timed motion from rest to rest between two configurations.

        With a scene the motion is free of collisions, also between its samples; no finger may touch
        the grasped object of the scene. If the straight line in configuration space is not free,
        OMPL plans another path.

        Args:
            q0: (n,) first configuration [rad or m].
            q1: (n,) last configuration [rad or m].
            velocity: See `follow`.
            acceleration: See `follow`.
            period: Time between two samples of the motion [s].
            seed: Seed of the path planner.

        Returns:
            Motion with the part "going"; its status is NO_WAY if there is no path.

        Raises:
            InputError: A value is out of range, or a configuration exceeds limits.
            MissingExtraError: toppra is not installed (extra `motion`).

        Example:
            >>> found = solver.move(robot.home, solution.q)
            >>> found.success, bool((found.motion.q[-1] == solution.q).all())
            (True, True)
        """
        endpoints = self._target_builder.start(q0), self._target_builder.start(q1, "q1")
        lower, upper = self._bounds(None)
        for name, q in zip(("q0", "q1"), endpoints, strict=True):
            excess = np.maximum(lower - q, q - upper)
            i = int(excess.argmax())
            if not excess[i] <= LIMIT_SLACK:
                raise InputError(
                    f"{name}: found {self.robot.actuators[i]} at {q[i]:g}, expected a number from "
                    f"{lower[i]:g} to {upper[i]:g}"
                )
        pace = self._pace(velocity, acceleration, period)
        query, check = None, self._engine.check
        if check is not None:
            query = check.collision_query(self._placeholder_target(np.nan)).rows(
                np.zeros(1, dtype=np.intp)
            )
        return move(self.robot, endpoints, query, pace, checked_integer(seed, "seed", 0))

    def approach(
        self,
        grasp: Grasp | SolvedGrasp,
        distance: float = 0.08,
        opening: float = 0.02,
        q0: ArrayLike | None = None,
        seed: int = 0,
        limit: int = 8,
        direction: ArrayLike | None = None,
    ) -> Approach:
        """Plan the straight approach to a grasp, from a pre-grasp to the closed hand.

        The hand is open at the pre-grasp and moves straight. The solutions of the grasp are
        attempted in the order of distance from q0; for a result of `choose` only the configuration
        of the result is attempted. With a scene the approach is checked, also between its postures;
        fingers touch the object only while they close.

        Args:
            grasp: See `reach`.
            distance: Length of the straight motion [m].
            opening: Distance of the fingertips from their contacts before they close [m].
            q0: (n,) positions of the motors [rad or m]; None: home.
            seed: Seed of the solver.
            limit: Maximum number of attempted solutions.
            direction: See `reach`.

        Raises:
            InputError: A value is out of range, or the grasp does not fit the robot.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> found = solver.approach(grasp)
            >>> found.success, found.pregrasp.shape
            (True, (14,))
        """
        start = self._target_builder.start(q0)
        request = self._approach_request(grasp, start, opening, distance, direction)
        return approach(request, *self._solutions(grasp, request.problem, start, seed, limit))

    def _pace(
        self, velocity: ArrayLike | None, acceleration: ArrayLike | None, period: float
    ) -> Pace:
        return Pace(rates_of(self.robot, velocity, acceleration), seconds("period", period))

    def _approach_request(
        self,
        grasp: Grasp | SolvedGrasp,
        start: Array,
        opening: float,
        distance: float,
        direction: ArrayLike | None,
    ) -> ApproachRequest:
        """Return the requirements of the approach to a grasp."""
        target: Any = grasp if isinstance(grasp, Grasp) else getattr(grasp, "grasp", grasp)
        problem = self._target_builder.from_grasps([target])
        pregrasp_palm = target.pregrasp and target.pregrasp.single_palm
        return ApproachRequest(
            self._path_config(start),
            problem,
            length("opening", opening),
            length("distance", distance),
            None if direction is None else direction_vector("direction", direction),
            None if pregrasp_palm is None else pregrasp_palm[:3, 3],
        )

    def _solutions(
        self, grasp: Grasp | SolvedGrasp, problem: TargetBatch, start: Array, seed: int, limit: int
    ) -> tuple[list[Array], str]:
        """Return the solutions (n,) of a grasp, nearest first, and the reason if there are none.

        A result of `choose` has a single configuration.
        """
        if not isinstance(grasp, Grasp):
            q = self._target_builder.start(grasp.q, "q")
            verdict = judge(self.robot, problem, q[None])
            if verdict.solved(problem.enforce_limits)[0]:
                return [q], ""
            error = f"{1e3 * np.nanmax(verdict.position_error):.3g} mm"
            return [], f"q of the chosen grasp is not a solution (error {error}, or limits)"
        engine, problem = (
            self._engine.engine_for(problem),
            replace(problem, q0=start, seed=checked_integer(seed, "seed", 0)),
        )
        alternatives = engine.finder.find(
            problem, limit, "q0", separation=0.05, query=engine.collision_query(problem)
        )
        # A solve searches longer for a collision-free solution than the list of alternatives.
        best = engine.solve(replace(problem, prefer="q0"), SolveOptions())
        solutions = [*best.q[best.success], *(item.q for item in alternatives)][:limit]
        return solutions, "" if solutions else "the grasp has no solution"

    def _path_config(self, q0: Array, targets: TargetBatch | None = None) -> FollowerConfig:
        """Return the configuration of the graph for paths, without limits of velocities.

        With an infinite `settling` there are no free motions, so the period does not matter.
        """
        return FollowerConfig(
            target_builder=self._target_builder,
            check=self._engine.check,
            compiled=self._engine.compiled,
            q0=q0,
            bounds=self._bounds(targets),
            period=1.0,
            rates=unbounded(self.robot),
            posture=q0,
            settling=math.inf,
            pull=PATH_PULL,
            nearest=self._nearest,
        )

    def _nearest(self, target: TargetBatch, q0: Array) -> Array:
        """Return the configuration (n,) with the smallest error; of several the nearest to q0.

        Args:
            target: One target.
            q0: (n,) start of the search.
        """
        target = replace(target, q0=q0[None], prefer="q0")
        options = SolveOptions(diagnose=False, best_effort=True)
        return self._engine.engine_for(target).solve(target, options).q[0]

    def _bounds(self, targets: TargetBatch | None) -> tuple[Array, Array]:
        """Return the limits (n,) of motions, see `RobotDescription.motion_limits`."""
        if targets is None:
            targets = self._placeholder_target(0.0)
        robot = self.robot.description
        lower, upper = targets.bounds(robot)
        endless = robot.continuous & (lower < upper)
        return np.where(endless, robot.motion_limits[0], lower), np.where(
            endless, robot.motion_limits[1], upper
        )

    def _placeholder_target(self, coordinate: float) -> TargetBatch:
        """Return a target whose points have equal coordinates [m]; NaN frees the contacts.

        It serves where a target is required but its contacts do not matter.
        """
        zeros = np.zeros((1, len(self.robot.fingers), 3))
        target = self._target_builder.from_arrays(zeros, zeros + 1.0)
        return replace(target, points=zeros + coordinate)
