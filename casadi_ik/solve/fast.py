"""One target a call, arrays in and arrays out: for loops that cannot wait."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.model.grasp import real_array
from casadi_ik.solve.engine import Engine, Run
from casadi_ik.solve.request import Request, preference
from casadi_ik.solve.status import Status

STATUSES = {int(status): status for status in Status}


class FastSolver:
    """Solves one target a call, in memory made once.

    The answers are bit for bit those of `Solver.solve(..., diagnose=False)`, all restarts and the
    verdict included. What it does without: a diagnosis, a log, a `Solution` (errors are in two
    arrays), grasps and what contacts may have beside point and normal, actuators held where they
    are, and interruption of a call by Ctrl-C before its kernel comes back (0.2 s at most).

    An instance has one answer at a time: threads need one each.

    Attributes:
        position_error: (f,) [m] of the last answer, NaN where free; the next call overwrites it.
        angle_error: (f,) [rad], likewise.
    """

    def __init__(self, engine: Engine, request: Request) -> None:
        """Compile what is not compiled yet, and lay the arrays out.

        Raises:
            UnsupportedError: The method has no such memory, or there is a scene.
        """
        if engine.check is not None:
            raise UnsupportedError("fast: checks no collisions, expected a solver without a scene")
        method = engine.hand_first
        if method is None:
            found = engine.method.name
            raise UnsupportedError(f"fast: expected method 'hand-first', found {found!r}")
        self._engine, self._request = engine, request
        robot = engine.robot
        f, n = len(robot.fingers), len(robot.actuators)
        self._home, self._shapes = robot.home, ((f, 3), (f, 3), (n,))
        self.position_error, self.angle_error = np.full(f, np.nan), np.full(f, np.nan)
        self._one = one = method.alone(request.enforce_limits)
        if one is None:
            return
        self._points, self._normals, self._here = one.points, one.normals, one.here
        self._terms, self._q, self._rounds = one.terms, one.q, one.plan.rounds
        self.position_error, self.angle_error = one.position_error, one.angle_error
        # Tolerances and limits are the same for all targets.
        any_contact = np.zeros((1, *self._shapes[0])), np.ones((1, *self._shapes[0]))
        self._terms[...] = method.terms(request.of_arrays(*any_contact, None))

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
            q (n,) [rad or m] and the status.

        Raises:
            InputError: Wrong shapes or numbers.
        """
        one = self._one
        if one is None:
            return self._slowly(points, normals, q0)
        try:
            p, n = _numbers(points), _numbers(normals)
            here = self._home if q0 is None else _numbers(q0)
        except (TypeError, ValueError):
            return self._slowly(points, normals, q0)
        if (p.shape, n.shape, here.shape) != self._shapes:
            return self._slowly(points, normals, q0)
        self._points[...], self._normals[...], self._here[...] = p, n, here
        self._terms[-1] = q0 is not None
        status = one(self._rounds)
        if status is None:
            return self._slowly(points, normals, q0)
        return self._q.copy(), STATUSES[status]

    def _slowly(
        self, points: ArrayLike, normals: ArrayLike, q0: ArrayLike | None
    ) -> tuple[Array, Status]:
        """The way of a batch: without a compiler, and for what has to be refused in words.

        Raises:
            InputError: Wrong shapes or numbers.
        """
        request = self._request
        prefer = preference(None, q0 is not None)
        one: Any = [points], [normals]
        targets = request.of_arrays(one[0], one[1], None, prefer=prefer)
        start = request.start(q0)
        solution = self._engine.solve(targets, Run(start)).solution(0)
        verdicts = solution.contacts.values()
        self.position_error[...] = [verdict.position_error for verdict in verdicts]
        self.angle_error[...] = [verdict.angle_error for verdict in verdicts]
        return solution.q, solution.status


def _numbers(value: ArrayLike) -> Array:
    """Real numbers as an array.

    Raises:
        TypeError: Something else.
        ValueError: The same.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    return real_array(value)
