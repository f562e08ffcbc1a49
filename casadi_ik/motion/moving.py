"""What a solver does with a robot that moves: the part of `Solver` that is about motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks.poses import single_pose
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.contacts import group_by_kinds
from casadi_ik.model.grasp import Grasp
from casadi_ik.model.pose import inverse
from casadi_ik.model.targets import TargetBatch
from casadi_ik.motion.approach import Approach, ApproachPlan, approach
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.inputs import FollowPlan
from casadi_ik.motion.motion import a_direction, length, rates_of, seconds, unbounded
from casadi_ik.motion.reach import Carried, Pace, Reach, WayPlan, move, place, reach
from casadi_ik.motion.track import PathTracker, Track, track
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.request import Request
from casadi_ik.solve.solution import Chosen
from casadi_ik.solve.verdict import LIMIT_SLACK, judge

SETTLING = 0.1
"""Seconds in which motions that contacts leave free come to their posture."""

FOLLOWING_PULL = 0.1
"""Weight of momentum in a stream. Of 16 random smooth paths of kuka_lwr_barrett at half the
velocity limits, 1e-3 missed a part of three, this of one (3.6 % of the cycles)."""

PATH_PULL = 1e-5
"""Weight of the posture before along a path, where steps are as large as they have to be."""


class MovingSolver:
    """The motions of a solver.

    Attributes:
        robot: The robot.
    """

    robot: ArmHand
    _engine: Engine
    _request: Request

    def follow(
        self,
        q0: ArrayLike | None = None,
        period: float = 1e-3,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        posture: ArrayLike | None = None,
        settling: float = SETTLING,
    ) -> Follower:
        """Follow targets that move, one call a cycle: see `Follower`.

        Args:
            q0: (n,) where the robot is, at rest [rad or m]; None: at home.
            period: Time from cycle to cycle [s].
            velocity: Limits of the motors, (n,) or a number [rad/s or m/s]; None: the
                description's, and a range in a second where it has none.
            acceleration: Limits, (n,) or a number [rad/s^2 or m/s^2]; None: from rest to the
                velocity limit in a quarter of a second.
            posture: (n,) where motions lead that the contacts leave free; None: q0.
            settling: In what time they come there [s].

        Raises:
            InputError: Bad numbers.

        Example:
            >>> follower = solver.follow(q0=solution.q, period=0.001)
            >>> follower(grasp).shape, follower.state.status.name
            ((14,), 'FOLLOWING')
        """
        start = self._request.start(q0)
        rates = rates_of(self.robot, velocity, acceleration)
        comfortable = start if posture is None else self._request.start(posture, "posture")
        return Follower(
            FollowPlan(
                self._request,
                self._engine.check,
                self._engine.compiled,
                start,
                self._bounds(None),
                seconds("period", period),
                rates,
                comfortable,
                seconds("settling", settling),
                FOLLOWING_PULL,
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
        """Follow a path of grasps that is known: every solution continues the one before.

        The motion begins with the solution of the first grasp from which the others are reached
        without a jump between branches; a jump that cannot be avoided is reported. Where the
        solver has a scene, the motion stops short of what is in its way.

        Args:
            grasps: In order; the tolerances are those of the first.
            q0: (n,) where the robot is [rad or m]: the motion begins near it. None: it begins far
                from the limits.
            period: Time from one grasp to the next [s]; then the motors' velocity limits are kept,
                and a grasp that moves too fast is followed as well as they allow.
            velocity: Other velocity limits, (n,) or a number [rad/s or m/s].
            seed: As for `solve`.
            fixed: As for `solve`.

        Raises:
            InputError: No grasp, bad q0, period or velocity, or a grasp the robot cannot take.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> up = np.eye(4)
            >>> up[2, 3] = 0.002
            >>> track = solver.track([grasp, grasp.at(up), grasp.at(up @ up)])
            >>> track.q.shape, bool(track.success.all()), track.jumps
            ((3, 14), True, ())
        """
        if not grasps:
            raise InputError("grasps: found none, expected at least one")
        if period is None and velocity is not None:
            raise InputError("velocity: given without a period, expected both")
        # A palm that is given counts as the contacts that it leads to.
        targets = replace(self._request.of_grasps(grasps, fixed), palms=None)
        if targets.fixed is not None and targets.fixed.ndim > 1:
            targets = replace(targets, fixed=self._request.fixed_vector(fixed))
        engine, start = self._engine.engine_for(targets), self._request.start(q0)
        _ = engine.finder
        ((kinds, _, _),) = group_by_kinds(targets.rows(slice(0, 1)))
        travel = None
        if period is not None:
            travel = rates_of(self.robot, velocity, None).steps(seconds("period", period))[0]
        tracker = PathTracker(self._path_plan(start, targets), kinds)
        prefer = "limits" if q0 is None else "q0"
        return track(engine, targets, start, prefer, tracker, travel, seed)

    def reach(
        self,
        grasp: Grasp | Chosen,
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
        """The way from where the robot is to a grasp, in time.

        It goes to a pre-grasp, where the hand is open; comes straight; and closes. Of a grasp
        solutions are tried, nearest first, until there is a way to one; of what `choose` answers
        (``ranked[0]``) it is that very posture or none. With a scene all of it is checked, between
        its points too: the straight way there if it is free, else one by OMPL; fingers touch the
        object only while they close. With `lift` or `retreat` it goes on: the object moves with
        the palm then, and is compared with the scene by points of its surface.

        Args:
            grasp: A contact per finger, or an answer of `choose`.
            q0: (n,) where the robot is, at rest [rad or m]; None: at home.
            opening: How far the fingertips are from their contacts before they close [m].
            distance: How far the hand comes straight [m].
            velocity: As for `follow`.
            acceleration: As for `follow`.
            period: Time between two samples of the motion [s].
            seed: Of starts and of a planner.
            limit: Solutions that are tried at most.
            direction: (3,) the way the hand comes, base frame: ``[0, 0, -1]`` from above. None:
                from where the grasp has its palm before it, if it says (`Grasp.pregrasp`), else
                along the line from the palm to the contacts; where that cannot be gone, from above,
                between both, or leaning to a side.
            lift: How far the hand goes straight up, along z of the base, after it closed [m].
            retreat: How far it goes back then, against the way it came [m].

        Raises:
            InputError: Bad numbers, or a grasp the robot cannot take.
            MissingExtraError: toppra is not installed (extra `motion`).
            UnsupportedError: The method is not hand-first, or a hand that no arm moves is to be
                lifted.

        Example:
            >>> found = solver.reach(grasp, q0=robot.home)
            >>> found.status.name, bool(found.motion.times[-1] > 0)
            ('REACHED', True)
            >>> best = solver.choose([grasp])[0]
            >>> found = solver.reach(best, lift=0.05)
            >>> bool((found.motion.q == best.solution.q).all(axis=1).any())
            True
        """
        start = self._request.start(q0)
        onward = length("lift", lift), length("retreat", retreat)
        if any(onward) and not (
            self.robot.description.arm_actuators or self.robot.description.sides
        ):
            raise UnsupportedError(f"lift: {self.robot.name!r} has no arm that moves its palm")
        pace = self._pace(velocity, acceleration, period)
        last = self._last_part(grasp, start, opening, distance, direction)
        asked = WayPlan(last, pace, seed, np.clip(start, *last.plan.bounds))
        return reach(asked, *self._solutions(grasp, last.problem, start, seed, limit), *onward)

    def place(
        self,
        held: Chosen,
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
        """The way from where the hand holds an object to where it stands elsewhere, in time.

        The object is carried over its place, straight or around what is in the way; comes straight
        down; the hand opens, and goes straight back. With a scene all of it is checked, the object
        with the scene while it is carried, hand and object afterwards.

        Args:
            held: What was reached: an answer of `choose` or `grasps_of`, whose grasp says where its
                object is.
            pose: (4, 4) where the object is to stand, base frame.
            q0: (n,) where the robot is, at rest: at the end of `reach`, say [rad or m].
            lower: From how far above the object comes straight down [m].
            opening: How far the fingertips are from their contacts before the hand goes [m].
            distance: How far it goes straight [m].
            velocity: As for `follow`.
            acceleration: As for `follow`.
            period: Time between two samples of the motion [s].
            seed: Of starts and of a planner.
            limit: Postures that are tried at most.
            direction: (3,) against which the hand goes, as for `reach`.

        Returns:
            A `Reach` whose parts are "carrying", "lowering", "opening" and "leaving"; its `q` is
            where the object stands and the hand has not opened yet.

        Raises:
            InputError: Bad numbers, or a grasp that does not say where its object is.
            MissingExtraError: toppra is not installed (extra `motion`).
            UnsupportedError: The method is not hand-first, no arm moves the palm, or the robot is a
                body.

        Example:
            >>> best = solver.choose([grasp])[0]
            >>> up = solver.reach(best, lift=0.05)
            >>> beside = grasp.object_pose.copy()
            >>> beside[1, 3] += 0.05
            >>> down = solver.place(best, beside, up.motion.q[-1])
            >>> down.status.name, down.motion.notes["part"][-1].item()
            ('REACHED', 'leaving')
        """
        chosen = getattr(held, "grasp", None)
        if not isinstance(chosen, Grasp) or not hasattr(held, "q"):
            raise InputError(
                f"held: found {type(held).__name__}, expected an answer with its grasp and its q,"
                " as choose and grasps_of return them"
            )
        start, target = self._request.start(q0), single_pose(pose)
        if chosen.known_pose is None:
            raise InputError("held: found a grasp without a known object_pose, expected one")
        self.robot.description.require_single_hand("place")
        if not self.robot.description.arm_actuators:
            raise UnsupportedError(f"place: {self.robot.name!r} has no arm that moves its palm")
        moved = target @ inverse(chosen.known_pose)
        q = self._request.start(held.q, "q")
        motors = self.robot.description.finger_motors
        hand = {name: float(q[self.robot.actuators.index(name)]) for name in motors}
        palm = Grasp(robot=chosen.robot, palm=moved @ self.robot.palm(q), posture=hand)
        there = replace(chosen.at(moved), pregrasp=None)
        last = self._last_part(there, start, opening, distance, direction)
        carried = None
        if self._engine.check is not None:
            carried = Carried(self._engine.check, self._request.of_grasps([chosen], None), q)
        pace, above = self._pace(velocity, acceleration, period), length("lower", lower)
        asked = WayPlan(last, pace, seed, np.clip(start, *last.plan.bounds))
        problem = self._request.of_grasps([palm], None)
        solutions = self._solutions(palm, problem, start, seed, limit)
        return place(asked, *solutions, carried, above)

    def move(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        period: float = 0.01,
        seed: int = 0,
    ) -> Reach:
        """The way from one posture to another, in time: straight, or around what is in the way.

        From rest to rest. With a scene it is free, between its points too; no finger may touch
        what the scene calls grasped. Where the straight way (in motors) is not free, OMPL looks
        for another.

        Args:
            q0: (n,) where the robot is [rad or m].
            q1: (n,) where it is to be.
            velocity: As for `follow`.
            acceleration: As for `follow`.
            period: Time between two samples of the motion [s].
            seed: Of a planner.

        Returns:
            A `Reach` of one part, "going"; NO_WAY if none was found.

        Raises:
            InputError: Bad numbers, or a posture beyond limits.
            MissingExtraError: toppra is not installed (extra `motion`).

        Example:
            >>> found = solver.move(robot.home, solution.q)
            >>> found.success, bool((found.motion.q[-1] == solution.q).all())
            (True, True)
        """
        ends = self._request.start(q0), self._request.start(q1, "q1")
        lower, upper = self._bounds(None)
        for name, q in zip(("q0", "q1"), ends, strict=True):
            off = np.maximum(lower - q, q - upper)
            i = int(off.argmax())
            if not off[i] <= LIMIT_SLACK:
                raise InputError(
                    f"{name}: found {self.robot.actuators[i]} at {q[i]:g}, expected a number from "
                    f"{lower[i]:g} to {upper[i]:g}"
                )
        pace = self._pace(velocity, acceleration, period)
        query, check = None, self._engine.check
        if check is not None:
            query = check.collision_query(self._anything(np.nan)).rows(np.zeros(1, dtype=np.intp))
        return move(self.robot, ends, query, pace, seed)

    def approach(
        self,
        grasp: Grasp | Chosen,
        distance: float = 0.08,
        opening: float = 0.02,
        q0: ArrayLike | None = None,
        seed: int = 0,
        limit: int = 8,
        direction: ArrayLike | None = None,
    ) -> Approach:
        """The last part of the way to a grasp: a pre-grasp, straight on, closing.

        The hand is open at the pre-grasp and comes straight. Solutions of the grasp are tried,
        nearest to q0 first; of what `choose` answers it is that very posture. With a scene all of
        it is checked, between its points too; fingers touch the object only while they close.

        Args:
            grasp: As for `reach`.
            distance: How far the hand comes straight [m].
            opening: How far the fingertips are from their contacts before they close [m].
            q0: (n,) where the robot is [rad or m]; None: at home.
            seed: Of starts.
            limit: Solutions that are tried at most.
            direction: As for `reach`.

        Raises:
            InputError: Bad numbers, or a grasp the robot cannot take.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> found = solver.approach(grasp)
            >>> found.success, found.pregrasp.shape
            (True, (14,))
        """
        start = self._request.start(q0)
        last = self._last_part(grasp, start, opening, distance, direction)
        return approach(last, *self._solutions(grasp, last.problem, start, seed, limit))

    def _pace(
        self, velocity: ArrayLike | None, acceleration: ArrayLike | None, period: float
    ) -> Pace:
        return Pace(rates_of(self.robot, velocity, acceleration), seconds("period", period))

    def _last_part(
        self,
        grasp: Grasp | Chosen,
        start: Array,
        opening: float,
        distance: float,
        direction: ArrayLike | None,
    ) -> ApproachPlan:
        """What the last part of the way to a grasp keeps to."""
        asked: Any = grasp if isinstance(grasp, Grasp) else getattr(grasp, "grasp", grasp)
        problem = self._request.of_grasps([asked], None)
        before = asked.pregrasp and asked.pregrasp.single_palm
        return ApproachPlan(
            self._path_plan(start),
            problem,
            length("opening", opening),
            length("distance", distance),
            None if direction is None else a_direction("direction", direction),
            None if before is None else before[:3, 3],
        )

    def _solutions(
        self, grasp: Grasp | Chosen, problem: TargetBatch, start: Array, seed: int, limit: int
    ) -> tuple[list[Array], str]:
        """Solutions (n,) of a grasp, nearest first, or that which was chosen; why there is none."""
        if not isinstance(grasp, Grasp):
            q = self._request.start(grasp.q, "q")
            verdict = judge(self.robot, problem, q[None])
            if verdict.solved(problem.enforce_limits)[0]:
                return [q], ""
            off = f"{1e3 * np.nanmax(verdict.position_error):.3g} mm"
            return [], f"the posture that was chosen does not take its grasp ({off} off, or limits)"
        engine = self._engine.engine_for(problem)
        found = engine.finder.find(
            problem, start, seed, limit, "q0", apart=0.05, query=engine.collision_query(problem)
        )
        # A solve looks further for an answer that is free than a list of all does.
        best = engine.solve(replace(problem, prefer="q0"), SolveOptions(start, seed))
        every = [*best.q[best.success], *(one.q for one in found)][:limit]
        return every, "" if every else "the grasp has no solution"

    def _path_plan(self, q0: Array, targets: TargetBatch | None = None) -> FollowPlan:
        """Paths are gone along at any speed."""
        bounds, rates = self._bounds(targets), unbounded(self.robot)
        check, compiled = self._engine.check, self._engine.compiled
        return FollowPlan(
            self._request, check, compiled, q0, bounds, 1.0, rates, q0, math.inf, PATH_PULL
        )

    def _bounds(self, targets: TargetBatch | None) -> tuple[Array, Array]:
        """Return the (n,) limits of motions, see `RobotDescription.motion_limits`."""
        if targets is None:
            targets = self._anything(0.0)
        robot = self.robot.description
        lower, upper = targets.bounds(robot)
        endless = robot.continuous & (lower < upper)
        return np.where(endless, robot.motion_limits[0], lower), np.where(
            endless, robot.motion_limits[1], upper
        )

    def _anything(self, place: float) -> TargetBatch:
        """A target with all contacts at a place, or none if that is NaN."""
        anywhere = np.zeros((1, len(self.robot.fingers), 3))
        found = self._request.of_arrays(anywhere, anywhere + 1.0, None)
        return replace(found, points=anywhere + place)
