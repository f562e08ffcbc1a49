"""The verdict: is it solved? Recomputed from q alone, whatever a method believes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_ik.arm_hand import ArmHand
from casadi_ik.solvers.problem import Array, Problems

LIMIT_SLACK = 1e-9
"""Rounding allowed at a limit [rad or m]: a coupling's arithmetic may end a hair beyond it."""

TOLERANCE_SLACK = 1e-9
"""Relative rounding allowed at a tolerance, so that graph and verdict agree on its edge."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """How k configurations meet their targets; arrays as in `BatchSolution`."""

    position_error: Array
    angle_error: Array
    ok: NDArray[np.bool_]
    limits_ok: NDArray[np.bool_]

    def solved(self, limits: bool) -> NDArray[np.bool_]:
        """(k,) whether every contact is met and, if asked, the robot's limits are kept."""
        ok = np.all(self.ok, axis=1)
        return np.logical_and(ok, self.limits_ok) if limits else ok


def judge(robot: ArmHand, problems: Problems, q: Array) -> Verdict:
    """Compare configurations with their targets.

    Args:
        robot: The robot.
        problems: k targets, or one that all configurations are compared with.
        q: (k, n) configurations.
    """
    return Verdict(*judge_contacts(robot, problems, q), within_limits(robot, q))


def judge_contacts(
    robot: ArmHand, problems: Problems, q: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The same without regard to limits: (k, f) distances [m], angles [rad], and what is met."""
    points, normals = problems.points, problems.normals
    if len(problems) == 1:
        points, normals = points[0], normals[0]
    position, angle = robot.errors(q, points, normals)
    slack = 1 + TOLERANCE_SLACK
    # Free is what the target leaves out; an error that is NaN for another reason is no success.
    met = (position <= problems.position_tolerance * slack) | np.isnan(problems.points[..., 0])
    ok = met & ((angle <= problems.angle_tolerance * slack) | np.isnan(problems.normals[..., 0]))
    return position, angle, ok


def within_limits(robot: ArmHand, q: Array) -> NDArray[np.bool_]:
    """(k,) whether every actuator and every joint of (k, n) configurations is within its limits."""
    return robot.beyond_limits(q) <= LIMIT_SLACK
