"""What a solver does with a robot that moves: the part of `Solver` that is about motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import InputError
from casadi_ik.grasps import Grasp
from casadi_ik.methods.hand_first.method import UNBOUNDED
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.plan import FollowPlan
from casadi_ik.motion.rates import Rates, rates_of, seconds, unbounded
from casadi_ik.motion.tracking import Track, track
from casadi_ik.motion.walker import Walker
from casadi_ik.problem.contacts.arrays import by_kinds
from casadi_ik.problem.problems import Problems
from casadi_ik.problem.questions import Questions
from casadi_ik.solving.engine import Engine

SETTLING = 0.1
"""Seconds in which motions that contacts leave free come to their posture."""

FOLLOWING_PULL = 0.1
"""Weight of momentum in a stream. On 28 random smooth paths at half the velocity limits, of which
an undamped step (1e-5) missed a part of 9, this missed a part of one."""

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
        """
        if not grasps:
            raise InputError("grasps: found none, expected at least one")
        if period is None and velocity is not None:
            raise InputError("velocity: given without a period, expected both")
        problems = self._questions.of_grasps(grasps, fixed)
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
