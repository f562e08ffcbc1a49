"""One target a call, arrays in and arrays out: for loops that cannot wait."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.arrays import Array
from casadi_ik.errors import InputError, UnsupportedError
from casadi_ik.methods.hand_first.method import HandFirstMethod
from casadi_ik.methods.hand_first.rounds import OneTarget, RoundsPlan
from casadi_ik.problem.preference import NO_PREFERENCE, preference
from casadi_ik.problem.questions import Questions
from casadi_ik.problem.status import Status
from casadi_ik.solving.engine import Engine
from casadi_ik.solving.run import Run

STATUSES = {int(status): status for status in Status}


class FastSolver:
    """Solves one target a call by hand-first, in memory made once.

    The answers are bit for bit those of `Solver.solve(..., diagnose=False)`, all restarts and the
    verdict included. What it does without: a diagnosis, a log, a `Solution` (errors are in two
    arrays), grasps and what contacts may have beside point and normal, actuators held where they
    are, and interruption of a call by Ctrl-C before its kernel comes back (0.2 s at most).

    An instance has one answer at a time: threads need one each.

    Attributes:
        position_error: (f,) [m] of the last answer, NaN where free; the next call overwrites it.
        angle_error: (f,) [rad], likewise.
    """

    def __init__(self, engine: Engine, questions: Questions) -> None:
        """Compile what is not compiled yet, and lay the arrays out.

        Raises:
            UnsupportedError: The method is not hand-first.
        """
        method = engine.method
        if not isinstance(method, HandFirstMethod):
            raise UnsupportedError(f"fast: expected method 'hand-first', found {method.name!r}")
        method.prepare()
        self._engine, self._questions = engine, questions
        robot = engine.robot
        self._home = robot.home
        f, n = len(robot.fingers), len(robot.actuators)
        self._shapes = (f, 3), (n,)
        self.position_error, self.angle_error = np.full(f, np.nan), np.full(f, np.nan)
        self._iterations = self._restarts = 0
        self._one = None
        if method.kernel.compiled:
            self._one = one = OneTarget(RoundsPlan(method, questions.enforce_limits))
            self._points, self._normals, self._here = one.points, one.normals, one.here
            self._terms = one.terms
            nothing = np.full((1, f, 3), np.nan)
            nothing[0, 0] = 0.0, 0.0, 1.0
            self._terms[:] = method.terms(questions.of_arrays(nothing, nothing, None))
            self._answer = one.q
            self.position_error, self.angle_error = one.position_error, one.angle_error

    def __call__(
        self, points: ArrayLike, normals: ArrayLike, q0: ArrayLike | None = None
    ) -> tuple[Array, Status]:
        """Solve one target.

        Args:
            points: (f, 3) contact points [m], base frame, in `robot.fingers` order; NaN marks a
                free finger.
            normals: (f, 3) outward pad normals; NaN marks a free normal.
            q0: (n,) where the robot is: of several solutions one near it is wanted. None: it is
                at home, and one far from limits is wanted.

        Returns:
            q (n,) [rad or m], which the next call overwrites (`q.copy()` stays), and the status.

        Raises:
            InputError: Wrong shapes or numbers.
        """
        one = self._one
        if one is None:
            return self._slowly(points, normals, q0)
        try:
            self._points[...] = points
            self._normals[...] = normals
            self._here[...] = self._home if q0 is None else q0
        except (TypeError, ValueError):
            return self._slowly(points, normals, q0)
        self._terms[-1] = q0 is not None
        status = one()
        if status is None or np.shape(points) != self._shapes[0]:
            return self._slowly(points, normals, q0)
        return self._answer, STATUSES[status]
