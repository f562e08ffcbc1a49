"""Solver of single targets with array inputs and outputs, for control loops."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.model.grasp import real_array
from casadi_ik.solve.engine import Engine, SolveOptions
from casadi_ik.solve.status import Status
from casadi_ik.solve.target_builder import TargetBuilder

STATUS_BY_CODE = {int(status): status for status in Status}


class FastSolver:
    """Solves one target per call in preallocated memory.

    The results equal those of `Solver.solve(..., diagnose=False)` bit for bit, with all restarts
    and the verdict. It has no diagnosis, log, `Solution` (errors are in two arrays), grasps,
    contact vectors beyond point and normal, or fixed actuators, and Ctrl-C takes effect when the
    kernel returns (0.2 s at most).

    An instance stores one result; create one instance per thread.

    Attributes:
        position_error: (f,) distances of the last result [m], NaN where free; the next call
            overwrites them.
        angle_error: (f,) angles of the last result [rad], NaN where free.
    """

    def __init__(self, engine: Engine, target_builder: TargetBuilder) -> None:
        """Compile the method if necessary, and allocate its memory.

        Args:
            engine: Engine without a scene.
            target_builder: Builder of the targets.

        Raises:
            UnsupportedError: The method is not hand-first, or there is a scene.
        """
        if engine.check is not None:
            raise UnsupportedError("fast: a scene is not supported; expected a solver without one")
        method = engine.hand_search
        if method is None:
            name = engine.method.name
            raise UnsupportedError(f"fast: expected method 'hand-first', found {name!r}")
        self._engine, self._target_builder = engine, target_builder
        robot = engine.robot
        f, n = len(robot.fingers), len(robot.actuators)
        self._home, self._shapes = robot.home, ((f, 3), (f, 3), (n,))
        self.position_error, self.angle_error = np.full(f, np.nan), np.full(f, np.nan)
        self._search = search = method.new_search(target_builder.enforce_limits)
        if search is None:
            return
        self._points, self._normals, self._start = search.points, search.normals, search.q0
        self._parameters, self._q = search.settings, search.q
        self._max_restarts = method.rounds
        self.position_error, self.angle_error = search.position_error, search.angle_error
        # Tolerances and limits are the same for all targets.
        any_contact = np.zeros((1, *self._shapes[0])), np.ones((1, *self._shapes[0]))
        self._parameters[...] = method.settings(target_builder.from_arrays(*any_contact))

    def __call__(
        self, points: ArrayLike, normals: ArrayLike, q0: ArrayLike | None = None
    ) -> tuple[Array, Status]:
        """Solve one target.

        Args:
            points: (f, 3) contact points [m], base frame, in `robot.fingers` order; NaN marks a
                free finger.
            normals: (f, 3) outward pad normals; NaN marks a free normal.
            q0: (n,) start configuration [rad or m]; a solution near it is preferred. None: start
                at home, and prefer a solution far from the limits.

        Returns:
            q (n,) [rad or m] and the status.

        Raises:
            InputError: Wrong shapes or numbers.
        """
        search = self._search
        if search is None:
            return self._solve_as_batch(points, normals, q0)
        try:
            p, n = _as_array(points), _as_array(normals)
            start = self._home if q0 is None else _as_array(q0)
        except (TypeError, ValueError):
            return self._solve_as_batch(points, normals, q0)
        if (p.shape, n.shape, start.shape) != self._shapes:
            return self._solve_as_batch(points, normals, q0)
        self._points[...], self._normals[...], self._start[...] = p, n, start
        self._parameters[-1] = q0 is not None
        status = search(self._max_restarts)
        if status is None:
            return self._solve_as_batch(points, normals, q0)
        return self._q.copy(), STATUS_BY_CODE[status]

    def _solve_as_batch(
        self, points: ArrayLike, normals: ArrayLike, q0: ArrayLike | None
    ) -> tuple[Array, Status]:
        """Solve as a batch of one target: without a compiler, and to report malformed input.

        Raises:
            InputError: Wrong shapes or numbers.
        """
        builder = self._target_builder
        arrays: Any = [points], [normals]
        start = None if q0 is None else builder.start(q0)
        targets = builder.from_arrays(arrays[0], arrays[1], q0=start)
        solution = self._engine.solve(targets, SolveOptions()).solution(0)
        verdicts = solution.contacts.values()
        self.position_error[...] = [verdict.position_error for verdict in verdicts]
        self.angle_error[...] = [verdict.angle_error for verdict in verdicts]
        return solution.q, solution.status


def _as_array(value: ArrayLike) -> Array:
    """Return real numbers as an array.

    Raises:
        TypeError: The value is not numeric.
        ValueError: The value is ragged or not real.
    """
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    return real_array(value)
