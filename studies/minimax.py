"""The smallest factor by which all tolerances of a grasp could be multiplied, by Ipopt.

Over the actuator positions q and the square w of that factor::

    minimise    w
    subject to  |point_i(q) - wanted_i|^2   <= w tolerance_i^2
                |normal_i(q) - wanted_i|^2  <= w chord_i^2        chord = 2 sin(angle / 2)
                lower <= q <= upper,  joint limits behind couplings

A grasp can be met if and only if the minimum is at most 1. Ipopt finds local minima, so it is run
from several starts; what any of them finds to be within tolerance is proved to be so by its q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

import casadi_ik as ik
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.couplings import joint_positions
from casadi_ik.kinematics.forward import actuated

ITERATIONS = 300
"""Maximum number of iterations of Ipopt from one start."""

CLOSE = 1e-8
"""Ipopt's tolerance."""

FIRST = 1.1
"""The factor begins so much above what the start needs: the constraints hold strictly."""


@dataclass(frozen=True, eq=False)
class Nearest:
    """The best that was found.

    Attributes:
        factor: By what all tolerances would have to be multiplied: <= 1 can be met.
        q: (n,) configuration that shows it.
        starts: How many starts were made.
    """

    factor: float
    q: Array
    starts: int


class MinimaxProgram:
    """The program for one robot with one tolerance; contacts are numbers of a solve."""

    def __init__(self, robot: ik.ArmHand, tolerance: ik.Tolerance, fingers: Sequence[str]) -> None:
        """Build the graphs and the solver.

        Args:
            robot: The robot.
            tolerance: Of all contacts.
            fingers: Those that have a contact; the others are free.
        """
        self._robot = robot
        self._rows = [robot.fingers.index(name) for name in fingers]
        description = robot.description
        n, f = len(robot.actuators), len(fingers)
        ranges = robot.upper - robot.lower
        # Sliders of millimetres and joints of radians move the contacts alike once scaled.
        x, w = ca.SX.sym("x", n), ca.SX.sym("w")
        points, normals = ca.SX.sym("points", f, 3), ca.SX.sym("normals", f, 3)
        q = ca.SX(robot.lower) + x * ca.SX(ranges)
        kinematics = actuated(description, q).kinematics
        chord = 2 * np.sin(tolerance.angle / 2)
        squares = []
        for i, name in enumerate(fingers):
            point, normal = kinematics.contact(name)
            squares.append(ca.sumsqr(point - points[i, :].T) / tolerance.position**2)
            squares.append(ca.sumsqr(normal - normals[i, :].T) / chord**2)
        errors = ca.vertcat(*squares)
        joints = joint_positions(description, q)
        inputs = ca.vertcat(ca.vec(points), ca.vec(normals))
        self._squares = ca.Function("squares", [x, inputs], [errors])
        program = {"x": ca.vertcat(x, w), "p": inputs, "f": w, "g": ca.vertcat(errors - w, joints)}
        options = {
            "error_on_fail": False,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.tol": CLOSE,
            "ipopt.max_iter": ITERATIONS,
            "ipopt.bound_relax_factor": 0.0,
        }
        self._solver = ca.nlpsol("minimax", "ipopt", program, options)
        self._lower = np.concatenate([np.full(2 * f, -np.inf), description.joint_lower])
        self._upper = np.concatenate([np.zeros(2 * f), description.joint_upper])

    def nearest(self, points: Array, normals: Array, starts: Array) -> Nearest:
        """Return the smallest factor of several starts; stop at the first one that is at most 1.

        Args:
            points: (f, 3) [m].
            normals: (f, 3).
            starts: (s, n) configurations to begin with.
        """
        robot, rows = self._robot, self._rows
        parameters = np.concatenate([points[rows].T.ravel(), normals[rows].T.ravel()])
        n, ranges = len(robot.lower), robot.upper - robot.lower
        best, best_q = np.inf, starts[0]
        for number, start in enumerate(starts, 1):
            x = (start - robot.lower) / ranges
            first = float(ca.mmax(self._squares(x, parameters)))
            answer = self._solver(
                x0=np.append(x, FIRST * first),
                p=parameters,
                lbx=np.zeros(n + 1),
                ubx=np.append(np.ones(n), np.inf),
                lbg=self._lower,
                ubg=self._upper,
            )
            solution = np.clip(np.array(answer["x"]).ravel()[:n], 0.0, 1.0)
            factor = float(np.sqrt(float(ca.mmax(self._squares(solution, parameters)))))
            q = np.clip(robot.lower + solution * ranges, robot.lower, robot.upper)
            if factor < best and self._within_joint_limits(q):
                best, best_q = factor, q
            if best <= 1:
                return Nearest(best, best_q, number)
        return Nearest(best, best_q, len(starts))

    def _within_joint_limits(self, q: Array) -> bool:
        _, _, limit_excess = self._robot.deviations(q, *self._robot.contacts(q))
        return bool(limit_excess <= 1e-9)
