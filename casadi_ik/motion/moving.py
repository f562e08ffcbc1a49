"""What a solver does with a robot that moves: the part of `Solver` that is about motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.methods.hand_first.method import UNBOUNDED
from casadi_ik.motion.approaching import Approach, ApproachPlan, approach
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.motion.rates import Rates, length, rates_of, seconds, unbounded
from casadi_ik.motion.reaching import Reach, ReachPlan, reach
from casadi_ik.motion.tracking import Track, track
from casadi_ik.motion.walker import Walker
from casadi_ik.problem.contacts.arrays import by_kinds
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.questions import Questions
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run

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
    _questions: Questions

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
        start = self._questions.start(q0)
        rates = rates_of(self.robot, velocity, acceleration)
        comfortable = start if posture is None else self._questions.start(posture)
        return Follower(
            self._plan(
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
        problems = replace(self._questions.of_grasps(grasps, fixed), palms=None)
        if problems.fixed is not None and problems.fixed.ndim > 1:
            problems = replace(problems, fixed=self._questions.held(fixed))
        engine, start = self._engine.kinds_of(problems), self._questions.start(q0)
        _ = engine.finder
        ((kinds, _, _),) = by_kinds(problems.rows(slice(0, 1)))
        travel = None
        if period is not None:
            travel = rates_of(self.robot, velocity, None).steps(seconds("period", period))[0]
        bounds, rates = self._bounds(problems), unbounded(self.robot)
        walker = Walker(self._plan(start, bounds, 1.0, rates, start, math.inf, PATH_PULL), kinds)
        prefer = "limits" if q0 is None else "q0"
        return track(engine, problems, start, prefer, walker, travel, seed)

    def reach(
        self,
        grasp: Grasp,
        q0: ArrayLike | None = None,
        opening: float = 0.02,
        distance: float = 0.08,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        period: float = 0.01,
        seed: int = 0,
        limit: int = 8,
    ) -> Reach:
        """The way from where the robot is to a grasp, in time.

        It goes to a pre-grasp, where the hand is open; comes straight along the line from the palm
        to the contacts; and closes. Solutions of the grasp are tried, nearest first, until there
        is a way to one. With a scene all of it is checked, between its points too: the straight
        way there if it is free, else one by OMPL; fingers touch the object only while they close.

        Args:
            grasp: A contact per finger.
            q0: (n,) where the robot is, at rest [rad or m]; None: at home.
            opening: How far the fingertips are from their contacts before they close [m].
            distance: How far the hand comes straight [m].
            velocity: As for `follow`.
            acceleration: As for `follow`.
            period: Time between two samples of the motion [s].
            seed: Of starts and of a planner.
            limit: Solutions that are tried at most.

        Raises:
            InputError: Bad numbers, or a grasp the robot cannot take.
            MissingExtraError: toppra is not installed (extra `motion`).
            UnsupportedError: The method is not hand-first.

        Example:
            >>> found = solver.reach(grasp, q0=robot.home)
            >>> found.status.name, bool(found.motion.times[-1] > 0)
            ('REACHED', True)
        """
        start = self._questions.start(q0)
        last, solutions = self._solutions(grasp, start, opening, distance, seed, limit)
        rates = rates_of(self.robot, velocity, acceleration)
        asked = ReachPlan(last, rates, seconds("period", period), seed)
        return reach(asked, np.clip(start, *last.plan.bounds), solutions)

    def approach(
        self,
        grasp: Grasp,
        distance: float = 0.08,
        opening: float = 0.02,
        q0: ArrayLike | None = None,
        seed: int = 0,
        limit: int = 8,
    ) -> Approach:
        """The last part of the way to a grasp: a pre-grasp, straight on, closing.

        The hand is open at the pre-grasp and comes straight along the line from the palm to the
        contacts. Solutions of the grasp are tried, nearest to q0 first. With a scene all of it is
        checked, between its points too; fingers touch the object only while they close.

        Args:
            grasp: As for `reach`.
            distance: How far the hand comes straight [m].
            opening: How far the fingertips are from their contacts before they close [m].
            q0: (n,) where the robot is [rad or m]; None: at home.
            seed: Of starts.
            limit: Solutions that are tried at most.

        Raises:
            InputError: Bad numbers, or a grasp the robot cannot take.
            UnsupportedError: The method is not hand-first.

        Example:
            >>> found = solver.approach(grasp)
            >>> found.success, found.pregrasp.shape
            (True, (14,))
        """
        start = self._questions.start(q0)
        return approach(*self._solutions(grasp, start, opening, distance, seed, limit))

    def _solutions(
        self, grasp: Grasp, start: Array, opening: float, distance: float, seed: int, limit: int
    ) -> tuple[ApproachPlan, list[Array]]:
        """What the last part of the way to a grasp keeps to, and solutions (n,), nearest first."""
        problem = self._questions.of_grasps([grasp], None)
        bounds, free = self._bounds(None), unbounded(self.robot)
        asked = ApproachPlan(
            self._plan(start, bounds, 1.0, free, start, math.inf, PATH_PULL),
            problem,
            length("opening", opening),
            length("distance", distance),
        )
        engine = self._engine.kinds_of(problem)
        found = engine.finder.find(
            problem, start, seed, limit, "q0", apart=0.05, around=engine.around(problem)
        )
        # A solve looks further for an answer that is free than a list of all does.
        best = engine.solve(replace(problem, prefer="q0"), Run(start, seed))
        return asked, [*best.q[best.success], *(one.q for one in found)][:limit]

    def _plan(
        self,
        q0: Array,
        bounds: tuple[Array, Array],
        period: float,
        rates: Rates,
        posture: Array,
        settling: float,
        pull: float,
    ) -> FollowPlan:
        engine = self._engine
        return FollowPlan(
            self._questions,
            engine.check,
            engine.compiled,
            q0,
            bounds,
            period,
            rates,
            posture,
            settling,
            pull,
        )

    def _bounds(self, problems: Problems | None) -> tuple[Array, Array]:
        """(n,) lower and upper."""
        if problems is None:
            f = len(self.robot.fingers)
            anywhere: Any = np.zeros((1, f, 3))
            problems = self._questions.of_arrays(anywhere, anywhere + 1.0, None)
        return problems.bounds(self.robot.description, UNBOUNDED)
